"""The saddle system of trees of rigid bodies, solved by elimination along the joints.

With velocities y in common coordinates (`articulated`), joints have rows W with W (y_child −
y_parent) = b. Then y = y₀ + N q̇, with the motions N that the joints allow, and y₀ from the shortest
relative velocities that satisfy the rows. Of the equations M a = f + Jᵀλ, only those along the
joints remain:

    (Nᵀ K N + D) q̇ = Nᵀ (f − K y₀) + g.

K are the inertias of the bodies, D those of rotors, and g their forces along the joints. λ is then
known from K y − f of a child and all bodies that it carries, since the joint holds them.

References:
    Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxcon.core.jaxprs import traced_once
from jaxcon.core.lanes import Matrix, Vector, collect, minus, plus, take, times, total
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.typing import Array, Lane
from jaxcon.linear.articulated import (
    Articulated,
    ByBranch,
    Frames,
    JointGroup,
    Lanes,
    Motions,
    rows_at,
    symmetric,
    widened,
)
from jaxcon.linear.blocks import Block, freeze
from jaxcon.linear.jacobian import Block as JacobianBlock
from jaxcon.linear.roots import solve_symmetric
from jaxcon.linear.saddle import Factored, Saddle, Solution, judge
from jaxcon.linear.trees import WORLD, Tree


@dataclass(frozen=True)
class JointRows:
    """Rows on the coordinates of joints: rotors, or inequality rows.

    Attributes:
        start: the first row.
        joints: branch and index of the joint of each row.
        relative: the rows as functions of the child's velocity relative to its parent, in common
            coordinates, lanes (row, …).
        pulls: the rows as functions of the joint's velocities, lanes (row, …).
    """

    start: int
    joints: tuple[tuple[int, int], ...]
    relative: Vector
    pulls: Lanes

    @classmethod
    def of(cls, motions: Motions, start: int, own: Sequence[JacobianBlock]) -> JointRows:
        """Returns the rows of one or two blocks of a Jacobian; see `joint_places`."""
        tree = motions.tree
        found = joint_places(tree, own)
        assert found is not None
        children = tuple(tree.starts[i] + k for i, k in found)
        (w,) = rows_at(tree, motions.frames, own, children)
        joints = tuple(found)
        freedom = tree.branches[joints[0][0]].freedom
        pulls = []
        for c in range(freedom):
            axes: ByBranch = [list(x[c]) if c < len(x) else [0.0] * len(w) for x in motions.axes]
            pulls.append(w.dot(Vector(*motions.at_joints(axes, joints, len(w)))))
        return cls(start, joints, w, pulls)

    def add_forces(self, multipliers: Lane, sums: list[list[list]]) -> None:
        """Adds the forces along the joints to terms of `collect`, by branch and joint velocity.

        Args:
            multipliers: one for each row, (row, …).
            sums: the terms.
        """
        for c, x in enumerate(self.pulls):
            to_branches(sums, c, self.joints, times(x, multipliers))


def joint_places(tree: Tree, own: Sequence[JacobianBlock]) -> list[tuple[int, int]] | None:
    """Returns branch and index of the joint on which each element acts.

    None if an element acts on no joint, or if the joints differ in freedom.
    """
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
        found.append((branch, index))
    return found if len({tree.branches[i].freedom for i, _ in found}) == 1 else None


def to_branches(sums: list, c: int, joints: tuple[tuple[int, int], ...], lane: Lane) -> None:
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


def add_outer(blocks: list[Block], row: JointRows, weight: Lane, tree: Tree) -> None:
    """Adds weight · w wᵀ to the blocks of joints."""
    k = len(row.pulls)
    for r in range(k):
        for s in range(r + 1):
            sums: list[list[list]] = [[[]] for _ in blocks]
            to_branches(sums, 0, row.joints, times(weight, times(row.pulls[r], row.pulls[s])))
            for i, own in enumerate(sums):
                if own[0]:
                    x = collect(own[0], len(tree.branches[i].bodies))
                    blocks[i][r][s] = plus(blocks[i][r][s], x)


def part(x: Lane, start: int, count: int) -> Lane:
    """Returns consecutive entries of a lane."""
    if isinstance(x, int | float) or count == x.shape[0]:
        return x
    return jax.lax.slice_in_dim(x, start, start + count)


@dataclass(frozen=True)
class Drift:
    """Rows of joints or rotors whose two bodies have drifted apart.

    Joints hold W y_child + P y_parent = b. In a tree P = −W, which is exact if φ = 0.

    Attributes:
        start: the first row in J.
        parents: the place of the parent of each joint.
        rows: W + P as functions of the parent's velocity; None if the parents are the world.
        count: the number of rows of a joint.
    """

    start: int
    parents: tuple[int, ...]
    rows: list[Vector] | None
    count: int

    @classmethod
    def of(
        cls,
        motions: Motions,
        start: int,
        own: Sequence[JacobianBlock],
        children: Sequence[int],
        child_rows: Sequence[Vector],
    ) -> Drift:
        """Returns the drift of rows, of which `child_rows` are W."""
        tree = motions.tree
        parents = tuple(tree.parents[k] for k in children)
        if len(own) == 1:
            return cls(start, parents, None, len(child_rows))
        rows = rows_at(tree, motions.frames, own, parents)
        drifted = [p + w for p, w in zip(rows, child_rows, strict=True)]
        return cls(start, parents, drifted, len(child_rows))


@dataclass(frozen=True)
class TreeEquations:
    """The factored equations of motion of trees of bodies, whose rows are joints and rotors.

    They are constants: `solver` differentiates the saddle system, not its factors.

    Attributes:
        motions: the motions that the joints allow.
        joints: the joints, by their rows.
        rotor_rows: the rotors.
        drifts: the drift of all rows, in the order of J; empty in single precision.
        inertia: for each branch, the inertias K of the bodies.
        rotors: for each branch, the inertias D of rotors on joint coordinates, (k, k).
        factors: the factors of Nᵀ K N + D.
        compliance: the diagonal of C, (n_c,); None if C is zero.
    """

    motions: Motions
    joints: list[JointGroup]
    rotor_rows: list[JointRows]
    drifts: list[Drift]
    inertia: list[Block]
    rotors: list[Block]
    factors: Articulated
    compliance: Array | None

    @classmethod
    def of(
        cls, tree: Tree, position: Vector, rotation: Matrix | None, saddle: Saddle
    ) -> TreeEquations:
        """Returns the equations of a saddle system, whose mass matrix is diagonal.

        Args:
            tree: the tree of the bodies.
            position: centers of the bodies, lanes (body, …) [m].
            rotation: rotation matrices, body to world, lanes (body, …); None in the plane.
            saddle: the saddle system.
        """
        saddle, position, rotation = freeze((saddle, position, rotation))
        roots: list[int] = []
        for i, p in enumerate(tree.parents):
            roots.append(i if p == WORLD else roots[p])
        position = position.map(lambda x: take(x, tree.bodies))
        arm = position.map(lambda x: x - take(x, tuple(roots)))
        if rotation is not None:
            rotation = jax.tree.map(lambda x: take(x, tree.bodies), rotation)
        frames = Frames(rotation, arm)
        joints = JointGroup.all_of(tree, frames, saddle.jacobian)
        motions = Motions.of(tree, frames, joints, saddle.force.shape[1:])
        # 0 for an infinite mass would silently fix a body that no joint fixes
        diagonal = finite_or_nan(saddle.mass.diagonal)
        mass = Vector.of_rows(diagonal, 0, motions.size, len(tree.bodies))
        whole = frames.inertia(mass.map(lambda x: take(x, tree.bodies)))
        inertia = [
            [[part(x, start, len(b.bodies)) for x in row] for row in whole]
            for b, start in zip(tree.branches, tree.starts, strict=True)
        ]
        rotors: list[Block] = [[[0.0] * (r + 1) for r in range(b.freedom)] for b in tree.branches]
        rotor_rows, drifts = [], []
        groups = {group.start: group for group in joints}
        for start, own in saddle.jacobian.by_rows():
            if start in groups:
                children, rows = groups[start].children, groups[start].rows.given
            else:
                assert saddle.compliance is not None
                weight = 1 / saddle.compliance[start : start + own[0].shape[1]]
                row = JointRows.of(motions, start, own)
                add_outer(rotors, row, weight, tree)
                rotor_rows.append(row)
                children, rows = [tree.starts[i] + k for i, k in row.joints], [row.relative]
            if jnp.finfo(saddle.force.dtype).bits == 64:
                drifts.append(Drift.of(motions, start, own, children, rows))
        factors = Articulated(motions, inertia, rotors)
        c = saddle.compliance
        return cls(motions, joints, rotor_rows, drifts, inertia, rotors, factors, c)

    def solver(self, saddle: Saddle) -> Factored:
        """Returns a function (f, b) → `Solution`, which is differentiated implicitly.

        Args:
            saddle: the saddle system of which these are the equations.
        """
        j, compliance, n = saddle.jacobian, saddle.compliance, len(saddle.force)
        dependent = jnp.zeros(saddle.force.shape[1:], bool)
        for group in self.joints:
            if group.rows.dependent is not None:
                dependent = dependent | jnp.any(group.rows.dependent, axis=0)

        # one array, since JAX does not transpose a solve of which only a part is used
        @traced_once
        def apply(x: Array) -> Array:
            a, ν = x[:n], x[n:]
            moved = j.apply(a)
            if compliance is not None:
                moved = moved - compliance * ν
            return jnp.concatenate([saddle.mass.apply(a) + j.transpose(ν), moved])

        @traced_once
        def inverse(right: Array) -> Array:
            return jnp.concatenate(self.solve(right[:n], right[n:]))

        def solve(force: Array, target: Array) -> Solution:
            right = jnp.concatenate([force, target])
            x = solve_symmetric(apply, right, inverse)
            a, ν = x[:n], x[n:]
            dependent_only = dependent & jnp.all(jnp.isfinite(a), axis=0)
            code = judge(a, saddle.mass.singular | dependent_only)
            return Solution(a, -ν, code)

        return solve

    def solve(self, force: Array, target: Array) -> tuple[Array, Array]:
        """Returns a and −λ with M a − Jᵀλ = f and J a + C λ = b.

        If joints have drifted apart by φ, the error is of the order of φ, relative to the arms of
        the bodies. In double precision, a second round takes the drift into account, which reduces
        it to φ².

        Args:
            force: f, (n_v,).
            target: b, (n_c,).
        """
        motions, tree = self.motions, self.motions.tree
        n = len(tree.parents)
        lanes = Vector.of_rows(force, 0, motions.size, n)
        applied = motions.frames.pull(lanes.map(lambda x: take(x, tree.bodies)))
        shape = (n, *target.shape[1:])
        wrench = jnp.stack([jnp.broadcast_to(x, shape) for x in applied])

        def solved(wrench: Array, target: Array) -> tuple[Array, Array]:
            y, ν = self._without_drift(self._by_branch(Vector.of(wrench)), target)
            return self._stacked(y, force), ν

        y, ν = solved(wrench, target)
        if any(x.rows is not None for x in self.drifts):
            wrenches, targets = self._drifted(y, ν)
            y, ν = solved(wrench + wrenches, target + targets)
        return self._velocity(y), ν

    def _drifted(self, y: Array, multipliers: Array) -> tuple[Array, Array]:
        """Returns forces on the bodies (lane, body, …) and targets (n_c,) that make up for drift.

        Args:
            y: accelerations of the bodies, (lane, body, …).
            multipliers: −λ, (n_c,).
        """
        size, n = len(y), y.shape[1]
        sums: list[list] = [[] for _ in range(size)]
        targets = []
        for drift in self.drifts:
            m = len(drift.parents)
            ν = Vector.of_rows(multipliers, drift.start, drift.count, m)
            if drift.rows is None:
                targets += [(jnp.zeros_like(x), m) for x in ν]
                continue
            above = Vector(*(take(x, drift.parents) for x in Vector.of(y)))
            targets += [(-row.dot(above), m) for row in drift.rows]
            for c, terms in enumerate(sums):
                force = total(times(-row[c], x) for row, x in zip(drift.rows, ν, strict=True))
                terms.append((drift.parents, force))
        shape = y.shape[1:]
        forces = [jnp.broadcast_to(jnp.asarray(collect(x, n), y.dtype), shape) for x in sums]
        rows = [jnp.broadcast_to(x, (m, *shape[1:])) for x, m in targets]
        return jnp.stack(forces), jnp.concatenate(rows)

    def _without_drift(self, f: ByBranch, target: Array) -> tuple[ByBranch, Array]:
        """Returns the accelerations of the bodies and −λ, (n_c,), for joints without drift.

        Args:
            f: forces on the bodies, by branch.
            target: b, (n_c,).
        """
        motions, tree = self.motions, self.motions.tree
        size = motions.size
        least: dict[int, Vector] = {}
        for group in self.joints:
            m = len(group.children)
            right = Vector.of_rows(target, group.start, size - len(group.rows.complement), m)
            least[group.start] = group.rows.least([*right])
        shortest: ByBranch = [
            [0.0] * size if b.row is None else [take(x, b.elements) for x in least[b.row]]
            for b in tree.branches
        ]
        start = motions.sums_from_roots(shortest)
        # −λ of rotors is (w (d + S q̇) − b)/C, with the shortest d and w of `JointRows.relative`
        sums: list[list[list]] = [[[] for _ in range(b.freedom)] for b in tree.branches]
        for row in self.rotor_rows:
            lacking = minus(self._target(row, target), self._rate(row, shortest))
            row.add_forces(times(self._stiffness(row), lacking), sums)
        along = [
            [collect(s, len(b.bodies)) for s in x] for b, x in zip(tree.branches, sums, strict=True)
        ]
        left = [
            [minus(x, y) for x, y in zip(own, symmetric(k, y0), strict=True)]
            for own, k, y0 in zip(f, self.inertia, start, strict=True)
        ]
        joint, moved = self.factors.solve(left, along)
        y = [
            [plus(a, b) for a, b in zip(p, q, strict=True)]
            for p, q in zip(start, moved, strict=True)
        ]
        return y, self._multipliers(y, f, shortest, joint, target)

    def _stiffness(self, row: JointRows) -> Array:
        """Returns 1/C of rotors, (row, …)."""
        assert self.compliance is not None
        return 1 / self.compliance[row.start : row.start + len(row.joints)]

    def _target(self, row: JointRows, target: Array) -> Array:
        """Returns b of rotors, (row, …)."""
        return target[row.start : row.start + len(row.joints)]

    def _rate(self, row: JointRows, relative: ByBranch) -> Lane:
        """Returns w·y of rotors, (row, …), for velocities y of children relative to parents."""
        return row.relative.dot(
            Vector(*self.motions.at_joints(relative, row.joints, self.motions.size))
        )

    def _by_branch(self, lanes: Vector) -> ByBranch:
        """Splits lanes over all bodies, in the order of the tree."""
        tree = self.motions.tree
        return [
            [part(x, start, len(b.bodies)) for x in lanes]
            for b, start in zip(tree.branches, tree.starts, strict=True)
        ]

    def _stacked(self, by_branch: ByBranch, like: Array) -> Array:
        """Returns lanes of bodies by branch as one array, (lane, body, …)."""
        shape, branches = like.shape[1:], self.motions.tree.branches
        return jnp.stack(
            [
                jnp.concatenate(
                    [
                        jnp.broadcast_to(jnp.asarray(lanes[c], like.dtype), (len(b.bodies), *shape))
                        for lanes, b in zip(by_branch, branches, strict=True)
                    ]
                )
                for c in range(self.motions.size)
            ]
        )

    def _velocity(self, y: Array) -> Array:
        """Returns velocities in common coordinates as those of centers and body axes, (n_v,)."""
        tree = self.motions.tree
        own = self.motions.frames.push(Vector.of(y))
        back = tuple(tree.places[b] for b in range(len(tree.bodies)))
        return jnp.concatenate([take(x, back) for x in own])

    def _multipliers(
        self, y: ByBranch, f: ByBranch, shortest: ByBranch, joint: ByBranch, target: Array
    ) -> Array:
        """Returns −λ, (n_c,).

        Args:
            y: accelerations of the bodies, by branch.
            f: forces on the bodies, by branch.
            shortest: the part of the relative accelerations that the rows of the joints determine.
            joint: accelerations along the joints, by branch.
            target: b, (n_c,).
        """
        motions, tree = self.motions, self.motions.tree
        lacking = [
            [minus(x, z) for x, z in zip(own, symmetric(k, a), strict=True)]
            for own, k, a in zip(f, self.inertia, y, strict=True)
        ]
        carried = motions.sums_to_roots(lacking)  # f − K y = −Wᵀ λ of a child and its descendants
        parts: list[tuple[int, Lanes, int]] = []
        of_rotors: list[list[list]] = [[[] for _ in range(motions.size)] for _ in tree.branches]
        for row in self.rotor_rows:
            free = plus(
                self._rate(row, shortest),
                total(map(times, row.pulls, motions.at_joints(joint, row.joints, len(row.pulls)))),
            )
            ν = times(self._stiffness(row), minus(free, self._target(row, target)))
            parts.append((row.start, [ν], len(row.joints)))
            for c, x in enumerate(row.relative):
                to_branches(of_rotors, c, row.joints, times(x, ν))
        for branch, own, more in zip(tree.branches, carried, of_rotors, strict=True):
            own[:] = [
                minus(x, collect(s, len(branch.bodies))) for x, s in zip(own, more, strict=True)
            ]
        for group in self.joints:
            held = Vector(*motions.gather(carried, group.children))
            parts.append((group.start, group.rows.coefficients(held), len(group.children)))
        lanes = [(x, m) for _, own, m in sorted(parts, key=lambda p: p[0]) for x in own]
        return jnp.concatenate(
            [
                jnp.broadcast_to(jnp.asarray(x, target.dtype), (m, *target.shape[1:]))
                for x, m in lanes
            ]
        )
