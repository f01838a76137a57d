"""What a comparison of methods found: runs, the Pareto front, and which method to take."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from jaxcon.analysis.diagram import draw
from jaxcon.analysis.listing import LEGEND, table
from jaxcon.core.checks import check
from jaxcon.simulation.method import Method

METERS, COORDINATES = "m", "of q"
"""Units of the error: of bodies, and of generalized coordinates."""
OK = "ok"
"""The outcome of a run that neither failed nor left its bounds."""


@dataclass(frozen=True)
class Run:
    """One method at one step in one precision.

    Attributes:
        name: of the method.
        dtype: "float32" or "float64".
        dt: h [s].
        outcome: "ok", or what went wrong and when: the run diverged.
        error: the largest distance from the reference at the ends of the parts [m], never below
            the reference's own error; of a body √(d² + k²θ²), d between centres of mass, θ between
            orientations and k the largest radius of gyration; on generalized coordinates the norm
            of the difference of q. Infinite where the run diverged.
        told: whether the error is more than that of the reference.
        angle: the largest θ [rad].
        violation: the worst |φ| of all steps [m, rad]; rows without a φ have none.
        energy: the largest difference from the reference's [J].
        cost: time on this device for a simulated second of one world in the batch [s/s]; NaN where
            the run diverged, or there was no time to measure it.
        alone: the same of a world that is alone on the device [s/s].
        gradient: the same as `cost` of value and gradient of a rollout; NaN where not measured.
        memory: of a world in the batch [B].
        note: a status that does not end a run, such as CONFLICT.
        unit: of `error`: "m" for bodies, "of q" for generalized coordinates.
        method: the method itself.
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
        """Returns True where it did not diverge."""
        return self.outcome == OK

    def plain(self) -> dict[str, Any]:
        """As JSON holds it, without the method; numbers that are not finite are None."""
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
class Limit:
    """How long steps of a method may be.

    Attributes:
        name: of the method.
        dtype: "float32" or "float64".
        stable: the longest step up to which all that were tried were stable [s]; None without.
        unstable: the shortest one above it that was not [s]; None where none was.
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
    """What was not run, and why.

    Attributes:
        name: of the method.
        dtype: its precision; empty for all.
        reason: in words.
    """

    name: str
    dtype: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}{', ' if self.dtype else ''}{self.dtype}: {self.reason}"


@dataclass(frozen=True)
class Tradeoff:
    """Error and cost of methods on one scene; `print` it.

    Attributes:
        runs: all that were made, also those that diverged.
        limits: of each method and precision in the length of a step.
        left_out: what was not run, and why.
        horizon: how long each run was [s].
        until: up to which errors are counted, as far as the reference is good [s].
        floor: its own error there, below which no error can be told [m].
        about: of the reference and the device, in words.
        batch: how many worlds shared the device where `cost` was measured.
        seconds: that all of it took.
    """

    runs: tuple[Run, ...]
    limits: tuple[Limit, ...]
    left_out: tuple[LeftOut, ...]
    horizon: float
    until: float
    floor: float
    about: tuple[str, ...]
    batch: int
    seconds: float

    @property
    def front(self) -> tuple[Run, ...]:
        """The runs that no other one beats in both error and cost, the cheapest first."""
        return front_of(self.runs)

    def recommend(self, *, error: float | None = None, cost: float | None = None) -> Run:
        """The cheapest run of at most this error, or the most accurate one of at most this cost.

        Errors are those up to `until`; a chaotic motion that goes on is another beyond it.

        Args:
            error: as of a `Run` [m].
            cost: as of a `Run`, time for a simulated second of one world in the batch [s/s].

        Returns:
            The run; its `method`, `dt` and `dtype` are ready to use.

        Raises:
            ValueError: none meets it; the message says what the best one reaches. Or not a positive
                number.
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
            able = [run for run in front if run.error <= error]
            best, unit, what = front[-1].error, front[-1].unit, f"an error of at most {error:.2g}"
        else:
            able = [run for run in front if run.cost <= (cost or 0.0)][-1:]
            best, unit, what = front[0].cost, "s/s", f"a cost of at most {cost:.2g}"
        if not able:
            raise ValueError(
                f"recommend: no run has {what} {unit}; the least is {best:.2g} {unit}. Other steps"
                " are tried by dts=, other methods by methods=, and more with a larger budget."
            )
        return able[0]

    def plot(self, onto: Any = None) -> Any:
        """The work–precision diagram: error by cost, a line for each method and precision.

        Args:
            onto: matplotlib axes, or the path of a picture; new axes unless given.

        Returns:
            The axes.
        """
        return draw(self, onto)

    @property
    def grouped(self) -> dict[tuple[str, str], list[Run]]:
        """Runs by name and precision, the longest step first."""
        found: dict[tuple[str, str], list[Run]] = {}
        for run in self.runs:
            found.setdefault((run.name, run.dtype), []).append(run)
        return {key: sorted(runs, key=lambda run: -run.dt) for key, runs in found.items()}

    @property
    def table(self) -> str:
        """Every run, by method."""
        return "\n".join(table([run for runs in self.grouped.values() for run in runs]))

    def to_json(self, path: str | Path | None = None) -> str:
        """Everything but the methods themselves as JSON, also written to a path where one is given.

        Numbers that are not finite are null.

        Args:
            path: of a file; none unless given.
        """
        found = {
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
        text = json.dumps(found, indent=1)
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
        """By reason what was left out, each method with its precisions."""
        found: dict[str, dict[str, list[str]]] = {}
        for x in self.left_out:
            found.setdefault(x.reason, {}).setdefault(x.name, []).append(x.dtype)
        return {
            reason: [", ".join(filter(None, [name, *dtypes])) for name, dtypes in own.items()]
            for reason, own in found.items()
        }

    @property
    def without(self) -> str:
        """Why there is no front."""
        if self.runs:
            return "no run was both stable and timed; `result.table` says why"
        spent = f"no method was run in {self.seconds:.0f} s"
        return f"{spent}; `result.left_out` says why, and a larger budget= may help"


def front_of(runs: Iterable[Run]) -> tuple[Run, ...]:
    """Returns the runs that no other one beats in both error and cost, the cheapest first."""
    found: list[Run] = []
    able = [run for run in runs if run.ok and math.isfinite(run.cost)]
    for run in sorted(able, key=lambda run: (run.cost, run.error)):
        if not found or run.error < found[-1].error:
            found.append(run)
    return tuple(found)
