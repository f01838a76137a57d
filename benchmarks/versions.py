"""Tests the package on every supported pair of Python and JAX.

    python benchmarks/versions.py [--pairs 3.11:0.8.3 3.13:0.12.0 …] [--pythons 3.11 3.13 3.14]
        [--stages import README guide tests] [--minutes 30] [--folder DIR] [--json FILE] [--list]

Each installed Python is tested with each minor version of JAX that pip offers for it, from the
lower bound in pyproject.toml to the newest. A pair gets a virtual environment with the dependencies
of the package. The first pair has their lower bounds, all other pairs the newest versions. There
are four stages: the import, the programs of the README, the programs of every page of the guide,
and the fast tests with those in `INTERNALS`. A DeprecationWarning is an error throughout.

Pairs run in sequence with a time limit each. The table is printed row by row, and marks stages for
which no time was left. The script needs only Python, and its exit status is 1 if a stage failed.
Environments are kept and reused if a folder is given.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
PYTHONS = ("3.11", "3.13", "3.14")
INTERNALS = {
    *("native", "fusion", "kernels", "worlds", "composition"),
    *("needed", "numerics", "lanes", "quaternion", "layout"),
}
"""Tests of modules that depend on JAX's internals or isolate the package from them."""
TOOLS = ("pytest>=8", "pytest-xdist>=3.5", "flatbuffers")
STAGES = ("import", "README", "guide", "tests")
LEFT_OUT = ("models-you-already-have", "train-policies")
"""Pages of the guide that need MuJoCo or Gymnasium, which restrict versions themselves."""

IMPORT = "import jaxcon; jaxcon.environments; jaxcon.learning"
READER = """
import os, re, sys, time, traceback

def read(page):
    start, names = time.perf_counter(), {}
    try:
        for block in re.findall(r"```python\\n(.*?)```", open(page, encoding="utf-8").read(), re.S):
            exec(block, names)
        result = "ok"
    except BaseException as error:
        traceback.print_exc()
        result = f"{type(error).__name__}: {error}"
    print(f"PAGE {page} {time.perf_counter() - start:.0f} s {result}", flush=True)
    return result != "ok"

failed = False
for page in sys.argv[1:]:
    child = os.fork()  # nothing has imported JAX yet
    if not child:
        os._exit(read(page))
    code = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(code):
        print(f"PAGE {page} 0 s ended by signal {os.WTERMSIG(code)}", flush=True)
    failed |= code != 0
sys.exit(failed)
"""
"""A script that runs the programs of each page in order, in a process of its own per page."""


def project() -> dict[str, Any]:
    """Reads the `project` table of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def fast_tests() -> set[str]:
    """Reads the set `FAST` of the names of fast tests from tests/conftest.py."""
    tree = ast.parse((ROOT / "tests" / "conftest.py").read_text())
    assigned = (x for x in tree.body if isinstance(x, ast.Assign))
    return next(
        ast.literal_eval(x.value) for x in assigned if getattr(x.targets[0], "id", "") == "FAST"
    )


def number(version: str) -> tuple[int, ...]:
    """Returns a version as a tuple of integers, for comparisons."""
    return tuple(int(x) for x in version.split("."))


def chosen(versions: Iterable[str], bound: str) -> list[str]:
    """Returns the lower bound and the last patch of every later minor version."""
    last: dict[tuple[int, ...], str] = {}
    for version in sorted((v for v in versions if re.fullmatch(r"[\d.]+", v)), key=number):
        if number(version) >= number(bound):
            last[number(version)[:2]] = version
    return list(dict.fromkeys([bound, *last.values()]))


def lower_bounds(dependencies: Sequence[str]) -> dict[str, str]:
    """Returns the lower bound of each dependency."""
    return dict(re.fullmatch(r"([\w-]+)>=([\d.]+)", x).groups() for x in dependencies)  # type: ignore[union-attr]


def interpreter(version: str) -> str | None:
    """Returns the path of a Python of this minor version, on the path or in pyenv, or None."""
    on_path = shutil.which(f"python{version}")
    of_pyenv = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for candidate in [*([on_path] if on_path else []), *map(str, of_pyenv)]:
        command = [candidate, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.stdout.strip() == version:
            return candidate
    return None


def offered(python: str) -> list[str]:
    """Returns the versions of JAX that pip offers for a Python."""
    command = [python, "-m", "pip", "index", "versions", "jax", "--disable-pip-version-check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    match = re.search(r"Available versions: (.*)", result.stdout)
    return match[1].split(", ") if match else []


def _packages(record: Path) -> dict[str, str]:
    """Reads the versions of installed packages from the output of `pip freeze`, if it exists."""
    lines = record.read_text().splitlines() if record.exists() else []
    return dict(x.split("==") for x in lines if "==" in x)


class Pair:
    """A version of Python with a version of JAX, and its test results.

    Attributes:
        python: version of Python.
        jax: version of JAX.
        lowest: True if all dependencies have their lower bounds.
        found: result of each stage.
        said: end of the output of each failed stage.
    """

    def __init__(self, python: str, jax: str, lowest: bool = False) -> None:
        self.python, self.jax, self.lowest = python, jax, lowest
        self.found: dict[str, str] = {}
        self.said: dict[str, str] = {}

    def run(self, folder: Path, minutes: float, wanted: Sequence[str] = STAGES) -> None:
        """Creates the environment if needed, and runs the wanted stages."""
        start = time.monotonic()
        end = start + 60 * minutes
        place = folder / f"python{self.python}-jax{self.jax}{'-lowest' * self.lowest}"
        if self._installed(place, end):
            command = [str(place / "venv" / "bin" / "python"), "-W", "error::DeprecationWarning"]
            names = sorted(fast_tests() | INTERNALS)
            tests = [str(ROOT / "tests" / f"test_{name}.py") for name in names]
            guide = [str(p) for p in PAGES[1:] if p.stem not in LEFT_OUT]
            options = ["-n2", "-q", "--durations=0", "-o", f"cache_dir={place / 'pytest'}"]
            stages = (
                ["-c", IMPORT],
                ["-c", READER, str(PAGES[0])],
                ["-c", READER, *guide],
                ["-m", "pytest", *options, *tests],
            )
            for name, stage in zip(STAGES, stages, strict=True):
                if name in wanted:
                    self._stage(name, [*command, *stage], place, end)
        self.found["time"] = f"{(time.monotonic() - start) / 60:.0f} min"

    def _installed(self, place: Path, end: float) -> bool:
        """Creates the environment unless it exists. Returns True if it exists afterwards.

        An environment that lacks a dependency is from before it was one, and is created again.
        """
        record, needed = place / "versions.txt", project()["dependencies"]
        bounds = lower_bounds(needed)
        if not bounds.keys() <= _packages(record).keys():
            others = [f"{k}=={v}" for k, v in bounds.items()] if self.lowest else needed
            exact = {f"jax=={self.jax}", f"jaxlib=={self.jax}"}
            wanted = [*exact, *(x for x in others if not x.startswith("jax"))]
            python, venv = interpreter(self.python), place / "venv"
            pip = [str(venv / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
            for command in (
                [str(python), "-m", "venv", "--clear", str(venv)],
                [*pip, "install", "--quiet", *wanted, *TOOLS],
                [*pip, "freeze"],
            ):
                text = self._stage("install", command, place, end)
                if text is None:
                    return False
            record.write_text(text)
        packages = _packages(record)
        self.found["install"] = ", ".join(
            f"{x} {packages[x]}" for x in ("llvmlite", "numpy", "optax")
        )
        return True

    def _stage(self, name: str, command: list[str], place: Path, end: float) -> str | None:
        """Runs a command and returns its output.

        After a failure or timeout, it records the result and returns None.
        """
        place.mkdir(parents=True, exist_ok=True)
        remaining = end - time.monotonic()
        environment = {
            k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PYTHON"))
        }
        environment |= {
            "PYTHONPATH": str(ROOT),
            "JAX_COMPILATION_CACHE_DIR": str(place / "programs"),
        }
        environment |= {"JAX_PLATFORMS": "cpu", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        try:
            process = subprocess.run(
                command,
                cwd=place,
                env=environment,
                capture_output=True,
                text=True,
                timeout=max(1.0, remaining),
            )
        except subprocess.TimeoutExpired as error:
            text = (error.stdout or b"").decode(errors="replace")
            self.found[name], self.said[name] = "no time left", text[-2000:]
            return None
        summary = outcome(process.stdout)
        self.found[name] = f"FAILED {summary}".strip() if process.returncode else summary or "ok"
        if process.returncode:
            self.said[name] = (process.stdout + process.stderr)[-4000:]
            return None
        return process.stdout


def outcome(text: str) -> str:
    """Counts passed and failed pages or tests in the output of a stage."""
    pages = re.findall(r"^PAGE .*? \d+ s (.*)$", text, re.MULTILINE)
    if len(pages) > 1:
        return f"{pages.count('ok')} of {len(pages)} pages"
    tests = re.findall(r"\d+ (?:passed|failed|skipped|errors?)", text)
    return ", ".join(tests[-4:])


def table(pairs: Sequence[Pair]) -> str:
    """Formats the results of all pairs as a Markdown table."""
    columns = ("install", *STAGES, "time")
    rows = [("Python", "JAX", "with", *STAGES, "time"), ("---",) * 8]
    rows += [(p.python, p.jax, *(p.found.get(c, "—") for c in columns)) for p in pairs]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def all_pairs(pythons: Sequence[str]) -> tuple[list[Pair], list[str]]:
    """Returns the pairs to test, oldest Python first, and the Pythons that are not installed."""
    bound = lower_bounds(project()["dependencies"])["jax"]
    interpreters = {version: interpreter(version) for version in pythons}
    pairs: list[Pair] = []
    for version, python in interpreters.items():
        if python:
            pairs += [Pair(version, jax) for jax in chosen(offered(python), bound)]
    if pairs:
        pairs[0].lowest = True
    return pairs, [version for version, python in interpreters.items() if not python]


def main(arguments: Sequence[str] | None = None) -> int:
    """Tests all supported pairs, or the pairs of `--pairs`, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", nargs="+", default=(), metavar="PYTHON:JAX")
    parser.add_argument("--pythons", nargs="+", default=PYTHONS)
    parser.add_argument("--stages", nargs="+", default=STAGES, choices=STAGES)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true", help="print the pairs and exit")
    options = parser.parse_args(arguments)
    pairs, absent = all_pairs(options.pythons)
    if options.pairs:
        pairs, absent = [Pair(*x.split(":")) for x in options.pairs], []
    for version in absent:
        print(f"Python {version} is not on this machine: not tested.")
    if options.list:
        print(*(f"{p.python}:{p.jax}" for p in pairs))
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)).resolve()
        for i, pair in enumerate(pairs):
            pair.run(folder, options.minutes, options.stages)
            rows = table(pairs[: i + 1]).splitlines()
            print("\n".join(rows[-1:] if i else rows), flush=True)
    for pair in pairs:
        for name, text in pair.said.items():
            print(f"\n{name} of Python {pair.python}, JAX {pair.jax}:\n{text}")
    if options.json:
        results = [{"python": p.python, "jax": p.jax, **p.found} for p in pairs]
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    return 1 if any(p.said for p in pairs) else 0


if __name__ == "__main__":
    sys.exit(main())
