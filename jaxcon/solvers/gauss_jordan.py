"""Small dense matrices of many worlds, by lanes, and their inverse."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array

UNROLLED = 4
"""Up to so many rows there is no loop."""
LARGE, BLOCK = 48, 4
"""From so many rows on, so many are eliminated at once: reading and writing the matrix, which
leaves the fastest cache, then costs more than their order."""


def inverse(matrix: Array) -> Array:
    """A⁻¹ (n, n, …) by Gauss–Jordan elimination in place, by blocks, without pivoting.

    For matrices whose leading blocks are regular, such as a positive definite one and what
    complementarity adds to its diagonal blocks.
    """
    n = len(matrix)
    if n <= UNROLLED:
        for k in range(n):
            matrix = _exchanged(matrix, k, k)
        return matrix
    if n < LARGE:
        return jax.lax.fori_loop(0, n, lambda k, a: _exchanged(a, k, k), matrix)
    whole, rest = divmod(n, BLOCK)
    matrix = jax.lax.fori_loop(0, whole, lambda k, a: _eliminated(a, k * BLOCK, BLOCK), matrix)
    return _eliminated(matrix, n - rest, rest) if rest else matrix


def _eliminated(matrix: Array, first: Any, count: int) -> Array:
    """The matrix with x and b of A x = b exchanged in some rows."""
    rows = jax.lax.dynamic_slice_in_dim(matrix, first, count, 0)
    # a loop, whose result XLA does not compute again for every row of the matrix
    rows = jax.lax.fori_loop(0, count, lambda i, a: _exchanged(a, i, first + i), rows)
    place = _places(matrix)
    rest = jnp.where((place >= first) & (place < first + count), 0, matrix)
    for i in range(count):
        rest = rest - at(matrix, first + i, 1)[:, None] * rows[i][None]
    return jax.lax.dynamic_update_slice_in_dim(rest, rows, first, 0)


def _exchanged(rows: Array, i: Any, k: Any) -> Array:
    """Some rows of A with x and b exchanged in one of them, the i-th here and the k-th of A."""
    row, column, here = at(rows, i), at(rows, k, 1), _places(rows) == k
    pivot = 1 / at(row, k)
    scaled = jnp.where(here, pivot[None], row * pivot[None])
    rest = jnp.where(here[None], 0, rows) - column[:, None] * scaled[None]
    return put(rest, scaled, i)


def _places(rows: Array) -> Array:
    """Numbers of the columns, (n, …)."""
    return jnp.arange(rows.shape[1]).reshape(-1, *(1,) * (rows.ndim - 2))


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
    """Returns the diagonal of a matrix (n, n, …), (n, …)."""
    n = len(matrix)
    return matrix.reshape(n * n, *matrix.shape[2:])[:: n + 1]
