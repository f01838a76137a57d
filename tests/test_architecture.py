"""Which module may import which, and that importing changes nothing; read from the source."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxcon as jc

ROOT = Path(jc.__file__).parent
FLOORS = {
    "core": 0,
    "geometry": 1,
    "solvers": 1,
    "model": 2,
    "constraints": 3,
    "dynamics": 4,
    "stabilization": 5,
    "simulation": 6,
    "view": 7,
    "analysis": 7,
    "io": 7,
    "learning": 8,
    "environments": 8,
    "verification": 8,
    "scenes": 8,
    "demo": 8,
    "__main__": 8,
}
MODULES = sorted(ROOT.rglob("*.py"))


def room(path):
    """The folder of a module in the package, or its own name at the top."""
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imports(path):
    """Names of the modules of jaxcon that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "jaxcon")


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_module_imports_its_own_folder_and_lower_floors(path):
    own = room(path)
    if own == "__init__":
        return
    assert own in FLOORS, f"{own} has no floor"
    for name in imports(path):
        other = (name.split(".") + [""])[1]
        if own == "__main__" and other in ("", "__version__"):
            continue
        public = other not in FLOORS
        assert not (public and FLOORS[own] < 8), f"{path}: {name} is the public face of the house"
        if public or other == own:
            continue
        top = FLOORS[own] == FLOORS[other] == 8
        assert FLOORS[other] < FLOORS[own] or top, f"{path}: {name} is not on a lower floor"


def test_the_check_sees_imports():
    names = set(imports(ROOT / "model" / "system.py"))
    assert "jaxcon.solvers.saddle.Diagonal" in names
    assert len(names) > 5


def uses(path):
    """Every dotted name in the code of a file, as (line, name)."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            yield node.lineno, ast.unparse(node)


NOT_IN_THE_LIBRARY = ("jnp.float64", "jax.config.update", "jnp.einsum", "jnp.linalg.inv")
MAY_USE = {"dynamics/scene.py": {"jnp.float64"}}
"""A scene checks the dtype that it was given."""


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_library_keeps_its_hands_off(path):
    """No float64 for all, no global configuration, no small einsum, no inverse."""
    if room(path) in ("__main__", "verification", "demo"):
        return
    allowed = MAY_USE.get(str(path.relative_to(ROOT)), set())
    for line, name in uses(path):
        assert name not in NOT_IN_THE_LIBRARY or name in allowed, f"{path}:{line}: {name}"


INNER = ("jax.extend", "jax.interpreters", "jax.experimental", "jax.core")
"""Modules of JAX that may change between its versions; CONTRIBUTING.md says why each is used."""
MAY_IMPORT = {
    "core/native.py": {"jax.core", "jax.extend", "jax.interpreters"},
    "core/jaxprs.py": {"jax.interpreters"},
    "core/program.py": {"jax.extend"},
    "core/operations.py": {"jax.extend"},
    "core/closures.py": {"jax.extend"},
    "core/doubled.py": {"jax.extend"},
    "core/host.py": {"jax.extend"},
    "core/fusion.py": {"jax.experimental"},
    "core/meshes.py": {"jax.core"},
    "core/notices.py": {"jax.experimental"},
    "core/somewhere.py": {"jax.core", "jax.experimental", "jax.extend", "jax.interpreters"},
    "core/equality.py": {"jax.core"},
    "core/pytree.py": {"jax.core"},
    "core/checks.py": {"jax.core"},
}


def foreign(path):
    """Names of the modules of JAX that a file imports or reaches by a dotted name."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute):
            yield ast.unparse(node)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_library_leans_on_few_inner_workings_of_jax(path):
    allowed = MAY_IMPORT.get(path.relative_to(ROOT).as_posix(), set())
    names = set(foreign(path))
    assert not [name for name in names if name.startswith("jax._src")]
    used = {inner for inner in INNER for name in names if f"{name}.".startswith(f"{inner}.")}
    assert used == allowed


def test_every_public_name_exists_and_says_what_it_is():
    assert sorted(set(jc.__all__)) == sorted(jc.__all__)
    shown = {name for name in dir(jc) if not name.startswith("__")}
    assert shown == {*jc.__all__, "environments"} - {"__version__"}
    for name in jc.__all__:
        thing = getattr(jc, name)
        assert name == "WORLD" or inspect.getdoc(thing), name


def test_the_tour_of_the_package_has_every_public_name_once():
    tour = jc.__doc__.split("A tour of the names")[1]
    words = re.findall(r"\w+", tour)
    assert [name for name in jc.__all__ if words.count(name) != 1] == []


def test_every_public_method_says_what_it_does():
    for name in jc.__all__:
        thing = getattr(jc, name)
        if not inspect.isclass(thing) or issubclass(thing, Exception):
            continue
        for key, member in vars(thing).items():
            if not key.startswith("_") and callable(member):
                assert inspect.getdoc(member), f"{name}.{key}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_module_has_a_docstring(path):
    assert ast.get_docstring(ast.parse(path.read_text()))


def test_importing_changes_no_global_configuration():
    """Compared in a fresh interpreter, which also must not import what is optional."""
    program = """
import sys, jax
before = dict(jax.config.values)
import jaxcon
changed = {k for k, v in jax.config.values.items() if before.get(k) != v}
assert not changed, changed
optional = {"matplotlib", "mujoco", "gymnasium"} & set(sys.modules)
assert not optional, optional
assert jaxcon.environments.TASKS  # and this registers them with gymnasium
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
