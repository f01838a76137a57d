"""The rows that `benchmarks.throughput` measures, their verdicts, and the tables it prints."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks import roofline, targets
from benchmarks.accuracy import Accuracy
from benchmarks.peers import Mjx
from benchmarks.timing import Rate


@dataclass(frozen=True)
class Row:
    """One scene at one precision.

    Attributes:
        scene, dtype: which.
        rates: world-steps a second by batch.
        compile: of the rollout, tracing included, by batch [s].
        accuracy: of one second.
        work: of one step.
        mujoco, mjx: what the peers do, None where they did not run.
        alone: MuJoCo in C with one world on one core.
    """

    scene: str
    dtype: str
    rates: dict[int, Rate]
    compile: dict[int, float]
    accuracy: Accuracy
    work: roofline.Work
    mujoco: Rate | None = None
    mjx: Mjx | None = None
    alone: Rate | None = None

    @property
    def best(self) -> float:
        """The median at the batch that suits it best."""
        return max(rate.median for rate in self.rates.values())

    @property
    def over_c(self) -> float | None:
        """How many times faster than MuJoCo in C."""
        return self.best / self.mujoco.median if self.mujoco else None

    @property
    def over_mjx(self) -> float | None:
        """How many times faster than MJX."""
        best = self.mjx.best if self.mjx else None
        return self.best / best.rate.median if best else None

    @property
    def behind_alone(self) -> float | None:
        """How many times slower than MuJoCo in C on one core with one world, if that was run."""
        ours = self.rates.get(1)
        return self.alone.median / ours.median if self.alone and ours else None

    @property
    def share(self) -> float:
        """Of the machine's elementwise peak."""
        return self.best * self.work.operations / roofline.peak(self.dtype)


def verdict(row: Row) -> str:
    """Whether a row of the table of targets passes."""
    if not row.accuracy.counts:
        return "does not count"
    target, factor = targets.SCENES.get(row.scene), row.over_c
    if target is None or factor is None:
        return "-"
    said = "aim" if factor >= target.aim else "at least" if factor >= target.least else "below"
    slow = row.over_mjx is not None and row.over_mjx < targets.MJX
    return f"{said}; below {targets.MJX:g} x MJX" if slow else said


HEAD = """
| scene | dtype | batch | steps/s (min to max) | compile | violation / link | error [m] | MuJoCo's |
|---|---|---|---|---|---|---|---|"""
AGAINST = """
| scene | dtype | best | MuJoCo C | times | MJX | times | at least | aim | verdict | one world |
|---|---|---|---|---|---|---|---|---|---|---|"""
ROOFLINE = """
| scene | dtype | operations a step | state | rate | of the peak |
|---|---|---|---|---|---|"""


def lines(row: Row) -> list[str]:
    """A row of the first table for each batch."""
    a = row.accuracy
    off = f"{a.violation:.1e}" if a.healthy else "a step failed"
    peer = "-" if a.peer is None else f"{a.peer:.1e}"
    return [
        f"| {row.scene} | {row.dtype} | {batch} | {rate} | {row.compile[batch]:.1f} s"
        f" | {off} | {a.error:.1e} | {peer} |"
        for batch, rate in row.rates.items()
    ]


def against(row: Row) -> str:
    """A row of the comparison."""
    target = targets.SCENES.get(row.scene)
    wanted = (target.least, target.aim) if target else ("-", "-")
    cells = [row.scene, row.dtype, f"{row.best / 1e6:.3g} M", row.mujoco or "-"]
    cells += [times(row.over_c), row.mjx or "-", times(row.over_mjx), *wanted, verdict(row)]
    slower = row.behind_alone
    cells.append("-" if slower is None else f"{slower:.2g} x slower than C on one core")
    return "| " + " | ".join(map(str, cells)) + " |"


def times(factor: float | None) -> str:
    """A ratio in words."""
    return "-" if factor is None else f"{factor:.3g} x"


def roof(row: Row) -> str:
    """A row of the table of operations."""
    return (
        f"| {row.scene} | {row.dtype} | {row.work.operations:.0f} | {row.work.state} B"
        f" | {row.best * row.work.operations / 1e9:.2f} G/s | {100 * row.share:.1f} % |"
    )
