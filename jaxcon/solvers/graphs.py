"""Orders in which the nodes of a graph are eliminated: host code.

Eliminating a node makes its later neighbours neighbours of each other. Minimum degree keeps that
fill small: a tree of joints of two bodies each has none.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from typing import Any

HUB = 4
"""How many times more neighbours than the middle one of all nodes a hub has."""


def independent_sets(
    neighbours: dict[Any, set[Any]], degree: int = 2
) -> tuple[list[Any], dict[Any, list[Any]]]:
    """An order in few rounds, each of nodes that do not touch each other; else `minimum_degree`.

    A round takes nodes of the least degree or of at most `degree`: eliminating a node with two
    neighbours makes these neighbours of each other, so that no degree grows. A chain of n is done
    in log₂ n rounds (cyclic reduction). Hubs are eliminated after all others and not counted among
    their neighbours: a row that touches everything would make every degree but those of the ends
    too large, and leave two nodes to a round.
    """
    graph = {node: set(around) for node, around in neighbours.items()}
    order: list[Any] = []
    later: dict[Any, set[Any]] = {}
    hubs = _hubs(graph, degree)
    while graph:
        if hubs.issuperset(graph):  # only these are left
            hubs = _hubs(graph, degree)
        counted = {node: around - hubs for node, around in graph.items() if node not in hubs}
        most = max(degree, min(map(len, counted.values())))
        blocked: set[Any] = set()
        chosen = []
        for node, around in counted.items():
            if node not in blocked and len(around) <= most:
                chosen.append(node)
                blocked |= around
        for node in chosen:
            later[node] = _eliminate(graph, node)
        order += chosen
    return order, _sorted(order, later)


def _hubs(graph: dict[Any, set[Any]], degree: int) -> set[Any]:
    """Nodes that touch many times more others than most nodes do; never all."""
    degrees = sorted(map(len, graph.values()))
    usual = max(degree, degrees[len(degrees) // 2] if degrees else 0)
    return {node for node, around in graph.items() if len(around) > HUB * usual}


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

    def key(node: Any) -> tuple[int, bool, int, int]:
        return len(graph[node]), node not in near, distance[node], rank[node]

    # the least of all, by a heap in which degrees that have changed stand twice, and of the near
    heap = [(len(graph[node]), distance[node], rank[node], node) for node in graph]
    heapq.heapify(heap)
    while graph:
        while heap[0][3] not in graph or heap[0][0] != len(graph[heap[0][3]]):
            heapq.heappop(heap)
        node = min((heap[0][3], *near), key=key)
        later[node] = near = _eliminate(graph, node)
        order.append(node)
        for other in near:
            heapq.heappush(heap, (len(graph[other]), distance[other], rank[other], other))
    return order, _sorted(order, later)


def _eliminate(graph: dict[Any, set[Any]], node: Any) -> set[Any]:
    """Takes a node out of a graph, whose neighbours become neighbours of each other."""
    around = graph.pop(node)
    for other in around:
        graph[other] |= around - {other}
        graph[other].discard(node)
    return around


def _sorted(order: list[Any], later: dict[Any, set[Any]]) -> dict[Any, list[Any]]:
    """The later neighbours in the order of elimination."""
    position = {node: i for i, node in enumerate(order)}
    return {node: sorted(s, key=position.__getitem__) for node, s in later.items()}


def distances(neighbours: dict[Any, set[Any]], start: list[Any]) -> dict[Any, int]:
    """How many nodes away each is from the nearest of some; all of them where there is none."""
    result = dict.fromkeys(start, 0)
    front, away = start, 0
    while front:
        away += 1
        front = [other for node in front for other in neighbours[node] if other not in result]
        result.update(dict.fromkeys(front, away))
    return {node: result.get(node, len(neighbours)) for node in neighbours}
