"""Small dense matrices as unrolled scalar formulas, for the blocks of a sparse factorization.

A matrix is a list of rows. Each entry is a lane: an array with one value for each of many equal
blocks and for each world. Of a symmetric matrix and of its factor, only the lower triangle is
stored, row by row.
"""

from collections.abc import Iterable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import minus, plus, times, total
from jaxcon.core.typing import Lane

T = TypeVar("T")
Block = list[list[Lane]]
Rows = Sequence[Iterable[Lane]]


def freeze(tree: T) -> T:
    """Stops the gradient of every array in a tree."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, tree)


def ldl(a: Block, least: list[Lane] | None = None) -> Block:
    """Factors A = L D Lᵀ, where L is unit lower triangular and D is diagonal.

    Args:
        a: the lower triangle of a symmetric matrix A.
        least: a bound for each pivot in D; None for no bounds. A row whose pivot is not above its
            bound is left out of the factorization, by setting its D⁻¹ to 0.

    Returns:
        The entries of L below the diagonal, and of D⁻¹ on the diagonal.
    """
    factor: Block = []
    for j, row in enumerate(a):
        scaled: list[Lane] = []  # L_jk D_k
        for k in range(j):
            scaled.append(minus(row[k], total(map(times, factor[k][:k], scaled))))
        lower = [times(x, factor[k][k]) for k, x in enumerate(scaled)]
        pivot = minus(row[j], total(map(times, lower, scaled)))
        if least is None:
            inverse = 1 / pivot
        else:
            above = pivot > least[j]
            inverse = jnp.where(above, 1 / jnp.where(above, pivot, 1), 0)
        factor.append([*lower, inverse])
    return factor


def forward(factor: Block, b: list[Lane]) -> list[Lane]:
    """Returns L⁻¹ b by forward substitution, for the factor L of `ldl` and a vector b."""
    y: list[Lane] = []
    for row, value in zip(factor, b, strict=True):
        y.append(minus(value, total(times(x, z) for x, z in zip(row, y, strict=False))))
    return y


def backward(factor: Block, y: list[Lane]) -> list[Lane]:
    """Returns L⁻ᵀ y by backward substitution, for the factor L of `ldl` and a vector y."""
    x = list(y)
    for i in reversed(range(len(y))):
        x[i] = minus(x[i], total(times(factor[k][i], x[k]) for k in range(i + 1, len(y))))
    return x


def scale(factor: Block, y: list[Lane]) -> list[Lane]:
    """Returns D⁻¹ y, for the diagonal matrix D of pivots from `ldl` and a vector y."""
    return [times(value, row[-1]) for value, row in zip(y, factor, strict=True)]


def transpose(a: Block) -> Block:
    """Returns the transpose Aᵀ."""
    return [list(column) for column in zip(*a, strict=True)]


def apply(a: Block, x: list[Lane]) -> list[Lane]:
    """Returns the product A x of a matrix and a vector."""
    return [total(map(times, row, x)) for row in a]


def product(a: Rows, b: Rows, lower: bool = False) -> Block:
    """Returns A Bᵀ, or only its lower triangle if `lower` is True."""
    return [
        [total(map(times, row, column)) for column in (b[: r + 1] if lower else b)]
        for r, row in enumerate(a)
    ]


def zero(rows: int, columns: int | None = None) -> Block:
    """Returns a zero matrix, or the lower triangle of a square one if `columns` is None."""
    return [[0.0] * (r + 1 if columns is None else columns) for r in range(rows)]


def add(a: Block, b: Block) -> Block:
    """Returns the sum A + B of two matrices."""
    return [[plus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def subtract(a: Block, b: Block) -> Block:
    """Returns the difference A − B of two matrices."""
    return [[minus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]
