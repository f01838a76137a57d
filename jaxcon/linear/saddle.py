"""The saddle system of the constrained accelerations, as solvers receive it: matrices only.

[ M  −Jᵀ ] [a]   [f]
[ J   C  ] [λ] = [b]
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.linear.jacobian import Jacobian
from jaxcon.staging.worlds import per_world


@pytree
class Diagonal:
    """A diagonal mass matrix M.

    Attributes:
        values: the diagonal entries, (n_v,).
    """

    values: Array

    def solve(self, x: Array) -> Array:
        """Returns M⁻¹ x, (n_v,); NaN where a mass is infinite."""
        # 0 for an infinite mass would silently fix a body that no constraint fixes
        return x * (1 / finite_or_nan(self.values))

    def solve_columns(self, x: Array) -> Array:
        """Returns M⁻¹ X for k columns X, (n_v, k); NaN where a mass is infinite."""
        return x * (1 / finite_or_nan(self.values))[:, None]

    def apply(self, x: Array) -> Array:
        """Returns M x, (n_v,)."""
        return self.values * x

    def dense(self) -> Array:
        """Returns M as a dense matrix, (n_v, n_v)."""
        return jnp.diag(self.values)

    @property
    def diagonal(self) -> Array:
        """The diagonal of M, (n_v,)."""
        return self.values

    @property
    def singular(self) -> Array:
        """True if a diagonal entry is finite and not positive, ()."""
        return jnp.any(jnp.isfinite(self.values) & (self.values <= 0), axis=0)


@pytree
class Full:
    """A full, symmetric positive definite mass matrix M.

    Attributes:
        values: the matrix, (n_v, n_v).
    """

    values: Array

    @property
    def factor(self) -> Array:
        """The Cholesky factor of M, without derivative; NaN if M is not positive definite."""
        return jnp.linalg.cholesky(jax.lax.stop_gradient(self.values), symmetrize_input=False)

    @property
    def singular(self) -> Array:
        """True if M is finite and not positive definite, ()."""
        return jnp.all(jnp.isfinite(self.values)) & ~jnp.all(jnp.isfinite(self.factor))

    def solve(self, x: Array) -> Array:
        """Returns M⁻¹ x, (n_v,); NaN if M is not positive definite."""
        return self.solve_columns(x[:, None])[:, 0]

    def solve_columns(self, x: Array) -> Array:
        """Returns M⁻¹ X for k columns X, (n_v, k); NaN if M is not positive definite."""
        factor = self.factor
        return jax.lax.custom_linear_solve(
            lambda y: self.values @ y,
            x,
            lambda _, y: jax.scipy.linalg.cho_solve((factor, True), y),
            symmetric=True,
        )

    def apply(self, x: Array) -> Array:
        """Returns M x, (n_v,)."""
        return self.values @ x

    def dense(self) -> Array:
        """Returns M as a dense matrix, (n_v, n_v)."""
        return self.values

    @property
    def diagonal(self) -> Array:
        """The diagonal entries of M, (n_v,)."""
        return jnp.diagonal(self.values)


Mass = Diagonal | Full


@pytree
class Saddle:
    """The saddle system M a = f + Jᵀλ, J a + C λ = b, for accelerations a and multipliers λ.

    Attributes:
        mass: the mass matrix M, (n_v, n_v).
        force: the generalized forces f, (n_v,) [N, N m].
        jacobian: the constraint Jacobian J, (n_c, n_v).
        target: the target b of the constraint rows, (n_c,).
        compliance: the diagonal of C, (n_c,); None if C is zero.
        noise: the rounding error of b, () or (n_c,); None if it is not known.
        loops: True if closed loops may make rows dependent. False if the structure makes all rows
            independent, as in a tree of joints.
        layout: an object with the `names` of the constraints and their `rows(name)`, for solvers
            that treat constraints differently; None if rows have no names.
        has_columns: True if f and b have an axis of right-hand sides after their first axis; see
            `add_rhs_axis`.
    """

    mass: Mass
    force: Array
    jacobian: Jacobian
    target: Array
    compliance: Array | None = None
    noise: Any = None
    loops: bool = static(default=True)
    layout: Any = static(default=None)
    has_columns: bool = static(default=False)


@exportable
class Solution(NamedTuple):
    """The result of a solver; unpacks as `a, λ, status`.

    Attributes:
        acceleration: the accelerations a, (n_v,).
        multipliers: the constraint multipliers λ, (n_c,).
        status: the `Status` code, ().
    """

    acceleration: Array
    multipliers: Array
    status: Array


Factored = Callable[[Array, Array], Solution]
"""A function (f, b) → `Solution` that solves a factored system with fixed M, J and C."""


def free_motion(system: Saddle) -> Factored:
    """Returns a function (f, b) → `Solution` that computes a = M⁻¹ f, without constraints.

    Args:
        system: the saddle system, of which only M is used.
    """

    def solve(force: Array, target: Array) -> Solution:
        acceleration = system.mass.solve(force)
        status = judge(acceleration, system.mass.singular)
        return Solution(acceleration, jnp.zeros_like(target), status)

    return solve


def factor_per_world(
    factor: Callable[..., Any], solve: Callable[..., Solution], system: Saddle, *args: Any
) -> Factored:
    """Factors a batch of saddle systems by functions that are written for one world.

    Args:
        factor: (system, *args) → the factorization, a pytree.
        solve: (factorization, f, b) → `Solution`.
        system: the saddle system of a batch of worlds.
        args: further arguments of `factor`, each shared by all worlds or with one value per world.

    Returns:
        A function (f, b) → `Solution` of the batch.
    """
    if not system.target.size:
        return free_motion(system)
    rank = system.target.ndim - 1
    factored = per_world(factor, rank)(system, *args)
    return lambda force, target: per_world(solve, rank)(factored, force, target)


def judge(x: Array, singular: Array | None = None) -> Array:
    """Returns the status of each world: SINGULAR, NON_FINITE or OK.

    A world is NON_FINITE if its solution has a NaN or infinite entry. SINGULAR takes precedence.

    Args:
        x: the solution, such as a, (n,).
        singular: True where the system is singular, (); None for nowhere.
    """
    status = jnp.where(jnp.all(jnp.isfinite(x), axis=0), Status.OK, Status.NON_FINITE)
    status = status if singular is None else jnp.where(singular, Status.SINGULAR, status)
    return status.astype(jnp.int32)
