"""All benchmarks, or some by name, as one table.

    python -m benchmarks [NAMES …] [--list] [--quick] [--json FILE]
        [--compare [BASELINE]] [--update]

Every number says its unit, which way is better, and by what factor it may get worse. Ratios, errors
and counts are compared with those of a baseline, `benchmarks/baseline.json` unless given; times and
rates, which other machines change, are only shown. `--update` stores what was found in the
baseline. `--quick` takes a small version of each, with numbers of its own in the baseline. Pictures
lie beside the file of `--json`. Ends with 1 where something failed, or got worse under `--compare`.
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
    """Runs an entry; one that fails says why and does not stop the others."""
    missing = [name for name in entry.needs if importlib.util.find_spec(name) is None]
    if missing:
        return Outcome(left_out=f"needs {', '.join(missing)}")
    begin = time.perf_counter()
    try:
        found = entry.run(quick)
        picture = folder / f"{entry.name}.png" if folder and found.draw else None
        if picture and found.draw:
            found.draw(picture)
    except Exception as trouble:
        return Outcome(seconds=time.perf_counter() - begin, failed=f"fails: {trouble!r}"[:200])
    spent = time.perf_counter() - begin
    return Outcome(found.metrics, spent, picture=picture.name if picture else "")


def run(
    names: Iterable[str], quick: bool, baseline: Baseline, folder: Path | None = None
) -> dict[str, Outcome]:
    """Runs entries and prints the table as it grows.

    Args:
        names: of entries.
        quick: whether the small versions.
        baseline: to be shown beside what is found.
        folder: for pictures; None, and none are drawn.
    """
    found = {}
    print(suite.HEAD)
    for name in names:
        found[name] = attempt(ENTRIES[name], quick, folder)
        rows = suite.lines(name, found[name], baseline.of(size_of(quick), name))
        print("\n".join(rows), flush=True)
    return found


def size_of(quick: bool) -> str:
    """The part of a baseline."""
    return "quick" if quick else "full"


def save(found: dict[str, Outcome], quick: bool, file: Path) -> None:
    """Everything that was found, as JSON."""
    kept: dict[str, Any] = {"machine": timing.machine(), "size": size_of(quick)}
    kept["entries"] = timing.plain(found)
    file.write_text(json.dumps(kept, indent=1) + "\n")


def arguments(given: list[str] | None) -> argparse.Namespace:
    """The options of the command line."""
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m benchmarks", None, __doc__, formatter_class=text)
    parser.add_argument("names", nargs="*", metavar="NAMES", help="all unless given")
    parser.add_argument("--list", action="store_true", help="say what there is")
    parser.add_argument("--quick", action="store_true", help="a small version of each")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--compare", type=Path, nargs="?", const=suite.FILE, metavar="BASELINE")
    parser.add_argument("--update", action="store_true", help="rewrite the baseline")
    asked = parser.parse_args(given)
    wanted = asked.compare if not asked.update else None
    if wanted and not wanted.exists():
        if str(wanted) in ENTRIES:
            parser.error(f"--compare takes the file of a baseline; name {wanted} before it")
        parser.error(f"there is no baseline {wanted}; --update --compare {wanted} writes one")
    if asked.json and not asked.json.absolute().parent.is_dir():
        parser.error(f"there is no folder for {asked.json}")
    if asked.json and asked.json.is_dir():
        parser.error(f"{asked.json} is a folder; name a file in it")
    if strange := suite.unknown(asked.names, ENTRIES):
        parser.error(f"unknown are {strange}; known are {list(ENTRIES)}")
    try:
        asked.file = asked.compare or suite.FILE
        asked.baseline = Baseline.read(asked.file)
    except ValueError as error:
        parser.error(str(error))
    return asked


def main(given: list[str] | None = None) -> int:
    """Runs what is asked for; 1 where something failed or got worse."""
    asked = arguments(given)
    if asked.list:
        print("\n".join(f"{name:18s} {entry.about}" for name, entry in ENTRIES.items()))
        return 0
    baseline, begin = asked.baseline, time.perf_counter()
    folder = asked.json.absolute().parent if asked.json else None
    found = run(asked.names or list(ENTRIES), asked.quick, baseline, folder)
    print(f"{len(found)} benchmarks in {time.perf_counter() - begin:.0f} s: {longest(found)}")
    print(timing.machine())
    if asked.json:
        save(found, asked.quick, asked.json)
    failed = [name for name, outcome in found.items() if outcome.failed]
    if asked.update:
        baseline.updated(size_of(asked.quick), found, timing.machine()).write(asked.file)
        print(f"wrote {asked.file}")
        return int(bool(failed))
    said = baseline.worse(size_of(asked.quick), found)
    print("\n".join(said) or "nothing got worse than it may")
    if new := [name for name in found if not baseline.of(size_of(asked.quick), name)]:
        print(f"{asked.file.name} has nothing to compare with of {', '.join(new)}")
    return int(bool(failed or (said and asked.compare)))


def longest(found: dict[str, Outcome]) -> str:
    """Which entries took the most time, in words."""
    names = sorted(found, key=lambda name: -found[name].seconds)[:3]
    return ", ".join(f"{name} {found[name].seconds:.0f} s" for name in names)


if __name__ == "__main__":
    timing.use_all_cores()
    sys.exit(main())
