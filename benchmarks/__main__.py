"""Runs all benchmarks, or some by name, and prints one table.

    python -m benchmarks [NAMES …] [--list] [--quick] [--json FILE]
        [--compare [BASELINE]] [--update]

Every number has a unit, a better direction and a factor by which it may get worse. Ratios, errors
and counts are compared with a baseline, by default `benchmarks/baseline.json`. Times and rates
depend on the machine; they are shown, not compared. `--update` stores the results in the baseline.
`--quick` runs a small version of each benchmark, with its own numbers in the baseline. Pictures are
written to the folder of the `--json` file. The exit status is 1 if a benchmark failed, or if one
got worse under `--compare`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks import suite, timing
from benchmarks.entries import ENTRIES
from benchmarks.suite import Baseline, Entry, Outcome


def attempt(entry: Entry, quick: bool, folder: Path | None) -> Outcome:
    """Runs one benchmark. The outcome reports a failure, so later benchmarks still run."""
    missing = [name for name in entry.needs if importlib.util.find_spec(name) is None]
    if missing:
        return Outcome(left_out=f"needs {', '.join(missing)}")
    begin = time.perf_counter()
    try:
        result = entry.run(quick)
        picture = folder / f"{entry.name}.png" if folder and result.draw else None
        if picture and result.draw:
            result.draw(picture)
    except Exception as error:
        return Outcome(seconds=time.perf_counter() - begin, failed=f"fails: {error!r}"[:200])
    elapsed = time.perf_counter() - begin
    return Outcome(result.metrics, elapsed, picture=picture.name if picture else "")


def run(
    names: Iterable[str], quick: bool, baseline: Baseline, folder: Path | None = None
) -> dict[str, Outcome]:
    """Runs benchmarks and prints the table row by row.

    Args:
        names: names of benchmarks.
        quick: True to run the small versions.
        baseline: reference values, printed beside the results.
        folder: folder for pictures; None draws no pictures.
    """
    outcomes = {}
    print(suite.HEAD)
    for name in names:
        outcomes[name] = attempt(ENTRIES[name], quick, folder)
        rows = suite.lines(name, outcomes[name], baseline.of(size_of(quick), name))
        print("\n".join(rows), flush=True)
    return outcomes


def size_of(quick: bool) -> str:
    """Returns the key under which a baseline stores results: "quick" or "full"."""
    return "quick" if quick else "full"


def save(outcomes: dict[str, Outcome], quick: bool, file: Path) -> None:
    """Writes the machine, the size ("quick" or "full") and all outcomes as JSON."""
    report: dict[str, Any] = {"machine": timing.machine(), "size": size_of(quick)}
    report["entries"] = timing.plain(outcomes)
    file.write_text(json.dumps(report, indent=1) + "\n")


def arguments(given: list[str] | None) -> argparse.Namespace:
    """Parses the command line and checks names and files."""
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m benchmarks", None, __doc__, formatter_class=text)
    parser.add_argument(
        "names", nargs="*", metavar="NAMES", help="benchmarks to run (default: all)"
    )
    parser.add_argument("--list", action="store_true", help="list the benchmarks and exit")
    parser.add_argument("--quick", action="store_true", help="run the small versions")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--compare", type=Path, nargs="?", const=suite.FILE, metavar="BASELINE")
    parser.add_argument("--update", action="store_true", help="store the results in the baseline")
    options = parser.parse_args(given)
    wanted = options.compare if not options.update else None
    if wanted and not wanted.exists():
        if str(wanted) in ENTRIES:
            parser.error(f"--compare takes the file of a baseline; name {wanted} before it")
        parser.error(f"there is no baseline {wanted}; --update --compare {wanted} writes one")
    if options.json and not options.json.absolute().parent.is_dir():
        parser.error(f"there is no folder for {options.json}")
    if options.json and options.json.is_dir():
        parser.error(f"{options.json} is a folder; name a file in it")
    if wrong := suite.unknown(options.names, ENTRIES):
        parser.error(f"unknown benchmarks {wrong}; known are {list(ENTRIES)}")
    try:
        options.file = options.compare or suite.FILE
        options.baseline = Baseline.read(options.file)
    except ValueError as error:
        parser.error(str(error))
    return options


def main(given: list[str] | None = None) -> int:
    """Runs the benchmarks named on the command line and returns the exit status."""
    options = arguments(given)
    if options.list:
        print("\n".join(f"{name:18s} {entry.about}" for name, entry in ENTRIES.items()))
        return 0
    baseline, begin = options.baseline, time.perf_counter()
    folder = options.json.absolute().parent if options.json else None
    outcomes = run(options.names or list(ENTRIES), options.quick, baseline, folder)
    print(f"{len(outcomes)} benchmarks in {time.perf_counter() - begin:.0f} s: {longest(outcomes)}")
    print(timing.machine())
    if options.json:
        save(outcomes, options.quick, options.json)
    failed = [name for name, outcome in outcomes.items() if outcome.failed]
    if options.update:
        baseline.updated(size_of(options.quick), outcomes, timing.machine()).write(options.file)
        print(f"wrote {options.file}")
        return int(bool(failed))
    regressions = baseline.worse(size_of(options.quick), outcomes)
    print("\n".join(regressions) or "nothing got worse beyond its tolerance")
    if absent := [name for name in outcomes if not baseline.of(size_of(options.quick), name)]:
        print(f"{options.file.name} has no values for {', '.join(absent)}")
    return int(bool(failed or (regressions and options.compare)))


def longest(outcomes: dict[str, Outcome]) -> str:
    """Returns the three slowest benchmarks with their times, as text."""
    names = sorted(outcomes, key=lambda name: -outcomes[name].seconds)[:3]
    return ", ".join(f"{name} {outcomes[name].seconds:.0f} s" for name in names)


if __name__ == "__main__":
    timing.use_all_cores()
    sys.exit(main())
