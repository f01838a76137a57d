"""Inverse and products of small dense matrices (n, n, …) with trailing batch axes."""

import functools

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array

Index = int | Array

UNROLLED = 4
"""The largest number of rows n for which the elimination is unrolled."""
LARGE, BLOCK = 48, 4
"""LARGE is the smallest number of rows n for which rows are eliminated in blocks of BLOCK rows.
A matrix of this size exceeds the fastest cache: memory traffic costs more than arithmetic."""


def inverse(matrix: Array) -> Array:
    """Returns A⁻¹ (n, n, …) by Gauss–Jordan elimination in place, without pivoting.

    All leading principal blocks of A must be regular. Positive definite matrices satisfy this, even
    after complementarity conditions have added their diagonal blocks.
    """
    n = len(matrix)
    place = jnp.arange(n).reshape(-1, *(1,) * (matrix.ndim - 2))

    def exchange(rows: Array, i: Index, k: Index) -> Array:
        """Solves equation k of A x = b for x_k, so that x_k and b_k exchange places.

        Args:
            rows: the rows of A to update; they include row k.
            i: the position of row k in `rows`.
            k: the number of the equation.

        Returns:
            The updated rows.
        """
        row, column, here = at(rows, i), at(rows, k, 1), place == k
        pivot = 1 / at(row, k)
        scaled = jnp.where(here, pivot[None], row * pivot[None])
        return put(jnp.where(here[None], 0, rows) - column[:, None] * scaled[None], scaled, i)

    def exchange_block(matrix: Array, first: Index, count: int) -> Array:
        """Solves equations of A x = b for x_k, so that x_k and b_k exchange places.

        Args:
            matrix: A.
            first: the first of the equations k.
            count: the number of consecutive equations.

        Returns:
            The matrix of the system after all exchanges.
        """
        rows = jax.lax.dynamic_slice_in_dim(matrix, first, count, 0)
        # a loop, because XLA would recompute unrolled code for every row of the matrix
        rows = jax.lax.fori_loop(0, count, lambda i, a: exchange(a, i, first + i), rows)
        rest = jnp.where((place >= first) & (place < first + count), 0, matrix)
        for i in range(count):
            rest = rest - at(matrix, first + i, 1)[:, None] * rows[i][None]
        return jax.lax.dynamic_update_slice_in_dim(rest, rows, first, 0)

    if n <= UNROLLED:
        return functools.reduce(lambda a, k: exchange(a, k, k), range(n), matrix)
    if n < LARGE:
        return jax.lax.fori_loop(0, n, lambda k, a: exchange(a, k, k), matrix)
    blocks, rest = divmod(n, BLOCK)
    matrix = jax.lax.fori_loop(0, blocks, lambda k, a: exchange_block(a, k * BLOCK, BLOCK), matrix)
    return exchange_block(matrix, n - rest, rest) if rest else matrix


def at(x: Array, i: Index, axis: int = 0) -> Array:
    """Returns entry i of an array along an axis; i may be traced."""
    if isinstance(i, int):
        return jax.lax.index_in_dim(x, i, axis, keepdims=False)
    return jax.lax.dynamic_index_in_dim(x, i, axis, keepdims=False)


def put(x: Array, value: Array, i: Index) -> Array:
    """Returns the array x with entry i along the first axis replaced by a value."""
    # XLA updates x in place here, but copies x for `x.at[i].set(value)`
    return jax.lax.dynamic_update_index_in_dim(x, value, i, 0)


def apply(matrix: Array, x: Array) -> Array:
    """Returns the product A x, (n, …), of a matrix and a vector."""
    return jnp.sum(matrix * x[None], axis=1)


def identity(like: Array) -> Array:
    """Returns the identity matrix, (n, n, 1, …), with an axis of size 1 per batch axis of `like`.

    Args:
        like: an array (n, …) with the batch axes and the dtype.
    """
    n = len(like)
    return jnp.eye(n, dtype=like.dtype).reshape(n, n, *(1,) * (like.ndim - 1))


def diagonal(matrix: Array) -> Array:
    """Returns the diagonal (n, …) of a matrix (n, n, …)."""
    return matrix.reshape(-1, *matrix.shape[2:])[:: len(matrix) + 1]
