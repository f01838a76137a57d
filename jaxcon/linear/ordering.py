"""Plans the elimination of the sparse block matrix A = J M⁻¹ Jᵀ, on the host, once per structure.

The nodes of the graph are constraints, that is, elements of Jacobian blocks. Two nodes are
neighbors if they touch a common body, because their block of A is then nonzero. The module
`graphs` orders the nodes; this module turns the order into steps of many nodes each.
"""

import functools
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

from jaxcon.linear.graphs import distances, independent_sets, minimum_degree
from jaxcon.linear.jacobian import Columns

ORDERS = ("runs", "levels")
RUN = 6
"""The smallest number of successive equal nodes that are eliminated in a loop."""
Structure = tuple[tuple[int, int, Columns], ...]
"""The structure of J: (first row, rows per element, columns) for each Jacobian block."""


@dataclass(frozen=True)
class EliminationNode:
    """One constraint, as a node of the elimination graph.

    Attributes:
        group: the first row of its group of equal constraints in J; names the group.
        element: the number of the constraint within the group.
        size: the number of rows of the constraint.
    """

    group: int
    element: int
    size: int


@dataclass(frozen=True)
class BlockCoupling:
    """The off-diagonal blocks of A that two Jacobian blocks contribute to.

    The elements are paired: both elements of a pair, one from each block, touch a common body.

    Attributes:
        blocks: the positions of the two Jacobian blocks in `Jacobian.blocks`.
        elements: the element numbers in the first and in the second block, (pairs,) each.
        pairs: the nodes of each pair of elements.
    """

    blocks: tuple[int, int]
    elements: tuple[tuple[int, ...], tuple[int, ...]]
    pairs: tuple[tuple[EliminationNode, EliminationNode], ...]


@dataclass(frozen=True)
class EliminationBatch:
    """An elimination step of nodes of one group that are not neighbors, all eliminated at once.

    Attributes:
        nodes: the nodes, in ascending order of their elements.
        later: for each node, the neighbors that are eliminated later, in order of elimination.
            All nodes have equally many later neighbors, of equal sizes.
    """

    nodes: tuple[EliminationNode, ...]
    later: tuple[tuple[EliminationNode, ...], ...]

    @property
    def slots(self) -> list[tuple[EliminationNode, ...]]:
        """The transpose of `later`: entry i holds the i-th later neighbor of every node."""
        return list(zip(*self.later, strict=True))


@dataclass(frozen=True)
class EliminationRun:
    """An elimination step that is a chain: each node is a later neighbor of the previous node.

    Attributes:
        nodes: nodes of one group, in the order of elimination; their elements are consecutive
            numbers, ascending or descending.
        parent: the node after the last node of the chain; not part of the run.
        border: the other later neighbors, which all nodes of the run share.
    """

    nodes: tuple[EliminationNode, ...]
    parent: EliminationNode
    border: tuple[EliminationNode, ...] = ()

    @property
    def ascending(self) -> list[EliminationNode]:
        """The nodes in ascending order of their elements."""
        return list(self.nodes[::-1] if self.descending else self.nodes)

    @property
    def pairs(self) -> list[tuple[EliminationNode, EliminationNode]]:
        """The pairs (next node to eliminate, node), in ascending order of the node's element."""
        pairs = list(zip((*self.nodes[1:], self.parent), self.nodes, strict=True))
        return pairs[::-1] if self.descending else pairs

    @property
    def descending(self) -> bool:
        """True if the elements are eliminated in descending order."""
        return self.parent.element < self.nodes[-1].element


@dataclass(frozen=True)
class Plan:
    """The plan by which A is eliminated, for one structure of J.

    Attributes:
        couplings: the nonzero off-diagonal blocks of A.
        steps: the elimination steps, in order.
    """

    couplings: tuple[BlockCoupling, ...]
    steps: tuple[EliminationBatch | EliminationRun, ...]


@functools.lru_cache(maxsize=256)
def plan(structure: Structure, run: int = RUN, order: str = "runs") -> Plan:
    """Plans the elimination of A for a given structure of J.

    Args:
        structure: (first row, rows per element, columns) for each Jacobian block.
        run: the smallest number of nodes that form an `EliminationRun`.
        order: "runs" for the fewest operations, or "levels" for the fewest sequential steps.

    Raises:
        ValueError: the order is neither "runs" nor "levels".
    """
    if order not in ORDERS:
        raise ValueError(f"Sparse: order must be one of {ORDERS} or None, got {order!r}.")
    couplings = _couplings(structure)
    neighbors = {
        EliminationNode(start, element, size): set[EliminationNode]()
        for start, size, columns in structure
        for element in range(len(columns.indices))
    }
    kinds: dict[tuple[EliminationNode, EliminationNode], list[tuple[int, bool]]] = {}
    for c, coupling in enumerate(couplings):
        for first, second in coupling.pairs:
            for pair, swapped in (((first, second), False), ((second, first), True)):
                neighbors[pair[0]].add(pair[1])
                kinds.setdefault(pair, []).append((c, swapped))
    if order == "levels":
        nodes, later = independent_sets(neighbors)
        steps: list[EliminationBatch | EliminationRun] = [
            EliminationBatch((node,), (tuple(later[node]),)) for node in nodes
        ]
    else:
        bodies = Counter(start for start, _, _ in structure)
        grounded = [node for node in neighbors if bodies[node.group] == 1]
        found = minimum_degree(neighbors, distances(neighbors, grounded))
        steps = _steps(*found, kinds, run)
    return Plan(tuple(couplings), tuple(_at_once(steps)))


def _couplings(structure: Structure) -> list[BlockCoupling]:
    """Returns the off-diagonal blocks of A, by pairs of Jacobian blocks with common bodies."""
    touching: dict[tuple[int, int], list[tuple[int, int]]] = {}  # body: all (block, element)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for b, (_, _, columns) in enumerate(structure):
        for element, body in enumerate(columns.indices):
            touching.setdefault((columns.start, body), []).append((b, element))
    for members in touching.values():
        for i, (b, x) in enumerate(members):
            for c, y in members[:i]:
                if (structure[b][0], x) != (structure[c][0], y):
                    pairs.setdefault((b, c), []).append((x, y))
    couplings = []
    for blocks, elements in pairs.items():
        first, second = zip(*sorted(elements), strict=True)
        (p, m, _), (q, n, _) = (structure[b] for b in blocks)
        nodes = tuple(
            (EliminationNode(p, x, m), EliminationNode(q, y, n))
            for x, y in zip(first, second, strict=True)
        )
        couplings.append(BlockCoupling(blocks, (first, second), nodes))
    return couplings


def _steps(
    order: list[EliminationNode],
    later: dict[EliminationNode, list[EliminationNode]],
    kinds: dict[tuple[EliminationNode, EliminationNode], list[tuple[int, bool]]],
    run: int,
) -> list[EliminationBatch | EliminationRun]:
    """Splits the elimination order into runs and single nodes.

    A run is a sequence of consecutive elements of one group. Each is coupled to the next element by
    the same coupling blocks. All of them have the same border: the later neighbors besides the next
    element.

    Args:
        order: the nodes in the order of elimination.
        later: the later neighbors of each node.
        kinds: for each pair (i, j) of neighbors, the numbers of the coupling blocks between them,
            and True where a block is stored as (j, i).
        run: the smallest number of nodes that form a run.
    """

    def link(k: int) -> tuple[int, list[tuple[int, bool]] | None]:
        """Describes how the k-th node of the order is linked to the next node.

        Returns:
            The difference of their element numbers, and their coupling blocks; None for no block.
        """
        node, following = order[k : k + 2]
        return following.element - node.element, kinds.get((following, node))

    def continues(i: int, j: int) -> bool:
        """Returns True if a run of the nodes i to j can be extended by the node after j.

        Node j must have the next element of its group as its next neighbor, and the border and
        coupling blocks of node i.
        """
        node, following = order[j : j + 2]
        same = later[node] == [following, *later[order[i]][1:]] and node.group == following.group
        return same and abs(link(j)[0]) == 1 and link(j) == link(i)

    steps: list[EliminationBatch | EliminationRun] = []
    i = 0
    while i < len(order):
        j = i
        while j + 1 < len(order) and continues(i, j):
            j += 1
        if j - i >= run:
            steps.append(EliminationRun(tuple(order[i:j]), order[j], tuple(later[order[i]][1:])))
        else:
            j = i + 1
            steps.append(EliminationBatch((order[i],), (tuple(later[order[i]]),)))
        i = j
    return steps


def _at_once(
    steps: list[EliminationBatch | EliminationRun],
) -> list[EliminationBatch | EliminationRun]:
    """Merges steps of single nodes that can be eliminated at once.

    A step depends on all earlier steps that update its nodes. Its level is the length of the
    longest chain of such dependencies. Steps of single nodes are merged if they have the same level
    and group, and later neighbors of the same sizes. Runs are not merged.
    """
    waits: dict[EliminationNode, int] = {}
    levels: dict[tuple[Hashable, ...], list[EliminationBatch | EliminationRun]] = {}
    for step in steps:
        level = max(waits.get(node, 0) for node in step.nodes)
        run = isinstance(step, EliminationRun)
        after = [step.parent, *step.border] if run else [q for s in step.later for q in s]
        for node in after:
            waits[node] = max(waits.get(node, 0), level + 1)
        sizes = tuple(node.size for node in after)
        key = (level, step.nodes[0].group, sizes, *((step,) if run else ()))
        levels.setdefault(key, []).append(step)
    merged: list[EliminationBatch | EliminationRun] = []
    for _, equal in sorted(levels.items(), key=lambda item: item[0][:1]):
        pairs = [(s.nodes[0], s.later[0]) for s in equal if isinstance(s, EliminationBatch)]
        pairs.sort(key=lambda pair: pair[0].element)
        merged += [EliminationBatch(*zip(*pairs, strict=True))] if pairs else equal
    return merged
