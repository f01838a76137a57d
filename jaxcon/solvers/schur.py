"""The Schur complement on the multipliers (chapter 3.2.5, method 2)."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.core.worlds import per_world
from jaxcon.solvers.saddle import Factored, Mass, Saddle, Solution, free_motion, judge


@pytree
class Schur(checks.Checked):
    """Solves M a = f + Jᵀλ, J a + C λ = b through A = J M⁻¹ Jᵀ + C (the Delassus operator).

    Eliminating a = M⁻¹(f + Jᵀλ) from the second row leaves A λ = b − J M⁻¹ f, with A symmetric and
    positive definite where the rows are independent; it is factored by Cholesky.

    The derivative is that of the solution, not of the factorization: dλ = A⁻¹(db − dA λ) reuses
    the factor, in forward and in reverse mode.

    Attributes:
        tikhonov: ε of a regularised system (A + ε diag A) λ = b − J M⁻¹ f, or None; see `Sparse`.

    References:
        Featherstone, Rigid Body Dynamics Algorithms (2008), section 8.
    """

    tikhonov: Any = None

    def check(self) -> None:
        """Checks the regularization.

        Raises:
            ValueError: it is negative or no number.
        """
        checks.check("Schur", "tikhonov", self.tikhonov, (), least=0, optional=True)

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status.

        The status is SINGULAR where A or M is not positive definite to working precision.
        """
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size:
            return free_motion(system)
        rank = system.target.ndim - 1
        known = per_world(_factor, rank)(system, self.tikhonov)
        return lambda force, target: per_world(_solve, rank)(known, force, target)


@pytree
class Complement:
    """A = L Lᵀ and what else a solution needs, of one world."""

    mass: Mass
    jacobian: Array
    delassus: Array
    factor: Array
    singular: Array


def _factor(system: Saddle, tikhonov: Any) -> Complement:
    """Factors the Schur complement of one world."""
    j = system.jacobian.dense()
    a = delassus(system.mass, j, system.compliance)
    if tikhonov is not None:
        share = jnp.asarray(tikhonov).astype(a.dtype)
        a = a + jnp.diag(jax.lax.stop_gradient(share * jnp.diagonal(a)))
    factor = jnp.linalg.cholesky(jax.lax.stop_gradient(a), symmetrize_input=False)
    rounding = 0.0 if tikhonov is not None else a.shape[0] * float(jnp.finfo(a.dtype).eps)
    dependent = _dependent(factor, a, rounding) & jnp.all(jnp.isfinite(a))
    return Complement(system.mass, j, a, factor, dependent | system.mass.singular)


def _solve(known: Complement, force: Array, target: Array) -> Solution:
    """Solves for one world."""
    j, free = known.jacobian, known.mass.solve(force)
    multipliers = jax.lax.custom_linear_solve(
        lambda x: known.delassus @ x,
        target - j @ free,
        lambda _, x: jax.scipy.linalg.cho_solve((known.factor, True), x),
        symmetric=True,
    )
    acceleration = free + known.mass.solve(j.T @ multipliers)
    return Solution(acceleration, multipliers, judge(acceleration, known.singular))


def delassus(mass: Mass, jacobian: Array, compliance: Array | None) -> Array:
    """A = J M⁻¹ Jᵀ + C, (n_c, n_c), from a dense J (n_c, n_v)."""
    a = jacobian @ mass.solve_columns(jacobian.T)
    return a if compliance is None else a + jnp.diag(compliance)


def _dependent(factor: Array, a: Array, rounding: float) -> Array:
    """Returns True where a row is, to round-off, a combination of the rows before it.

    The square of a Cholesky pivot over the diagonal entry is the part of a row that the earlier
    ones do not explain: 1 for an orthogonal row, round-off for a dependent one.
    """
    share = jnp.diagonal(factor) ** 2 / jnp.diagonal(a)
    return ~jnp.all(share > rounding)
