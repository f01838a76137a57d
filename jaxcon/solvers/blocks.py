"""Small dense matrices by lanes: blocks of a sparse factorization in unrolled scalar formulas.

A matrix is a list of rows of lanes.
"""

from __future__ import annotations

from typing import Any

import jax

from jaxcon.core.lanes import plus, times, total
from jaxcon.core.typing import Lane

Block = list[list[Lane]]


def freeze(x: Any) -> Any:
    """The same values, constant under differentiation."""

    def one(leaf: Any) -> Any:
        return jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf

    return jax.tree.map(one, x)


def minus(x: Lane, y: Lane) -> Lane:
    """x − y."""
    return plus(x, times(-1, y))


def ldl(a: Block) -> tuple[Block, list[Lane]]:
    """A = L D Lᵀ from the lower triangle of A: L strictly below the diagonal, and D⁻¹."""
    n = len(a)
    lower: Block = [[0.0] * n for _ in range(n)]
    pivots: list[Lane] = []
    inverse: list[Lane] = []
    for j in range(n):
        scaled = [times(lower[j][k], pivots[k]) for k in range(j)]
        pivots.append(minus(a[j][j], total(map(times, lower[j], scaled))))
        inverse.append(1 / pivots[j])
        for i in range(j + 1, n):
            rest = minus(a[i][j], total(map(times, lower[i], scaled)))
            lower[i][j] = times(rest, inverse[j])
    return lower, inverse


def forward(lower: Block, b: list[Lane]) -> list[Lane]:
    """L⁻¹ b."""
    y: list[Lane] = []
    for row, value in zip(lower, b, strict=True):
        y.append(minus(value, total(times(x, z) for x, z in zip(row, y, strict=False))))
    return y


def backward(lower: Block, y: list[Lane]) -> list[Lane]:
    """L⁻ᵀ y."""
    n = len(y)
    x = list(y)
    for i in reversed(range(n)):
        x[i] = minus(x[i], total(times(lower[k][i], x[k]) for k in range(i + 1, n)))
    return x


def scale(x: list[Lane], weights: list[Lane]) -> list[Lane]:
    """The products of components."""
    return [times(value, w) for value, w in zip(x, weights, strict=True)]


def transpose(a: Block) -> Block:
    """Aᵀ."""
    return [list(column) for column in zip(*a, strict=True)]


def apply(a: Block, x: list[Lane]) -> list[Lane]:
    """A x."""
    return [total(map(times, row, x)) for row in a]


def product(a: Block, b: Block) -> Block:
    """A B."""
    columns = transpose(b)
    return [[total(map(times, row, column)) for column in columns] for row in a]


def lower_product(a: Block, b: Block) -> Block:
    """The lower triangle of A Bᵀ, zero above it."""
    n = len(a)
    return [[total(map(times, a[r], b[c])) if c <= r else 0.0 for c in range(n)] for r in range(n)]


def add(a: Block, b: Block) -> Block:
    """A + B."""
    return [[plus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def subtract(a: Block, b: Block) -> Block:
    """A − B."""
    return [[minus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]
