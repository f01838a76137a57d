"""MuJoCo's generalized coordinates: the poses of links from them, and back."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

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

    def poses(self, qpos: Array) -> list[Pose]:
        """Of the frame of every link: its parent's, its offset, and its joints one by one."""
        poses: list[Pose] = []
        for i, node in enumerate(self.nodes):
            pose = Pose(self.positions[i], self.turns[i])
            if node.parent >= 0:
                above = poses[node.parent]
                turn = quaternion.multiply(above.orientation, pose.orientation)
                pose = Pose(above.point(pose.position), turn)
            for joint in node.joints:
                pose = self._moved(pose, joint, qpos)
            poses.append(pose)
        return poses

    def _moved(self, pose: Pose, joint: LinkJoint, qpos: Array) -> Pose:
        """The frame of a link after one of its joints; hinges and balls turn it about a point."""
        if joint.kind == "free":
            turn = quaternion.normalize(qpos[joint.q + 3 : joint.q + 7])
            return Pose(qpos[joint.q : joint.q + 3], turn)
        point, axis = self.points[joint.id], self.axes[joint.id]
        if joint.kind == "slide":
            travel = qpos[joint.q] - self.reference[joint.q]
            return Pose(pose.position + pose.direction(axis) * travel, pose.orientation)
        if joint.kind == "ball":
            own = quaternion.normalize(qpos[joint.q : joint.q + 4])
        else:
            own = quaternion.exp(axis * (qpos[joint.q] - self.reference[joint.q]))
        turned = Pose(pose.position, quaternion.multiply(pose.orientation, own))
        anchor = pose.point(point)
        return Pose(anchor - turned.direction(point), turned.orientation)

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
        for joint in (joint for node in self.nodes for joint in node.joints):
            q, v = joint.q, joint.v
            if joint.kind == "free":
                slopes = slopes.at[q : q + 3].set(qvel[v : v + 3])
                q, v = q + 3, v + 3
            if joint.kind in ("free", "ball"):
                turning = quaternion.derivative(qpos[q : q + 4], qvel[v : v + 3])
                slopes = slopes.at[q : q + 4].set(turning)
            else:
                slopes = slopes.at[q].set(qvel[v])
        return slopes

    def motions(self, qpos: Array, qvel: Array) -> list[Motion]:
        """Of the frame of every link; ω = 2 q* ⊗ q̇."""
        poses, slopes = jax.jvp(self.poses, (qpos,), (self.rates(qpos, qvel),))
        return [_motion(*pair) for pair in zip(poses, slopes, strict=True)]

    def flat(self, system: Any, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """q and v of the system."""
        q = jnp.zeros(system.layout.n_q, qpos.dtype)
        v = jnp.zeros(system.layout.n_v, qpos.dtype)
        for node, motion in zip(self.nodes, self.motions(qpos, qvel), strict=True):
            group, _ = system.layout.locate(node.name)
            own = motion.seen_from(_inverse(system.offsets.get(node.name)))
            x, y = system.layout.groups[group].kind.coordinates(own)
            q = q.at[system.layout.q(node.name)].set(x)
            v = v.at[system.layout.v(node.name)].set(y)
        return q, v

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
        snapshot = system.snapshot(state.q, state.v, state.time)
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


def _motion(pose: Pose, slope: Pose) -> Motion:
    """From a pose and its derivative in time."""
    spin = quaternion.multiply(quaternion.conjugate(pose.orientation), slope.orientation)
    return Motion(pose.position, pose.orientation, slope.position, 2 * spin[1:])


def _inverse(offset: Pose | None) -> Pose | None:
    """The principal frame in the user's frame, from the user's in the principal frame."""
    if offset is None:
        return None
    back = quaternion.conjugate(offset.orientation)
    return Pose(-offset.local_direction(offset.position), back)
