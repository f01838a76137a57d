"""The constraint Jacobian J by blocks, with static rows and columns and with array entries."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.lanes import Vector, add_rhs_axis, collect_each, plus, take, times, total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.linear.gauss_jordan import identity


@dataclass(frozen=True)
class Columns:
    """The columns of J that multiply the velocities of the bodies of one Jacobian block.

    Bodies with equal velocity components form a group. Component c of element i lies in column
    start + c · bodies + indices[i].

    Attributes:
        start: the first column of the group.
        components: the number of velocity components of a body.
        bodies: the number of bodies in the group.
        indices: the number of a body within the group, for each element of the block.
    """

    start: int
    components: int
    bodies: int
    indices: tuple[int, ...]

    def take(self, v: Array) -> Vector:
        """Selects the velocities of these columns from v, (n_v,).

        Returns:
            A `Vector` over velocity components, whose components are arrays (element,).
        """
        lanes = Vector.of_rows(v, self.start, self.components, self.bodies)
        return lanes.map(lambda lane: take(lane, self.indices))

    def index(self) -> np.ndarray:
        """Returns the column number of each velocity component, (components, elements)."""
        component = self.bodies * np.arange(self.components)[:, None]
        return self.start + component + np.asarray(self.indices)


@pytree
class Block:
    """The Jacobian block of equal constraints with respect to one of their bodies.

    An element is one of these constraints. Row r of element i lies in row
    start + r · elements + i of J.

    Attributes:
        value: the entries: a `Vector` over velocity components for each row r, whose components are
            arrays (element,).
        start: the first row of the block in J.
        columns: the columns of the block in J.
    """

    value: tuple[Vector, ...]
    start: int = static()
    columns: Columns = static()

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows of each element, and the number of elements."""
        return len(self.value), len(self.columns.indices)


@pytree
class Jacobian:
    """The sparse constraint Jacobian J (n_c, n_v): the sum of its blocks."""

    blocks: tuple[Block, ...]
    shape: tuple[int, int] = static()

    def apply(self, v: Array) -> Array:
        """Returns J v, (n_c,)."""
        if not self.blocks:
            return jnp.zeros((self.shape[0], *v.shape[1:]), v.dtype)
        moved = (block.columns.take(v) for block in self.blocks)
        pairs = zip(self.blocks, moved, strict=True)
        return self.sum_blocks(([row.dot(x) for row in block.value] for block, x in pairs), v)

    def sum_blocks(self, values: Iterable[Sequence[Lane]], like: Array) -> Array:
        """Sums the contributions of all blocks to the rows of J, (n_c,).

        Args:
            values: for each block, the contribution (element,) to each of its rows; the Python
                number 0 for rows that are left out.
            like: an array with the batch axes and the dtype of the result.
        """
        rows: dict[int, list[Lane]] = {}
        for block, lanes in zip(self.blocks, values, strict=True):
            before = rows.get(block.start, [0.0] * len(lanes))
            rows[block.start] = [plus(a, b) for a, b in zip(before, lanes, strict=True)]
        counts = {block.start: block.shape[1] for block in self.blocks}
        sums = [(x, counts[start]) for start in sorted(rows) for x in rows[start]]
        batch = jnp.broadcast_shapes(like.shape[1:], *(jnp.shape(x)[1:] for x, _ in sums))
        return jnp.concatenate(
            [jnp.broadcast_to(jnp.asarray(x, like.dtype), (k, *batch)) for x, k in sums]
        )

    def by_rows(self) -> list[tuple[int, list[Block]]]:
        """Groups the blocks by their first row, in ascending order.

        The blocks of a group belong to the same constraints: one block for each body that these
        constraints connect.
        """
        groups: dict[int, list[Block]] = {}
        for block in self.blocks:
            groups.setdefault(block.start, []).append(block)
        return sorted(groups.items())

    def map(self, function: Callable[[Block], Iterable[Vector]]) -> Jacobian:
        """Returns J with new entries of its blocks.

        Args:
            function: block → its new rows, one `Vector` for each row of a constraint.
        """
        return dataclasses.replace(
            self,
            blocks=tuple(dataclasses.replace(x, value=tuple(function(x))) for x in self.blocks),
        )

    def reach(self, v: Array) -> Array:
        """Returns |J| |v|, (n_c,): an upper bound on |J v|, reached if no terms cancel."""
        return self.map(lambda x: (row.map(abs) for row in x.value)).apply(jnp.abs(v))

    def transpose(self, multipliers: Array) -> Array:
        """Returns the constraint forces Jᵀ λ, (n_v,), of multipliers λ (n_c,)."""
        batch, dtype = multipliers.shape[1:], multipliers.dtype
        terms: dict[int, tuple[Columns, list[list[tuple[tuple[int, ...], Lane]]]]] = {}
        for block in self.blocks:
            columns = block.columns
            force = Vector.of_rows(multipliers, block.start, *block.shape)
            _, sums = terms.setdefault(
                columns.start, (columns, [[] for _ in range(columns.components)])
            )
            for component, pulls in enumerate(sums):
                pairs = zip(block.value, force, strict=True)
                pulls.append((columns.indices, total(times(x[component], f) for x, f in pairs)))
        lanes: list[Array] = []
        free = 0
        for start, (columns, sums) in sorted(terms.items()):
            lanes.append(jnp.zeros((start - free, *batch), dtype))
            for lane in collect_each(sums, columns.bodies):
                wide = jnp.asarray(lane, dtype)
                lanes.append(jnp.broadcast_to(wide, (columns.bodies, *batch)))
            free = start + columns.components * columns.bodies
        lanes.append(jnp.zeros((self.shape[1] - free, *batch), dtype))
        return jnp.concatenate([x for x in lanes if x.shape[0]])

    def columns(self, like: Array) -> Array:
        """Returns Jᵀ as a dense array (n_v, n_c, …), with the batch axes of `like` (n_c, …)."""
        return self.pulls(jnp.broadcast_to(identity(like), (len(like), *like.shape)))

    def pulls(self, multipliers: Array) -> Array:
        """Returns the products Jᵀ λ, (n_v, k, …), with k multiplier vectors λ, (n_c, k, …)."""
        return add_rhs_axis(self, multipliers.ndim - 2).transpose(multipliers)

    def each(self, v: Array) -> Array:
        """Returns the products J v, (n_c, k, …), with k velocity vectors v, (n_v, k, …)."""
        return add_rhs_axis(self, v.ndim - 2).apply(v)

    def only(self, kept: np.ndarray, like: Array) -> Jacobian:
        """Returns J with zeros in all rows that a mask does not keep.

        Args:
            kept: a mask of the rows that keep their entries, (n_c,).
            like: an array (n_c, …) with the batch axes and the dtype of the entries.
        """

        def chosen(mask: np.ndarray, lane: Lane) -> Lane:
            if mask.all() or (not isinstance(lane, jax.Array) and lane == 0):
                return lane
            wide = mask.reshape(-1, *(1,) * (like.ndim - 1))
            if isinstance(lane, jax.Array):
                return jnp.where(wide, lane, 0) if mask.any() else jnp.zeros_like(lane)
            return jnp.asarray(np.where(wide, lane, 0.0), like.dtype)

        def rows(block: Block) -> Iterable[Vector]:
            m, k = block.shape
            masks = kept[block.start : block.start + m * k].reshape(m, k)
            return (
                row.map(partial(chosen, mask)) for row, mask in zip(block.value, masks, strict=True)
            )

        return self.map(rows)

    def scaled(self, factor: Array, chosen: np.ndarray) -> Jacobian:
        """Returns J with each chosen row multiplied by its own factor.

        Args:
            factor: the factor of each row, (n_c,); must be 1 in rows that are not chosen.
            chosen: a mask of the chosen rows, (n_c,); blocks without chosen rows are not changed.
        """

        def rows(block: Block) -> Iterable[Vector]:
            m, k = block.shape
            if not chosen[block.start : block.start + m * k].any():
                return block.value
            pairs = zip(block.value, Vector.of_rows(factor, block.start, m, k), strict=True)
            return (row.map(partial(times, x)) for row, x in pairs)

        return self.map(rows)

    def dense(self) -> Array:
        """Returns J as a dense array (n_c, n_v)."""
        # one concatenation and one gather by a fixed index are faster than many scatters
        entries: list[Array] = []
        index = np.full(self.shape, -1)
        filled = 0
        for block in self.blocks:
            element = np.arange(block.shape[1])
            for r, lanes in enumerate(block.value):
                for value, column in zip(lanes, block.columns.index(), strict=True):
                    if isinstance(value, jax.Array) or value != 0:
                        entries.append(jnp.broadcast_to(value, element.shape))
                        index[block.start + r * len(element) + element, column] = filled + element
                        filled += len(element)
        dtype = jnp.result_type(*entries) if entries else jnp.result_type(float)
        return jnp.concatenate([*(x.astype(dtype) for x in entries), jnp.zeros(1, dtype)])[index]


@pytree
class Gathered:
    """A dense Jacobian J whose rows are selected in each world separately.

    Attributes:
        transposed: Jᵀ, (n_v, n, …), for n rows and the trailing batch axes.
    """

    transposed: Array

    def apply(self, v: Array) -> Array:
        """Returns J v, (n,)."""
        return jnp.sum(self.transposed * v[:, None], axis=0)

    def reach(self, v: Array) -> Array:
        """Returns |J| |v|, (n,): an upper bound on |J v|, reached if no terms cancel."""
        return jnp.sum(jnp.abs(self.transposed * v[:, None]), axis=0)

    def transpose(self, multipliers: Array) -> Array:
        """Returns the constraint forces Jᵀ λ, (n_v,), of multipliers λ (n,)."""
        return jnp.sum(self.transposed * multipliers[None], axis=1)

    def columns(self, like: Array) -> Array:
        """Returns Jᵀ as a dense array (n_v, n, …), with the batch axes of `like` (n, …)."""
        return jnp.broadcast_to(self.transposed, (len(self.transposed), *like.shape))

    def each(self, v: Array) -> Array:
        """Returns the products J v, (n, k, …), with k velocity vectors v, (n_v, k, …)."""
        return jnp.sum(self.transposed[:, :, None] * v[:, None], axis=0)
