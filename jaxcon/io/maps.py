"""Conversion between MuJoCo's coordinates qpos and qvel and the state of a system."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.io.joints import Coordinate
from jaxcon.io.links import LinkJoint
from jaxcon.system import coordinates
from jaxcon.system.bodies import rest
from jaxcon.system.body_system import BodySystem
from jaxcon.system.coordinates import End
from jaxcon.system.layout import Layout
from jaxcon.system.state import State, checked_system


class Node(NamedTuple):
    """A link in the kinematic tree.

    Attributes:
        name: the name of the link in the scene.
        parent: the index of the parent link; −1 for the world.
        joints: the joints between the link and its parent, in order.
    """

    name: str
    parent: int
    joints: tuple[LinkJoint, ...]


class Scalar(NamedTuple):
    """A joint with one coordinate: a hinge or a slide.

    Attributes:
        q: the index of its coordinate in qpos.
        v: the index of its rate in qvel.
        at: its coordinate in the scene.
    """

    q: int
    v: int
    at: Coordinate


class Numbers(NamedTuple):
    """The indices of n joints.

    Attributes:
        id: MuJoCo's joint ids, (n,).
        q: the first index of each joint in qpos, (n, 1).
        v: the first index of each joint in qvel, (n, 1).
    """

    id: np.ndarray
    q: np.ndarray
    v: np.ndarray


@pytree
class Tree:
    """The kinematic tree of a model, in MuJoCo's coordinates.

    Attributes:
        positions: the position of each link in its parent with joints at zero, (links, 3) [m].
        turns: the orientation of each link in its parent with joints at zero, quaternions
            (links, 4).
        points: a point on each joint axis, in the frame of the link, (joints, 3) [m].
        axes: the axis of each joint, in the frame of the link, (joints, 3).
        reference: qpos at assembly, (nq,).
        nodes: the links, parents before children.
        scalars: all hinges and slides.
        size: the number of entries of qvel, nv.
    """

    positions: Array
    turns: Array
    points: Array
    axes: Array
    reference: Array
    nodes: tuple[Node, ...] = static()
    scalars: tuple[Scalar, ...] = static()
    size: int = static()

    def poses(self, qpos: Array) -> Pose:
        """Returns the poses of all links at qpos (forward kinematics), (links, …)."""
        order, bases, ends = _moves(self.nodes)
        steps, turns = (jnp.concatenate(x)[order] for x in zip(*self._moved(qpos), strict=True))
        upright = jnp.zeros((len(order) + 1, 4), qpos.dtype).at[:, 0].set(1)

        def move(
            frames: tuple[Array, Array], inputs: tuple[Array, ...]
        ) -> tuple[tuple[Array, Array], None]:
            """Sets frame i to frame `base`, translated and rotated; a step of the scan.

            The translation and the rotation are given in frame `base`.
            """
            i, base, step, turn = inputs
            positions, orientations = frames
            above = Pose(positions[base], orientations[base])
            position, turned = above.point(step), quaternion.multiply(above.orientation, turn)
            return (positions.at[i].set(position), orientations.at[i].set(turned)), None

        # a scan, so that the size of the program does not grow with the model
        world = jnp.zeros((len(order) + 1, 3), qpos.dtype), upright
        moves = jnp.arange(1, len(order) + 1), jnp.asarray(bases), steps, turns
        (positions, orientations), _ = jax.lax.scan(move, world, moves)
        return Pose(positions[ends], orientations[ends])

    def _moved(self, qpos: Array) -> list[tuple[Array, Array]]:
        """Returns the relative transformations of all links and joints at qpos.

        Each list entry has translations (n, 3) [m] and rotations (n, 4), relative to the preceding
        frame. The first entry is for the constant link offsets. One entry for each joint kind in
        `KINDS` follows.
        """
        slide, hinge, ball, free = (self._joints(kind) for kind in KINDS)
        travel = self.axes[slide.id] * (qpos - self.reference)[slide.q]
        upright = jnp.zeros((len(travel), 4), qpos.dtype).at[:, 0].set(1)
        angle = self.axes[hinge.id] * (qpos - self.reference)[hinge.q]
        turned = quaternion.normalize(qpos[ball.q + np.arange(4)].T)
        flown = quaternion.normalize(qpos[free.q + np.arange(3, 7)].T)
        return [
            (self.positions, self.turns),
            (travel, upright),
            self._about(hinge.id, quaternion.exp(angle.T)),
            self._about(ball.id, turned),
            (qpos[free.q + np.arange(3)], flown.T),
        ]

    def _about(self, joints: np.ndarray, turn: Array) -> tuple[Array, Array]:
        """Converts rotations about the joint points to rotations about the frame origins.

        Args:
            joints: MuJoCo's joint ids, (n,).
            turn: the rotations about the joint points, (4, n).

        Returns:
            The equivalent translations (n, 3) [m] and rotations (n, 4).
        """
        point = self.points[joints]
        return point - quaternion.rotate(turn, point.T).T, turn.T

    def _joints(self, kind: str) -> Numbers:
        """Returns the indices of all joints of a kind such as "hinge"."""
        joints = _of_kind(self.nodes, kind)
        rows = np.array([(j.id, j.q, j.v) for j in joints], int).reshape(-1, 3)
        return Numbers(rows[:, 0], rows[:, 1:2], rows[:, 2:3])

    def check(self, qpos: Array) -> None:
        """Checks that links with three hinges are not beyond gimbal lock, if qpos is concrete.

        At gimbal lock, the triple product n₁·(n₂ × n₃) of the three axes changes its sign.

        Raises:
            ValueError: the angle of a middle hinge lies beyond gimbal lock, as seen from the
                reference pose.
        """
        if not checks.is_concrete((qpos, self.axes)):
            return
        for node in self.nodes:
            hinges = [joint for joint in node.joints if joint.kind == "hinge"]
            if len(hinges) == 3:
                first, middle, last = (self.axes[joint.id] for joint in hinges)
                q = hinges[1].q
                turn = quaternion.exp(middle * (qpos[q] - self.reference[q]))
                across = jnp.cross(first, middle)
                if across @ last * (across @ quaternion.rotate(turn, last)) <= 0:
                    raise ValueError(
                        f"state: qpos[{q}] = {float(qpos[q]):.6g} turns the middle one of the three"
                        f" hinges of '{node.name}' beyond gimbal lock, where other angles, within"
                        " it, stand for the same pose."
                    )

    def rates(self, qpos: Array, qvel: Array) -> Array:
        """Returns the time derivative of qpos, (nq,).

        It equals qvel, except for the quaternions q of ball and free joints: q̇ = ½ q ⊗ (0, ω).
        """
        slopes = jnp.zeros_like(qpos)
        for kind in ("slide", "hinge"):
            joints = self._joints(kind)
            slopes = slopes.at[joints.q].set(qvel[joints.v])
        for joint in (*_of_kind(self.nodes, "free"), *_of_kind(self.nodes, "ball")):
            q, v = joint.q, joint.v
            if joint.kind == "free":
                slopes = slopes.at[q : q + 3].set(qvel[v : v + 3])
                q, v = q + 3, v + 3
            turning = quaternion.derivative(qpos[q : q + 4], qvel[v : v + 3])
            slopes = slopes.at[q : q + 4].set(turning)
        return slopes

    def motions(self, qpos: Array, qvel: Array) -> Motion:
        """Returns the motions of all links, (links, …).

        The angular velocity ω comes from the quaternion rate: (0, ω) = 2 q* ⊗ q̇.
        """
        pose, slope = jax.jvp(self.poses, (qpos,), (self.rates(qpos, qvel),))
        spin = quaternion.multiply(quaternion.conjugate(pose.orientation.T), slope.orientation.T)
        return Motion(pose.position, pose.orientation, slope.position, 2 * spin[1:].T)

    def flat(self, system: BodySystem, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """Converts MuJoCo's qpos and qvel to the positions q and velocities v of the system."""
        return _flat(self, system.layout, system.offsets, qpos, qvel)

    def turns_of(self, system: BodySystem, qpos: Array) -> Array | tuple[()]:
        """Returns the angles at qpos of the joints whose whole turns a `State` counts, (n,) [rad].

        Angles are measured from the reference pose. The result is the empty tuple if the turns of
        no joint are counted.
        """
        if not system.counted:
            return ()
        indices = {scalar.at: scalar.q for scalar in self.scalars}
        order = [
            indices[Coordinate(system.constraints[c.group].names[j], c.name)]
            for c in system.counted
            for j in c.joints
        ]
        return jnp.stack([qpos[i] - self.reference[i] for i in order])

    def read(self, system: BodySystem, state: State) -> tuple[Array, Array]:
        """Converts a state to MuJoCo's qpos (nq,) and qvel (nv,)."""
        system = checked_system(system, state)
        qpos, qvel = self.reference, jnp.zeros(self.size, state.q.dtype)
        motions = [system.motion(node.name, state.q, state.v) for node in self.nodes]
        for i, node in enumerate(self.nodes):
            for joint in (j for j in node.joints if j.kind in ("free", "ball")):
                above = rest(Pose(jnp.zeros(3, qvel.dtype), jnp.eye(4, dtype=qvel.dtype)[0]))
                above = above if node.parent < 0 else motions[node.parent]
                x, y = self._relative(i, joint, above, motions[i])
                qpos = qpos.at[joint.q : joint.q + len(x)].set(x)
                qvel = qvel.at[joint.v : joint.v + len(y)].set(y)
        snapshot = system.snapshot(state.q, state.v, state.instant)
        for scalars, ends in self._groups(system):
            row = coordinates.at(coordinates.numbered(system.counted), ends).read(snapshot)
            indices = jnp.asarray([s.q for s in scalars])
            qpos = qpos.at[indices].set(self.reference[indices] + row.value)
            qvel = qvel.at[jnp.asarray([s.v for s in scalars])].set(row.rate)
        return qpos, qvel

    def _relative(
        self, i: int, joint: LinkJoint, above: Motion, below: Motion
    ) -> tuple[Array, Array]:
        """Returns the entries of qpos and qvel of a ball or free joint between two moving frames.

        Args:
            i: the index of the link.
            joint: the joint between the link and its parent.
            above: the motion of the parent.
            below: the motion of the link.
        """
        if joint.kind == "free":
            x = jnp.concatenate([below.position, below.orientation])
            return x, jnp.concatenate([below.velocity, below.angular_velocity])
        before = quaternion.multiply(above.orientation, self.turns[i])
        turn = quaternion.multiply(quaternion.conjugate(before), below.orientation)
        spin = below.local_direction(above.direction(above.angular_velocity))
        return turn, below.angular_velocity - spin

    def _groups(self, system: BodySystem) -> Iterable[tuple[list[Scalar], list[End]]]:
        """Yields hinges and slides in groups whose coordinates can be read as one array.

        The members of a group belong to the same group of joints and have the same coordinate
        name. Whole turns are counted for all members, or for none.
        """
        groups: dict[tuple[int, str, bool], list[tuple[Scalar, End]]] = {}
        where = coordinates.directory(system.constraints)
        counters = coordinates.numbered(system.counted)
        for scalar in self.scalars:
            end = coordinates.find(system.constraints, where, "qpos", *scalar.at)
            counts = bool(coordinates.at(counters, [end]).counters)
            groups.setdefault((end[0], end[2], counts), []).append((scalar, end))
        for members in groups.values():
            scalars, ends = zip(*members, strict=True)
            yield list(scalars), list(ends)


KINDS = ("slide", "hinge", "ball", "free")
"""The kinds of joints, in the order in which `Tree._moved` lists them."""


def _of_kind(nodes: tuple[Node, ...], kind: str) -> list[LinkJoint]:
    """Returns all joints of a kind such as "hinge", in the order of the links."""
    return [joint for node in nodes for joint in node.joints if joint.kind == kind]


def _moves(nodes: tuple[Node, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plans the order in which `Tree.poses` composes relative transformations (moves).

    For each link, its constant offset comes first, then its joints. Frame 0 is the world, and frame
    i + 1 is the result of move i.

    Returns:
        order: the index of each move in the concatenated arrays of `Tree._moved`, (moves,).
        bases: the number of the frame from which each move starts, (moves,).
        ends: the number of the final frame of each link, (links,).
    """
    joints = [joint for kind in KINDS for joint in _of_kind(nodes, kind)]
    numbers = {joint.id: len(nodes) + i for i, joint in enumerate(joints)}
    order: list[int] = []
    bases: list[int] = []
    ends: list[int] = []
    for i, node in enumerate(nodes):
        order.append(i)
        bases.append(0 if node.parent < 0 else ends[node.parent])
        for joint in node.joints:
            bases.append(0 if joint.kind == "free" else len(order))
            order.append(numbers[joint.id])
        ends.append(len(order))
    return np.array(order), np.array(bases), np.array(ends)


@functools.partial(jax.jit, static_argnums=1)
def _flat(
    tree: Tree, layout: Layout, offsets: dict[str, Pose], qpos: Array, qvel: Array
) -> tuple[Array, Array]:
    """Converts qpos and qvel to q and v of the system, whose bodies must all be of one kind.

    Args:
        tree: the kinematic tree of the model.
        layout: the layout of the system.
        offsets: the frame of each link in the principal frame of its body, by name. For links
            without an entry, both frames are equal.
        qpos: MuJoCo's positions, (nq,).
        qvel: MuJoCo's velocities, (nv,).
    """
    names = [node.name for node in tree.nodes]
    kind = layout.groups[layout.locate(names[0])[0]].kind
    zero, upright = jnp.zeros(3, qpos.dtype), jnp.eye(4, dtype=qpos.dtype)[0]
    poses = [offsets.get(name, Pose(zero, upright)) for name in names]
    frames = jax.vmap(lambda pose: pose.inverse)(jax.tree.map(lambda *x: jnp.stack(x), *poses))
    relative = jax.vmap(lambda motion, frame: motion.seen_from(frame))
    x, y = jax.vmap(kind.coordinates)(relative(tree.motions(qpos, qvel), frames))
    q, v = jnp.zeros(layout.n_q, qpos.dtype), jnp.zeros(layout.n_v, qpos.dtype)
    at_q, at_v = (np.stack([where(n) for n in names]) for where in (layout.q, layout.v))
    return q.at[at_q].set(x), v.at[at_v].set(y)
