"""How Sphinx builds these pages: `python -m sphinx -W -b html docs docs/_build`, offline."""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

project = "jaxcon"
author = copyright = "The jaxcon authors"
release = PROJECT["version"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "docstrings"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"jaxcon {release}"

default_role = "py:obj"  # `x` in a docstring is code, and a link where x is documented
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"
myst_heading_anchors = 3
napoleon_use_ivar = True
napoleon_attr_annotations = False
autodoc_typehints_format = "short"
autodoc_mock_imports = ["brax"]
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"

LINKS = (
    (r"\]\(examples\)", "](#examples)"),
    (r"\]\(examples/(\w+)\.py\)", r"](#example-\1)"),
    (r"\]\(benchmarks/RESULTS\.md", "](/benchmarks.md"),
)
"""Files that the README points to, and where they are among these pages."""


def prepare(app, path, parent, content):
    """The README's links as links between pages, its sections one level up: each is a page."""
    if path.name == "README.md":
        text = re.sub(r"^### ", "## ", content[0], flags=re.MULTILINE)
        for pattern, target in LINKS:
            text = re.sub(pattern, target, text)
        content[0] = text


def setup(app):
    """Called by Sphinx."""
    app.connect("include-read", prepare)
