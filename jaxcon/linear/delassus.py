"""The Delassus operator A = J M⁻¹ Jᵀ + C, and its diagonal blocks, one for each constraint."""

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, plus, times, total
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear import blocks
from jaxcon.linear.blocks import Block, freeze
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.saddle import Saddle


class Delassus:
    """The operator x → A x = J (M⁻¹ (Jᵀ x)) + C x of a system with a diagonal mass matrix M.

    Attributes:
        compliance: the diagonal of C, (n_c,), plus ε diag A if a regularization ε is given; None
            if C is zero and no ε is given.
        matrices: J, the diagonal of M⁻¹, and `compliance`, all constant under differentiation.
    """

    def __init__(self, system: Saddle, tikhonov: Scalar | None) -> None:
        self.system, self.compliance = system, system.compliance
        jacobian, inverse = freeze((system.jacobian, 1 / system.mass.diagonal))
        if tikhonov is not None:
            weight = diagonal(jacobian, inverse)
            ε = jnp.asarray(freeze(tikhonov)).astype(weight.dtype)[None]
            if self.compliance is None:
                self.compliance = ε * weight
            else:
                frozen = jax.lax.stop_gradient(self.compliance)
                self.compliance = self.compliance + ε * (weight + frozen)
        self.matrices = jacobian, inverse, freeze(self.compliance)

    def __call__(self, x: Array) -> Array:
        """Returns A x, (n_c,)."""
        j, mass = self.system.jacobian, self.system.mass
        y = j.apply(mass.solve(j.transpose(x)))
        return y if self.compliance is None else y + self.compliance * x


def weighted(jacobian: Jacobian, inverse_mass: Array) -> list[Block]:
    """Returns the blocks of J M⁻¹, one for each block of J; `inverse_mass` is diag M⁻¹, (n_v,)."""
    weights = [block.columns.take(inverse_mass) for block in jacobian.blocks]
    return [
        [[times(x, w) for x, w in zip(row, weight, strict=True)] for row in block.value]
        for block, weight in zip(jacobian.blocks, weights, strict=True)
    ]


def diagonal_blocks(
    jacobian: Jacobian, rows: list[Block], compliance: Array | None
) -> dict[int, Block]:
    """Returns the diagonal blocks of A = J M⁻¹ Jᵀ + C, keyed by the first row of each group.

    A group is a set of equal constraints. Each block is stored as the rows of its lower triangle.

    Args:
        jacobian: J.
        rows: J M⁻¹, from `weighted`.
        compliance: the diagonal of C, (n_c,); None if C is zero.
    """
    diagonal: dict[int, Block] = {}
    for block, row in zip(jacobian.blocks, rows, strict=True):
        square = blocks.product(row, block.value, lower=True)
        before = diagonal.get(block.start, blocks.zero(len(row)))
        diagonal[block.start] = blocks.add(before, square)
    if compliance is not None:
        for start, shape in {block.start: block.shape for block in jacobian.blocks}.items():
            pairs = zip(diagonal[start], Vector.of_rows(compliance, start, *shape), strict=True)
            diagonal[start] = [[*row[:-1], plus(row[-1], c)] for row, c in pairs]
    return diagonal


def diagonal(jacobian: Jacobian, inverse_mass: Array) -> Array:
    """Returns the diagonal of J M⁻¹ Jᵀ, (n_c,); `inverse_mass` is diag M⁻¹, (n_v,)."""
    weights = (block.columns.take(inverse_mass) for block in jacobian.blocks)
    squares = (
        [total(times(w, times(x, x)) for x, w in zip(row, ws, strict=True)) for row in block.value]
        for block, ws in zip(jacobian.blocks, weights, strict=True)
    )
    return jacobian.sum_blocks(squares, inverse_mass)
