"""Further joints: sliders, shafts, massless rods, points on lines, spans and twists.

Like the joints in `joints`, each is composed of the rows in `primitives`. The user gives points and
axes in the world frame at assembly; joints keep them in the frames of their two bodies.

In all equations p_a and p_b are the joint's points on bodies a and b, n is an axis or normal, and
b₁, b₂ are directions of b normal to it at assembly.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joint
from jaxcon.constraints.joints import (
    PERPENDICULAR,
    POSITIVE_LENGTH,
    Distance,
    Prismatic,
    anchors,
    axes_in,
    axes_in_both,
    check_perpendicular,
    on_axis,
    parallel,
    relative_orientation,
    triad,
    turn_about,
    unit,
)
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import BetweenBodies, label, own_point

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame


@dataclass(frozen=True)
class PointOnLine(Joint):
    """A point of b stays on a line of a: 1 row in the plane (a pin in a slot), 2 in space.

    u·(p_b − p_a) = 0 for the directions u normal to the line; b may be a particle.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`; a has an orientation.
        axis: direction of the line, world frame at assembly, (dim,), any length but zero.
        point: a point on the line, world frame at assembly, (dim,) [m]; the second body's center of
            mass unless given.
    """

    axis: Any
    point: Any = None
    coordinates = MappingProxyType({"travel": "m"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies, and the axis and its normals in a."""
        check_oriented(self, a)
        return anchors(self, a, b) | axes_in(self, a)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows u·(p_b − p_a) = 0, for the directions u normal to the line.

        p_a is a point of the line, and p_b the point of b.
        """
        return on_axis(p, a, b)

    coordinate = Prismatic.coordinate


@dataclass(frozen=True)
class PointOnPlane(Joint):
    """A point of b stays on a plane of a (a line in the plane): n·(p_b − p_a) = 0, 1 row.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`; a has an orientation, b may be a particle.
        axis: the normal n, world frame at assembly, (dim,), any length but zero.
        point: a point on the plane, world frame at assembly, (dim,) [m]; the second body's center
            of mass unless given.
        x_axis: the direction of the coordinate x, world frame at assembly, (dim,); only its part in
            the plane counts, and y is axis × x. Unless given, x is axis × e, with e the world axis
            along which the axis has its smallest component: the first of x, y and z if components
            are equal. For a normal along world z, x points along world y, and y along −x. In scenes
            in the plane, x is the axis turned by +90°.
    """

    axis: Any
    point: Any = None
    x_axis: Any = None
    coordinates = MappingProxyType({"x": "m", "y": "m"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, and the normal and the tangents of the plane in a."""
        check_oriented(self, a)
        return anchors(self, a, b) | axes_in(self, a)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the row n·(p_b − p_a) = 0.

        n is the normal of the plane, p_a a point of the plane, and p_b the point of b.
        """
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return [primitives.travel(a.direction(p["axis"]), *points)]

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the position of b's point along x or y of a [m]; in the plane there is only x."""
        side = {"x": "first_a", "y": "second_a"}[name]
        if side not in p:
            raise ValueError("PointOnPlane: in the plane its one coordinate is x, got y.")
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return primitives.travel(a.direction(p[side]), *points)


@dataclass(frozen=True)
class Parallel(Joint):
    """An axis of b stays parallel to an axis n of a, in space: n·b₁ = n·b₂ = 0, 2 rows.

    b₁ and b₂ are directions of b normal to its axis.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: the axis of both bodies, world frame at assembly, (3,), any length but zero.
    """

    axis: Any
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"angle": "rad"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the axis in the frame of a, and its normals in the frames of both bodies."""
        return axes_in_both(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows n·b₁ = n·b₂ = 0, for the axis n in a and its normals b₁, b₂ in b."""
        return parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the angle of b in a about the axis, zero at assembly, in [−π, π] [rad]."""
        return turn_about(p, a, b)


@dataclass(frozen=True)
class Cylindrical(Parallel):
    """A sleeve on a shaft, in space: travel along an axis and the turn about it are free, 4 rows.

    The point of b stays on the axis through the point of a, and the axes of a and b stay parallel.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: direction of the shaft, world frame at assembly, (3,), any length but zero.
        point: a point on the axis, world frame at assembly, (3,) [m]; the second body's center of
            mass unless given.
    """

    point: Any = None
    coordinates = MappingProxyType({"travel": "m", "angle": "rad"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, the axis in a, and its normals in both frames."""
        return anchors(self, a, b) | Parallel.attach(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows u·(p_b − p_a) = 0 and n·b₁ = n·b₂ = 0.

        p_a and p_b are the joint's points, and n is the axis in a. The directions u of a and b₁, b₂
        of b are normal to the axis.
        """
        return on_axis(p, a, b) + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the travel of b along the axis [m] or its turn about it [rad], since assembly."""
        return turn_about(p, a, b) if name == "angle" else Prismatic.coordinate(name, p, a, b)


@dataclass(frozen=True)
class Screw(Cylindrical):
    """A nut on a thread, in space, 5 rows: b moves along the axis by `lead` each turn.

    The joint has the rows of `Cylindrical`, and s = lead θ/2π for travel s and angle θ. The poses
    give θ only up to whole turns, which the travel determines: φ = (lead/2π) wrap(2π s/lead − θ).

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: direction of the thread, world frame at assembly, (3,), any length but zero.
        point: a point on the axis, world frame at assembly, (3,) [m]; the second body's center of
            mass unless given.
        lead: travel in one turn of b about the axis, positive for a right-handed thread, not 0 [m].
    """

    lead: Any = None
    nonzero = ("lead",)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the numbers of the sleeve joint (`Cylindrical`), and the lead."""
        if self.lead is None:
            raise ValueError(f"{label(self)}: a lead is needed, the travel in one turn [m].")
        lead = checks.real(label(self), "lead", self.lead, a.position.dtype)
        return Cylindrical.attach(self, a, b) | {"lead": lead}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows of the sleeve joint, and s − lead θ/2π = 0 for travel s and angle θ."""
        s, θ = Prismatic.coordinate("travel", p, a, b), turn_about(p, a, b)
        rise = p["lead"] / (2 * jnp.pi)
        thread = Row(
            rise * numerics.wrap(s.value / rise - θ.value),
            s.rate - rise * θ.rate,
            s.bias - rise * θ.bias,
            (s.pulls[0] - θ.pulls[0] * rise, s.pulls[1] - θ.pulls[1] * rise),
        )
        return [*Cylindrical.rows(p, a, b), thread]


@dataclass(frozen=True)
class Planar(Parallel):
    """A plane of b slides on a plane of a, in space: n·(p_b − p_a) = n·b₁ = n·b₂ = 0, 3 rows.

    n is the normal of the planes, p_a and p_b are points of them, and b₁, b₂ directions in b's
    plane.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: the normal n, world frame at assembly, (3,), any length but zero.
        point: a point on the plane, world frame at assembly, (3,) [m]; the second body's center of
            mass unless given.
        x_axis: the direction of the coordinate x, world frame at assembly, (3,); only its part in
            the plane counts, and y is axis × x. Unless given, x is axis × e, with e the world axis
            along which the axis has its smallest component: the first of x, y and z if components
            are equal. For a normal along world z, x points along world y, and y along −x.
    """

    point: Any = None
    x_axis: Any = None
    coordinates = MappingProxyType({"x": "m", "y": "m", "angle": "rad"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns point and tangents of the plane in both body frames, and its normal in a."""
        return anchors(self, a, b) | Parallel.attach(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows n·(p_b − p_a) = 0 and n·b₁ = n·b₂ = 0.

        n is the normal of a's plane, p_a and p_b are the joint's points, and b₁, b₂ directions in
        the plane of b.
        """
        return PointOnPlane.rows(p, a, b) + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the position of b's point along x or y of a [m], or b's angle about n [rad].

        n is the normal of the plane.
        """
        if name == "angle":
            return turn_about(p, a, b)
        return PointOnPlane.coordinate(name, p, a, b)


@dataclass(frozen=True)
class SphericalSpherical(Distance):
    """A massless rod with a ball joint at each end, in space: another name of `Distance`, 1 row.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        length: l > 0 [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (3,) [m]; the centers of mass unless given.
    """

    dims = (3,)


@dataclass(frozen=True)
class RevoluteSpherical(Joint):
    """A massless rod with a hinge on a and a ball joint on b, in space, 2 rows.

    The rod turns about the axis n through the hinge: n·(p_b − p_a) = 0 and ‖p_b − p_a‖ = l, with
    the hinge p_a, the ball p_b and the rod's length l.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`; b may be a particle.
        hinge: position of the hinge, world frame at assembly, (3,) [m].
        ball: position of the ball joint, world frame at assembly, (3,) [m]; it lies in the plane
            through the hinge normal to the axis.
        axis: the hinge axis n, world frame at assembly, (3,), any length but zero.
    """

    hinge: Any
    ball: Any
    axis: Any
    dims = (3,)
    coordinates = MappingProxyType({"angle": "rad"})
    ranges = POSITIVE_LENGTH
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the rod's ends in their bodies' frames, its length, and three directions in a.

        The directions are the hinge axis, the rod at assembly, and the normal of both.
        """
        check_oriented(self, a)
        n = unit(self, "axis", a)
        hinge, ball = own_point(self, "hinge", self.hinge, a), own_point(self, "ball", self.ball, b)
        length = numerics.norm(ball - hinge)
        checks.check(
            label(self), "the distance from hinge to ball", length, **self.ranges["length"]
        )
        rod = (ball - hinge) / length
        cosine = n @ rod
        if checks.is_concrete(cosine) and abs(float(cosine)) > PERPENDICULAR:
            raise ValueError(
                f"{label(self)}: the rod must be normal to the axis of its hinge, got a cosine of"
                f" {float(cosine):.6g} between them."
            )
        return {
            "anchor_a": a.local_point(hinge),
            "anchor_b": b.local_point(ball),
            "axis": a.local_direction(n),
            "first_a": a.local_direction(rod),
            "second_a": a.local_direction(jnp.cross(n, rod)),
            "length": length,
        }

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows n·(p_b − p_a) = 0 and ‖p_b − p_a‖ − l = 0.

        n is the hinge axis, p_a the hinge, p_b the ball joint, and l the length of the rod.
        """
        return PointOnPlane.rows(p, a, b) + Distance.rows(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the angle of the rod about its hinge, zero at assembly [rad]."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        sides = (a.direction(p[side]) for side in ("first_a", "second_a"))
        return primitives.bearing(*(primitives.travel(u, *points) for u in sides))


def check_oriented(joint: BetweenBodies, a: Pose) -> None:
    """Checks that the first body has an orientation.

    Raises:
        ValueError: the first body is a particle.
    """
    if a.orientation is None:
        raise ValueError(
            f"{label(joint)}: it needs an orientation, but '{joint.body_a}' is a particle; let the"
            " particle be body_b."
        )


@dataclass(frozen=True)
class Universal(Joint):
    """A universal joint (cross, Cardan or Hooke joint) in space, 4 rows; two turns are free.

    Two points coincide, and an axis n_a of a stays normal to an axis n_b of b: n_a·n_b = 0.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the center of the cross, world frame at assembly, (3,) [m].
        axis_a, axis_b: the axes of the cross that turn in a and in b, world frame at assembly,
            (3,), any length but zero; perpendicular.
    """

    point: Any
    axis_a: Any
    axis_b: Any
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"angle_a": "rad", "angle_b": "rad"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, both axes, and the reference directions of the angles.

        The first axis and the two directions from which its angle is measured are in the frame of
        a, the second axis and its two directions in the frame of b.
        """
        n_a, n_b = unit(self, "axis_a", a), unit(self, "axis_b", b)
        check_perpendicular(self, n_a, n_b)
        across = jnp.cross(n_a, n_b)
        return anchors(self, a, b) | {
            "axis_a": a.local_direction(n_a),
            "first_a": a.local_direction(n_b),
            "second_a": a.local_direction(across),
            "axis_b": b.local_direction(n_b),
            "first_b": b.local_direction(n_a),
            "second_b": b.local_direction(across),
        }

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows p_b − p_a = 0 and n_a·n_b = 0.

        p_a and p_b are the joint's points, n_a and n_b the axes of the cross.
        """
        rows = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        n_a, n_b = a.direction(p["axis_a"]), b.direction(p["axis_b"])
        return [*rows, primitives.angle_between(n_a, n_b)]

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the angle of the cross in a about n_a, or of b on the cross about n_b [rad].

        The cross contains the axes n_a and n_b; n_a⁰ and n_b⁰ are their directions at assembly. If
        the cross has turned by α in a, then n_b = cos α n_b⁰ + sin α c with c = n_a × n_b⁰. If b
        has turned by β on the cross, then n_a = cos β n_a⁰ + sin β c in the frame of b.
        """
        if name == "angle_a":
            first, second = a.direction(p["first_a"]), a.direction(p["second_a"])
            return primitives.turn(first, second, b.direction(p["axis_b"]))
        first, second = b.direction(p["first_b"]), b.direction(p["second_b"])
        row = primitives.turn(first, second, a.direction(p["axis_a"]))
        return row._replace(pulls=row.pulls[::-1])


@dataclass(frozen=True)
class ConstantVelocity(Joint):
    """Two shafts at any angle below π that turn equally fast, in space, 4 rows.

    The shafts meet in a point. The rotation of b relative to a, measured from the pose with the
    shafts in line, is about an axis normal to both shafts. Its unit quaternion (w, x, y, z), with z
    along the shaft of a, therefore has z = 0. a₁ and a₂ are directions of a normal to its shaft. b₁
    and b₂ are the directions of b that coincide with them when the shafts are in line. Then

        φ = a₂·b₁ − a₁·b₂ = 4 w z = (1 + cos β) sin τ,

    where β is the bend and τ the twist between the shafts. If a and b turn about their own shafts
    by α and α′, φ changes from 0 to 2 w² sin(α′ − α). So φ = 0 demands α′ = α at every bend.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the point at which the shafts meet, world frame at assembly, (3,) [m].
        axis: direction of a's shaft, world frame at assembly, (3,), any length but zero.
        axis_b: direction of b's shaft, in line with `axis` unless given. Both shafts turn equally
            fast, each in the right-handed sense about its direction.
    """

    point: Any
    axis: Any
    axis_b: Any = None
    oriented = True
    dims = (3,)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, and directions in each body normal to its shaft."""
        n, u, w = triad(self, a)
        m = n if self.axis_b is None else unit(self, "axis_b", b)
        if checks.is_concrete((n, m)) and float(n @ m) < PERPENDICULAR - 1:
            raise ValueError(
                f"{label(self)}: axis and axis_b are opposite, which leaves the bend between them"
                " without a plane; let both point on along the shafts, from a to b."
            )
        return anchors(self, a, b) | {
            "first_a": a.local_direction(u),
            "second_a": a.local_direction(w),
            "first_b": b.local_direction(bent(n, m, u)),
            "second_b": b.local_direction(bent(n, m, w)),
        }

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows p_b − p_a = 0 and a₂·b₁ − a₁·b₂ = 0.

        p_a and p_b are the joint's points; a₁, a₂ and b₁, b₂ are directions normal to the shafts of
        a and b.
        """
        a1, a2 = a.direction(p["first_a"]), a.direction(p["second_a"])
        b1, b2 = b.direction(p["first_b"]), b.direction(p["second_b"])
        twist = primitives.difference(
            primitives.angle_between(a2, b1), primitives.angle_between(a1, b2)
        )
        return [*primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"])), twist]


def bent(n: Array, m: Array, x: Array) -> Array:
    """Returns the vector x after the shortest turn from unit vector n to unit vector m; m ≠ −n.

    R x = x + k × x + k × (k × x)/(1 + n·m) with k = n × m.
    """
    k = jnp.cross(n, m)
    across = jnp.cross(k, x)
    return x + across + jnp.cross(k, across) / (1 + n @ m)


@dataclass(frozen=True)
class Span(Joint):
    """Two points and the line between them: no rows, one coordinate, "stretch" = ‖p_b − p_a‖ − l.

    l is the distance at assembly. With motors, servos, springs and drives a span models hydraulic
    cylinders, tendons and winches; `Pulley` joins two spans by a rope over a pulley. If the points
    coincide, the line has no direction, and forces along it vanish.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point_a, point_b: world points at assembly, (dim,) [m]; the centers of mass unless given.
    """

    point_a: Any = None
    point_b: Any = None
    coordinates = MappingProxyType({"stretch": "m"})
    ranges = POSITIVE_LENGTH
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the two points in the frames of their bodies, and the distance between them."""
        ends = {"point_a": self.point_a, "point_b": self.point_b}
        return Distance(self.name, self.body_a, self.body_b, **ends).attach(a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns an empty list: a span constrains nothing."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the stretch ‖p_b − p_a‖ − l [m], with the points' distance l at assembly."""
        return primitives.distance(a.point(p["anchor_a"]), b.point(p["anchor_b"]), p["length"])


@dataclass(frozen=True)
class Twist(Joint):
    """A measure of the turn of b in a about an axis n of b: no rows, one coordinate, "twist".

    The twist is n·φ, with φ the rotation vector of b in a since assembly, at most half a turn. Its
    rate is n·(ω_b − ω_a). If b also turns about other axes, this rate is not the derivative of any
    function of the orientation. Motors, springs, dampers and rotors may act on a twist, but its
    motion cannot be prescribed or coupled. Equal springs on three perpendicular axes have the
    torque −k φ and the energy ½ k ‖φ‖². A spring on one axis alone is not conservative, and its
    part of `energy` is only nominal.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        axis: n, world frame at assembly, (3,), any length but zero.
        point: the reference point of wrenches, world frame at assembly, (3,) [m]; the second body's
            center of mass unless given.
    """

    axis: Any
    point: Any = None
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"twist": "rotation"})
    in_b = ("axis",)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in both frames, the axis in b, and the orientation of b in a."""
        axis = b.local_direction(unit(self, "axis", b))
        return anchors(self, a, b) | {"axis": axis, "orientation": relative_orientation(a, b)}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns an empty list: a twist constrains nothing."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the twist n·φ, its rate n·(ω_b − ω_a) and its bias (ω_b × n)·(ω_b − ω_a).

        n is the axis in b, and φ the rotation vector of b in a since assembly [rad].
        """
        relative = quaternion.multiply(quaternion.conjugate(a.quaternion), b.quaternion)
        since = quaternion.multiply(quaternion.conjugate(p["orientation"]), relative)
        value = Vector.of(p["axis"]).dot(quaternion.log(since))
        n = b.direction(p["axis"])
        turning = b.spin - a.spin
        pulls = a.torque(-n.position), b.torque(n.position)
        return Row(value, n.position.dot(turning), n.velocity.dot(turning), pulls)
