"""What runs are compared with: a fine run of high order in float64 that knows its own error."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxcon.analysis.trials import Course, Observer, Points, Problem, Seen, Trip
from jaxcon.core.precision import cast, precision
from jaxcon.core.status import MEANING, SimulationError, Status
from jaxcon.dynamics.assembly import assemble
from jaxcon.simulation.events import Events
from jaxcon.simulation.integrators import RK4, RungeKutta
from jaxcon.simulation.method import Method

FIRST = 64
"""Steps of the coarsest run, about."""
MOST = 1 << 20
"""Steps of the finest run."""
GOAL = 1e-13
"""Difference of two runs at which no finer one is asked for, of the size of the motion."""
GOOD = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Errors, of the size of the motion, up to which a part is compared: the least with which at least
half of the horizon is, or the largest."""
REST = 1e-4
"""The share of its energy that a scene at rest may gain before it counts as diverged."""
ON = 1e-10
"""φ and φ̇ up to which a start is on its constraints, of 1 + max |q| and 1 + max |v|."""


def butcher() -> RungeKutta:
    """A method of order six with seven stages, for reference solutions.

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
    """How far two configurations are apart, in metres; on generalized coordinates ‖q₁ − q₂‖.

    Of a body it is √(d² + k²θ²), d the distance of its centres of mass, θ the angle between its two
    orientations and k its largest radius of gyration: to first order no less than the root mean
    square, over its mass, of how far its points are displaced. Of all bodies the largest counts.
    """

    def __init__(self, system: Any, q: np.ndarray) -> None:
        self.layout = getattr(system, "layout", None)
        if self.layout is not None:
            mass = np.asarray(system.mass(q).diagonal)
            blocks = [(g, _block(mass, g.v, g.kind.n_v, g.names)) for g in self.layout.groups]
            self.gyration = [
                np.sqrt(np.max(block[g.kind.dim :], axis=0, initial=0) / block[0])
                for g, block in blocks
            ]

    @classmethod
    def of(cls, observe: Observer, problem: Problem) -> Ruler:
        """Returns the ruler of a problem."""
        with precision(np.float64):
            return cls(observe.system, cast(problem.start.q, np.float64))

    @np.errstate(over="ignore")  # of a run that went far away, which then is infinitely far
    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distance (n,) and the largest angle (n,) [rad] of configurations (n, n_q)."""
        if self.layout is None:
            return np.linalg.norm(x - y, axis=-1), np.zeros(len(x))
        far, turned = np.zeros(len(x)), np.zeros(len(x))
        for group, k in zip(self.layout.groups, self.gyration, strict=True):
            a, b = (_block(z, group.q, group.kind.n_q, group.names) for z in (x, y))
            angle, dim = _angle(a, b, group.kind), group.kind.dim
            d = np.linalg.norm(a[:, :dim] - b[:, :dim], axis=1)
            far = np.fmax(far, np.max(np.hypot(d, k * angle), axis=1))
            turned = np.fmax(turned, np.max(angle, axis=1))
        return far, turned

    def size(self, q: np.ndarray) -> float:
        """Returns the size of a motion through configurations (n, n_q): places and k [m]."""
        if self.layout is None:
            return float(np.max(np.ptp(q, axis=0), initial=0)) or 1.0
        places = [
            np.moveaxis(_block(q, g.q, g.kind.n_q, g.names)[:, : g.kind.dim], 1, -1)
            for g in self.layout.groups
        ]
        spread = np.ptp(np.concatenate([x.reshape(-1, x.shape[-1]) for x in places]), axis=0)
        widest = max(float(np.max(k, initial=0)) for k in self.gyration)
        return float(np.max(spread)) + widest or 1.0


def _block(x: np.ndarray, first: int, components: int, names: tuple[str, ...]) -> np.ndarray:
    """The coordinates of a group of bodies, (…, component, body)."""
    own = x[..., first : first + components * len(names)]
    return own.reshape(*x.shape[:-1], components, len(names))


def _angle(a: np.ndarray, b: np.ndarray, kind: Any) -> np.ndarray:
    """Between orientations in configurations (n, component, body), (n, body) [rad]."""
    a, b = a[:, kind.dim :], b[:, kind.dim :]
    if a.shape[1] < 2:
        return np.sum(np.abs(a - b), axis=1)
    apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(apart / 2, 1))


@dataclass(frozen=True)
class Reference:
    """A fine run of high order in float64, and how far it is to be trusted.

    Attributes:
        points: at the start and at the ends of the parts.
        seen: energy and violation there.
        error: by part, how far off it may be at its end or before, the difference of two runs, of
            which the coarser has twice the step of this one (parts,) [m].
        size: of the motion, what errors are to be compared with [m].
        until: up to which it is good, and up to which runs are compared with it [s].
        steps: how many it took.
        moved: by how much the start was taken to the constraints, (Σ m d²)^½ [kg^½ m].
    """

    points: Points
    seen: Seen
    error: np.ndarray
    size: float
    until: float
    steps: int
    moved: float

    @property
    def last(self) -> int:
        """How many parts are compared."""
        whole = self.points.time[-1] - self.points.time[0]
        return round(float(self.until / whole) * len(self.error))

    @property
    def floor(self) -> float:
        """Its own error up to there, below which no other can be told [m]."""
        return float(self.error[self.last - 1])

    @property
    def scale(self) -> float:
        """The scale of the energy: what moves or is exchanged, or may be rounded away [J]."""
        energy = self.seen.energy
        moved = max(float(np.max(self.seen.kinetic)), float(np.ptp(energy)))
        return max(moved, REST * float(np.max(np.abs(energy))))


def started(problem: Problem, observe: Observer) -> tuple[Problem, float]:
    """The problem with its start on the constraints, and by how much that moved it.

    Raises:
        SimulationError: no configuration nearby meets them; the message names those left open.
    """
    points = problem.start
    seen = observe(Points(*(x[None] for x in points)))
    allowed = [ON * (1 + np.max(np.abs(x), initial=0)) for x in (points.q, points.v)]
    if seen.violation[0] <= allowed[0] and seen.rate[0] <= allowed[1]:
        return problem, 0.0
    with precision(np.float64):
        own = cast(points, np.float64)
        met = assemble(observe.system, own.begin(observe.system, Method()))
        on, moved = Points.of(met.check()), float(met.distance)
    host = Points(*(np.asarray(x, np.float64) for x in on))
    return dataclasses.replace(problem, start=host), moved


def method_for(system: Any) -> Method:
    """Returns the method of the reference: order six, or four with events beside bounded rows."""
    return Method(RK4(), events=Events()) if system.bounds else Method(butcher())


def make(course: Course, observe: Observer, moved: float, seconds: float) -> Reference:
    """Runs with halved steps until two agree, or agree no better, or time is up.

    Args:
        course: of `method_for` in float64 on the problem from `started`.
        observe: reads energies.
        moved: of the `Reference`.
        seconds: for which the runs may go on, compilation not counted.

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
            best, better = _closer(best, Pair(before, trip, apart, count), size)
            idle = 0 if better else idle + 1
            if apart[-1] <= GOAL * size or idle > 1 and apart[-1] < GOOD[-1] * size:
                break
        count, before = 2 * count, trip
        if count * problem.parts > MOST or spent + 2 * trip.seconds > seconds:
            break
    if best is None:
        raise SimulationError(_hopeless(trip, count // 2 * problem.parts))
    return _trusted(problem, observe, ruler, best, moved)


class Pair(NamedTuple):
    """Two runs, the finer of so many steps a part, and how far they are apart by each part."""

    coarse: Trip
    fine: Trip
    apart: np.ndarray
    each: int


def _closer(best: Pair | None, new: Pair, size: float) -> tuple[Pair, bool]:
    """The pair that agrees better, of all parts in the mean of the logarithms.

    At the end of a motion that is chaotic any two runs may agree by chance. So may two runs before
    a third one shows it: the finer of the best pair is then off by what it is from that one, too.
    """
    if best is None or _logarithm(new.apart, size) < _logarithm(best.apart, size):
        return new, True
    if best.fine is new.coarse:
        best = best._replace(apart=np.maximum(best.apart, new.apart))
    return best, False


def _logarithm(apart: np.ndarray, size: float) -> float:
    return float(np.mean(np.log(apart + np.finfo(float).eps * size)))


def _trusted(
    problem: Problem, observe: Observer, ruler: Ruler, best: Pair, moved: float
) -> Reference:
    """The reference, with the part of the horizon in which it is good."""
    _, trip, apart, count = best
    both = zip(problem.start, trip.points, strict=True)
    points = Points(*(np.concatenate([x[None], y]) for x, y in both))
    size = ruler.size(points.q)
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
    """Why there is no reference."""
    code, when = trip.status, float(trip.points.time[-1])
    if not trip.failed:
        return (
            f"tradeoff: the reference needs two runs that agree, and there was time for one of"
            f" {steps} steps alone; take a shorter horizon, or more of a budget."
        )
    why = MEANING.get(code, "its numbers are not finite")
    return (
        f"tradeoff: the reference fails in {steps} steps, {Status(code).name} at {when:.3g} s:"
        f" {why}. Take a horizon that ends before, or see jc.find_first_failure."
    )
