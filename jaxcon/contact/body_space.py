"""Inequality rows of trees of rigid bodies, as rows on single bodies and on joint coordinates.

A row that acts on a body and the world changes only the body's own 6×6 block of M + Jᵀ D J. A row
on the coordinate of a joint changes only the joint's own block. `Articulated` then eliminates along
the joints, and no matrix of all rows is formed.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.armature import Armatures
from jaxcon.constraints.base import Joints
from jaxcon.contact.bounded import RowCounts
from jaxcon.contact.rows import BoundRows
from jaxcon.core.lanes import Vector, collect, plus, take, times, total
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.linear.articulated import (
    Articulated,
    ByBranch,
    Frames,
    Lanes,
    Motions,
    picked,
    symmetric,
    widened,
)
from jaxcon.linear.blocks import Block
from jaxcon.linear.jacobian import Block as JacobianBlock
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.saddle import Diagonal, Saddle
from jaxcon.linear.trees import WORLD, Tree, structure, tree_of
from jaxcon.system.bodies import PlanarRigid, SpatialRigid
from jaxcon.system.elements import UserElement
from jaxcon.system.frames import SpatialFrame

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
        The tree; None if there are particles, closed loops, constraints other than joints and
        rotors, inequalities of user functions, or inequality rows between bodies that no joint
        connects.
    """
    bounds = rows.jacobian
    if system.layout is None or not isinstance(bounds, Jacobian):
        return None
    if len(system.layout.groups) != 1 or layout.loops:
        return None
    # the rows of other constraints may depend on more than the relative motion of two bodies
    if not all(isinstance(x, Joints | Armatures) for x in system.constraints):
        return None
    if any(isinstance(x, UserElement) for x in system.bounds):
        return None
    (group,) = system.layout.groups
    if not isinstance(group.kind, SpatialRigid | PlanarRigid):
        return None
    soft = frozenset(
        start
        for start, own in joints.by_rows()
        if not layout.holds[start : start + own[0].shape[0] * own[0].shape[1]].all()
    )
    tree = tree_of(structure(joints), soft, len(group.names), group.kind.n_v)
    if tree is None:
        return None
    if any(len(own) > 1 for start, own in bounds.by_rows() if start >= rows.kinds.normal):
        return None  # a contact between two bodies
    rotors = [own for start, own in joints.by_rows() if start in soft]
    pairs = [own for _, own in bounds.by_rows() if len(own) > 1]
    for own in [*pairs, *rotors]:
        if len(own) > 2 or _joint_places(tree, own) is None:
            return None
    return tree


def _joint_places(tree: Tree, own: Sequence[JacobianBlock]) -> list[tuple[int, int, int]] | None:
    """Returns branch, index and side of the joint on which each element acts; None if on none."""
    found = []
    for ends in zip(*(block.columns.indices for block in own), strict=True):
        places = [tree.places[body] for body in ends]
        above = places[::-1] if len(places) == 2 else [WORLD]
        side = next((k for k, p in enumerate(places) if tree.parents[p] == above[k]), None)
        if side is None:
            return None
        branch, index = tree.branch_of(places[side])
        if tree.branches[branch].row is None:  # a root without a joint
            return None
        found.append((branch, index, side))
    return found if len({tree.branches[i].freedom for i, *_ in found}) == 1 else None


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


@dataclass(frozen=True)
class JointRows:
    """Inequality rows on the coordinates of joints.

    Attributes:
        start: the first row.
        joints: branch and index of the joint of each row.
        pulls: the rows as functions of the joint's velocities, lanes (row, …).
    """

    start: int
    joints: tuple[tuple[int, int], ...]
    pulls: Lanes


class BodySpace(NamedTuple):
    """The equations of motion of trees of bodies, and inequality rows, in common coordinates.

    Attributes:
        motions: the motions that the joints allow.
        inertia: for each branch, the inertias of the bodies.
        rotors: for each branch, the inertias of rotors on joint coordinates, (k, k).
        on_bodies, on_joints: the inequality rows.
        order: for each row in the order of the solver, its index in the order of the system. The
            solver sorts contacts by bodies.
    """

    motions: Motions
    inertia: list[Block]
    rotors: list[Block]
    on_bodies: list[BodyRows]
    on_joints: list[JointRows]
    order: np.ndarray

    @classmethod
    def of(
        cls, system: System, q: Array, v: Array, saddle: Saddle, rows: BoundRows
    ) -> BodySpace | None:
        """Returns the equations; None if M is not diagonal, or the bodies form no tree."""
        j = rows.jacobian
        if not isinstance(saddle.mass, Diagonal) or not isinstance(j, Jacobian):
            return None
        tree = tree_below(system, saddle.jacobian, saddle.layout, rows)
        if tree is None:
            return None
        assert system.layout is not None
        (group,) = system.layout.groups
        n = len(group.names)
        members = tuple(b for x in tree.branches for b in x.bodies)
        shape = q.shape[1:]
        frame = group.kind.frame(*group.unpack(q, v))
        roots: list[int] = []
        for i, p in enumerate(tree.parents):
            roots.append(i if p == WORLD else roots[p])
        position = frame.position.map(lambda x: take(x, members))
        arm = position.map(lambda x: x - take(x, tuple(roots)))
        rotation = None
        if isinstance(frame, SpatialFrame):
            rotation = jax.tree.map(lambda x: take(x, members), frame.rotation)
        frames = Frames(*jax.lax.stop_gradient((rotation, arm)))
        mass = Vector.of_rows(saddle.mass.values, group.v, group.kind.n_v, n)
        whole = frames.inertia(jax.lax.stop_gradient(mass.map(lambda x: take(x, members))))
        joints, bounds = jax.lax.stop_gradient((saddle.jacobian, j))
        motions = Motions.of(tree, frames, joints, shape)
        inertia = [
            [[_part(x, start, len(b.bodies)) for x in row] for row in whole]
            for b, start in zip(tree.branches, tree.starts, strict=True)
        ]
        order = np.arange(rows.kinds.size)
        on_bodies: list[BodyRows] = []
        on_joints: list[JointRows] = []
        contacts: dict[int, tuple[tuple[int, ...], list[Lane]]] = {}
        for start, own in bounds.by_rows():
            if len(own) == 2:
                on_joints.append(_on_joints(motions, start, own))
                continue
            places = tuple(tree.places[b] for b in own[0].columns.indices)
            pull = frames.at(places).pull(own[0].value[0])
            lanes = [widened(x, len(places), len(shape)) for x in pull]
            if start < rows.kinds.normal:
                on_bodies.append(BodyRows((start,), places, [Vector(*lanes)]))
            else:
                contacts[start] = places, lanes
        if contacts:
            groups, order = _sorted_contacts(rows.kinds, contacts, shape, q.dtype)
            on_bodies += groups
        rotors: list[Block] = [[[0.0] * (r + 1) for r in range(b.freedom)] for b in tree.branches]
        holds = saddle.layout.holds
        for start, own in joints.by_rows():
            m = own[0].shape[1]
            if holds[start]:
                continue
            assert saddle.compliance is not None
            weight = 1 / jax.lax.stop_gradient(saddle.compliance[start : start + m])
            row = _on_joints(motions, start, own)
            _add_outer(rotors, row, weight, tree)
        return cls(motions, inertia, rotors, on_bodies, on_joints, order)

    def rows_of(self, bodies: ByBranch, joints: ByBranch, like: Array) -> Array:
        """Returns the velocities of all inequality rows, (n,)."""
        parts: list[tuple[int, int, Lane]] = []
        whole = self.stacked(bodies, like)
        for group in self.on_bodies:
            v = Vector(*_repeated(whole, group.places))
            for start, pull in zip(group.starts, group.pulls, strict=True):
                parts.append((start, len(group.places), pull.dot(v)))
        for row in self.on_joints:
            z = self.motions.at_joints(joints, row.joints, len(row.pulls))
            parts.append((row.start, len(row.joints), total(map(times, row.pulls, z))))
        return _flat(parts, like)

    def pull(self, multipliers: Array) -> tuple[ByBranch, ByBranch]:
        """Returns the forces on bodies and joints, Jᵀ λ, by branch."""
        tree = self.motions.tree
        n, size = len(tree.parents), len(self.inertia[0])
        whole: Any = 0.0
        for group in self.on_bodies:
            λ = group.slices(multipliers)
            lanes = [
                total(times(x[c], y) for x, y in zip(group.pulls, λ, strict=True))
                for c in range(size)
            ]
            whole = whole + _summed(_stack(lanes, len(group.places), multipliers), group.places, n)
        bodies: ByBranch = [
            [0.0] * size
            if isinstance(whole, float)
            else [whole[c, start : start + len(b.bodies)] for c in range(size)]
            for b, start in zip(tree.branches, tree.starts, strict=True)
        ]
        sums: list[list[list]] = [[[] for _ in range(b.freedom)] for b in tree.branches]
        for row in self.on_joints:
            λ = multipliers[row.start : row.start + len(row.joints)]
            for c, x in enumerate(row.pulls):
                _to_branches(sums, c, row.joints, times(x, λ))
        joints = [
            [collect(s, len(b.bodies)) for s in x] for b, x in zip(tree.branches, sums, strict=True)
        ]
        return bodies, joints

    def stiffened(
        self, slope: Array, kinds: RowCounts, discs: list[tuple[Array, Vector]]
    ) -> tuple[list[Block], list[Block]]:
        """Returns M + Jᵀ D J, as blocks of bodies and of joints by branch.

        Args:
            slope: the diagonal part of D, (n,).
            kinds: the numbers of rows by law.
            discs: for each disc, the part −b t tᵀ of D: b and t, lanes (contact, …).
        """
        tree = self.motions.tree
        n, size = len(tree.parents), len(self.inertia[0])
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
        for b, start, block in zip(tree.branches, tree.starts, self.inertia, strict=True):
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
        joints = [[list(row) for row in block] for block in self.rotors]
        for row in self.on_joints:
            _add_outer(joints, row, slope[row.start : row.start + len(row.joints)], tree)
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
            [symmetric(m, y) for m, y in zip(self.inertia, bodies, strict=True)],
            [symmetric(m, z) for m, z in zip(self.rotors, joints, strict=True)],
        )

    def mobility(self, factors: Articulated, like: Array) -> tuple[Array, list[Block]]:
        """Returns the inverse mass of each row, (n,), and those of the joints."""
        ofbodies, ofjoints = factors.mobility()
        size = len(ofbodies[0])
        flat = [[x for row in b for x in row] for b in ofbodies]
        parts: list[tuple[int, int, Lane]] = []
        whole = self.stacked(flat, like)
        for group in self.on_bodies:
            lanes = iter(_repeated(whole, group.places))
            block: Block = [list(itertools.islice(lanes, r + 1)) for r in range(size)]
            for start, pull in zip(group.starts, group.pulls, strict=True):
                parts.append(
                    (start, len(group.places), pull.dot(Vector(*symmetric(block, [*pull]))))
                )
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


def _sorted_contacts(
    kinds: RowCounts,
    contacts: dict[int, tuple[tuple[int, ...], list[Lane]]],
    shape: tuple[int, ...],
    dtype: DType,
) -> tuple[list[BodyRows], np.ndarray]:
    """Merges the rows of contacts that have the same kinds of rows, and sorts them by bodies.

    Returns:
        The rows, and the order of all rows; see `BodySpace`.
    """
    columns = [(kinds.normal, 0, kinds.contacts)]
    for disc, first in zip(kinds.discs, kinds.starts, strict=False):
        columns += [(first + r * disc.count, disc.first, disc.count) for r in range(disc.rank)]
    places = np.concatenate([contacts[k][0] for k in sorted(contacts) if k < kinds.starts[0]])
    size = len(next(iter(contacts.values()))[1])
    whole: list[list[Lane]] = []
    for start, _, count in columns:
        own = [contacts[k][1] for k in sorted(contacts) if start <= k < start + count]
        counts = [len(contacts[k][0]) for k in sorted(contacts) if start <= k < start + count]
        whole.append(
            [
                jnp.concatenate(
                    [
                        jnp.broadcast_to(jnp.asarray(x[c], dtype), (n, *shape))
                        for x, n in zip(own, counts, strict=True)
                    ]
                )
                for c in range(size)
            ]
        )
    order, groups = np.arange(kinds.size), []
    ends = sorted({e for _, first, count in columns for e in (first, first + count)})
    for low, high in itertools.pairwise(ends):
        sort = low + np.argsort(places[low:high], kind="stable")
        starts, pulls = [], []
        for (start, first, count), lanes in zip(columns, whole, strict=True):
            if first <= low and high <= first + count:
                begin = start + low - first
                order[begin : begin + high - low] = start - first + sort
                indices = tuple((sort - first).tolist())
                pulls.append(Vector(*(take(x, indices) for x in lanes)))
                starts.append(begin)
        groups.append(BodyRows(tuple(starts), tuple(places[sort].tolist()), pulls))
    return groups, order


def _part(x: Lane, start: int, count: int) -> Lane:
    """Returns consecutive entries of a lane."""
    if isinstance(x, int | float):
        return x
    if count == x.shape[0]:
        return x
    return jax.lax.slice_in_dim(x, start, start + count)


def _on_joints(motions: Motions, start: int, own: Sequence[JacobianBlock]) -> JointRows:
    """Returns rows of two blocks as functions of joint velocities."""
    tree = motions.tree
    found = _joint_places(tree, own)
    assert found is not None
    places = tuple(tree.starts[i] + k for i, k, _ in found)
    counts = [b.shape[1] for b in own]
    picks = [(side, e) for e, (*_, side) in enumerate(found)]
    lanes = [
        picked([b.value[0][c] for b in own], picks, counts, motions.like)
        for c in range(len(own[0].value[0]))
    ]
    w = motions.frames.at(places).pull(Vector(*lanes))
    joints = tuple((i, k) for i, k, _ in found)
    freedom = tree.branches[joints[0][0]].freedom
    pulls = []
    for c in range(freedom):
        axes: ByBranch = [list(x[c]) if c < len(x) else [0.0] * len(w) for x in motions.axes]
        pulls.append(w.dot(Vector(*motions.at_joints(axes, joints, len(w)))))
    return JointRows(start, joints, pulls)


def _to_branches(sums: list, c: int, joints: tuple[tuple[int, int], ...], lane: Lane) -> None:
    """Adds a lane over joints to the sums of their branches."""
    if isinstance(lane, int | float) and lane == 0:
        return
    lane = widened(lane, len(joints), jnp.ndim(lane) - 1)
    by_branch: dict[int, list[tuple[int, int]]] = {}
    for e, (branch, index) in enumerate(joints):
        by_branch.setdefault(branch, []).append((index, e))
    for branch, members in by_branch.items():
        indices, own = zip(*members, strict=True)
        sums[branch][c].append((indices, take(lane, own)))


def _add_outer(blocks: list[Block], row: JointRows, weight: Lane, tree: Tree) -> None:
    """Adds weight · w wᵀ to the blocks of joints."""
    k = len(row.pulls)
    for r in range(k):
        for s in range(r + 1):
            sums: list[list[list]] = [[[]] for _ in blocks]
            _to_branches(sums, 0, row.joints, times(weight, times(row.pulls[r], row.pulls[s])))
            for i, own in enumerate(sums):
                if own[0]:
                    x = collect(own[0], len(tree.branches[i].bodies))
                    blocks[i][r][s] = plus(blocks[i][r][s], x)
