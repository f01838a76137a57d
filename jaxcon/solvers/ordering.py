"""The order in which a sparse block matrix is eliminated: host code, once for each structure.

Nodes are constraints (one element of one block row each). Two nodes are neighbours where they
touch a common body, since their block of A = J M⁻¹ Jᵀ is then not zero. Eliminating a node makes
its later neighbours neighbours of each other. Minimum degree keeps that fill small: a tree of
joints of two bodies each has none.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

RUN = 6
"""Nodes in a row from which a scan pays more than unrolling."""


@dataclass(frozen=True)
class Node:
    """One constraint: an element of the row group that starts at row `group`, of `size` rows."""

    group: int
    element: int
    size: int


@dataclass(frozen=True)
class Coupling:
    """Blocks of A between elements of two Jacobian blocks that touch common bodies.

    Attributes:
        blocks: positions of the two blocks in `Jacobian.blocks`.
        elements: which element of the first meets which of the second, (pairs,) each.
    """

    blocks: tuple[int, int]
    elements: tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True)
class Entry:
    """Where a block of A is found: a pair of a coupling, transposed or not."""

    coupling: int
    pair: int
    transposed: bool


@dataclass(frozen=True)
class Single:
    """A node eliminated by itself, and its neighbours that are eliminated later."""

    node: Node
    later: tuple[Node, ...]


@dataclass(frozen=True)
class Run:
    """Nodes of one group, each the only later neighbour of the one before; the last one excluded.

    Attributes:
        nodes: in the order of elimination; consecutive elements, ascending or descending.
        parent: the only later neighbour of the last of them.
    """

    nodes: tuple[Node, ...]
    parent: Node

    @property
    def elements(self) -> tuple[int, ...]:
        """Of the nodes, ascending."""
        return tuple(sorted(node.element for node in self.nodes))

    @property
    def descending(self) -> bool:
        """Whether elements are eliminated from the last to the first."""
        return self.parent.element < self.nodes[-1].element


@dataclass(frozen=True)
class Plan:
    """How to factor one structure.

    Attributes:
        couplings: which blocks of A to compute.
        entries: for a pair of nodes (row, column), what to add up to their block.
        steps: the elimination, in order.
    """

    couplings: tuple[Coupling, ...]
    entries: Mapping[tuple[Node, Node], tuple[Entry, ...]]
    steps: tuple[Single | Run, ...]


@functools.lru_cache(maxsize=256)
def plan(structure: Any, run: int = RUN) -> Plan:
    """The plan for a Jacobian's structure.

    Args:
        structure: (first row, rows an element, columns) of each Jacobian block.
        run: least length of a run.
    """
    nodes, touching = _nodes(structure)
    couplings = _couplings(structure, nodes, touching)
    entries: dict[tuple[Node, Node], tuple[Entry, ...]] = {}
    neighbours: dict[Node, set[Node]] = {node: set() for node in nodes.values()}
    for c, coupling in enumerate(couplings):
        groups = [structure[b][0] for b in coupling.blocks]
        for i, (x, y) in enumerate(zip(*coupling.elements, strict=True)):
            first, second = nodes[groups[0], x], nodes[groups[1], y]
            neighbours[first].add(second)
            neighbours[second].add(first)
            for key, flip in (((first, second), False), ((second, first), True)):
                entries[key] = (*entries.get(key, ()), Entry(c, i, flip))
    grounded = [node for node in neighbours if _bodies(structure, node) == 1]
    order, later = minimum_degree(neighbours, distances(neighbours, grounded))
    return Plan(tuple(couplings), entries, tuple(_steps(order, later, entries, run)))


def minimum_degree(
    neighbours: dict[Any, set[Any]], distance: Mapping[Any, int] | None = None
) -> tuple[list[Any], dict[Any, list[Any]]]:
    """An elimination order, and for each node its later neighbours in that order, fill included.

    Among nodes of equal degree the one next to the last eliminated comes first, so that chains are
    eliminated from one end to the other; and before that the one next to the ground. A chain is
    well conditioned from the ground on: each pivot is then that of a joint whose one side is held.
    From its free end, the pivots of n links fall like 1/n³.
    """
    distance = distance or dict.fromkeys(neighbours, 0)
    graph = {node: set(around) for node, around in neighbours.items()}
    rank = {node: i for i, node in enumerate(graph)}
    order: list[Any] = []
    later: dict[Any, set[Any]] = {}
    near: set[Any] = set()
    while graph:
        node = min(graph, key=lambda x: (len(graph[x]), x not in near, distance[x], rank[x]))
        around = graph.pop(node)
        for other in around:
            graph[other] |= around - {other}
            graph[other].discard(node)
        later[node], near = around, around
        order.append(node)
    position = {node: i for i, node in enumerate(order)}
    return order, {node: sorted(s, key=position.__getitem__) for node, s in later.items()}


def distances(neighbours: dict[Any, set[Any]], start: list[Any]) -> dict[Any, int]:
    """How many nodes away each is from the nearest of some; all of them where there is none."""
    result = dict.fromkeys(start, 0)
    front = start
    while front:
        front = [other for node in front for other in neighbours[node] if other not in result]
        result.update(dict.fromkeys(front, max(result.values()) + 1))
    return {node: result.get(node, len(neighbours)) for node in neighbours}


def _bodies(structure: Any, node: Node) -> int:
    """How many moving bodies a constraint touches."""
    return sum(start == node.group for start, _, _ in structure)


def _nodes(structure: Any) -> tuple[dict[tuple[int, int], Node], dict[Any, list[Any]]]:
    """Nodes by (group, element), and for each body the (block, element) that touch it."""
    nodes: dict[tuple[int, int], Node] = {}
    touching: dict[Any, list[Any]] = {}
    for b, (start, size, columns) in enumerate(structure):
        for element, body in enumerate(columns.indices):
            nodes.setdefault((start, element), Node(start, element, size))
            touching.setdefault((columns.start, body), []).append((b, element))
    return nodes, touching


def _couplings(structure: Any, nodes: Any, touching: Any) -> list[Coupling]:
    """Couplings by pairs of Jacobian blocks."""
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for members in touching.values():
        for i, (b, x) in enumerate(members):
            for c, y in members[:i]:
                if nodes[structure[b][0], x] != nodes[structure[c][0], y]:
                    pairs.setdefault((b, c), []).append((x, y))
    couplings = []
    for blocks, elements in pairs.items():
        first, second = zip(*sorted(elements), strict=True)
        couplings.append(Coupling(blocks, (first, second)))
    return couplings


def _steps(
    order: list[Node], later: dict[Node, list[Node]], entries: Any, run: int
) -> list[Single | Run]:
    """The order as runs where there are long ones, and single nodes elsewhere."""
    steps: list[Single | Run] = []
    i = 0
    while i < len(order):
        j = i
        while j + 1 < len(order) and _continues(order, later, entries, i, j):
            j += 1
        if j - i >= run:
            steps.append(Run(tuple(order[i:j]), order[j]))
            i = j
        else:
            steps.append(Single(order[i], tuple(later[order[i]])))
            i += 1
    return steps


def _continues(order: list[Node], later: Any, entries: Any, i: int, j: int) -> bool:
    """Whether a run from i to j may go on: same group, next element, same kind of block."""
    node, following = order[j], order[j + 1]
    if later[node] != [following] or node.group != following.group:
        return False

    def kind(k: int) -> Any:
        blocks = entries.get((order[k + 1], order[k]), ())
        stride = order[k + 1].element - order[k].element
        return stride, [(entry.coupling, entry.transposed) for entry in blocks]

    return abs(following.element - node.element) == 1 and kind(j) == kind(i)
