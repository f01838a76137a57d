"""MuJoCo's generalized coordinates: the poses of links from them, and back."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

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
from jaxcon.model import coordinates
from jaxcon.model.bodies import rest
from jaxcon.model.coordinates import End
from jaxcon.model.state import at


class Node(NamedTuple):
    """A link in the tree: its name, the index of its parent, and its joints."""

    name: str
    parent: int
    joints: tuple[LinkJoint, ...]


class Scalar(NamedTuple):
    """A hinge or slide: where it lies in qpos and qvel, and in the scene."""

    q: int
    v: int
    at: Coordinate


class Numbers(NamedTuple):
    """Numbers of joints: ids (n,), and where their coordinates begin in qpos and qvel, (n, 1)."""

    id: np.ndarray
    q: np.ndarray
    v: np.ndarray


@pytree
class Tree:
    """The links of a model and how MuJoCo's coordinates move them.

    Attributes:
        positions, turns: of each link before its joints, in its parent, (3,), (4,).
        points, axes: of each joint, in the frame of its link, (joints, 3).
        reference: qpos at assembly, (nq,).
        nodes: the links, parents first.
        scalars: hinges and slides.
        size: of qvel.
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
        """Returns the frames of all links, (links, …), by parent, offset and joints.

        One move after the other in a scan, so that a program does not grow with the model.
        """
        order, bases, ends = _moves(self.nodes)
        steps, turns = (jnp.concatenate(x)[order] for x in zip(*self._moved(qpos), strict=True))
        upright = jnp.zeros((len(order) + 1, 4), qpos.dtype).at[:, 0].set(1)

        def move(frames: tuple[Array, Array], now: Any) -> tuple[tuple[Array, Array], None]:
            i, base, step, turn = now
            places, orientations = frames
            above = Pose(places[base], orientations[base])
            place, turned = above.point(step), quaternion.multiply(above.orientation, turn)
            return (places.at[i].set(place), orientations.at[i].set(turned)), None

        world = jnp.zeros((len(order) + 1, 3), qpos.dtype), upright
        numbers = jnp.arange(1, len(order) + 1)
        (places, orientations), _ = jax.lax.scan(move, world, (numbers, bases, steps, turns))
        return Pose(places[ends], orientations[ends])

    def _moved(self, qpos: Array) -> list[tuple[Array, Array]]:
        """Step (n, 3) and turn (n, 4) of each move in the frame before it: links, then `KINDS`."""
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
        """Turns (4, n) of joints about their points."""
        point = self.points[joints]
        return point - quaternion.rotate(turn, point.T).T, turn.T

    def _joints(self, kind: str) -> Numbers:
        """The joints of a kind."""
        own = _of_kind(self.nodes, kind)
        ids, q, v = (np.array([getattr(j, x) for j in own], int) for x in ("id", "q", "v"))
        return Numbers(ids, q[:, None], v[:, None])

    def check(self, qpos: Array) -> None:
        """Checks three hinges of one link, where qpos is concrete.

        n₁·(n₂ × n₃) changes its sign with the middle angle where the axes fall into a plane.

        Raises:
            ValueError: their middle angle lies beyond gimbal lock, as seen from the reference.
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
        """q̇pos, (nq,): qvel, with the quaternions of ball and free joints by ½ q ⊗ ω."""
        slopes = jnp.zeros_like(qpos)
        for kind in ("slide", "hinge"):
            own = self._joints(kind)
            slopes = slopes.at[own.q].set(qvel[own.v])
        for joint in (*_of_kind(self.nodes, "free"), *_of_kind(self.nodes, "ball")):
            q, v = joint.q, joint.v
            if joint.kind == "free":
                slopes = slopes.at[q : q + 3].set(qvel[v : v + 3])
                q, v = q + 3, v + 3
            turning = quaternion.derivative(qpos[q : q + 4], qvel[v : v + 3])
            slopes = slopes.at[q : q + 4].set(turning)
        return slopes

    def motions(self, qpos: Array, qvel: Array) -> Motion:
        """Returns the motions of the frames of all links, (links, …); ω = 2 q* ⊗ q̇."""
        pose, slope = jax.jvp(self.poses, (qpos,), (self.rates(qpos, qvel),))
        spin = quaternion.multiply(quaternion.conjugate(pose.orientation.T), slope.orientation.T)
        return Motion(pose.position, pose.orientation, slope.position, 2 * spin[1:].T)

    def flat(self, system: Any, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """q and v of the system, all of whose links are of one kind; compiled as one."""
        return _flat(self, system.layout, system.offsets, qpos, qvel)

    def turns_of(self, system: Any, qpos: Array) -> Any:
        """What a state at qpos remembers of the joints whose turns are counted."""
        if not system.counted:
            return ()
        places = {scalar.at: scalar.q for scalar in self.scalars}
        order = [
            places[Coordinate(system.constraints[c.group].names[j], c.name)]
            for c in system.counted
            for j in c.joints
        ]
        return jnp.stack([qpos[i] - self.reference[i] for i in order])

    def read(self, system: Any, state: Any) -> tuple[Array, Array]:
        """qpos and qvel of a state."""
        system = at(system, state)
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
            places = jnp.asarray([s.q for s in scalars])
            qpos = qpos.at[places].set(self.reference[places] + row.value)
            qvel = qvel.at[jnp.asarray([s.v for s in scalars])].set(row.rate)
        return qpos, qvel

    def _relative(
        self, i: int, joint: LinkJoint, above: Motion, own: Motion
    ) -> tuple[Array, Array]:
        """Coordinates and velocities of a ball or free joint."""
        if joint.kind == "free":
            x = jnp.concatenate([own.position, own.orientation])
            return x, jnp.concatenate([own.velocity, own.angular_velocity])
        before = quaternion.multiply(above.orientation, self.turns[i])
        turn = quaternion.multiply(quaternion.conjugate(before), own.orientation)
        spin = own.local_direction(above.direction(above.angular_velocity))
        return turn, own.angular_velocity - spin

    def _groups(self, system: Any) -> Iterable[tuple[list[Scalar], list[End]]]:
        """Hinges and slides by group and name of their coordinates, and whether turns count."""
        found: dict[Any, list[tuple[Scalar, End]]] = {}
        where = coordinates.directory(system.constraints)
        counters = coordinates.numbered(system.counted)
        for scalar in self.scalars:
            end = coordinates.find(system.constraints, where, "qpos", *scalar.at)
            counts = bool(coordinates.at(counters, [end]).counters)
            found.setdefault((end[0], end[2], counts), []).append((scalar, end))
        for members in found.values():
            scalars, ends = zip(*members, strict=True)
            yield list(scalars), list(ends)


KINDS = ("slide", "hinge", "ball", "free")
"""The kinds of joints, in the order in which `Tree._moved` has them."""


def _of_kind(nodes: tuple[Node, ...], kind: str) -> list[LinkJoint]:
    """The joints of a kind."""
    return [joint for node in nodes for joint in node.joints if joint.kind == kind]


def _moves(nodes: tuple[Node, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The moves from frame to frame: into each link, then along each of its joints.

    Returns:
        Which move of `Tree._moved` comes when, and the frame from which each begins, (moves,)
        each, where 0 is the world and i + 1 what move i leads to; and that of each link, (links,).
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
    tree: Tree, layout: Any, offsets: dict[str, Pose], qpos: Array, qvel: Array
) -> tuple[Array, Array]:
    names = [node.name for node in tree.nodes]
    kind = layout.groups[layout.locate(names[0])[0]].kind
    zero, upright = jnp.zeros(3, qpos.dtype), jnp.eye(4, dtype=qpos.dtype)[0]
    own = [offsets.get(name, Pose(zero, upright)) for name in names]
    frames = jax.vmap(lambda pose: pose.inverse)(jax.tree.map(lambda *x: jnp.stack(x), *own))
    seen = jax.vmap(lambda motion, frame: motion.seen_from(frame))
    x, y = jax.vmap(kind.coordinates)(seen(tree.motions(qpos, qvel), frames))
    q, v = jnp.zeros(layout.n_q, qpos.dtype), jnp.zeros(layout.n_v, qpos.dtype)
    at_q, at_v = (np.stack([where(n) for n in names]) for where in (layout.q, layout.v))
    return q.at[at_q].set(x), v.at[at_v].set(y)
