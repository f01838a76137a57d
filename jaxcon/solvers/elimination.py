"""Factorization and substitution along an elimination plan, by lanes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, plus, replaced, take, times, total
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks, ordering
from jaxcon.solvers.blocks import Block
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.ordering import Node, Plan, Run, Single


class Elimination:
    """The factorization of one A, step by step of its plan.

    Eliminating node p with pivot block A_pp = L D Lᵀ leaves H_q = A_qp L⁻ᵀ D⁻¹ for each later
    neighbour q, and A_qr −= H_q D H_rᵀ. Then y_p = L⁻¹ b_p and b_q −= H_q y_p on the way down, and
    on the way back x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q).

    Attributes:
        share: the smallest part of a row that the rows before it do not explain, by world.
        finite: whether A is, by world.
    """

    def __init__(self, matrices: tuple[Jacobian, Array, Any], run: int, batch: Any) -> None:
        jacobian, inverse_mass, compliance = matrices
        structure = tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)
        self.plan = ordering.plan(structure, run)
        self.batch, self.dtype = batch, inverse_mass.dtype
        self.groups = {block.start: block.shape for block in jacobian.blocks}
        self.diagonal, self.couplings = _blocks_of(self.plan, jacobian, inverse_mass)
        if compliance is not None:
            self._soften(compliance)
        self.updates: dict[tuple[Node, Node], Block] = {}
        self.share: Any = jnp.ones(self.batch, self.dtype)
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
        original = [pivot[r][r] for r in range(node.size)]
        if (node, node) in self.updates:
            pivot = blocks.subtract(pivot, self.updates[node, node])
        lower, inverse = blocks.ldl(pivot)
        self._judge(original, inverse)
        sides = [_halve(lower, self._coupling(q, node)) for q in step.later]
        gains = [[blocks.scale(row, inverse) for row in a] for a in sides]
        for i, (q, side) in enumerate(zip(step.later, sides, strict=True)):
            for r, gain in zip(step.later[:i], gains, strict=False):
                self._update(q, r, blocks.product(side, blocks.transpose(gain)))
            self._update(q, q, blocks.lower_product(side, gains[i]))
        return SingleFactor(step, lower, inverse, gains)

    def _run(self, step: Run) -> RunFactor:
        """The same along a run, in a scan that carries the update of the next pivot."""
        size, count = step.nodes[0].size, len(step.nodes)

        def spread(x: Lane) -> Array:
            return jnp.broadcast_to(jnp.asarray(x, self.dtype), (count, *self.batch))

        pivots = [
            [spread(take(x, step.elements)) for x in row]
            for row in self.diagonal[step.nodes[0].group]
        ]
        first, *others = step.nodes
        for node in others:
            for r, row in enumerate(self.updates.get((node, node), ())):
                place = node.element - step.elements[0]
                pairs = zip(pivots[r], row, strict=True)
                pivots[r] = [replaced(x, place, blocks.minus(x[place], u)) for x, u in pairs]
        sides = [[spread(x) for x in row] for row in self._run_coupling(step)]
        known = self.updates.get((first, first), [[0.0] * size] * size)
        start = [
            [jnp.broadcast_to(jnp.asarray(x, self.dtype), self.batch) for x in row[: r + 1]]
            for r, row in enumerate(known)
        ]
        (last, self.share), (lower, inverse, gain) = jax.lax.scan(
            _eliminate, (start, self.share), (pivots, sides), reverse=step.descending
        )
        full = [[last[r][c] if c <= r else 0.0 for c in range(size)] for r in range(size)]
        self._update(step.parent, step.parent, full)
        return RunFactor(step, lower, inverse, gain)

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

    def _judge(self, original: list[Lane], inverse: list[Lane]) -> None:
        for x, w in zip(original, inverse, strict=True):
            self.share = jnp.minimum(self.share, 1 / (w * x))

    def _soften(self, compliance: Array) -> None:
        for start, (m, k) in self.groups.items():
            for r in range(m):
                part = jax.lax.slice_in_dim(compliance, start + r * k, start + (r + 1) * k)
                self.diagonal[start][r][r] = plus(self.diagonal[start][r][r], part)


def _halve(lower: Block, side: Block) -> Block:
    """A_qp L⁻ᵀ."""
    return [blocks.forward(lower, row) for row in side]


def _eliminate(carry: Any, at: Any) -> Any:
    """One node of a run: its pivot less the update, its gain, and the update of the next pivot."""
    (update, share), (pivot, side) = carry, at
    size = len(pivot)
    rows = zip(pivot, update, strict=True)
    changed = [[x - u for x, u in zip(p, w, strict=False)] for p, w in rows]
    lower, inverse = blocks.ldl(changed)
    for r in range(size):
        share = jnp.minimum(share, 1 / (inverse[r] * pivot[r][r]))
    half = _halve(lower, side)
    gain = [blocks.scale(row, inverse) for row in half]
    following = [[total(map(times, half[r], gain[c])) for c in range(r + 1)] for r in range(size)]
    return (following, share), (lower, inverse, gain)


@dataclass(frozen=True)
class SingleFactor:
    """One eliminated node: L, D⁻¹ of its pivot, and H_q for its later neighbours."""

    step: Single
    lower: Block
    inverse: list[Lane]
    gains: list[Block]

    def down(self, b: Vectors) -> list[Lane]:
        """y_p = L⁻¹ b_p and b_q −= H_q y_p; returns D⁻¹ y_p."""
        y = blocks.forward(self.lower, b.get(self.step.node))
        for q, gain in zip(self.step.later, self.gains, strict=True):
            b.subtract(q, blocks.apply(gain, y))
        return blocks.scale(y, self.inverse)

    def back(self, y: list[Lane], x: Vectors) -> None:
        """x_p = L⁻ᵀ (D⁻¹ y_p − Σ H_qᵀ x_q)."""
        for q, gain in zip(self.step.later, self.gains, strict=True):
            pull = blocks.apply(blocks.transpose(gain), x.solution(q))
            y = [blocks.minus(a, c) for a, c in zip(y, pull, strict=True)]
        x.nodes[self.step.node] = blocks.backward(self.lower, y)


@dataclass(frozen=True)
class RunFactor:
    """An eliminated run: the same with a first axis over its nodes, and one gain each."""

    step: Run
    lower: Block
    inverse: list[Lane]
    gain: Block

    def down(self, b: Vectors) -> list[Lane]:
        """The same in a scan that carries H y to the next node."""

        def eliminate(update: Any, at: Any) -> Any:
            lower, inverse, gain, right = at
            right = [x - u for x, u in zip(right, update, strict=True)]
            y = blocks.forward(lower, right)
            return blocks.apply(gain, y), blocks.scale(y, inverse)

        right, start = b.get_run(self.step)
        at = (self.lower, self.inverse, self.gain, right)
        last, y = jax.lax.scan(eliminate, start, at, reverse=self.step.descending)
        b.subtract(self.step.parent, last)
        return y

    def back(self, y: list[Lane], x: Vectors) -> None:
        """The same in a scan that carries the solution of the next node."""

        def substitute(following: Any, at: Any) -> Any:
            lower, gain, own = at
            pull = blocks.apply(blocks.transpose(gain), following)
            rest = [a - c for a, c in zip(own, pull, strict=True)]
            solution = blocks.backward(lower, rest)
            return solution, solution

        start, step = x.solution(self.step.parent), self.step
        _, solution = jax.lax.scan(
            substitute, start, (self.lower, self.gain, y), reverse=not step.descending
        )
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


def regularized(compliance: Array | None, share: Any, matrices: Any) -> Array:
    """C + ε diag(J M⁻¹ Jᵀ), (n_c,), with the diagonal held constant."""
    jacobian, inverse_mass, _ = matrices
    rows: dict[int, list[Lane]] = {}
    for block in jacobian.blocks:
        weight = block.columns.take(inverse_mass)
        squares = [
            total(times(w, times(x, x)) for x, w in zip(row, weight, strict=True))
            for row in block.value
        ]
        known = rows.get(block.start, [0.0] * len(squares))
        rows[block.start] = [plus(a, b) for a, b in zip(known, squares, strict=True)]
    diagonal = jnp.concatenate([x for start in sorted(rows) for x in rows[start]])
    added = jnp.asarray(share).astype(diagonal.dtype)[None] * diagonal
    return added if compliance is None else compliance + added


def _blocks_of(plan: Plan, jacobian: Jacobian, inverse_mass: Array) -> Any:
    """The diagonal blocks of A by group, lower triangles, and its couplings, by lanes."""
    weighted = []
    diagonal: dict[int, Block] = {}
    for block in jacobian.blocks:
        weight = block.columns.take(inverse_mass)
        rows = [[times(x, w) for x, w in zip(row, weight, strict=True)] for row in block.value]
        weighted.append(rows)
        own = [
            [
                total(map(times, rows[r], block.value[s])) if s <= r else 0.0
                for s in range(len(rows))
            ]
            for r in range(len(rows))
        ]
        known = diagonal.get(block.start)
        diagonal[block.start] = own if known is None else blocks.add(known, own)
    couplings = []
    for coupling in plan.couplings:
        (first, second), (x, y) = coupling.blocks, coupling.elements
        left = [[take(lane, x) for lane in row] for row in weighted[first]]
        right = [[take(lane, y) for lane in row] for row in jacobian.blocks[second].value]
        couplings.append(blocks.product(left, blocks.transpose(right)))
    return diagonal, couplings
