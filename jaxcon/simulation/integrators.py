"""How a step advances q and v by accelerations alone.

`dynamics(q, v, t)` returns the solution of the saddle system there and its rows. Each integrator
also says how it transforms a constraint error under feedback, which decides which gains are stable.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks, numerics, status
from jaxcon.core.doubled import Doubled
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.dynamics.forward import Dynamics
from jaxcon.dynamics.impacts import jump_of, with_jump
from jaxcon.dynamics.islands import largest_by_island, rows_beside_contact
from jaxcon.model.state import State
from jaxcon.solvers.saddle import Solution
from jaxcon.stabilization.baumgarte import completes_steps


class Advanced(NamedTuple):
    """Where a step leads, and what was seen at its start.

    Attributes:
        point: q (n_q,), v (n_v,) and the time reached, () [s], as `state.instant + dt`, which keeps
            its remainder, or rounded.
        solution: a and λ.
        rows: the constraints.
        memory: of the integrator.
        ends: whether a and λ belong to the point reached, and not to the start of the step.
    """

    point: tuple[Array, Array, Any]
    solution: Solution
    rows: Rows
    memory: PyTree = ()
    ends: bool = False


def reached(state: State, time: Any, dt: Array) -> Doubled:
    """The instant of `Advanced.point`, with its remainder where it is the rounded end of the step.

    Args:
        state: at the start of the step.
        time: that of the point.
        dt: the length of the step, () [s].
    """
    if isinstance(time, Doubled):
        return time
    return keep(time == state.time + dt, state.instant + dt, Doubled.of(time))


Pair = tuple[Any, Any]
FASTEST = 1e8
"""Velocities [m/s, rad/s] from which a world is blowing up."""

LARGE, LARGE_IN_SPACE = (0.038, 0.042), (0.025, 0.03)
"""Turns of a body in a step [rad] between which `newton_correction` sets in.

In the plane, energy then drifts by less than 2 % of the largest kinetic energy in a minute; bodies
in space, which have more ways to exchange it, drift as little if the step sets in sooner.
"""


class Explicit(checks.Checked):
    """An integrator that needs accelerations only; admits every stabiliser."""

    @property
    def bounded(self) -> bool:
        """Returns True where limits, friction and contact may act beside it."""
        return True

    def init(self, system: Any, q: Array, v: Array) -> PyTree:
        """No memory."""
        return ()

    def refuses(self, system: Any, stabilizer: Any) -> str | None:
        """Why it does not work with a system or stabiliser; None where it does."""
        return None


class ForcesInSpace(NamedTuple):
    """The forces of a step of bodies in space.

    Attributes:
        solution: a and λ.
        rows: the equality rows.
        solve_rows: b → the least a with J a + C λ = b; None where the stabilizer solves by itself.
        coasting: what a contains for free rotation during the step, of bodies on which one-sided
            rows may act, (n_v,); None without such rows.
        pushed: a mask of the velocities of bodies on which one-sided rows act, (n_v,); None without
            such rows.
    """

    solution: Solution
    rows: Rows
    solve_rows: Callable[[Array], Solution] | None
    coasting: Array | None
    pushed: Array | None

    def without_coasting(self, acceleration: Array) -> Array:
        """a without what it contains for free rotation during the step, (n_v,)."""
        return acceleration if self.coasting is None else acceleration - self.coasting

    def where_pushed(self, pushed: Array, others: Array) -> Array:
        """Velocities of bodies on which one-sided rows act, and of the others, (n_v,)."""
        return others if self.pushed is None else jnp.where(self.pushed, pushed, others)


@pytree
class SemiImplicitEuler(Explicit):
    """v⁺ = v + h a(q, v), q⁺ = q ⊕ h v⁺: first order, one solve, symplectic without constraints.

    v leads from one q to the next, and so belongs to the time half a step before q. The rate at
    which a constraint moved then is p = φ̇ − ½h γ = (φ − φ⁻)/h + O(h²), and p is what feedback acts
    on. It would hold φ̇ itself against ½h γ, and so do work on the motion: energy would grow in
    proportion to h, and φ be off by h² γ/2. Rows of velocities alone are held at q itself.

    A start with φ̇ = 0 is taken back by half a step in the first one, whose λ therefore lacks a
    share of what bends the path (half, by default gains); `forward_dynamics` without feedback has
    it all.

    In space, the free rotation of bodies is split off from what accelerates them
    (`BodySystem.kick`). A free body so keeps |Iω| and its energy up to turns of a radian a step. A
    top on its point may spin by 4 rad a step; its axis goes round 3 % too slowly where it spins by
    0.3 rad, and a fifth where it spins by one. Beside `Projection()` v belongs to the time of q.

    Where a body or a rod turns by more than 0.038 rad in a step, or 0.025 rad if bodies turn in
    space, what the linearized rows missed of φ is taken out by a second substitution with the
    factors of the step, in full from 0.042 and 0.03 rad on. Such a step takes about half as long
    again. Without it, energy would grow with (h|ω|)³, and motions of a radian in a few
    steps would end NON_FINITE. In the plane, bodies on which a limit or contact acts go without it,
    and so do bodies that joints connect to them. In space `Projection()` takes its place.

    A rod (`Distance`) that turns too fast leaves its length with the status OK: by 0.1 % at 0.5 rad
    a step, 7 % at 1 rad, 40 % at 1.4 rad. `Recovery(limit=…)` ends such a run as VIOLATED. Two
    rods in series end SINGULAR or NON_FINITE from about 0.7 rad a step on.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections VII.1.4 and VII.5.
    """

    reads_within = False
    """True for an integrator that reads angles between the ends of a step."""

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Any) -> Advanced:
        """One step."""
        system, h = dynamics.system, dt[None]
        if system.has_bodies:
            return self._of_bodies(dynamics, state, dt)
        solution, rows = dynamics(state.q, state.v, state.instant, dt / 2)
        v = moving = state.v + h * solution.acceleration
        if (jump := jump_of(rows.reactions)) is not None:
            moving = v - jump.velocity + numerics.safe_divide(jump.travel, h)
        q = system.retract(state.q, h * moving)
        return Advanced((q, v, state.instant + dt), solution, rows)

    def _of_bodies(self, dynamics: Dynamics, state: State, dt: Any) -> Advanced:
        """One step of a system of bodies."""
        system, h = dynamics.system, dt[None]
        if system.turns_in_space and completes_steps(dynamics.stabilizer):
            return self._completed_step(dynamics, state, dt)
        v, solution, rows, solve_rows, skip_newton = self._linearized_step(dynamics, state, dt)
        if solve_rows is not None and rows.layout.size:
            v, solution = newton_correction(
                system, state, v, solution, rows, solve_rows, skip_newton, dt
            )
        travel = h * v
        if (jump := jump_of(rows.reactions)) is not None:
            travel, v = travel + jump.travel, v + jump.velocity
            solution = with_jump(solution, jump, dt)
        q = system.retract(state.q, travel)
        return Advanced((q, v, state.instant + dt), solution, rows)

    def _linearized_step(
        self, dynamics: Dynamics, state: State, dt: Any
    ) -> tuple[Array, Solution, Rows, Callable[[Array], Solution] | None, Array | None]:
        """v⁺, a and λ, rows, `solve_rows` and `skip_newton` of `newton_correction`."""
        system, h, here = dynamics.system, dt[None], (state.q, state.v, state.instant)
        if not system.turns_in_space:
            ahead = dynamics.bounds_ahead(*here) if system.bounds else None
            solution, rows, solve_rows, _ = dynamics.factored(*here, dt / 2, ahead)
            skip_newton = None
            if ahead is not None and rows.reactions is not None:
                skip_newton = rows_beside_contact(rows.jacobian, ahead, rows.reactions.multipliers)
            return state.v + h * solution.acceleration, solution, rows, solve_rows, skip_newton
        forces = self._forces_in_space(dynamics, state, dt)
        solution, rows, solve_rows = forces.solution, forces.rows, forces.solve_rows
        # small turns do for what is corrected later
        small = forces.coasting is None and solve_rows is not None and rows.layout.size > 0
        v = system.kick(state.q, state.v, forces.without_coasting(solution.acceleration), h, small)
        v = forces.where_pushed(state.v + h * solution.acceleration, v)
        return v, solution, rows, solve_rows, None

    def _forces_in_space(self, dynamics: Dynamics, state: State, dt: Any) -> ForcesInSpace:
        """a and λ at the start of a step in space.

        The free rotation of bodies is split off. Of a body on which a one-sided row acts,
        v⁺ = v + h a, as its law says something of this v⁺. The gyroscopic part of a is then the
        mean over a step of free rotation.
        """
        system, h, here = dynamics.system, dt[None], (state.q, state.v, state.instant)
        if not system.bounds:
            solution, rows, solve_rows, _ = dynamics.factored(*here, dt / 2)
            return ForcesInSpace(solution, rows, solve_rows, None, None)
        bounds = dynamics.bounds_ahead(*here)
        may_press = dynamics.pressed(bounds).reshape(-1, *(1,) * (state.v.ndim - 1))
        coasting = jnp.where(may_press, system.coast(state.q, state.v, h), 0)
        held = dataclasses.replace(dynamics, held=system.mass(state.q).apply(coasting))
        solution, rows, solve_rows, push = held.factored(*here, dt / 2, bounds)
        pushed = None if push is None else system.by_body(state.q, push)
        return ForcesInSpace(solution, rows, solve_rows, coasting, pushed)

    def _completed_step(self, dynamics: Dynamics, state: State, dt: Any) -> Advanced:
        """One step in space whose constraint forces are completed afterwards; v belongs to q.

        With R half a step of free rotation, g the gyroscopic part of a, and c the `coasting`,

            V = R(v + h (a − c − g)),   q⁺ = q ⊕ h V,   v⁺ = R(V).

        So φ⁺ = φ + h φ̇ + h² (J (a − c) − ½ J g + ½ γ) + O(h³), and V obeys rows of velocities half
        a step later where J (a − c) − ½ J g + ½ γ = 0. The motion therefore takes the constraint
        forces with J a = −½ γ + J (½ g + c) − φ̇/h, and the projection of v does the rest. Those of
        J a = −γ are reported. Without this, the projection of q would have to do O(h²), or O(h)
        after a start with φ̇ ≠ 0, whose impulses would change R.

        Impacts see v half a step before q, as without a projection: the displacement is h V.
        """
        system, h = dynamics.system, dt[None]
        forces = self._forces_in_space(dynamics, state, dt)
        solution, rows, q, v = forces.solution, forces.rows, state.q, state.v
        a, g = solution.acceleration, system.gyroscopic_acceleration(q, v)
        if forces.solve_rows is not None and rows.layout.size:
            free = g if forces.coasting is None else g + 2 * forces.coasting
            turning = rows.jacobian.apply(forces.where_pushed(jnp.zeros_like(g), free))
            held = rows.layout.holds.reshape(-1, *(1,) * (rows.bias.ndim - 1))
            missing = (rows.bias + turning) / 2 - numerics.safe_divide(rows.rate, h)
            more = forces.solve_rows(jnp.where(held, missing, 0))
            a = a + more.acceleration
            code = status.first(solution.status, status.failures(more.status))
            solution = solution._replace(status=code)
        middle = v + h * (forces.without_coasting(a) - g)
        middle = forces.where_pushed(v + h * a, system.rotate(q, middle, h / 2))
        end = forces.where_pushed(middle, system.rotate(q, middle, h / 2))
        travel = h * middle
        if (jump := jump_of(rows.reactions)) is not None:
            travel, end = travel + jump.travel, end + jump.velocity
            solution = with_jump(solution, jump, dt)
        return Advanced((system.retract(q, travel), end, state.instant + dt), solution, rows)

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """α = 1/(2h), β = 1/h [1/s]: the gains for which an error is gone after one step.

        φ⁺ = φ + h p⁺ with p⁺ = p + h (J a + γ) vanishes where J a = −γ − p/h − φ/h². Both roots of
        the error's recursion are then 0, as far from instability as they can be, and the step is
        SHAKE but for O(h³): of all gains, the one with the least energy drift.

        β² multiplies the rounding of φ into the multipliers. It is therefore held below 0.1/ε, ε
        the precision, where a metre's rounding makes 0.1 m/s²; in float32 this acts below 1.1 ms.
        `Baumgarte()` lets it rise to 1/h where constraints accelerate fast.
        """
        precision = float(jnp.finfo(jnp.result_type(dt)).eps)
        beta = 1.0 / jnp.maximum(dt, (precision / 0.1) ** 0.5)  # with a derivative at h = 0
        return beta / 2, beta

    def highest_rate(self, dt: Any) -> Any:
        """β = 1/h [1/s], to which default gains rise in float32 where constraints accelerate."""
        return 1.0 / jnp.maximum(dt, 1e-9)  # with a derivative at h = 0

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """The factor by which an error (φ, p) may grow in one step: a spectral radius.

        p⁺ = (1 − 2hα) p − hβ² φ and φ⁺ = φ + h p⁺.
        """
        half = 1 - dt * alpha - (dt * beta) ** 2 / 2  # of the trace; the determinant is 1 − 2hα
        root = np.emath.sqrt(half**2 - (1 - 2 * dt * alpha))
        return float(max(abs(half + root), abs(half - root)))

    def error_map(self, alpha: Any, beta: Any, dt: Any) -> tuple[Pair, Pair, Pair]:
        """What a step makes of φ = 1, of φ̇ = 1, and of an acceleration 1 held over it: (φ, φ̇)."""
        rates = (-dt * beta * beta, 1 - 2 * dt * alpha, dt)
        places = (1 + dt * rates[0], dt * rates[1], dt * rates[2])
        return tuple(zip(places, rates, strict=True))  # type: ignore[return-value]


def newton_correction(
    system: Any,
    state: State,
    v: Array,
    solution: Solution,
    rows: Rows,
    solve_rows: Callable[[Array], Solution],
    skip_newton: Array | None,
    dt: Any,
) -> tuple[Array, Solution]:
    """Corrects v⁺, a and λ for the linearization error of φ⁺, by one Newton step for large turns.

    The linearized rows predict φ⁺ = φ + h p + h² φ̈, with φ̈ = J a + γ and p = φ̇ − ½hγ. At q ⊕ h v⁺
    φ differs from it by e = O(h³), and the work of e on the motion adds up. The correction solves
    J a + C λ = −e/h², which leaves O(h⁴). Without inequality rows, the free rotation of
    bodies in space is split more finely, too.

    Most steps turn bodies by less than `LARGE`, where e is about 3e-5 of a lever arm, and pay for
    the branch only. The correction is made island by island, an island being the bodies that
    equality rows connect. It sets in smoothly between the two turns of `LARGE`, so that derivatives
    exist. Rounding over h² therefore does not reach rows of islands that turn slowly.

    The correction fades where the arms and axes that a row holds turn by 1 to √2 rad, and where its
    own kinetic energy is ¼ to ½ of the motion's, as near a singular configuration: from so far away
    a Newton step leads nowhere. A body in space may spin about its arm by 4 rad: its end turns by
    dexp_{hω} Δω h, and the step is taken through the inverse of that map.

    A row of friction or of a motor, or of any inequality constraint on bodies
    in space, moves off its target by e/h with them. Where no body turns in space, islands in which
    a stop or contact acts go without.

    Args:
        system: of bodies.
        state: at the start of the step.
        v: v⁺, (n_v,), with q⁺ = q ⊕ h v⁺.
        solution: a and λ at the start.
        rows: the constraints there.
        solve_rows: b → the least a with J a + C λ = b.
        skip_newton: rows that go without, (n_c,); None for none.
        dt: h, () [s].
    """
    h = dt[None]
    least_turn, full_turn = LARGE_IN_SPACE if system.turns_in_space else LARGE
    splits_finely = system.turns_in_space and not system.bounds
    if skip_newton is None:
        turn = system.squared_turn(state.q, v, state.v, rows, h)
    else:
        turn = jnp.max(jnp.where(skip_newton, 0, system.squared_turns(v, state.v, rows, h)), axis=0)
    # `kick_little` may overflow where `kick` does not: NaN counts as fast
    is_fast = ~(turn <= least_turn**2) if splits_finely else turn > least_turn**2

    def corrected() -> tuple[Array, Solution]:
        # a world that blows up must not lend the derivatives of others what is infinite
        sizes = jnp.abs(state.v), jnp.abs(h * solution.acceleration), jnp.abs(v)
        start_size, change_size, end_size = (jnp.max(x, axis=0) for x in sizes)
        corrects = is_fast & (start_size < FASTEST)
        corrects &= (change_size < FASTEST**1.5) if splits_finely else (end_size < FASTEST)
        finite = [jnp.where(corrects, x, 0) for x in (solution.acceleration, state.v, v)]
        a, v_start, v_end = finite
        swings = {i: jnp.where(corrects, x, 0) for i, x in rows.swings.items()}
        turning = dataclasses.replace(rows, swings=swings)

        def rise(squares: Array) -> Array:
            return smooth((squares - least_turn**2) / (full_turn**2 - least_turn**2))

        kicked = system.kick(state.q, v_start, a, h) if splits_finely else v_end
        if splits_finely:
            # `kick_little` diverges for large turns: there nothing of it may be left
            v_end = jnp.where(turn < 4 * full_turn**2, v_end, kicked)
        square = system.squared_turn(state.q, v_end, v_start, turning, h)
        if splits_finely:
            v_end = v_end + rise(square)[None] * (kicked - v_end)
        q_end = system.retract(state.q, h * v_end)
        squares = system.squared_turns(v_end, v_start, turning, h)
        whole = system.squared_turns(v_end, v_start, turning, h, whole=True)
        largest = largest_by_island(rows.jacobian, whole)
        largest = square[None] if largest is None else largest
        weight = rise(largest) * smooth(2 - squares)
        corrected_rows = corrects if skip_newton is None else corrects[None] & ~skip_newton
        weight = jnp.where(corrected_rows, weight, 0)
        held = rows.layout.holds & rows.layout.holonomic
        held = held.reshape(-1, *(1,) * (rows.bias.ndim - 1))
        predicted = rows.residual + h * (rows.rate + h * (rows.jacobian.apply(a) + rows.bias / 2))
        residual = linearize(system, q_end, v_end, state.instant + dt).residual
        error = jnp.where(held, residual - predicted, 0)
        correction = solve_rows(-weight * numerics.safe_divide(error, h * h))
        # rounding over h² may contradict redundant rows; rows that do contradict were noted before
        code = status.failures(correction.status)
        change, mass = h * correction.acceleration, system.mass(state.q)
        energies = [(x * mass.apply(x)).sum(axis=0) for x in (change, v_end)]
        fade = smooth(2 - 4 * numerics.safe_divide(*energies))[None]
        faded = Solution(fade * correction.acceleration, fade * correction.multipliers, code)
        if system.turns_in_space:  # J is that of the start, and the body turns meanwhile
            change = system.carry(state.q, -h * v_end, change)
        return jnp.where(corrects, v_end + fade * change, v), added(solution, faded)

    return jax.lax.cond(somewhere(is_fast), corrected, lambda: (v, solution))


def smooth(x: Array) -> Array:
    """0 up to x = 0, 1 from x = 1 on, and 3x² − 2x³ between."""
    x = jnp.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def added(solution: Solution, more: Solution) -> Solution:
    """The sum of two solutions; the graver status."""
    return Solution(
        solution.acceleration + more.acceleration,
        solution.multipliers + more.multipliers,
        status.first(solution.status, more.status),
    )


@pytree
class RungeKutta(Explicit):
    """An explicit Runge–Kutta method by its tableau.

    Stages move q along q̇ = N(q) v and bring quaternions back to unit length. The vector field so
    extended off the unit sphere agrees with the true one on it: the order is that of the tableau.

    Attributes:
        a: rows of the strictly lower triangle.
        b: weights.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section IV.4.
    """

    a: tuple[tuple[float, ...], ...] = static()
    b: tuple[float, ...] = static()

    def check(self) -> None:
        """Checks the tableau.

        Raises:
            ValueError: rows of the wrong lengths, or weights that do not add up to 1.
        """
        lengths = [len(row) for row in self.a]
        if lengths != list(range(1, len(lengths) + 1)) or len(self.b) != len(lengths) + 1:
            raise ValueError(
                f"RungeKutta: with {len(self.b)} weights the rows of a must have 1 to"
                f" {len(self.b) - 1} entries, got {lengths}."
            )
        if abs(sum(self.b) - 1) > 1e-9:
            raise ValueError(f"RungeKutta: the weights b must add up to 1, got {sum(self.b)}.")

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Any) -> Advanced:
        """One step."""
        q, v, t, h = state.q, state.v, state.instant, dt[None]
        system = dynamics.system
        solution, rows, dynamics = dynamics.begun(state.q, state.v, state.instant)
        first = system.kinematics(q, v), solution.acceleration

        def stage(carry: Any, row: tuple[Array, Array]) -> tuple[Any, None]:
            (slopes, code), (weights, i) = carry, row
            dq, dv = (combine(weights, x) for x in slopes)
            q_i, v_i = system.normalize(q + h * dq), v + h * dv
            found, _ = dynamics(q_i, v_i, t + dt * jnp.sum(weights))
            own = system.kinematics(q_i, v_i), found.acceleration
            put = jax.lax.dynamic_update_index_in_dim
            slopes = tuple(put(x, y, i, 0) for x, y in zip(slopes, own, strict=True))
            return (slopes, status.first(code, found.status)), None

        slopes = tuple(jnp.zeros((len(self.b), *x.shape), x.dtype).at[0].set(x) for x in first)
        table = np.zeros((len(self.a), len(self.b)))
        for i, weights in enumerate(self.a):
            table[i, : i + 1] = weights
        inputs = jnp.asarray(table, q.dtype), jnp.arange(1, len(self.b))
        through = one_by_one if checks.is_concrete((q, v)) else jax.lax.scan
        (slopes, code), _ = through(stage, (slopes, solution.status), inputs)
        dq, dv = (combine(self.b, x) for x in slopes)
        q, v = system.normalize(q + h * dq), v + h * dv
        if (jump := jump_of(rows.reactions)) is not None:
            q, v = system.retract(q, jump.travel), v + jump.velocity
            solution = with_jump(solution, jump, dt)
        return Advanced((q, v, t + dt), solution._replace(status=code), rows)

    def default_gains(self, dt: Any) -> tuple[Any, Any]:
        """α = β = 10 /s, and less where h is so large that 0.4/h is below it."""
        rate = 0.4 / jnp.maximum(dt, 0.04)
        return rate, rate

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """max |R(h s)| over the roots s of s² + 2α s + β² = 0, R the stability polynomial."""
        root = np.emath.sqrt(alpha**2 - beta**2)
        return float(max(abs(self.amplify(dt * (sign * root - alpha))) for sign in (1, -1)))

    def error_map(self, alpha: Any, beta: Any, dt: Any) -> tuple[Pair, Pair, Pair]:
        """What a step makes of φ = 1, of φ̇ = 1, and of an acceleration 1 held over it: (φ, φ̇).

        With x = (φ, φ̇), ẋ = A x + B w and w held, x⁺ = R(hA) x + h Q(hA) B w, where
        R(z) = 1 + z Q(z) is the stability polynomial.
        """

        def times(x: Pair) -> Pair:
            return dt * x[1], -dt * (beta * beta * x[0] + 2 * alpha * x[1])

        def polynomial(coefficients: list[float], x: Pair) -> Pair:
            y = (0.0 * x[0], 0.0 * x[1])
            for c in reversed(coefficients):
                moved = times(y)
                y = (c * x[0] + moved[0], c * x[1] + moved[1])
            return y

        powers = [float(c) for c in np.asarray(self.amplify(np.poly1d([1.0, 0.0])))[::-1]]
        zero = 0.0 * (alpha + beta + dt)
        columns = [polynomial(powers, x) for x in ((1 + zero, zero), (zero, 1 + zero))]
        return columns[0], columns[1], polynomial(powers[1:], (zero, dt + zero))

    def amplify(self, z: Any) -> Any:
        """R(z), what a step makes of y = 1 under ẏ = z y with h = 1; z may be a polynomial."""
        slopes: list[Any] = []
        for weights in ((), *self.a):
            stage = 1 + sum(w * k for w, k in zip(weights, slopes, strict=True))
            slopes.append(z * stage)
        return 1 + sum(w * k for w, k in zip(self.b, slopes, strict=True))


def ExplicitEuler() -> RungeKutta:  # noqa: N802
    """v⁺ = v + h a, q⁺ = q + h q̇: first order, for comparison only."""
    return RungeKutta((), (1.0,))


def Heun() -> RungeKutta:  # noqa: N802
    """The trapezoidal method of Heun: second order, two solves."""
    return RungeKutta(((1.0,),), (0.5, 0.5))


def RK4() -> RungeKutta:  # noqa: N802
    """The classical method of Kutta: fourth order, four solves."""
    return RungeKutta(((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))


def one_by_one(function: Any, carry: Any, inputs: Any) -> tuple[Any, None]:
    """`scan` outside a trace, so that what is called sees values."""
    for row in zip(*inputs, strict=True):
        carry, _ = function(carry, row)
    return carry, None


def combine(weights: Any, slopes: Array) -> Array:
    """Σ wᵢ kᵢ of slopes (stage, n)."""
    return functools.reduce(operator.add, (w * k for w, k in zip(weights, slopes, strict=True)))
