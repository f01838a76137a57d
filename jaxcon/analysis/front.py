"""The result of `tradeoff`: all runs, the Pareto front, and the recommended method."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxcon.analysis.diagram import draw
from jaxcon.analysis.listing import LEGEND, table
from jaxcon.core.checks import check
from jaxcon.methods.method import Method

if TYPE_CHECKING:
    from matplotlib.axes import Axes

METERS, COORDINATES = "m", "of q"
"""Units of the error, for systems of bodies and for generalized coordinates."""
OK = "ok"
"""The outcome of a run that neither failed nor diverged."""


@dataclass(frozen=True)
class Run:
    """The result of one method with one step size in one precision.

    Attributes:
        name: name of the method.
        dtype: "float32" or "float64".
        dt: step size h [s].
        outcome: "ok"; for a diverged run the failure status and its time, or the violation or
            energy error that is too large.
        error: the largest distance from the reference solution [m], at the ends of the parts of the
            horizon. It is at least the reference's own error, and infinite for a diverged run. A
            body's distance is √(d² + k²θ²). Here d is the distance of centers of mass, θ the angle
            between orientations, and k the largest radius of gyration. For generalized coordinates
            the distance is ‖q − q_ref‖.
        told: True if the error is resolved, that is, exceeds the reference's own error.
        angle: the largest angle θ between orientations [rad].
        violation: the largest |φ| over all steps [m, rad]. Velocity constraints have no φ.
        energy: the largest energy difference from the reference [J].
        cost: computing time per simulated second of one world in a batch on this device [s/s]. NaN
            for a diverged run, or if there was no time to measure it.
        alone: computing time per simulated second of a single world, without a batch [s/s].
        gradient: computing time for value and gradient of a rollout, per simulated second of one
            world in a batch [s/s]. NaN if not measured.
        memory: memory per world of the batch [B].
        note: name of a status that does not stop a run, such as CONFLICT; or empty.
        unit: unit of `error`: "m" for bodies, "of q" for generalized coordinates.
        method: the `jc.Method`.
    """

    name: str
    dtype: str
    dt: float
    outcome: str
    error: float
    told: bool
    angle: float
    violation: float
    energy: float
    alone: float
    cost: float = math.nan
    memory: float = math.nan
    gradient: float = math.nan
    note: str = ""
    unit: str = METERS
    method: Method | None = field(default=None, repr=False, compare=False)

    @property
    def ok(self) -> bool:
        """True if the run did not diverge."""
        return self.outcome == OK

    def plain(self) -> dict[str, Any]:
        """Returns all fields except `method` by name, for JSON. Non-finite numbers become None."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "method"}
        bad = (k for k, x in values.items() if isinstance(x, float) and not math.isfinite(x))
        return values | dict.fromkeys(bad)

    def __str__(self) -> str:
        head = f"{self.name}, {self.dtype}, h = {self.dt:.3g} s"
        if not self.ok:
            return f"{head}: diverged, {self.outcome}"
        costs = f"; {self.cost:.3g} s of computing per simulated second of one world"
        costs = "" if math.isnan(self.cost) else costs
        below = "" if self.told else "<"
        note = f"; {self.note}" if self.note else ""
        return (
            f"{head}: error {below}{self.error:.2g} {self.unit}, violation {self.violation:.2g} m"
            f" or rad, energy off by {self.energy:.2g} J{costs}{note}"
        )


@dataclass(frozen=True)
class StabilityLimit:
    """The largest stable step size of a method.

    Attributes:
        name: name of the method.
        dtype: "float32" or "float64".
        stable: the largest step size [s] up to which the method was stable at all tested step
            sizes; None if there is none.
        unstable: the smallest unstable step size above `stable` [s]; None if all were stable.
    """

    name: str
    dtype: str
    stable: float | None
    unstable: float | None

    def __str__(self) -> str:
        if self.stable is None:
            return f"no step that was tried is stable, down to {self.unstable:.3g} s"
        if self.unstable is None:
            return f"stable up to {self.stable:.3g} s, the longest step that was tried"
        return f"stable up to {self.stable:.3g} s, unstable at {self.unstable:.3g} s"


@dataclass(frozen=True)
class LeftOut:
    """A method or measurement that was not run, with the reason.

    Attributes:
        name: name of the method.
        dtype: "float32" or "float64"; empty for both.
        reason: the reason, as text.
    """

    name: str
    dtype: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}{', ' if self.dtype else ''}{self.dtype}: {self.reason}"


@dataclass(frozen=True)
class Tradeoff:
    """Errors and costs of methods on one scene; `print` it.

    Attributes:
        runs: all runs, including diverged ones.
        limits: the largest stable step size of each method in each precision.
        left_out: methods and measurements that were skipped, with reasons.
        horizon: simulated time of each run [s].
        until: the time up to which the reference is accurate and errors are measured [s].
        floor: error of the reference at time `until` [m]; smaller errors cannot be resolved.
        about: description of the reference and the device, as lines of text.
        batch: number of worlds in the batch for the cost measurements.
        seconds: total time of the comparison [s].
    """

    runs: tuple[Run, ...]
    limits: tuple[StabilityLimit, ...]
    left_out: tuple[LeftOut, ...]
    horizon: float
    until: float
    floor: float
    about: tuple[str, ...]
    batch: int
    seconds: float

    @property
    def front(self) -> tuple[Run, ...]:
        """The Pareto front: runs that no other run beats in both error and cost, cheapest first."""
        return front_of(self.runs)

    def recommend(self, *, error: float | None = None, cost: float | None = None) -> Run:
        """Returns the cheapest run within an error limit, or the most accurate within a cost limit.

        Errors are measured up to the time `until`. Later, the reference is not accurate enough to
        measure errors, for example because the motion is chaotic.

        Args:
            error: largest allowed `error` [m].
            cost: largest allowed `cost` [s/s], the computing time per simulated second of one
                world.

        Returns:
            The run. Simulate with its `method`, `dt` and `dtype`.

        Raises:
            ValueError: no run meets the limit (the message gives the best value), the limit is
                below the error of the reference or not positive, or not exactly one limit is given.
        """
        check("recommend", "error= [m]", error, (), above=0, finite=False, optional=True)
        check("recommend", "cost= [s/s]", cost, (), above=0, finite=False, optional=True)
        if (error is None) == (cost is None):
            raise ValueError("recommend: give either error= [m] or cost= [s/s].")
        front = self.front
        if not front:
            raise ValueError(f"recommend: {self.without}.")
        if error is not None and error < self.floor:
            raise ValueError(
                f"recommend: an error of {error:.2g} {front[0].unit} cannot be told, as the"
                f" reference itself may be off by {self.floor:.2g} {front[0].unit} after"
                f" {self.until:.3g} s; ask for more, or take a shorter horizon or a larger budget."
            )
        if error is not None:
            good = [run for run in front if run.error <= error]
            best, unit, goal = front[-1].error, front[-1].unit, f"an error of at most {error:.2g}"
        else:
            good = [run for run in front if run.cost <= (cost or 0.0)][-1:]
            best, unit, goal = front[0].cost, "s/s", f"a cost of at most {cost:.2g}"
        if not good:
            raise ValueError(
                f"recommend: no run has {goal} {unit}; the least is {best:.2g} {unit}. Other steps"
                " are tried by dts=, other methods by methods=, and more with a larger budget."
            )
        return good[0]

    def plot(self, onto: Axes | str | Path | None = None) -> Axes:
        """Plots the work–precision diagram: error over cost, with a line per method and precision.

        Args:
            onto: matplotlib axes, or the path of an image file; new axes by default.

        Returns:
            The matplotlib axes.
        """
        return draw(self, onto)

    @property
    def grouped(self) -> dict[tuple[str, str], list[Run]]:
        """Runs by (name, precision), the largest step size first."""
        groups: dict[tuple[str, str], list[Run]] = {}
        for run in self.runs:
            groups.setdefault((run.name, run.dtype), []).append(run)
        return {key: sorted(runs, key=lambda run: -run.dt) for key, runs in groups.items()}

    @property
    def table(self) -> str:
        """A text table of all runs, grouped by method."""
        return "\n".join(table([run for runs in self.grouped.values() for run in runs]))

    def to_json(self, path: str | Path | None = None) -> str:
        """Returns all results as JSON, without the method objects; with `path`, also writes a file.

        Numbers that are not finite become null.

        Args:
            path: path of the file; None writes no file.
        """
        contents = {
            "about": self.about,
            "horizon": self.horizon,
            "until": self.until,
            "floor": self.floor,
            "batch": self.batch,
            "seconds": self.seconds,
            "runs": [run.plain() for run in self.runs],
            "front": [run.plain() for run in self.front],
            "limits": [vars(x) for x in self.limits],
            "left_out": [vars(x) for x in self.left_out],
        }
        text = json.dumps(contents, indent=1)
        if path is not None:
            Path(path).write_text(text + "\n")
        return text

    def __str__(self) -> str:
        lines = [*self.about, "", "the front, each with the least error up to its cost:"]
        lines += [*table(self.front), "", *LEGEND] if self.front else [f"    empty: {self.without}"]
        lines += ["", "all methods (`result.table` has every run):"]
        limits = {(x.name, x.dtype): x for x in self.limits}
        for key, runs in self.grouped.items():
            least = min((run.error for run in runs if run.ok), default=math.inf)
            bad = [f"{run.dt:.3g} s ({run.outcome})" for run in runs if not run.ok]
            lines.append(f"{key[0]}, {key[1]}: {len(runs)} runs, least error {least:.2e}")
            if key in limits:
                lines.append(f"    {limits[key]}")
            if bad:
                lines.append(f"    diverged at {', '.join(bad)}")
        if self.left_out:
            lines += ["", "left out:"]
        for reason, names in self.excuses.items():
            lines += [f"  {reason}:", *(f"    {name}" for name in names)]
        return "\n".join(lines)

    @property
    def excuses(self) -> dict[str, list[str]]:
        """The skipped methods, grouped by reason; each text is a method's name and precisions."""
        by_reason: dict[str, dict[str, list[str]]] = {}
        for x in self.left_out:
            by_reason.setdefault(x.reason, {}).setdefault(x.name, []).append(x.dtype)
        return {
            reason: [", ".join(filter(None, [name, *dtypes])) for name, dtypes in methods.items()]
            for reason, methods in by_reason.items()
        }

    @property
    def without(self) -> str:
        """The reason why the Pareto front is empty."""
        if self.runs:
            return "no run was both stable and timed; `result.table` says why"
        spent = f"no method was run in {self.seconds:.0f} s"
        return f"{spent}; `result.left_out` says why, and a larger budget= may help"


def front_of(runs: Iterable[Run]) -> tuple[Run, ...]:
    """Returns the Pareto front: runs that no other beats in both error and cost, cheapest first."""
    front: list[Run] = []
    timed = [run for run in runs if run.ok and math.isfinite(run.cost)]
    for run in sorted(timed, key=lambda run: (run.cost, run.error)):
        if not front or run.error < front[-1].error:
            front.append(run)
    return tuple(front)
