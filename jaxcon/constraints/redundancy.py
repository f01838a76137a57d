"""Structures of scenes whose rows may depend on each other."""

from __future__ import annotations

from collections.abc import Iterable

from jaxcon.constraints.base import RowSet

WORLD = -1


def has_loops(sets: Iterable[RowSet]) -> bool:
    """Returns True where constraints close a loop of bodies, or two of them act on the same ones.

    In a tree of joints no row depends on another. What acts along a freedom that a joint leaves, a
    drive or a rotor, closes no loop.
    """
    joined = Joined()
    for rows in sets:
        sides = [[c.start + i for i in c.indices] for c, _ in rows.jacobian]
        if len(sides) == 1:
            sides.append([WORLD] * len(sides[0]))
        if not all(joined.join(*bodies) for bodies in zip(*sides, strict=True)):
            return True
    return False


class Joined:
    """Which bodies hang together."""

    def __init__(self) -> None:
        self.parent: dict[int, int] = {}

    def root(self, body: int) -> int:
        """One body that stands for all that hang together with this one."""
        while self.parent.setdefault(body, body) != body:
            self.parent[body] = self.parent[self.parent[body]]
            body = self.parent[body]
        return body

    def join(self, *bodies: int) -> bool:
        """Joins bodies; False where two of them hung together before."""
        roots = [self.root(body) for body in bodies]
        for root in roots[1:]:
            self.parent[root] = roots[0]
        return len(set(roots)) == len(roots)
