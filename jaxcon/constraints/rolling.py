"""Rolling without slip, and blades: rows keep contact by positions, and prevent slip by velocities.

A plane is a face of body a: a point p, a unit normal n and two tangents t, all fixed in a. Body a
may be the world, a moving body, or a body with prescribed motion such as a turntable. Body b
touches the plane at c + ρ, where c is a point of b, and ρ the arm from c to the contact. With the
relative angular velocity Ω = ω_b − ω_a, the point of b at the contact moves over the plane along t
at the speed

    ψ = t·(ċ − v_a(c)) + Ω·(ρ × t),        t·(ċ − v_a(c)) = d/dt t·(c − p),

where v_a(c) is the velocity of the point of a that lies at c. An angular velocity with constant
components in its own body is constant in the world, too. At constant v therefore

    γ = d²/dt² t·(c − p) + Ω·(ρ̇ × t + ρ × ṫ).

The contact row has a φ. Slip rows have no φ, and a position projection leaves them out. The wrench
of an element refers to the point c; its force is the contact force.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joint
from jaxcon.constraints.joints import PERPENDICULAR, basis, unit
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import label, own_point
from jaxcon.system.frames import Direction, Point

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

POSITIVE_RADIUS = MappingProxyType({"radius": checks.NumberRange(above=0)})
"""The `Element.ranges` of rolling elements."""


@dataclass(frozen=True)
class RollingSphere(Joint):
    """A ball rolls on a plane without slip and may spin about the normal: 3 rows, in space.

    The contact row is φ = n·(c − p) − r. The slip rows are ψ = t·(ċ − v_a(c)) + Ω·(ρ × t) along
    both tangents t of the plane: the slip velocity at the contact c + ρ. Here ρ = −r n, Ω = ω_b −
    ω_a, and v_a(c) is the velocity of the point of a at c.

    Attributes:
        name: name of the element, unique in the scene.
        body_a: name of the body a with the plane, or `WORLD`.
        body_b: name of the ball.
        radius: r > 0 [m].
        normal: normal n of the plane, towards the ball, world frame at assembly, (3,), any length
            but zero; z unless given.
        center: center c of the ball, world frame at assembly, (3,) [m]; the ball's center of mass
            unless given.
        point: a point p of the plane, world frame at assembly, (3,) [m]; the contact point at
            assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    radius: Any
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    dims = (3,)
    ranges = POSITIVE_RADIUS
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the plane in the frame of a, the center in the frame of b, and the radius."""
        return touch(self, a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the contact row n·(c − p) − r = 0, and slip rows ψ = 0 along two tangents.

        n and p are normal and point of the plane, c and r center and radius of the ball.
        """
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        n, r = plane.normal, p["radius"]
        height = plane.height(center)
        arm = n.position * -r, n.velocity * -r
        return [
            height._replace(value=height.value - r),
            *(no_slip(a, b, plane, t, center, arm) for t in plane.tangents),
        ]


@dataclass(frozen=True)
class RollingCylinder(Joint):
    """A cylinder rolls on a plane along a line without slip: 5 rows, in space.

    The joint has the rows of `RollingSphere`, and two more since it touches the plane along a line.
    The axis e stays parallel to the plane: φ = n·e. The remaining points of the line do not slip
    either: ψ = n·Ω = 0, with Ω = ω_b − ω_a. The five rows are independent and leave one degree of
    freedom.

    Attributes:
        name: name of the element, unique in the scene.
        body_a: name of the body a with the plane, or `WORLD`.
        body_b: name of the cylinder.
        radius: r > 0 [m].
        axis: axis e of the cylinder, world frame at assembly, (3,), any length but zero; parallel
            to the plane.
        normal: normal n of the plane, towards the cylinder, world frame at assembly, (3,); z unless
            given.
        center: a point c of the axis, world frame at assembly, (3,) [m]; the cylinder's center of
            mass unless given.
        point: a point p of the plane, world frame at assembly, (3,) [m]; the contact point at
            assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    radius: Any
    axis: Any
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    dims = (3,)
    ranges = POSITIVE_RADIUS
    in_b = ("axis",)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the plane in the frame of a, center and axis in b's frame, and the radius."""
        e, n = unit(self, "axis", b), normal(self, a)
        if checks.is_concrete((e, n)) and abs(float(jnp.dot(e, n))) > PERPENDICULAR:
            raise ValueError(
                f"{label(self)}: its axis must be parallel to the plane, got a cosine of"
                f" {float(jnp.dot(e, n)):.6g} between the axis and the normal."
            )
        return touch(self, a, b) | {"axis": b.local_direction(e)}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the contact rows n·(c − p) − r = 0 and n·e = 0, and three slip rows.

        The slip rows are ψ = 0 along two tangents, and n·Ω = 0 with Ω = ω_b − ω_a. n and p are
        normal and point of the plane; c, e and r are center, axis and radius of the cylinder.
        """
        height, *slip = RollingSphere.rows(p, a, b)
        n = a.direction(p["normal"])
        level = primitives.angle_between(n, b.direction(p["axis"]))
        # ψ = n·Ω with γ = ṅ·Ω = ṅ·ω_b, since ṅ = ω_a × n is normal to ω_a
        rate, pulls = n.position.dot(b.spin - a.spin), (-a.torque(n.position), b.torque(n.position))
        spin = Row(0.0, rate, n.velocity.dot(b.spin), pulls, holonomic=False)
        return [height, level, *slip, spin]


@dataclass(frozen=True)
class RollingDisc(Joint):
    """The rim of a thin disc or wheel rolls without slip: 2 rows in the plane, 3 in space.

    In space the disc with axis e may lean and turn. Its lowest point lies at ρ = −r s from its
    center c. Here s = (n − κ e)/σ is the direction in the disc nearest to n, with κ = n·e and
    σ = ‖n × e‖. The contact row is φ = n·(c − p) − r σ. In scenes in the plane the disc rolls on a
    line, with ρ = −r n. A disc that lies flat (σ = 0) touches everywhere; its rows then take the
    center as the contact point.

    Attributes:
        name: name of the element, unique in the scene.
        body_a: name of the body a with the plane or line, or `WORLD`.
        body_b: name of the disc.
        radius: r > 0 [m].
        axis: axis e of the disc, world frame at assembly, (3,), any length but zero; only in space.
        normal: normal n of the plane, towards the disc, world frame at assembly, (dim,); the last
            axis of the world unless given.
        center: center c of the disc, world frame at assembly, (dim,) [m]; the disc's center of mass
            unless given.
        point: a point p of the plane, world frame at assembly, (dim,) [m]; the contact point at
            assembly unless given.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972), chapter I.
    """

    radius: Any
    axis: Any = None
    normal: Any = None
    center: Any = None
    point: Any = None
    oriented = True
    turns = True
    ranges = POSITIVE_RADIUS
    in_b = ("axis",)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the plane in the frame of a, the center in the frame of b, and the radius.

        In space the result also has the disc's axis in the frame of b.
        """
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
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the contact row n·(c − p) − r σ = 0, and slip rows ψ = 0 along the tangents.

        n and p are normal and point of the plane, c and r center and radius of the disc. σ is the
        sine of the angle between n and the disc's axis, and 1 in the plane.
        """
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        height, r = plane.height(center), p["radius"]
        if "axis" not in p:
            row = plane.along(plane.tangents[0], center)  # Ω (ρ × t) = −r Ω
            rate = row.rate - r * (b.omega - a.omega)
            pulls = row.pulls[0] + a.turn(r), row.pulls[1] + b.turn(-r)
            slip = Row(0.0, rate, row.bias, pulls, holonomic=False)
            return [height._replace(value=height.value - r), slip]
        rim, ρ, ρ̇ = lowest(plane.normal, b.direction(p["axis"]), r)
        contact = primitives.difference(height, rim)
        return [contact, *(no_slip(a, b, plane, t, center, (ρ, ρ̇)) for t in plane.tangents)]


def no_slip(
    a: JointFrame,
    b: JointFrame,
    plane: Plane,
    t: Direction,
    center: Point,
    arm: tuple[Vector, Vector],
) -> Row:
    """Returns the slip row ψ = t·(ċ − v_a(c)) + Ω·(ρ × t) along a tangent t, in space.

    Args:
        a: motion of the body with the plane.
        b: motion of the rolling body.
        plane: the plane.
        t: the tangent.
        center: the point c of the rolling body.
        arm: the arm ρ from c to the contact, and its rate ρ̇.
    """
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


def lowest(n: Direction, e: Direction, r: Lane) -> tuple[Row, Vector, Vector]:
    """Returns the depth r σ of a disc's lowest point below its center, and the arm to that point.

    The depth is a row; the arm ρ = −r s [m] comes with its rate ρ̇. Here κ = n·e, σ = ‖n × e‖ and
    s = (n − κ e)/σ. From σ² = 1 − κ² follow σ σ̇ = −κ κ̇ and σ σ̈ = −κ̇² − κ κ̈ − σ̇². The
    derivative of σ s = n − κ e gives ṡ. At σ = 0 all results are zero.

    Args:
        n: the normal of the plane.
        e: the axis of the disc.
        r: the radius [m].
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


def touch(
    joint: RollingSphere | RollingCylinder | RollingDisc, a: Pose, b: Pose, reach: Lane = 1.0
) -> dict[str, Array]:
    """Returns radius, plane and center of a rolling element that touches its plane at assembly.

    Args:
        joint: the rolling element.
        a: pose of the body with the plane at assembly.
        b: pose of the rolling body at assembly.
        reach: the height of the center above the plane, in radii.

    Raises:
        ValueError: a field has a wrong shape.
    """
    radius = checks.real(label(joint), "radius", joint.radius, a.position.dtype)
    center, n = own_point(joint, "center", joint.center, b), normal(joint, a)
    contact = center - radius * reach * n if joint.point is None else joint.point
    point = own_point(joint, "point", contact, a)
    anchors = {"anchor_a": a.local_point(point), "anchor_b": b.local_point(center)}
    return surface(n, a) | anchors | {"radius": radius}


class Plane:
    """A plane or line fixed in a body, as lanes (element, …).

    Attributes:
        point: a point of the plane.
        normal: the unit normal; None if the rows do not need it.
        tangents: the unit tangents.
    """

    def __init__(self, p: dict[str, Any], a: JointFrame) -> None:
        self.point = a.point(p["anchor_a"])
        self.normal: Any = a.direction(p["normal"]) if "normal" in p else None
        self.tangents = [a.direction(p[side]) for side in ("first_a", "second_a") if side in p]

    def height(self, center: Point) -> Row:
        """Returns the row n·(c − p), the height of a point c above the plane.

        n is the normal and p the point of the plane.
        """
        return primitives.travel(self.normal, self.point, center)

    def along(self, tangent: Direction, center: Point) -> Row:
        """Returns the row of t·(c − p), the position of a point c along the tangent t.

        Its rate is the velocity of c relative to the plane along t.
        """
        return primitives.travel(tangent, self.point, center)


def normal(joint: RollingSphere | RollingCylinder | RollingDisc | KnifeEdge, a: Pose) -> Array:
    """Returns the unit normal of a joint's plane, world frame; the last world axis unless given."""
    if joint.normal is None:
        return jnp.eye(a.position.shape[0], dtype=a.position.dtype)[-1]
    return unit(joint, "normal", a)


def surface(n: Array, a: Pose) -> dict[str, Array]:
    """Returns the unit normal and the tangents of a plane in the frame of its body."""
    directions = zip(("normal", "first_a", "second_a"), basis(n), strict=False)
    return {name: a.local_direction(x) for name, x in directions}


@dataclass(frozen=True)
class KnifeEdge(Joint):
    """A blade moves along its edge and not sideways: 1 row in the plane, 2 in space.

    The slip row is ψ = m·(ċ − v_a(c)), the sideways velocity of the blade's point c over the ice.
    v_a(c) is the velocity of the point of a at c. In scenes in the plane, the plane is the
    ice, and m points to the left of the edge e. In space the point c also stays on the plane of the
    ice, φ = n·(c − p), and m = n × e / ‖n × e‖; the blade may lean and pitch. λ of ψ is the side
    force [N].

    Attributes:
        name: name of the element, unique in the scene.
        body_a: name of the body a with the ice, or `WORLD`.
        body_b: name of the skate, sleigh or vehicle.
        edge: direction e of the edge, world frame at assembly, (dim,), any length but zero.
        normal: normal n of the ice, towards the blade, world frame at assembly, (3,); z unless
            given; only in space.
        center: the contact point c of the blade, world frame at assembly, (dim,) [m]; the second
            body's center of mass unless given.
    """

    edge: Any
    normal: Any = None
    center: Any = None
    oriented = True
    in_b = ("edge",)
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the plane of the ice in a, and the contact point and the edge in b."""
        e, center = unit(self, "edge", b), own_point(self, "center", self.center, b)
        if a.position.shape == (3,):
            n = normal(self, a)
            if checks.is_concrete((e, n)) and float(numerics.norm(jnp.cross(e, n))) < PERPENDICULAR:
                raise ValueError(
                    f"{label(self)}: its edge {checks.numerals(e)} must not be the normal of the"
                    f" ice {checks.numerals(n)}, across which a blade points nowhere."
                )
            axes = surface(n, a)
        elif self.normal is None:
            axes = {
                "first_a": jnp.eye(2, dtype=e.dtype)[0],
                "second_a": jnp.eye(2, dtype=e.dtype)[1],
            }
        else:
            raise ValueError(f"{label(self)}: in the plane the ice is the scene; give no normal.")
        anchors = {"anchor_a": a.local_point(center), "anchor_b": b.local_point(center)}
        return axes | anchors | {"edge": b.local_direction(e)}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the slip row ψ = 0, and in space the contact row n·(c − p) = 0.

        e₁, e₂ are the components of the edge e along the tangents t of the plane, scaled to length
        one. V₁, V₂ are the rates of t·(c − p). Then ψ = e₁ V₂ − e₂ V₁. The edge turns in the plane
        at the rate χ, so that ė₁ = −e₂ χ and ė₂ = e₁ χ.
        """
        plane, center = Plane(p, a), b.point(p["anchor_b"])
        first, second = plane.tangents
        x, y = (primitives.angle_between(t, b.direction(p["edge"])) for t in (first, second))
        weight = numerics.safe_divide(1.0, numerics.norm(Vector(x.value, y.value)))
        e1, e2 = x.value * weight, y.value * weight
        χ = (e1 * y.rate - e2 * x.rate) * weight
        u, w = plane.along(first, center), plane.along(second, center)
        slip = Row(
            0.0,
            e1 * w.rate - e2 * u.rate,
            e1 * w.bias - e2 * u.bias - χ * (e1 * u.rate + e2 * w.rate),
            (w.pulls[0] * e1 - u.pulls[0] * e2, w.pulls[1] * e1 - u.pulls[1] * e2),
            holonomic=False,
        )
        return [slip] if "normal" not in p else [plane.height(center), slip]
