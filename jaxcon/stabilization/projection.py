"""Projection onto the constraints after a step (chapter 3.4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.core import checks, numerics, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import lift
from jaxcon.dynamics.forward import saddle
from jaxcon.model.state import State
from jaxcon.solvers import roots
from jaxcon.solvers.saddle import Diagonal, Mass, Saddle, Solution
from jaxcon.stabilization.baumgarte import Unstabilized

METRICS = ("mass", "euclidean")

SMALL = 1e-3
"""The share of the kinetic energy below which what a projection moves is a correction."""


@pytree
class Tolerance(checks.Checked):
    """ε = ε₀ (1 + α ‖v‖ + β ‖F‖): what |φ| may be, more where the motion is fast or forces large.

    ‖·‖ is the Euclidean norm over all entries of v and of the applied force F, control left out.

    Attributes:
        base: ε₀, in the units of φ.
        speed: α; None leaves the term out.
        force: β; None leaves the term out.
    """

    base: Any
    speed: Any = None
    force: Any = None

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: one is negative or no number.
        """
        for what in ("base", "speed", "force"):
            x, optional = getattr(self, what), what != "base"
            checks.check("Tolerance", what, x, (), least=0, optional=optional)

    def at(self, system: Any, state: State) -> Array:
        """ε by world, ()."""
        scale = jnp.ones_like(state.q[0])
        if self.speed is not None:
            scale = scale + _number(self.speed, state) * numerics.norm(state.v)
        if self.force is not None:
            force = system.force(state.q, state.v, state.instant)
            scale = scale + _number(self.force, state) * numerics.norm(force)
        return _number(self.base, state) * scale


class Bounds(NamedTuple):
    """max |φ| at which a world stays as it is, and from which on it has not converged, ()."""

    stays: Array
    fails: Array


@pytree
class Projection(Unstabilized):
    """Takes q and then v to the constraints after each step; within a step b = −γ.

    Positions first: q = q* ⊕ d with d = W⁻¹ J₀ᵀ μ and φ(q, t) = 0, W the metric. One J₀ serves all
    iterations, so that one factorization of J W⁻¹ Jᵀ does, too, and the root does not depend on how
    it was found. Then velocities at that q: v = v* + W⁻¹ Jᵀ μ with J v + ∂φ/∂t = 0, the smallest
    change in the metric. Doing it in the other order would leave J v = −J d/h.

    Coupled, J₀ is that of the point where the step began, and d/h is added to v before v is
    projected: W⁻¹ J₀ᵀ μ/h is what the constraint forces of the step missed. Semi-implicit Euler so
    becomes the symplectic Euler method of constrained particles and plane bodies, whose energy
    stays near its start; split, it would grow in proportion to h. Runge–Kutta methods keep their
    order either way. What the state was off before the step, its forces did not miss; d/h therefore
    counts by 1/(1 + r²), r = T(d/h)/T(v*), T the kinetic energy in the metric: r is O(h²) after a
    step from the surface, and large after one from far off it. Split, J₀ is that of q*, and q
    differs from the nearest point in the metric of W by O(‖d‖²) along the surface.

    Rows that depend on each other do so on the surface only: off it J(q*) has directions too many,
    by which the point is not unique; the solver chooses, within O(‖d‖).

    Where bodies turn in space, the torques J₀ᵀ μ belong to their frames at the start of the step,
    and turn with them. Beside semi-implicit Euler, with default options, a top may so spin by 3 rad
    a step, and the energy of two boxes on a hinge and a ball joint stays as near its start as by
    default. With other options, or as a part of `Hybrid` or `AugmentedLagrangian`, it does not.

    Rows of velocities alone are part of the second projection only. Rotors are inertia of the mass
    metric. The derivative is that of the root, in every world, and not of the iterations.

    Attributes:
        metric: W, "mass" for M with rotors, or "euclidean" for 1 [m, rad], in which heavy bodies
            move as much as light ones. In float32, where an angle of the plane has grown by many
            turns, it leaves less: it moves places, whose spacing is finer.
        iterations: at most, of quasi-Newton d ← d − factor · S φ(q* ⊕ d), S b the least step with
            J₀ d = b; they end where only rounding is left. Each multiplies the error by about the
            distance from where J₀ belongs, over the size of the scene: some six are enough after a
            step of a hundredth of a radian, all are needed at one. 1 is the linearized projection,
            which leaves O(‖d‖²) and is differentiated as it is.
        tolerance: max |φ|, a number or a `Tolerance`. A world stays as it is once it is there, and
            is NOT_CONVERGED if it is not there at the end. If None, it stays below 2 ε times 1 +
            max |x| over all places x, and fails beyond ε^⅔ (1 + max |q|), ε the spacing of
            floating numbers; the linearized projection fails only where its solver does.
        factor: of each step, in (0, 1].
        every: how many steps there are from one projection to the next.
        coupled: whether d belongs to the step, and d/h to its velocity; or q and v are split, as
            they are where only one of them is projected.
        position: whether q is projected.
        velocity: whether v is projected.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections IV.4 and VII.1.3.
        Ascher, Chin, Reich, Stabilization of DAEs and invariant manifolds (1994).
    """

    metric: str = static(default="mass")
    iterations: int = static(default=40)
    tolerance: Any = None
    factor: Any = 1.0
    every: int = static(default=1)
    coupled: bool = static(default=True)
    position: bool = static(default=True)
    velocity: bool = static(default=True)

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """How many steps ago the last projection was, where not every step has one."""
        return () if self.every == 1 else jnp.zeros((), jnp.int32)

    def advance(self, rows: Rows, memory: PyTree, dt: Any) -> PyTree:
        """One step more, modulo `every`."""
        return memory if self.every == 1 else (memory + 1) % self.every

    @property
    def corrects(self) -> tuple[str, ...]:
        """Which of q and v are projected."""
        return ("position",) * self.position + ("velocity",) * self.velocity

    @property
    def completes(self) -> bool:
        """Returns True where q and v are projected after each step, and d/h is a part of v."""
        return self.every == 1 and self.coupled and self.position and self.velocity

    @property
    def remembers(self) -> bool:
        """Returns True where it counts steps."""
        return self.every != 1

    def correct(
        self, system: Any, solver: Any, before: State, state: State, memory: PyTree, dt: Any
    ) -> Any:
        """The state on the constraints, where its projection is due, and a status."""
        if self.every == 1:
            return self.project(system, solver, before, state, dt)
        due = memory == 0

        def go(q: Array, v: Array) -> tuple[Array, Array, Array]:
            new, code = self.project(
                system, solver, before, dataclasses.replace(state, q=q, v=v), dt
            )
            return new.q, new.v, code

        def rest(q: Array, v: Array) -> tuple[Array, Array, Array]:
            return q, v, jnp.zeros_like(state.status)

        q, v, code = jax.lax.cond(somewhere(due), go, rest, state.q, state.v)
        q, v = (jnp.where(lift(due, x), x, y) for x, y in ((q, state.q), (v, state.v)))
        return dataclasses.replace(state, q=q, v=v), jnp.where(due, code, Status.OK)

    def project(
        self, system: Any, solver: Any, before: State, state: State, dt: Any
    ) -> tuple[State, Array]:
        """The state on the constraints, and a status: failures of the solver, or NOT_CONVERGED."""
        code = jnp.zeros_like(state.status)
        if self.position:
            start = state
            if self.coupled and self.velocity and before is not state:
                start = dataclasses.replace(before, q=system.normalize(before.q))
            q, v, code = self._positions(system, solver, start, state, dt)
            state = dataclasses.replace(state, q=q, v=v)
        if self.velocity:
            v, late = self._velocities(system, solver, state)
            state, code = dataclasses.replace(state, v=v), status.first(code, late)
        return state, code

    def _positions(
        self, system: Any, solver: Any, start: State, state: State, dt: Any
    ) -> tuple[Array, Array, Array]:
        """q with φ(q, t) = 0 by the directions at the start, the v that goes with it, a status."""
        q, still = state.q, jnp.zeros_like(state.v)
        rows = linearize(system, start.q, still, start.instant)
        held, rotors = _held(rows.layout)
        if not held.any():
            return q, state.v, jnp.zeros_like(state.status)
        problem = self._problem(system, start.q, rows, held, rotors)
        off = rows if start is state else linearize(system, q, still, state.instant)
        frames = None
        if start is not state and system.turns_in_space:
            frames = _Frames(system, problem.mass, q, state.v, dt[None])
        surface = _Surface(system, state, off.residual, problem, held, frames)
        factored, bounds = solver.factor(problem), self._bounds(system, state)
        step, left, code = self._step(surface, partial(factored, still), bounds)
        late = jnp.where(left > bounds.fails, Status.NOT_CONVERGED, Status.OK)
        code = status.first(status.failures(code), late.astype(jnp.int32))
        v = state.v
        if start is not state:
            v = v + _missed(problem.mass, v, step, dt, frames)
        return surface.moved(step), v, code

    def _step(
        self, surface: _Surface, solve: Callable[[Array], Solution], bounds: Bounds
    ) -> tuple[Array, Array, Array]:
        """d with φ(q* ⊕ d) = 0, max |φ| there, where it is needed, and what the solver said."""
        factor = jnp.asarray(self.factor, surface.start.dtype)[None]
        if self.iterations == 1:
            solution = solve(surface.start)
            step = -factor * solution.acceleration
            # what is there already may be rounding, which redundant rows contradict: no fault
            there = _largest(surface.start) <= bounds.stays
            lost = there & status.failed(solution.status)
            met = there & (solution.status == Status.NOT_CONVERGED)
            none = jnp.where(met[None], step - jax.lax.stop_gradient(step), 0)  # a derivative alone
            step = jnp.where(lost[None], none, step)
            left = surface.start if self.tolerance is None else surface.residual(step)
            return step, _largest(left), jnp.where(met, Status.OK, solution.status)

        def nearest(b: Array) -> Array:
            """d = W⁻¹ J₀ᵀ μ with J₀ d = b."""
            return solve(b).acceleration

        def goes(left: Array, before: Array) -> Array:
            """Returns True where a world is still off, and not yet where only rounding is left."""
            off = (left > bounds.stays) & ((left < before) | (left > bounds.fails))
            return off & ~status.failed(surface.state.status)

        def iterate(_: Any, d: Array) -> tuple[Array, Array]:
            def wanted(known: tuple[Array, ...]) -> Array:
                count, _, left, before = known
                return (count < self.iterations) & somewhere(goes(_largest(left), before))

            def once(known: tuple[Array, ...]) -> tuple[Array, ...]:
                count, d, left, before = known
                most = _largest(left)
                d = jnp.where(goes(most, before)[None], d - factor * nearest(left), d)
                return count + 1, d, surface.residual(d), most

            first = (jnp.zeros((), jnp.int32), d, surface.start, _largest(surface.start) + jnp.inf)
            _, d, left, _ = jax.lax.while_loop(wanted, once, first)
            return d, left

        def equation(d: Array) -> Array:
            """d − S (J₀ d − φ(q* ⊕ d)), S b the least step with J₀ d = b: near to d itself.

            Where it vanishes d is among the steps S b, and φ is zero, or at least S φ is.
            """
            return d - nearest(surface.apply(d) - surface.residual(d))

        still = jnp.zeros_like(surface.problem.force)
        step, left = roots.implicit(equation, still, iterate, self.iterations)
        # whether there are factors; how well each round was solved is seen by what is left
        return step, _largest(left), solve(0 * surface.start).status

    def _velocities(self, system: Any, solver: Any, state: State) -> tuple[Array, Array]:
        """v with φ̇ = 0 and ψ = 0, and a status."""
        rows = linearize(system, state.q, state.v, state.instant)
        if not rows.layout.size:
            return state.v, jnp.zeros_like(state.status)
        rotors = _held(rows.layout)[1]
        problem = self._problem(system, state.q, rows, ~rotors, rotors)
        solution = solver.factor(problem)(problem.force, -rows.rate)
        return state.v + solution.acceleration, status.failures(solution.status)

    def _problem(
        self, system: Any, q: Array, rows: Rows, held: np.ndarray, rotors: np.ndarray
    ) -> Saddle:
        """W d = Jᵀ μ, J d = b of the rows held, and of rotors where they are inertia."""
        still = jnp.zeros((rows.jacobian.shape[1], *q.shape[1:]), q.dtype)
        massive = self.metric == "mass"
        kept = rows.only(held | rotors if massive else held)
        problem = saddle(system, q, kept, still, jnp.zeros_like(rows.bias))
        return problem if massive else dataclasses.replace(problem, mass=Diagonal(still + 1))

    def _bounds(self, system: Any, state: State) -> Bounds:
        """At which max |φ| a world stays, and beyond which it fails."""
        state = jax.lax.stop_gradient(state)
        if self.tolerance is not None:
            given = self.tolerance
            given = given if isinstance(given, Tolerance) else Tolerance(given)
            bound = given.at(jax.lax.stop_gradient(system), state)
            return Bounds(bound, bound)
        fails = numerics.negligible(state.q)
        fails = jnp.full_like(fails, jnp.inf) if self.iterations == 1 else fails
        spacing = float(jnp.finfo(fails.dtype).eps)
        return Bounds(2 * spacing * (1 + system.extent(state.q)), fails)

    def check(self) -> None:
        """Checks the choices.

        Raises:
            ValueError: one that does not exist, or a number out of range.
        """
        if self.metric not in METRICS:
            raise ValueError(f"Projection: metric must be one of {METRICS}, got {self.metric!r}.")
        for what in ("iterations", "every"):
            checks.count("Projection", what, getattr(self, what))
        for what in ("coupled", "position", "velocity"):
            checks.flag("Projection", what, getattr(self, what))
        checks.check("Projection", "factor", self.factor, (), above=0, most=1)
        if isinstance(self.tolerance, Tolerance):
            self.tolerance.check()
        else:
            checks.check("Projection", "tolerance", self.tolerance, (), least=0, optional=True)


def _missed(mass: Mass, v: Array, step: Array, dt: Any, frames: _Frames | None) -> Array:
    """The velocity d/h, as far as its kinetic energy is small beside that of v.

    It turns with the bodies as far as its energy is below `SMALL` of theirs, half of it there. A
    larger one belongs to a start with φ̇ ≠ 0, and the free rotation, which depends on it, takes most
    of its turn back.
    """
    gain = numerics.safe_divide(step, dt[None])
    own, present = (jnp.sum(x * mass.apply(x), axis=0) for x in (gain, v))
    scale = jax.lax.stop_gradient(jnp.maximum(own, present))
    own, present = (numerics.safe_divide(x, scale) for x in (own, present))
    if frames is not None:
        turned = numerics.safe_divide(frames.change(step), dt[None])
        share = numerics.safe_divide(present**2, present**2 + (own / SMALL) ** 2)
        gain = gain + share[None] * (turned - gain)
    return gain * numerics.safe_divide(present**2, present**2 + own**2)[None]


@dataclass(frozen=True)
class _Frames:
    """Moves d = W⁻¹ J₀ᵀ μ from the start of a step to its end, where bodies turn in space.

    J₀ᵀ μ contains torques in the frames of the bodies at the start. Bodies turn by h ω till the
    end, and by half of it until the middle of the step, where W⁻¹ belongs.

    Attributes:
        system: with `rotate` and `in_turned_frames`.
        mass: W.
        q: positions at the end, (n_q,).
        v: velocities at the end, (n_v,).
        dt: h, (1,) [s].
    """

    system: Any
    mass: Mass
    q: Array
    v: Array
    dt: Array

    def displacement(self, d: Array) -> Array:
        """The displacement of q by d at the end of the step, (n_v,)."""
        half = self.dt / 2 * self.v
        return self.system.in_turned_frames(self.q, half, self._by_torques(d, half))

    def change(self, d: Array) -> Array:
        """The change of h v by d at the end of the step, (n_v,)."""
        return self._by_torques(d, self.dt * self.v)

    def _by_torques(self, d: Array, step: Array) -> Array:
        """W⁻¹ J₀ᵀ μ of bodies that have turned by a step, (n_v,)."""
        return self.mass.solve(self.system.in_turned_frames(self.q, step, self.mass.apply(d)))


class _Surface:
    """φ(q* ⊕ d) of the rows that are projected, zero for the others.

    Attributes:
        problem: M, J₀ and C.
        start: φ(q*), (n_c,).
        frames: from those of d to those at q*; None where they are the same.
    """

    def __init__(
        self,
        system: Any,
        state: State,
        start: Array,
        problem: Saddle,
        held: np.ndarray,
        frames: _Frames | None,
    ) -> None:
        self.system, self.state, self.problem, self.frames = system, state, problem, frames
        self.held = jnp.asarray(held).reshape(-1, *(1,) * (start.ndim - 1))
        self.start = start  # rows of velocities and rotors have φ = 0

    def moved(self, d: Array) -> Array:
        """q* ⊕ d, (n_q,)."""
        d = d if self.frames is None else self.frames.displacement(d)
        return self.system.retract(self.state.q, d)

    def residual(self, d: Array) -> Array:
        """φ(q* ⊕ d), (n_c,)."""
        still = jnp.zeros_like(d)
        return linearize(self.system, self.moved(d), still, self.state.instant).residual

    def apply(self, d: Array) -> Array:
        """J₀ d, (n_c,)."""
        return jnp.where(self.held, self.problem.jacobian.apply(d), 0)


def _held(layout: RowLayout) -> tuple[np.ndarray, np.ndarray]:
    """Which rows have a φ to be projected, and which are rotors, (n_c,) each."""
    rotors = ~layout.holds
    return layout.holonomic & ~rotors, rotors


def _largest(x: Array) -> Array:
    """max |x| by world."""
    return jnp.max(jnp.abs(x), axis=0, initial=0)


def _number(x: Any, state: State) -> Array:
    """A number of a method in the dtype of the state."""
    return jnp.asarray(x, state.q.dtype)
