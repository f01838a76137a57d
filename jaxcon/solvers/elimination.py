"""Factorization and substitution along an elimination plan, by lanes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, plus, replaced, take, total
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks, ordering
from jaxcon.solvers.blocks import Block
from jaxcon.solvers.delassus import diagonal_blocks, softened, weighted
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.ordering import Node, Plan, Run, Single


class Elimination:
    """The factorization of one A, step by step of its plan.

    Eliminating node p with pivot block A_pp = L D Lᵀ leaves H_q = A_qp L⁻ᵀ D⁻¹ for each later
    neighbour q, and A_qr −= H_q D H_rᵀ. Then y_p = L⁻¹ b_p and b_q −= H_q y_p on the way down, and
    on the way back x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q).

    A row is a combination of the rows before it where its pivot D_r is not above `rounding` of its
    diagonal entry A_rr, the pivot that it would have without them.

    Attributes:
        margin: positive, by world, where no row is such a combination: the least of D_r⁻¹ and of
            1 − rounding A_rr D_r⁻¹, which needs no division and sees negative pivots, too.
        finite: whether A is, by world.
    """

    def __init__(
        self, matrices: tuple[Jacobian, Array, Any], run: int, batch: Any, rounding: float
    ) -> None:
        jacobian, inverse_mass, compliance = matrices
        structure = tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)
        self.plan = ordering.plan(structure, run)
        self.batch, self.dtype, self.rounding = batch, inverse_mass.dtype, rounding
        self.groups = {block.start: block.shape for block in jacobian.blocks}
        rows = weighted(jacobian, inverse_mass)
        self.diagonal = diagonal_blocks(jacobian, rows)
        self.couplings = _couplings(self.plan, jacobian, rows)
        if compliance is not None:
            self.diagonal = softened(self.diagonal, self.groups, compliance)
        self.updates: dict[tuple[Node, Node], Block] = {}
        self.margin: Any = jnp.ones(self.batch, self.dtype)
        traces = (total(block[r][r] for r in range(len(block))) for block in self.diagonal.values())
        self.finite = jnp.isfinite(total(jnp.sum(x, axis=0) for x in traces))
        self.factors = [
            self._run(step) if isinstance(step, Run) else self._single(step)
            for step in self.plan.steps
        ]

    def substitute(self, right: Array) -> Array:
        """A⁻¹ b: down the order, then back."""
        b, x = (Vectors(self.groups, values, self.batch) for values in (right, None))
        middle = [factor.down(b) for factor in self.factors]
        for factor, y in reversed(list(zip(self.factors, middle, strict=True))):
            factor.back(y, x)
        return x.join()

    def _single(self, step: Single) -> SingleFactor:
        node = step.node
        pivot = [[_at(x, node.element) for x in row] for row in self.diagonal[node.group]]
        update = self.updates.get((node, node), _no_update(node))
        factor = blocks.ldl(blocks.subtract(pivot, update))
        self.margin = self._judge(self.margin, pivot, factor)
        sides = [_halve(factor, self._coupling(q, node)) for q in step.later]
        gains = [[blocks.scale(factor, row) for row in a] for a in sides]
        for i, (q, side) in enumerate(zip(step.later, sides, strict=True)):
            for r, gain in zip(step.later[:i], gains, strict=False):
                self._update(q, r, blocks.product(side, blocks.transpose(gain)))
            self._update(q, q, blocks.lower_product(side, gains[i]))
        return SingleFactor(step, factor, gains)

    def _run(self, step: Run) -> RunFactor:
        """The same along a run, carrying the update of the next pivot."""
        first, *others = step.nodes

        def spread(x: Lane) -> Array:
            return jnp.broadcast_to(jnp.asarray(x, self.dtype), (len(step.nodes), *self.batch))

        def eliminate(carry: Any, rows: Any, k: Array) -> Any:
            (update, margin), (pivot, side) = carry, rows
            factor = blocks.ldl(blocks.subtract(pivot, update))
            half = _halve(factor, side)
            gain = [blocks.scale(factor, row) for row in half]
            margin = self._judge(margin, pivot, factor)
            return (blocks.lower_product(half, gain), margin), (factor, gain)

        diagonal = self.diagonal[first.group]
        pivots = [[spread(take(x, step.elements)) for x in row] for row in diagonal]
        for node in others:
            for r, row in enumerate(self.updates.get((node, node), ())):
                place = node.element - step.elements[0]
                pairs = zip(pivots[r], row, strict=True)
                pivots[r] = [replaced(x, place, blocks.minus(x[place], u)) for x, u in pairs]
        sides = [[spread(x) for x in row] for row in self._run_coupling(step)]
        known = self.updates.get((first, first), _no_update(first))
        start = [
            [jnp.broadcast_to(jnp.asarray(x, self.dtype), self.batch) for x in row] for row in known
        ]
        (last, self.margin), factors = _along(
            step, eliminate, (start, self.margin), (pivots, sides)
        )
        self._update(step.parent, step.parent, last)
        return RunFactor(step, *factors)

    def _run_coupling(self, step: Run) -> Block:
        """A_(next, node) of every node of a run, ascending in its elements."""
        nodes = [*step.nodes, step.parent]
        pairs = list(itertools.pairwise(nodes))
        pairs = pairs[::-1] if step.descending else pairs
        found = [self.plan.entries[q, p] for p, q in pairs]
        result: Block | None = None
        for column in zip(*found, strict=True):
            block = self.couplings[column[0].coupling]
            index = tuple(entry.pair for entry in column)
            part = [[take(x, index) for x in row] for row in block]
            part = blocks.transpose(part) if column[0].transposed else part
            result = part if result is None else blocks.add(result, part)
        assert result is not None
        return result

    def _coupling(self, q: Node, p: Node) -> Block:
        """A_qp as it is when p is eliminated."""
        result: Block = [[0.0] * p.size for _ in range(q.size)]
        for entry in self.plan.entries.get((q, p), ()):
            part = [[_at(x, entry.pair) for x in row] for row in self.couplings[entry.coupling]]
            result = blocks.add(result, blocks.transpose(part) if entry.transposed else part)
        update = self.updates.get((q, p))
        return result if update is None else blocks.subtract(result, update)

    def _update(self, q: Node, r: Node, amount: Block) -> None:
        known = self.updates.get((q, r))
        self.updates[q, r] = amount if known is None else blocks.add(known, amount)

    def _judge(self, margin: Lane, pivot: Block, factor: Block) -> Lane:
        for full, left in zip(pivot, factor, strict=True):
            rest = 1 - self.rounding * full[-1] * left[-1]
            margin = jnp.minimum(margin, jnp.minimum(left[-1], rest))
        return margin


def _no_update(node: Node) -> Block:
    return [[0.0] * (r + 1) for r in range(node.size)]


def _halve(factor: Block, side: Block) -> Block:
    """A_qp L⁻ᵀ."""
    return [blocks.forward(factor, row) for row in side]


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
        carry, new = function(carry, _row(rows, i), i)
        put = jax.lax.dynamic_update_index_in_dim
        return carry, jax.tree.map(lambda x, y: put(x, y, i, 0), rows, new)

    return jax.lax.fori_loop(0, count, at, (carry, rows))


def _row(tree: Any, i: Array) -> Any:
    """Row i of arrays."""
    return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, i, keepdims=False), tree)


@dataclass(frozen=True)
class SingleFactor:
    """One eliminated node: L and D⁻¹ of its pivot, and H_q for its later neighbours."""

    step: Single
    factor: Block
    gains: list[Block]

    def down(self, b: Vectors) -> list[Lane]:
        """y_p = L⁻¹ b_p and b_q −= H_q y_p; returns D⁻¹ y_p."""
        y = blocks.forward(self.factor, b.get(self.step.node))
        for q, gain in zip(self.step.later, self.gains, strict=True):
            b.subtract(q, blocks.apply(gain, y))
        return blocks.scale(self.factor, y)

    def back(self, y: list[Lane], x: Vectors) -> None:
        """x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q)."""
        for q, gain in zip(self.step.later, self.gains, strict=True):
            pull = blocks.apply(blocks.transpose(gain), x.solution(q))
            y = [blocks.minus(a, c) for a, c in zip(y, pull, strict=True)]
        x.nodes[self.step.node] = blocks.backward(self.factor, y)


@dataclass(frozen=True)
class RunFactor:
    """An eliminated run: the same with a first axis over its nodes, and one gain each."""

    step: Run
    factor: Block
    gain: Block

    def down(self, b: Vectors) -> list[Lane]:
        """The same, carrying H y to the next node."""

        def eliminate(update: Any, right: Any, k: Array) -> Any:
            factor, gain = _row((self.factor, self.gain), k)
            y = blocks.forward(factor, [x - u for x, u in zip(right, update, strict=True)])
            return blocks.apply(gain, y), blocks.scale(factor, y)

        right, start = b.get_run(self.step)
        last, y = _along(self.step, eliminate, start, right)
        b.subtract(self.step.parent, last)
        return y

    def back(self, y: list[Lane], x: Vectors) -> None:
        """The same, carrying the solution of the next node."""

        def substitute(following: Any, own: Any, k: Array) -> Any:
            factor, gain = _row((self.factor, self.gain), k)
            pull = blocks.apply(blocks.transpose(gain), following)
            solution = blocks.backward(factor, [a - c for a, c in zip(own, pull, strict=True)])
            return solution, solution

        start, step = x.solution(self.step.parent), self.step
        _, solution = _along(step, substitute, start, y, down=False)
        x.runs[step.nodes[0].group, step.elements[0]] = solution


class Vectors:
    """A vector by nodes: rows of a group as lanes (element, …), read and changed node by node."""

    def __init__(
        self, shapes: dict[int, tuple[int, int]], values: Array | None, batch: Any
    ) -> None:
        self.shapes, self.batch = shapes, batch
        self.groups: dict[int, list[Lane]] = {}
        self.taken: dict[Node, list[Lane]] = {}
        self.nodes: dict[Node, list[Lane]] = {}
        self.runs: dict[tuple[int, int], list[Lane]] = {}
        if values is not None:
            for start, (m, k) in shapes.items():
                rows = jax.lax.slice_in_dim(values, start, start + m * k)
                self.groups[start] = list(Vector.of(rows.reshape((m, k, *values.shape[1:]))))

    def get(self, node: Node) -> list[Lane]:
        """The lanes of one node, less what was subtracted from it."""
        own = [x[node.element] for x in self.groups[node.group]]
        taken = self.taken.get(node, [0.0] * node.size)
        return [blocks.minus(x, y) for x, y in zip(own, taken, strict=True)]

    def solution(self, node: Node) -> list[Lane]:
        """The lanes of one node that was solved by itself or in a run."""
        if node in self.nodes:
            return self.nodes[node]
        for (group, first), lanes in self.runs.items():
            place = node.element - first
            if group == node.group and 0 <= place < lanes[0].shape[0]:
                return [x[place] for x in lanes]
        raise KeyError(node)

    def subtract(self, node: Node, amount: list[Lane]) -> None:
        """Subtracts from one node."""
        known = self.taken.get(node, [0.0] * node.size)
        self.taken[node] = [plus(x, y) for x, y in zip(known, amount, strict=True)]

    def get_run(self, step: Run) -> tuple[list[Array], list[Array]]:
        """The lanes of the nodes of a run, ascending, and what to subtract from the first."""
        lanes = [take(x, step.elements) for x in self.groups[step.nodes[0].group]]
        first, *others = step.nodes
        for node in (node for node in others if node in self.taken):
            place = node.element - step.elements[0]
            pairs = zip(lanes, self.get(node), strict=True)
            lanes = [replaced(x, place, y) for x, y in pairs]
        taken = self.taken.get(first, [0.0] * first.size)
        dtype = lanes[0].dtype
        return lanes, [jnp.broadcast_to(jnp.asarray(y, dtype), self.batch) for y in taken]

    def join(self) -> Array:
        """One array (n_c, …)."""
        parts: list[Array] = []
        for start, (rows, _) in sorted(self.shapes.items()):
            pieces = {
                n.element: [x[None] for x in v] for n, v in self.nodes.items() if n.group == start
            }
            pieces |= {first: v for (group, first), v in self.runs.items() if group == start}
            parts += [pieces[element][r] for r in range(rows) for element in sorted(pieces)]
        return jnp.concatenate(parts)


def _at(x: Lane, i: int) -> Lane:
    return x[i] if isinstance(x, jax.Array) else x


def _couplings(plan: Plan, jacobian: Jacobian, rows: list[Block]) -> list[Block]:
    """The blocks of A off its diagonal from those of J M⁻¹, by lanes."""
    couplings = []
    for coupling in plan.couplings:
        (first, second), (x, y) = coupling.blocks, coupling.elements
        left = [[take(lane, x) for lane in row] for row in rows[first]]
        right = [[take(lane, y) for lane in row] for row in jacobian.blocks[second].value]
        couplings.append(blocks.product(left, blocks.transpose(right)))
    return couplings
