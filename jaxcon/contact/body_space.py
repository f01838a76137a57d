"""Inequality rows of trees of rigid bodies, as rows on single bodies and on joint coordinates.

A row that acts on a body and the world changes only the body's own 6×6 block of M + Jᵀ D J. A row
on the coordinate of a joint changes only the joint's own block. `Articulated` then eliminates along
the joints, and no matrix of all rows is formed. Rows between two other bodies enter as a low-rank
term; see `Bordered`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.joint_trees import tree_of_joints
from jaxcon.contact.bounded import RowCounts
from jaxcon.contact.rows import BoundRows
from jaxcon.core.lanes import Vector, collect, plus, take, times, total
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.linear.articulated import Articulated, ByBranch, Lanes, Motions, symmetric, widened
from jaxcon.linear.blocks import Block, freeze
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.tree_equations import JointRows, TreeEquations, add_outer, joint_places
from jaxcon.linear.trees import Tree
from jaxcon.system.elements import UserElement

if TYPE_CHECKING:
    from jaxcon.constraints.rows import RowLayout
    from jaxcon.protocols import System


def tree_below(system: System, joints: Jacobian, layout: RowLayout, rows: BoundRows) -> Tree | None:
    """Returns the tree of a system's bodies, on which Newton's method works.

    Args:
        system: the system.
        joints: the Jacobian of the equality rows.
        layout: the layout of the equality rows.
        rows: the inequality rows.

    Returns:
        The tree; None if there is no `tree_of_joints`, inequalities of user functions, or
        inequality rows on more than two bodies.
    """
    bounds = rows.jacobian
    if not isinstance(bounds, Jacobian) or any(len(own) > 2 for _, own in bounds.by_rows()):
        return None
    if any(isinstance(x, UserElement) for x in system.bounds):
        return None
    return tree_of_joints(system, joints, layout)


@dataclass(frozen=True)
class BodyRows:
    """Inequality rows that act on one body each: single rows, or the rows of contacts.

    Attributes:
        starts: the first row of each kind: one, or normals, tangents, rolling and spinning rows.
        places: the body of each element, by its place in the tree.
        pulls: for each kind, the rows in common coordinates, lanes (element, …).
    """

    starts: tuple[int, ...]
    places: tuple[int, ...]
    pulls: list[Vector]

    def slices(self, x: Array) -> list[Array]:
        """Returns the entries of each kind of row from an array over rows, (n,)."""
        return [x[start : start + len(self.places)] for start in self.starts]

    def of(self, velocities: Array) -> list[tuple[int, Lane]]:
        """Returns the first row of each kind, and its velocities J v, (element,).

        Args:
            velocities: the velocities v of all bodies, (lane, body, …).
        """
        v = Vector(*_repeated(velocities, self.places))
        return [(s, pull.dot(v)) for s, pull in zip(self.starts, self.pulls, strict=True)]


@dataclass(frozen=True)
class PairRows:
    """Inequality rows that act on two bodies each, at any place in the trees.

    Attributes:
        starts: the first row of each kind; see `BodyRows`.
        sides: the rows as functions of the velocities of the first and of the second body.
    """

    starts: tuple[int, ...]
    sides: tuple[BodyRows, ...]


class BodySpace(NamedTuple):
    """The equations of motion of trees of bodies, and inequality rows, in common coordinates.

    Attributes:
        equations: the equations of motion without inequality rows.
        on_bodies, on_joints, on_pairs: the inequality rows.
        order: for each row in the order of the solver, its index in the order of the system. The
            solver sorts contacts by bodies.
    """

    equations: TreeEquations
    on_bodies: list[BodyRows]
    on_joints: list[JointRows]
    on_pairs: list[PairRows]
    order: np.ndarray

    @property
    def motions(self) -> Motions:
        """The motions that the joints allow."""
        return self.equations.motions

    @classmethod
    def of(cls, equations: TreeEquations, rows: BoundRows) -> BodySpace:
        """Returns the equations with the inequality rows, of which J is a `Jacobian`."""
        bounds = freeze(rows.jacobian)
        assert isinstance(bounds, Jacobian)
        motions = equations.motions
        tree, frames, shape, dtype = motions.tree, motions.frames, motions.shape, motions.like.dtype
        order = np.arange(rows.kinds.size)
        groups: list[BodyRows | PairRows] = []
        on_joints: list[JointRows] = []
        contacts: dict[int, list[Side]] = {}
        for start, own in bounds.by_rows():
            single = start < rows.kinds.normal
            if single and len(own) == 2 and joint_places(tree, own) is not None:
                on_joints.append(JointRows.of(motions, start, own))
                continue
            sides: list[Side] = []
            for block in own:
                places = tuple(tree.places[b] for b in block.columns.indices)
                pull = frames.at(places).pull(block.value[0])
                sides.append((places, [widened(x, len(places), len(shape)) for x in pull]))
            if single:
                groups.append(_rows((start,), [(p, [Vector(*x)]) for p, x in sides]))
            else:
                contacts[start] = sides
        if contacts:
            sorted_groups, order = _sorted_contacts(rows.kinds, contacts, shape, dtype)
            groups += sorted_groups
        on_bodies = [x for x in groups if isinstance(x, BodyRows)]
        on_pairs = [x for x in groups if isinstance(x, PairRows)]
        return cls(equations, on_bodies, on_joints, on_pairs, order)

    @property
    def pair_rows(self) -> int:
        """The number of rows between two bodies."""
        return sum(len(x.starts) * len(x.sides[0].places) for x in self.on_pairs)

    def between(self, like: Array) -> np.ndarray:
        """Returns a mask of the rows between two bodies, (n, 1, …), with as many axes as `like`."""
        mask = np.zeros(len(like), bool)
        for pair in self.on_pairs:
            for start in pair.starts:
                mask[start : start + len(pair.sides[0].places)] = True
        return mask.reshape(-1, *(1,) * (like.ndim - 1))

    def rows_of(self, bodies: ByBranch, joints: ByBranch, like: Array) -> Array:
        """Returns the velocities of all inequality rows, (n,)."""
        parts: list[tuple[int, int, Lane]] = []
        whole = self.stacked(bodies, like)
        for group in self.on_bodies:
            parts += [(s, len(group.places), x) for s, x in group.of(whole)]
        for pair in self.on_pairs:
            first, second = (side.of(whole) for side in pair.sides)
            for (start, x), (_, y) in zip(first, second, strict=True):
                parts.append((start, len(pair.sides[0].places), plus(x, y)))
        for row in self.on_joints:
            z = self.motions.at_joints(joints, row.joints, len(row.pulls))
            parts.append((row.start, len(row.joints), total(map(times, row.pulls, z))))
        return _flat(parts, like)

    def pull(self, multipliers: Array) -> tuple[ByBranch, ByBranch]:
        """Returns the forces on bodies and joints, Jᵀ λ, by branch."""
        tree = self.motions.tree
        sides = [side for pair in self.on_pairs for side in pair.sides]
        bodies = self._forces([*self.on_bodies, *sides], multipliers)
        sums: list[list[list]] = [[[] for _ in range(b.freedom)] for b in tree.branches]
        for row in self.on_joints:
            row.add_forces(multipliers[row.start : row.start + len(row.joints)], sums)
        joints = [
            [collect(s, len(b.bodies)) for s in x] for b, x in zip(tree.branches, sums, strict=True)
        ]
        return bodies, joints

    def pull_pairs(self, multipliers: Array) -> ByBranch:
        """Returns the forces of `on_pairs` on bodies, Jᵀ λ, by branch."""
        return self._forces([side for x in self.on_pairs for side in x.sides], multipliers)

    def _forces(self, groups: Sequence[BodyRows], multipliers: Array) -> ByBranch:
        """Returns the forces of some rows on bodies, Jᵀ λ, by branch."""
        tree = self.motions.tree
        n, size = len(tree.parents), self.motions.size
        whole: Any = 0.0
        for group in groups:
            λ = group.slices(multipliers)
            lanes = [
                total(times(x[c], y) for x, y in zip(group.pulls, λ, strict=True))
                for c in range(size)
            ]
            whole = whole + _summed(_stack(lanes, len(group.places), multipliers), group.places, n)
        return [
            [0.0] * size
            if isinstance(whole, float)
            else [whole[c, start : start + len(b.bodies)] for c in range(size)]
            for b, start in zip(tree.branches, tree.starts, strict=True)
        ]

    def stiffened(
        self, slope: Array, kinds: RowCounts, discs: list[tuple[Array, Vector]]
    ) -> tuple[list[Block], list[Block]]:
        """Returns M + Jᵀ D J without `on_pairs`, as blocks of bodies and of joints by branch.

        Args:
            slope: the diagonal part of D, (n,).
            kinds: the numbers of rows by law.
            discs: for each disc, the part −b t tᵀ of D: b and t, lanes (contact, …).
        """
        tree = self.motions.tree
        n, size = len(tree.parents), self.motions.size
        whole: Any = 0.0
        for group in self.on_bodies:
            m = len(group.places)
            terms = list(zip(group.pulls, group.slices(slope), strict=True))
            for disc, first, (b, t) in zip(kinds.discs, kinds.starts, discs, strict=False):
                inside = [first <= start < first + disc.count for start in group.starts]
                if not disc.rank or True not in inside:
                    continue
                k = inside.index(True)
                own = slice(group.starts[k] - first, group.starts[k] - first + m)
                pairs = list(zip(group.pulls[k : k + disc.rank], t, strict=True))
                along = (total(times(x[c], y[own]) for x, y in pairs) for c in range(size))
                terms.append((Vector(*along), -b[own]))
            weighted = [(x, x.map(lambda y, w=w: times(w, y))) for x, w in terms]
            lanes = [
                total(times(x[r], y[c]) for x, y in weighted)
                for r in range(size)
                for c in range(r + 1)
            ]
            whole = whole + _summed(_stack(lanes, m, slope), group.places, n)
        bodies = []
        for b, start, block in zip(tree.branches, tree.starts, self.equations.inertia, strict=True):
            entries = itertools.count()
            bodies.append(
                [
                    [
                        y
                        if isinstance(whole, float)
                        else plus(y, whole[next(entries), start : start + len(b.bodies)])
                        for y in row
                    ]
                    for row in block
                ]
            )
        joints = [[list(row) for row in block] for block in self.equations.rotors]
        for row in self.on_joints:
            add_outer(joints, row, slope[row.start : row.start + len(row.joints)], tree)
        return bodies, joints

    def stacked(self, by_branch: ByBranch, like: Array) -> Array:
        """Returns lanes of bodies by branch as one array, (lane, body, …)."""
        return jnp.concatenate(
            [
                _stack(lanes, len(b.bodies), like)
                for lanes, b in zip(by_branch, self.motions.tree.branches, strict=True)
            ],
            axis=1,
        )

    def momentum(self, bodies: ByBranch, joints: ByBranch) -> tuple[ByBranch, ByBranch]:
        """Returns M y for velocities of bodies and joints."""
        return (
            [symmetric(m, y) for m, y in zip(self.equations.inertia, bodies, strict=True)],
            [symmetric(m, z) for m, z in zip(self.equations.rotors, joints, strict=True)],
        )

    def mobility(self, factors: Articulated, like: Array) -> tuple[Array, list[Block]]:
        """Returns the inverse mass of each row, (n,), and those of the joints.

        That of a row between two bodies is the sum of both, as if no joints connected them.
        """
        ofbodies, ofjoints = factors.mobility()
        size = len(ofbodies[0])
        flat = [[x for row in b for x in row] for b in ofbodies]
        parts: list[tuple[int, int, Lane]] = []
        whole = self.stacked(flat, like)

        def met(group: BodyRows) -> list[Lane]:
            lanes = iter(_repeated(whole, group.places))
            block: Block = [list(itertools.islice(lanes, r + 1)) for r in range(size)]
            return [pull.dot(Vector(*symmetric(block, [*pull]))) for pull in group.pulls]

        for group in self.on_bodies:
            parts += [
                (s, len(group.places), x) for s, x in zip(group.starts, met(group), strict=True)
            ]
        for pair in self.on_pairs:
            first, second = pair.sides
            for s, x, y in zip(pair.starts, met(first), met(second), strict=True):
                parts.append((s, len(first.places), plus(x, y)))
        for row in self.on_joints:
            k = len(row.pulls)
            inverse = [[x for r in b for x in r] for b in ofjoints]
            lanes = iter(self.motions.at_joints(inverse, row.joints, k * (k + 1) // 2))
            block = [list(itertools.islice(lanes, r + 1)) for r in range(k)]
            parts.append(
                (
                    row.start,
                    len(row.joints),
                    total(map(times, row.pulls, symmetric(block, row.pulls))),
                )
            )
        return _flat(parts, like), ofjoints


def _flat(parts: list[tuple[int, int, Lane]], like: Array) -> Array:
    """Returns the rows of all parts (first row, number of rows, lane) as an array, (n,)."""
    return jnp.concatenate(
        [
            jnp.broadcast_to(jnp.asarray(x, like.dtype), (n, *like.shape[1:]))
            for _, n, x in sorted(parts, key=lambda part: part[0])
        ]
    )


def _stack(lanes: Lanes, count: int, like: Array) -> Array:
    """Returns lanes over `count` elements as one array, (lane, element, …)."""
    shape = (count, *like.shape[1:])
    return jnp.stack([jnp.broadcast_to(jnp.asarray(x, like.dtype), shape) for x in lanes])


def _runs(places: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Returns the runs of equal places: the place, the first index, and the length."""
    runs, first = [], 0
    for place, members in itertools.groupby(places):
        count = len(list(members))
        runs.append((place, first, count))
        first += count
    return runs


def _repeated(x: Array, places: tuple[int, ...]) -> list[Array]:
    """Returns the lanes of the bodies at given places from an array, (lane, body, …)."""
    pieces = [
        jnp.broadcast_to(x[:, p : p + 1], (len(x), count, *x.shape[2:]))
        for p, _, count in _runs(places)
    ]
    return list(jnp.concatenate(pieces, axis=1))


def _summed(x: Array, places: tuple[int, ...], n: int) -> Array:
    """Returns the sums over the elements of each body, (lane, body, …)."""
    sums: list[Any] = [None] * n
    for p, first, count in _runs(places):
        parts = [x[:, k : k + 1] for k in range(first, first + count)]
        sums[p] = total(parts if sums[p] is None else [sums[p], *parts])
    zero = jnp.zeros((len(x), 1, *x.shape[2:]), x.dtype)
    return jnp.concatenate([zero if y is None else y for y in sums], axis=1)


Side = tuple[tuple[int, ...], list[Lane]]
"""The places of the bodies of rows, and the rows as functions of these bodies' velocities."""


def _rows(
    starts: tuple[int, ...], sides: Sequence[tuple[tuple[int, ...], list[Vector]]]
) -> BodyRows | PairRows:
    """Returns rows on one body or two."""
    each = tuple(BodyRows(starts, places, pulls) for places, pulls in sides)
    return each[0] if len(each) == 1 else PairRows(starts, each)


def _sorted_contacts(
    kinds: RowCounts, contacts: dict[int, list[Side]], shape: tuple[int, ...], dtype: DType
) -> tuple[list[BodyRows | PairRows], np.ndarray]:
    """Merges the rows of contacts that have the same kinds of rows, and sorts them by bodies.

    Args:
        kinds: the numbers of rows by law.
        contacts: one or two sides of the rows that begin at each row.
        shape: the shape of the batch.
        dtype: the dtype of the rows.

    Returns:
        The rows, and the order of all rows; see `BodySpace`.
    """
    columns = [(kinds.normal, 0, kinds.contacts)]
    for disc, first in zip(kinds.discs, kinds.starts, strict=False):
        columns += [(first + r * disc.count, disc.first, disc.count) for r in range(disc.rank)]
    starts = sorted(contacts)
    ends = {e for _, first, count in columns for e in (first, first + count)}
    normals = [start for start in starts if start < kinds.starts[0]]
    for before, start in itertools.pairwise(normals):
        if len(contacts[before]) != len(contacts[start]):
            ends.add(start - kinds.normal)
    order, groups = np.arange(kinds.size), []
    for low, high in itertools.pairwise(sorted(ends)):
        count = high - low

        def of_rows(begin: int, count: int = count) -> list[list[Side]]:
            return [contacts[s] for s in starts if begin <= s < begin + count]

        own = of_rows(kinds.normal + low)
        bodies = [[p for x in own for p in x[k][0]] for k in range(len(own[0]))]
        sort = np.lexsort(bodies[::-1])
        begins, pulls = [], [[] for _ in bodies]
        for start, first, contained in columns:
            if not (first <= low and high <= first + contained):
                continue
            begin = start + low - first
            order[begin : begin + count] = begin + sort
            for k, vectors in enumerate(pulls):
                parts = [x[k] for x in of_rows(begin)]
                lanes = (
                    _joined([(x[c], len(p)) for p, x in parts], shape, dtype)
                    for c in range(len(parts[0][1]))
                )
                vectors.append(Vector(*(take(x, tuple(sort.tolist())) for x in lanes)))
            begins.append(begin)
        places = [tuple(np.array(x)[sort].tolist()) for x in bodies]
        groups.append(_rows(tuple(begins), list(zip(places, pulls, strict=True))))
    return groups, order


def _joined(parts: list[tuple[Lane, int]], shape: tuple[int, ...], dtype: DType) -> Array:
    """Returns lanes with the given numbers of elements as one lane."""
    return jnp.concatenate([jnp.broadcast_to(jnp.asarray(x, dtype), (n, *shape)) for x, n in parts])
