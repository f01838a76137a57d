"""The whole saddle matrix, factored as it is (chapter 3.2.5, method 1): the reference."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import native
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
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
        known = native.per_world(_factor, rank)(system)
        return lambda force, target: native.per_world(_solve, rank)(known, force, target)


@pytree
class Whole:
    """S K S = P L U, of one world."""

    scale: Array
    matrix: Array
    factor: tuple[Array, Array]
    singular: Array


def _factor(system: Saddle) -> Whole:
    """Of one world."""
    j = system.jacobian.dense()
    scale = jax.lax.stop_gradient(_scale(system, j))
    matrix = saddle_matrix(system, j) * scale[None] * scale[:, None]
    factor = jax.scipy.linalg.lu_factor(jax.lax.stop_gradient(matrix))
    pivots = jnp.abs(jnp.diagonal(factor[0]))
    singular = ~jnp.all(pivots > matrix.shape[0] * jnp.finfo(matrix.dtype).eps)
    return Whole(scale, matrix, factor, singular & jnp.all(jnp.isfinite(matrix)))


def _solve(known: Whole, force: Array, target: Array) -> Solution:
    """Of one world."""
    right = jnp.concatenate([force, target]) * known.scale
    solution = known.scale * jax.lax.custom_linear_solve(
        lambda x: known.matrix @ x,
        right,
        lambda multiply, x: _refined(multiply, known.factor, 0, x),
        lambda multiply, x: _refined(multiply, known.factor, 1, x),
    )
    n = force.shape[0]
    return Solution(solution[:n], solution[n:], judge(solution, known.singular))


def _refined(multiply: Callable[[Array], Array], factor: Any, trans: int, right: Array) -> Array:
    """The solution after one step of refinement.

    Of the two it is the one whose error is small in each entry beside its own size, so that a light
    body that moves with a heavy rotor has the right acceleration.

    References:
        Skeel, Iterative refinement implies numerical stability for Gaussian elimination (1980).
    """
    x = jax.scipy.linalg.lu_solve(factor, right, trans=trans)
    return x + jax.scipy.linalg.lu_solve(factor, right - multiply(x), trans=trans)


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
