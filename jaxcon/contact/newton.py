"""Solves inequality rows by Newton's method for the velocities of the bodies.

The end velocity of a step is v = v₀ + N z, where v₀ is the velocity without inequality rows and N z
are the motions that the joints allow. Each row i has the law λ = P(λ̂ − (J v − u*)/R), where P
projects onto the bounds of λ and λ̂ is an estimate of λ. For fixed λ̂ and fixed friction bounds μ λ̂_n
these are the conditions of a convex problem,

    min ½ zᵀ Nᵀ M N z + Σ ½ R ‖P(λ̂ − (J v − u*)/R)‖²,

which Newton's method with a line search solves. Its matrix is Nᵀ (M + Jᵀ D J) N, with D = 1/R in
active rows: rows on a body change only the body's own block, rows on a joint coordinate only the
joint's. After each full step λ̂ becomes the new λ. A fixed point obeys the laws without
regularization, whatever R is.

References:
    Castro, Permenter, Han, An Unconstrained Convex Formulation of Compliant Contact, IEEE T-RO
        (2022), for the convex problem and its line search.
    Carpentier, Le Lidec, Montaut, From Compliant to Rigid Contact Simulation, RSS (2024), for
        proximal iterations.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.contact.bounded import Bounded, RowCounts, RowsByLaw
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.rows import BoundRows
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector, collect, plus, take, times, total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, Lane
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
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.saddle import Diagonal, Saddle
from jaxcon.linear.trees import WORLD, Tree, structure, tree_of
from jaxcon.protocols import ContactSolver
from jaxcon.system.bodies import PlanarRigid, SpatialRigid

SHARE = 0.3
"""R at the start, as a share of the inverse mass that a row meets."""

EASE, LEAST = 0.5, 0.1
"""The factor of R after each full step, and the least product of these factors.

A large R decides soon which rows act. A small R then needs fewer iterations.
"""


@pytree
class Newton(checks.Checked, ContactSolver):
    """Newton's method for the velocities of bodies that joints connect to trees.

    Attributes:
        iterations: the largest number of iterations in a step.
        tolerance: the violation of the laws at which a world is done [m/s, rad/s]; None for 2e-6 in
            single precision and 2e-13 in double precision.
        warm: True to start from the multipliers of the last step.
        smoothing: width of the smoothed corners of the laws, for the derivative only [m/s, rad/s].
    """

    iterations: int = static(default=12)
    tolerance: float | None = static(default=None)
    warm: bool = static(default=True)  # type: ignore[override]
    smoothing: Any = None
    exact = False  # type: ignore[assignment]

    def check(self) -> None:
        """Checks the number of iterations, the tolerance, the warm start and the smoothing."""
        checks.count("Newton", "iterations", self.iterations)
        checks.flag("Newton", "warm", self.warm)
        checks.check("Newton", "tolerance", self.tolerance, (), above=0, optional=True)
        checks.check("Newton", "smoothing", self.smoothing, (), least=0, optional=True)

    def reached(self, dtype: Any) -> float:
        """Returns the violation at which a world is done [m/s, rad/s]."""
        if self.tolerance is not None:
            return self.tolerance
        return 2e-6 if jnp.finfo(dtype).eps > 1e-10 else 2e-13

    def solve(self, problem: Bounded, start: Array) -> Array:
        """Returns the multipliers λ, (n,), of a problem whose bodies form no tree, by sweeps."""
        return GaussSeidel().solve(problem, start)


def tree_below(system: Any, joints: Jacobian, layout: Any, rows: Jacobian) -> Tree | None:
    """Returns the tree of a system's bodies; None if `Newton` cannot use it.

    Args:
        system: the system.
        joints: the Jacobian of the equality rows.
        layout: the layout of the equality rows.
        rows: the Jacobian of the inequality rows.
    """
    if system.layout is None or not isinstance(joints, Jacobian) or not isinstance(rows, Jacobian):
        return None
    if len(system.layout.groups) != 1 or layout.loops:
        return None
    (group,) = system.layout.groups
    if type(group.kind) not in (SpatialRigid, PlanarRigid):
        return None
    soft = frozenset(
        start
        for start, own in joints.by_rows()
        if not layout.holds[start : start + own[0].shape[0] * own[0].shape[1]].all()
    )
    tree = tree_of(structure(joints), soft, len(group.names), group.kind.n_v)
    if tree is None:
        return None
    for start, own in [*rows.by_rows(), *(x for x in joints.by_rows() if x[0] in soft)]:
        if len(own) > 2:
            return None
        if len(own) == 2 and _joint_places(tree, own) is None:
            return None
    return tree


def _joint_places(tree: Tree, own: list) -> list[tuple[int, int, int]] | None:
    """Returns branch, index and side of the joint on which each element of two blocks acts."""
    found = []
    for a, b in zip(own[0].columns.indices, own[1].columns.indices, strict=True):
        pa, pb = tree.places[a], tree.places[b]
        if tree.parents[pb] == pa:
            found.append((*tree.branch_of(pb), 1))
        elif tree.parents[pa] == pb:
            found.append((*tree.branch_of(pa), 0))
        else:
            return None
    if len({tree.branches[i].freedom for i, *_ in found}) != 1:
        return None
    return found


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
        cls, system: Any, q: Array, v: Array, saddle: Saddle, rows: BoundRows
    ) -> BodySpace | None:
        """Returns the equations of a system; None if its bodies form no tree."""
        j = rows.jacobian
        if not isinstance(saddle.mass, Diagonal) or not isinstance(j, Jacobian):
            return None
        tree = tree_below(system, saddle.jacobian, saddle.layout, j)
        if tree is None:
            return None
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
        if isinstance(group.kind, SpatialRigid):
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
        rotors = [[[0.0] * (r + 1) for r in range(b.freedom)] for b in tree.branches]
        holds = saddle.layout.holds
        for start, own in joints.by_rows():
            m = own[0].shape[1]
            if holds[start]:
                continue
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
            z = _gathered(
                joints, row.joints, len(row.pulls), self.motions.tree, len(self.motions.shape)
            )
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
        bodies = [
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
        self, slope: Array, kinds: RowCounts, discs: list
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
            block = [list(itertools.islice(lanes, r + 1)) for r in range(size)]
            for start, pull in zip(group.starts, group.pulls, strict=True):
                parts.append((start, len(group.places), pull.dot(Vector(*symmetric(block, pull)))))
        for row in self.on_joints:
            k = len(row.pulls)
            inverse = [[x for r in b for x in r] for b in ofjoints]
            lanes = iter(
                _gathered(
                    inverse,
                    row.joints,
                    k * (k + 1) // 2,
                    self.motions.tree,
                    len(self.motions.shape),
                )
            )
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
    dtype: Any,
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


def _on_joints(motions: Motions, start: int, own: list) -> JointRows:
    """Returns rows of two blocks as functions of joint velocities."""
    tree = motions.tree
    found = _joint_places(tree, own)
    assert found is not None
    places = tuple(tree.starts[i] + k for i, k, _ in found)
    counts = [b.shape[1] for b in own]
    picks = [(side, e) for e, (*_, side) in enumerate(found)]
    lanes = [
        picked([b.value[0][c] for b in own], picks, counts, len(motions.shape))
        for c in range(len(own[0].value[0]))
    ]
    w = motions.frames.at(places).pull(Vector(*lanes))
    joints = tuple((i, k) for i, k, _ in found)
    freedom = tree.branches[joints[0][0]].freedom
    sizes = [len(b.bodies) for b in tree.branches]
    pulls = [
        w.dot(
            Vector(
                *(
                    picked(
                        [x[c][a] if c < len(x) else 0.0 for x in motions.axes],
                        joints,
                        sizes,
                        len(motions.shape),
                    )
                    for a in range(len(w))
                )
            )
        )
        for c in range(freedom)
    ]
    return JointRows(start, joints, pulls)


def _gathered(
    by_branch: ByBranch, joints: tuple[tuple[int, int], ...], k: int, tree: Tree, rank: int
) -> Lanes:
    """Returns the first k lanes of joints."""
    sizes = [len(b.bodies) for b in tree.branches]
    return [
        picked([x[c] if c < len(x) else 0.0 for x in by_branch], joints, sizes, rank)
        for c in range(k)
    ]


def _to_branches(sums: list, c: Any, joints: tuple[tuple[int, int], ...], lane: Lane) -> None:
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


class _State(NamedTuple):
    """The state of the iteration.

    Attributes:
        count: number of iterations so far.
        velocity: u of the rows, (n,).
        center: λ̂, (n,).
        multipliers: λ, (n,).
        momentum: M (v − v₀) of bodies and joints, by branch.
        going: True in worlds that are not done.
        left: the largest violation of the laws, as a velocity, (1,).
        ease: the factor of R, (1,).
    """

    count: Array
    velocity: Array
    center: Array
    multipliers: Array
    momentum: tuple[ByBranch, ByBranch]
    going: Array
    left: Array
    ease: Array


class Laws(NamedTuple):
    """The laws of the rows, with all numbers as impulses.

    Attributes:
        kinds: numbers of rows by law.
        regularization: R, (n,).
        compliance: C/h, (n,).
        lower, upper: bounds of boxes.
        coefficients: μ of each disc.
        acts: mask of the active rows, (n,).
    """

    kinds: RowCounts
    regularization: Array
    compliance: Array
    lower: Array
    upper: Array
    coefficients: tuple[Array, ...]
    acts: Array

    def eased(self, factor: Array) -> Laws:
        """Returns the laws with R multiplied by a factor, (1,)."""
        return self._replace(regularization=factor * self.regularization)

    def ahead(self, center: Array, velocity: Array) -> Array:
        """Returns the multipliers before projection, (n,)."""
        r = self.regularization
        return (r * center - velocity) / (r + self.compliance)

    def project(self, center: Array, velocity: Array) -> Array:
        """Returns λ, (n,)."""
        x, here = self.kinds.split(self.ahead(center, velocity)), self.kinds.split(center)
        pressed = jnp.maximum(here.normal, 0)
        discs = []
        for disc, μ, y in zip(self.kinds.discs, self.coefficients, x.discs, strict=True):
            if not len(y):
                discs.append(y)
                continue
            length = numerics.norm(y)
            radius = μ * disc.of(pressed)
            discs.append(y * jnp.minimum(1, radius / jnp.where(length > 0, length, 1)))
        λ = self.kinds.join(
            RowsByLaw(
                jnp.maximum(x.single, 0),
                jnp.clip(x.box, self.lower, self.upper),
                jnp.maximum(x.normal, 0),
                tuple(discs),
            )
        )
        return jnp.where(self.acts, λ, 0)

    def slope(self, center: Array, velocity: Array) -> tuple[Array, list[tuple[Array, Vector]]]:
        """Returns −∂λ/∂u: its diagonal part a, (n,), and for each disc b and t of −b t tᵀ."""
        stiff = jnp.where(self.acts, 1 / (self.regularization + self.compliance), 0)
        x, here = self.kinds.split(self.ahead(center, velocity)), self.kinds.split(center)
        k = self.kinds.split(stiff)
        pressed = jnp.maximum(here.normal, 0)
        a_discs, others = [], []
        for disc, μ, y, s in zip(
            self.kinds.discs, self.coefficients, x.discs, k.discs, strict=True
        ):
            if not len(y):
                a_discs.append(y)
                others.append((jnp.zeros(()), y))
                continue
            length = numerics.norm(y)
            safe = jnp.where(length > 0, length, 1)
            radius = μ * disc.of(pressed)
            share = jnp.minimum(1, radius / safe)
            slides = length > radius
            a = s.map(lambda z, f=share: z * f)
            a_discs.append(a)
            others.append((jnp.where(slides, a[0], 0), y * (1 / safe)))
        diagonal = self.kinds.join(
            RowsByLaw(
                jnp.where(x.single > 0, k.single, 0),
                jnp.where((x.box > self.lower) & (x.box < self.upper), k.box, 0),
                jnp.where(x.normal > 0, k.normal, 0),
                tuple(a_discs),
            )
        )
        return diagonal, others


def multipliers(
    space: BodySpace,
    rows: BoundRows,
    offset: Array,
    start: Array,
    acts: Array | None,
    bare: Array,
    dt: Array,
    solver: Newton,
) -> tuple[Array, Array, Array, Array]:
    """Returns λ, (n,), and what is known about it.

    Args:
        space: the equations of motion.
        rows: the inequality rows.
        offset: velocities of the rows without multipliers, minus their targets, (n,).
        start: the estimate of λ, (n,).
        acts: mask of the active rows, (n,); None for all.
        bare: diagonal of J M⁻¹ Jᵀ, (n,).
        dt: step size h, () [s].
        solver: the solver.

    Returns:
        λ, (n,); the inverse mass g of each row, (n,); the mask of movable rows, (n,); the largest
        violation of the laws, ().
    """
    kinds, motions = rows.kinds, space.motions
    tree, order = motions.tree, space.order
    sorts = (order != np.arange(len(order))).any()
    friction, resistance, compliance = rows.friction, rows.resistance, rows.compliance
    if sorts:
        contacts = order[kinds.normal : kinds.normal + kinds.contacts] - kinds.normal
        friction = friction[contacts]
        resistance = tuple(
            x[contacts[disc.first : disc.first + disc.count] - disc.first]
            for x, disc in zip(resistance, kinds.turning, strict=True)
        )
        offset, start, bare, compliance = (x[order] for x in (offset, start, bare, compliance))
        acts = None if acts is None else acts[order]
    free = Articulated(motions, space.inertia, space.rotors)
    mass, of_joints = space.mobility(free, offset)
    rounding = 64 * float(jnp.finfo(offset.dtype).eps)
    movable = mass > rounding * bare
    movable = movable if acts is None else movable & acts
    movable = kinds.under_normals(kinds.split(movable))
    joint = kinds.largest(jnp.where(movable, mass, 0))
    scale = jnp.where(movable, joint, 1)
    offset = jnp.where(movable, offset, 0)
    h = dt[None]
    first_laws = Laws(
        kinds,
        SHARE * scale,
        jnp.where(movable, compliance / h, 0),
        h * rows.lower,
        h * rows.upper,
        (friction, *resistance),
        movable,
    )
    center = jnp.where(movable, h * start, 0)
    z, y = free.solve(*space.pull(center))
    velocity = offset + jnp.where(movable, space.rows_of(y, z, offset), 0)
    reach = [[b[r][r] for r in range(len(b))] for b in of_joints]

    def wide(x: ByBranch) -> ByBranch:
        return [
            [
                jnp.broadcast_to(jnp.asarray(a, offset.dtype), (len(b.bodies), *motions.shape))
                for a in lanes
            ]
            for b, lanes in zip(tree.branches, x, strict=True)
        ]

    momentum = tuple(map(wide, space.momentum(y, z)))

    def forces(λ: Array, momentum: Any) -> tuple[ByBranch, ByBranch]:
        pairs = zip(space.pull(λ), momentum, strict=True)
        return tuple(
            [[a - m for a, m in zip(p, q, strict=True)] for p, q in zip(f, old, strict=True)]
            for f, old in pairs
        )  # type: ignore[return-value]

    def judged(count: Array, u: Array, center: Array, momentum: Any, ease: Array) -> _State:
        laws = first_laws.eased(ease)
        λ = laws.project(center, u)
        left = jnp.max(laws.regularization * jnp.abs(λ - center), axis=0)
        gradient = motions.gradient(*forces(λ, momentum))
        for lanes, own in zip(gradient, reach, strict=True):
            for g, v in zip(lanes, own, strict=True):
                left = jnp.maximum(left, jnp.max(jnp.abs(g * v), axis=0))
        return _State(
            count, u, center, λ, momentum, left > solver.reached(left.dtype), left[None], ease
        )

    def iterate(state: _State) -> _State:
        count, u, center, λ, momentum, going, _, ease = state
        laws = first_laws.eased(ease)
        diagonal, discs = laws.slope(center, u)
        factors = Articulated(motions, *space.stiffened(diagonal, kinds, discs))
        pulls = forces(λ, momentum)
        dz, dy = factors.solve(*pulls)
        du = jnp.where(movable, space.rows_of(dy, dz, u), 0)
        change = space.momentum(dy, dz)
        first = -_work(pulls[0], dy) - _work(pulls[1], dz)
        square = _work(change[0], dy) + _work(change[1], dz)

        def slope(α: Array) -> Array:
            new = laws.project(center, u + α[None] * du)
            return first + α * square - jnp.sum((new - λ) * du, axis=0)

        α, whole = _line_search(slope, first, going)
        α = jnp.where(going, α, 0)
        u = u + α[None] * du
        momentum = jax.tree.map(lambda p, d: p + α[None] * d, momentum, tuple(map(wide, change)))
        new = laws.project(center, u)
        center = jnp.where((going & whole)[None], new, center)
        ease = jnp.where(whole, jnp.maximum(EASE * ease, LEAST), ease)
        after = judged(count + 1, u, center, momentum, ease)
        # a world that is done keeps its λ
        return after._replace(
            multipliers=jnp.where(going[None], after.multipliers, λ), going=after.going & going
        )

    def goes(state: _State) -> Array:
        return (state.count < solver.iterations) & somewhere(state.going)

    ones = jnp.ones_like(offset[:1])
    first_state = judged(jnp.zeros((), jnp.int32), velocity, center, momentum, ones)
    last = jax.lax.while_loop(goes, iterate, first_state)
    found = (last.multipliers / h, scale, movable)
    if sorts:
        back = np.argsort(order)
        found = tuple(x[back] for x in found)  # type: ignore[assignment]
    return *found, jnp.max(last.left, axis=0)


def _work(forces: ByBranch, velocities: ByBranch) -> Lane:
    """Returns Σ f·v over all bodies, ()."""
    return total(
        jnp.sum(x * y, axis=0)
        for own, v in zip(forces, velocities, strict=True)
        for x, y in zip(own, v, strict=True)
        if not isinstance(times(x, y), float)
    )


FLAT, TRIES = 0.01, 4


def _line_search(slope: Any, first: Array, going: Array) -> tuple[Array, Array]:
    """Returns the step length α in (0, 1] at which a convex function is smallest, nearly, ().

    Args:
        slope: its derivative by α.
        first: the derivative at 0, negative.
        going: worlds that need a step.

    Returns:
        α, and True where it is 1.
    """
    one = jnp.ones_like(first)
    end = slope(one)
    steep = going & (end > FLAT * jnp.abs(first))

    def cond(s: Any) -> Array:
        return (s[0] < TRIES) & somewhere(s[-1])

    def body(s: Any) -> Any:
        count, α, low, high, at_low, at_high, bad = s
        guess = low - at_low * (high - low) / jnp.where(at_high > at_low, at_high - at_low, 1)
        guess = jnp.clip(guess, low + 0.1 * (high - low), low + 0.9 * (high - low))
        here = slope(guess)
        up, down = bad & (here > 0), bad & (here <= 0)
        return (
            count + 1,
            jnp.where(bad, guess, α),
            jnp.where(down, guess, low),
            jnp.where(up, guess, high),
            jnp.where(down, here, at_low),
            jnp.where(up, here, at_high),
            bad & (jnp.abs(here) > 0.1 * jnp.abs(first)),
        )

    start = (jnp.zeros((), jnp.int32), one, 0 * one, one, first, end, steep)
    α = jax.lax.while_loop(cond, body, start)[1]
    return α, ~steep
