"""Small dense matrices by lanes: blocks of a sparse factorization in unrolled scalar formulas.

A matrix is a list of rows of lanes; of a symmetric one and of its factor, the rows of the lower
triangle.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import minus, plus, times, total
from jaxcon.core.typing import Lane

Block = list[list[Lane]]


def freeze(x: Any) -> Any:
    """Returns the values, constant under differentiation."""

    def one(leaf: Any) -> Any:
        return jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf

    return jax.tree.map(one, x)


def ldl(a: Block, least: list[Lane] | None = None) -> Block:
    """A = L D Lᵀ from the lower triangle of A: L below the diagonal, and D⁻¹ on it.

    A row whose pivot is not above the least one, if given, is left out: its D⁻¹ is 0.
    """
    factor: Block = []
    for j, row in enumerate(a):
        own: list[Lane] = []  # L_jk D_k, then L_jk
        for k in range(j):
            own.append(minus(row[k], total(map(times, factor[k][:k], own))))
        lower = [times(x, factor[k][k]) for k, x in enumerate(own)]
        pivot = minus(row[j], total(map(times, lower, own)))
        factor.append([*lower, 1 / pivot if least is None else _inverse(pivot, least[j])])
    return factor


def _inverse(pivot: Lane, least: Lane) -> Lane:
    """1 / d where d is above the least pivot, else 0."""
    above = pivot > least
    return jnp.where(above, 1 / jnp.where(above, pivot, 1), 0)


def forward(factor: Block, b: list[Lane]) -> list[Lane]:
    """L⁻¹ b."""
    y: list[Lane] = []
    for row, value in zip(factor, b, strict=True):
        y.append(minus(value, total(times(x, z) for x, z in zip(row, y, strict=False))))
    return y


def backward(factor: Block, y: list[Lane]) -> list[Lane]:
    """L⁻ᵀ y."""
    n = len(y)
    x = list(y)
    for i in reversed(range(n)):
        x[i] = minus(x[i], total(times(factor[k][i], x[k]) for k in range(i + 1, n)))
    return x


def scale(factor: Block, y: list[Lane]) -> list[Lane]:
    """D⁻¹ y."""
    return [times(value, row[-1]) for value, row in zip(y, factor, strict=True)]


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
    """The lower triangle of A Bᵀ."""
    return [[total(map(times, row, b[c])) for c in range(r + 1)] for r, row in enumerate(a)]


def add(a: Block, b: Block) -> Block:
    """A + B."""
    return [[plus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def subtract(a: Block, b: Block) -> Block:
    """A − B."""
    return [[minus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]
