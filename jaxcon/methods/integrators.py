"""Explicit integrators, which advance q and v by accelerations alone.

`dynamics(q, v, t)` returns the solution of the saddle system and its rows. Each integrator also has
the linear map by which a step with feedback transforms a constraint error. This map determines
which gains are stable.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.contact.rows import rows_beside_contact
from jaxcon.core import checks, numerics, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, Number, PyTree
from jaxcon.linear.islands import largest_by_island
from jaxcon.linear.saddle import Solution
from jaxcon.methods import dormand_prince
from jaxcon.methods.gains import column
from jaxcon.protocols import Bodies, Integrator, System
from jaxcon.step import Advanced, Dynamics
from jaxcon.system.jump import with_jump
from jaxcon.system.state import State

Pair = tuple[Any, Any]
"""A constraint error: φ and φ̇."""
Carry = tuple[tuple[Array, ...], Array]
"""The slopes of q and of v at the stages, (stage, n) each, and a status."""
FASTEST = 1e8
"""The speed [m/s, rad/s] above which a world counts as diverging."""

LARGE = 0.038, 0.042
LARGE_IN_SPACE = {np.dtype(np.float32): (0.025, 0.03), np.dtype(np.float64): (0.018, 0.02)}
"""Rotations of a body in a step [rad] at which `newton_correction` begins and acts in full.

In space they depend on the dtype: in float32, at smaller rotations, rounding errors of φ over h²
would disturb multipliers by more than 0.1 %. Below these rotations energy drifts, see
`benchmarks.energy_drift`. Half of these numbers would cut the drift to a half or less, and cost up
to a quarter of the rate of chains and closed loops.
"""


@pytree
class SemiImplicitEuler(checks.Checked, Integrator):
    """Semi-implicit Euler, v⁺ = v + h a(q, v), q⁺ = q ⊕ h v⁺: first order, one solve a step.

    Without constraints the method is symplectic. v leads from one q to the next, so it belongs to
    the time half a step before q. The rate of a constraint at that time is p = φ̇ − ½hγ = (φ −
    φ⁻)/h + O(h²), where φ⁻ is φ one step before. Feedback acts on p. Feedback of φ̇ would drive φ̇
    to zero although it should be ½hγ. This would do work on the motion: energy would grow in
    proportion to h, and φ would have an error of h²γ/2. Velocity-level rows are satisfied at q
    itself.

    If a simulation starts with φ̇ = 0, the first step shifts v to half a step before q. The λ of
    this step therefore lacks a part of the centripetal force (half of it with default gains).
    `forward_dynamics` without feedback returns all of it.

    For bodies that turn in space, operator splitting treats free rotation separately from
    acceleration (`BodySystem.kick`). A free body thus conserves |Iω| and its energy for rotations
    up to a radian a step. A top on its point may spin by 4 rad a step. Its axis precesses 3 % too
    slowly for a spin of 0.3 rad a step, and 20 % too slowly for one radian. With `Projection()`, v
    belongs to the time of q.

    `newton_correction` removes the linearization error of φ by a second solve with the factors of
    the step. The correction begins if a body or a rod turns by more than 0.038 rad in a step. It
    acts in full from 0.042 rad on. If bodies turn in space, these numbers are 0.018 and 0.02 rad,
    and 0.025 and 0.03 rad in float32. A step with it takes about 1.5 times as long. Without the
    correction, energy would grow with (h|ω|)³, and motions of a radian in a few steps would end
    with status NON_FINITE. Below these rotations energy still drifts, most where a light body
    carries a heavy one. In the plane, islands (bodies connected by constraints) on which a limit or
    contact acts are not corrected. In space, `Projection()` replaces the correction.

    A rod (`Distance`) that turns too fast changes its length, although the status stays OK: by 0.1
    % at 0.5 rad a step, 7 % at 1 rad, 40 % at 1.4 rad. `Recovery(limit=…)` ends such a run with
    status VIOLATED. Two rods in series end with status SINGULAR or NON_FINITE from about 0.7 rad a
    step on.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections VII.1.4 and VII.5.
    """

    reads_within: ClassVar[bool] = False

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Array) -> Advanced:
        """Advances a state by one step of dt [s]."""
        system, h, here = dynamics.system, dt[None], (state.q, state.v, state.instant)
        if not system.has_bodies:
            solution, rows, *_ = dynamics.solve(dynamics.linearize(*here), *here, dt / 2)
            v = state.v + h * solution.acceleration
            return _with_jump(system, state, h * v, v, solution, rows, dt)
        if system.turns_in_space:
            return self._in_space(dynamics, state, dt)
        solution, rows, solve_rows, *_ = dynamics.solve(dynamics.linearize(*here), *here, dt / 2)
        skip_newton = None
        if rows.inequalities is not None and rows.reactions is not None:
            λ = rows.reactions.multipliers
            skip_newton = rows_beside_contact(rows.jacobian, rows.inequalities, λ)
        v = state.v + h * solution.acceleration
        if solve_rows is not None and rows.layout.size:
            v, solution = newton_correction(
                cast(Bodies, system), state, v, solution, rows, solve_rows, skip_newton, dt
            )
        return _with_jump(system, state, h * v, v, solution, rows, dt)

    def _in_space(self, dynamics: Dynamics, state: State, dt: Array) -> Advanced:
        """Advances a state by one step in a system whose bodies turn in space.

        Operator splitting treats the free rotation of bodies separately. A body with a one-sided
        row instead uses v⁺ = v + h a, since the law of the row applies to this v⁺. Its acceleration
        a then includes c (`coasting`): the mean gyroscopic acceleration over a step of free
        rotation, less its value at the start. For other bodies c is zero.

        If the stabilizer completes the step afterwards (`Projection()`), v belongs to the time of
        q. Let R be half a step of free rotation, and g the gyroscopic acceleration at the start:

            V = R(v + h (a − c − g)),   q⁺ = q ⊕ h V,   v⁺ = R(V).

        Then φ⁺ = φ + h φ̇ + h² (J (a − c) − ½ J g + ½ γ) + O(h³). V obeys velocity-level rows half
        a step later if J (a − c) − ½ J g + ½ γ = 0. The motion therefore uses the constraint forces
        with J a = −½ γ + J (½ g + c) − φ̇/h, and the projection of v adds the rest. The reported
        forces satisfy J a = −γ. If the motion used them, the projection of q would be O(h²), or
        O(h) after a start with φ̇ ≠ 0, and the impulses of this projection would change R.

        Impacts treat v as half a step before q, as without a projection: the displacement is h V.
        """
        system, h, here = cast(Bodies, dynamics.system), dt[None], (state.q, state.v, state.instant)
        q, v = state.q, state.v
        rows = dynamics.linearize(*here)
        coasting = pushed = None
        if rows.inequalities is None:
            solution, rows, solve_rows, *_ = dynamics.solve(rows, *here, dt / 2)
        else:
            may_press = rows.inequalities.pressed.reshape(-1, *(1,) * (v.ndim - 1))
            coasting = jnp.where(may_press, system.coast(q, v, h), 0)
            force = system.mass(q).apply(coasting)
            dynamics = dataclasses.replace(dynamics, constant_force=force)
            solution, rows, solve_rows, push, _ = dynamics.solve(rows, *here, dt / 2)
            pushed = None if push is None else system.by_body(q, push)

        def where_pushed(x: Array, others: Array) -> Array:
            """Returns `x` for bodies on which one-sided rows act and `others` elsewhere, (n_v,)."""
            return others if pushed is None else jnp.where(pushed, x, others)

        solve_rows = solve_rows if rows.layout.size else None
        a = solution.acceleration
        free = a if coasting is None else a - coasting
        if not dynamics.stabilizer.completes:
            # a cheaper kick suffices for small rotations; `newton_correction` repeats large ones
            end = system.kick(q, v, free, h, coasting is None and solve_rows is not None)
            end = where_pushed(v + h * a, end)
            if solve_rows is not None:
                end, solution = newton_correction(
                    system, state, end, solution, rows, solve_rows, None, dt
                )
            return _with_jump(system, state, h * end, end, solution, rows, dt)
        g = system.gyroscopic_acceleration(q, v)
        if solve_rows is not None:
            turning = g if coasting is None else g + 2 * coasting
            turning = rows.jacobian.apply(where_pushed(jnp.zeros_like(g), turning))
            missing = (rows.bias + turning) / 2 - numerics.safe_divide(rows.rate, h)
            change = solve_rows(jnp.where(column(rows.layout.holds, rows), missing, 0))
            a = a + change.acceleration
            code = status.first(solution.status, status.failures(change.status))
            solution = solution._replace(status=code)
        free = a if coasting is None else a - coasting
        middle = v + h * (free - g)
        middle = where_pushed(v + h * a, system.rotate(q, middle, h / 2))
        end = where_pushed(middle, system.rotate(q, middle, h / 2))
        return _with_jump(system, state, h * middle, end, solution, rows, dt)

    def default_gains(self, dt: Array) -> tuple[Array, Array]:
        """Returns α = 1/(2h) and β = 1/h [1/s]: one step removes an error completely.

        Let p be the rate of φ half a step before q. Then φ⁺ = φ + h p⁺ with p⁺ = p + h (J a + γ)
        vanishes if J a = −γ − p/h − φ/h². Both roots of the error's recursion are then 0, as far
        from instability as possible. The step agrees with SHAKE up to O(h³). Of all gains, these
        have the least energy drift.

        The multipliers contain β² times the rounding error of φ. β is therefore at most √(0.1/ε),
        where ε is the relative precision. The rounding error of a length of 1 m then causes at most
        0.1 m/s². In float32 this bound is active for h below 1.1 ms. `Baumgarte()` lets β rise to
        1/h if constraints accelerate fast.
        """
        checks.numbers("SemiImplicitEuler.default_gains", "dt", dt)
        precision = float(jnp.finfo(jnp.result_type(dt)).eps)
        beta = 1.0 / jnp.maximum(dt, (precision / 0.1) ** 0.5)  # with a derivative at h = 0
        return beta / 2, beta

    def highest_rate(self, dt: Array) -> Array:
        """Returns β = 1/h [1/s], the largest value to which default gains may rise in float32."""
        return 1.0 / jnp.maximum(dt, 1e-9)  # with a derivative at h = 0

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """Returns the growth factor of a constraint error (φ, p) in a step, a spectral radius.

        p is the rate of φ half a step before. A step is p⁺ = (1 − 2hα) p − hβ² φ and φ⁺ = φ + h p⁺.
        """
        half = 1 - dt * alpha - (dt * beta) ** 2 / 2  # half the trace; the determinant is 1 − 2hα
        root = np.emath.sqrt(half**2 - (1 - 2 * dt * alpha))
        return float(max(abs(half + root), abs(half - root)))

    def error_map(self, alpha: Number, beta: Number, dt: Number) -> tuple[Pair, Pair, Pair]:
        """Returns three errors (φ, φ̇) after a step with feedback.

        The errors before the step are φ = 1, then φ̇ = 1, then zero. In the third case a
        disturbance φ̈ = 1 acts during the step.
        """
        rates = (-dt * beta * beta, 1 - 2 * dt * alpha, dt)
        first, second, held = ((dt * rate, rate) for rate in rates)
        return (1 + first[0], first[1]), second, held


def _with_jump(
    system: System,
    state: State,
    travel: Array,
    v: Array,
    solution: Solution,
    rows: Rows,
    dt: Array,
) -> Advanced:
    """Returns the end of a step, with the changes of q and v by impacts added.

    Args:
        system: the system to step.
        state: state at the start of the step.
        travel: displacement of the step without impacts, (n_v,).
        v: velocity at the end of the step without impacts, (n_v,).
        solution: accelerations a and multipliers λ of the step.
        rows: linearized constraints at the start, with the jump by impacts.
        dt: step size h, () [s].
    """
    if (jump := rows.jump) is not None:
        travel, v = travel + jump.travel, v + jump.velocity
        solution = with_jump(solution, jump, dt)
    return Advanced((system.retract(state.q, travel), v, state.instant + dt), solution, rows)


def newton_correction(
    system: Bodies,
    state: State,
    v: Array,
    solution: Solution,
    rows: Rows,
    solve_rows: Callable[[Array], Solution],
    skip_newton: Array | None,
    dt: Array,
) -> tuple[Array, Solution]:
    """Corrects v⁺, a and λ for the linearization error of φ⁺ in steps with large rotations.

    The linearized rows predict φ⁺ = φ + h p + h² φ̈, with φ̈ = J a + γ and p = φ̇ − ½hγ. At q ⊕ h
    v⁺, φ differs from the prediction by e = O(h³), and the work that e does on the motion adds up.
    One Newton step solves J a + C λ = −e/h², which leaves an error of O(h⁴). Without inequality
    rows, the free rotation of bodies in space also uses a finer splitting.

    Most steps turn bodies by less than `LARGE`, for which e is about 3e-5 of a lever arm. Such
    steps skip the correction, at the cost of a branch. An island is a set of bodies that equality
    rows connect; each island has its own weight of the correction. The weight rises smoothly
    between the two rotations of `LARGE`, so derivatives exist. Islands that turn slowly have the
    weight 0, so rounding errors divided by h² do not affect them.

    The correction fades out if the arms and axes of a row turn by 1 to √2 rad. It also fades out if
    its kinetic energy is ¼ to ½ of that of the motion, as near a singular configuration. For such
    large errors Newton steps are useless. A body in space may spin about its arm by 4 rad in a
    step. A change Δω turns the end of such a body by dexp_{hω} Δω h; the correction is multiplied
    by the inverse of this map.

    The correction changes the velocities of friction and motor rows by e/h, so they miss their
    targets. For bodies in space, this holds for all inequality rows. In the plane, islands on which
    a stop or contact acts are not corrected.

    Args:
        system: a system of bodies.
        state: state at the start of the step.
        v: velocity v⁺ before the correction, (n_v,), with q⁺ = q ⊕ h v⁺.
        solution: accelerations a and multipliers λ at the start.
        rows: linearized constraints at the start.
        solve_rows: function that returns the smallest a with J a + C λ = b, given b.
        skip_newton: mask of the rows that are not corrected, (n_c,); None to correct all.
        dt: step size h, () [s].
    """
    h = dt[None]
    least_turn, full_turn = LARGE_IN_SPACE[v.dtype] if system.turns_in_space else LARGE
    splits_finely = system.turns_in_space and not system.bounds
    if skip_newton is None:
        turn = system.squared_turn(state.q, v, state.v, rows, h)
    else:
        turn = jnp.max(jnp.where(skip_newton, 0, system.squared_turns(v, state.v, rows, h)), axis=0)
    # v⁺ by the cheaper kick may overflow where the finer one does not: NaN counts as fast
    is_fast = ~(turn <= least_turn**2) if splits_finely else turn > least_turn**2

    def corrected() -> tuple[Array, Solution]:
        # a diverging world must not put infinite numbers into the derivatives of other worlds
        sizes = jnp.abs(state.v), jnp.abs(h * solution.acceleration), jnp.abs(v)
        start_size, change_size, end_size = (jnp.max(x, axis=0) for x in sizes)
        corrects = is_fast & (start_size < FASTEST)
        corrects &= (change_size < FASTEST**1.5) if splits_finely else (end_size < FASTEST)
        a, v_start, v_end = (jnp.where(corrects, x, 0) for x in (solution.acceleration, state.v, v))
        swings = {i: jnp.where(corrects, x, 0) for i, x in rows.swings.items()}
        turning = dataclasses.replace(rows, swings=swings)

        def rise(squares: Array) -> Array:
            return smooth((squares - least_turn**2) / (full_turn**2 - least_turn**2))

        kicked = v_end
        if splits_finely:
            kicked = system.kick(state.q, v_start, a, h)
            # v⁺ by the cheaper kick diverges for large rotations, so `kicked` replaces it
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
        held = column(rows.layout.holds & rows.layout.holonomic, rows)
        predicted = rows.residual + h * (rows.rate + h * (rows.jacobian.apply(a) + rows.bias / 2))
        residual = linearize(system, q_end, v_end, state.instant + dt).residual
        error = jnp.where(held, residual - predicted, 0)
        correction = solve_rows(-weight * numerics.safe_divide(error, h * h))
        # rounding errors over h² may contradict redundant rows; the first solve reports conflicts
        code = status.failures(correction.status)
        correction = system.complete(correction)
        change = h * correction.acceleration
        energies = [system.kinetic_energy(state.q, x) for x in (change, v_end)]
        fade = smooth(2 - 4 * numerics.safe_divide(*energies))[None]
        if system.turns_in_space:  # J belongs to the start of the step, and bodies turn after it
            change = system.carry(state.q, -h * v_end, change)
        total = Solution(
            solution.acceleration + fade * correction.acceleration,
            solution.multipliers + fade * correction.multipliers,
            status.first(solution.status, code),
        )
        return jnp.where(corrects, v_end + fade * change, v), total

    return jax.lax.cond(somewhere(is_fast), corrected, lambda: (v, solution))


def smooth(x: Array) -> Array:
    """Returns the smooth step 3x² − 2x³ with x clipped to [0, 1]."""
    x = jnp.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


@pytree
class RungeKutta(checks.Checked, Integrator):
    """An explicit Runge–Kutta method, defined by its tableau.

    Stages move q along q̇ = N(q) v and normalize quaternions. Normalization does not change the
    vector field on the unit sphere, so the method has the order of its tableau.

    Attributes:
        a: coefficients of the stages, the rows of the strictly lower triangle.
        b: weights of the stages.

    References:
        Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), section IV.4.
    """

    a: tuple[tuple[float, ...], ...] = static()
    b: tuple[float, ...] = static()

    def __post_init__(self) -> None:
        """Converts the tableau to tuples of numbers, which can be hashed, and checks it.

        Raises:
            TypeError: an entry is not a number, or is traced.
            ValueError: a row has the wrong length, or the weights do not add up to 1.
        """
        try:
            a = tuple(tuple(float(x) for x in row) for row in self.a)
            b = tuple(float(x) for x in self.b)
        except (TypeError, ValueError) as error:
            raise TypeError(
                "RungeKutta: a must be rows of numbers and b a row of numbers, got"
                f" {checks.shortened(self.a)} and {checks.shortened(self.b)}."
            ) from error
        object.__setattr__(self, "a", a)
        object.__setattr__(self, "b", b)
        super().__post_init__()

    def __repr__(self) -> str:
        """Returns the constructor call, such as `RK4()`, with the tableau if it has no name."""
        for method in (Heun, RK4, Dopri5, Dopri8):
            if (known := method()).a == self.a and known.b == self.b:
                return f"{method.__name__}()"
        return f"RungeKutta(a={self.a}, b={self.b})"

    def check(self) -> None:
        """Checks the lengths of the tableau's rows, and the sum of its weights.

        Raises:
            ValueError: a row has the wrong length, or the weights do not add up to 1.
        """
        lengths = [len(row) for row in self.a]
        if lengths != list(range(1, len(lengths) + 1)) or len(self.b) != len(lengths) + 1:
            raise ValueError(
                f"RungeKutta: with {len(self.b)} weights the rows of a must have 1 to"
                f" {len(self.b) - 1} entries, got {lengths}."
            )
        if abs(sum(self.b) - 1) > 1e-9:
            raise ValueError(f"RungeKutta: the weights b must add up to 1, got {sum(self.b)}.")

    def advance(self, dynamics: Dynamics, state: State, memory: PyTree, dt: Array) -> Advanced:
        """Advances a state by one step of dt [s]."""
        q, v, t, h = state.q, state.v, state.instant, dt[None]
        system, put = dynamics.system, jax.lax.dynamic_update_index_in_dim

        def stage(carry: Carry, row: tuple[Array, Array]) -> tuple[Carry, tuple[Solution, Rows]]:
            (slopes, code), (weights, i) = carry, row
            dq, dv = (combine(weights, x) for x in slopes)
            q_i, v_i = system.normalize(q + h * dq), v + h * dv
            solution, rows = dynamics(q_i, v_i, t + dt * jnp.sum(weights))
            pairs = zip(slopes, (system.kinematics(q_i, v_i), solution.acceleration), strict=True)
            slopes = tuple(put(x, y, i, 0) for x, y in pairs)
            return (slopes, status.first(code, solution.status)), (solution, rows)

        count = len(self.b)
        table = np.zeros((count, count))
        for i, row in enumerate(self.a):
            table[i + 1, : i + 1] = row
        weights, numbers = jnp.asarray(table, q.dtype), jnp.arange(count)
        slopes = tuple(jnp.zeros((count, *x.shape), x.dtype) for x in (q, v))
        carry: Carry = slopes, jnp.zeros_like(state.status)
        begun: list[tuple[Solution, Rows]] = []
        if dynamics.contact is not None:  # its forces are solved for in the first stage only
            solution, rows, dynamics = dynamics.at_step_start(q, v, t)
            first = system.kinematics(q, v), solution.acceleration
            slopes = tuple(x.at[0].set(y) for x, y in zip(slopes, first, strict=True))
            carry, begun = (slopes, solution.status), [(solution, rows)]
            weights, numbers = weights[1:], numbers[1:]
        if checks.is_concrete((q, v)):  # outside a trace, the user's functions get concrete values
            for row in zip(weights, numbers, strict=True):
                carry, solved = stage(carry, row)
                begun.append(solved)
        else:
            carry, solved = jax.lax.scan(stage, carry, (weights, numbers))
            begun = begun or [jax.tree.map(lambda x: x[0], solved)]
        (slopes, code), (solution, rows) = carry, begun[0]
        dq, dv = (combine(self.b, x) for x in slopes)
        q, v = system.normalize(q + h * dq), v + h * dv
        if (jump := rows.jump) is not None:
            q, v = system.retract(q, jump.travel), v + jump.velocity
            solution = with_jump(solution, jump, dt)
        return Advanced((q, v, t + dt), solution._replace(status=code), rows)

    def default_gains(self, dt: Array) -> tuple[Array, Array]:
        """Returns α = β = 10/s, or 0.4/h if that is less."""
        checks.numbers(f"{type(self).__name__}.default_gains", "dt", dt)
        rate = 0.4 / jnp.maximum(dt, 0.04)
        return rate, rate

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """Returns the growth factor of a constraint error in a step with feedback.

        It is max |R(h s)| over the roots s of s² + 2α s + β² = 0, with the stability polynomial R.
        """
        root = np.emath.sqrt(alpha**2 - beta**2)
        return float(max(abs(self.amplify(dt * (sign * root - alpha))) for sign in (1, -1)))

    def error_map(self, alpha: Number, beta: Number, dt: Number) -> tuple[Pair, Pair, Pair]:
        """Returns three errors (φ, φ̇) after a step with feedback.

        The errors before the step are φ = 1, then φ̇ = 1, then zero. In the third case a
        disturbance φ̈ = 1 acts during the step.

        The error x = (φ, φ̇) obeys ẋ = A x + B w with a constant disturbance w. A step gives x⁺ =
        R(hA) x + h Q(hA) B w, where R(z) = 1 + z Q(z) is the stability polynomial.
        """

        def polynomial(coefficients: list[float], x: Pair) -> Pair:
            φ, rate = 0.0 * x[0], 0.0 * x[1]
            for c in reversed(coefficients):
                change = -dt * (beta * beta * φ + 2 * alpha * rate)
                φ, rate = c * x[0] + dt * rate, c * x[1] + change
            return φ, rate

        powers = [float(c) for c in np.asarray(self.amplify(np.poly1d([1.0, 0.0])))[::-1]]
        zero = 0.0 * (alpha + beta + dt)
        columns = [polynomial(powers, x) for x in ((1 + zero, zero), (zero, 1 + zero))]
        return columns[0], columns[1], polynomial(powers[1:], (zero, dt + zero))

    def amplify(self, z: complex | np.poly1d) -> Any:
        """Returns the stability polynomial R(z); z may be a number or a polynomial.

        R(z) is y after a step of h = 1 from y = 1, under ẏ = z y.
        """
        slopes: list[Any] = []
        for weights in ((), *self.a):
            stage = 1 + sum(w * k for w, k in zip(weights, slopes, strict=True))
            slopes.append(z * stage)
        return 1 + sum(w * k for w, k in zip(self.b, slopes, strict=True))


def ExplicitEuler() -> RungeKutta:  # noqa: N802
    """Returns the explicit Euler method, first order with one solve, for comparison only."""
    return RungeKutta((), (1.0,))


def Heun() -> RungeKutta:  # noqa: N802
    """Returns the trapezoidal method of Heun: second order, two solves a step."""
    return RungeKutta(((1.0,),), (0.5, 0.5))


def RK4() -> RungeKutta:  # noqa: N802
    """Returns the classical method of Kutta: fourth order, four solves a step."""
    return RungeKutta(((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6))


def Dopri5() -> RungeKutta:  # noqa: N802
    """Returns the fifth-order method of Dormand and Prince: six solves a step.

    The step size is fixed: the embedded error estimate and its seventh stage are left out.

    References:
        Dormand, Prince, A family of embedded Runge-Kutta formulae, J. Comput. Appl. Math. 6 (1980).
    """
    return RungeKutta(*dormand_prince.ORDER_5)


def Dopri8() -> RungeKutta:  # noqa: N802
    """Returns the eighth-order method of Dormand and Prince (DOP853): twelve solves a step.

    The step size is fixed: the embedded error estimates are left out.

    References:
        Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993), section II.5.
    """
    return RungeKutta(*dormand_prince.ORDER_8)


def combine(weights: Array | tuple[float, ...], slopes: Array) -> Array:
    """Returns the sum Σ wᵢ kᵢ of slopes k, (stage, n), with weights w."""
    return functools.reduce(operator.add, (w * k for w, k in zip(weights, slopes, strict=True)))
