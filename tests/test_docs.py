"""Every public name is on one page of the reference, and its docstring describes its parameters."""

import dataclasses
import enum
import importlib
import inspect
import re
import runpy
from collections import Counter
from pathlib import Path
from types import ModuleType

import jaxcon as jc
import jaxcon.scenes

ROOT = Path(__file__).parents[1]
PAGES = {p.stem: p.read_text() for p in (ROOT / "docs" / "reference").glob("*.rst")}
SPACES = {n: getattr(jc, n) for n in jc.__all__ if isinstance(getattr(jc, n), ModuleType)}
PLACES = {"jaxcon.learning.losses": jc.learning.losses, "jaxcon.scenes": jaxcon.scenes}
"""Documented modules besides the namespaces."""
BESIDE = {
    "jaxcon.system.body_system.BodySystem",
    "jaxcon.system.layout.Layout",
    "jaxcon.constraints.rows.Violation",
    "jaxcon.analysis.front.Run",
    "jaxcon.analysis.gradients.LeafGradient",
    "jaxcon.analysis.front.StabilityLimit",
    "jaxcon.analysis.front.LeftOut",
    "jaxcon.scenes.CRANK_ROCKER",
    "jaxcon.scenes.BICYCLE",
}
"""Types that public functions return, and other names that users meet."""
UNREAD = "jaxcon.environments.brax.BraxEnv"
"""A subclass of a Brax class; the tests run without Brax."""
SECTION = re.compile(r"(Args|Attributes):")
FIELD = re.compile(r" {4}([\w*]+(?:, [\w*]+)*):")


def entries(page):
    """Returns the full names that a page documents, each with its listed members."""
    found, module = [], ""
    for line in page.splitlines():
        if match := re.fullmatch(r"\.\. currentmodule:: (.*)", line):
            module = match[1]
        elif match := re.fullmatch(r"\.\. (?:auto(?!module)\w+|py:data):: (.*)", line):
            name = match[1]
            found.append((name if name.startswith("jaxcon.") else f"{module}.{name}", []))
        elif match := re.fullmatch(r" +:members: (.*)", line):
            found[-1][1].extend(match[1].split(", "))
    return found


ENTRIES = {page: entries(text) for page, text in PAGES.items()}
README = (ROOT / "README.md").read_text()
GUIDE = {p.stem: p.read_text() for p in (ROOT / "docs" / "guide").glob("*.md")}


def look_up(name):
    """Imports the object of a full name, which its module may define under another name."""
    parts = name.split(".")
    here = importlib.import_module("jaxcon")
    for i, part in enumerate(parts[1:], 2):
        if not hasattr(here, part):
            importlib.import_module(".".join(parts[:i]))
        here = getattr(here, part)
    return here


def defined(module):
    """Returns the names of public functions and classes that a module defines."""
    return {
        name
        for name, thing in vars(module).items()
        if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
    }


def public():
    """Returns every full name that belongs in the reference."""
    environments = {*jc.environments.__all__, *jc.environments.ADAPTERS} - {"BraxEnv"}
    spaces = {
        f"jaxcon.{space}.{n}"
        for space, module in SPACES.items()
        for n in module.__all__
        if not isinstance(getattr(module, n), ModuleType)
    }
    elsewhere = {name.rpartition(".")[2] for name in spaces if look_up(name) in at_top()}
    return (
        {f"jaxcon.{n}" for n in jc.__all__ if n not in {*SPACES, *elsewhere}}
        | spaces
        | {f"{place}.{n}" for place, module in PLACES.items() for n in defined(module)}
        | {f"jaxcon.environments.{n}" for n in environments}
        | {*BESIDE, UNREAD}
    )


def at_top():
    """Returns the functions and classes at the top of the package."""
    return [getattr(jc, n) for n in jc.__all__ if n not in SPACES]


def test_every_public_name_is_on_one_page_and_nothing_else_is():
    found = Counter(name for page in ENTRIES.values() for name, _ in page)
    assert set(found) ^ public() == set()
    assert [name for name, count in found.items() if count > 1] == []
    listed = re.findall(r"^   (\w+)$", PAGES["index"], re.MULTILINE)
    assert sorted(listed) == sorted(PAGES.keys() - {"index"})


def test_each_namespace_has_a_page_in_its_order():
    for space, module in SPACES.items():
        names = [name for name, _ in ENTRIES[space] if name not in BESIDE]
        wanted = [n for n in module.__all__ if not isinstance(getattr(module, n), ModuleType)]
        assert names == [f"jaxcon.{space}.{n}" for n in wanted]


def described(doc):
    """Returns the names described in the sections Args and Attributes of a docstring."""
    found, inside = set(), False
    for line in inspect.cleandoc(doc or "").splitlines():
        if line and not line.startswith(" "):
            inside = bool(SECTION.fullmatch(line))
        elif inside and (match := FIELD.match(line)):
            found |= {name.lstrip("*") for name in match[1].split(", ")}
    return found


def numbers(thing):
    """Returns the names that a docstring must describe: parameters, fields, or enum members."""
    if dataclasses.is_dataclass(thing):
        return {f.name for f in dataclasses.fields(thing) if not f.name.startswith("_")}
    if inspect.isclass(thing) and issubclass(thing, enum.Enum):
        return set(thing.__members__)
    if inspect.isclass(thing) and (
        issubclass(thing, Exception) or thing.__dict__.get("_is_protocol")
    ):
        return set()
    return set(inspect.signature(thing).parameters) - {"self", "cls"}


def lacking(thing):
    """Returns the names that neither the object's docstring nor those of its bases describe."""
    places = inspect.getmro(thing)[:-1] if inspect.isclass(thing) else [thing]
    return numbers(thing) - set().union(*(described(p.__doc__) for p in places))


def test_every_number_of_a_public_name_is_described_and_no_other():
    missing, unknown = {}, {}
    for name, members in (entry for page in ENTRIES.values() for entry in page):
        if name == UNREAD:
            continue
        thing = look_up(name)
        parts = {name: thing} if callable(thing) else {}
        parts |= {f"{name}.{m}": getattr(thing, m) for m in members}
        for label, part in parts.items():
            if callable(part):
                assert inspect.getdoc(part), label
                missing[label] = lacking(part)
                unknown[label] = described(part.__doc__) - numbers(part)
            else:
                assert inspect.getdoc(inspect.getattr_static(thing, label.split(".")[-1])), label
    assert {label: left for label, left in missing.items() if left} == {}
    assert {label: more for label, more in unknown.items() if more} == {}


def test_the_check_sees_a_parameter_that_nothing_describes():
    def f(mass, length, *, radius):
        """Says little.

        Args:
            mass: () [kg].
            radius: () [m], where
                length: is a word of the text.

        Raises:
            length: never.
        """

    assert lacking(f) == {"length"}


def test_the_guide_has_the_pages_that_the_readme_names_in_the_same_order():
    named = re.findall(r"^\| \[([^\]]+)\]\(docs/guide/([a-z-]+)\.md\) \|", README, re.MULTILINE)
    assert [page for _, page in named] == re.findall(r"^([a-z-]+)$", GUIDE["index"], re.MULTILINE)
    assert sorted(page for _, page in named) == sorted(GUIDE.keys() - {"index"})
    for title, page in named:
        assert GUIDE[page].startswith(f"# {title}\n")


def test_the_names_in_tables_of_the_guide_exist():
    """`joints.Gear(…)` in a table is `jc.joints.Gear`, and a name without a prefix `jc.Name`."""
    rows = [line for text in GUIDE.values() for line in text.splitlines() if line.startswith("|")]
    spans = [span for row in rows for span in re.findall(r"`([^`]+)`", row)]
    called = {name for span in spans for name in re.findall(r"([\w.]*\b[A-Z]\w+)\(", span)}
    names = {name.removeprefix("jc.") for name in called}
    assert len(names) > 80
    absent = [n for n in names if not _exists(n)]
    assert absent == []


def _exists(name):
    """Returns True if `jc.name` exists."""
    try:
        return look_up(f"jaxcon.{name}") is not None
    except (ImportError, AttributeError):
        return False


def test_the_numbers_of_the_readme_are_those_that_were_measured():
    section = README.split("\n## Performance\n")[1].split("\n## ")[0]
    shown = re.findall(r"[\d.]+(?:e[+-]\d+)? (?:µs|M)\b", section)
    measured = (ROOT / "benchmarks" / "RESULTS.md").read_text()
    assert len(shown) > 10
    assert [x for x in shown if not re.search(rf"(?<![\d.]){re.escape(x)}", measured)] == []


def test_links_between_files_lead_to_files():
    texts = [*ROOT.glob("*.md"), *(ROOT / "benchmarks").glob("*.md")]
    for path in [*texts, *(ROOT / "docs" / "guide").glob("*.md")]:
        for target in re.findall(r"\]\((?!\w+:|#|/)([^)\s#]+)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_every_example_is_on_the_page_of_examples():
    text = (ROOT / "docs" / "examples.md").read_text()
    shown = re.findall(r"{literalinclude} \.\./examples/(\w+)\.py", text)
    assert sorted(shown) == sorted(p.stem for p in (ROOT / "examples").glob("*.py"))


def test_every_notebook_is_on_the_page_of_notebooks():
    text = (ROOT / "docs" / "notebooks.md").read_text()
    listed = re.findall(r"^notebooks/(\w+)$", text, re.MULTILINE)
    assert listed == sorted(p.stem for p in (ROOT / "examples" / "notebooks").glob("*.ipynb"))


def test_the_gallery_shows_small_pictures_that_its_script_makes():
    made = runpy.run_path(str(ROOT / "docs" / "gallery.py"))
    names = {f"{n}.png" for n in made["PICTURES"]} | {f"{n}.gif" for n in made["MOTIONS"]}
    place = ROOT / "docs" / "gallery"
    assert {p.name for p in place.iterdir()} == names
    assert [p.name for p in place.iterdir() if not 1_000 < p.stat().st_size < 200_000] == []
    shown = re.findall(r"\]\(gallery/([\w.]+)\)", (ROOT / "docs" / "gallery.md").read_text())
    assert sorted(shown) == sorted(names)


def commands():
    """Yields (file, module, options) of every `python -m benchmarks…` in the documentation."""
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "RESULTS.md"]
    files += sorted((ROOT / "docs" / "guide").glob("*.md"))
    for path in [*files, *sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))]:
        for module, rest in re.findall(r"python -m (benchmarks[\w.]*)([^`\n]*)`", path.read_text()):
            yield path.name, module, re.findall(r"--[\w-]+", rest)


def test_every_command_of_the_benchmarks_that_is_named_exists_with_its_options():
    found = list(commands())
    assert len(found) > 20
    for name, module, options in found:
        path = ROOT / module.replace(".", "/")
        path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
        assert path.exists(), f"{name}: python -m {module}"
        source = path.read_text()
        for option in options:
            assert option in source, f"{name}: python -m {module} {option}"


def test_links_to_what_is_not_there_are_seen():
    links = runpy.run_path(str(ROOT / "docs" / "links.py"))
    here = ROOT.resolve() / "README.md"
    pages = {here: links["Page"]("<p id='there'><a href='#there'></a></p>")}
    fine = ("#there", "README.md#there", "CHANGELOG.md", "https://jax.dev/x#y", "docs")
    bad = ("#gone", "README.md#gone", "NONE.md", "https://nowhere", "mailto:x", "https://a.b/c d")
    assert [x for x in fine if links["wrong"](x, here, pages)] == []
    assert [x for x in bad if not links["wrong"](x, here, pages)] == []


def test_pages_have_no_programs_of_their_own_that_nothing_runs():
    """The guide is excepted, as `test_examples.py` runs its programs."""
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.rst")]
    assert len(pages) > 30
    for page in pages:
        text = page.read_text()
        if page.parent.name == "guide":
            text = re.sub(r"^```python\n.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        assert not re.search(r"```py|code-block|:: *python|^::$|>>>", text), page
