"""Trees of rigid bodies: which joint leads to which body, for elimination along the joints.

A joint whose rows act on two bodies, or on one body and the world, is an edge of a graph. If the
graph has no closed loop, each body has one joint toward the root of its tree, and the motions that
the joints allow are v_child = v_parent + S q̇ in common coordinates (`articulated`).
"""

from __future__ import annotations

import functools
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from jaxcon.linear.jacobian import Columns, Jacobian

WORLD = -1
"""The place of the world, the parent of every root."""

Structure = tuple[tuple[int, tuple[tuple[int, Columns], ...]], ...]
"""The first row of each group of constraints, and the rows and columns of its blocks in J."""


@dataclass(frozen=True)
class Branch:
    """Bodies at the same depth whose joints have the same structure.

    Attributes:
        bodies: the bodies, by their index in the group of bodies.
        parents: the place of each body's parent in the order of the tree; `WORLD` for none.
        row: the first row of the joints in J; None for bodies without a joint to a parent.
        elements: the element of each body's joint among the joints that begin at `row`.
        freedom: the number k of velocities that a joint allows.
    """

    bodies: tuple[int, ...]
    parents: tuple[int, ...]
    row: int | None
    elements: tuple[int, ...]
    freedom: int


@dataclass(frozen=True)
class Tree:
    """The bodies of a system as a forest, in an order in which parents come before children.

    Attributes:
        branches: the bodies with their joints. The place of a body is its index in the
            concatenation of all branches.
    """

    branches: tuple[Branch, ...]

    @functools.cached_property
    def bodies(self) -> tuple[int, ...]:
        """The bodies, in the order of the tree."""
        return tuple(b for x in self.branches for b in x.bodies)

    @functools.cached_property
    def depth(self) -> int:
        """The largest number of joints between a body and the root of its tree."""
        depths: list[int] = []
        for p in self.parents:
            depths.append(0 if p == WORLD else depths[p] + 1)
        return max(depths)

    @functools.cached_property
    def starts(self) -> tuple[int, ...]:
        """The place of the first body of each branch."""
        return tuple(np.cumsum([0, *(len(x.bodies) for x in self.branches)])[:-1].tolist())

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of bodies of each branch."""
        return tuple(len(x.bodies) for x in self.branches)

    @functools.cached_property
    def places(self) -> dict[int, int]:
        """The place of each body."""
        return {b: i for i, b in enumerate(self.bodies)}

    @functools.cached_property
    def parents(self) -> tuple[int, ...]:
        """The place of the parent of the body at each place."""
        return tuple(p for x in self.branches for p in x.parents)

    def branch_of(self, place: int) -> tuple[int, int]:
        """Returns the branch of the body at a place, and its index in the branch."""
        branch = max(i for i, start in enumerate(self.starts) if start <= place)
        return branch, place - self.starts[branch]


def structure(jacobian: Jacobian) -> Structure:
    """Returns the rows and columns of the blocks of J, without their entries."""
    return tuple(
        (start, tuple((block.shape[0], block.columns) for block in blocks))
        for start, blocks in jacobian.by_rows()
    )


@functools.lru_cache(maxsize=256)
def tree_of(
    joints: Structure,
    soft: frozenset[int],
    bodies: int,
    components: int,
) -> Tree | None:
    """Returns the tree of bodies that joints connect.

    Args:
        joints: the structure of the Jacobian of the equality rows; see `structure`.
        soft: the first rows of groups that remove no degree of freedom.
        bodies: the number of bodies.
        components: the number of velocities of a body.

    Returns:
        The tree; None if joints close a loop, act on more than two bodies, or have more rows than a
        body has velocities.
    """
    edges: dict[int, list[tuple[int, int, int, int]]] = defaultdict(list)
    for start, blocks in joints:
        if start in soft:
            continue
        (rows, side), *_ = blocks
        if len(blocks) > 2 or rows > components:
            return None
        for i in range(len(side.indices)):
            ends = [columns.indices[i] for _, columns in blocks]
            a, b = ends if len(ends) == 2 else (WORLD, ends[0])
            edges[a].append((b, start, i, rows))
            edges[b].append((a, start, i, rows))
    found: dict[int, tuple[int, int, int | None, int, int]] = {}
    used: set[tuple[int, int]] = set()
    for root in [WORLD, *range(bodies)]:
        pending = [root]
        if root != WORLD:
            if root in found:
                continue
            found[root] = (0, WORLD, None, 0, components)
        while pending:
            here = pending.pop(0)
            depth = 0 if here == WORLD else found[here][0] + 1
            for other, start, i, rows in edges[here]:
                if (start, i) in used:
                    continue
                if other in found or other == WORLD:
                    return None
                used.add((start, i))
                found[other] = (depth, here, start, i, components - rows)
                pending.append(other)
    groups: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    for body, (depth, _, row, _, freedom) in sorted(found.items()):
        groups[depth, -1 if row is None else row, freedom].append(body)
    order: list[tuple[tuple[int, int, int], list[int]]] = sorted(groups.items())
    places = {b: i for i, b in enumerate(b for _, members in order for b in members)}
    places[WORLD] = WORLD
    return Tree(
        tuple(
            Branch(
                tuple(members),
                tuple(places[found[b][1]] for b in members),
                found[members[0]][2],
                tuple(found[b][3] for b in members),
                freedom,
            )
            for (_, _, freedom), members in order
        )
    )
