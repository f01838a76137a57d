"""Rolling without slip, and blades: contact held by position, motion along it by velocity.

A plane is a face of body a: a point p, a unit normal n and two tangents t, all fixed in a, which
may be the world, a body that moves, or one whose motion is prescribed (a turntable). Body b touches
it at c + ρ, where c is a point of b and ρ the arm from there to the contact. With Ω = ω_b − ω_a,
the point of b at the contact moves over the plane along t with

    ψ = t·(ċ − v_a(c)) + Ω·(ρ × t),        t·(ċ − v_a(c)) = d/dt t·(c − p),

v_a(c) the velocity of the point of a that lies at c. Angular velocities with constant components in
their own bodies are constant in the world too, so that at constant v

    γ = d²/dt² t·(c − p) + Ω·(ρ̇ × t + ρ × ṫ).

The row of the contact has a φ; those of the slip have none and are never part of a position
projection. The wrench of an element is read at c; its force is that of the contact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import PERPENDICULAR, unit
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.surfaces import Plane, normal, surface
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, own_point
from jaxcon.model.frames import Direction, Point


@dataclass(frozen=True)
class RollingSphere:
    """A ball rolls on a plane without slip and may spin about the normal: 3 rows, in space.

    φ = n·(c − p) − r, and along both tangents t of the plane ψ = t·(ċ − v_a(c)) + Ω·(ρ × t), the
    slip at the contact c + ρ, ρ = −r n, with Ω = ω_b − ω_a.

    Attributes:
        name: unique in the scene.
        body_a: of the plane, or `WORLD`.
        body_b: the ball.
        radius: r > 0 [m].
        normal: of the plane, towards the ball, world frame at assembly, (3,), any length but zero;
            z unless given.
        center: c, world frame at assembly, (3,) [m]; the ball's centre of mass unless given.
        point: p, world frame at assembly, (3,) [m]; where they touch at assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    name: str
    body_a: str
    body_b: str
    radius: Any
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    dims = (3,)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The plane in a, the centre in b, and the radius."""
        return touch(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(c − p) − r = 0; ψ = 0 along two tangents."""
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        n, r = plane.normal, p["radius"]
        height = plane.height(center)
        arm = n.position * -r, n.velocity * -r
        return [
            height._replace(value=height.value - r),
            *(no_slip(a, b, plane, t, center, arm) for t in plane.tangents),
        ]


@dataclass(frozen=True)
class RollingCylinder:
    """A cylinder rolls on a plane along a line without slip: 5 rows, in space.

    The rows of `RollingSphere`, and two more since a line touches: the axis e stays parallel to the
    plane, φ = n·e, and no other point of the line slips, which adds to the slip at c only
    ψ = n·Ω = 0. The five are independent and leave one motion.

    Attributes:
        name: unique in the scene.
        body_a: of the plane, or `WORLD`.
        body_b: the cylinder.
        radius: r > 0 [m].
        axis: e, world frame at assembly, (3,), any length but zero; parallel to the plane.
        normal: of the plane, towards the cylinder, world frame at assembly, (3,); z unless given.
        center: c, on the axis, world frame at assembly, (3,) [m]; the cylinder's centre of mass
            unless given.
        point: p, world frame at assembly, (3,) [m]; where they touch at assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    name: str
    body_a: str
    body_b: str
    radius: Any
    axis: Any
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    dims = (3,)
    in_b = ("axis",)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The plane in a, the centre and the axis in b, and the radius."""
        e, n = unit(self, "axis", b), normal(self, a)
        if checks.is_concrete((e, n)) and abs(float(jnp.dot(e, n))) > PERPENDICULAR:
            raise ValueError(
                f"{label(self)}: its axis must be parallel to the plane, got a cosine of"
                f" {float(jnp.dot(e, n)):.6g} between the axis and the normal."
            )
        return touch(self, a, b) | {"axis": b.local_direction(e)}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(c − p) − r = 0, n·e = 0; ψ = 0 along two tangents, n·Ω = 0."""
        height, *slip = RollingSphere.rows(p, a, b)
        n = a.direction(p["normal"])
        level = primitives.angle_between(n, b.direction(p["axis"]))
        return [height, level, *slip, no_spin(a, b, n)]


@dataclass(frozen=True)
class RollingDisc:
    """The rim of a thin disc or wheel rolls without slip: 2 rows in the plane, 3 in space.

    In space the disc with axis e may lean and turn. Its lowest point lies at ρ = −r s, with s the
    direction of n in the disc, s = (n − κ e)/σ, κ = n·e and σ = ‖n × e‖, so that
    φ = n·(c − p) − r σ. In the plane of a scene it rolls on a line, ρ = −r n. A disc that lies flat
    (σ = 0) touches everywhere, and its rows are those of its centre.

    Attributes:
        name: unique in the scene.
        body_a: of the plane or line, or `WORLD`.
        body_b: the disc.
        radius: r > 0 [m].
        axis: e, world frame at assembly, (3,), any length but zero; only in space.
        normal: of the plane, towards the disc, world frame at assembly, (dim,); the last axis of
            the world unless given.
        center: c, world frame at assembly, (dim,) [m]; the disc's centre of mass unless given.
        point: p, world frame at assembly, (dim,) [m]; where they touch at assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    name: str
    body_a: str
    body_b: str
    radius: Any
    axis: Any = None
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    turns = True
    in_b = ("axis",)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The plane in a, the centre and in space the axis in b, and the radius."""
        if a.position.shape == (2,):
            return touch(self, a, b)
        e, n = unit(self, "axis", b), normal(self, a)
        sine = numerics.norm(jnp.cross(n, e))
        if checks.is_concrete(sine) and float(sine) < PERPENDICULAR:
            raise ValueError(
                f"{label(self)}: it lies flat on its plane, where no point is the lowest; its axis"
                f" {checks.numerals(e)} must not be the normal {checks.numerals(n)}."
            )
        return touch(self, a, b, sine) | {"axis": b.local_direction(e)}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """n·(c − p) − r σ = 0; ψ = 0 along the tangents."""
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        height, r = plane.height(center), p["radius"]
        if "axis" not in p:
            row = plane.along(plane.tangents[0], center)  # Ω (ρ × t) = −r Ω
            rate = row.rate - r * (b.omega - a.omega)
            pulls = row.pulls[0] + a.turn(r), row.pulls[1] + b.turn(-r)
            slip = Row(0.0, rate, row.bias, pulls, holonomic=False)
            return [height._replace(value=height.value - r), slip]
        rim, ρ, ρ̇ = lowest(plane.normal, b.direction(p["axis"]), r)
        pulls = [x - y for x, y in zip(height.pulls, rim.pulls, strict=True)]
        contact = Row(
            height.value - rim.value,
            height.rate - rim.rate,
            height.bias - rim.bias,
            (pulls[0], pulls[1]),
        )
        return [contact, *(no_slip(a, b, plane, t, center, (ρ, ρ̇)) for t in plane.tangents)]


def no_slip(a: Any, b: Any, plane: Plane, t: Direction, center: Point, arm: Any) -> Row:
    """ψ = t·(ċ − v_a(c)) + Ω·(ρ × t), in space, with the arm (ρ, ρ̇)."""
    row, Ω = plane.along(t, center), b.spin - a.spin
    ρ, ρ̇ = arm
    lever = ρ.cross(t.position)
    return Row(
        0.0,
        row.rate + Ω.dot(lever),
        row.bias + Ω.dot(ρ̇.cross(t.position) + ρ.cross(t.velocity)),
        (row.pulls[0] - a.torque(lever), row.pulls[1] + b.torque(lever)),
        holonomic=False,
    )


def no_spin(a: Any, b: Any, n: Direction) -> Row:
    """ψ = n·Ω, with γ = ṅ·ω_b since n and ω_a turn together; in space."""
    pulls = -a.torque(n.position), b.torque(n.position)
    return Row(0.0, n.position.dot(b.spin - a.spin), n.velocity.dot(b.spin), pulls, holonomic=False)


def lowest(n: Direction, e: Direction, r: Any) -> tuple[Row, Vector, Vector]:
    """How far a disc reaches down from its centre, r σ as a row, and the arm ρ with its rate ρ̇.

    From σ² = 1 − κ²: σ σ̇ = −κ κ̇ and σ σ̈ = −κ̇² − κ κ̈ − σ̇²; from σ s = n − κ e the rate of s. At
    σ = 0 all of them are zero.
    """
    κ = primitives.angle_between(n, e)
    σ = numerics.norm(n.position.cross(e.position))
    inverse = numerics.safe_divide(1.0, σ)
    σ̇ = -κ.value * κ.rate * inverse
    σ̈ = -(κ.rate * κ.rate + κ.value * κ.bias + σ̇ * σ̇) * inverse
    s = (n.position - e.position * κ.value) * inverse
    turning = n.velocity - e.velocity * κ.value - e.position * κ.rate
    ṡ = (turning - s * σ̇) * inverse
    gradient = -r * κ.value * inverse
    pulls = κ.pulls[0] * gradient, κ.pulls[1] * gradient
    return Row(r * σ, r * σ̇, r * σ̈, pulls), s * -r, ṡ * -r


def touch(joint: Any, a: Pose, b: Pose, reach: Any = 1.0) -> dict[str, Array]:
    """Radius, plane and centre of a rolling element whose centre lies `reach` radii up.

    Raises:
        ValueError: a radius that is not positive, or a wrong shape.
    """
    radius = checks.real(label(joint), "radius", joint.radius, a.position.dtype, above=0)
    center, n = own_point(joint, "center", joint.center, b), normal(joint, a)
    contact = center - radius * reach * n if joint.point is None else joint.point
    point = own_point(joint, "point", contact, a)
    anchors = {"anchor_a": a.local_point(point), "anchor_b": b.local_point(center)}
    return surface(n, a) | anchors | {"radius": radius}
