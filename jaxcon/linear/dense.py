"""The reference solver: LU decomposition of the whole saddle matrix (chapter 3.2.5, method 1)."""

import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.linear import lu
from jaxcon.linear.saddle import Factored, Saddle, Solution, factor_per_world, judge
from jaxcon.protocols import Solver


@pytree
class Dense(Solver):
    """Solves K (a, λ) = (f, b) with K = [[M, −Jᵀ], [J, C]] by LU with pivoting.

    `Dense` is slow, but needs neither a definite A = J M⁻¹ Jᵀ + C nor an invertible M. All other
    solvers are tested against it. The factored matrix is S K S, with S = diag(1/√M_ii, 1/√A_ii):
    this scale makes pivots of different units comparable. A_ii is computed with the diagonal of M
    only.

    The status is SINGULAR if K is singular to working precision. An indefinite mass matrix is not
    detected as long as K is regular.
    """

    def factor(self, system: Saddle) -> Factored:
        """Factors the saddle matrix K = [[M, −Jᵀ], [J, C]] for repeated solves.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        return factor_per_world(_factor, _solve, system)


def _factor(system: Saddle) -> lu.Factored:
    """Factors the saddle matrix K = [[M, −Jᵀ], [J, C]] of one world."""
    j, mass, c = system.jacobian.dense(), system.mass, system.compliance
    compliance = jnp.zeros(len(j), j.dtype) if c is None else c
    inertia = jnp.where(mass.diagonal > 0, mass.diagonal, 1)
    weight = j**2 @ (1 / inertia)
    weight = weight if c is None else weight + c
    scale = 1 / jnp.sqrt(jnp.concatenate([inertia, jnp.where(weight > 0, weight, 1)]))
    return lu.factor(jnp.block([[mass.dense(), -j.T], [j, jnp.diag(compliance)]]), scale)


def _solve(factored: lu.Factored, force: Array, target: Array) -> Solution:
    """Solves K (a, λ) = (f, b) of one world, for a factored saddle matrix K."""
    solution, n = factored.solve(jnp.concatenate([force, target])), len(force)
    return Solution(solution[:n], solution[n:], judge(solution, factored.singular))
