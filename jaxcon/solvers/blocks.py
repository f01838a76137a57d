"""Small dense matrices by lanes: blocks of a sparse factorization in unrolled scalar formulas.

A matrix is a list of rows of lanes. `settle` ends a fusion: XLA would otherwise merge the chain of
a factorization into one kernel for each of its results, and compute shared values again in each.
"""

from __future__ import annotations

from typing import Any

import jax

from jaxcon.core.lanes import plus, times, total
from jaxcon.core.typing import Lane

Block = list[list[Lane]]


def settle(x: Any) -> Any:
    """The same values, computed once and stored."""
    return on_arrays(jax.lax.optimization_barrier, x)


def freeze(x: Any) -> Any:
    """The same values, constant under differentiation."""
    return on_arrays(jax.lax.stop_gradient, x)


def on_arrays(function: Any, x: Any) -> Any:
    """A function of the arrays of a tree; its Python numbers stay known when tracing."""
    leaves, structure = jax.tree.flatten(x)
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]
    results = function([leaves[i] for i in places])
    for i, y in zip(places, results, strict=True):
        leaves[i] = y
    return jax.tree.unflatten(structure, leaves)


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


def ldl_solve(lower: Block, inverse: list[Lane], b: list[Lane]) -> list[Lane]:
    """(L D Lᵀ)⁻¹ b."""
    n = len(b)
    y: list[Lane] = []
    for i in range(n):
        y.append(minus(b[i], total(map(times, lower[i], y))))
    x = [times(value, w) for value, w in zip(y, inverse, strict=True)]
    for i in reversed(range(n)):
        x[i] = minus(x[i], total(times(lower[k][i], x[k]) for k in range(i + 1, n)))
    return x


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


def add(a: Block, b: Block) -> Block:
    """A + B."""
    return [[plus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def subtract(a: Block, b: Block) -> Block:
    """A − B."""
    return [[minus(x, y) for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]
