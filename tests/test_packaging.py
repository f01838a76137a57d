"""Packages built from the checkout can be installed and work outside of it."""

import email
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
QUICK = ("test_quaternion.py", "test_layout.py")
"""Tests that run from the unpacked source package on the installed wheel."""


def run(*command, **options):
    done = subprocess.run(
        [sys.executable, *map(str, command)], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Returns the source package, the wheel built from it, and the folder of its installation."""
    place = tmp_path_factory.mktemp("dist")
    run("-m", "build", "--no-isolation", "--outdir", place, ROOT)
    (source,), (wheel,) = place.glob("*.tar.gz"), place.glob("*.whl")
    site = place / "site"
    quiet = ("--quiet", "--disable-pip-version-check")
    run("-m", "pip", "install", *quiet, "--no-deps", "--no-index", "--target", site, wheel)
    return source, wheel, site


def outside(site, place):
    """Returns options of a process that imports the installed package, not the checkout."""
    return {"cwd": place, "env": os.environ | {"PYTHONPATH": str(site)}}


def test_the_wheel_has_the_package_whole_and_nothing_else(built):
    with zipfile.ZipFile(built[1]) as wheel:
        names = set(wheel.namelist())
        (written,) = (name for name in names if name.endswith("METADATA"))
        metadata = email.message_from_string(wheel.read(written).decode())
    package = ROOT / "jaxcon"
    own = {p.relative_to(ROOT).as_posix() for p in package.rglob("*") if p.is_file()}
    own = {name for name in own if "__pycache__" not in name}
    assert {"jaxcon/py.typed", "jaxcon/renamed.json"} <= own
    about = {name for name in names if ".dist-info/" in name}
    assert names - about == own
    assert [name for name in about if name.endswith("licenses/LICENSE")]
    needed = {re.split(r"[^\w-]", x)[0] for x in metadata.get_all("Requires-Dist") if ";" not in x}
    assert needed == {"jax", "llvmlite", "numpy", "optax", "tqdm"}
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata.get_payload() == README


def test_the_sources_have_tests_licence_and_changelog(built):
    with tarfile.open(built[0]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    for name in ("LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "pyproject.toml"):
        assert name in names
    for folder in ("tests", "jaxcon", "examples", "benchmarks", "docs"):
        own = {p.relative_to(ROOT).as_posix() for p in (ROOT / folder).rglob("*.py")}
        own = {name for name in own if "_build" not in name}
        assert own <= names
    assert not [name for name in names if "__pycache__" in name or "_build" in name]


def test_the_ten_lines_of_the_readme_run_on_the_installed_wheel(built, tmp_path):
    code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)[0]
    said = run("-c", f"{code}\nprint(jc.__file__)", **outside(built[2], tmp_path))
    assert said.splitlines()[-1] == str(built[2] / "jaxcon" / "__init__.py")
    run("-m", "jaxcon", "--help", **outside(built[2], tmp_path))


def test_the_unpacked_tests_run_on_the_installed_wheel(built, tmp_path):
    with tarfile.open(built[0]) as archive:
        archive.extractall(tmp_path, filter="data")
    (place,) = tmp_path.iterdir()
    (place / "jaxcon").rename(tmp_path / "put_away")
    chosen = [f"tests/{name}" for name in QUICK]
    said = run("-m", "pytest", "-n0", *chosen, **outside(built[2], place))
    assert re.search(r"\d+ passed", said)
