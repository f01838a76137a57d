"""The equations of an implicit step, whose positions satisfy the constraints, and their root.

Divided by κβh² and κγh, κ = ∂a⁺/∂v̇⁺, what φ and ψ demand is an acceleration, and Newton's matrix
is that of a saddle system whatever h,

    [ M − κγh ∂f/∂v − κβh² ∂(f + Jᵀλ)/∂q   −Jᵀ ]
    [ J                                      C ],

the geometric stiffness of the constraint forces included.

References:
    Bottasso, Dopico, Trainelli, On the optimal scaling of index three DAEs in multibody dynamics,
    Multibody System Dynamics 19 (2008).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.core.worlds import per_world
from jaxcon.dynamics.forward import Dynamics
from jaxcon.model.state import State
from jaxcon.solvers import lu


@pytree
class History:
    """What a step leaves to the next one; nothing yet before the first.

    Attributes:
        acceleration: v̇, (n_v,).
        average: a, which is v̇ a little later or earlier, to second order, (n_v,).
        multipliers: λ, (n_c,), from which the next ones are sought.
        started: whether these were found, ().
    """

    acceleration: Array
    average: Array
    multipliers: Array
    started: Array


class Scheme(NamedTuple):
    """The coefficients of a step of length h, numbers with an axis in front, (1, …)."""

    alpha_m: Any
    alpha_f: Any
    beta: Any
    gamma: Any
    dt: Any

    @classmethod
    def of(cls, rho: Any, dt: Any) -> Scheme:
        """Returns the scheme that damps the highest frequencies by ρ a step, and low ones least.

        References:
            Chung, Hulbert, A time integration algorithm for structural dynamics with improved
            numerical dissipation: the generalized-α method, J. Applied Mechanics 60 (1993).
        """
        alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 0.5 + alpha_f - alpha_m
        return cls(alpha_m, alpha_f, 0.25 * (gamma + 0.5) ** 2, gamma, dt)

    @property
    def share(self) -> Any:
        """κ = ∂a⁺/∂v̇⁺."""
        return (1 - self.alpha_f) / (1 - self.alpha_m)

    @property
    def reach(self) -> Any:
        """∂(q⁺ − q)/∂v̇⁺ = κβh² [s²]."""
        return self.share * self.beta * self.dt**2

    @property
    def push(self) -> Any:
        """∂v⁺/∂v̇⁺ = κγh [s]."""
        return self.share * self.gamma * self.dt


class Equations:
    """r(x) = 0 of one step, x = (v̇⁺, λ⁺), each row an acceleration or a force.

    Attributes:
        guess: where x is sought: what it was a step ago.
        scheme: the coefficients.
        inertia: the diagonal of M at the start, (n_v,).
        weights: 1/κβh² and 1/κγh.
        soft: ε W, (n_c,), by which Newton's matrix is regularized; None where it is not.
    """

    def __init__(
        self, dynamics: Dynamics, state: State, known: History, scheme: Scheme, soft: Array | None
    ) -> None:
        self.dynamics, self.state, self.known = dynamics, state, known
        self.scheme, self.soft = scheme, soft
        # made before the root, see `roots.implicit`
        self.weights = 1 / scheme.reach, 1 / scheme.push
        self.time = state.instant + dynamics.dt
        self.guess = jnp.concatenate([known.acceleration, known.multipliers])
        self.inertia = dynamics.system.mass(state.q).diagonal

    def split(self, x: Array) -> tuple[Array, Array]:
        """v̇⁺ and λ⁺."""
        n = self.state.v.shape[0]
        return x[:n], x[n:]

    def end(self, acceleration: Array) -> tuple[Array, Array, Array]:
        """a⁺, q⁺ and v⁺."""
        s, known, state = self.scheme, self.known, self.state
        lag = s.alpha_f * known.acceleration - s.alpha_m * known.average
        a = s.share * acceleration + lag / (1 - s.alpha_m)
        step = s.dt * (state.v + s.dt * ((0.5 - s.beta) * known.average + s.beta * a))
        v = state.v + s.dt * ((1 - s.gamma) * known.average + s.gamma * a)
        return a, self.dynamics.system.retract(state.q, step), v

    def __call__(self, x: Array) -> Array:
        """r(x), (n_v + n_c,)."""
        own, (acceleration, multipliers) = self.dynamics, self.split(x)
        _, q, v = self.end(acceleration)
        rows = linearize(own.system, q, v, self.time)
        pull = own.system.force(q, v, self.time, own.control) + rows.jacobian.transpose(multipliers)
        balance = own.system.mass(q).apply(acceleration) - pull
        return jnp.concatenate([balance, self.closed(rows, acceleration, multipliers)])

    def closed(self, rows: Rows, acceleration: Array, multipliers: Array) -> Array:
        """φ/κβh², ψ/κγh, or J v̇⁺ + C λ⁺ + γ where there is compliance, (n_c,)."""
        holonomic = rows.layout.holonomic.reshape(-1, *(1,) * (multipliers.ndim - 1))
        positions, velocities = self.weights
        hard = jnp.where(holonomic, rows.residual * positions, rows.rate * velocities)
        if rows.compliance is None:
            return hard
        soft = rows.jacobian.apply(acceleration) + rows.compliance * multipliers + rows.bias
        return jnp.where(rows.compliance > 0, soft, hard)


CLOSING = 2
"""Newton's iterations that take out what regularization did; all but the first, at most."""

ROUNDS = 4
"""Rounds of refinement against it in each."""


def root(equations: Equations, iterations: int) -> tuple[Array, Array, Array]:
    """x with r(x) = 0 by Newton's method; the derivative is that of the root.

    Where rows may depend on each other K is singular, and K + R is factored, R = ε W on the rows of
    constraints. First r(x) + R λ = 0 is solved, whose λ is unique: of all that fit it is the least,
    whatever the guess was, and φ gives way by κβh² R λ. From there the last iterations go on to
    r(x) = 0 by proximal rounds, see `lu.factor`: of what a direction with the eigenvalue σ of the
    scaled J M⁻¹ Jᵀ lacks, each round leaves the share ε/(σ + ε), and where σ = 0 it adds nothing
    but rounding. Derivatives are those of r(x) = 0, by the same rounds.

    Returns:
        x (n_v + n_c,), by how much the last correction moved q, the last iterations left out, (),
        and whether a matrix was singular, ().
    """
    inertia, soft = jax.lax.stop_gradient((equations.inertia, equations.soft))

    def solve(linear: Any, right: Array, yields: Any = None) -> tuple[Array, Array]:
        columns = matrix(linear, right)
        given = (columns, right, inertia) if soft is None else (columns, right, inertia, soft)
        one = functools.partial(_solve, yields=yields)
        return per_world(one, right.ndim - 1)(*given)

    def newton(residual: Any, guess: Array) -> tuple[Array, tuple[Array, Array]]:
        def improve(known: Any, yields: Any) -> tuple[Any, None]:
            x, last, singular = known
            value, linear = jax.linearize(residual, x)
            if soft is not None:
                value = value.at[len(inertia) :].add(yields * soft * equations.split(x)[1])
            correction, dependent = solve(linear, value, yields)
            # near a singular position the last ones go on to move q, by what regularization did
            last = correction if soft is None else jnp.where(yields > 0, correction, last)
            return (x - correction, last, singular | dependent), None

        start = guess, jnp.zeros_like(guess), jnp.zeros(guess.shape[1:], bool)
        yields = np.arange(iterations) < max(iterations - CLOSING, 1)
        flags = None if soft is None else jnp.asarray(yields, guess.dtype)
        (x, last, singular), _ = jax.lax.scan(improve, start, flags, length=iterations)
        moved = jnp.abs(equations.split(last)[0]) * equations.scheme.reach
        # the derivative of a root passes on real numbers only
        return x, (jnp.max(moved, axis=0, initial=0), singular.astype(x.dtype))

    x, (moved, singular) = jax.lax.custom_root(
        equations, equations.guess, newton, lambda g, y: solve(g, y)[0], has_aux=True
    )
    return x, moved, singular > 0


def matrix(linear: Any, like: Array) -> Array:
    """A linear map of arrays (n, …) by its columns, (column, row, …)."""
    n = like.shape[0]
    directions = jnp.eye(n, dtype=like.dtype).reshape(n, n, *(1,) * (like.ndim - 1))
    return jax.vmap(lambda e: linear(jnp.broadcast_to(e, like.shape)))(directions)


def _solve(
    columns: Array, right: Array, inertia: Array, soft: Array | None = None, yields: Any = None
) -> tuple[Array, Array]:
    """K⁻¹ r, and whether K is singular, of one world; with R as a part of K where `yields` is 1.

    Rows of velocities are scaled by 1/√K_ii, rows of constraints by their length so measured.
    """
    n = len(inertia)
    own = jnp.maximum(jnp.abs(jnp.diagonal(columns)[:n]), inertia)
    weight = (1 / own) @ columns[:n, n:] ** 2 + jnp.abs(jnp.diagonal(columns)[n:])
    size = jnp.concatenate([own, jnp.where(weight > 0, weight, 1)])
    scale = 1 / jnp.sqrt(size)
    k, added = columns.T, None
    if soft is not None:
        added = jnp.append(jnp.zeros_like(inertia), soft)
        if yields is not None:
            k, added = k + jnp.diag(yields * added), (1 - yields) * added
    known = lu.factor(k, scale, added, 1 if soft is None else ROUNDS)
    return known.solve(right), known.singular
