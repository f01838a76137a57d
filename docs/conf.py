"""How Sphinx builds these pages: `python -m sphinx -W -b html docs docs/_build`, offline."""

import functools
import importlib
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
    (r"\]\((?:\.\./\.\./)?examples\)", "](/examples.md)"),
    (r"\]\((?:\.\./\.\./)?examples/(\w+)\.py\)", r"](#example-\1)"),
    (r"\]\((?:\.\./\.\./)?examples/notebooks\)", "](/notebooks.md)"),
    (r"\]\((?:\.\./\.\./)?benchmarks/RESULTS\.md", "](/benchmarks.md"),
    (r"\]\(benchmarks/(\w+\.png)\)", r"](../benchmarks/\1)"),
    (r"\]\(CONTRIBUTING\.md", "](/contributing.md"),
    (r"\]\(docs/", "](/"),
)
"""Files that the README and the guide point to, and where they are among these pages."""

ALIKE = ("inertia", "quaternion", "view")
"""Namespaces whose names, such as `box`, are linked within them only."""

os.environ.setdefault(  # the notebooks compile much and run little, as the tests do
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true",
)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "docs" / "_build" / ".jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def linked(text):
    """A text whose links are between pages."""
    for pattern, target in LINKS:
        text = re.sub(pattern, target, text)
    return text


def prepare_readme(app, path, parent, content):
    """Called for each file that a page includes."""
    if path.name == "README.md":
        content[0] = linked(content[0])


def prepare_page(app, name, source):
    """Called for each page."""
    if name.startswith("guide/"):
        source[0] = linked(source[0])


def link_name(app, env, node, content):
    """Links `Dense` or `Penalty.from_time` to its namespace, from any page.

    Called for each reference whose target is not on its own page.
    """
    if node.get("refdomain") != "py":
        return None
    head, dot, member = node["reftarget"].partition(".")
    target = public_names().get(head, head) + dot + member
    python = env.get_domain("py")
    if target not in python.objects:
        return None
    return python.resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, content)


@functools.cache
def public_names():
    """Returns dotted names of what the namespaces have, by the last part."""
    package, found = importlib.import_module("jaxcon"), {}
    for space in package.__all__:
        if hasattr(getattr(package, space), "__all__") and space not in ALIKE:
            found |= {n: f"jaxcon.{space}.{n}" for n in getattr(package, space).__all__}
    return {n: f"jaxcon.{n}" for n in package.__all__ if n not in found} | found


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
    app.connect("include-read", prepare_readme)
    app.connect("source-read", prepare_page)
    app.connect("missing-reference", link_name)
