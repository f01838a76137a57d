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
    n = matrix.shape[0]
    places = jnp.arange(n).reshape(-1, *(1,) * (matrix.ndim - 2))

    def eliminate(k: Any, a: Array) -> Array:
        row, column, here = at(a, k), at(a, k, 1), places == k
        pivot = 1 / at(row, k)
        scaled = jnp.where(here, pivot[None], row * pivot[None])
        rest = jnp.where(here[None], 0, a) - column[:, None] * scaled[None]
        return jnp.where(here[:, None], scaled[None], rest)

    if n > UNROLLED:
        return jax.lax.fori_loop(0, n, eliminate, matrix)
    for k in range(n):
        matrix = eliminate(k, matrix)
    return matrix


def at(x: Array, i: Any, axis: int = 0) -> Array:
    """The i-th along an axis, i being known when tracing or not."""
    pick = jax.lax.index_in_dim if isinstance(i, int) else jax.lax.dynamic_index_in_dim
    return pick(x, i, axis, keepdims=False)


def put(x: Array, value: Array, i: Any) -> Array:
    """With another i-th entry; a write in place, which `x.at[i].set(value)` is not to XLA."""
    return jax.lax.dynamic_update_index_in_dim(x, value, i, 0)


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
