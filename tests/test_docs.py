"""Every public name is on one page of the reference, and says what its numbers are."""

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
MODULES = {
    "inertia": jc.inertia,
    "quaternion": jc.quaternion,
    "losses": jc.losses,
    "scenes": jaxcon.scenes,
}
BESIDE = {
    "jaxcon.model.system.BodySystem",
    "jaxcon.model.layout.Layout",
    "jaxcon.constraints.rows.Violation",
    "jaxcon.analysis.front.Run",
    "jaxcon.analysis.gradients.LeafGradient",
    "jaxcon.analysis.front.Limit",
    "jaxcon.analysis.front.LeftOut",
    "jaxcon.view.animate",
    "jaxcon.view.draw",
    "jaxcon.view.links",
    "jaxcon.view.canvas",
    "jaxcon.scenes.CRANK_ROCKER",
    "jaxcon.scenes.BICYCLE",
}
"""What public functions return, and other names that users meet."""
UNREAD = "jaxcon.environments.brax.BraxEnv"
"""It derives from a class of Brax, which tests do without."""
SECTION = re.compile(r"(Args|Attributes):")
FIELD = re.compile(r" {4}([\w*]+(?:, [\w*]+)*):")


def entries(page):
    """Full names of what a page documents, with the members of each."""
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
    """What a full name stands for; modules may have it under another name."""
    parts = name.split(".")
    here = importlib.import_module("jaxcon")
    for i, part in enumerate(parts[1:], 2):
        here = getattr(here, part, None) or importlib.import_module(".".join(parts[:i]))
    return here


def defined(module):
    """Public functions and classes of a module's own."""
    return {
        name
        for name, thing in vars(module).items()
        if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
    }


def public():
    """Every full name that the reference has."""
    environments = {*jc.environments.__all__, *jc.environments.OF_OTHERS} - {"BraxEnv"}
    return (
        {f"jaxcon.{n}" for n in jc.__all__ if not isinstance(getattr(jc, n), ModuleType)}
        | {f"jaxcon.{place}.{n}" for place, module in MODULES.items() for n in defined(module)}
        | {f"jaxcon.environments.{n}" for n in environments}
        | {*BESIDE, UNREAD}
    )


def test_every_public_name_is_on_one_page_and_nothing_else_is():
    found = Counter(name for page in ENTRIES.values() for name, _ in page)
    assert set(found) ^ public() == set()
    assert [name for name, count in found.items() if count > 1] == []
    listed = re.findall(r"^   (\w+)$", PAGES["index"], re.MULTILINE)
    assert sorted(listed) == sorted(PAGES.keys() - {"index"})


def test_pages_are_the_groups_of_the_tour():
    tour = inspect.getdoc(jc).split("A tour of the names")[1]
    groups = dict(re.findall(r"^(\w[^:\n]*): (.*(?:\n    .*)*)", tour, re.MULTILINE))
    pages = {text.splitlines()[0]: page for page, text in PAGES.items()}
    assert len(groups) == 12
    for title, words in groups.items():
        names = [n for n in re.findall(r"\w+", words) if hasattr(jc, n)]
        wanted = {f"jaxcon.{n}" for n in names if n not in MODULES}
        assert {name for name, _ in ENTRIES[pages[title]]} - BESIDE == wanted, title


def described(doc):
    """Names in the sections Args and Attributes of a docstring."""
    found, inside = set(), False
    for line in inspect.cleandoc(doc or "").splitlines():
        if line and not line.startswith(" "):
            inside = bool(SECTION.fullmatch(line))
        elif inside and (match := FIELD.match(line)):
            found |= {name.lstrip("*") for name in match[1].split(", ")}
    return found


def numbers(thing):
    """Names that a docstring owes its reader: parameters, fields, or members."""
    if dataclasses.is_dataclass(thing):
        return {f.name for f in dataclasses.fields(thing) if not f.name.startswith("_")}
    if inspect.isclass(thing) and issubclass(thing, enum.Enum):
        return set(thing.__members__)
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return set()
    return set(inspect.signature(thing).parameters) - {"self", "cls"}


def lacking(thing):
    """Numbers that nothing describes, for a class neither in its docstring nor in its bases'."""
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
    """(file, module, its options) of every `python -m benchmarks…` that a reader is told to run."""
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
    """But for those of the guide, which `test_examples.py` runs."""
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.rst")]
    assert len(pages) > 30
    for page in pages:
        text = page.read_text()
        if page.parent.name == "guide":
            text = re.sub(r"^```python\n.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
        assert not re.search(r"```py|code-block|:: *python|^::$|>>>", text), page
