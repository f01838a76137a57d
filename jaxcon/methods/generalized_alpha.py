"""Generalized-α: an implicit second-order integrator for stiff forces and extreme mass ratios.

The equations φ = 0 and ψ = 0 of a step are divided by κβh² and κγh, so that their residuals are
accelerations. Here β and γ are coefficients of the integrator, a is the averaged acceleration, and
κ = ∂a⁺/∂v̇⁺. For every h, Newton's matrix then has the form of a saddle system,

    [ M − κγh ∂f/∂v − κβh² ∂(f + Jᵀλ)/∂q   −Jᵀ ]
    [ J                                      C ],

including the geometric stiffness of the constraint forces.

References:
    Bottasso, Dopico, Trainelli, On the optimal scaling of index three DAEs in multibody dynamics,
    Multibody System Dynamics 19 (2008).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.builders.vakonomic import Vakonomic
from jaxcon.constraints.rows import Rows, linearize, saddle
from jaxcon.core import checks, derivatives, status
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.linear import lu
from jaxcon.linear.proximal import scaled
from jaxcon.linear.saddle import judge
from jaxcon.methods.baumgarte import asks_nothing
from jaxcon.methods.gains import check_numbers, column, zeros_by_row
from jaxcon.methods.projection import Projection
from jaxcon.protocols import Integrator, Stabilizer, System
from jaxcon.staging.worlds import per_world, where_tree
from jaxcon.step import Advanced, Dynamics
from jaxcon.system.state import State

Linear = Callable[[Array], Array]

CLOSING = 2
"""The largest number of final Newton iterations that remove the effect of the regularization.

The first iteration is never one of them.
"""

ROUNDS = 4
"""Rounds of iterative refinement in each of the `CLOSING` iterations."""


@pytree
class LastStep:
    """The memory of `GeneralizedAlpha`; zeros before the first step.

    Attributes:
        acceleration: acceleration v̇ at the end of the step, (n_v,).
        average: averaged acceleration a, which equals v̇ at a slightly shifted time to second
            order, (n_v,).
        multipliers: multipliers λ, the initial guess for the next step, (n_c,).
        started: True after the first step, ().
    """

    acceleration: Array
    average: Array
    multipliers: Array
    started: Array


class Scheme(NamedTuple):
    """The coefficients of a step of length h, each with a leading axis of size 1, (1, …).

    Attributes:
        alpha_m, alpha_f, beta, gamma: the coefficients α_m, α_f, β and γ of Chung and Hulbert.
        dt: the step size h [s].
    """

    alpha_m: Array
    alpha_f: Array
    beta: Array
    gamma: Array
    dt: Array

    @classmethod
    def of(cls, rho: Array, dt: Array) -> Scheme:
        """Returns the coefficients for which the spectral radius at infinite frequency is ρ.

        Among all schemes with this ρ, these coefficients damp low frequencies the least.

        References:
            Chung, Hulbert, A time integration algorithm for structural dynamics with improved
                numerical dissipation: the generalized-α method, J. Applied Mechanics 60 (1993).
        """
        alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 0.5 + alpha_f - alpha_m
        return cls(alpha_m, alpha_f, 0.25 * (gamma + 0.5) ** 2, gamma, dt)

    @property
    def share(self) -> Array:
        """The derivative κ = ∂a⁺/∂v̇⁺ of the averaged acceleration a⁺ by the acceleration v̇⁺."""
        return (1 - self.alpha_f) / (1 - self.alpha_m)

    @property
    def reach(self) -> Array:
        """The displacement per unit of acceleration, ∂(q⁺ − q)/∂v̇⁺ = κβh² [s²]."""
        return self.share * self.beta * self.dt**2


@pytree
class GeneralizedAlpha(checks.Checked, Integrator):
    """An implicit second-order integrator for stiff springs and extreme ratios of masses.

    Each step ends with φ = 0 and φ̇ = 0, whatever its length. An explicit method needs steps as
    short as the period of the fastest vibration. This method damps such a vibration instead. It
    uses no feedback: `Baumgarte()` without gains has no effect, like `Unstabilized()`.

    A step of length h solves the following equations at its end, with unknowns v̇⁺ and λ⁺:

        M v̇⁺ = f(q⁺, v⁺, t⁺) + Jᵀλ⁺,    φ(q⁺, t⁺) = 0,    ψ(q⁺, v⁺, t⁺) = 0,    J v̇⁺ + C λ⁺ = b,

    ψ = 0 is for velocity-level rows, and the last equation for rows with compliance, such as
    rotors. q⁺ and v⁺ follow from averaged accelerations a, with the coefficients of Chung and
    Hulbert:

        (1 − α_m) a⁺ + α_m a = (1 − α_f) v̇⁺ + α_f v̇,
        q⁺ = q ⊕ h (v + h ((½ − β) a + β a⁺)),    v⁺ = v + h ((1 − γ) a + γ a⁺).

    The solution has φ̇ of order h². The smallest change of v in the metric of M then makes φ̇ zero.
    Without this projection, light links between heavy bodies start to shake if ρ > 0.7. With it,
    the λ of the equations is of first order only. Therefore `solver` computes the a and λ of `info`
    from q and v at the end of the step.

    If rows may be linearly dependent, as in closed loops, Newton's matrix is regularized by ε W,
    where W is the diagonal of J M⁻¹ Jᵀ. Proximal iterations remove the effect of this term: φ is
    zero to rounding, and λ is the solution of least norm. Implicit differentiation gives
    derivatives of a step that are exact to every order. Newton's matrix is dense, which suits up to
    some hundreds of rows. After changing a state by hand, call `init` again. The equations divide
    by h: a world with h = 0 ends with status NON_FINITE.

    Attributes:
        rho: spectral radius ρ∞ at infinite frequency, from 1 (no dissipation) to 0 (the highest
            frequencies vanish in one step).
        tolerance: the largest final Newton correction of q, relative to 1 + max |q|. Above it, the
            status is NOT_CONVERGED. If None, it is the spacing of floating-point numbers to the
            power ⅔.
        tikhonov: regularization ε. It changes the speed of convergence and the rounding error of λ,
            but not the solution. If None, it is the square root of the spacing of floating-point
            numbers if the scene has loops, and 0 otherwise.
        iterations: number of Newton iterations, each with a new matrix.
        projects: True to project v at the end of the step, so that φ̇ = 0.

    References:
        Arnold, Brüls, Convergence of the generalized-α scheme for constrained mechanical systems,
            Multibody System Dynamics 18 (2007).
        Brüls, Cardona, Arnold, Lie group generalized-α time integration of constrained flexible
            multibody systems, Mechanism and Machine Theory 48 (2012).
    """

    rho: Any = 0.9
    tolerance: Any = None
    tikhonov: Any = None
    iterations: int = static(default=6)
    projects: bool = static(default=True)
    supports_inequalities: ClassVar[bool] = False

    def init(self, system: System, q: Array, v: Array) -> LastStep:
        """Returns the memory before the first step: zeros."""
        none = jnp.zeros_like(v)
        return LastStep(none, none, zeros_by_row(system, q, v), jnp.zeros((), bool))

    def refuses(self, system: System, stabilizer: Stabilizer) -> str | None:
        """Returns why the integrator does not work with a system or stabilizer; None if it does."""
        if isinstance(system, Vakonomic):
            return (
                "it solves M v̇ = f + Jᵀλ, which variational equations are not;"
                " use an explicit integrator such as RK4()"
            )
        if asks_nothing(stabilizer) or isinstance(stabilizer, Projection):
            return None
        return (
            f"it solves φ = 0 itself and leaves nothing to {type(stabilizer).__name__}; use"
            " Baumgarte() without gains, Unstabilized() or Projection()"
        )

    def check(self) -> None:
        """Checks ρ, the tolerance, the regularization and the number of iterations.

        Raises:
            ValueError: ρ is not in [0, 1], there are no iterations, or a number is negative.
        """
        checks.flag("GeneralizedAlpha", "projects", self.projects)
        check_numbers(
            self,
            rho={"least": 0, "most": 1},
            tolerance={"least": 0, "optional": True},
            tikhonov={"least": 0, "optional": True},
        )
        checks.count("GeneralizedAlpha", "iterations", self.iterations)

    def default_gains(self, dt: Array) -> tuple[Array, Array]:
        """Returns α = β = 0, since the integrator uses no feedback."""
        return jnp.zeros_like(dt), jnp.zeros_like(dt)

    def growth(self, alpha: float, beta: float, dt: float) -> float:
        """Returns 0: one step removes an error of φ, whatever the gains."""
        return 0.0

    def advance(self, dynamics: Dynamics, state: State, memory: LastStep, dt: Array) -> Advanced:
        """Advances a state by one step of dt [s]."""
        system, q, t = dynamics.system, state.q, state.instant + dt
        healthy = jnp.zeros_like(state.status)

        def first_step() -> tuple[LastStep, Array]:
            """Returns the memory at the start of the step, and a status.

            A world in its first step has no memory: its a and λ solve the saddle system. Any other
            world keeps its memory, with the status OK.
            """
            (a, λ, code), _ = dynamics(state.q, state.v, state.instant)
            fresh = LastStep(a, a, λ, memory.started)
            return where_tree(memory.started, (memory, healthy), (fresh, code))

        started = everywhere(memory.started)
        last, began = jax.lax.cond(started, lambda: (memory, healthy), first_step)

        # solve the equations of the step
        rows = linearize(system, q, state.v, state.instant)
        scheme = Scheme.of(jnp.asarray(self.rho, q.dtype)[None], dt[None])
        equations = Equations(dynamics, state, last, scheme, self._softness(dynamics, state, rows))
        eps = float(jnp.finfo(q.dtype).eps)
        given = eps ** (2 / 3) if self.tolerance is None else jnp.asarray(self.tolerance, q.dtype)
        allowed = given * (1 + jnp.max(jnp.abs(q), axis=0, initial=0))
        x, moved, singular = root(equations, self.iterations)
        acceleration, multipliers = equations.split(x)
        average, q, v = equations.end(acceleration)

        projection = jnp.zeros_like(began)
        if self.projects:
            # M w = Jᵀ Λ, J w + C Λ = −φ̇ for the change w of v; compliant rows have the target 0
            end = linearize(system, q, v, t)
            target = -end.rate
            if end.compliance is not None:
                target = jnp.where(end.compliance > 0, 0, target)
            problem = saddle(system, q, end, jnp.zeros_like(v), target)
            change, _, code = dynamics.solver.solve(problem)
            # redundant rows seem contradictory if φ̇ is at rounding level, so only failures count
            v, projection = v + change, status.failures(code)

        late = jnp.where(moved <= allowed, Status.OK, Status.NOT_CONVERGED).astype(jnp.int32)
        codes = (began, judge(x, singular), judge(equations.weights[0]), late, projection)
        code = functools.reduce(status.first, codes)
        new = LastStep(acceleration, average, multipliers, jnp.ones_like(memory.started))
        solution, seen = dynamics(q, v, t)  # compiled only where it is read
        if equations.soft is not None:
            # CONFLICT if φ is larger than the error that regularization by ε W causes with the
            # least λ. Proximal rounds reduce the φ of independent rows, most slowly near a singular
            # position. They do not reduce the φ of contradictory rows.
            gives = scheme.reach * equations.soft * jnp.abs(solution.multipliers)
            most = allowed + 10 * jnp.max(gives, axis=0)
            bad = jnp.max(jnp.abs(seen.residual), axis=0) > most
            conflict = jnp.where(bad, Status.CONFLICT, Status.OK).astype(jnp.int32)
            code = status.first(code, conflict)
        return Advanced((q, v, t), solution._replace(status=code), rows, new, ends=True)

    def _softness(self, dynamics: Dynamics, state: State, rows: Rows) -> Array | None:
        """Returns the diagonal ε W of the regularization, (n_c,), zero for rows with compliance.

        It is None if rows cannot be linearly dependent and `tikhonov` is not given.
        """
        if self.tikhonov is None and not rows.layout.loops:
            return None
        dtype = rows.bias.dtype
        # this balances the error after a proximal round, ε, and the rounding error of λ, eps/ε
        share = float(jnp.finfo(dtype).eps) ** 0.5
        if self.tikhonov is not None:
            share = jnp.asarray(self.tikhonov, dtype)[None]
        problem = saddle(dynamics.system, state.q, rows, state.v, rows.bias)
        soft = share * scaled(problem, 1e-6)
        return soft if rows.compliance is None else jnp.where(rows.compliance > 0, 0, soft)


class Equations:
    """The equations r(x) = 0 of a step for x = (v̇⁺, λ⁺), in units of accelerations and forces.

    Attributes:
        guess: initial guess: x of the last step.
        scheme: coefficients of the integrator.
        inertia: diagonal of M at the start of the step, (n_v,).
        weights: the factors 1/κβh² of φ and 1/κγh of ψ.
        soft: regularization ε W of Newton's matrix, (n_c,); None without regularization.
    """

    def __init__(
        self, dynamics: Dynamics, state: State, last: LastStep, scheme: Scheme, soft: Array | None
    ) -> None:
        self.dynamics, self.state, self.last = dynamics, state, last
        self.scheme, self.soft = scheme, soft
        # computed outside of the root finding, see `roots.implicit`
        self.weights = 1 / scheme.reach, 1 / (scheme.share * scheme.gamma * scheme.dt)
        self.time = state.instant + dynamics.dt
        self.guess = jnp.concatenate([last.acceleration, last.multipliers])
        self.inertia = dynamics.system.mass(state.q).diagonal

    def split(self, x: Array) -> tuple[Array, Array]:
        """Splits x into the accelerations v̇⁺, (n_v,), and the multipliers λ⁺, (n_c,)."""
        n = self.state.v.shape[0]
        return x[:n], x[n:]

    def end(self, acceleration: Array) -> tuple[Array, Array, Array]:
        """Returns a⁺, q⁺ and v⁺ for accelerations v̇⁺; a⁺ is the averaged acceleration."""
        s, last, state = self.scheme, self.last, self.state
        lag = s.alpha_f * last.acceleration - s.alpha_m * last.average
        a = s.share * acceleration + lag / (1 - s.alpha_m)
        step = s.dt * (state.v + s.dt * ((0.5 - s.beta) * last.average + s.beta * a))
        v = state.v + s.dt * ((1 - s.gamma) * last.average + s.gamma * a)
        return a, self.dynamics.system.retract(state.q, step), v

    def __call__(self, x: Array) -> Array:
        """Returns the residual r(x), (n_v + n_c,).

        The first n_v entries are M v̇⁺ − f − Jᵀλ⁺. The last n_c entries depend on the kind of row:
        φ/κβh² for holonomic rows, ψ/κγh for velocity-level rows. For rows with compliance they are
        J v̇⁺ + C λ⁺ plus the part of φ̈ without accelerations.
        """
        system, (acceleration, multipliers) = self.dynamics.system, self.split(x)
        _, q, v = self.end(acceleration)
        rows = linearize(system, q, v, self.time)
        force = system.force(q, v, self.time, self.dynamics.control)
        pull = force + rows.jacobian.transpose(multipliers)
        balance = system.mass(q).apply(acceleration) - pull
        positions, velocities = self.weights
        holonomic = column(rows.layout.holonomic, rows)
        closed = jnp.where(holonomic, rows.residual * positions, rows.rate * velocities)
        if rows.compliance is not None:
            soft = rows.jacobian.apply(acceleration) + rows.compliance * multipliers + rows.bias
            closed = jnp.where(rows.compliance > 0, soft, closed)
        return jnp.concatenate([balance, closed])


def root(equations: Equations, iterations: int) -> tuple[Array, Array, Array]:
    """Solves r(x) = 0 by Newton's method, with implicit differentiation.

    If rows may be linearly dependent, Newton's matrix K is singular. Then K + R is factored. On the
    rows of constraints R = ε W, where W is the diagonal of J M⁻¹ Jᵀ. First r(x) + R λ = 0 is
    solved. Its λ is unique, has the least norm, and does not depend on the guess, but φ has the
    error κβh² R λ. The last iterations continue to r(x) = 0 by proximal rounds, see `lu.factor`.
    Each round multiplies the error along an eigenvector of the scaled J M⁻¹ Jᵀ by ε/(σ + ε), where
    σ is the eigenvalue. If σ = 0, a round adds only rounding errors. Derivatives are those of
    r(x) = 0, and also use proximal rounds.

    Args:
        equations: the residual r and its initial guess.
        iterations: number of Newton iterations.

    Returns:
        The solution x (n_v + n_c,), the last correction of q before the `CLOSING` iterations, (),
        and True if a matrix was singular, ().
    """
    inertia, soft = jax.lax.stop_gradient((equations.inertia, equations.soft))

    def solve(linear: Linear, right: Array, yields: Array | None = None) -> tuple[Array, Array]:
        n = right.shape[0]
        directions = jnp.eye(n, dtype=right.dtype).reshape(n, n, *(1,) * (right.ndim - 1))
        columns = jax.vmap(lambda e: linear(jnp.broadcast_to(e, right.shape)))(directions)
        given = (columns, right, inertia) if soft is None else (columns, right, inertia, soft)
        one = functools.partial(_solve, yields=yields)
        return per_world(one, right.ndim - 1)(*given)

    def newton(residual: Linear, guess: Array) -> tuple[Array, tuple[Array, Array]]:
        def improve(
            carry: tuple[Array, Array, Array], yields: Array
        ) -> tuple[tuple[Array, Array, Array], None]:
            x, last, singular = carry
            with derivatives.taken(True):
                value, linear = jax.linearize(residual, x)
            if soft is not None:
                value = value.at[len(inertia) :].add(yields * soft * equations.split(x)[1])
            correction, dependent = solve(linear, value, yields)
            # near a singular position the `CLOSING` iterations still move q while they undo R
            last = correction if soft is None else jnp.where(yields > 0, correction, last)
            return (x - correction, last, singular | dependent), None

        start = guess, jnp.zeros_like(guess), jnp.zeros(guess.shape[1:], bool)
        yields = np.arange(iterations) < max(iterations - CLOSING, 1)
        flags = None if soft is None else jnp.asarray(yields, guess.dtype)
        (x, last, singular), _ = jax.lax.scan(improve, start, flags, length=iterations)
        moved = jnp.abs(equations.split(last)[0]) * equations.scheme.reach
        # `custom_root` differentiates auxiliary results, which must be real numbers
        return x, (jnp.max(moved, axis=0, initial=0), singular.astype(x.dtype))

    if derivatives.may_be_taken():
        x, (moved, singular) = jax.lax.custom_root(
            equations, equations.guess, newton, lambda g, y: solve(g, y)[0], has_aux=True
        )
    else:
        x, (moved, singular) = newton(equations, equations.guess)
    return x, moved, singular > 0


def _solve(
    columns: Array,
    right: Array,
    inertia: Array,
    soft: Array | None = None,
    yields: Array | None = None,
) -> tuple[Array, Array]:
    """Solves K x = r in one world; returns x, and True if K is singular.

    If `yields` is 1, K + R takes the place of K. Otherwise K x = r is solved by `ROUNDS` proximal
    rounds with the factors of K + R. Both sides of the matrix are scaled. The scale of a velocity
    is 1/√K_ii. The scale of a constraint row is the inverse of the row's length in that scale.

    Args:
        columns: the matrix K by columns, (column, row).
        right: the right-hand side r, (n_v + n_c,).
        inertia: diagonal of M, (n_v,).
        soft: diagonal of R, (n_c,); None for zero.
        yields: 1 to add R to K, else 0; None for 0.
    """
    n = len(inertia)
    diagonal = jnp.maximum(jnp.abs(jnp.diagonal(columns)[:n]), inertia)
    weight = (1 / diagonal) @ columns[:n, n:] ** 2 + jnp.abs(jnp.diagonal(columns)[n:])
    size = jnp.concatenate([diagonal, jnp.where(weight > 0, weight, 1)])
    k, added = columns.T, None
    if soft is not None:
        added = jnp.append(jnp.zeros_like(inertia), soft)
        if yields is not None:
            k, added = k + jnp.diag(yields * added), (1 - yields) * added
    factors = lu.factor(k, 1 / jnp.sqrt(size), added, 1 if soft is None else ROUNDS)
    return factors.solve(right), factors.singular
