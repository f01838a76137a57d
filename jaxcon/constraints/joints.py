"""Joints between two bodies, each composed of the rows in `primitives`.

The user gives points, axes and lengths in the world frame at assembly; joints keep them in the
frames of their two bodies. To add a joint, write a class like these and one row in
`tests/scenes.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joint
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.typing import Array, PyTree
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import BetweenBodies, label, own_point

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame
    from jaxcon.contact.contact import Rope

PERPENDICULAR = 1e-6
"""The largest cosine of two axes that count as perpendicular; rounding in float32 gives 1e-7."""
POSITIVE_LENGTH = MappingProxyType({"length": checks.NumberRange(above=0)})
"""The `Element.ranges` of elements with a length."""


@dataclass(frozen=True)
class Coincident(Joint):
    """Two points coincide: 2 rows in the plane, 3 in space. Bodies may be particles.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the common point, world frame at assembly, (dim,) [m].
    """

    point: Any
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies."""
        return anchors(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows p_b − p_a = 0: the joint's points on both bodies coincide."""
        return primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))


@dataclass(frozen=True)
class Spherical(Coincident):
    """A ball joint in space: two points stay together, every turn is free (3 rows).

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the center of the ball, world frame at assembly, (3,) [m].
    """

    dims = (3,)


@dataclass(frozen=True)
class Distance(Joint):
    """Two points keep their distance, φ = ‖p_b − p_a‖ − l: λ is minus the tension [N].

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        length: l > 0 [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (dim,) [m]; the centers of mass unless given.
    """

    length: Any = None
    point_a: Any = None
    point_b: Any = None
    ranges = POSITIVE_LENGTH
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the points in the frames of their bodies, and the length."""
        return stretched(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the row φ = ‖p_b − p_a‖ − l, with the end points p_a, p_b and the length l."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return [primitives.distance(*points, p["length"])]


@dataclass(frozen=True)
class Fixed(Joint):
    """Two bodies keep their relative pose: 3 rows in the plane, 6 in space.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the point at which the bodies are joined, world frame at assembly, (dim,) [m]; the
            second body's center of mass unless given. The wrench refers to it.
    """

    point: Any = None
    oriented = True
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies, and the orientation of b in a."""
        return anchors(self, a, b) | {"orientation": relative_orientation(a, b)}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows p_b − p_a = 0, and rows that keep the relative orientation.

        p_a and p_b are the joint's points on both bodies.
        """
        points = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        return points + primitives.same_orientation(a, b, p["orientation"])


@dataclass(frozen=True)
class Revolute(Joint):
    """A hinge: 2 rows in the plane, 5 in space.

    Two points coincide. In space, an axis n of a also stays normal to two directions b₁, b₂ of b
    that span the plane normal to the axis: n·b₁ = n·b₂ = 0.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: a point on the axis, world frame at assembly, (dim,) [m].
        axis: the hinge axis, world frame at assembly, (3,), any length but zero; only in space.
    """

    point: Any
    axis: Any = None
    oriented = True
    turns = True
    coordinates = MappingProxyType({"angle": "rad"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies, and references of the angle.

        In space, the references are the axis in the frame of a, and two directions normal to it in
        the frame of each body. In the plane, the reference is the angle of b in a at assembly.
        """
        points = anchors(self, a, b)
        if a.position.shape == (2,):
            return points | {"angle": b.orientation - a.orientation}
        return points | axes_in_both(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows p_b − p_a = 0 for the joint's points, and n·b₁ = n·b₂ = 0 in space.

        n is the axis in a; b₁ and b₂ are directions of b normal to it.
        """
        rows = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        if "axis" not in p:
            return rows
        return rows + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the angle of b in a about the axis, zero at assembly [rad].

        In the plane it includes whole turns; in space it lies in [−π, π].
        """
        if "axis" not in p:
            return primitives.same_orientation(a, b, p["angle"])[0]
        return turn_about(p, a, b)


@dataclass(frozen=True)
class Prismatic(Joint):
    """A slider: 2 rows in the plane, 5 in space; only travel along an axis of a is free.

    The point p_b of b stays on the axis through the point p_a of a: u·(p_b − p_a) = 0 for the
    directions u normal to the axis. The relative orientation of the bodies is constant.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: the direction of travel, world frame at assembly, (dim,), any length but zero.
        point: a point on the axis, world frame at assembly, (dim,) [m]; the second body's center of
            mass unless given.
    """

    axis: Any
    point: Any = None
    oriented = True
    coordinates = MappingProxyType({"travel": "m"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, and the axis, its normals and b's orientation in a."""
        orientation = relative_orientation(a, b)
        return anchors(self, a, b) | axes_in(self, a) | {"orientation": orientation}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows u·(p_b − p_a) = 0, and rows that keep the relative orientation.

        p_a and p_b are the joint's points, u the directions normal to its axis.
        """
        return on_axis(p, a, b) + primitives.same_orientation(a, b, p["orientation"])

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the travel of b along the axis since assembly [m]."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return primitives.travel(a.direction(p["axis"]), *points)


def axes_in(joint: Joint, a: Pose) -> dict[str, Array]:
    """Returns the axis of a joint and the directions normal to it, in the frame of a."""
    directions = zip(("axis", "first_a", "second_a"), triad(joint, a), strict=False)
    return {side: a.local_direction(u) for side, u in directions}


def axes_in_both(joint: Joint, a: Pose, b: Pose) -> dict[str, Array]:
    """Returns the axis of a joint in the frame of a, and its normals in the frames of a and b.

    For joints in space.
    """
    n, u, w = triad(joint, a)
    return {
        "axis": a.local_direction(n),
        "first_a": a.local_direction(u),
        "second_a": a.local_direction(w),
        "first_b": b.local_direction(u),
        "second_b": b.local_direction(w),
    }


def on_axis(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
    """Returns the rows u·(p_b − p_a) = 0.

    p_a and p_b are the joint's points, u the directions normal to its axis.
    """
    points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
    normals = [p[side] for side in ("first_a", "second_a") if side in p]
    return [primitives.travel(a.direction(u), *points) for u in normals]


def parallel(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
    """Returns the rows n·b₁ = n·b₂ = 0, for the axis n in a and its normals b₁, b₂ in b."""
    n = a.direction(p["axis"])
    across = (b.direction(p["first_b"]), b.direction(p["second_b"]))
    return [primitives.angle_between(n, u) for u in across]


def turn_about(p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
    """Returns the angle of b in a about the joint's axis, zero at assembly [rad].

    The angle is measured between directions normal to the axis, and lies in [−π, π].
    """
    first, second = a.direction(p["first_a"]), a.direction(p["second_a"])
    return primitives.turn(first, second, b.direction(p["first_b"]))


def anchors(joint: Any, a: Pose, b: Pose) -> dict[str, Array]:
    """Returns the joint's point in the frames of both bodies, as `anchor_a` and `anchor_b`.

    Args:
        joint: a joint whose field `point` is (dim,) [m], world frame, or None for the position of
            the second body.
        a: pose of the first body at assembly.
        b: pose of the second body at assembly.
    """
    point = own_point(joint, "point", b.position if joint.point is None else joint.point, b)
    own_point(joint, "point", point, a)
    return {"anchor_a": a.local_point(point), "anchor_b": b.local_point(point)}


def triad(joint: Any, pose: Pose) -> list[Array]:
    """Returns the unit axis of a joint and the directions normal to it, right-handed.

    If the joint has an `x_axis`, the first normal is the part of `x_axis` normal to the axis.

    Raises:
        ValueError: an axis is missing, has the wrong shape or length zero, or `x_axis` is parallel
            to the axis.
    """
    n = unit(joint, "axis", pose)
    if joint.x_axis is None:
        return basis(n)
    given = unit(joint, "x_axis", pose)
    across = given - jnp.dot(n, given) * n
    length = numerics.norm(across)
    if checks.is_concrete(length) and float(length) <= PERPENDICULAR:
        raise ValueError(
            f"{label(joint)}: x_axis must not be parallel to axis, got {joint.x_axis} and"
            f" {joint.axis}; give a direction in the plane."
        )
    u = across / length
    return [n, u] if n.shape == (2,) else [n, u, jnp.cross(n, u)]


def basis(n: Array) -> list[Array]:
    """Returns a right-handed basis: the unit vector n, (dim,), and the directions normal to it."""
    return [n, *normals(n)]


def normals(n: Array) -> list[Array]:
    """Returns the directions normal to a unit vector n, (dim,), that complete a right-handed basis.

    In space the first direction is n × e, with e the world axis along which n has its smallest
    component: the first of x, y and z if components are equal.
    """
    if n.shape == (2,):
        return [jnp.stack([-n[1], n[0]])]
    smallest = jnp.argmin(jnp.abs(n))
    across = jnp.cross(n, jnp.eye(3, dtype=n.dtype)[smallest])
    u = across / numerics.norm(across)
    return [u, jnp.cross(n, u)]


def unit(joint: Joint, what: str, pose: Pose) -> Array:
    """Reads a direction from a field of a joint; returns it as a unit vector, world frame.

    Args:
        joint: the joint.
        what: name of the field, a direction (dim,) in the world frame.
        pose: pose of the body that has the direction.

    Raises:
        ValueError: the direction is missing, or has the wrong shape or length zero.
    """
    given = getattr(joint, what)
    if given is None:
        raise ValueError(f"{label(joint)}: in space an {what} (3,) is needed, got none.")
    return unit_vector(joint, what, given, pose)


def unit_vector(joint: BetweenBodies, what: str, given: PyTree, pose: Pose) -> Array:
    """Returns a vector given by the user, (dim,), as a unit vector.

    Raises:
        ValueError: the vector has the wrong shape or length zero.
    """
    axis = checks.real(label(joint), what, given, pose.position.dtype, pose.position.shape)
    checks.nonzero(label(joint), what, axis)
    return axis / numerics.norm(axis)


def check_perpendicular(joint: Joint, u: Array, w: Array) -> None:
    """Checks that two unit axes of a joint are perpendicular, if they are concrete.

    Args:
        joint: the joint, for the message.
        u: the first axis, (3,).
        w: the second axis, (3,).

    Raises:
        ValueError: the cosine of the angle between them is not zero.
    """
    cosine = jnp.dot(u, w)
    if checks.is_concrete(cosine) and abs(float(cosine)) > PERPENDICULAR:
        raise ValueError(
            f"{label(joint)}: axis_a and axis_b must be perpendicular, got a cosine of"
            f" {float(cosine):.6g} between them."
        )


def relative_orientation(a: Pose, b: Pose) -> Array:
    """Returns b's orientation in a: θ_b − θ_a in the plane, a quaternion q_a* q_b in space."""
    if a.position.shape == (2,):
        return b.orientation - a.orientation
    return quaternion.multiply(quaternion.conjugate(a.orientation), b.orientation)


def stretched(element: Distance | Rope, a: Pose, b: Pose) -> dict[str, Array]:
    """Returns the ends of a rod or rope in the frames of its bodies, and its length.

    Raises:
        ValueError: the length is not positive.
    """
    start = own_point(element, "point_a", element.point_a, a)
    end = own_point(element, "point_b", element.point_b, b)
    length, what = element.length, "length"
    if length is None:
        length, what = (
            numerics.norm(end - start),
            "the distance of its points, as no length is given,",
        )
    limits = element.ranges["length"]
    length = checks.real(label(element), what, length, a.position.dtype, **limits)
    return {"anchor_a": a.local_point(start), "anchor_b": b.local_point(end), "length": length}
