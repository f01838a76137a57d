"""Small dense matrices of many worlds, by lanes, and their inverse."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array

UNROLLED = 4
"""Up to so many rows there is no loop."""


def inverse(matrix: Array) -> Array:
    """A⁻¹ (n, n, …) by Gauss–Jordan elimination in place, without pivoting.

    For matrices whose leading blocks are regular, such as a positive definite one and what
    complementarity adds to its diagonal blocks.
    """

    def eliminate(k: Any, a: Array) -> Array:
        row, column = a[k], a[:, k]
        pivot = 1 / row[k]
        scaled = (row * pivot[None]).at[k].set(pivot)
        rest = a.at[:, k].set(0) - column[:, None] * scaled[None]
        return rest.at[k].set(scaled)

    n = matrix.shape[0]
    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, eliminate, matrix)
    for k in range(n):
        matrix = eliminate(k, matrix)
    return matrix


def apply(matrix: Array, x: Array) -> Array:
    """A x, (n, …)."""
    return jnp.sum(matrix * x[None], axis=1)


def identity(like: Array) -> Array:
    """The unit matrix (n, n, …) for an array (n, …)."""
    n = len(like)
    return jnp.eye(n, dtype=like.dtype).reshape(n, n, *(1,) * (like.ndim - 1))


def diagonal(matrix: Array) -> Array:
    """Of a matrix (n, n, …), (n, …)."""
    n = len(matrix)
    return matrix.reshape(n * n, *matrix.shape[2:])[:: n + 1]
