"""Factorization and substitution along an elimination plan, by lanes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, take, total
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks
from jaxcon.solvers.blocks import Block
from jaxcon.solvers.delassus import diagonal_blocks, softened, weighted
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.ordering import Batch, Node, Plan, Run
from jaxcon.solvers.pieces import Pieces, Vectors, less


class Elimination:
    """The factorization of one A, step by step of its plan.

    Eliminating node p with pivot block A_pp = L D Lᵀ leaves H_q = A_qp L⁻ᵀ D⁻¹ for each later
    neighbour q, and A_qr −= H_q D H_rᵀ. Then y_p = L⁻¹ b_p and b_q −= H_q y_p on the way down, and
    on the way back x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q). A step does this for many nodes: for those
    that do not wait for each other at once, along lanes, and for those of a run in a loop.

    A row is a combination of the rows before it where its pivot D_r is not above `rounding` of its
    diagonal entry A_rr, the pivot that it would have without them. Such rows may be left out.

    Attributes:
        margin: positive, by world, where no row is such a combination: the least of D_r⁻¹ and of
            1 − rounding A_rr D_r⁻¹, which needs no division and sees negative pivots, too.
        finite: whether A is, by world.
    """

    def __init__(
        self,
        matrices: tuple[Jacobian, Array, Any],
        plan: Plan,
        batch: Any,
        rounding: float,
        leaves_out: bool = False,
    ) -> None:
        self.batch, self.dtype = batch, matrices[1].dtype
        self.rounding, self.leaves_out = rounding, leaves_out
        self.groups = {block.start: block.shape for block in matrices[0].blocks}
        self.entries, trace = _matrix(plan, matrices)
        self.updates = Pieces()
        self.margin: Any = jnp.ones(batch, self.dtype)
        self.finite = jnp.isfinite(trace)
        self.factors = [
            self._run(step) if isinstance(step, Run) else self._batch(step) for step in plan.steps
        ]

    def substitute(self, right: Array) -> Array:
        """A⁻¹ b: down the order, then back."""
        b, x = Vectors(), Vectors()
        for start, (m, k) in self.groups.items():
            b.put(nodes_of(start, m, k), list(Vector.of_rows(right, start, m, k)))
        middle = [factor.down(b) for factor in self.factors]
        for factor, y in reversed(list(zip(self.factors, middle, strict=True))):
            factor.back(y, x)
        groups = sorted(self.groups.items())
        return jnp.concatenate(
            [z for start, (m, k) in groups for z in x.get(nodes_of(start, m, k))]
        )

    def _batch(self, step: Batch) -> BatchFactor:
        diagonal = [(p, p) for p in step.nodes]
        whole = self._entries(diagonal)
        factor = blocks.ldl(less(whole, self.updates.sum(diagonal)), self._least(whole))
        self.margin = jnp.minimum(self.margin, jnp.min(self._margin(whole, factor), axis=0))
        pairs = [list(zip(slot, step.nodes, strict=True)) for slot in step.slots]
        halves = [_halve(factor, less(self._entries(x), self.updates.sum(x))) for x in pairs]
        gains = [_gain(factor, half) for half in halves]
        for (i, j), product in _products(halves, gains).items():
            self.updates.add(zip(step.slots[i], step.slots[j], strict=True), product)
        return BatchFactor(step, factor, gains)

    def _run(self, step: Run) -> RunFactor:
        """Factors a run of nodes, carrying the updates of the next node and of the border."""
        nodes, first, later = step.ascending, step.nodes[0], (step.parent, *step.border)
        others = [None if p == first else p for p in nodes]
        whole = self._entries([(p, p) for p in nodes])
        changed = self.updates.sum((p, p) for p in others)
        pairs = step.pairs
        sides = [less(self._entries(pairs), self.updates.sum(pairs))]
        for g in step.border:
            side = self._entries([(g, p) for p in nodes])
            sides.append(less(side, self.updates.sum((g, p) for p in others)))

        def eliminate(carry: Any, rows: Any, k: Array) -> Any:
            (updates, margin), (pivot, sides) = carry, rows
            original = pivot if changed is None else row_of(whole, k)
            factor = blocks.ldl(blocks.subtract(pivot, updates[0, 0]), self._least(original))
            border = [blocks.subtract(x, updates[j, 0]) for j, x in enumerate(sides[1:], 1)]
            halves = [_halve(factor, side) for side in (sides[0], *border)]
            gains = [_gain(factor, half) for half in halves]
            products = _products(halves, gains)
            updates = {
                key: blocks.add(updates[key], x) if key[1] else x for key, x in products.items()
            }
            margin = jnp.minimum(margin, self._margin(original, factor))
            return (updates, margin), (factor, gains)

        rows = self._spread((less(whole, changed), sides), len(nodes))
        start = {(0, 0): self.updates.sum([(first, first)]) or _zero(first)}
        for j, g in enumerate(step.border, 1):
            start[j, 0] = self.updates.sum([(g, first)]) or _zero(g, first)
            start |= {
                (j, i): _zero(g, None if i == j else step.border[i - 1]) for i in range(1, j + 1)
            }
        start = jax.tree.map(lambda x: x[0], self._spread(start, 1))
        (last, self.margin), factors = _along(step, eliminate, (start, self.margin), rows)
        for (i, j), product in last.items():
            self.updates.add([(later[i], later[j])], jax.tree.map(lambda x: x[None], product))
        return RunFactor(step, *factors)

    def _entries(self, pairs: list[tuple[Node, Node]]) -> Block:
        """A_qp of several pairs before any elimination."""
        q, p = pairs[0]
        return self.entries.sum(pairs) or _zero(q, p)

    def _spread(self, tree: Any, count: int) -> Any:
        """Arrays (count, …) over the whole batch."""
        shape = (count, *self.batch)
        return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, self.dtype), shape), tree)

    def _least(self, whole: Block) -> list[Lane] | None:
        """The pivots above which rows are kept."""
        return [self.rounding * a[-1] for a in whole] if self.leaves_out else None

    def _margin(self, whole: Block, factor: Block) -> Lane:
        """Returns the margin of one node or of many; see `margin`."""
        inverse = [row[-1] for row in factor]
        rests = [1 - self.rounding * a[-1] * x for a, x in zip(whole, inverse, strict=True)]
        return functools.reduce(jnp.minimum, [*inverse, *rests])


def nodes_of(group: int, size: int, count: int) -> list[Node]:
    """All nodes of a group."""
    return [Node(group, element, size) for element in range(count)]


def _halve(factor: Block, side: Block) -> Block:
    """A_qp L⁻ᵀ."""
    return [blocks.forward(factor, row) for row in side]


def _gain(factor: Block, half: Block) -> Block:
    """A_qp L⁻ᵀ D⁻¹."""
    return [blocks.scale(factor, row) for row in half]


def _products(halves: list[Block], gains: list[Block]) -> dict[tuple[int, int], Block]:
    """H_q D H_rᵀ for the q-th and the r-th of some later neighbours, r ≤ q."""
    return {
        (q, r): blocks.product(half, blocks.transpose(gains[r]))
        if r < q
        else blocks.lower_product(half, gains[q])
        for q, half in enumerate(halves)
        for r in range(q + 1)
    }


def _zero(q: Node, p: Node | None = None) -> Block:
    """A block of zeros; the lower triangle of one on the diagonal where p is not given."""
    return [[0.0] * (r + 1 if p is None else p.size) for r in range(q.size)]


def _along(step: Run, function: Any, carry: Any, rows: Any, down: bool = True) -> Any:
    """The nodes of a run one after the other, each replacing its rows of arrays (node, …).

    In place, so that no memory is set up for results, and what is read is read where it lies.

    Args:
        step: the run.
        function: (carry, rows of the node, its place) → the carry for the next node, and the rows.
        carry: for the first node.
        rows: trees of arrays, ascending in the nodes' elements.
        down: in the order of elimination, or against it.
    """
    count = len(step.nodes)

    def at(k: Array, state: Any) -> Any:
        carry, rows = state
        i = count - 1 - k if step.descending == down else k
        carry, new = function(carry, row_of(rows, i), i)
        put = jax.lax.dynamic_update_index_in_dim
        return carry, jax.tree.map(lambda x, y: put(x, y, i, 0), rows, new)

    return jax.lax.fori_loop(0, count, at, (carry, rows))


def row_of(tree: Any, i: Any) -> Any:
    """Row i of arrays."""

    def row(x: Lane) -> Lane:
        lane = isinstance(x, jax.Array) and x.ndim
        return jax.lax.dynamic_index_in_dim(x, i, keepdims=False) if lane else x

    return jax.tree.map(row, tree)


@dataclass(frozen=True)
class BatchFactor:
    """Eliminated nodes: L and D⁻¹ of their pivots, and H_q for each of their later neighbours."""

    step: Batch
    factor: Block
    gains: list[Block]

    def down(self, b: Vectors) -> list[Lane]:
        """y_p = L⁻¹ b_p and b_q −= H_q y_p; returns D⁻¹ y_p."""
        y = blocks.forward(self.factor, b.get(self.step.nodes))
        for slot, gain in zip(self.step.slots, self.gains, strict=True):
            b.subtract(slot, blocks.apply(gain, y))
        return blocks.scale(self.factor, y)

    def back(self, y: list[Lane], x: Vectors) -> None:
        """x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q)."""
        for slot, gain in zip(self.step.slots, self.gains, strict=True):
            pull = blocks.apply(blocks.transpose(gain), x.get(slot))
            y = [blocks.minus(a, c) for a, c in zip(y, pull, strict=True)]
        x.put(self.step.nodes, blocks.backward(self.factor, y))


@dataclass(frozen=True)
class RunFactor:
    """An eliminated run: the same with a first axis over its nodes."""

    step: Run
    factor: Block
    gains: list[Block]

    def down(self, b: Vectors) -> list[Lane]:
        """Substitutes forwards along the run, carrying H y to the next node and the border."""

        def eliminate(taken: Any, right: Any, k: Array) -> Any:
            factor, gains = row_of((self.factor, self.gains), k)
            y = blocks.forward(factor, [x - u for x, u in zip(right, taken[0], strict=True)])
            following, *border = (blocks.apply(gain, y) for gain in gains)
            pairs = zip(taken[1:], border, strict=True)
            sums = [[u + x for u, x in zip(known, own, strict=True)] for known, own in pairs]
            return [following, *sums], blocks.scale(factor, y)

        right, taken = b.split(self.step.ascending, self.step.nodes[0])
        none = jnp.zeros_like(right[0][0])
        start = [[x[0] for x in taken], *([none] * g.size for g in self.step.border)]
        last, y = _along(self.step, eliminate, start, right)
        for q, amount in zip((self.step.parent, *self.step.border), last, strict=True):
            b.subtract([q], [x[None] for x in amount])
        return y

    def back(self, y: list[Lane], x: Vectors) -> None:
        """Substitutes backwards along the run, carrying the solution of the next node."""
        border = [[z[0] for z in x.get([g])] for g in self.step.border]

        def substitute(following: Any, own: Any, k: Array) -> Any:
            factor, gains = row_of((self.factor, self.gains), k)
            for gain, solution in zip(gains, (following, *border), strict=True):
                pull = blocks.apply(blocks.transpose(gain), solution)
                own = [a - c for a, c in zip(own, pull, strict=True)]
            solution = blocks.backward(factor, own)
            return solution, solution

        start = [z[0] for z in x.get([self.step.parent])]
        _, solution = _along(self.step, substitute, start, y, down=False)
        x.put(self.step.ascending, solution)


def _matrix(plan: Plan, matrices: Any) -> tuple[Pieces, Lane]:
    """A by its blocks, of those on the diagonal the lower triangles, and its trace."""
    jacobian, inverse_mass, compliance = matrices
    rows = weighted(jacobian, inverse_mass)
    groups = {block.start: block.shape for block in jacobian.blocks}
    diagonal = diagonal_blocks(jacobian, rows)
    if compliance is not None:
        diagonal = softened(diagonal, groups, compliance)
    entries = Pieces()
    for start, (m, k) in groups.items():
        entries.add([(node, node) for node in nodes_of(start, m, k)], diagonal[start])
    for coupling in plan.couplings:
        (first, second), (x, y) = coupling.blocks, coupling.elements
        left = [[take(lane, x) for lane in row] for row in rows[first]]
        right = [[take(lane, y) for lane in row] for row in jacobian.blocks[second].value]
        block = blocks.product(left, blocks.transpose(right))
        entries.add(coupling.pairs, block)
        entries.add([pair[::-1] for pair in coupling.pairs], blocks.transpose(block))
    traces = (total(row[-1] for row in block) for block in diagonal.values())
    return entries, total(jnp.sum(x, axis=0) for x in traces)
