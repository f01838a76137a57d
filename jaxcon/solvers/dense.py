"""The whole saddle matrix, factored as it is (chapter 3.2.5, method 1): the reference."""

import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.core.worlds import per_world
from jaxcon.solvers import lu
from jaxcon.solvers.saddle import Factored, Saddle, Solution, free_motion, judge


@pytree
class Dense:
    """Solves K (a, λ) = (f, b) with K = [[M, −Jᵀ], [J, C]] by LU with pivoting.

    Slow and plain, it needs neither a definite A nor an invertible M alone: the solver that all
    others are held to. K is first scaled to S K S with S = diag(1/√M_ii, 1/√(J M⁻¹ Jᵀ + C)_ii
    approximated by the diagonal of M), so that pivots compare across units.
    """

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status.

        The status is SINGULAR where K is singular to working precision. A mass matrix that is
        not definite goes unnoticed where K is regular.
        """
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size:
            return free_motion(system)
        rank = system.target.ndim - 1
        known = per_world(_factor, rank)(system)
        return lambda force, target: per_world(_solve, rank)(known, force, target)


def _factor(system: Saddle) -> lu.Factored:
    """Factors the matrix of one world."""
    j = system.jacobian.dense()
    return lu.factor(saddle_matrix(system, j), _scale(system, j))


def _solve(known: lu.Factored, force: Array, target: Array) -> Solution:
    """Solves for one world."""
    solution = known.solve(jnp.concatenate([force, target]))
    n = force.shape[0]
    return Solution(solution[:n], solution[n:], judge(solution, known.singular))


def saddle_matrix(system: Saddle, jacobian: Array) -> Array:
    """K = [[M, −Jᵀ], [J, C]], (n_v + n_c, n_v + n_c)."""
    n_c = jacobian.shape[0]
    compliance = jnp.zeros(n_c, jacobian.dtype) if system.compliance is None else system.compliance
    upper = jnp.concatenate([system.mass.dense(), -jacobian.T], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([jacobian, jnp.diag(compliance)], axis=1)])


def _scale(system: Saddle, jacobian: Array) -> Array:
    inertia = system.mass.diagonal
    inertia = jnp.where(inertia > 0, inertia, 1)
    weight = jacobian**2 @ (1 / inertia)
    weight = weight if system.compliance is None else weight + system.compliance
    return 1 / jnp.sqrt(jnp.concatenate([inertia, jnp.where(weight > 0, weight, 1)]))
