"""A square matrix by LU with pivoting, scaled and refined; small, dense, of one world."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array


@pytree
class Factored:
    """S K S = P L U.

    Attributes:
        scale: the diagonal of S, (n,), constant under differentiation.
        matrix: S K S, (n, n).
        factor: L and U, and the pivots; of a matrix near S K S where K is regularized.
        singular: whether a pivot vanishes to working precision, ().
        rounds: of refinement.
    """

    scale: Array
    matrix: Array
    factor: tuple[Array, Array]
    singular: Array
    rounds: int = static(default=1)

    def solve(self, right: Array) -> Array:
        """K⁻¹ b, (n,); differentiated implicitly."""
        return self.scale * jax.lax.custom_linear_solve(
            lambda x: self.matrix @ x,
            self.scale * right,
            lambda multiply, x: self._refined(multiply, 0, x),
            lambda multiply, x: self._refined(multiply, 1, x),
        )

    def _refined(self, multiply: Callable[[Array], Array], trans: int, right: Array) -> Array:
        """The solution after some rounds of refinement.

        After one its error is small in each entry beside its own size, so that a light body that
        moves with a heavy rotor has the right acceleration.

        References:
            Skeel, Iterative refinement implies numerical stability for Gaussian elimination (1980).
        """
        x = jax.scipy.linalg.lu_solve(self.factor, right, trans=trans)
        for _ in range(self.rounds):
            x = x + jax.scipy.linalg.lu_solve(self.factor, right - multiply(x), trans=trans)
        return x


def factor(
    matrix: Array, scale: Array, regularization: Array | None = None, rounds: int = 1
) -> Factored:
    """K, scaled on both sides, so that pivots compare across units.

    Where K may be singular, K + R is factored in its place, R diagonal. Refinement then is the
    proximal iteration x ← x + (K + R)⁻¹ (b − K x): what a direction of K lacks falls by its share
    of R in K + R in each round, and a direction that K does not have stays zero but for rounding.

    Args:
        matrix: K, (n, n).
        scale: the diagonal of S, (n,).
        regularization: the diagonal of R, (n,); None for none.
        rounds: of refinement.
    """
    scale = jax.lax.stop_gradient(scale)
    scaled = matrix * scale[None] * scale[:, None]
    regular = scaled if regularization is None else scaled + jnp.diag(regularization * scale**2)
    known = jax.scipy.linalg.lu_factor(jax.lax.stop_gradient(regular))
    pivots = jnp.abs(jnp.diagonal(known[0]))
    singular = ~jnp.all(pivots > len(scale) * jnp.finfo(matrix.dtype).eps)
    return Factored(scale, scaled, known, singular & jnp.all(jnp.isfinite(scaled)), rounds)
