"""Elimination orders for the nodes of a graph, computed on the host.

Eliminating a node connects all its later neighbors with each other; the new edges are the fill.
The minimum-degree order keeps the fill small. A tree of joints has no fill at all.
"""

import heapq
from collections.abc import Hashable, Mapping
from typing import TypeVar

N = TypeVar("N", bound=Hashable)
HUB = 4
"""A node is a hub if it has more than `HUB` times as many neighbors as the median node."""


def independent_sets(
    neighbors: dict[N, set[N]], degree: int = 2
) -> tuple[list[N], dict[N, list[N]]]:
    """Orders nodes for elimination in few rounds. No two nodes of a round are neighbors.

    A round eliminates nodes of degree at most `degree`; if there are none, it eliminates nodes of
    the smallest degree. Eliminating a node with two neighbors connects the two neighbors, so their
    degrees do not grow. So a chain of n nodes takes log₂ n rounds (cyclic reduction).

    Hubs, the nodes with by far the most neighbors, are eliminated after all other nodes. They do
    not count in the degrees of other nodes. Otherwise a constraint that touches every body would
    raise nearly all degrees above `degree`, and a round would have only about two nodes.

    Args:
        neighbors: the neighbors of each node.
        degree: the largest degree of the nodes in a round, unless all nodes have a larger degree.

    Returns:
        The order, and the later neighbors of each node in that order, fill included.
    """
    graph = {node: set(around) for node, around in neighbors.items()}
    order: list[N] = []
    later: dict[N, set[N]] = {}
    hubs: set[N] = set(graph)
    while graph:
        if hubs.issuperset(graph):  # at the start, and when only hubs are left
            degrees = sorted(map(len, graph.values()))
            usual = max(degree, degrees[len(degrees) // 2])
            hubs = {node for node, around in graph.items() if len(around) > HUB * usual}
        counted = {node: around - hubs for node, around in graph.items() if node not in hubs}
        most = max(degree, min(map(len, counted.values())))
        blocked: set[N] = set()
        chosen: list[N] = []
        for node, around in counted.items():
            if node not in blocked and len(around) <= most:
                chosen.append(node)
                blocked |= around
        for node in chosen:
            later[node] = _eliminate(graph, node)
        order += chosen
    return order, _sorted(order, later)


def minimum_degree(
    neighbors: dict[N, set[N]], distance: Mapping[N, int] | None = None
) -> tuple[list[N], dict[N, list[N]]]:
    """Orders the nodes by minimum degree.

    Among nodes of equal degree, neighbors of the last eliminated node come first, so that chains
    are eliminated from one end to the other. Next come the nodes nearest to the ground. A chain
    eliminated from the ground outward is well conditioned: each pivot equals that of a joint whose
    inner body is fixed. Eliminated from the free end, a chain of n links has pivots that fall like
    1/n³.

    Args:
        neighbors: the neighbors of each node.
        distance: the distance of each node from the ground; None to ignore it.

    Returns:
        The order, and the later neighbors of each node in that order, fill included.
    """
    distance = distance or dict.fromkeys(neighbors, 0)
    graph = {node: set(around) for node, around in neighbors.items()}
    rank = {node: i for i, node in enumerate(graph)}
    order: list[N] = []
    later: dict[N, set[N]] = {}
    near: set[N] = set()

    def key(node: N) -> tuple[int, bool, int, int]:
        return len(graph[node]), node not in near, distance[node], rank[node]

    # a heap of all nodes; a node whose degree has changed has stale entries, which are skipped
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


def _eliminate(graph: dict[N, set[N]], node: N) -> set[N]:
    """Removes a node from a graph in place, connects its neighbors, and returns the neighbors."""
    around = graph.pop(node)
    for other in around:
        graph[other] |= around - {other}
        graph[other].discard(node)
    return around


def _sorted(order: list[N], later: dict[N, set[N]]) -> dict[N, list[N]]:
    """Returns the later neighbors of each node, sorted by the order of elimination."""
    position = {node: i for i, node in enumerate(order)}
    return {node: sorted(s, key=position.__getitem__) for node, s in later.items()}


def distances(neighbors: dict[N, set[N]], start: list[N]) -> dict[N, int]:
    """Returns the number of edges from each node to its nearest node in `start`.

    A node that is not connected to `start` gets the value len(neighbors).
    """
    result = dict.fromkeys(start, 0)
    front, away = start, 0
    while front:
        away += 1
        front = [other for node in front for other in neighbors[node] if other not in result]
        result.update(dict.fromkeys(front, away))
    return {node: result.get(node, len(neighbors)) for node in neighbors}
