"""A solver by the dense Schur complement A = J M⁻¹ Jᵀ + C (chapter 3.2.5, method 2)."""

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear.saddle import Factored, Mass, Saddle, Solution, factor_per_world, judge
from jaxcon.protocols import Solver


@pytree
class Schur(checks.Checked, Solver):
    """Solves M a = f + Jᵀλ, J a + C λ = b through A = J M⁻¹ Jᵀ + C (the Delassus operator).

    Eliminating a = M⁻¹(f + Jᵀλ) from the second equation leaves A λ = b − J M⁻¹ f. A is symmetric,
    and positive definite if the rows are independent; it is factored by Cholesky.

    The solution is differentiated implicitly, not through the factorization. With r = b − J M⁻¹ f,
    dλ = A⁻¹(dr − dA λ) reuses the factor, in forward and in reverse mode.

    The status is SINGULAR if A or M is not positive definite to working precision.

    Attributes:
        tikhonov: ε of a regularized system (A + ε diag A) λ = b − J M⁻¹ f, or None; see `Sparse`.

    References:
        Featherstone, Rigid Body Dynamics Algorithms (2008), section 8.
    """

    tikhonov: Scalar | None = None

    def check(self) -> None:
        """Checks the regularization ε.

        Raises:
            ValueError: `tikhonov` is negative or no number.
        """
        checks.check("Schur", "tikhonov", self.tikhonov, (), least=0, optional=True)

    def factor(self, system: Saddle) -> Factored:
        """Factors A = J M⁻¹ Jᵀ + C for repeated solves.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        return factor_per_world(_factor, _solve, system, self.tikhonov)


Complement = tuple[Mass, Array, Array, Array, Array]
"""A factored world: M, J, A, the Cholesky factor of A, and True if A or M is singular, ()."""


def _factor(system: Saddle, tikhonov: Scalar | None) -> Complement:
    """Computes and factors the Schur complement A = J M⁻¹ Jᵀ + C of one world.

    Args:
        system: the saddle system.
        tikhonov: ε, to factor A + ε diag A instead; None for no regularization.
    """
    j = system.jacobian.dense()
    a = delassus(system.mass, j, system.compliance)
    rounding = a.shape[0] * float(jnp.finfo(a.dtype).eps) if tikhonov is None else 0.0
    if tikhonov is not None:
        share = jnp.asarray(tikhonov).astype(a.dtype)
        a = a + jnp.diag(jax.lax.stop_gradient(share * jnp.diagonal(a)))
    factor = jnp.linalg.cholesky(jax.lax.stop_gradient(a), symmetrize_input=False)
    # pivot² / A_rr is the share of row r that is independent of earlier rows: 1 if it is orthogonal
    # to them, and at most rounding if it depends on them
    dependent = ~jnp.all(jnp.diagonal(factor) ** 2 / jnp.diagonal(a) > rounding)
    dependent = dependent & jnp.all(jnp.isfinite(a))
    return system.mass, j, a, factor, dependent | system.mass.singular


def _solve(complement: Complement, force: Array, target: Array) -> Solution:
    """Solves A λ = b − J M⁻¹ f and M a = f + Jᵀλ of one world, for a factored A.

    Args:
        complement: the result of `_factor`.
        force: f, (n_v,).
        target: b, (n_c,).
    """
    mass, j, a, factor, singular = complement
    free = mass.solve(force)
    multipliers = jax.lax.custom_linear_solve(
        lambda x: a @ x,
        target - j @ free,
        lambda _, x: jax.scipy.linalg.cho_solve((factor, True), x),
        symmetric=True,
    )
    acceleration = free + mass.solve(j.T @ multipliers)
    return Solution(acceleration, multipliers, judge(acceleration, singular))


def delassus(mass: Mass, jacobian: Array, compliance: Array | None) -> Array:
    """Returns the Delassus matrix A = J M⁻¹ Jᵀ + C, (n_c, n_c), of one world.

    Args:
        mass: M.
        jacobian: J, dense, (n_c, n_v).
        compliance: diagonal of C, (n_c,); None for C = 0.
    """
    a = jacobian @ mass.solve_columns(jacobian.T)
    return a if compliance is None else a + jnp.diag(compliance)
