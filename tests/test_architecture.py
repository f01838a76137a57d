"""Rules about imports within the package, checked in the source; importing has no side effects."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxcon as jc

ROOT = Path(jc.__file__).parent
FLOORS = {
    "core": 0,
    "staging": 1,
    "protocols": 1,
    "geometry": 2,
    "linear": 2,
    "system": 3,
    "constraints": 4,
    "contact": 5,
    "step": 6,
    "builders": 6,
    "methods": 7,
    "execution": 8,
    "readout": 9,
    "view": 10,
    "analysis": 10,
    "io": 10,
    "learning": 11,
    "environments": 11,
    "verification": 11,
    "scenes": 11,
    "demo": 11,
    "__main__": 11,
}
TOP = 11
FACADES = {
    "adjoints",
    "chains",
    "contacts",
    "devices",
    "extend",
    "forces",
    "integrators",
    "joints",
    "shapes",
    "solvers",
    "stabilizers",
    "systems",
}
"""Modules at the top of the package that only import public names."""
PACKAGES = {"analysis", "io", "learning"}
"""Folders whose `__init__` only imports public names."""
USERS = {"environments", "verification", "scenes", "demo", "__main__"}
"""Folders and modules that may use public names, as a user's program does."""
FLOORS |= dict.fromkeys(FACADES, TOP)
MODULES = sorted(ROOT.rglob("*.py"))


def room(path):
    """Returns the top-level folder of a module in the package, or its own name at the top."""
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imports(path):
    """Yields the names of jaxcon modules that a file imports, without imports for type checking."""
    tree = ast.parse(path.read_text())
    for branch in [node for node in tree.body if isinstance(node, ast.If)]:
        if ast.unparse(branch.test) == "TYPE_CHECKING":
            tree.body.remove(branch)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "jaxcon")


def is_facade(name):
    """Returns True if an import takes a name from a facade and not from a module in a folder."""
    _, room, *rest = [*name.split("."), ""]
    if room in PACKAGES:
        return rest[0] in getattr(jc, room).__all__ and rest[0] != "losses" and rest[1:] == [""]
    return room in FACADES or room not in FLOORS


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
        if is_facade(name):
            assert own in USERS, f"{path}: {name} is a public name; import it from its own module"
        elif other != own:
            top = FLOORS[own] == FLOORS[other] == TOP
            assert FLOORS[other] < FLOORS[own] or top, f"{path}: {name} is not on a lower floor"


def test_the_check_knows_facades():
    public = ("jaxcon", "jaxcon.Scene", "jaxcon.solvers", "jaxcon.solvers.Dense")
    modules = ("jaxcon.linear.dense.Dense", "jaxcon.analysis.report.report", "jaxcon.scenes")
    assert all(map(is_facade, [*public, "jaxcon.analysis.report", "jaxcon.io.from_mjcf"]))
    assert not any(map(is_facade, [*modules, "jaxcon.analysis.traps", "jaxcon.learning.losses"]))


def test_the_check_sees_imports():
    names = set(imports(ROOT / "system" / "body_system.py"))
    assert "jaxcon.linear.saddle.Diagonal" in names
    assert len(names) > 5


def uses(path):
    """Yields every dotted name in the code of a file, as (line, name)."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            yield node.lineno, ast.unparse(node)


NOT_IN_THE_LIBRARY = ("jnp.float64", "jax.config.update", "jnp.einsum", "jnp.linalg.inv")
MAY_USE = {"builders/scene.py": {"jnp.float64"}, "core/cores.py": {"jax.config.update"}}
"""The scene checks the dtype that a user gives; `use_all_cores` sets the number of devices."""


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_library_keeps_its_hands_off(path):
    """No forced float64, no global configuration, no einsum of small arrays, no matrix inverse."""
    if room(path) in ("__main__", "verification", "demo"):
        return
    allowed = MAY_USE.get(str(path.relative_to(ROOT)), set())
    for line, name in uses(path):
        assert name not in NOT_IN_THE_LIBRARY or name in allowed, f"{path}:{line}: {name}"


INNER = ("jax.extend", "jax.interpreters", "jax.experimental", "jax.core")
"""JAX modules that may change between versions; CONTRIBUTING.md says why each is used."""
MAY_IMPORT = {
    "staging/batch_last.py": {"jax.core", "jax.experimental", "jax.extend", "jax.interpreters"},
    "staging/chunks.py": {"jax.core", "jax.extend", "jax.interpreters"},
    "staging/cpu.py": {"jax.core", "jax.interpreters"},
    "staging/cuda.py": {"jax.interpreters"},
    "staging/kernels.py": {"jax.core", "jax.experimental", "jax.extend", "jax.interpreters"},
    "staging/entries.py": {"jax.extend"},
    "core/jaxprs.py": {"jax.extend", "jax.interpreters"},
    "staging/program.py": {"jax.core", "jax.extend"},
    "staging/constants.py": {"jax.core", "jax.extend"},
    "core/selection.py": {"jax.core", "jax.extend", "jax.interpreters"},
    "staging/operations.py": {"jax.extend"},
    "core/closures.py": {"jax.extend"},
    "core/doubled.py": {"jax.extend"},
    "core/host.py": {"jax.extend"},
    "staging/fusion.py": {"jax.experimental"},
    "staging/meshes.py": {"jax.core"},
    "core/notices.py": {"jax.experimental"},
    "core/somewhere.py": {"jax.core", "jax.experimental", "jax.extend", "jax.interpreters"},
    "core/equality.py": {"jax.core"},
    "core/pytree.py": {"jax.core"},
    "core/checks.py": {"jax.core"},
}


def foreign(path):
    """Yields the names of JAX modules that a file imports or reaches by a dotted name."""
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


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_module_has_a_docstring(path):
    assert ast.get_docstring(ast.parse(path.read_text()))


def test_importing_changes_no_global_configuration():
    """The check runs in a fresh interpreter; optional packages must not be imported either."""
    program = """
import sys, jax
before = dict(jax.config.values)
import jaxcon
changed = {k for k, v in jax.config.values.items() if before.get(k) != v}
assert not changed, changed
optional = {"matplotlib", "mujoco", "gymnasium"} & set(sys.modules)
assert not optional, optional
assert "jaxcon.environments" not in sys.modules
assert jaxcon.environments.TASKS  # and this registers them with gymnasium
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
