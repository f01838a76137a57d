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

import functools
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
from jaxcon.linear.jacobian import Block as JacobianBlock
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

    def push(self, y: Vector) -> Vector:
        """Returns velocities of centers and body axes for velocities in common coordinates.

        This is the transpose of `pull`.
        """
        if self.rotation is None:
            turning, linear = y[0], Vector(*y[1:])
            x, z = self.arm
            return Vector(
                minus(linear[0], times(turning, z)), plus(linear[1], times(turning, x)), turning
            )
        turning, linear = Vector(*y[:3]), Vector(*y[3:])
        return Vector(*(linear + turning.cross(self.arm)), *(self.rotation.T @ turning))

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


class Reflections:
    """Householder's factorization Wᵀ = Q R of independent rows W; Q is a product of reflections.

    The first columns of Q span the rows. The others, `complement`, are normal to all of them.

    Attributes:
        given: the rows.
        complement: an orthonormal basis of the vectors normal to all rows.
        dependent: mask of the worlds in which a row depends on the rows before it, (…), up to
            rounding; None if there are no rows.

    References:
        Golub, Van Loan, Matrix Computations (2013), section 5.2.
    """

    def __init__(self, rows: Sequence[Vector], size: int) -> None:
        """Factors the rows.

        Args:
            rows: vectors with `size` components each, at most `size` of them.
            size: the number of components.
        """
        self.given = rows
        self._columns = [list(row) for row in rows]  # above the diagonal: R
        self._mirrors: list[tuple[Lanes, Lane]] = []
        self._inverses: list[Array] = []  # 1/R_jj
        self.dependent: Array | None = None
        arrays = (x for row in rows for x in row if isinstance(x, jax.Array))
        dtype = next((x.dtype for x in arrays), None)
        squares = [row.dot(row) for row in rows]
        # 1 + d² for arms d of the rows from the reference point, in units of length
        linear = [Vector(*row[size // 2 :]) for row in rows]
        reach = [numerics.safe_divide(x, y.dot(y)) for x, y in zip(squares, linear, strict=True)]
        longest = functools.reduce(jnp.maximum, reach, 1.0)
        for j, column in enumerate(self._columns):
            x = column[j:]
            # rows of Python numbers alone have no dtype of their own
            length = jnp.asarray(numerics.norm(Vector(*x)), dtype)
            # what arms add to other rows makes this length shorter, up to 1/d of a row; this
            # must not count as dependence
            share = size * float(jnp.finfo(length.dtype).eps)
            least = jnp.maximum(share / longest, share * share)
            dependent = length * length <= least * squares[j]
            self.dependent = dependent if self.dependent is None else self.dependent | dependent
            sign = jnp.where(jnp.asarray(x[0]) < 0, -1.0, 1.0).astype(length.dtype)
            normal = [plus(x[0], sign * length), *x[1:]]
            # the normal is zero only if a row is: then its world fails, and others must not
            share = numerics.safe_divide(2.0, total(times(y, y) for y in normal))
            self._mirrors.append((normal, share))
            self._inverses.append(numerics.safe_divide(-sign, length))
            for other in self._columns[j + 1 :]:
                other[j:] = _mirrored(normal, share, other[j:])
        units = range(len(rows), size)
        self.complement = [
            Vector(*self._reflected([1.0 if i == c else 0.0 for i in range(size)])) for c in units
        ]
        self._rest = size - len(rows)

    def least(self, right: Sequence[Lane]) -> Vector:
        """Returns the shortest x with W x = b, for b, (row,)."""
        z: Lanes = []
        for j, (b, inverse) in enumerate(zip(right, self._inverses, strict=True)):
            known = total(times(self._columns[j][i], z[i]) for i in range(j))
            z.append(times(minus(b, known), inverse))
        return Vector(*self._reflected([*z, *(0.0,) * self._rest]))

    def coefficients(self, x: Vector) -> Lanes:
        """Returns the coefficients λ of the rows in x, with Wᵀ λ ≈ x."""
        y = [*x]
        for j, (normal, share) in enumerate(self._mirrors):
            y[j:] = _mirrored(normal, share, y[j:])
        count = len(self._mirrors)
        λ: Lanes = [0.0] * count
        for j in reversed(range(count)):
            known = total(times(self._columns[k][j], λ[k]) for k in range(j + 1, count))
            λ[j] = times(minus(y[j], known), self._inverses[j])
        return λ

    def _reflected(self, x: Lanes) -> Lanes:
        """Returns Q x."""
        for j, (normal, share) in reversed(list(enumerate(self._mirrors))):
            x[j:] = _mirrored(normal, share, x[j:])
        return x


def _mirrored(normal: Lanes, share: Lane, x: Lanes) -> Lanes:
    """Returns x − share (normal·x) normal."""
    along = times(share, total(map(times, normal, x)))
    return [minus(y, times(along, n)) for y, n in zip(x, normal, strict=True)]


@dataclass(frozen=True)
class JointGroup:
    """Joints of one class, whose rows hold the velocity of a child relative to its parent.

    Attributes:
        start: their first row in J.
        children: the place of the child of each joint.
        rows: the rows in common coordinates, as functions of the child's velocity.
    """

    start: int
    children: tuple[int, ...]
    rows: Reflections

    @classmethod
    def all_of(cls, tree: Tree, frames: Frames, joints: Jacobian) -> list[JointGroup]:
        """Returns the joints of a tree, from the Jacobian of the equality rows."""
        members: dict[int, dict[int, int]] = {}
        for branch in tree.branches:
            if branch.row is not None:
                own = zip(branch.elements, branch.bodies, strict=True)
                members.setdefault(branch.row, {}).update(own)
        groups = []
        for start, own in joints.by_rows():
            if start not in members:  # a rotor
                continue
            children = tuple(tree.places[members[start][e]] for e in range(len(members[start])))
            rows = rows_at(tree, frames, own, children)
            groups.append(cls(start, children, Reflections(rows, len(rows[0]))))
        return groups


def rows_at(
    tree: Tree, frames: Frames, own: Sequence[JacobianBlock], places: tuple[int, ...]
) -> list[Vector]:
    """Returns rows of J as functions of the velocity of one of their bodies, in common coordinates.

    Args:
        tree: the tree of the bodies.
        frames: the bodies.
        own: the blocks of the rows, one for each of their bodies.
        places: the place of the body, for each element; it may be on different sides.
    """
    picks = [
        (next(i for i, b in enumerate(own) if tree.places[b.columns.indices[e]] == place), e)
        for e, place in enumerate(places)
    ]
    counts, here = [b.shape[1] for b in own], frames.at(places)
    like = here.arm[0]

    def pulled(r: int, size: int) -> Vector:
        lanes = [[b.value[r][c] for b in own] for c in range(size)]
        row = here.pull(Vector(*(picked(x, picks, counts, like) for x in lanes)))
        if any(isinstance(x, jax.Array) for x in row):
            return row
        return row.map(lambda x: x if x == 0 else jnp.full_like(like, x))  # with a dtype

    return [pulled(r, len(row)) for r, row in enumerate(own[0].value)]


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
    def of(
        cls, tree: Tree, frames: Frames, joints: Sequence[JointGroup], shape: tuple[int, ...]
    ) -> Motions:
        """Returns the motions that joints allow; bodies without a joint move freely."""
        groups = {group.start: group for group in joints}
        axes, size = [], 3 if frames.rotation is None else 6
        for branch in tree.branches:
            if branch.row is None:
                unit = [[1.0 if i == c else 0.0 for i in range(size)] for c in range(size)]
                axes.append([Vector(*x) for x in unit])
                continue
            own = groups[branch.row].rows.complement
            axes.append([x.map(lambda y, b=branch: take(y, b.elements)) for x in own])
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
        return [
            [plus(axis.dot(Vector(*f)), g) for axis, g in zip(axes, own, strict=True)]
            for axes, f, own in zip(self.axes, self.sums_to_roots(forces), joints, strict=True)
        ]

    def sums_to_roots(self, forces: ByBranch) -> ByBranch:
        """Returns the forces on each body and all bodies that it carries, by branch."""
        sums = [[[] for _ in x] for x in forces]
        result: list[Lanes] = [[] for _ in forces]
        for i in reversed(range(len(forces))):
            n = len(self.tree.branches[i].bodies)
            result[i] = [plus(x, collect(s, n)) for x, s in zip(forces[i], sums[i], strict=True)]
            self.to_parents(i, result[i], sums)
        return result

    def velocities(self, joints: ByBranch) -> ByBranch:
        """Returns the velocities N q̇ of the bodies for joint velocities q̇, by branch."""
        return self.sums_from_roots(
            [
                _combined(axes, own) or [0.0] * self.size
                for axes, own in zip(self.axes, joints, strict=True)
            ]
        )

    def sums_from_roots(self, relative: ByBranch) -> ByBranch:
        """Returns the velocities of the bodies, from those relative to their parents, by branch."""
        moved: ByBranch = []
        for branch, y in zip(self.tree.branches, relative, strict=True):
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
