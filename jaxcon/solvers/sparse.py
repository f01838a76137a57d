"""Block LDLᵀ of the Delassus matrix by a plan found when tracing.

Three tiers. Once for each structure, on the host: the graph of A = J M⁻¹ Jᵀ, an elimination order,
and its long runs (`ordering.plan`). Once for each state: the blocks of A and their factorization,
blocks unrolled into scalar formulas and runs of equal blocks in a scan (`factor`). For each right
side: one sweep down the order and one back (`substitute`). A tree of joints costs and compiles in
proportion to its joints, and no matrix of the size of the system is ever formed.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector, plus, take, times, total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks, ordering
from jaxcon.solvers.blocks import Block, freeze, settle
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.ordering import Node, Plan, Run, Single
from jaxcon.solvers.saddle import Diagonal, Saddle, Solution, free_motion, judge
from jaxcon.solvers.schur import Schur


@pytree
class Sparse:
    """Solves M a = f + Jᵀλ, J a + C λ = b by sparse elimination of A = J M⁻¹ Jᵀ + C.

    The solution is differentiated implicitly, with A λ written as J (M⁻¹ (Jᵀ λ)) + C λ: forward and
    reverse mode reuse the factorization and never differentiate it. Where M is not diagonal A is
    dense, and `Schur` takes over.

    Attributes:
        run: equal nodes in a row from which a scan is used instead of unrolled code.

    References:
        Baraff, Linear-time dynamics using Lagrange multipliers, SIGGRAPH 1996.
        Davis, Direct Methods for Sparse Linear Systems (2006), chapters 4 and 7.
    """

    run: int = static(default=ordering.RUN)

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status.

        The status is SINGULAR where a row is, to working precision, a combination of others.
        """
        if not system.target.size:
            return free_motion(system)
        if not isinstance(system.mass, Diagonal):
            return Schur().solve(system)
        j, compliance = settle(system.jacobian), system.compliance
        free = system.mass.solve(system.force)
        fixed = freeze((j, 1 / system.mass.values, compliance))
        elimination = Elimination(*fixed, self.run)

        def delassus(x: Array) -> Array:
            y = j.apply(system.mass.solve(j.transpose(x)))
            return y if compliance is None else y + compliance * x

        multipliers = jax.lax.custom_linear_solve(
            delassus,
            system.target - j.apply(free),
            lambda _, x: elimination.substitute(x),
            symmetric=True,
        )
        acceleration = free + system.mass.solve(j.transpose(multipliers))
        dependent = elimination.share <= len(system.target) * jnp.finfo(free.dtype).eps
        return Solution(acceleration, multipliers, judge(acceleration, dependent))


class Elimination:
    """The factorization of one A, step by step of its plan.

    Eliminating node p with pivot block A_pp leaves G_q = A_qp A_pp⁻¹ for each later neighbour q, and
    A_qr −= G_q A_pr. Then b_q −= G_q b_p on the way down, x_p = A_pp⁻¹ b_p − Σ G_qᵀ x_q on the way
    back.

    Attributes:
        share: the smallest part of a row that the rows before it do not explain, by world.
    """

    def __init__(self, jacobian: Jacobian, inverse_mass: Array, compliance: Any, run: int) -> None:
        structure = tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)
        self.plan = ordering.plan(structure, run)
        self.batch, self.dtype = inverse_mass.shape[1:], inverse_mass.dtype
        self.groups = {block.start: block.shape for block in jacobian.blocks}
        self.diagonal, self.couplings = settle(_blocks_of(self.plan, jacobian, inverse_mass))
        if compliance is not None:
            self._soften(compliance)
        self.updates: dict[tuple[Node, Node], Block] = {}
        self.share: Any = jnp.ones(self.batch, self.dtype)
        self.factors = [
            self._run(step) if isinstance(step, Run) else self._single(step)
            for step in self.plan.steps
        ]

    def substitute(self, right: Array) -> Array:
        """A⁻¹ b: down the order, then back."""
        b = _Vectors(self, right)
        middle = []
        for step, factor in zip(self.plan.steps, self.factors, strict=True):
            down = _run_down if isinstance(step, Run) else _single_down
            middle.append(down(step, factor, b))
        x = _Vectors(self, None)
        steps = list(zip(self.plan.steps, self.factors, middle, strict=True))
        for step, factor, y in reversed(steps):
            back = _run_back if isinstance(step, Run) else _single_back
            back(step, factor, y, x)
        return x.join()

    def _single(self, step: Single) -> Any:
        node = step.node
        pivot = [[_at(x, node.element) for x in row] for row in self.diagonal[node.group]]
        original = [pivot[r][r] for r in range(node.size)]
        if (node, node) in self.updates:
            pivot = blocks.subtract(pivot, self.updates[node, node])
        lower, inverse = settle(blocks.ldl(pivot))
        self._judge(original, inverse)
        sides = [self._coupling(q, node) for q in step.later]
        gains = settle([[blocks.ldl_solve(lower, inverse, row) for row in a] for a in sides])
        for i, (q, side) in enumerate(zip(step.later, sides, strict=True)):
            for r, gain in list(zip(step.later, gains, strict=True))[: i + 1]:
                self._update(q, r, blocks.product(side, blocks.transpose(gain)))
        return lower, inverse, gains

    def _run(self, step: Run) -> Any:
        """The same along a run, in a scan that carries the update of the next pivot."""
        first, parent, reverse = step.nodes[0], step.parent, step.descending
        order = sorted(node.element for node in step.nodes)
        pivots = [
            [_spread(take(x, tuple(order)), len(order), self) for x in row]
            for row in self.diagonal[first.group]
        ]
        sides = [[_spread(x, len(order), self) for x in row] for row in self._run_coupling(step)]
        for node in step.nodes:
            if (node, node) in self.updates:
                place, update = node.element - order[0], self.updates[node, node]
                pivots = [
                    [
                        x.at[place].add(times(-1, u)) if not _is_zero(u) else x
                        for x, u in zip(p, w, strict=True)
                    ]
                    for p, w in zip(pivots, update, strict=True)
                ]
        zero = jnp.zeros(self.batch, self.dtype)
        start = [[zero] * (r + 1) for r in range(first.size)]

        def eliminate(update: Any, at: Any) -> Any:
            pivot, side = at
            size = len(pivot)
            changed = [
                [x - u for x, u in zip(p, w, strict=False)]
                for p, w in zip(pivot, update, strict=True)
            ]
            lower, inverse = settle(blocks.ldl(changed))
            share = [1 / (inverse[r] * pivot[r][r]) for r in range(size)]
            gain = settle([blocks.ldl_solve(lower, inverse, row) for row in side])
            following = [
                [total(map(times, side[r], gain[c])) for c in range(r + 1)] for r in range(size)
            ]
            return following, (lower, inverse, gain, share)

        last, (lower, inverse, gain, share) = jax.lax.scan(
            eliminate, start, (pivots, sides), reverse=reverse
        )
        for lane in share:
            self.share = jnp.minimum(self.share, jnp.min(lane, axis=0))
        full = [[last[max(r, c)][min(r, c)] for c in range(first.size)] for r in range(first.size)]
        self._update(parent, parent, full)
        return lower, inverse, gain

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


class _Vectors:
    """A vector by nodes: rows of a group as lanes (element, …), read and changed node by node."""

    def __init__(self, owner: Elimination, values: Array | None) -> None:
        self.owner = owner
        self.groups: dict[int, list[Lane]] = {}
        self.nodes: dict[Node, list[Lane]] = {}
        self.runs: dict[tuple[int, int], list[Lane]] = {}
        if values is not None:
            for start, (m, k) in owner.groups.items():
                rows = jax.lax.slice_in_dim(values, start, start + m * k)
                self.groups[start] = list(Vector.of(rows.reshape((m, k, *values.shape[1:]))))

    def get(self, node: Node) -> list[Lane]:
        """The lanes of one node."""
        if node not in self.nodes:
            self.nodes[node] = [x[node.element] for x in self.groups[node.group]]
        return self.nodes[node]

    def subtract(self, node: Node, amount: list[Lane]) -> None:
        """Subtracts from one node."""
        pairs = zip(self.get(node), amount, strict=True)
        self.nodes[node] = [blocks.minus(x, y) for x, y in pairs]

    def get_run(self, step: Run) -> list[Lane]:
        """The lanes of the nodes of a run, ascending, (element, …)."""
        order = sorted(node.element for node in step.nodes)
        lanes = [take(x, tuple(order)) for x in self.groups[step.nodes[0].group]]
        for node in step.nodes:
            if node in self.nodes:
                place = node.element - order[0]
                pairs = zip(lanes, self.nodes[node], strict=True)
                lanes = [x.at[place].set(y) for x, y in pairs]
        return lanes

    def join(self) -> Array:
        """One array (n_c, …)."""
        parts = []
        for start, (m, k) in sorted(self.owner.groups.items()):
            pieces = {
                n.element: [x[None] for x in v] for n, v in self.nodes.items() if n.group == start
            }
            pieces |= {first: v for (group, first), v in self.runs.items() if group == start}
            for r in range(m):
                parts += [pieces[element][r] for element in sorted(pieces)]
        return jnp.concatenate(parts)


def _single_down(step: Single, factor: Any, b: _Vectors) -> list[Lane]:
    lower, inverse, gains = factor
    right = b.get(step.node)
    for q, gain in zip(step.later, gains, strict=True):
        b.subtract(q, blocks.apply(gain, right))
    return settle(blocks.ldl_solve(lower, inverse, right))


def _single_back(step: Single, factor: Any, y: list[Lane], x: _Vectors) -> None:
    for q, gain in zip(step.later, factor[2], strict=True):
        pull = blocks.apply(blocks.transpose(gain), x.nodes[q])
        y = [blocks.minus(a, c) for a, c in zip(y, pull, strict=True)]
    x.nodes[step.node] = settle(y)


def _run_down(step: Run, factor: Any, b: _Vectors) -> Any:
    def down(update: Any, at: Any) -> Any:
        lower, inverse, gain, right = at
        right = [x - u for x, u in zip(right, update, strict=True)]
        y = settle(blocks.ldl_solve(lower, inverse, right))
        return blocks.apply(gain, right), y

    zero = jnp.zeros(b.owner.batch, b.owner.dtype)
    right = b.get_run(step)
    last, y = jax.lax.scan(down, [zero] * len(right), (*factor, right), reverse=step.descending)
    b.subtract(step.parent, last)
    return y


def _run_back(step: Run, factor: Any, y: Any, x: _Vectors) -> None:
    def back(following: Any, at: Any) -> Any:
        gain, own = at
        pull = blocks.apply(blocks.transpose(gain), following)
        solution = [a - c for a, c in zip(own, pull, strict=True)]
        return solution, solution

    start = x.nodes[step.parent]
    _, solution = jax.lax.scan(back, start, (factor[2], y), reverse=not step.descending)
    first = min(step.nodes, key=lambda node: node.element)
    x.runs[first.group, first.element] = solution


def _at(x: Lane, i: int) -> Lane:
    return x[i] if isinstance(x, jax.Array) else x


def _is_zero(x: Lane) -> bool:
    return not isinstance(x, jax.Array) and x == 0


def _spread(x: Lane, n: int, owner: Elimination) -> Array:
    return jnp.broadcast_to(jnp.asarray(x, owner.dtype), (n, *owner.batch))


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
