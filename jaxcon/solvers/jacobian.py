"""J by blocks: which rows touch which bodies is structure, what they are is numbers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.lanes import Vector, collect, plus, take, times, total, widened
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane


@dataclass(frozen=True)
class Columns:
    """The velocities of some bodies of a group.

    Component c of element i lies in column start + c · bodies + indices[i].
    """

    start: int
    components: int
    bodies: int
    indices: tuple[int, ...]

    def take(self, v: Array) -> Vector:
        """The velocities by components, each lane (element,)."""
        lanes = Vector.of_rows(v, self.start, self.components, self.bodies)
        return lanes.map(lambda lane: take(lane, self.indices))

    def index(self) -> np.ndarray:
        """Column numbers, (components, elements)."""
        component = self.bodies * np.arange(self.components)[:, None]
        return self.start + component + np.asarray(self.indices)


@pytree
class Block:
    """The rows of equal constraints on one body each.

    Row r of element i lies in row start + r · elements + i of J.

    Attributes:
        value: rows, each a Vector over velocity components of lanes (element,).
    """

    value: tuple[Vector, ...]
    start: int = static()
    columns: Columns = static()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows an element, and elements."""
        return len(self.value), len(self.columns.indices)


@pytree
class Jacobian:
    """J (n_c, n_v) as the sum of its blocks."""

    blocks: tuple[Block, ...]
    shape: tuple[int, int] = static()

    def apply(self, v: Array) -> Array:
        """J v, (n_c,)."""
        rows: dict[int, list[Lane]] = {}
        if not self.blocks:
            return jnp.zeros((self.shape[0], *v.shape[1:]), v.dtype)
        for block in self.blocks:
            moved = block.columns.take(v)
            values = [row.dot(moved) for row in block.value]
            known = rows.get(block.start, [0.0] * len(values))
            rows[block.start] = [plus(a, b) for a, b in zip(known, values, strict=True)]
        counts = {block.start: block.shape[1] for block in self.blocks}
        return join(rows, counts, v)

    def by_rows(self) -> list[tuple[int, list[Block]]]:
        """The first row of equal constraints and their blocks, one for each of their bodies."""
        found: dict[int, list[Block]] = {}
        for block in self.blocks:
            found.setdefault(block.start, []).append(block)
        return sorted(found.items())

    def reach(self, v: Array) -> Array:
        """|J| |v|, (n_c,): J v as large as it could be if no terms cancelled."""

        def block(old: Block) -> Block:
            return dataclasses.replace(old, value=tuple(row.map(abs) for row in old.value))

        return dataclasses.replace(self, blocks=tuple(map(block, self.blocks))).apply(jnp.abs(v))

    def transpose(self, multipliers: Array) -> Array:
        """Jᵀ λ, (n_v,)."""
        terms: dict[int, tuple[Columns, list[Any]]] = {}
        for block in self.blocks:
            m, k = block.shape
            force = Vector.of_rows(multipliers, block.start, m, k)
            columns = block.columns
            _, known = terms.setdefault(
                columns.start, (columns, [[] for _ in range(columns.components)])
            )
            for component in range(columns.components):
                pairs = zip(block.value, force, strict=True)
                pull = total(times(row[component], f) for row, f in pairs)
                known[component].append((columns.indices, pull))
        lanes: list[Array] = []
        free = 0
        for start, (columns, components) in sorted(terms.items()):
            lanes.append(jnp.zeros((start - free, *multipliers.shape[1:]), multipliers.dtype))
            for known in components:
                lane = collect(known, columns.bodies)
                shape = (columns.bodies, *multipliers.shape[1:])
                lanes.append(jnp.broadcast_to(jnp.asarray(lane, multipliers.dtype), shape))
            free = start + columns.components * columns.bodies
        lanes.append(jnp.zeros((self.shape[1] - free, *multipliers.shape[1:]), multipliers.dtype))
        return jnp.concatenate([x for x in lanes if x.shape[0]])

    def columns(self, like: Array) -> Array:
        """Jᵀ as right sides (n_v, n_c, …) for lanes like (n_c, …)."""
        n, batch = self.shape[0], like.shape[1:]
        unit = jnp.eye(n, dtype=like.dtype).reshape(n, n, *(1,) * len(batch))
        return self.pulls(jnp.broadcast_to(unit, (n, n, *batch)))

    def pulls(self, multipliers: Array) -> Array:
        """Jᵀ λ of many λ (n_c, k, …), (n_v, k, …)."""
        return widened(self, multipliers.ndim - 2).transpose(multipliers)

    def each(self, v: Array) -> Array:
        """J v of many v (n_v, k, …), (n_c, k, …)."""
        return widened(self, v.ndim - 2).apply(v)

    def only(self, kept: np.ndarray, like: Array) -> Jacobian:
        """J with rows of zeros where they are not kept, (n_c,); `like` has the axes of a lane."""

        def block(old: Block) -> Block:
            m, k = old.shape
            choice = kept[old.start : old.start + m * k].reshape(m, k)
            rows = zip(old.value, choice, strict=True)
            value = tuple(row.map(partial(_chosen, own, like)) for row, own in rows)
            return dataclasses.replace(old, value=value)

        return dataclasses.replace(self, blocks=tuple(map(block, self.blocks)))

    def scaled(self, factor: Array, chosen: np.ndarray) -> Jacobian:
        """J with some of its rows multiplied, each by a factor (n_c,).

        Args:
            factor: of each row, 1 of those that are not chosen.
            chosen: which rows these are, (n_c,); blocks without one stay as they are.
        """

        def block(old: Block) -> Block:
            m, k = old.shape
            if not chosen[old.start : old.start + m * k].any():
                return old
            pairs = zip(old.value, Vector.of_rows(factor, old.start, m, k), strict=True)
            value = tuple(row.map(partial(times, own)) for row, own in pairs)
            return dataclasses.replace(old, value=value)

        return dataclasses.replace(self, blocks=tuple(map(block, self.blocks)))

    def dense(self) -> Array:
        """J as one array (n_c, n_v): one concatenation and one gather by a fixed index."""
        entries: list[Array] = []
        index = np.full(self.shape, -1)
        filled = 0
        for block in self.blocks:
            m, k = block.shape
            columns = block.columns.index()
            for r in range(m):
                row = block.start + r * k + np.arange(k)
                for value, column in zip(block.value[r], columns, strict=True):
                    if isinstance(value, jax.Array) or value != 0:
                        entries.append(jnp.broadcast_to(value, (k,)))
                        index[row, column] = filled + np.arange(k)
                        filled += k
        dtype = jnp.result_type(*entries) if entries else jnp.result_type(float)
        flat = [x.astype(dtype) for x in entries]
        return jnp.concatenate([*flat, jnp.zeros(1, dtype)])[index]


@pytree
class Gathered:
    """J of rows that are not the same in each world, its columns first: Jᵀ (n_v, n, …)."""

    transposed: Array

    def apply(self, v: Array) -> Array:
        """J v, (n,)."""
        return jnp.sum(self.transposed * v[:, None], axis=0)

    def reach(self, v: Array) -> Array:
        """|J| |v|, (n,): J v as large as it could be if no terms cancelled."""
        return jnp.sum(jnp.abs(self.transposed * v[:, None]), axis=0)

    def transpose(self, multipliers: Array) -> Array:
        """Jᵀ λ, (n_v,)."""
        return jnp.sum(self.transposed * multipliers[None], axis=1)

    def columns(self, like: Array) -> Array:
        """Jᵀ as right sides (n_v, n, …) for lanes like (n, …)."""
        return jnp.broadcast_to(self.transposed, (len(self.transposed), *like.shape))

    def each(self, v: Array) -> Array:
        """J v of many v (n_v, k, …), (n, k, …)."""
        return jnp.sum(self.transposed[:, :, None] * v[:, None], axis=0)


def _chosen(kept: np.ndarray, like: Array, lane: Lane) -> Lane:
    """A lane (element, …) with zeros where an element is not kept."""
    if kept.all() or (not isinstance(lane, jax.Array) and lane == 0):
        return lane
    choice = kept.reshape(-1, *(1,) * (like.ndim - 1))
    if isinstance(lane, jax.Array):
        return jnp.where(choice, lane, 0) if kept.any() else jnp.zeros_like(lane)
    return jnp.asarray(np.where(choice, lane, 0.0), like.dtype)


def join(rows: dict[int, list[Lane]], counts: dict[int, int], like: Array) -> Array:
    """One array (n_c,) of the lanes (element,) of rows, by where each block starts.

    A lane may be the number 0, as where rows are left out.
    """
    lanes = [(x, counts[start]) for start in sorted(rows) for x in rows[start]]
    shape = jnp.broadcast_shapes(like.shape[1:], *(jnp.shape(x)[1:] for x, _ in lanes))
    parts = [jnp.broadcast_to(jnp.asarray(x, like.dtype), (k, *shape)) for x, k in lanes]
    return jnp.concatenate(parts)
