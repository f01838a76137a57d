"""Runs a method in one precision with several step sizes: errors, stability limit and costs."""

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
from jaxcon.analysis.front import COORDINATES, METERS, OK, LeftOut, Run, StabilityLimit
from jaxcon.analysis.reference import Reference, Ruler
from jaxcon.analysis.trials import Course, Observer, Problem, Trip
from jaxcon.core.status import Status
from jaxcon.methods.method import Method

COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
"""The default numbers of steps per part of the horizon."""
MOST = 20_000
"""The largest number of steps over the horizon with default step sizes.

One step per part of the horizon is always allowed.
"""
OPEN = 0.05
"""The max |φ|, relative to the size of the motion, above which a run counts as diverged."""
GAINED = 1.0
"""The energy error, relative to `Reference.scale`, above which a run counts as diverged."""
BISECTIONS = 4
"""The number of bisections between a stable and an unstable step size, on a logarithmic scale."""
SHARE = 1 / 60
"""The share of the budget that a single run with a default step size may take."""
ASKED = 1 / 4
"""The share of the budget that all runs of a method may take, even at the user's step sizes."""
FEW = 10
"""The number of steps per part in a short run that predicts the time of the first full run."""
NO_GAIN = 0.8
"""The share of the least error so far below which a run's error counts as an improvement."""
REFUSED = (ValueError, TypeError, NotImplementedError, jax.errors.JaxRuntimeError)
"""The exceptions raised by a method that does not fit a scene."""


@dataclass(frozen=True)
class Unit:
    """The results of one method in one precision.

    Attributes:
        runs: one run for each step size.
        limit: the largest stable step size.
        left_out: skipped measurements, with reasons.
        differentiated: True if timing of gradients was attempted.
        compiling: time to trace and compile the programs [s].
    """

    runs: tuple[Run, ...] = ()
    limit: StabilityLimit | None = None
    left_out: tuple[LeftOut, ...] = ()
    differentiated: bool = False
    compiling: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """Measures methods on one problem, with data that all methods share.

    Attributes:
        problem: the problem; its initial state satisfies the constraints.
        reference: reference solution of the problem.
        observe: evaluates energies and violations.
        batch: batch for the cost measurements.
        dts: the user's step sizes [s]; None for default step sizes.
        budget: time budget of the whole comparison [s].
        left: function that returns the remaining budget [s].
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
        """Measures distances between configurations of this problem."""
        return Ruler.of(self.observe, self.problem)

    @property
    def counts(self) -> list[int]:
        """The numbers of steps per part of the horizon, in ascending order.

        The user's step sizes are reduced until they divide a part.
        """
        parts = self.problem.parts
        if self.dts is None:
            return [n for n in COUNTS if n == 1 or n * parts <= MOST]
        part = self.problem.horizon / parts
        return sorted({max(1, math.ceil(part / dt - 1e-9)) for dt in self.dts})

    def measure(self, name: str, method: Method, dtype: str) -> Unit:
        """Runs a method at all step sizes. A method that does not fit the scene is skipped.

        Args:
            name: name of the method.
            method: the method.
            dtype: "float32" or "float64".

        Returns:
            The results; for a skipped method, only the reason.
        """
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
        except jax.errors.JaxRuntimeError as error:  # for example, out of memory
            return Unit(left_out=(LeftOut(name, dtype, first_line(error)),))

    def _measured(self, course: Course, pace: Pace, name: str, method: Method) -> Unit:
        """Measures the errors of a method, then its stability limit, then its costs.

        Args:
            course: the program for the errors.
            pace: the program for the costs.
            name: name of the method.
            method: the method.
        """
        course.go(self.problem.dt(1), 1)  # the first run of a program takes longer than later ones
        runs, why = self._refined(course, name, method)
        limit = self._limit(course, name, runs) if runs else None
        timed, late = self._timed(pace, runs)
        dtype = course.dtype.name
        left_out = [LeftOut(name, dtype, reason) for reason in (why, late) if reason]
        return Unit(timed, limit, tuple(left_out))

    def _timed(self, pace: Pace, runs: list[Run]) -> tuple[tuple[Run, ...], str]:
        """Adds costs to the stable runs as long as the budget lasts.

        The run with the smallest step size comes first and is always timed. The others follow,
        alternating between the largest and the smallest remaining step size.

        Returns:
            All runs; and the reason why some have no costs, or an empty text.
        """
        stable = [i for i, run in enumerate(runs) if run.ok]
        order = [stable.pop(0 if k % 2 else -1) for k in range(len(stable))]
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
        """Adds the costs of gradients to the runs of a method.

        Args:
            unit: results of the method, with at least one stable run.
        """
        first = next(run for run in unit.runs if run.ok)
        assert first.method is not None
        try:
            slope = Slope(self.batch, first.method, first.dtype)
            slope.compile()
        except REFUSED as error:
            why = LeftOut(first.name, first.dtype, f"its gradient: {first_line(error)}")
            left_out = (*unit.left_out, why)
            return dataclasses.replace(unit, left_out=left_out, differentiated=True)
        runs = tuple(
            dataclasses.replace(run, gradient=slope.seconds(run.dt) / run.dt)
            if run is first or run.ok and self.left() > 0
            else run
            for run in unit.runs
        )
        return dataclasses.replace(unit, runs=runs, differentiated=True)

    def _refined(self, course: Course, name: str, method: Method) -> tuple[list[Run], str]:
        """Runs the method with smaller and smaller steps.

        Stops before a run that would take too much of the budget. With default step sizes, also
        stops if errors no longer fall, or are below the error of the reference.

        Returns:
            The runs; and the reason why there are no smaller steps, or an empty text.
        """
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
                    return (
                        runs,
                        f"steps from {dt:.3g} s on: errors are below the reference error",
                    )
                if stalled > 1:
                    return runs, f"steps from {dt:.3g} s on: the error no longer falls"
            trip = course.go(dt, count)
            runs.append(self._run(trip, name, method, course.dtype.name))
            stalled = stalled + 1 if runs[-1].error > NO_GAIN * least and runs[-1].ok else 0
            least = min(least, runs[-1].error)
        return runs, ""

    def _seconds(self, course: Course, trip: Trip | None, dt: float, count: int) -> float:
        """Predicts the duration of the next run [s].

        The prediction scales the duration of the previous run by the number of steps. Before the
        first run, a short run is timed instead if the user gave step sizes; with default step
        sizes, the prediction is 0.

        Args:
            course: the simulation program.
            trip: the previous run; None before the first run.
            dt: step size of the next run [s].
            count: number of steps per part of the next run.
        """
        if trip is not None:
            return trip.seconds * trip.dt / dt
        few = 0 if self.dts is None else min(count, FEW)
        return course.go(dt, few).seconds * count / few if few else 0.0

    def _run(self, trip: Trip, name: str, method: Method, dtype: str) -> Run:
        """Converts a simulation to a `Run`, with its outcome and errors."""
        outcome, energy = self._outcome(trip)
        error, angle, told = math.inf, math.inf, True
        if outcome == OK:
            last = self.reference.last
            distance, turn = self.ruler(trip.points.q, self.reference.points.q[1:])
            error, angle = float(np.max(distance[:last])), float(np.max(turn[:last]))
            told = error > self.reference.floor
            error = max(error, self.reference.floor)
        alone = trip.seconds / self.problem.horizon
        note = trip.status.name if trip.status and outcome == OK else ""
        measured = (error, told, angle, trip.violation, energy, alone)
        unit = METERS if self.ruler.layout is not None else COORDINATES
        return Run(name, dtype, trip.dt, outcome, *measured, note=note, unit=unit, method=method)

    def _outcome(self, trip: Trip) -> tuple[str, float]:
        """Returns the outcome of a simulation as text, and its energy error [J]."""
        points, reference = trip.points, self.reference
        if trip.failed:
            code = trip.status.name if trip.status else Status.NON_FINITE.name
            return f"{code} at {points.time[-1]:.3g} s", math.inf
        seen = self.observe(points)
        exact = np.interp(points.time, reference.points.time, reference.seen.energy)
        energy = float(np.max(np.abs(seen.energy - exact)))
        worst = max(trip.violation, float(np.max(seen.violation)))
        if not worst <= OPEN * reference.size:
            return f"violation {worst:.2g}", energy
        if reference.scale > 0 and not energy <= GAINED * reference.scale:
            return f"energy off by {energy:.2g} J", energy
        return OK, energy

    def _limit(self, course: Course, name: str, runs: list[Run]) -> StabilityLimit:
        """Finds the largest stable step size by bisection between stable and unstable runs."""
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
        return StabilityLimit(name, course.dtype.name, good, bad)


def compiled_side_by_side(*makers: Callable[[], Any]) -> list[Any]:
    """Traces programs one after another, and compiles each in a thread during the next trace.

    Args:
        makers: functions that trace a program; called in order.

    Returns:
        The compiled programs.
    """
    with ThreadPoolExecutor(len(makers)) as pool:
        programs, compilations = [], []
        for make in makers:
            programs.append(make())
            compilations.append(pool.submit(programs[-1].compile))
        for compilation in compilations:
            compilation.result()
    return programs


def first_line(error: BaseException) -> str:
    """Formats an exception as "refused: " and the first line of its message.

    If the message is empty, the name of the exception's type takes its place.
    """
    text = str(error).strip().splitlines()
    return f"refused: {text[0]}" if text else f"refused: {type(error).__name__}"
