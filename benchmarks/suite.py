"""The contract of the benchmarks, and the comparison with numbers that were stored.

Every number has a name and a unit, and says which way is better and by how much it may get worse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import targets

HIGHER, LOWER = "higher", "lower"
FILE = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True)
class Metric:
    """One number that a benchmark found.

    Attributes:
        name: unique in its entry.
        value: not finite where there is none, which is worse than any number.
        unit: of it; empty for ratios and counts.
        better: `HIGHER` or `LOWER`.
        tolerance: the factor by which it may get worse, at least 1.
        floor: what is below counts as this much, such as rounding.
        transfers: whether it means the same on another machine, as ratios and errors do and times
            do not; a baseline holds only such numbers.
    """

    name: str
    value: float
    unit: str = ""
    better: str = HIGHER
    tolerance: float = 1.5
    floor: float = 0.0
    transfers: bool = True

    def worse_than(self, before: float) -> bool:
        """Whether it is worse than another value by more than the tolerance."""
        now, old = (max(x, self.floor) if math.isfinite(x) else x for x in (self.value, before))
        if not math.isfinite(old):
            return False
        if not math.isfinite(now):
            return True
        limit = old * self.tolerance if self.better == LOWER else old / self.tolerance
        return now > limit if self.better == LOWER else now < limit


def seconds(name: str, value: float) -> Metric:
    """A time, which does not transfer."""
    return Metric(name, value, "s", LOWER, transfers=False)


def rate(name: str, value: float) -> Metric:
    """Work a second, which does not transfer."""
    return Metric(name, value, "1/s", HIGHER, transfers=False)


def error(name: str, value: float, unit: str = "", floor: float = 0.0) -> Metric:
    """An error or violation: of other compilers and processors up to three times as large."""
    return Metric(name, value, unit, LOWER, 3.0, floor)


def count(name: str, value: float, unit: str = "", tolerance: float = 1.0) -> Metric:
    """A number of operations, bytes or failures, which no machine changes."""
    return Metric(name, value, unit, LOWER, tolerance)


@dataclass(frozen=True)
class Found:
    """What an entry found.

    Attributes:
        metrics: its numbers.
        draw: makes a picture at a path; None where there is none.
    """

    metrics: tuple[Metric, ...]
    draw: Callable[[Path], Any] | None = None


@dataclass(frozen=True)
class Entry:
    """One benchmark of the suite.

    Attributes:
        name: by which it is run.
        about: what it measures.
        run: quick → what it found.
        needs: packages without which it is left out.
    """

    name: str
    about: str
    run: Callable[[bool], Found]
    needs: tuple[str, ...] = ()


ENTRIES: dict[str, Entry] = {}
"""By name; `benchmarks.entries` has them all."""
GYMNASIUM, MUJOCO = "gymnasium", "mujoco"
SMALL = ("pendulum", "four-bar")
"""The scenes of a quick run."""


def entry(name: str, *needs: str) -> Callable[[Callable[[bool], Any]], Callable[[bool], Any]]:
    """Enters a function from quick to metrics, or to `Found`; its docstring says what it does."""

    def enters(run: Callable[[bool], Any]) -> Callable[[bool], Any]:
        def found(quick: bool) -> Found:
            result = run(quick)
            return result if isinstance(result, Found) else Found(tuple(result))

        about = (run.__doc__ or "").strip().splitlines()[0]
        ENTRIES[name] = Entry(name, about, found, needs)
        return run

    return enters


def scenes(quick: bool) -> list[str]:
    """Of the comparison with other simulators."""
    return list(SMALL if quick else targets.SCENES)


@dataclass(frozen=True)
class Outcome:
    """What became of an entry.

    Attributes:
        metrics: its numbers.
        seconds: that it took.
        failed: why it has none although it was run; empty where it has.
        left_out: why it was not run; empty where it was.
        picture: where one was drawn.
    """

    metrics: tuple[Metric, ...] = ()
    seconds: float = 0.0
    failed: str = ""
    left_out: str = ""
    picture: str = ""


@dataclass(frozen=True)
class Baseline:
    """Numbers as they were, by size ("quick" or "full"), entry and name.

    Attributes:
        values: of the metrics that transfer.
        machines: on which those of a size and entry were measured.
    """

    values: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    machines: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, file: Path) -> Baseline:
        """From a file; empty where there is none.

        Raises:
            ValueError: the file is no baseline.
        """
        try:
            return cls(**json.loads(file.read_text())) if file.exists() else cls()
        except (ValueError, TypeError):
            raise ValueError(f"{file} is no baseline, as --update --compare FILE writes") from None

    def write(self, file: Path) -> None:
        """To a file."""
        file.write_text(json.dumps(asdict(self), indent=1, sort_keys=True) + "\n")

    def of(self, size: str, entry: str) -> dict[str, float]:
        """The values of an entry by name."""
        return self.values.get(size, {}).get(entry, {})

    def updated(self, size: str, found: Mapping[str, Outcome], machine: Any) -> Baseline:
        """With the numbers of the entries that were run in the place of theirs."""
        new = {
            name: {m.name: m.value for m in outcome.metrics if m.transfers and _finite(m)}
            for name, outcome in found.items()
            if outcome.metrics
        }
        values = self.values | {size: self.values.get(size, {}) | new}
        own = dict.fromkeys(new, machine)
        machines = self.machines | {size: self.machines.get(size, {}) | own}
        return Baseline(values, machines)

    def worse(self, size: str, found: Mapping[str, Outcome]) -> list[str]:
        """What got worse by more than its tolerance or is no longer there, in words."""
        said = []
        for name, outcome in found.items():
            before, now = self.of(size, name), {m.name: m for m in outcome.metrics}
            if outcome.left_out:
                continue
            if outcome.failed:
                said.append(f"{name}: {outcome.failed}")
                continue
            said += [f"{name}: {gone} is missing" for gone in before if gone not in now]
            said += [
                f"{name}: {m.name} was {before[m.name]:.3g} and is {m.value:.3g} {m.unit}".rstrip()
                for m in outcome.metrics
                if m.name in before and m.worse_than(before[m.name])
            ]
        return said


def _finite(metric: Metric) -> bool:
    return math.isfinite(metric.value)


HEAD = """
| benchmark | | value | better | before | may become |
|---|---|---|---|---|---|"""


def lines(name: str, outcome: Outcome, before: Mapping[str, float]) -> list[str]:
    """The rows of an entry."""
    if not outcome.metrics:
        return [f"| {name} | | {outcome.failed or outcome.left_out} | | | |"]
    rows = []
    for m in outcome.metrics:
        old = f"{before[m.name]:.3g}" if m.name in before else ""
        bound = f"{m.tolerance:g} times {'more' if m.better == LOWER else 'less'}"
        cells = [name, m.name, f"{m.value:.3g} {m.unit}".rstrip(), m.better, old]
        rows.append("| " + " | ".join([*cells, bound if m.transfers else "anything"]) + " |")
    return rows


def unknown(names: Iterable[str], entries: Mapping[str, Entry]) -> list[str]:
    """Those names that no entry has."""
    return [name for name in names if name not in entries]
