"""How Sphinx builds these pages: `python -m sphinx -W -b html docs docs/_build`, offline."""

import os
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
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "docstrings"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"jaxcon {release}"

default_role = "py:obj"  # `x` in a docstring is code, and a link where x is documented
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]
nb_execution_mode = "cache"  # a notebook runs again when its code has changed
nb_execution_cache_path = str(ROOT / "docs" / "_build" / ".jupyter_cache")
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
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
    (r"\]\(CONTRIBUTING\.md", "](/contributing.md"),
    (r"\]\(examples/notebooks\)", "](/notebooks.md)"),
    (r"\]\(docs/gallery/", "](/gallery/"),
)
"""Files that the README points to, and where they are among these pages."""

os.environ.setdefault(  # the notebooks compile much and run little, as the tests do
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    " --xla_cpu_use_fusion_emitters=false",
)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "docs" / "_build" / ".jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def prepare(app, path, parent, content):
    """The README's links as links between pages, its sections one level up: each is a page."""
    if path.name == "README.md":
        text = re.sub(r"^### ", "## ", content[0], flags=re.MULTILINE)
        for pattern, target in LINKS:
            text = re.sub(pattern, target, text)
        if parent == "index":  # sections are its neighbours but on the first page
            text = re.sub(r"\]\(#([\w-]+)\)", r"](guide/\1.md)", text)
        content[0] = text


def bring_notebooks():
    """Copies of the notebooks, among these pages, with their links to examples."""
    place = ROOT / "docs" / "notebooks"
    place.mkdir(exist_ok=True)
    for path in (ROOT / "examples" / "notebooks").glob("*.ipynb"):
        text = re.sub(r"\]\(\.\./(\w+)\.py\)", r"](../examples.md#example-\1)", path.read_text())
        copy = place / path.name
        if not copy.exists() or copy.read_text() != text:
            copy.write_text(text)


def setup(app):
    """Called by Sphinx."""
    bring_notebooks()
    app.connect("include-read", prepare)
