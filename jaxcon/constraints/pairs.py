"""Further pairs of bodies: sliding ones, shafts at an angle, massless rods, points on lines.

As in `joints`, each is the sum of its primitives; points and axes are given in the world frame at
assembly and kept in the frames of the two bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import (
    PERPENDICULAR,
    Distance,
    Prismatic,
    anchors,
    axes_in,
    axes_in_both,
    on_axis,
    parallel,
    turn_about,
    unit,
)
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, own_point


@dataclass(frozen=True)
class PointOnLine:
    """A point of b stays on a line of a: 1 row in the plane (a pin in a slot), 2 in space.

    u·(p_b − p_a) = 0 for the directions u normal to the line; b may be a particle.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`; a has an orientation.
        axis: of the line, world frame at assembly, (dim,), any length but zero.
        point: on the line, world frame at assembly, (dim,) [m]; the second body's centre of mass
            unless given.
    """

    name: str
    body_a: str
    body_b: str
    axis: Any
    point: Any = None
    coordinates = MappingProxyType({"travel": "m"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the axis and its normals in a."""
        check_oriented(self, a)
        return anchors(self, a, b) | axes_in(self, a)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """u·(p_b − p_a) = 0 for u normal to the axis."""
        return on_axis(p, a, b)

    coordinate = Prismatic.coordinate


@dataclass(frozen=True)
class PointOnPlane:
    """A point of b stays on a plane of a (a line in the plane): n·(p_b − p_a) = 0, 1 row.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`; a has an orientation, b may be a particle.
        axis: the normal, world frame at assembly, (dim,), any length but zero.
        point: on the plane, world frame at assembly, (dim,) [m]; the second body's centre of mass
            unless given.
        x_axis: the direction of the coordinate x, world frame at assembly, (dim,); its part in the
            plane counts, and y is axis × x. Unless given, x is axis × e, e the world axis along
            which the axis is shortest, x before y before z: of a normal along world z, x points
            along world y, and y along −x.
            In the plane x is the axis turned by +90°.
    """

    name: str
    body_a: str
    body_b: str
    axis: Any
    point: Any = None
    x_axis: Any = None
    coordinates = MappingProxyType({"x": "m", "y": "m"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, and the normal in a."""
        check_oriented(self, a)
        return anchors(self, a, b) | axes_in(self, a)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(p_b − p_a) = 0."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return [primitives.travel(a.direction(p["axis"]), *points)]

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """How far b has moved along x and y of a [m]; in the plane there is only x."""
        side = {"x": "first_a", "y": "second_a"}[name]
        if side not in p:
            raise ValueError("PointOnPlane: in the plane its one coordinate is x, got y.")
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        return primitives.travel(a.direction(p[side]), *points)


@dataclass(frozen=True)
class Parallel:
    """An axis of b stays parallel to one of a, in space: n·b₁ = n·b₂ = 0, 2 rows.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: world frame at assembly, (3,), any length but zero.
    """

    name: str
    body_a: str
    body_b: str
    axis: Any
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"angle": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The axis in a, and the directions normal to it in both."""
        return axes_in_both(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·b₁ = n·b₂ = 0."""
        return parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """The angle of b in a about the axis, zero at assembly [rad]."""
        return turn_about(p, a, b)


@dataclass(frozen=True)
class Cylindrical(Parallel):
    """A sleeve on a shaft, in space: travel along an axis and the turn about it are free, 4 rows.

    The point of b stays on the axis through the point of a, and the axes stay parallel.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: world frame at assembly, (3,), any length but zero.
        point: on the axis, world frame at assembly, (3,) [m]; the second body's centre of mass
            unless given.
    """

    point: Any = None
    coordinates = MappingProxyType({"travel": "m", "angle": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the axis and its normals in both."""
        return anchors(self, a, b) | Parallel.attach(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """u·(p_b − p_a) = 0 for u normal to the axis, n·b₁ = n·b₂ = 0."""
        return on_axis(p, a, b) + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """How far b has moved along the axis [m] and turned about it [rad] since assembly."""
        return turn_about(p, a, b) if name == "angle" else Prismatic.coordinate(name, p, a, b)


@dataclass(frozen=True)
class Screw(Cylindrical):
    """A nut on a thread, in space, 5 rows: b moves along the axis by `lead` each turn.

    Besides the rows of `Cylindrical`, s = lead θ/2π of travel and angle. The angle is read up to
    whole turns, and the travel says which turn it is: φ = (lead/2π) wrap(2π s/lead − θ).

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: world frame at assembly, (3,), any length but zero.
        point: on the axis, world frame at assembly, (3,) [m]; the second body's centre of mass
            unless given.
        lead: travel in one turn of b about the axis, positive for a right-handed thread, not 0 [m].
    """

    lead: Any = None

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the numbers of the sleeve, and the lead."""
        if self.lead is None:
            raise ValueError(f"{label(self)}: a lead is needed, the travel in one turn [m].")
        lead = checks.real(label(self), "lead", self.lead, a.position.dtype)
        checks.nonzero(label(self), "lead", lead)
        return Cylindrical.attach(self, a, b) | {"lead": lead}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """Returns the rows of the sleeve, and s − lead θ/2π = 0."""
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

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: the normal, world frame at assembly, (3,), any length but zero.
        point: on the plane, world frame at assembly, (3,) [m]; the second body's centre of mass
            unless given.
        x_axis: the direction of the coordinate x, world frame at assembly, (3,); its part in the
            plane counts, and y is axis × x. Unless given, x is axis × e, e the world axis along
            which the axis is shortest, x before y before z: of a normal along world z, x points
            along world y, and y along −x.
    """

    point: Any = None
    x_axis: Any = None
    coordinates = MappingProxyType({"x": "m", "y": "m", "angle": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the normal in a, and the directions of the plane in both."""
        return anchors(self, a, b) | Parallel.attach(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(p_b − p_a) = 0, n·b₁ = n·b₂ = 0."""
        return PointOnPlane.rows(p, a, b) + parallel(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """How far b has moved along x and y of a [m] and turned about the normal [rad]."""
        if name == "angle":
            return turn_about(p, a, b)
        return PointOnPlane.coordinate(name, p, a, b)


@dataclass(frozen=True)
class SphericalSpherical(Distance):
    """A massless rod with a ball at each end, in space: `Distance` by its other name, 1 row.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        length: l > 0 [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (3,) [m]; the centres of mass unless given.
    """

    dims = (3,)


@dataclass(frozen=True)
class RevoluteSpherical:
    """A massless rod hinged to a and with a ball on b, in space, 2 rows.

    The rod turns about the axis n through the hinge: n·(p_b − p_a) = 0 and ‖p_b − p_a‖ = l.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`; b may be a particle.
        hinge: world frame at assembly, (3,) [m].
        ball: likewise; in the plane through the hinge normal to the axis.
        axis: of the hinge, world frame at assembly, (3,), any length but zero.
    """

    name: str
    body_a: str
    body_b: str
    hinge: Any
    ball: Any
    axis: Any
    dims = (3,)
    coordinates = MappingProxyType({"angle": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The ends in their frames, the axis and the rod in a, and the length."""
        check_oriented(self, a)
        n = unit(self, "axis", a)
        hinge, ball = own_point(self, "hinge", self.hinge, a), own_point(self, "ball", self.ball, b)
        length = numerics.norm(ball - hinge)
        checks.check(label(self), "the distance from hinge to ball", length, above=0)
        rod = (ball - hinge) / length
        check_normal(self, n, rod)
        return {
            "anchor_a": a.local_point(hinge),
            "anchor_b": b.local_point(ball),
            "axis": a.local_direction(n),
            "first_a": a.local_direction(rod),
            "second_a": a.local_direction(jnp.cross(n, rod)),
            "length": length,
        }

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(p_b − p_a) = 0, ‖p_b − p_a‖ − l = 0."""
        return PointOnPlane.rows(p, a, b) + Distance.rows(p, a, b)

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """The angle of the rod about its hinge, zero at assembly [rad]."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        sides = (a.direction(p[side]) for side in ("first_a", "second_a"))
        return primitives.bearing(*(primitives.travel(u, *points) for u in sides))


def check_oriented(joint: Any, a: Pose) -> None:
    """Checks that the first body has an orientation.

    Raises:
        ValueError: it is a particle.
    """
    if a.orientation is None:
        raise ValueError(
            f"{label(joint)}: it needs an orientation, but '{joint.body_a}' is a particle; let the"
            " particle be body_b."
        )


def check_normal(joint: Any, n: Array, rod: Array) -> None:
    """Checks, where they are concrete, that a rod is normal to the axis of its hinge.

    Raises:
        ValueError: it is not.
    """
    if checks.is_concrete((n, rod)):
        cosine = float(n @ rod)
        if abs(cosine) > PERPENDICULAR:
            raise ValueError(
                f"{label(joint)}: the rod must be normal to the axis of its hinge, got a cosine of"
                f" {cosine:.6g} between them."
            )
