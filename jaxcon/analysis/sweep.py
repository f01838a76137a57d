"""One method in one precision over all steps: errors, the limit of stability, and costs."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np

from jaxcon.analysis.costs import Batch, Pace, Slope
from jaxcon.analysis.front import COORDINATES, METERS, OK, LeftOut, Limit, Run
from jaxcon.analysis.reference import Reference, Ruler
from jaxcon.analysis.trials import Course, Observer, Problem, Trip
from jaxcon.core.status import Status
from jaxcon.simulation.method import Method

COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
"""Steps in a part of the horizon, as far as the horizon then has no more than `MOST`."""
MOST = 20_000
OPEN = 0.05
"""max |φ| from which a run counts as diverged, of the size of the motion."""
GAINED = 1.0
"""Difference in energy from which it does, of what moves or is exchanged."""
BISECTIONS = 4
"""The halvings of the gap between a stable and an unstable step, on a logarithmic scale."""
SHARE = 1 / 60
"""The share of the budget that one run may take."""
ASKED = 1 / 4
"""The share of the budget that all runs of a method may take, also at steps that were asked for."""
FEW = 10
"""Steps in a part by which the time of a first run is foretold."""
NO_GAIN = 0.8
"""The share of the least error so far above which a run gains nothing by its shorter step."""
REFUSED = (ValueError, TypeError, NotImplementedError, jax.errors.JaxRuntimeError)
"""What a method that does not fit a scene raises."""


@dataclass(frozen=True)
class Unit:
    """The results of one method in one precision.

    Attributes:
        runs: at all steps.
        limit: of stability.
        left_out: what was not run, and why.
        differentiated: whether gradients were tried.
        compiling: the time until its programs were compiled [s].
    """

    runs: tuple[Run, ...] = ()
    limit: Limit | None = None
    left_out: tuple[LeftOut, ...] = ()
    differentiated: bool = False
    compiling: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """What all methods share.

    Attributes:
        problem: with its start on the constraints.
        reference: of it.
        observe: reads energies.
        batch: in which costs are measured.
        dts: steps that were asked for [s]; None for those of the default.
        budget: for all of it [s].
        left: returns what is left of it [s].
    """

    problem: Problem
    reference: Reference
    observe: Observer
    batch: Batch
    dts: tuple[float, ...] | None
    budget: float
    left: Callable[[], float] = lambda: math.inf

    @cached_property
    def ruler(self) -> Ruler:
        """The ruler of configurations."""
        return Ruler.of(self.observe, self.problem)

    @property
    def counts(self) -> list[int]:
        """Steps in a part, ascending; a step asked for that divides no part is shortened."""
        parts = self.problem.parts
        if self.dts is None:
            return [n for n in COUNTS if n == 1 or n * parts <= MOST]
        part = self.problem.horizon / parts
        return sorted({max(1, math.ceil(part / dt - 1e-9)) for dt in self.dts})

    def measure(self, name: str, method: Method, dtype: str) -> Unit:
        """Runs a method at all steps; one that does not fit the scene says why."""
        begin = time.perf_counter()
        try:
            course, pace = compiled_side_by_side(
                lambda: Course(self.problem, method, dtype), lambda: Pace(self.batch, method, dtype)
            )
        except REFUSED as error:
            return Unit(left_out=(LeftOut(name, dtype, first_line(error)),))
        spent = time.perf_counter() - begin
        try:
            unit = self._measured(course, pace, name, method)
            return dataclasses.replace(unit, compiling=spent)
        except jax.errors.JaxRuntimeError as error:  # as where memory runs out
            return Unit(left_out=(LeftOut(name, dtype, first_line(error)),))

    def _measured(self, course: Course, pace: Pace, name: str, method: Method) -> Unit:
        """Errors first, then costs."""
        course.go(self.problem.dt(1), 1)  # the first run of a program takes longer than later ones
        runs, why = self._refined(course, name, method)
        limit = self._limit(course, name, runs) if runs else None
        timed, late = self._timed(pace, runs)
        dtype = course.dtype.name
        left = [LeftOut(name, dtype, reason) for reason in (why, late) if reason]
        return Unit(timed, limit, tuple(left))

    def _timed(self, pace: Pace, runs: list[Run]) -> tuple[tuple[Run, ...], str]:
        """Returns the runs with costs while time is left, and why some have none.

        The first is timed in any case, and then the others from both ends of the steps in turn.
        """
        able = [i for i, run in enumerate(runs) if run.ok]
        order = [able.pop(0 if k % 2 else -1) for k in range(len(able))]
        timed, late = list(runs), ""
        for k, i in enumerate(order):
            if k and self.left() <= 0:
                late = f"costs of {len(order) - k} of its runs: no time was left of the budget"
                break
            run = runs[i]
            cost = pace.seconds(run.dt) / run.dt
            timed[i] = dataclasses.replace(run, cost=cost, memory=pace.memory)
        return tuple(timed), late

    def gradients(self, unit: Unit) -> Unit:
        """Returns the unit with the costs of gradients."""
        able = [run for run in unit.runs if run.ok]
        one = able[0]
        assert one.method is not None
        try:
            slope = Slope(self.batch, one.method, one.dtype)
            slope.compile()
        except REFUSED as error:
            why = LeftOut(one.name, one.dtype, f"its gradient: {first_line(error)}")
            left = (*unit.left_out, why)
            return dataclasses.replace(unit, left_out=left, differentiated=True)
        runs = tuple(
            dataclasses.replace(run, gradient=slope.seconds(run.dt) / run.dt)
            if run is one or run.ok and self.left() > 0
            else run
            for run in unit.runs
        )
        return dataclasses.replace(unit, runs=runs, differentiated=True)

    def _refined(self, course: Course, name: str, method: Method) -> tuple[list[Run], str]:
        """Runs with shorter and shorter steps, and why there are no shorter ones."""
        runs: list[Run] = []
        stalled, least, trip, spent = 0, math.inf, None, 0.0
        for count in self.counts:
            dt = self.problem.dt(count)
            longer = self._seconds(course, trip, dt, count)
            spent += longer
            late = bool(runs) and longer > self.left() / 2  # the other half is for costs
            late = late or longer > self.budget * SHARE and self.dts is None
            if late or spent > self.budget * ASKED:
                return runs, f"steps from {dt:.3g} s on: each run would take {longer:.2g} s"
            if runs and self.dts is None:
                if runs[-1].ok and not runs[-1].told:
                    return runs, f"steps from {dt:.3g} s on: the reference tells them no more apart"
                if stalled > 1:
                    return runs, f"steps from {dt:.3g} s on: the error falls no more"
            trip = course.go(dt, count)
            runs.append(self._run(trip, name, method, course.dtype.name))
            stalled = stalled + 1 if runs[-1].error > NO_GAIN * least and runs[-1].ok else 0
            least = min(least, runs[-1].error)
        return runs, ""

    def _seconds(self, course: Course, trip: Trip | None, dt: float, count: int) -> float:
        """How long a run will take, by the one before it or, at steps asked for, by a short one."""
        if trip is not None:
            return trip.seconds * trip.dt / dt
        few = 0 if self.dts is None else min(count, FEW)
        return course.go(dt, few).seconds * count / few if few else 0.0

    def _run(self, trip: Trip, name: str, method: Method, dtype: str) -> Run:
        """What a trip amounts to."""
        outcome, energy = self._outcome(trip)
        error, angle, told = math.inf, math.inf, True
        if outcome == OK:
            last = self.reference.last
            far, turned = self.ruler(trip.points.q, self.reference.points.q[1:])
            error, angle = float(np.max(far[:last])), float(np.max(turned[:last]))
            told = error > self.reference.floor
            error = max(error, self.reference.floor)
        alone = trip.seconds / self.problem.horizon
        note = trip.status.name if trip.status and outcome == OK else ""
        known = (name, dtype, trip.dt, outcome, error, told, angle, trip.violation, energy, alone)
        unit = METERS if self.ruler.layout is not None else COORDINATES
        return Run(*known, note=note, unit=unit, method=method)

    def _outcome(self, trip: Trip) -> tuple[str, float]:
        """Returns in words how a trip ended, and how far its energy is off [J]."""
        points, reference = trip.points, self.reference
        if trip.failed:
            code = trip.status.name if trip.status else Status.NON_FINITE.name
            return f"{code} at {points.time[-1]:.3g} s", math.inf
        seen = self.observe(points)
        exact = np.interp(points.time, reference.points.time, reference.seen.energy)
        energy = float(np.max(np.abs(seen.energy - exact)))
        off = max(trip.violation, float(np.max(seen.violation)))
        if not off <= OPEN * reference.size:
            return f"violation {off:.2g}", energy
        if reference.scale > 0 and not energy <= GAINED * reference.scale:
            return f"energy off by {energy:.2g} J", energy
        return OK, energy

    def _limit(self, course: Course, name: str, runs: list[Run]) -> Limit:
        """The longest step up to which all are stable, by bisection beside those that were run."""
        tried = {run.dt: run.ok for run in runs}
        bad = min((dt for dt, ok in tried.items() if not ok), default=None)
        good = max((dt for dt in tried if bad is None or dt < bad), default=None)
        if bad is not None and good is not None:
            part = self.problem.horizon / self.problem.parts
            for _ in range(BISECTIONS):
                if self.left() <= 0:
                    break
                middle = math.sqrt(good * bad)
                trip = course.go(middle, max(1, round(part / middle)))
                stable = self._outcome(trip)[0] == OK
                good, bad = (middle, bad) if stable else (good, middle)
        return Limit(name, course.dtype.name, good, bad)


def compiled_side_by_side(*makers: Callable[[], Any]) -> list[Any]:
    """Programs, each compiled on a core of its own while the next one is traced."""
    with ThreadPoolExecutor(len(makers)) as pool:
        programs, begun = [], []
        for make in makers:
            programs.append(make())
            begun.append(pool.submit(programs[-1].compile))
        for one in begun:
            one.result()
    return programs


def first_line(error: BaseException) -> str:
    """What an error says, without what follows its first line."""
    text = str(error).strip().splitlines()
    return f"refused: {text[0]}" if text else f"refused: {type(error).__name__}"
