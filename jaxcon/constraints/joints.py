"""Joints between two bodies, each the sum of its primitives (chapter 3.6.1, corrected).

Points, axes and lengths are given in the world frame at assembly and kept in the frames of the two
bodies. To add a joint, write a class like these and one row in `tests/scenes.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, own_point

PERPENDICULAR = 1e-6
"""The cosine up to which two axes count as perpendicular; in float32 rounding alone is 1e-7."""


@dataclass(frozen=True)
class Coincident:
    """Two points stay together: 2 rows in the plane, 3 in space; particles too.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: where, world frame at assembly, (dim,) [m].
    """

    name: str
    body_a: str
    body_b: str
    point: Any

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames."""
        return anchors(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """p_b − p_a = 0."""
        return primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))


@dataclass(frozen=True)
class Spherical(Coincident):
    """A ball joint in space: two points stay together, every turn is free (3 rows).

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: the middle of the ball, world frame at assembly, (3,) [m].
    """

    dims = (3,)


@dataclass(frozen=True)
class Distance:
    """Two points keep their distance, φ = ‖p_b − p_a‖ − l: λ is minus the tension [N].

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        length: l > 0 [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (dim,) [m]; the centres of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    length: Any = None
    point_a: Any = None
    point_b: Any = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The two points in their frames, and the length."""
        return stretched(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """‖p_b − p_a‖ − l = 0."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return [primitives.distance(*points, p["length"])]


@dataclass(frozen=True)
class Fixed:
    """Two bodies keep their relative pose: 3 rows in the plane, 6 in space.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: where they are joined, world frame at assembly, (dim,) [m]; the second body's
            centre of mass unless given. The wrench is read there.
    """

    name: str
    body_a: str
    body_b: str
    point: Any = None
    oriented = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, and the orientation of b in a."""
        return anchors(self, a, b) | {"orientation": relative_orientation(a, b)}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """p_b − p_a = 0 and the orientations agree."""
        points = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        return points + primitives.same_orientation(a, b, p["orientation"])


@dataclass(frozen=True)
class Revolute:
    """A hinge: 2 rows in the plane, 5 in space.

    Two points meet and, in space, an axis n of a stays normal to two directions of b that span the
    plane normal to it: n·b₁ = n·b₂ = 0.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: on the axis, world frame at assembly, (dim,) [m].
        axis: world frame at assembly, (3,), any length but zero; only in space.
    """

    name: str
    body_a: str
    body_b: str
    point: Any
    axis: Any = None
    oriented = True
    turns = True
    coordinates = MappingProxyType({"angle": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the axes, and pointers that read the angle."""
        points = anchors(self, a, b)
        if a.position.shape == (2,):
            return points | {"angle": b.orientation - a.orientation}
        return points | axes_in_both(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """p_b − p_a = 0, n·b₁ = n·b₂ = 0."""
        rows = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        if "axis" not in p:
            return rows
        return rows + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """The angle of b in a about the axis, zero at assembly [rad]; over turns in the plane."""
        if "axis" not in p:
            return primitives.same_orientation(a, b, p["angle"])[0]
        return turn_about(p, a, b)


@dataclass(frozen=True)
class Prismatic:
    """A slider: 2 rows in the plane, 5 in space; only travel along an axis of a is free.

    The point of b stays on the axis through the point of a, u·(p_b − p_a) = 0 for the directions u
    normal to the axis, and the orientations agree.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: world frame at assembly, (dim,), any length but zero.
        point: on the axis, world frame at assembly, (dim,) [m]; the second body's centre of mass
            unless given.
    """

    name: str
    body_a: str
    body_b: str
    axis: Any
    point: Any = None
    oriented = True
    coordinates = MappingProxyType({"travel": "m"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the axis and its normals in a, the orientation of b in a."""
        turn = {"orientation": relative_orientation(a, b)}
        return anchors(self, a, b) | axes_in(self, a) | turn

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """u·(p_b − p_a) = 0 for u normal to the axis, and the orientations agree."""
        return on_axis(p, a, b) + primitives.same_orientation(a, b, p["orientation"])

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """How far b has moved along the axis since assembly [m]."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return primitives.travel(a.direction(p["axis"]), *points)


def axes_in(joint: Any, a: Pose) -> dict[str, Array]:
    """The axis of a joint and the directions normal to it, in the frame of a."""
    directions = zip(("axis", "first_a", "second_a"), triad(joint, a), strict=False)
    return {side: a.local_direction(u) for side, u in directions}


def axes_in_both(joint: Any, a: Pose, b: Pose) -> dict[str, Array]:
    """The axis of a joint in space in the frame of a, and the directions normal to it in both."""
    n, u, w = triad(joint, a)
    return {
        "axis": a.local_direction(n),
        "first_a": a.local_direction(u),
        "second_a": a.local_direction(w),
        "first_b": b.local_direction(u),
        "second_b": b.local_direction(w),
    }


def on_axis(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
    """u·(p_b − p_a) = 0 for u normal to the axis."""
    points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
    normals = [p[side] for side in ("first_a", "second_a") if side in p]
    return [primitives.travel(a.direction(u), *points) for u in normals]


def parallel(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
    """n·b₁ = n·b₂ = 0."""
    n = a.direction(p["axis"])
    across = (b.direction(p["first_b"]), b.direction(p["second_b"]))
    return [primitives.angle_between(n, u) for u in across]


def turn_about(p: dict[str, Any], a: Any, b: Any) -> Row:
    """The angle of b in a about the normal of two directions of a, zero at assembly [rad]."""
    first, second = a.direction(p["first_a"]), a.direction(p["second_a"])
    return primitives.turn(first, second, b.direction(p["first_b"]))


def anchors(joint: Any, a: Pose, b: Pose) -> dict[str, Array]:
    """The joint's point in both frames; the second body's position unless given."""
    point = own_point(joint, "point", b.position if joint.point is None else joint.point, b)
    own_point(joint, "point", point, a)
    return {"anchor_a": a.local_point(point), "anchor_b": b.local_point(point)}


def triad(joint: Any, pose: Pose) -> list[Array]:
    """The unit axis of a joint and the directions normal to it, right-handed.

    The first of them is the part of `x_axis` normal to the axis, where the joint has one.

    Raises:
        ValueError: an axis is missing, has the wrong shape or length zero, or they are parallel.
    """
    n = unit(joint, "axis", pose)
    if getattr(joint, "x_axis", None) is None:
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
    """A unit vector and the directions normal to it, right-handed: two in the plane, or three."""
    return [n, *normals(n)]


def normals(n: Array) -> list[Array]:
    """The directions normal to a unit vector (dim,) that make it a right-handed frame.

    In space the first is n × e, e the world axis along which n is shortest, x before y before z.
    """
    if n.shape == (2,):
        return [jnp.stack([-n[1], n[0]])]
    smallest = jnp.argmin(jnp.abs(n))
    across = jnp.cross(n, jnp.eye(3, dtype=n.dtype)[smallest])
    u = across / numerics.norm(across)
    return [u, jnp.cross(n, u)]


def unit(joint: Any, what: str, pose: Pose) -> Array:
    """A direction of a joint at length one, world frame.

    Raises:
        ValueError: it is missing, has the wrong shape or length zero.
    """
    given = getattr(joint, what)
    if given is None:
        raise ValueError(f"{label(joint)}: in space an {what} (3,) is needed, got none.")
    return unit_vector(joint, what, given, pose)


def unit_vector(joint: Any, what: str, given: Any, pose: Pose) -> Array:
    """A vector (dim,) that a user gave to a joint, at length one.

    Raises:
        ValueError: it has the wrong shape or length zero.
    """
    axis = checks.real(label(joint), what, given, pose.position.dtype, pose.position.shape)
    checks.nonzero(label(joint), what, axis)
    return axis / numerics.norm(axis)


def check_perpendicular(joint: Any, u: Array, w: Array) -> None:
    """Checks two unit axes of a joint, where they are concrete.

    Raises:
        ValueError: the cosine of the angle between them is not zero.
    """
    if checks.is_concrete((u, w)):
        cosine = float(jnp.dot(u, w))
        if abs(cosine) > PERPENDICULAR:
            raise ValueError(
                f"{label(joint)}: axis_a and axis_b must be perpendicular, got a cosine of"
                f" {cosine:.6g} between them."
            )


def relative_orientation(a: Pose, b: Pose) -> Array:
    """θ_b − θ_a in the plane, q_a* q_b in space."""
    if a.position.shape == (2,):
        return b.orientation - a.orientation
    return quaternion.multiply(quaternion.conjugate(a.orientation), b.orientation)


def stretched(element: Any, a: Pose, b: Pose) -> dict[str, Array]:
    """What a rod or a rope lies between: two points in their frames, and its length.

    Raises:
        ValueError: it has no length.
    """
    start = own_point(element, "point_a", element.point_a, a)
    end = own_point(element, "point_b", element.point_b, b)
    length, what = element.length, "length"
    if length is None:
        length, what = (
            numerics.norm(end - start),
            "the distance of its points, as no length is given,",
        )
    length = checks.real(label(element), what, length, a.position.dtype, above=0)
    return {"anchor_a": a.local_point(start), "anchor_b": b.local_point(end), "length": length}
