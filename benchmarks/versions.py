"""Does it run on every Python and JAX that it says it runs on?

    python benchmarks/versions.py [--pairs 3.11:0.8.3 3.13:0.12.0 …] [--pythons 3.11 3.13 3.14]
        [--stages import README guide tests] [--minutes 15] [--folder DIR] [--json FILE] [--list]

Tries each Python that is found with each minor version of JAX that pip has for it, from the lower
bound in pyproject.toml to the newest. A pair gets a virtual environment with the dependencies of
the package: the first pair with their lower bounds, the others with the newest. The stages are the
import, the programs of the README, those of every page of the guide, and the tests of `TESTS`. A
DeprecationWarning is an error throughout.

Pairs run one after the other, each at most so many minutes; what it did not reach is said. The
table is printed as it grows. The script needs nothing but Python, and ends with 1 where something
failed. Environments stay in the folder, if one is given, and are used again.
"""

from __future__ import annotations

import argparse
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
TESTS = (
    *("native", "fusion", "worlds", "composition"),
    *("needed", "numerics", "lanes", "quaternion", "layout"),
)
"""Modules of tests that lean on JAX's inner workings, or hold them at arm's length."""
TOOLS = ("pytest>=8", "pytest-xdist>=3.5", "flatbuffers")
STAGES = ("import", "README", "guide", "tests")
LEFT_OUT = ("models-you-already-have", "train-policies")
"""Pages of the guide that need MuJoCo or Gymnasium, which have versions of their own."""

IMPORT = "import jaxcon; jaxcon.environments; jaxcon.learning"
READER = """
import re, sys, time, traceback
failed = 0
for page in sys.argv[1:]:
    start = time.perf_counter()
    try:
        names = {}
        for block in re.findall(r"```python\\n(.*?)```", open(page, encoding="utf-8").read(), re.S):
            exec(block, names)
        said = "ok"
    except BaseException as error:
        failed += 1
        traceback.print_exc()
        said = f"{type(error).__name__}: {error}"
    print(f"PAGE {page} {time.perf_counter() - start:.0f} s {said}", flush=True)
sys.exit(bool(failed))
"""
"""Runs the programs of each page from its top, and after nothing else."""


def project() -> dict[str, Any]:
    """Reads the package's table of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def number(version: str) -> tuple[int, ...]:
    """A version to be compared."""
    return tuple(int(x) for x in version.split("."))


def chosen(versions: Iterable[str], bound: str) -> list[str]:
    """The lower bound, and the last patch of every minor version after it."""
    last: dict[tuple[int, ...], str] = {}
    for version in sorted((v for v in versions if re.fullmatch(r"[\d.]+", v)), key=number):
        if number(version) >= number(bound):
            last[number(version)[:2]] = version
    return list(dict.fromkeys([bound, *last.values()]))


def lower_bounds(dependencies: Sequence[str]) -> dict[str, str]:
    """The least version of each dependency."""
    return dict(re.fullmatch(r"([\w-]+)>=([\d.]+)", x).groups() for x in dependencies)  # type: ignore[union-attr]


def interpreter(version: str) -> str | None:
    """A Python of this minor version: one on the path, or of pyenv."""
    found = shutil.which(f"python{version}")
    beside = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for candidate in [*([found] if found else []), *map(str, beside)]:
        asked = [candidate, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        said = subprocess.run(asked, capture_output=True, text=True, check=False)
        if said.stdout.strip() == version:
            return candidate
    return None


def offered(python: str) -> list[str]:
    """The versions of JAX that pip has for a Python."""
    command = [python, "-m", "pip", "index", "versions", "jax", "--disable-pip-version-check"]
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"Available versions: (.*)", said.stdout)
    return found[1].split(", ") if found else []


class Pair:
    """One Python with one JAX.

    Attributes:
        python, jax: their versions.
        lowest: whether all dependencies have their lower bounds.
        found: what became of each stage.
        said: the end of what a stage that failed printed.
    """

    def __init__(self, python: str, jax: str, lowest: bool = False) -> None:
        self.python, self.jax, self.lowest = python, jax, lowest
        self.found: dict[str, str] = {}
        self.said: dict[str, str] = {}

    def run(self, folder: Path, minutes: float, wanted: Sequence[str] = STAGES) -> None:
        """Makes the environment where there is none, and goes through the wanted stages."""
        start = time.monotonic()
        end = start + 60 * minutes
        place = folder / f"python{self.python}-jax{self.jax}{'-lowest' * self.lowest}"
        if self._installed(place, end):
            command = [str(place / "venv" / "bin" / "python"), "-W", "error::DeprecationWarning"]
            tests = [str(ROOT / "tests" / f"test_{name}.py") for name in TESTS]
            guide = [str(p) for p in PAGES[1:] if p.stem not in LEFT_OUT]
            options = ["-n0", "-q", "--durations=0", "-o", f"cache_dir={place / 'pytest'}"]
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
        """Makes the environment unless it exists; returns True where it does at the end."""
        done = place / "versions.txt"
        if not done.exists():
            needed = project()["dependencies"]
            least = lower_bounds(needed)
            others = [f"{k}=={v}" for k, v in least.items()] if self.lowest else needed
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
            done.write_text(text)
        packages = dict(x.split("==") for x in done.read_text().splitlines() if "==" in x)
        self.found["install"] = ", ".join(f"{x} {packages[x]}" for x in ("numpy", "optax"))
        return True

    def _stage(self, name: str, command: list[str], place: Path, end: float) -> str | None:
        """Returns the output of a command; None, with a note, where it fails or is out of time."""
        place.mkdir(parents=True, exist_ok=True)
        left = end - time.monotonic()
        own = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PYTHON"))}
        own |= {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": str(place / "programs")}
        own |= {"JAX_PLATFORMS": "cpu", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        try:
            done = subprocess.run(
                command, cwd=place, env=own, capture_output=True, text=True, timeout=max(1.0, left)
            )
        except subprocess.TimeoutExpired as error:
            text = (error.stdout or b"").decode(errors="replace")
            self.found[name], self.said[name] = "no time left", text[-2000:]
            return None
        seen = outcome(done.stdout)
        self.found[name] = f"FAILED {seen}".strip() if done.returncode else seen or "ok"
        if done.returncode:
            self.said[name] = (done.stdout + done.stderr)[-4000:]
            return None
        return done.stdout


def outcome(text: str) -> str:
    """Counts passed and failed pages or tests in the output of a stage."""
    pages = re.findall(r"^PAGE .*? \d+ s (.*)$", text, re.MULTILINE)
    if len(pages) > 1:
        return f"{pages.count('ok')} of {len(pages)} pages"
    tests = re.findall(r"\d+ (?:passed|failed|skipped|errors?)", text)
    return ", ".join(tests[-4:])


def table(pairs: Sequence[Pair]) -> str:
    """The results of all pairs as a Markdown table."""
    columns = ("install", *STAGES, "time")
    rows = [("Python", "JAX", "with", *STAGES, "time"), ("---",) * 8]
    rows += [(p.python, p.jax, *(p.found.get(c, "—") for c in columns)) for p in pairs]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def all_pairs(pythons: Sequence[str]) -> tuple[list[Pair], list[str]]:
    """The pairs to be tried, oldest Python first, and the Pythons that are not here."""
    bound = lower_bounds(project()["dependencies"])["jax"]
    found = {version: interpreter(version) for version in pythons}
    pairs: list[Pair] = []
    for version, python in found.items():
        if python:
            pairs += [Pair(version, jax) for jax in chosen(offered(python), bound)]
    if pairs:
        pairs[0].lowest = True
    return pairs, [version for version, python in found.items() if not python]


def main(arguments: Sequence[str] | None = None) -> int:
    """Tries all pairs, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", nargs="+", default=(), metavar="PYTHON:JAX")
    parser.add_argument("--pythons", nargs="+", default=PYTHONS)
    parser.add_argument("--stages", nargs="+", default=STAGES, choices=STAGES)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true", help="say which pairs, and try none")
    given = parser.parse_args(arguments)
    pairs, absent = all_pairs(given.pythons)
    if given.pairs:
        pairs, absent = [Pair(*x.split(":")) for x in given.pairs], []
    for version in absent:
        print(f"Python {version} is not on this machine: not tried.")
    if given.list:
        print(*(f"{p.python}:{p.jax}" for p in pairs))
        return 0
    with tempfile.TemporaryDirectory() as own:
        folder = (given.folder or Path(own)).resolve()
        for i, pair in enumerate(pairs):
            pair.run(folder, given.minutes, given.stages)
            rows = table(pairs[: i + 1]).splitlines()
            print("\n".join(rows[-1:] if i else rows), flush=True)
    for pair in pairs:
        for name, text in pair.said.items():
            print(f"\n{name} of Python {pair.python}, JAX {pair.jax}:\n{text}")
    if given.json:
        found = [{"python": p.python, "jax": p.jax, **p.found} for p in pairs]
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if any(p.said for p in pairs) else 0


if __name__ == "__main__":
    sys.exit(main())
