"""Public names: their namespaces, `dir` and `help`, and hints for names of earlier versions."""

import importlib
import inspect
import json
import pydoc
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import jaxcon as jc

RENAMED = json.loads((Path(jc.__file__).parent / "renamed.json").read_text())
SPACES = {n: getattr(jc, n) for n in jc.__all__ if isinstance(getattr(jc, n), ModuleType)}
FACADES = {n: s for n, s in SPACES.items() if n not in ("inertia", "quaternion", "view")}
AT_TOP = [n for n in jc.__all__ if n not in SPACES]
JOINTS = ("Revolute", "Prismatic", "Spherical", "Fixed", "Distance")
PARTS = ("Spring", "Motor", "PlaneContact", "Limit")
METHODS = ("SemiImplicitEuler", "RK4", "Baumgarte", "Projection")
FUNCTIONS = ("tune", "identify", "tradeoff", "report", "check_gradients", "from_mjcf")
CORES = ("use_all_cores", "shard", "compiler_options")
WITHOUT_DOCSTRING = {"jaxcon.WORLD", "jaxcon.devices.compiler_options"}
IN_TWO_PLACES = {*JOINTS, *PARTS, *METHODS, *FUNCTIONS, *CORES}


def public():
    """Returns every public object by its dotted name.

    Names that exist in two places count in their namespace only.
    """
    found = {f"jaxcon.{n}": getattr(jc, n) for n in AT_TOP if n not in IN_TWO_PLACES}
    for space, module in SPACES.items():
        found |= {f"jaxcon.{space}.{n}": getattr(module, n) for n in module.__all__}
    return found


def test_the_top_shows_its_names_and_the_namespaces():
    assert sorted(set(jc.__all__)) == sorted(jc.__all__)
    assert 40 <= len(AT_TOP) <= 51
    assert {n for n in dir(jc) if not n.startswith("__")} == {*jc.__all__, "environments"}
    assert {"__doc__", "__version__"} <= set(dir(jc))


@pytest.mark.parametrize("name", SPACES)
def test_a_namespace_shows_its_names_only(name):
    module = SPACES[name]
    assert sorted(set(module.__all__)) == sorted(module.__all__)
    assert dir(module) == sorted(module.__all__)
    assert importlib.import_module(module.__name__) is module


def test_environments_show_their_names_and_the_adapters_that_can_be_imported():
    shown = dir(jc.environments)
    gymnasium = {"FunctionalEnv", "GymnasiumEnv", "GymnasiumVectorEnv"}
    assert {*shown} - {"BraxEnv"} == {*jc.environments.__all__, *gymnasium}
    assert all(getattr(jc.environments, name) is not None for name in gymnasium)


def test_a_name_is_in_two_places_only_if_it_is_at_the_top():
    places = {}
    for name, module in FACADES.items():
        for each in module.__all__:
            places.setdefault(each, []).append((name, getattr(module, each)))
    assert [n for n, found in places.items() if len(found) > 1] == []
    assert set(places) & set(AT_TOP) == IN_TWO_PLACES
    for name in IN_TWO_PLACES:
        assert getattr(jc, name) is places[name][0][1]


def test_every_public_name_says_what_it_is():
    for name, thing in public().items():
        assert name in WITHOUT_DOCSTRING or inspect.getdoc(thing), name


def test_every_public_method_says_what_it_does():
    for name, thing in public().items():
        if not inspect.isclass(thing) or issubclass(thing, Exception):
            continue
        for key, member in vars(thing).items():
            if not key.startswith("_") and callable(member):
                assert inspect.getdoc(member), f"{name}.{key}"


def test_the_table_of_contents_of_the_package_has_every_name_once():
    names, spaces = jc.__doc__.split("The names that most")[1].split("All other names")
    words = re.findall(r"\w+", names)
    assert [name for name in AT_TOP if words.count(name) != 1] == []
    listed = re.findall(r"^    (\w+)  +\S", spaces, re.MULTILINE)
    assert sorted(listed) == sorted([*SPACES, "environments"])


@pytest.mark.parametrize("name", FACADES)
def test_the_table_of_contents_of_a_namespace_has_every_name_once(name):
    title, contents = FACADES[name].__doc__.split("\n\n", 1)
    assert title.endswith(".")
    listed = re.sub(r"^\w[^:\n]*: ", "", contents, flags=re.MULTILINE)
    assert re.findall(r"\w+", listed) == FACADES[name].__all__


def test_help_has_the_names_of_the_namespace_only():
    text = pydoc.plain(pydoc.render_doc(jc.solvers))
    assert set(re.findall(r"^    class (\w+)", text, re.MULTILINE)) <= set(jc.solvers.__all__)
    assert "Dense" in text
    text = pydoc.plain(pydoc.render_doc(jc))
    assert set(re.findall(r"^    class (\w+)", text, re.MULTILINE)) <= set(jc.__all__)


@pytest.mark.parametrize("old", RENAMED["names"])
def test_an_old_name_raises_with_its_new_one_which_exists(old):
    new = RENAMED["names"][old]
    module, _, name = new.rpartition(".")
    assert name in importlib.import_module(module).__all__
    hint = "see the changelog. tools/rename.py of the repository rewrites code."
    said = re.escape(f"{old} is {new} since 0.2.0: {hint}")
    with pytest.raises(AttributeError, match=f"^{said}$"):
        getattr(jc, old.removeprefix("jaxcon."))


def test_names_that_never_were_raise_as_in_any_module():
    with pytest.raises(AttributeError, match="^module 'jaxcon' has no attribute 'Nothing'$"):
        _ = jc.Nothing


def test_a_name_of_a_namespace_raises_with_its_place():
    with pytest.raises(AttributeError, match="'ActiveSet'; it is jc.solvers.ActiveSet$"):
        _ = jc.ActiveSet


def test_every_new_place_of_a_name_is_in_the_table_or_new():
    new = {"Dopri5", "Dopri8", "Newton", "RotationAngle", "Thrust", "Tendon", "DeadBandSpring"}
    new |= {"FluidDrag", "WrappedSpan", "Muscle", "ShapeContact", *jc.shapes.__all__}
    new |= {*jc.extend.__all__} - {"Pose", "Motion", "StepInfo"}
    moved = {n.rpartition(".")[2] for n in RENAMED["names"].values()}
    in_facades = {each for module in FACADES.values() for each in module.__all__}
    assert in_facades - IN_TWO_PLACES == moved | new


def test_the_changelog_has_the_table():
    text = (Path(__file__).parents[1] / "CHANGELOG.md").read_text()
    section = text.split("\n## ")[1]
    assert "0.2.0" in section.splitlines()[0]
    rows = re.findall(r"^\| `jc\.(\w+)` \| (.*) \|$", section, re.MULTILINE)
    was = r"`(\w+)`(?: \(was `(\w+)`\))?"
    names = [(space, *found) for space, row in rows for found in re.findall(was, row)]
    assert {f"jaxcon.{old or n}": f"jaxcon.{s}.{n}" for s, n, old in names} == RENAMED["names"]


def test_matplotlib_is_imported_by_pictures_only():
    program = "import sys, jaxcon as jc; jc.view.draw; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
