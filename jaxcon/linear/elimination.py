"""Block LDLᵀ factorization and substitution along an elimination plan, vectorized over nodes."""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, minus, side_by_side, take, total
from jaxcon.core.typing import Array, Lane
from jaxcon.linear import blocks
from jaxcon.linear.blocks import Block
from jaxcon.linear.delassus import diagonal_blocks, weighted
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.ordering import EliminationBatch, EliminationNode, EliminationRun, Plan

T = TypeVar("T")
Key = EliminationNode | tuple[EliminationNode, EliminationNode] | None
Lanes = list[Lane]


class Pieces:
    """A sparse block matrix or vector; the block at a key is the sum of the pieces added to it.

    A key is an `EliminationNode` (vector) or a pair of nodes (matrix). Many keys are read and
    written at once, as lanes (key, …). If the pieces of these keys lie in order in one array,
    reading them takes no gather.
    """

    def __init__(self) -> None:
        self.pieces: dict[Any, list[tuple[Block, int]]] = {}

    def add(self, keys: Iterable[Key], block: Block) -> None:
        """Adds a piece to the block at each key.

        Args:
            keys: the keys.
            block: the pieces as lanes (key, …): entry i of each lane belongs to the i-th key.
        """
        for i, key in enumerate(keys):
            self.pieces.setdefault(key, []).append((block, i))

    def sum(self, keys: Iterable[Key]) -> Block:
        """Returns the blocks at the given keys, as lanes (key, …), or [] if all are zero."""
        total: Block = []
        for pieces in itertools.zip_longest(*(self.pieces.get(key, ()) for key in keys)):
            shape = next(piece[0] for piece in pieces if piece is not None)
            block = [
                [
                    side_by_side([(0.0, 0) if p is None else (p[0][r][c], p[1]) for p in pieces])
                    for c in range(len(row))
                ]
                for r, row in enumerate(shape)
            ]
            total = blocks.add(total, block) if total else block
        return total


Down = Callable[[Pieces, Pieces], Lanes]
Back = Callable[[Lanes, Pieces], None]


class Elimination:
    """The block LDLᵀ factorization of A = J M⁻¹ Jᵀ + C, following the steps of a plan.

    Eliminating a node p factors its pivot block A_pp = L D Lᵀ. Each later neighbor q gets the
    coupling H_q = A_qp L⁻ᵀ D⁻¹, and each pair q, r the update A_qr −= H_q D H_rᵀ. Forward
    substitution computes y_p = L⁻¹ b_p and b_q −= H_q y_p. Backward substitution computes
    x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q). A step handles many nodes: independent nodes at once, along
    the lanes, and the nodes of a run in a loop.

    Without earlier rows, the pivot D_r of row r would be its diagonal entry A_rr. If D_r is at most
    `rounding` times A_rr, row r is a linear combination of earlier rows. Such dependent rows are
    left out if `leaves_out` is True.

    Attributes:
        margin: a number for each world, which is positive if no rows are dependent. It is the least
            of all D_r⁻¹ and all 1 − rounding A_rr D_r⁻¹. It needs no further division, and is
            negative for negative pivots, too.
        finite: True for each world whose A is finite.
    """

    def __init__(
        self,
        matrices: tuple[Jacobian, Array, Array | None],
        plan: Plan,
        batch: tuple[int, ...],
        rounding: float,
        leaves_out: bool = False,
    ) -> None:
        jacobian, inverse_mass, compliance = matrices
        self.batch, self.dtype = batch, inverse_mass.dtype
        self.rounding, self.leaves_out = rounding, leaves_out
        self.groups = {block.start: block.shape for block in jacobian.blocks}
        self.entries, self.updates = Pieces(), Pieces()
        rows = weighted(jacobian, inverse_mass)
        diagonal = diagonal_blocks(jacobian, rows, compliance)
        for start in self.groups:
            self.entries.add([(node, node) for node in self._nodes(start)], diagonal[start])
        for coupling in plan.couplings:
            (first, second), (x, y) = coupling.blocks, coupling.elements
            left = [[take(lane, x) for lane in row] for row in rows[first]]
            right = [[take(lane, y) for lane in row] for row in jacobian.blocks[second].value]
            block = blocks.product(left, right)
            self.entries.add(coupling.pairs, block)
            self.entries.add([(q, p) for p, q in coupling.pairs], blocks.transpose(block))
        traces = (total(row[-1] for row in block) for block in diagonal.values())
        self.finite = jnp.isfinite(total(jnp.sum(x, axis=0) for x in traces))
        self.margin = jnp.ones(batch, self.dtype)
        self.factors = [
            self._run(step) if isinstance(step, EliminationRun) else self._batch(step)
            for step in plan.steps
        ]

    def substitute(self, right: Array) -> Array:
        """Returns A⁻¹ b, (n_c,), by forward and backward substitution along the plan."""
        b, taken, x = Pieces(), Pieces(), Pieces()
        for start, shape in self.groups.items():
            b.add(self._nodes(start), [list(Vector.of_rows(right, start, *shape))])
        middle = [down(b, taken) for down, _ in self.factors]
        for (_, back), y in reversed(list(zip(self.factors, middle, strict=True))):
            back(y, x)
        return jnp.concatenate(
            [z for start in sorted(self.groups) for z in x.sum(self._nodes(start))[0]]
        )

    def _batch(self, step: EliminationBatch) -> tuple[Down, Back]:
        """Eliminates the nodes of a batch, which are not neighbors, all at once.

        Returns:
            The function of forward substitution, `down`, and of backward substitution, `back`.
        """
        diagonal = [(p, p) for p in step.nodes]
        whole = self._entries(diagonal)
        factor = blocks.ldl(_less(whole, self.updates.sum(diagonal)), self._least(whole))
        self.margin = jnp.minimum(self.margin, jnp.min(self._margin(whole, factor), axis=0))
        pairs = [list(zip(slot, step.nodes, strict=True)) for slot in step.slots]
        sides = [_less(self._entries(x), self.updates.sum(x)) for x in pairs]
        gains, products = _eliminate(factor, sides)
        for (i, j), product in products.items():
            self.updates.add(zip(step.slots[i], step.slots[j], strict=True), product)

        def down(b: Pieces, taken: Pieces) -> Lanes:
            """Substitutes forward: y_p = L⁻¹ b_p for each node p of the batch.

            Args:
                b: the right-hand sides.
                taken: the sums to subtract from b at each node. This function reads those at the
                    nodes p, and adds H_q y_p at their later neighbors q.

            Returns:
                D⁻¹ y_p as lanes (node, …).
            """
            y = blocks.forward(factor, _less(b.sum(step.nodes), taken.sum(step.nodes))[0])
            for slot, gain in zip(step.slots, gains, strict=True):
                taken.add(slot, [blocks.apply(gain, y)])
            return blocks.scale(factor, y)

        def back(y: Lanes, x: Pieces) -> None:
            """Substitutes backward: x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q) for each node p of the batch.

            Args:
                y: D⁻¹ y_p, from `down`.
                x: the solution, known at the later neighbors q; this function adds x_p to it.
            """
            for slot, gain in zip(step.slots, gains, strict=True):
                pull = blocks.apply(blocks.transpose(gain), x.sum(slot)[0])
                y = [minus(a, c) for a, c in zip(y, pull, strict=True)]
            x.add(step.nodes, [blocks.backward(factor, y)])

        return down, back

    def _run(self, step: EliminationRun) -> tuple[Down, Back]:
        """Eliminates the nodes of a run in a loop, one node in each iteration.

        The loop carries the updates of the next node and of the border nodes.

        Returns:
            The function of forward substitution, `down`, and of backward substitution, `back`.
        """
        nodes, first, later = step.ascending, step.nodes[0], (step.parent, *step.border)
        others = [None if p == first else p for p in nodes]
        whole = self._entries([(p, p) for p in nodes])
        changed = self.updates.sum([p and (p, p) for p in others])
        sides = [_less(self._entries(step.pairs), self.updates.sum(step.pairs))]
        for g in step.border:
            side = self._entries([(g, p) for p in nodes])
            sides.append(_less(side, self.updates.sum([p and (g, p) for p in others])))

        def eliminate(
            carry: tuple[dict[tuple[int, int], Block], Lane],
            rows: tuple[Block, list[Block]],
            k: Array,
        ) -> Any:
            (updates, margin), (pivot, sides) = carry, rows
            original = row_of(whole, k) if changed else pivot
            factor = blocks.ldl(blocks.subtract(pivot, updates[0, 0]), self._least(original))
            border = [blocks.subtract(x, updates[j, 0]) for j, x in enumerate(sides[1:], 1)]
            gains, products = _eliminate(factor, [sides[0], *border])
            updates = {
                key: blocks.add(updates[key], x) if key[1] else x for key, x in products.items()
            }
            return (updates, jnp.minimum(margin, self._margin(original, factor))), (factor, gains)

        rows = self._spread((_less(whole, changed), sides), len(nodes))
        start = {(0, 0): self.updates.sum([(first, first)]) or blocks.zero(first.size)}
        for j, g in enumerate(step.border, 1):
            start[j, 0] = self.updates.sum([(g, first)]) or blocks.zero(g.size, first.size)
            start |= {(j, i): blocks.zero(g.size, p.size) for i, p in enumerate(later[1:j], 1)}
            start[j, j] = blocks.zero(g.size)
        start = jax.tree.map(lambda x: x[0], self._spread(start, 1))
        (last, self.margin), (factors, gains) = _along(step, eliminate, (start, self.margin), rows)
        for (i, j), product in last.items():
            self.updates.add([(later[i], later[j])], jax.tree.map(lambda x: x[None], product))

        def down(b: Pieces, taken: Pieces) -> Lanes:
            """Substitutes forward along the run: y_p = L⁻¹ b_p for each node p, in a loop.

            The loop carries H_q y_p of the next node q, and the sums of H_q y_p of each border
            node q.

            Args:
                b: the right-hand sides.
                taken: the sums to subtract from b at each node. This function reads those at the
                    nodes of the run, and adds the carried sums at the end of the loop.

            Returns:
                D⁻¹ y_p as lanes (node, …).
            """

            def eliminate(carry: list[Lanes], right: Lanes, k: Array) -> tuple[list[Lanes], Lanes]:
                factor, gain = row_of((factors, gains), k)
                y = blocks.forward(factor, [x - u for x, u in zip(right, carry[0], strict=True)])
                following, *border = (blocks.apply(x, y) for x in gain)
                pairs = zip(carry[1:], border, strict=True)
                sums = [[u + x for u, x in zip(old, new, strict=True)] for old, new in pairs]
                return [following, *sums], blocks.scale(factor, y)

            (right,) = _less(b.sum(nodes), taken.sum(others))
            (before,) = taken.sum([first]) or [[jnp.zeros_like(x) for x in right]]
            nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), right[0])
            start = [_first(before), *([nothing] * g.size for g in step.border)]
            last, y = _along(step, eliminate, start, right)
            for q, amount in zip(later, last, strict=True):
                taken.add([q], [[x[None] for x in amount]])
            return y

        def back(y: Lanes, x: Pieces) -> None:
            """Substitutes backward along the run: x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q) for each node p.

            The loop carries the solution x_q of the node that was eliminated after p.

            Args:
                y: D⁻¹ y_p, from `down`.
                x: the solution, known after the run and at its border; this function adds all x_p.
            """
            border = [_first(x.sum([g])[0]) for g in step.border]

            def substitute(following: Lanes, right: Lanes, k: Array) -> tuple[Lanes, Lanes]:
                factor, gain = row_of((factors, gains), k)
                for h, solution in zip(gain, (following, *border), strict=True):
                    pull = blocks.apply(blocks.transpose(h), solution)
                    right = [a - c for a, c in zip(right, pull, strict=True)]
                solution = blocks.backward(factor, right)
                return solution, solution

            start = _first(x.sum([step.parent])[0])
            x.add(nodes, [_along(step, substitute, start, y, down=False)[1]])

        return down, back

    def _nodes(self, start: int) -> list[EliminationNode]:
        """Returns all nodes of the group of equal constraints whose first row is `start`."""
        size, count = self.groups[start]
        return [EliminationNode(start, element, size) for element in range(count)]

    def _entries(self, pairs: Sequence[tuple[EliminationNode, EliminationNode]]) -> Block:
        """Returns the blocks A_qp of node pairs (q, p), without the updates by eliminations."""
        q, p = pairs[0]
        return self.entries.sum(pairs) or blocks.zero(q.size, p.size)

    def _spread(self, tree: T, count: int) -> T:
        """Broadcasts all lanes of a tree to shape (count, …), where … are the batch axes."""
        shape = (count, *self.batch)
        return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, self.dtype), shape), tree)

    def _least(self, whole: Block) -> Lanes | None:
        """Returns the bounds of the pivots for `blocks.ldl`; None if no row may be left out.

        Args:
            whole: the diagonal blocks A_pp, without updates by eliminations.
        """
        return [self.rounding * a[-1] for a in whole] if self.leaves_out else None

    def _margin(self, whole: Block, factor: Block) -> Lane:
        """Returns the least of all D_r⁻¹ and 1 − rounding A_rr D_r⁻¹ of each node.

        The result is positive for nodes without dependent rows.

        Args:
            whole: the diagonal blocks A_pp of the nodes, without updates by eliminations.
            factor: L and D⁻¹ of the pivot blocks.
        """
        inverse = [row[-1] for row in factor]
        rests = [1 - self.rounding * a[-1] * x for a, x in zip(whole, inverse, strict=True)]
        return functools.reduce(jnp.minimum, [*inverse, *rests])


def _less(block: Block, taken: Block) -> Block:
    """Returns the difference of two blocks, `block` − `taken`; an empty `taken` counts as zero."""
    return blocks.subtract(block, taken) if taken else block


def _eliminate(
    factor: Block, sides: list[Block]
) -> tuple[list[Block], dict[tuple[int, int], Block]]:
    """Computes the couplings and the updates of the later neighbors of an eliminated node p.

    Args:
        factor: L and D⁻¹ of the pivot block A_pp; see `blocks.ldl`.
        sides: the blocks A_qp of the later neighbors q.

    Returns:
        The couplings H_q = A_qp L⁻ᵀ D⁻¹, in the order of `sides`; and the updates H_q D H_rᵀ, keyed
        by the positions (q, r) in `sides`, with r ≤ q.
    """
    halves = [[blocks.forward(factor, row) for row in side] for side in sides]
    gains = [[blocks.scale(factor, row) for row in half] for half in halves]
    return gains, {
        (q, r): blocks.product(half, gains[r], lower=q == r)
        for q, half in enumerate(halves)
        for r in range(q + 1)
    }


def _along(
    step: EliminationRun, function: Callable[..., Any], carry: Any, rows: Any, down: bool = True
) -> Any:
    """Scans over the nodes of a run, like `jax.lax.scan`, but overwrites its input in place.

    Args:
        step: the run.
        function: (carry, rows of a node, index of the node) → the carry for the next node, and the
            new rows of this node.
        carry: the initial carry.
        rows: a tree of arrays (node, …), in ascending order of the nodes' elements.
        down: True to visit the nodes in the order of elimination, False in reverse order.

    Returns:
        The final carry and the new rows.
    """
    count = len(step.nodes)

    def visit(k: Array, state: Any) -> Any:
        carry, rows = state
        i = count - 1 - k if step.descending == down else k
        carry, new = function(carry, row_of(rows, i), i)
        return carry, jax.tree.map(
            lambda x, y: jax.lax.dynamic_update_index_in_dim(x, y, i, 0), rows, new
        )

    return jax.lax.fori_loop(0, count, visit, (carry, rows))


def _first(lanes: Lanes) -> Lanes:
    """Returns the entry of the first node, x[0], of each lane x (node, …)."""
    return jax.tree.map(lambda x: x[0], lanes)


def row_of(tree: T, i: Array) -> T:
    """Returns row i of each array in a tree; Python numbers and scalars are unchanged."""
    return jax.tree.map(
        lambda x: (
            jax.lax.dynamic_index_in_dim(x, i, keepdims=False)
            if isinstance(x, jax.Array) and x.ndim
            else x
        ),
        tree,
    )
