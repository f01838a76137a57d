"""The results of `benchmarks.throughput`, their verdicts, and the tables that it prints."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks import roofline, targets
from benchmarks.accuracy import Accuracy
from benchmarks.peers import Mjx
from benchmarks.timing import Rate


@dataclass(frozen=True)
class Row:
    """Results of one scene in one precision.

    Attributes:
        scene: name of the scene.
        dtype: precision.
        rates: world-steps per second by batch size.
        compile: compile time of the rollout, including tracing, by batch size [s].
        accuracy: accuracy of a run of one second.
        work: operations and state size of one step.
        mujoco: rate of MuJoCo in C, None if not measured.
        mjx: runs of MJX, None if not measured.
        alone: rate of MuJoCo in C with one world on one core.
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
        """The median rate at the best batch size."""
        return max(rate.median for rate in self.rates.values())

    @property
    def over_c(self) -> float | None:
        """The best rate divided by that of MuJoCo in C, None if that is not measured."""
        return self.best / self.mujoco.median if self.mujoco else None

    @property
    def over_mjx(self) -> float | None:
        """The best rate divided by the best rate of MJX, None if that is not measured."""
        best = self.mjx.best if self.mjx else None
        return self.best / best.rate.median if best else None

    @property
    def behind_alone(self) -> float | None:
        """The rate of MuJoCo in C over that of jaxcon, for one world.

        MuJoCo uses one core. None if a rate is not measured.
        """
        ours = self.rates.get(1)
        return self.alone.median / ours.median if self.alone and ours else None

    @property
    def share(self) -> float:
        """The share of the machine's elementwise peak that the best rate reaches."""
        return self.best * self.work.operations / roofline.peak(self.dtype)


def verdict(row: Row) -> str:
    """Returns the verdict on a row: the target that it reaches, "below", or "does not count"."""
    if not row.accuracy.counts:
        return "does not count"
    target, factor = targets.SCENES.get(row.scene), row.over_c
    if target is None or factor is None:
        return "-"
    result = "aim" if factor >= target.aim else "at least" if factor >= target.least else "below"
    slow = row.over_mjx is not None and row.over_mjx < targets.MJX
    return f"{result}; below {targets.MJX:g} x MJX" if slow else result


HEAD = """
| scene | dtype | batch | steps/s (min to max) | compile | violation / link | error [m] | MuJoCo's |
|---|---|---|---|---|---|---|---|"""
AGAINST = """
| scene | dtype | best | MuJoCo C | ratio | MJX | ratio | at least | aim | verdict | one world |
|---|---|---|---|---|---|---|---|---|---|---|"""
ROOFLINE = """
| scene | dtype | operations a step | state | rate | of the peak |
|---|---|---|---|---|---|"""


def lines(row: Row) -> list[str]:
    """Formats the rows of the first table, one for each batch size."""
    accuracy = row.accuracy
    violation = f"{accuracy.violation:.1e}" if accuracy.healthy else "a step failed"
    peer = "-" if accuracy.peer is None else f"{accuracy.peer:.1e}"
    return [
        f"| {row.scene} | {row.dtype} | {batch} | {rate} | {row.compile[batch]:.1f} s"
        f" | {violation} | {accuracy.error:.1e} | {peer} |"
        for batch, rate in row.rates.items()
    ]


def against(row: Row) -> str:
    """Formats a row of the comparison with MuJoCo and MJX."""
    target = targets.SCENES.get(row.scene)
    wanted = (target.least, target.aim) if target else ("-", "-")
    cells = [row.scene, row.dtype, f"{row.best / 1e6:.3g} M", row.mujoco or "-"]
    cells += [times(row.over_c), row.mjx or "-", times(row.over_mjx), *wanted, verdict(row)]
    slower = row.behind_alone
    cells.append("-" if slower is None else f"{slower:.2g} x slower than C on one core")
    return "| " + " | ".join(map(str, cells)) + " |"


def times(factor: float | None) -> str:
    """Formats a ratio."""
    return "-" if factor is None else f"{factor:.3g} x"


def roof(row: Row) -> str:
    """Formats operations and share of the peak as a table row."""
    return (
        f"| {row.scene} | {row.dtype} | {row.work.operations:.0f} | {row.work.state} B"
        f" | {row.best * row.work.operations / 1e9:.2f} G/s | {100 * row.share:.1f} % |"
    )
