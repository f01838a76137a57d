"""The order in which a sparse block matrix is eliminated: host code, once for each structure.

Nodes are constraints (one element of one block row each). Two nodes are neighbours where they
touch a common body, since their block of A = J M⁻¹ Jᵀ is then not zero. Their order is that of
`graphs`; here it becomes steps that each take many nodes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from jaxcon.solvers.graphs import distances, independent_sets, minimum_degree

ORDERS = ("runs", "levels")
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
        pairs: the same as nodes.
    """

    blocks: tuple[int, int]
    elements: tuple[tuple[int, ...], tuple[int, ...]]
    pairs: tuple[tuple[Node, Node], ...]


@dataclass(frozen=True)
class Batch:
    """Nodes of one group that do not touch each other, eliminated at once.

    Attributes:
        nodes: ascending in their elements.
        later: of each node, its neighbours that are eliminated later, in that order; as many and of
            the same sizes for each.
    """

    nodes: tuple[Node, ...]
    later: tuple[tuple[Node, ...], ...]

    @property
    def slots(self) -> list[tuple[Node, ...]]:
        """The first later neighbours of all nodes, the second ones, and so on."""
        return list(zip(*self.later, strict=True))


@dataclass(frozen=True)
class Run:
    """Nodes of one group, each a later neighbour of the one before; the last one excluded.

    Attributes:
        nodes: in the order of elimination; consecutive elements, ascending or descending.
        parent: the later neighbour of the last of them.
        border: other later neighbours, common to all of them.
    """

    nodes: tuple[Node, ...]
    parent: Node
    border: tuple[Node, ...] = ()

    @property
    def ascending(self) -> list[Node]:
        """The nodes, ascending in their elements."""
        return list(self.nodes[::-1] if self.descending else self.nodes)

    @property
    def pairs(self) -> list[tuple[Node, Node]]:
        """For each node, ascending, the neighbour that is eliminated after it, and itself."""
        pairs = list(zip((*self.nodes[1:], self.parent), self.nodes, strict=True))
        return pairs[::-1] if self.descending else pairs

    @property
    def descending(self) -> bool:
        """Returns True where elements are eliminated from the last to the first."""
        return self.parent.element < self.nodes[-1].element


@dataclass(frozen=True)
class Plan:
    """How to factor one structure.

    Attributes:
        couplings: which blocks of A to compute.
        steps: the elimination, in order.
    """

    couplings: tuple[Coupling, ...]
    steps: tuple[Batch | Run, ...]


@functools.lru_cache(maxsize=256)
def plan(structure: Any, run: int = RUN, order: str = "runs") -> Plan:
    """The plan for a Jacobian's structure.

    Args:
        structure: (first row, rows an element, columns) of each Jacobian block.
        run: least length of a run.
        order: "runs" for the fewest operations, or "levels" for the fewest steps one after another.

    Raises:
        ValueError: another order.
    """
    if order not in ORDERS:
        raise ValueError(f"Sparse: order must be one of {ORDERS} or None, got {order!r}.")
    nodes, touching = _nodes(structure)
    couplings = _couplings(structure, nodes, touching)
    kinds: dict[tuple[Node, Node], list[tuple[int, bool]]] = {}
    neighbours: dict[Node, set[Node]] = {node: set() for node in nodes.values()}
    for c, coupling in enumerate(couplings):
        for first, second in coupling.pairs:
            neighbours[first].add(second)
            neighbours[second].add(first)
            kinds.setdefault((first, second), []).append((c, False))
            kinds.setdefault((second, first), []).append((c, True))
    if order == "levels":
        steps = _single(*independent_sets(neighbours))
    else:
        grounded = [node for node in neighbours if _bodies(structure, node) == 1]
        found = minimum_degree(neighbours, distances(neighbours, grounded))
        steps = _steps(*found, kinds, run)
    return Plan(tuple(couplings), tuple(_at_once(steps)))


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
        starts = [structure[b][0] for b in blocks]
        ends = [[nodes[s, x] for x in e] for s, e in zip(starts, (first, second), strict=True)]
        couplings.append(Coupling(blocks, (first, second), tuple(zip(*ends, strict=True))))
    return couplings


def _steps(
    order: list[Node], later: dict[Node, list[Node]], kinds: Any, run: int
) -> list[Batch | Run]:
    """The order as runs where there are long ones, and single nodes elsewhere."""
    steps: list[Batch | Run] = []
    i = 0
    while i < len(order):
        j = i
        while j + 1 < len(order) and _continues(order, later, kinds, i, j):
            j += 1
        if j - i >= run:
            steps.append(Run(tuple(order[i:j]), order[j], tuple(later[order[i]][1:])))
            i = j
        else:
            steps += _single(order[i : i + 1], later)
            i += 1
    return steps


def _single(order: list[Node], later: dict[Node, list[Node]]) -> list[Batch | Run]:
    """Nodes one by one."""
    return [Batch((node,), (tuple(later[node]),)) for node in order]


def _at_once(steps: list[Batch | Run]) -> list[Batch | Run]:
    """Returns the elimination with equal nodes that do not wait for each other in one step.

    A step waits for those that change its nodes; all that wait for equally many are a level.
    """
    waits: dict[Node, int] = {}
    levels: dict[Any, list[Batch | Run]] = {}
    for step in steps:
        level = max(waits.get(node, 0) for node in step.nodes)
        run = isinstance(step, Run)
        after = [step.parent, *step.border] if run else [q for s in step.later for q in s]
        for node in after:
            waits[node] = max(waits.get(node, 0), level + 1)
        alone = (step,) if run else ()
        sizes = tuple(node.size for node in after)
        levels.setdefault((level, step.nodes[0].group, sizes, *alone), []).append(step)
    merged: list[Batch | Run] = []
    for _, equal in sorted(levels.items(), key=lambda item: item[0][0]):
        pairs = [(s.nodes[0], s.later[0]) for s in equal if isinstance(s, Batch)]
        if pairs:
            pairs.sort(key=lambda pair: pair[0].element)
            nodes, later = zip(*pairs, strict=True)
            equal = [Batch(nodes, later)]
        merged += equal
    return merged


def _continues(order: list[Node], later: Any, kinds: Any, i: int, j: int) -> bool:
    """Returns True where a run from i to j goes on: same group and kind, next element."""
    node, following = order[j], order[j + 1]
    if later[node] != [following, *later[order[i]][1:]] or node.group != following.group:
        return False

    def kind(k: int) -> Any:
        stride = order[k + 1].element - order[k].element
        return stride, kinds.get((order[k + 1], order[k]))

    return abs(following.element - node.element) == 1 and kind(j) == kind(i)
