"""Decisions of the script that tests versions of Python and JAX, before it runs anything."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import versions  # noqa: E402

ROOT = Path(__file__).parents[1]


def test_the_lower_bound_and_the_last_patch_of_each_minor_version_are_tried():
    offered = ["0.10.2", "0.10.1", "0.10.0", "0.9.0.1", "0.9.0", "0.8.4", "0.8.3", "0.8.2", "0.7.2"]
    assert versions.chosen(offered, "0.8.3") == ["0.8.3", "0.8.4", "0.9.0.1", "0.10.2"]
    assert versions.chosen(["0.12.0.1", "0.12.0", "0.13.0rc1"], "0.12.0.1") == ["0.12.0.1"]


def test_the_lower_bounds_are_those_of_the_package():
    least = versions.lower_bounds(versions.project()["dependencies"])
    assert set(least) == {"jax", "llvmlite", "numpy", "optax", "tqdm"}
    assert f"jax>={least['jax']}" in (ROOT / "pyproject.toml").read_text()


def test_every_page_and_module_that_it_names_is_there():
    stems = {page.stem for page in versions.PAGES}
    assert {"README", "tune", *versions.LEFT_OUT} <= stems
    for name in versions.fast_tests() | versions.INTERNALS:
        assert (ROOT / "tests" / f"test_{name}.py").exists()


def test_pages_are_run_and_what_fails_is_counted(tmp_path):
    good, bad, old = (tmp_path / f"{name}.md" for name in ("good", "bad", "old"))
    good.write_text("```python\nx = 1\n```\nand then\n```python\nassert x == 1\n```\n")
    bad.write_text("```python\nx\n```\n")
    old.write_text('```python\nimport warnings\nwarnings.warn("gone", DeprecationWarning)\n```\n')
    command = [sys.executable, "-W", "error::DeprecationWarning", "-c", versions.READER]
    done = subprocess.run(
        [*command, *map(str, (good, bad, old))], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert versions.outcome(done.stdout) == "1 of 3 pages"
    assert re.search(r"bad.md 0 s NameError: name 'x'", done.stdout)
    assert re.search(r"old.md 0 s DeprecationWarning: gone", done.stdout)


def test_what_tests_printed_is_counted():
    assert versions.outcome("...\n2 failed, 7 passed, 1 skipped in 3.00s") == (
        "2 failed, 7 passed, 1 skipped"
    )


def test_time_is_bounded(tmp_path):
    pair = versions.Pair("3.11", "0.8.3")
    slow = [sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(60)"]
    assert pair._stage("README", slow, tmp_path, end=0.0) is None
    assert pair.found["README"] == "no time left"


@pytest.mark.skipif(os.name != "posix", reason="a Python is looked for as on Unix")
def test_a_python_is_found_by_its_version():
    own = ".".join(map(str, sys.version_info[:2]))
    found = versions.interpreter(own)
    if found:
        said = subprocess.run([found, "--version"], capture_output=True, text=True, check=True)
        assert own in said.stdout
    assert versions.interpreter("2.0") is None


def test_the_table_has_a_row_for_each_pair():
    pair = versions.Pair("3.13", "0.12.0")
    pair.found |= {"import": "ok", "time": "2 min"}
    rows = versions.table([pair]).splitlines()
    assert rows[-1] == "| 3.13 | 0.12.0 | — | ok | — | — | — | 2 min |"
    assert len({row.count("|") for row in rows}) == 1
