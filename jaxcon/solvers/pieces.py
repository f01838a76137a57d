"""Vectors and matrices by blocks, whose blocks lie in larger arrays of equal ones."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp

from jaxcon.core.lanes import side_by_side
from jaxcon.core.typing import Lane
from jaxcon.solvers import blocks
from jaxcon.solvers.blocks import Block

Piece = tuple[Block, int]
"""An element of a block of lanes (element, …)."""


class Pieces:
    """A sparse matrix or vector: for each key, the pieces whose sum is the block there.

    Many blocks are read, and added to, at once, as lanes (key, …). What lies in order in one array
    is not moved for that.
    """

    def __init__(self) -> None:
        self.known: dict[Any, list[Piece]] = {}

    def add(self, keys: Iterable[Any], block: Block) -> None:
        """Adds element i of a block to what is at the i-th key."""
        for i, key in enumerate(keys):
            self.known.setdefault(key, []).append((block, i))

    def sum(self, keys: Iterable[Any]) -> Block | None:
        """The blocks at some keys, lanes (key, …); None where there is nothing at any of them."""
        found = itertools.zip_longest(*(self.known.get(key, ()) for key in keys))
        total: Block | None = None
        for pieces in found:
            block = _joined(pieces)
            total = block if total is None else blocks.add(total, block)
        return total


def _joined(pieces: Sequence[Piece | None]) -> Block:
    """Pieces side by side, zero where there is none."""
    shape = next(piece[0] for piece in pieces if piece is not None)

    def lane(r: int, c: int) -> Lane:
        return side_by_side([(0.0, 0) if p is None else (p[0][r][c], p[1]) for p in pieces])

    return [[lane(r, c) for c in range(len(row))] for r, row in enumerate(shape)]


def less(block: Block, taken: Block | None) -> Block:
    """A − B, where B may be nothing."""
    return block if taken is None else blocks.subtract(block, taken)


class Vectors:
    """A vector by nodes, read, changed and set node by node."""

    def __init__(self) -> None:
        self.values, self.taken = Pieces(), Pieces()

    def get(self, nodes: Iterable[Any]) -> list[Lane]:
        """The lanes (node, …) of some nodes."""
        nodes = list(nodes)
        return self._less(nodes, nodes)

    def split(self, nodes: list[Any], first: Any) -> tuple[list[Lane], list[Lane]]:
        """Returns the sums, with what is subtracted from one of the nodes apart from it."""
        lanes = self._less(nodes, [None if node == first else node for node in nodes])
        taken = self.taken.sum([first])
        return lanes, [jnp.zeros_like(x) for x in lanes] if taken is None else taken[0]

    def _less(self, nodes: list[Any], taken_from: list[Any]) -> list[Lane]:
        values = self.values.sum(nodes)
        assert values is not None
        return less(values, self.taken.sum(taken_from))[0]

    def put(self, nodes: Iterable[Any], lanes: list[Lane]) -> None:
        """Sets some nodes."""
        self.values.add(nodes, [lanes])

    def subtract(self, nodes: Iterable[Any], lanes: list[Lane]) -> None:
        """Subtracts from some nodes."""
        self.taken.add(nodes, [lanes])
