"""Cost of a simulated second at equal error: jaxcon, MuJoCo in C on all cores, and MJX.

    python -m benchmarks.equal_error [--motions four-bar …] [--json FILE] [--picture FILE]
        [--resume] [--without-mjx] [--seconds 1]

Every method runs motions with known final states. Its step size is halved until the error no longer
falls. The cost is the time of all cores per world and simulated second, in a batch, without
compilation.

For each code and error the table shows the cheapest method. Between two step sizes of a method the
cost is interpolated linearly in the logarithms. The error of a run is the larger of its own error
and the error at the next halved step. An error that happens to pass through zero then does not
count.

Each motion in each code is a stage. Results are written to the file after each stage, and
`--resume` continues from there. A code does not reach an error if a smaller step size no longer
reduces its error, or if a run of one world takes too long.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import pictures, timing
from benchmarks import work_precision as ours
from benchmarks import work_precision_peers as peers
from benchmarks.accuracy import has_mujoco
from benchmarks.motions import MOTIONS, Motion
from benchmarks.work_precision import Point

LEVELS = tuple(10.0**-n for n in range(2, 9))
"""Errors at which costs are compared [m] or [rad]."""
CODES = ("jaxcon", "MuJoCo C", "MJX")
SHOWN = np.logspace(-1, -9, 81)
"""Errors at which the picture shows the lowest costs."""


@dataclass(frozen=True)
class Price:
    """The lowest cost of reaching an error.

    Attributes:
        cost: time per simulated second and world [s].
        setting: name of the cheapest method.
        note: batch size and flags of its run.
    """

    cost: float
    setting: str
    note: str


def curves(points: Iterable[Point]) -> dict[tuple[str, str, str], list[Point]]:
    """Groups runs by code, setting and note. In each group, the longest step size is first."""
    groups: dict[tuple[str, str, str], list[Point]] = {}
    for point in points:
        groups.setdefault((point.code, point.setting, point.note), []).append(point)
    return {key: sorted(runs, key=lambda point: -point.dt) for key, runs in groups.items()}


def priced(runs: Sequence[Point], level: float) -> float:
    """Returns the lowest cost at which one method reaches an error, or infinity if it does not."""
    errors = [max(a.error, b.error) for a, b in zip(runs, [*runs[1:], runs[-1]], strict=True)]
    lowest = min(
        (p.cost for p, error in zip(runs, errors, strict=True) if error <= level), default=np.inf
    )
    for i, (error, next_error) in enumerate(zip(errors, errors[1:], strict=False)):
        if next_error <= level < error < np.inf:
            share = np.log(error / level) / np.log(error / next_error)
            log_cost = np.log([runs[i].cost, runs[i + 1].cost]) @ [1 - share, share]
            lowest = min(lowest, np.exp(log_cost))
    return float(lowest)


def best(points: Iterable[Point], code: str, level: float) -> Price | None:
    """Returns the cheapest method of a code at an error, or None if no method reaches the error."""
    prices = [
        Price(priced(runs, level), setting, note)
        for (owner, setting, note), runs in curves(points).items()
        if owner == code
    ]
    reached = [price for price in prices if np.isfinite(price.cost)]
    return min(reached, key=lambda price: price.cost, default=None)


def chosen(points: Sequence[Point]) -> list[Point]:
    """Returns the runs of those jaxcon methods that are cheapest at one of `LEVELS`."""
    labels = {price.setting for level in LEVELS if (price := best(points, "jaxcon", level))}
    return [point for point in points if point.code == "jaxcon" and point.setting in labels]


def ratio(points: Sequence[Point], code: str, level: float) -> float | None:
    """Returns the cost of another code divided by that of jaxcon.

    It is None if one of the two does not reach the error.
    """
    prices = [best(points, name, level) for name in (code, "jaxcon")]
    return prices[0].cost / prices[1].cost if prices[0] and prices[1] else None


HEAD = """
| motion | error | jaxcon | method | MuJoCo C | method | ratio | MJX | method | ratio |
|---|---|---|---|---|---|---|---|---|---|"""


def lines(motion: Motion, points: Sequence[Point], codes: Sequence[str] = CODES) -> list[str]:
    """Formats the table rows of a motion."""
    rows = []
    for level in LEVELS:
        cells = [motion.name, f"{level:.0e} {motion.unit}"]
        for code in CODES:
            price = best(points, code, level)
            missing = "not reached" if code in codes else "not run"
            cells += [shown(price.cost), price.setting] if price else [missing, ""]
            if code != "jaxcon":
                times = ratio(points, code, level)
                cells.append(
                    "" if times is None else f"{times:.3g}" + (" **slower**" * (times < 1))
                )
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def shown(seconds: float) -> str:
    """Formats a cost, the time per world and simulated second."""
    return f"{1e6 * seconds:.3g} µs"


def draw(results: Sequence[tuple[Motion, Sequence[Point]]], picture: Path) -> None:
    """Plots error against cost, with one panel per motion.

    A panel shows every run, and the lowest cost of each code.
    """
    from jaxcon import view

    columns = min(2, len(results))
    rows = -(-len(results) // columns)
    size = {"figsize": (4.6 * columns, 3.6 * rows), "squeeze": False, "layout": "constrained"}
    figure, panels = view.pyplot().subplots(rows, columns, **size)
    for axes, (motion, points) in zip(panels.flat, results, strict=False):
        panel(axes, motion, points)
    for axes in panels.flat[len(results) :]:
        axes.set_axis_off()
    panels[0][0].legend(title="thick: cheapest method", fontsize=8, title_fontsize=8)
    pictures.save(figure, picture)


def panel(axes: Any, motion: Motion, points: Sequence[Point]) -> None:
    """Plots one motion on log axes: thin lines for runs, thick lines for the lowest cost."""
    for i, code in enumerate(CODES):
        own_points = [point for point in points if point.code == code]
        for runs in curves(own_points).values():
            pairs = [(point.cost, point.error) for point in runs if point.error < np.inf]
            axes.plot(*np.reshape(pairs, (-1, 2)).T, color=f"C{i}", lw=0.7, alpha=0.35)
        lowest = [(price.cost, x) for x in SHOWN if (price := best(own_points, code, x))]
        axes.plot(*np.reshape(lowest, (-1, 2)).T, color=f"C{i}", lw=2.5, label=code)
    axes.set(xscale="log", yscale="log", ylim=(1e-10, 1), title=motion.name)
    axes.set(ylabel=f"error after {motion.seconds:g} s [{motion.unit}]")
    axes.set(xlabel="time of all cores for a simulated\nsecond of one world [s]")
    axes.grid(alpha=0.3)


@dataclass
class Record:
    """Results by stage, saved to disk after each stage.

    Attributes:
        stages: runs by stage; a stage is a motion in one code, such as "four-bar, MJX".
        notes: reasons for missing runs.
        seconds: duration of each stage [s].
        file: path of the JSON file, None if nothing is saved.
    """

    stages: dict[str, list[Point]]
    notes: list[str]
    seconds: dict[str, float]
    file: Path | None = None

    @classmethod
    def of(cls, file: Path | None, resume: bool) -> Record:
        """Creates an empty record, or reads the record on disk if `resume` and the file exists."""
        if not (resume and file and file.exists()):
            return cls({}, [], {}, file)
        saved = json.loads(file.read_text())
        stages = {name: [_point(x) for x in points] for name, points in saved["stages"].items()}
        return cls(stages, saved["notes"], saved["seconds"], file)

    def run(self, stage: str, steps: Iterator[list[Point]]) -> None:
        """Runs a stage and saves the record. A stage that is in the record already is skipped."""
        if stage in self.stages:
            return
        begin = time.perf_counter()
        self.stages[stage] = [point for batch in steps for point in batch]
        self.seconds[stage] = time.perf_counter() - begin
        self.save()

    def points(self, motion: str) -> list[Point]:
        """Returns all runs of one motion."""
        return [x for stage, runs in self.stages.items() for x in runs if stage_of(stage) == motion]

    def save(self) -> None:
        """Writes the record as JSON."""
        if self.file:
            report = {"machine": timing.machine(), "seconds": self.seconds, "notes": self.notes}
            report["stages"] = timing.plain(self.stages)
            self.file.write_text(json.dumps(report, indent=1) + "\n")


def stage_of(stage: str) -> str:
    """Returns the name of the motion of a stage."""
    return stage.rsplit(", ", 1)[0]


def _point(saved: dict[str, Any]) -> Point:
    """Returns a point from its JSON data, where an infinite error is null."""
    error: Any = np.inf if saved["error"] is None else saved["error"]
    return Point(**(saved | {"error": error}))


def measure(record: Record, motion: Motion, codes: Sequence[str], limit: float = 1.0) -> None:
    """Runs all stages of a motion.

    Args:
        record: receives and saves the results.
        motion: the motion to run.
        codes: a subset of `CODES`.
        limit: duration of a run of one world above which the step size is not halved further [s].
    """
    runs = ours.Runs(motion)
    record.run(f"{motion.name}, jaxcon", runs.all(limit))
    record.notes += [f"{motion.name}, {label}: {why}" for label, why in runs.refused.items()]
    cheapest = chosen(record.points(motion.name))
    record.run(f"{motion.name}, jaxcon's batches", runs.again(cheapest))
    if "MuJoCo C" in codes:
        record.run(f"{motion.name}, MuJoCo C", peers.in_c(motion, limit))
    if "MJX" in codes:
        record.run(f"{motion.name}, MJX", _mjx(record, motion))


def glance(record: Record, motion: Motion) -> None:
    """Runs a small version of a motion: RK4 in jaxcon, and in MuJoCo if it is installed."""
    record.run(f"{motion.name}, jaxcon", ours.Runs(motion).all(0.1, ["RK4, float64"]))
    if has_mujoco():
        record.run(f"{motion.name}, MuJoCo C", peers.in_c(motion, 0.1, peers.TREES[:1]))


def _mjx(record: Record, motion: Motion) -> Iterator[list[Point]]:
    points, notes = peers.in_mjx(motion)
    record.notes += notes
    yield points


def main() -> None:
    """Prints the table of costs motion by motion, and writes results and picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", nargs="*", default=list(MOTIONS), choices=list(MOTIONS))
    parser.add_argument("--json", type=Path, default=Path("equal_error.json"))
    parser.add_argument("--picture", type=Path, default=Path("equal_error.png"))
    parser.add_argument("--resume", action="store_true", help="skip stages that are in the file")
    parser.add_argument("--without-mjx", action="store_true")
    parser.add_argument(
        "--seconds", type=float, default=1.0, help="time limit of a run of one world [s]"
    )
    options = parser.parse_args()
    # Otherwise batched factorizations occupy all threads and wait there for a thread of their own.
    os.environ.setdefault("PJRT_NPROC", str(4 * timing.cores()))
    timing.use_all_cores()
    print(timing.machine())
    print(HEAD)
    record = Record.of(options.json, options.resume)
    drawn = []
    codes = [code for code in CODES if code != "MJX" or not options.without_mjx]
    codes = codes if has_mujoco() else codes[:1]
    for name in options.motions:
        motion = MOTIONS[name]()
        measure(record, motion, codes, options.seconds)
        drawn.append((motion, record.points(name)))
        print("\n".join(lines(motion, drawn[-1][1], codes)), flush=True)
    print("\n".join(f"- {stage}: {x:.0f} s" for stage, x in record.seconds.items()))
    print("\n".join(record.notes))
    draw(drawn, options.picture)


if __name__ == "__main__":
    main()
