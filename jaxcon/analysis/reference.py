"""The reference solution: a high-order run with small steps in float64, and its error estimate."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxcon.analysis.trials import Course, Observation, Observer, Points, Problem, Trip
from jaxcon.builders.assembly import assemble
from jaxcon.core.precision import cast, precision
from jaxcon.core.status import MEANING, SimulationError, Status
from jaxcon.core.typing import Array
from jaxcon.methods.events import Events
from jaxcon.methods.integrators import RK4, RungeKutta
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.system.bodies import Particle

FIRST = 64
"""The approximate number of steps of the reference's first and coarsest run."""
MOST = 1 << 20
"""The largest number of steps of the reference's finest run."""
GOAL = 1e-13
"""The difference of two runs, relative to the size of the motion, at which refinement stops."""
GOOD = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""The thresholds on the reference's error, relative to the size of the motion.

The smallest threshold that the error does not exceed in the first half of the horizon is used; if
there is none, the largest threshold. The reference is accurate until its error exceeds the
threshold.
"""
REST = 1e-4
"""The energy error, as a share of the total energy, at which a scene at rest counts as diverged."""
ON = 1e-10
"""The largest |φ| and |φ̇| of an initial state that counts as consistent.

They are relative to 1 + max |q| and 1 + max |v|.
"""


def butcher() -> RungeKutta:
    """Returns an explicit Runge–Kutta method of order six with seven stages.

    References:
        Butcher, On Runge-Kutta processes of high order, J. Australian Math. Soc. 4 (1964).
    """
    a = (
        (1 / 3,),
        (0.0, 2 / 3),
        (1 / 12, 1 / 3, -1 / 12),
        (-1 / 16, 9 / 8, -3 / 16, -3 / 8),
        (0.0, 9 / 8, -3 / 8, -3 / 4, 1 / 2),
        (9 / 44, -9 / 11, 63 / 44, 18 / 11, 0.0, -16 / 11),
    )
    return RungeKutta(a, (11 / 120, 0.0, 27 / 40, 27 / 40, -4 / 15, -4 / 15, 11 / 120))


class Ruler:
    """Measures the distance of two configurations [m]; ‖q₁ − q₂‖ for generalized coordinates.

    A body's distance is √(d² + k²θ²). Here d is the distance between its two centers of mass, θ the
    angle between its two orientations, and k its largest radius of gyration. To first order, a
    body's distance is at least the root mean square displacement of its mass. The distance of two
    configurations is the largest distance of any body.
    """

    def __init__(self, system: System, q: Array) -> None:
        self.layout = system.layout
        if self.layout is not None:
            mass = np.asarray(system.mass(q).diagonal)
            blocks = [(g, _block(mass, g.v, g.kind.n_v, g.names)) for g in self.layout.groups]
            self.gyration = [
                np.sqrt(np.max(block[g.kind.dim :], axis=0, initial=0) / block[0])
                for g, block in blocks
            ]

    @classmethod
    def of(cls, observe: Observer, problem: Problem) -> Ruler:
        """Returns the `Ruler` of a problem, with the radii of gyration of its bodies."""
        with precision(np.float64):
            return cls(observe.system, cast(problem.start.q, np.float64))

    @np.errstate(over="ignore")  # a diverged run is infinitely far away
    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measures distances between configurations x and y, (n, n_q) each.

        Returns:
            The distance (n,) and the largest angle between orientations (n,) [rad].
        """
        if self.layout is None:
            return np.linalg.norm(x - y, axis=-1), np.zeros(len(x))
        distance, turn = np.zeros(len(x)), np.zeros(len(x))
        for group, k in zip(self.layout.groups, self.gyration, strict=True):
            a, b = (_block(z, group.q, group.kind.n_q, group.names) for z in (x, y))
            angle, dim = _angle(a, b, group.kind), group.kind.dim
            d = np.linalg.norm(a[:, :dim] - b[:, :dim], axis=1)
            distance = np.fmax(distance, np.max(np.hypot(d, k * angle), axis=1))
            turn = np.fmax(turn, np.max(angle, axis=1))
        return distance, turn

    def size(self, q: np.ndarray) -> float:
        """Returns the size of a motion (n, n_q) [m], the unit of relative errors.

        It is the largest range of positions along an axis plus the largest radius of gyration. For
        generalized coordinates, it is the largest range of a coordinate.
        """
        if self.layout is None:
            return float(np.max(np.ptp(q, axis=0), initial=0)) or 1.0
        positions = [
            np.moveaxis(_block(q, g.q, g.kind.n_q, g.names)[:, : g.kind.dim], 1, -1)
            for g in self.layout.groups
        ]
        spread = np.ptp(np.concatenate([x.reshape(-1, x.shape[-1]) for x in positions]), axis=0)
        widest = max(float(np.max(k, initial=0)) for k in self.gyration)
        return float(np.max(spread)) + widest or 1.0


def _block(x: np.ndarray, first: int, components: int, names: tuple[str, ...]) -> np.ndarray:
    """Extracts the coordinates of a group of bodies as an array (…, component, body).

    Args:
        x: positions or velocities, (…, n).
        first: index of the group's first entry.
        components: number of components per body.
        names: names of the bodies.
    """
    group = x[..., first : first + components * len(names)]
    return group.reshape(*x.shape[:-1], components, len(names))


def _angle(a: np.ndarray, b: np.ndarray, kind: Particle) -> np.ndarray:
    """Returns the angle between two orientations of each body, (n, body) [rad].

    Args:
        a: coordinates of a group of bodies, (n, component, body).
        b: coordinates of the same group in other configurations.
        kind: the kind of the bodies, which gives the number of position components.
    """
    a, b = a[:, kind.dim :], b[:, kind.dim :]
    if a.shape[1] < 2:
        return np.sum(np.abs(a - b), axis=1)
    apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(apart / 2, 1))


@dataclass(frozen=True)
class Reference:
    """A high-order run with small steps in float64, and its error estimate.

    Attributes:
        points: positions and velocities at the start and at the ends of the parts of the horizon.
        seen: energies and violations at these points.
        error: estimated largest error from the start to the end of each part, (parts,) [m]. It is
            the difference from a run with twice the step size.
        size: size of the motion [m], the unit of relative errors.
        until: the time up to which the reference is accurate and other runs are compared with it
            [s].
        steps: number of steps.
        moved: distance by which the start was moved onto the constraints, (Σ m d²)^½ [kg^½ m].
    """

    points: Points
    seen: Observation
    error: np.ndarray
    size: float
    until: float
    steps: int
    moved: float

    @property
    def last(self) -> int:
        """The number of parts of the horizon in which runs are compared with the reference."""
        horizon = self.points.time[-1] - self.points.time[0]
        return round(float(self.until / horizon) * len(self.error))

    @property
    def floor(self) -> float:
        """The error of the reference at time `until` [m]; smaller errors cannot be resolved."""
        return float(self.error[self.last - 1])

    @property
    def scale(self) -> float:
        """The energy by which energy errors are divided [J].

        It is the largest kinetic energy or the range of the total energy, whichever is larger. For
        scenes at rest it is a small share of the total energy.
        """
        energy = self.seen.energy
        exchanged = max(float(np.max(self.seen.kinetic)), float(np.ptp(energy)))
        return max(exchanged, REST * float(np.max(np.abs(energy))))


def started(problem: Problem, observe: Observer) -> tuple[Problem, float]:
    """Moves the initial state of a problem onto the constraints, unless it satisfies them.

    Returns:
        The problem with the moved initial state, and the distance moved, (Σ m d²)^½ [kg^½ m].

    Raises:
        SimulationError: no nearby configuration satisfies the constraints; the message names the
            violated ones.
    """
    points = problem.start
    seen = observe(Points(*(x[None] for x in points)))
    allowed = [ON * (1 + np.max(np.abs(x), initial=0)) for x in (points.q, points.v)]
    if seen.violation[0] <= allowed[0] and seen.rate[0] <= allowed[1]:
        return problem, 0.0
    with precision(np.float64):
        state = cast(points, np.float64).begin(observe.system, Method())
        assembly = assemble(observe.system, state)
        assembled, moved = Points.of(assembly.check()), float(assembly.distance)
    host = Points(*(np.asarray(x, np.float64) for x in assembled))
    return dataclasses.replace(problem, start=host), moved


def method_for(system: System) -> Method:
    """Returns the method of the reference solution: an explicit Runge–Kutta method of order six.

    For systems with inequality constraints, it is RK4 with `Events`.
    """
    return Method(RK4(), events=Events()) if system.bounds else Method(butcher())


def make(course: Course, observe: Observer, moved: float, seconds: float) -> Reference:
    """Computes the reference solution, by runs with smaller and smaller step sizes.

    The step size is halved until two successive runs agree, until their agreement stops improving,
    or until the time or the number of steps reaches its limit.

    Args:
        course: the program that simulates the problem in float64. The problem comes from `started`,
            and the method from `method_for`.
        observe: evaluates energies and violations.
        moved: distance by which `started` moved the initial state.
        seconds: time budget for the runs, without compilation [s].

    Raises:
        SimulationError: no run reaches the end of the first part; the message says why.
    """
    problem = course.problem
    ruler = Ruler.of(observe, problem)
    course.compile()
    count, spent, best, before, idle = max(1, FIRST // problem.parts), 0.0, None, None, 0
    while True:
        trip = course.go(problem.dt(count), count)
        spent += trip.seconds
        if before is not None and not trip.failed and not before.failed:
            size = ruler.size(trip.points.q)
            apart = np.maximum.accumulate(ruler(trip.points.q, before.points.q)[0])
            best, better = _closer(best, RunPair(before, trip, apart, count), size)
            idle = 0 if better else idle + 1
            # beyond two refinements without improvement, rounding dominates
            if apart[-1] <= GOAL * size or idle > 1 and apart[-1] < GOOD[-1] * size:
                break
        count, before = 2 * count, trip
        if count * problem.parts > MOST or spent + 2 * trip.seconds > seconds:
            break
    if best is None:
        raise SimulationError(_hopeless(trip, count // 2 * problem.parts))
    return _trusted(problem, observe, ruler, best, moved)


class RunPair(NamedTuple):
    """Two runs, the second with half the step size of the first.

    Attributes:
        coarse: the run with the larger step size.
        fine: the run with the smaller step size.
        apart: the largest distance of the runs from the start to the end of each part, (parts,)
            [m].
        each: number of steps of `fine` per part of the horizon.
    """

    coarse: Trip
    fine: Trip
    apart: np.ndarray
    each: int


def _closer(best: RunPair | None, new: RunPair, size: float) -> tuple[RunPair, bool]:
    """Returns the pair of runs that agree better, and True if that is the new pair.

    A pair agrees better if the mean logarithm of the distances between its runs is smaller.

    The two runs of a pair may be close by chance, for example at the end of a chaotic motion. The
    next run with half the step size reveals this. If the best pair stays the best, its distances
    are therefore raised to the distances between its finer run and the next run, where these are
    larger.

    Args:
        best: the best pair so far; None for the first pair.
        new: the pair of the last two runs.
        size: size of the motion [m].
    """
    if best is None or _logarithm(new.apart, size) < _logarithm(best.apart, size):
        return new, True
    if best.fine is new.coarse:
        best = best._replace(apart=np.maximum(best.apart, new.apart))
    return best, False


def _logarithm(apart: np.ndarray, size: float) -> float:
    """Returns the mean logarithm of distances, after adding the rounding error to each distance.

    Args:
        apart: distances, (parts,) [m].
        size: size of the motion [m], which gives the rounding error.
    """
    return float(np.mean(np.log(apart + np.finfo(float).eps * size)))


def _trusted(
    problem: Problem, observe: Observer, ruler: Ruler, best: RunPair, moved: float
) -> Reference:
    """Returns the finer run of the best pair as a `Reference`, with its error estimate.

    Its `until` is the end of the last part of the horizon in which the error meets the threshold of
    `GOOD`.

    Args:
        problem: the problem.
        observe: evaluates energies and violations.
        ruler: measures distances between configurations.
        best: the pair of runs that agree best.
        moved: distance by which `started` moved the initial state.

    Raises:
        SimulationError: the error exceeds the largest threshold in the first part already.
    """
    _, trip, apart, count = best
    pairs = zip(problem.start, trip.points, strict=True)
    points = Points(*(np.concatenate([x[None], y]) for x, y in pairs))
    size = ruler.size(points.q)
    # two runs may agree by chance to less than the rounding error
    error = apart + 64 * np.finfo(float).eps * size
    ends = problem.horizon / problem.parts * np.arange(1, problem.parts + 1)
    counts = [int(np.sum(error <= share * size)) for share in GOOD]
    good = next((n for n in counts if 2 * n >= len(ends)), counts[-1])
    if not good:
        raise SimulationError(
            f"tradeoff: the reference is off by {error[0]:.1e} of a motion of {size:.2g} after"
            f" {ends[0]:.3g} s already, in {count * problem.parts} steps, the finest that there was"
            " time for; take a shorter horizon, or more of a budget."
        )
    steps = count * problem.parts
    return Reference(points, observe(points), error, size, float(ends[good - 1]), steps, moved)


def _hopeless(trip: Trip, steps: int) -> str:
    """Returns the error message that says why there is no reference solution.

    Args:
        trip: the last run.
        steps: number of steps of this run.
    """
    code, when = trip.status, float(trip.points.time[-1])
    if not trip.failed:
        return (
            f"tradeoff: the reference needs two runs that agree, and there was time for one of"
            f" {steps} steps alone; take a shorter horizon, or more of a budget."
        )
    why = MEANING.get(code, "its numbers are not finite")
    return (
        f"tradeoff: the reference fails in {steps} steps, {Status(code).name} at {when:.3g} s:"
        f" {why}. Take a horizon that ends before, or see jc.analysis.find_first_failure."
    )
