"""Benchmarks and metrics of the benchmark suite, and the comparison with a baseline.

Every metric has a name, a unit, a better direction and a factor by which it may get worse.
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
    """A measured value of a benchmark.

    Attributes:
        name: unique name within its benchmark.
        value: the value. A value that is not finite means that the measurement failed. It is worse
            than any finite value.
        unit: unit, empty for ratios and counts.
        better: `HIGHER` or `LOWER`.
        tolerance: factor by which the value may get worse, at least 1.
        floor: lower bound for comparisons; smaller values, such as rounding, count as the floor.
        transfers: True if the value is comparable between machines, as ratios and errors are. A
            baseline stores only such values.
    """

    name: str
    value: float
    unit: str = ""
    better: str = HIGHER
    tolerance: float = 1.5
    floor: float = 0.0
    transfers: bool = True

    def worse_than(self, before: float) -> bool:
        """Returns True if the value is worse than `before` by more than the tolerance."""
        new, old = (max(x, self.floor) if math.isfinite(x) else x for x in (self.value, before))
        if not math.isfinite(old):
            return False
        if not math.isfinite(new):
            return True
        limit = old * self.tolerance if self.better == LOWER else old / self.tolerance
        return new > limit if self.better == LOWER else new < limit


def seconds(name: str, value: float) -> Metric:
    """Returns the metric of a time in seconds, which is not comparable between machines."""
    return Metric(name, value, "s", LOWER, transfers=False)


def rate(name: str, value: float) -> Metric:
    """Returns the metric of a rate, which is not comparable between machines."""
    return Metric(name, value, "1/s", HIGHER, transfers=False)


def error(name: str, value: float, unit: str = "", floor: float = 0.0) -> Metric:
    """Returns the metric of an error or violation.

    The tolerance is 3, since compilers and processors change rounding.
    """
    return Metric(name, value, unit, LOWER, 3.0, floor)


def count(name: str, value: float, unit: str = "", tolerance: float = 1.0) -> Metric:
    """Returns the metric of a number of operations, bytes or failures.

    It is equal on all machines.
    """
    return Metric(name, value, unit, LOWER, tolerance)


@dataclass(frozen=True)
class Found:
    """The result of a benchmark.

    Attributes:
        metrics: the measured values.
        draw: draws a picture at a path, None if there is no picture.
    """

    metrics: tuple[Metric, ...]
    draw: Callable[[Path], Any] | None = None


@dataclass(frozen=True)
class Entry:
    """A benchmark of the suite.

    Attributes:
        name: name on the command line.
        about: description in one sentence.
        run: (quick) → result.
        needs: packages that it requires.
    """

    name: str
    about: str
    run: Callable[[bool], Found]
    needs: tuple[str, ...] = ()


ENTRIES: dict[str, Entry] = {}
"""All entries by name, registered by importing `benchmarks.entries`."""
GYMNASIUM, MUJOCO = "gymnasium", "mujoco"
SMALL = ("pendulum", "four-bar")
"""Scenes of a quick run."""


def entry(name: str, *needs: str) -> Callable[[Callable[[bool], Any]], Callable[[bool], Any]]:
    """Registers a function (quick) → metrics or `Found` as a benchmark.

    The first line of its docstring becomes the description.
    """

    def register(run: Callable[[bool], Any]) -> Callable[[bool], Any]:
        def run_entry(quick: bool) -> Found:
            result = run(quick)
            return result if isinstance(result, Found) else Found(tuple(result))

        about = (run.__doc__ or "").strip().splitlines()[0]
        ENTRIES[name] = Entry(name, about, run_entry, needs)
        return run

    return register


def scenes(quick: bool) -> list[str]:
    """Returns the names of the scenes in the comparison with other simulators."""
    return list(SMALL if quick else targets.SCENES)


@dataclass(frozen=True)
class Outcome:
    """The outcome of running a benchmark.

    Attributes:
        metrics: the measured values.
        seconds: duration of the benchmark [s].
        failed: the reason of a failure, empty otherwise.
        left_out: the reason why the benchmark was not run, empty otherwise.
        picture: file name of the picture, empty if there is none.
    """

    metrics: tuple[Metric, ...] = ()
    seconds: float = 0.0
    failed: str = ""
    left_out: str = ""
    picture: str = ""


@dataclass(frozen=True)
class Baseline:
    """Stored values by size ("quick" or "full"), benchmark and metric name.

    Attributes:
        values: values of the metrics that are comparable between machines.
        machines: the machine that produced the values, by size and benchmark.
    """

    values: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    machines: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, file: Path) -> Baseline:
        """Reads a baseline from a file. A missing file gives an empty baseline.

        Raises:
            ValueError: the file is not a baseline.
        """
        try:
            return cls(**json.loads(file.read_text())) if file.exists() else cls()
        except (ValueError, TypeError):
            raise ValueError(f"{file} is no baseline, as --update --compare FILE writes") from None

    def write(self, file: Path) -> None:
        """Writes the baseline to a JSON file."""
        file.write_text(json.dumps(asdict(self), indent=1, sort_keys=True) + "\n")

    def of(self, size: str, entry: str) -> dict[str, float]:
        """Returns the stored values of a benchmark by metric name."""
        return self.values.get(size, {}).get(entry, {})

    def updated(self, size: str, outcomes: Mapping[str, Outcome], machine: Any) -> Baseline:
        """Returns a baseline in which the values of these outcomes are replaced."""
        new = {
            name: {m.name: m.value for m in outcome.metrics if m.transfers and _finite(m)}
            for name, outcome in outcomes.items()
            if outcome.metrics
        }
        values = self.values | {size: self.values.get(size, {}) | new}
        new_machines = dict.fromkeys(new, machine)
        machines = self.machines | {size: self.machines.get(size, {}) | new_machines}
        return Baseline(values, machines)

    def worse(self, size: str, outcomes: Mapping[str, Outcome]) -> list[str]:
        """Returns messages about metrics that failed, are missing, or got worse.

        Only a change beyond the tolerance of a metric counts as worse.
        """
        messages = []
        for name, outcome in outcomes.items():
            before, metrics = self.of(size, name), {m.name: m for m in outcome.metrics}
            if outcome.left_out:
                continue
            if outcome.failed:
                messages.append(f"{name}: {outcome.failed}")
                continue
            messages += [
                f"{name}: {missing} is missing" for missing in before if missing not in metrics
            ]
            messages += [
                f"{name}: {m.name} was {before[m.name]:.3g} and is {m.value:.3g} {m.unit}".rstrip()
                for m in outcome.metrics
                if m.name in before and m.worse_than(before[m.name])
            ]
        return messages


def _finite(metric: Metric) -> bool:
    return math.isfinite(metric.value)


HEAD = """
| benchmark | metric | value | better | baseline | may become |
|---|---|---|---|---|---|"""


def lines(name: str, outcome: Outcome, baseline: Mapping[str, float]) -> list[str]:
    """Formats the table rows of a benchmark."""
    if not outcome.metrics:
        return [f"| {name} | | {outcome.failed or outcome.left_out} | | | |"]
    rows = []
    for m in outcome.metrics:
        old = f"{baseline[m.name]:.3g}" if m.name in baseline else ""
        bound = f"{m.tolerance:g} times {'more' if m.better == LOWER else 'less'}"
        cells = [name, m.name, f"{m.value:.3g} {m.unit}".rstrip(), m.better, old]
        rows.append("| " + " | ".join([*cells, bound if m.transfers else "anything"]) + " |")
    return rows


def unknown(names: Iterable[str], entries: Mapping[str, Entry]) -> list[str]:
    """Returns the names that belong to no benchmark."""
    return [name for name in names if name not in entries]
