"""Detects loops of constraints, whose rows may depend on each other."""

from __future__ import annotations

from collections.abc import Iterable

from jaxcon.linear.jacobian import Block

WORLD = -1


def has_loops(groups: Iterable[list[Block]]) -> bool:
    """Returns True if constraints close a loop, or two constraints act on the same bodies.

    In a tree of joints no row depends on another. A drive or a rotor acts along a degree of freedom
    of its joint, and closes no loop.

    Args:
        groups: for each group of constraints, the blocks of their Jacobian.
    """
    parent: dict[int, int] = {}

    def root(body: int) -> int:
        """Returns the representative of all bodies that are connected to this body (union–find)."""
        while parent.setdefault(body, body) != body:
            parent[body] = body = parent[parent[body]]
        return body

    for blocks in groups:
        columns = [block.columns for block in blocks]
        sides = [[c.start + i for i in c.indices] for c in columns]
        if len(sides) == 1:
            sides.append([WORLD] * len(sides[0]))
        for bodies in zip(*sides, strict=True):
            roots = [root(body) for body in bodies]
            if len(set(roots)) < len(roots):
                return True
            parent.update(dict.fromkeys(roots[1:], roots[0]))
    return False
