"""Motions of a tree of rigid bodies, and elimination along its joints.

All bodies of a tree have velocities in common coordinates: (ω, v), where ω is the angular velocity
in the world frame and v the velocity of the body's material point at a reference point, which all
bodies share. A joint then allows v_child = v_parent + S q̇ (S: the motions, q̇: joint velocities),
and a force on a body has the same components for its parent. No quantity is transformed when it
moves along the tree, as in the articulated-body algorithm in world coordinates.

References:
    Featherstone, Rigid Body Dynamics Algorithms (2008), chapters 2 and 7.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Matrix, Vector, collect, minus, plus, side_by_side, take, times, total
from jaxcon.core.typing import Array, Lane
from jaxcon.linear import blocks
from jaxcon.linear.blocks import Block
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.trees import WORLD, Tree

Lanes = list[Lane]
ByBranch = list[Lanes]
"""Lanes for each branch of a tree: six (three in the plane) for bodies, k for joints."""


@dataclass(frozen=True)
class Frames:
    """The bodies of a system in the order of a tree.

    Attributes:
        rotation: rotation matrices R, body to world, lanes (body, …); None in the plane.
        arm: position of each body from the reference point of its tree, lanes (body, …) [m].
    """

    rotation: Matrix | None
    arm: Vector

    def at(self, places: tuple[int, ...]) -> Frames:
        """Returns the frames of the bodies at the given places."""
        rotation = self.rotation
        if rotation is not None:
            rotation = Matrix(*(row.map(lambda x: take(x, places)) for row in rotation))
        return Frames(rotation, self.arm.map(lambda x: take(x, places)))

    def pull(self, row: Vector) -> Vector:
        """Returns a row of a Jacobian in common coordinates: its entries for (ω, v).

        Args:
            row: the entries for the velocity of the center and the angular velocity in the body
                frame, lanes (body, …).
        """
        if self.rotation is None:
            linear, turning = Vector(*row[:2]), row[2]
            return Vector(plus(turning, self.arm.cross(linear)), *linear)
        linear = Vector(*row[:3])
        return Vector(*(self.rotation @ Vector(*row[3:]) + self.arm.cross(linear)), *linear)

    def inertia(self, mass: Vector) -> Block:
        """Returns the lower triangle of the inertia in common coordinates.

        Args:
            mass: the diagonal of M, lanes (body, …): masses, then moments of inertia.
        """
        m, d = mass[0], self.arm
        if self.rotation is None:
            x, y = d
            turning = plus(mass[2], times(m, d.dot(d)))
            return [[turning], [times(-1, times(m, y)), m], [times(m, x), 0.0, m]]
        spun = [row * 1.0 for row in self.rotation]
        weighted = [Vector(*map(times, row, mass[3:])) for row in self.rotation]
        square = d.dot(d)
        block: Block = []
        for i in range(3):
            line = []
            for j in range(i + 1):
                x = plus(weighted[i].dot(spun[j]), times(-1, times(m, times(d[i], d[j]))))
                line.append(plus(x, times(m, square)) if i == j else x)
            block.append(line)
        x, y, z = (times(m, c) for c in d)
        # v·(ω × d) m = ω·(d × v) m: the rows of v are −m [d]× transposed
        lower = [[0.0, z, times(-1, y)], [times(-1, z), 0.0, x], [y, times(-1, x), 0.0]]
        for i in range(3):
            block.append([*lower[i], *(m if i == j else 0.0 for j in range(i + 1))])
        return block


def complement(rows: Sequence[Vector], size: int) -> list[Vector]:
    """Returns an orthonormal basis of the vectors normal to all rows, by Householder reflections.

    Args:
        rows: independent vectors with `size` components each.
        size: the number of components.

    References:
        Golub, Van Loan, Matrix Computations (2013), section 5.2.
    """
    columns = [list(row) for row in rows]
    mirrors: list[tuple[Lanes, Lane]] = []
    for j, column in enumerate(columns):
        x = column[j:]
        length = numerics.norm(Vector(*x))
        sign = jnp.where(jnp.asarray(x[0]) < 0, -1.0, 1.0).astype(length.dtype)
        normal = [plus(x[0], sign * length), *x[1:]]
        # the normal is zero only if a row is: then its world fails, and others must not
        share = numerics.safe_divide(2.0, total(times(y, y) for y in normal))
        mirrors.append((normal, share))
        for other in columns[j + 1 :]:
            other[j:] = _mirrored(normal, share, other[j:])
    basis = []
    for c in range(len(rows), size):
        vector: Lanes = [1.0 if i == c else 0.0 for i in range(size)]
        for j, (normal, share) in reversed(list(enumerate(mirrors))):
            vector[j:] = _mirrored(normal, share, vector[j:])
        basis.append(Vector(*vector))
    return basis


def _mirrored(normal: Lanes, share: Lane, x: Lanes) -> Lanes:
    """Returns x − share (normal·x) normal."""
    along = times(share, total(map(times, normal, x)))
    return [minus(y, times(along, n)) for y, n in zip(x, normal, strict=True)]


@dataclass(frozen=True)
class Motions:
    """The motions that the joints of a tree allow.

    Attributes:
        tree: the tree.
        frames: the bodies, in the order of the tree.
        axes: for each branch, the k columns of S, vectors of lanes (body, …).
        shape: the shape of the batch.
    """

    tree: Tree
    frames: Frames
    axes: list[list[Vector]]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of velocities of a body."""
        return 6 if len(self.frames.arm) == 3 else 3

    @classmethod
    def of(cls, tree: Tree, frames: Frames, joints: Jacobian, shape: tuple[int, ...]) -> Motions:
        """Returns the motions, from the Jacobian of the equality rows."""
        groups = dict(joints.by_rows())
        axes, size = [], 3 if frames.rotation is None else 6
        for branch, start in zip(tree.branches, tree.starts, strict=True):
            if branch.row is None:
                unit = [[1.0 if i == c else 0.0 for i in range(size)] for c in range(size)]
                axes.append([Vector(*x) for x in unit])
                continue
            own = groups[branch.row]
            here = frames.at(tuple(range(start, start + len(branch.bodies))))
            # the child is on one side of all joints, or on different sides; both ends have the
            # same rows up to their sign, and the sign does not change the complement
            picks = [
                (next(i for i, b in enumerate(own) if b.columns.indices[e] == body), e)
                for body, e in zip(branch.bodies, branch.elements, strict=True)
            ]
            counts = [b.shape[1] for b in own]
            rows = [
                here.pull(
                    Vector(
                        *(
                            picked([b.value[r][c] for b in own], picks, counts, frames.arm[0])
                            for c in range(size)
                        )
                    )
                )
                for r in range(len(own[0].value))
            ]
            axes.append(complement(rows, size))
        return cls(tree, frames, axes, shape)

    @property
    def like(self) -> Array:
        """A lane over all bodies, with the batch axes and the dtype of all others."""
        return self.frames.arm[0]

    @property
    def freedom(self) -> int:
        """The number of joint velocities."""
        return sum(len(b.bodies) * b.freedom for b in self.tree.branches)

    def flat(self, joints: ByBranch) -> Array:
        """Returns lanes over joints as one array, (joint velocity, …)."""
        shape, dtype = self.shape, self.like.dtype
        return jnp.concatenate(
            [
                jnp.broadcast_to(jnp.asarray(x, dtype), (len(b.bodies), *shape))
                for b, lanes in zip(self.tree.branches, joints, strict=True)
                for x in lanes
            ]
        )

    def by_branch(self, x: Array) -> ByBranch:
        """Splits an array (joint velocity, …) to lanes over joints; the inverse of `flat`."""
        sizes = [len(b.bodies) for b in self.tree.branches for _ in range(b.freedom)]
        lanes = iter(jax.lax.split(x, sizes))
        return [list(itertools.islice(lanes, b.freedom)) for b in self.tree.branches]

    def gather(self, by_branch: ByBranch, places: tuple[int, ...]) -> Lanes:
        """Returns the lanes of the bodies at given places; zero for `WORLD`.

        `by_branch` may end before the last branch, if it contains these places.
        """
        count = len(by_branch)
        picks = [(count, 0) if p == WORLD else self.tree.branch_of(p) for p in places]
        counts = [*self.tree.sizes[:count], 1]
        return [
            picked([*(x[c] for x in by_branch), 0.0], picks, counts, self.like)
            for c in range(len(by_branch[0]))
        ]

    def at_joints(self, by_branch: ByBranch, joints: Sequence[tuple[int, int]], k: int) -> Lanes:
        """Returns the first k lanes of chosen joints, given by branch and index."""
        lanes = ([x[c] if c < len(x) else 0.0 for x in by_branch] for c in range(k))
        return [picked(x, joints, self.tree.sizes, self.like) for x in lanes]

    def to_parents(self, i: int, lanes: Lanes, sums: list[list[list]]) -> None:
        """Adds the lanes of the bodies of branch i to those of their parents, in `sums`."""
        by_parent: dict[int, list[tuple[int, int]]] = {}
        for k, p in enumerate(self.tree.branches[i].parents):
            if p != WORLD:
                branch, index = self.tree.branch_of(p)
                by_parent.setdefault(branch, []).append((index, k))
        for branch, members in by_parent.items():
            indices, own = zip(*members, strict=True)
            for c, lane in enumerate(lanes):
                wide = self.wide(lane, len(self.tree.branches[i].bodies))
                sums[branch][c].append((indices, take(wide, own)))

    def wide(self, lane: Lane, count: int) -> Lane:
        """Broadcasts a lane to (count, …); the number 0 is left."""
        if isinstance(lane, int | float) and lane == 0:
            return lane
        return jnp.broadcast_to(jnp.asarray(lane), (count, *self.shape))

    def gradient(self, forces: ByBranch, joints: ByBranch) -> ByBranch:
        """Returns Nᵀ f + g for forces f on bodies and g along joints, by branch."""
        sums = [[[] for _ in x] for x in forces]
        result: list[Lanes | None] = [None] * len(forces)
        for i in reversed(range(len(forces))):
            n = len(self.tree.branches[i].bodies)
            own = [plus(x, collect(s, n)) for x, s in zip(forces[i], sums[i], strict=True)]
            result[i] = [
                plus(axis.dot(Vector(*own)), g)
                for axis, g in zip(self.axes[i], joints[i], strict=True)
            ]
            self.to_parents(i, own, sums)
        return result  # type: ignore[return-value]

    def velocities(self, joints: ByBranch) -> ByBranch:
        """Returns the velocities N q̇ of the bodies for joint velocities q̇, by branch."""
        moved: ByBranch = []
        for i, branch in enumerate(self.tree.branches):
            y = _combined(self.axes[i], joints[i]) or [0.0] * self.size
            if set(branch.parents) != {WORLD}:
                above = self.gather(moved, branch.parents)
                y = [plus(a, b) for a, b in zip(y, above, strict=True)]
            moved.append(y)
        return moved


def widened(x: Lane, count: int, rank: int) -> Lane:
    """Returns a lane (count, …) with one entry for each element; Python numbers stay numbers.

    Args:
        x: a lane.
        count: the number of elements.
        rank: the number of axes of the batch.
    """
    if isinstance(x, int | float):
        return x
    shape = jnp.shape(x)[1:] if jnp.ndim(x) else (1,) * rank
    return jnp.broadcast_to(jnp.reshape(x, (-1, *shape)), (count, *shape))


def picked(
    lanes: Sequence[Lane], picks: Sequence[tuple[int, int]], counts: Sequence[int], like: Array
) -> Lane:
    """Returns chosen entries of several lanes side by side.

    Args:
        lanes: the lanes.
        picks: for each entry of the result, the lane and the index in it.
        counts: the number of elements of each lane.
        like: a lane with the batch axes and the dtype of the result.
    """
    if len(set(picks)) == 1:  # broadcast
        picks = picks[:1]
    wide = [widened(x, n, like.ndim - 1) for x, n in zip(lanes, counts, strict=True)]
    chosen = [wide[i] for i, _ in picks]
    numbers = {float(x) for x in chosen if isinstance(x, int | float)}
    if numbers and (len(numbers) > 1 or any(isinstance(x, jax.Array) for x in chosen)):
        some = next((x for x in wide if isinstance(x, jax.Array)), like[:1])
        wide = [
            jnp.full((n, *some.shape[1:]), x, some.dtype) if isinstance(x, int | float) else x
            for x, n in zip(wide, counts, strict=True)
        ]
    elif numbers:
        return numbers.pop()
    return side_by_side([(wide[i], k) for i, k in picks])


def _combined(axes: Sequence[Vector], change: Sequence[Lane]) -> Lanes:
    """Returns Σ_c S_c q̇_c."""
    return (
        [
            total(times(axis[i], x) for axis, x in zip(axes, change, strict=True))
            for i in range(len(axes[0]))
        ]
        if axes
        else []
    )


def symmetric(block: Block, x: Sequence[Lane]) -> Lanes:
    """Returns A x for a symmetric A, given by its lower triangle."""
    n = len(block)
    return [total(times(block[max(i, j)][min(i, j)], x[j]) for j in range(n)) for i in range(n)]


class Articulated:
    """The factors of H = Nᵀ K N + D on the motions y = N q̇ of a tree.

    K is block diagonal over bodies and D over joints. Elimination from the leaves to the roots adds
    to each parent K_c − U (Sᵀ U + D)⁻¹ Uᵀ, with U = K_c S, of each child c.

    Attributes:
        steps: for each branch, U, the factor of Sᵀ U + D, and U (Sᵀ U + D)⁻¹.
    """

    def __init__(self, motions: Motions, bodies: list[Block], joints: list[Block]) -> None:
        """Factors H.

        Args:
            motions: the motions of the tree.
            bodies: for each branch, the lower triangle of the blocks of K.
            joints: for each branch, the lower triangle of the blocks of D, (k, k).
        """
        self.motions = motions
        tree = motions.tree
        flat = [[x for row in block for x in row] for block in bodies]
        sums = [[[] for _ in x] for x in flat]
        self.steps: list[tuple[list[Lanes], Block, list[Lanes]]] = [None] * len(flat)  # type: ignore[list-item]
        for i in reversed(range(len(flat))):
            n = len(tree.branches[i].bodies)
            own = [plus(x, collect(s, n)) for x, s in zip(flat[i], sums[i], strict=True)]
            lanes = iter(own)
            block = [list(itertools.islice(lanes, r + 1)) for r in range(len(bodies[i]))]
            axes = motions.axes[i]
            pulled = [symmetric(block, [*axis]) for axis in axes]
            pivot = [
                [plus(Vector(*axis).dot(Vector(*pulled[c])), joints[i][r][c]) for c in range(r + 1)]
                for r, axis in enumerate(axes)
            ]
            factor = blocks.ldl(pivot)
            gains = _solved_columns(factor, pulled)
            self.steps[i] = (pulled, factor, gains)
            if set(tree.branches[i].parents) != {WORLD}:
                left = [
                    minus(
                        block[r][s],
                        total(times(u[r], g[s]) for u, g in zip(pulled, gains, strict=True)),
                    )
                    for r in range(len(block))
                    for s in range(r + 1)
                ]
                motions.to_parents(i, left, sums)

    def solve(self, forces: ByBranch, joints: ByBranch) -> tuple[ByBranch, ByBranch]:
        """Returns q̇ = H⁻¹ (Nᵀ f + g), and the velocities y of the bodies.

        Args:
            forces: forces f on the bodies, by branch.
            joints: forces g along the joints, by branch.
        """
        motions, tree = self.motions, self.motions.tree
        sums = [[[] for _ in x] for x in forces]
        right: list[Lanes] = [None] * len(forces)  # type: ignore[list-item]
        for i in reversed(range(len(forces))):
            n = len(tree.branches[i].bodies)
            own = [plus(x, collect(s, n)) for x, s in zip(forces[i], sums[i], strict=True)]
            pulled, factor, gains = self.steps[i]
            along = [
                plus(axis.dot(Vector(*own)), g)
                for axis, g in zip(motions.axes[i], joints[i], strict=True)
            ]
            right[i] = blocks.backward(factor, blocks.scale(factor, blocks.forward(factor, along)))
            if set(tree.branches[i].parents) != {WORLD}:
                left = [
                    minus(x, total(times(u[c], y) for u, y in zip(pulled, right[i], strict=True)))
                    for c, x in enumerate(own)
                ]
                motions.to_parents(i, left, sums)
        change: ByBranch = []
        moved: ByBranch = []
        for i, branch in enumerate(tree.branches):
            own, above = right[i], None
            if set(branch.parents) != {WORLD}:
                above = motions.gather(moved, branch.parents)
                gains = self.steps[i][2]
                own = [
                    minus(x, total(map(times, gain, above)))
                    for x, gain in zip(own, gains, strict=True)
                ]
            change.append(own)
            y = _combined(motions.axes[i], own) or [0.0] * motions.size
            moved.append(
                y if above is None else [plus(a, b) for a, b in zip(y, above, strict=True)]
            )
        return change, moved

    def mobility(self) -> tuple[list[Block], list[Block]]:
        """Returns the inverse inertias that a force meets, by branch.

        Returns:
            For the bodies, the lower triangles of N H⁻¹ Nᵀ; for the joints, those of H⁻¹.
        """
        motions, tree = self.motions, self.motions.tree
        ofbodies: list[Block] = []
        ofjoints: list[Block] = []
        for i, branch in enumerate(tree.branches):
            pulled, factor, gains = self.steps[i]
            axes = motions.axes[i]
            k, size = len(axes), motions.size
            unit: list[Lanes] = [[1.0 if r == c else 0.0 for r in range(k)] for c in range(k)]
            inverse = [
                blocks.backward(factor, blocks.scale(factor, blocks.forward(factor, u)))
                for u in unit
            ]
            joint = [[inverse[r][c] for c in range(r + 1)] for r in range(k)]
            if set(branch.parents) == {WORLD}:
                body = _spanned(axes, joint, size)
            else:
                flat = [[x for row in b for x in row] for b in ofbodies]
                lanes = iter(motions.gather(flat, branch.parents))
                above = [list(itertools.islice(lanes, r + 1)) for r in range(size)]
                met = [symmetric(above, gain) for gain in gains]  # T = Ω_p X
                joint = [
                    [plus(joint[r][c], total(map(times, gains[r], met[c]))) for c in range(r + 1)]
                    for r in range(k)
                ]
                body = _spanned(axes, joint, size)
                for r in range(size):
                    for s in range(r + 1):
                        cross = total(
                            plus(times(a[r], t[s]), times(t[r], a[s]))
                            for a, t in zip(axes, met, strict=True)
                        )
                        body[r][s] = plus(body[r][s], minus(above[r][s], cross))
            n = len(branch.bodies)
            ofbodies.append([[motions.wide(x, n) for x in row] for row in body])
            ofjoints.append(joint)
        return ofbodies, ofjoints


def _solved_columns(factor: Block, columns: list[Lanes]) -> list[Lanes]:
    """Returns the columns of U A⁻¹, for the columns of U and the factor of a symmetric A."""
    size = len(columns[0]) if columns else 0
    rows = []
    for r in range(size):
        y = [column[r] for column in columns]
        rows.append(blocks.backward(factor, blocks.scale(factor, blocks.forward(factor, y))))
    return [[row[c] for row in rows] for c in range(len(columns))]


def _spanned(axes: Sequence[Vector], middle: Block, size: int) -> Block:
    """Returns the lower triangle of S A Sᵀ, for a symmetric A given by its lower triangle."""
    right = [
        [
            total(times(middle[max(c, d)][min(c, d)], axes[d][i]) for d in range(len(axes)))
            for c in range(len(axes))
        ]
        for i in range(size)
    ]
    return [
        [total(times(axes[c][r], right[s][c]) for c in range(len(axes))) for s in range(r + 1)]
        for r in range(size)
    ]
