"""What a simulated second costs at equal error, in jaxcon, MuJoCo in C on all cores, and MJX.

    python -m benchmarks.equal_error [--motions four-bar …] [--json FILE] [--picture FILE]
        [--resume] [--without-mjx] [--seconds 1]

Every method runs motions whose end is known, at halved steps, until its error no longer falls.
The cost is that of all cores by world and simulated second, in a batch, without compilation. The
table takes the cheapest method of each code at each error, between two steps of one method as a
straight line in the logarithms has it; a run counts with the larger of its own error and that of
half its step, so that no error counts that passes through zero. Every motion and code is a stage:
what is found is written to the file after each, and `--resume` goes on from there. An error is not
reached where something else than the step makes it, or a run of one world takes too long.
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
from benchmarks import work_precision as own
from benchmarks import work_precision_peers as peers
from benchmarks.accuracy import has_mujoco
from benchmarks.motions import MOTIONS, Motion
from benchmarks.work_precision import Point

LEVELS = tuple(10.0**-n for n in range(2, 9))
"""Errors at which costs are compared [m] or [rad]."""
CODES = ("jaxcon", "MuJoCo C", "MJX")
SHOWN = np.logspace(-1, -9, 81)
"""Errors at which a picture shows the least costs."""


@dataclass(frozen=True)
class Price:
    """The least cost of an error.

    Attributes:
        cost: of a simulated second of one world [s].
        setting: of the method.
        note: its batch.
    """

    cost: float
    setting: str
    note: str


def curves(points: Iterable[Point]) -> dict[tuple[str, str, str], list[Point]]:
    """Runs by code, setting and note, the longest step first."""
    found: dict[tuple[str, str, str], list[Point]] = {}
    for point in points:
        found.setdefault((point.code, point.setting, point.note), []).append(point)
    return {key: sorted(runs, key=lambda point: -point.dt) for key, runs in found.items()}


def priced(runs: Sequence[Point], level: float) -> float:
    """The least cost at which one method reaches an error; infinite where it does not."""
    errors = [max(a.error, b.error) for a, b in zip(runs, [*runs[1:], runs[-1]], strict=True)]
    least = min((p.cost for p, e in zip(runs, errors, strict=True) if e <= level), default=np.inf)
    for i, (e, below) in enumerate(zip(errors, errors[1:], strict=False)):
        if below <= level < e < np.inf:
            share = np.log(e / level) / np.log(e / below)
            between = np.log([runs[i].cost, runs[i + 1].cost]) @ [1 - share, share]
            least = min(least, np.exp(between))
    return float(least)


def best(points: Iterable[Point], code: str, level: float) -> Price | None:
    """The cheapest method of a code at an error; None where none reaches it."""
    prices = [
        Price(priced(runs, level), setting, note)
        for (by, setting, note), runs in curves(points).items()
        if by == code
    ]
    reached = [price for price in prices if np.isfinite(price.cost)]
    return min(reached, key=lambda price: price.cost, default=None)


def chosen(points: Sequence[Point]) -> list[Point]:
    """The runs of jaxcon's methods that are the cheapest at some error."""
    labels = {price.setting for level in LEVELS if (price := best(points, "jaxcon", level))}
    return [point for point in points if point.code == "jaxcon" and point.setting in labels]


def ratio(points: Sequence[Point], code: str, level: float) -> float | None:
    """How many times more another code costs; None where one of them does not reach the error."""
    prices = [best(points, name, level) for name in (code, "jaxcon")]
    return prices[0].cost / prices[1].cost if prices[0] and prices[1] else None


HEAD = """
| motion | error | jaxcon | by | MuJoCo C | by | times | MJX | by | times |
|---|---|---|---|---|---|---|---|---|---|"""


def lines(motion: Motion, points: Sequence[Point], codes: Sequence[str] = CODES) -> list[str]:
    """The rows of a motion."""
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
    """A time by world and simulated second."""
    return f"{1e6 * seconds:.3g} µs"


def draw(found: Sequence[tuple[Motion, Sequence[Point]]], picture: Path) -> None:
    """Error by cost, a panel for each motion: every run, and the least cost of each code."""
    from jaxcon import view

    across = min(2, len(found))
    rows = -(-len(found) // across)
    size = {"figsize": (4.6 * across, 3.6 * rows), "squeeze": False, "layout": "constrained"}
    figure, panels = view.pyplot().subplots(rows, across, **size)
    for axes, (motion, points) in zip(panels.flat, found, strict=False):
        panel(axes, motion, points)
    for axes in panels.flat[len(found) :]:
        axes.set_axis_off()
    panels[0][0].legend(title="thick: its cheapest method", fontsize=8, title_fontsize=8)
    pictures.save(figure, picture)


def panel(axes: Any, motion: Motion, points: Sequence[Point]) -> None:
    """One motion on logarithmic axes, whose runs are thin and the best of a code thick."""
    for i, code in enumerate(CODES):
        mine = [point for point in points if point.code == code]
        for runs in curves(mine).values():
            pairs = [(point.cost, point.error) for point in runs if point.error < np.inf]
            axes.plot(*np.reshape(pairs, (-1, 2)).T, color=f"C{i}", lw=0.7, alpha=0.35)
        least = [(price.cost, x) for x in SHOWN if (price := best(mine, code, x))]
        axes.plot(*np.reshape(least, (-1, 2)).T, color=f"C{i}", lw=2.5, label=code)
    axes.set(xscale="log", yscale="log", ylim=(1e-10, 1), title=motion.name)
    axes.set(ylabel=f"error after {motion.seconds:g} s [{motion.unit}]")
    axes.set(xlabel="time of all cores for a simulated\nsecond of one world [s]")
    axes.grid(alpha=0.3)


@dataclass
class Record:
    """What was found, kept on the disk after each stage.

    Attributes:
        stages: runs by stage, such as "four-bar, MJX".
        notes: why runs are missing.
        seconds: that stages took.
        file: None where nothing is kept.
    """

    stages: dict[str, list[Point]]
    notes: list[str]
    seconds: dict[str, float]
    file: Path | None = None

    @classmethod
    def of(cls, file: Path | None, resume: bool) -> Record:
        """A new one, or the one on the disk."""
        if not (resume and file and file.exists()):
            return cls({}, [], {}, file)
        kept = json.loads(file.read_text())
        stages = {name: [_point(x) for x in points] for name, points in kept["stages"].items()}
        return cls(stages, kept["notes"], kept["seconds"], file)

    def run(self, stage: str, steps: Iterator[list[Point]]) -> None:
        """Does a stage that is not there yet."""
        if stage in self.stages:
            return
        begin = time.perf_counter()
        self.stages[stage] = [point for found in steps for point in found]
        self.seconds[stage] = time.perf_counter() - begin
        self.save()

    def points(self, motion: str) -> list[Point]:
        """Of one motion."""
        return [x for stage, own in self.stages.items() for x in own if stage_of(stage) == motion]

    def save(self) -> None:
        """Writes it."""
        if self.file:
            kept = {"machine": timing.machine(), "seconds": self.seconds, "notes": self.notes}
            kept["stages"] = timing.plain(self.stages)
            self.file.write_text(json.dumps(kept, indent=1) + "\n")


def stage_of(stage: str) -> str:
    """The motion of a stage."""
    return stage.rsplit(", ", 1)[0]


def _point(kept: dict[str, Any]) -> Point:
    """One from the disk, whose infinite error is null there."""
    error: Any = np.inf if kept["error"] is None else kept["error"]
    return Point(**(kept | {"error": error}))


def measure(record: Record, motion: Motion, codes: Sequence[str], limit: float = 1.0) -> None:
    """All stages of a motion.

    Args:
        record: which keeps them.
        motion: which.
        codes: of `CODES`.
        limit: of a run of one world, at which halving ends [s].
    """
    runs = own.Runs(motion)
    record.run(f"{motion.name}, jaxcon", runs.all(limit))
    record.notes += [f"{motion.name}, {label}: {why}" for label, why in runs.refused.items()]
    best_ones = chosen(record.points(motion.name))
    record.run(f"{motion.name}, jaxcon's batches", runs.again(best_ones))
    if "MuJoCo C" in codes:
        record.run(f"{motion.name}, MuJoCo C", peers.in_c(motion, limit))
    if "MJX" in codes:
        record.run(f"{motion.name}, MJX", _mjx(record, motion))


def glance(record: Record, motion: Motion) -> None:
    """A small version: RK4 in jaxcon, and in MuJoCo where it is installed."""
    record.run(f"{motion.name}, jaxcon", own.Runs(motion).all(0.1, ["RK4, float64"]))
    if has_mujoco():
        record.run(f"{motion.name}, MuJoCo C", peers.in_c(motion, 0.1, peers.TREES[:1]))


def _mjx(record: Record, motion: Motion) -> Iterator[list[Point]]:
    points, notes = peers.in_mjx(motion)
    record.notes += notes
    yield points


def main() -> None:
    """Prints the table as it grows, writes numbers and picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", nargs="*", default=list(MOTIONS), choices=list(MOTIONS))
    parser.add_argument("--json", type=Path, default=Path("equal_error.json"))
    parser.add_argument("--picture", type=Path, default=Path("equal_error.png"))
    parser.add_argument("--resume", action="store_true", help="keep the stages of the file")
    parser.add_argument("--without-mjx", action="store_true")
    parser.add_argument("--seconds", type=float, default=1.0, help="limit of a run of one world")
    given = parser.parse_args()
    # else factorizations of a batch take all threads and wait in them for one of their own
    os.environ.setdefault("PJRT_NPROC", str(4 * timing.cores()))
    timing.use_all_cores()
    print(timing.machine())
    print(HEAD)
    record = Record.of(given.json, given.resume)
    drawn = []
    codes = [code for code in CODES if code != "MJX" or not given.without_mjx]
    codes = codes if has_mujoco() else codes[:1]
    for name in given.motions:
        motion = MOTIONS[name]()
        measure(record, motion, codes, given.seconds)
        drawn.append((motion, record.points(name)))
        print("\n".join(lines(motion, drawn[-1][1], codes)), flush=True)
    print("\n".join(f"- {stage}: {x:.0f} s" for stage, x in record.seconds.items()))
    print("\n".join(record.notes))
    draw(drawn, given.picture)


if __name__ == "__main__":
    main()
