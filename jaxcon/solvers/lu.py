"""A square matrix by LU with pivoting, scaled and refined; small, dense, of one world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array


@pytree
class Factored:
    """S K S = P L U.

    Attributes:
        scale: the diagonal of S, (n,), constant under differentiation.
        matrix: S K S, (n, n).
        factor: L and U, and the pivots.
        singular: whether a pivot vanishes to working precision, ().
    """

    scale: Array
    matrix: Array
    factor: tuple[Array, Array]
    singular: Array

    def solve(self, right: Array) -> Array:
        """K⁻¹ b, (n,); differentiated implicitly."""
        return self.scale * jax.lax.custom_linear_solve(
            lambda x: self.matrix @ x,
            self.scale * right,
            lambda multiply, x: _refined(multiply, self.factor, 0, x),
            lambda multiply, x: _refined(multiply, self.factor, 1, x),
        )


def factor(matrix: Array, scale: Array) -> Factored:
    """K, scaled on both sides, so that pivots compare across units.

    Args:
        matrix: K, (n, n).
        scale: the diagonal of S, (n,).
    """
    scale = jax.lax.stop_gradient(scale)
    scaled = matrix * scale[None] * scale[:, None]
    known = jax.scipy.linalg.lu_factor(jax.lax.stop_gradient(scaled))
    pivots = jnp.abs(jnp.diagonal(known[0]))
    singular = ~jnp.all(pivots > len(scale) * jnp.finfo(matrix.dtype).eps)
    return Factored(scale, scaled, known, singular & jnp.all(jnp.isfinite(scaled)))


def _refined(multiply: Callable[[Array], Array], known: Any, trans: int, right: Array) -> Array:
    """The solution after one step of refinement.

    Of the two it is the one whose error is small in each entry beside its own size, so that a light
    body that moves with a heavy rotor has the right acceleration.

    References:
        Skeel, Iterative refinement implies numerical stability for Gaussian elimination (1980).
    """
    x = jax.scipy.linalg.lu_solve(known, right, trans=trans)
    return x + jax.scipy.linalg.lu_solve(known, right - multiply(x), trans=trans)
