"""A = J M⁻¹ Jᵀ + C as an operator, and its blocks on the diagonal, one for each constraint."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, plus, times, total
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks
from jaxcon.solvers.blocks import Block, freeze
from jaxcon.solvers.jacobian import Jacobian, join
from jaxcon.solvers.saddle import Saddle


class Delassus:
    """x → A x = J (M⁻¹ (Jᵀ x)) + C x of a system whose M is diagonal; C with ε diag A, if given.

    Attributes:
        matrices: J, the diagonal of M⁻¹ and C, constant under differentiation.
    """

    def __init__(self, system: Saddle, tikhonov: Any) -> None:
        self.system, self.compliance = system, system.compliance
        inverse_mass = 1 / system.mass.diagonal
        self.matrices = freeze((system.jacobian, inverse_mass, system.compliance))
        if tikhonov is not None:
            self.compliance = regularized(self.compliance, freeze(tikhonov), self.matrices)
            self.matrices = (*self.matrices[:2], freeze(self.compliance))

    def __call__(self, x: Array) -> Array:
        """A x, (n_c,)."""
        j, mass = self.system.jacobian, self.system.mass
        y = j.apply(mass.solve(j.transpose(x)))
        return y if self.compliance is None else y + self.compliance * x


def weighted(jacobian: Jacobian, inverse_mass: Array) -> list[Block]:
    """J M⁻¹, block by block."""
    weights = [block.columns.take(inverse_mass) for block in jacobian.blocks]
    return [
        [[times(x, w) for x, w in zip(row, weight, strict=True)] for row in block.value]
        for block, weight in zip(jacobian.blocks, weights, strict=True)
    ]


def diagonal_blocks(jacobian: Jacobian, rows: list[Block]) -> dict[int, Block]:
    """The blocks on the diagonal of J M⁻¹ Jᵀ from those of J M⁻¹, by group, lower triangles."""
    diagonal: dict[int, Block] = {}
    for block, row in zip(jacobian.blocks, rows, strict=True):
        own = blocks.lower_product(row, list(map(list, block.value)))
        known = diagonal.get(block.start)
        diagonal[block.start] = own if known is None else blocks.add(known, own)
    return diagonal


def softened(
    diagonal: dict[int, Block], shapes: dict[int, tuple[int, int]], compliance: Array
) -> dict[int, Block]:
    """Diagonal blocks with C added, by the rows and elements of each group."""
    result: dict[int, Block] = {}
    for start, block in diagonal.items():
        m, k = shapes[start]
        parts = Vector.of_rows(compliance, start, m, k)
        result[start] = [
            [*row[:-1], plus(row[-1], part)] for row, part in zip(block, parts, strict=True)
        ]
    return result


def regularized(compliance: Array | None, share: Any, matrices: Any) -> Array:
    """C + ε diag(J M⁻¹ Jᵀ + C), (n_c,), with the diagonal held constant."""
    own = diagonal(*matrices[:2])
    ε = jnp.asarray(share).astype(own.dtype)[None]
    if compliance is None:
        return ε * own
    return compliance + ε * (own + jax.lax.stop_gradient(compliance))


def diagonal(jacobian: Jacobian, inverse_mass: Array) -> Array:
    """diag(J M⁻¹ Jᵀ), (n_c,)."""
    rows: dict[int, list[Lane]] = {}
    for block in jacobian.blocks:
        weight = block.columns.take(inverse_mass)
        squares = [
            total(times(w, times(x, x)) for x, w in zip(row, weight, strict=True))
            for row in block.value
        ]
        known = rows.get(block.start, [0.0] * len(squares))
        rows[block.start] = [plus(a, b) for a, b in zip(known, squares, strict=True)]
    counts = {block.start: block.shape[1] for block in jacobian.blocks}
    return join(rows, counts, inverse_mass)
