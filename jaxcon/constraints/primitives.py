"""The rows of which joints are composed, in closed form.

Each row is a scalar function φ of the bodies' positions. A row also has the rate φ̇, the part γ of
φ̈ without accelerations, and the gradient of φ on each body: the generalized force of a unit
multiplier. All follow by the product rule from points p and directions u fixed in the bodies, since
p̈ and ü split into a part linear in the accelerations a and a part without them:

    (u · w)¨  = ü·w + 2 u̇·ẇ + u·ẅ
    (u · d)¨  = ü·d + 2 u̇·ḋ + u·d̈,   d = p_b − p_a
    ‖d‖¨      = n·d̈ + (ḋ·ḋ − (n·ḋ)²)/‖d‖,   n = d/‖d‖

References:
    Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), section 9.4.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, axes, minus, plus, times
from jaxcon.core.typing import Lane
from jaxcon.geometry import quaternion
from jaxcon.system.frames import BodyFrame, Direction, Point


class JointFrame(BodyFrame, Protocol):
    """The interface by which joints read the motion of one body per joint, as lanes (element, …).

    `PlanarFrame` has `angle` and `laps`, `SpatialFrame` has `quaternion` and `spin`, and
    `WorldFrame` has all four.
    """

    @property
    def angle(self) -> Lane:
        """The angle of the body in the plane without `laps` whole turns [rad]."""
        ...

    @property
    def laps(self) -> Lane:
        """The number of whole turns to add to `angle`."""
        ...

    @property
    def quaternion(self) -> Vector:
        """The orientation of the body in space, a unit quaternion from body to world."""
        ...

    @property
    def omega(self) -> Any:
        """The angular velocity ω [rad/s]: a scalar in 2-D, a vector in the body frame in 3-D."""
        ...

    @property
    def spin(self) -> Vector:
        """The angular velocity of the body in space, world frame [rad/s]."""
        ...

    def torque(self, n: Vector) -> Vector:
        """Returns the generalized force of a torque n, given in the world frame [N m]; in space."""
        ...


class Row(NamedTuple):
    """One scalar row of many equal constraints, as lanes (element, …).

    Attributes:
        value, rate, bias: φ, φ̇ and γ (the part of φ̈ without accelerations), lanes (element,).
        pulls: ∂φ̇/∂v on each body, the generalized force of a unit multiplier.
        holonomic: True if the row has a φ. Otherwise the row is ψ(q, v, t) = 0, with the value zero
            and the rate ψ.
        reduced: for an angle, φ without whole turns and the number of turns; None if unknown. A
            large φ is rounded, so differences of large angles are computed from these two.
        swing: for a rod, the squared angular rate of its direction [rad²/s²].
        compliance: C of J a + C λ = b, a lane (element,); None if it is zero.
    """

    value: Lane
    rate: Lane
    bias: Lane
    pulls: tuple[Vector, ...]
    holonomic: bool = True
    reduced: tuple[Lane, Lane] | None = None
    swing: Lane | None = None
    compliance: Lane | None = None


def meet(p: Point, r: Point) -> list[Row]:
    """Returns the rows of r − p = 0, one row for each world axis.

    Args:
        p: point of the first body.
        r: point of the second body.
    """
    d, ḋ, bias = r.position - p.position, r.velocity - p.velocity, r.bias - p.bias
    return [Row(d[i], ḋ[i], bias[i], (-p.pull(e), r.pull(e))) for i, e in enumerate(axes(len(d)))]


def angle_between(u: Direction, w: Direction) -> Row:
    """Returns the row of u · w, the cosine of the angle between two directions.

    Args:
        u: direction of the first body, a unit vector.
        w: direction of the second body, a unit vector.
    """
    return Row(
        u.position.dot(w.position),
        plus(u.velocity.dot(w.position), u.position.dot(w.velocity)),
        plus(
            plus(u.bias.dot(w.position), u.position.dot(w.bias)),
            times(2, u.velocity.dot(w.velocity)),
        ),
        (u.pull(w.position), w.pull(u.position)),
    )


def difference(x: Row, y: Row) -> Row:
    """Returns the row of φ_x − φ_y, the difference of two rows."""
    pulls = (x.pulls[0] - y.pulls[0], x.pulls[1] - y.pulls[1])
    return Row(x.value - y.value, x.rate - y.rate, x.bias - y.bias, pulls)


def travel(u: Direction, p: Point, r: Point) -> Row:
    """Returns the row of u · (r − p): the position of r from p along a direction u of p's body.

    Args:
        u: direction of the first body, a unit vector.
        p: point of the first body.
        r: point of the second body.
    """
    d, ḋ, bias = r.position - p.position, r.velocity - p.velocity, r.bias - p.bias
    return Row(
        u.position.dot(d),
        plus(u.velocity.dot(d), u.position.dot(ḋ)),
        plus(plus(u.bias.dot(d), u.position.dot(bias)), times(2, u.velocity.dot(ḋ))),
        (u.pull(d) - p.pull(u.position), r.pull(u.position)),
    )


def distance(p: Point, r: Point, length: Lane) -> Row:
    """Returns the row of ‖r − p‖ − l, the distance of two points less a length l.

    If the points coincide, the row has no direction, and its pulls are zero.

    Args:
        p: point of the first body.
        r: point of the second body.
        length: l, lanes (element,) [m].
    """
    d, ḋ = r.position - p.position, r.velocity - p.velocity
    span = numerics.norm(d)
    inverse = numerics.safe_divide(1.0, span)
    n = d * inverse
    speed = n.dot(ḋ)
    across = ḋ.dot(ḋ) - speed * speed
    # not across / span: the derivative of this quotient overflows in float32
    bias = n.dot(r.bias - p.bias) + across * inverse
    swing = across * inverse * inverse
    return Row(span - length, speed, bias, (-p.pull(n), r.pull(n)), swing=swing)


def same_orientation(a: JointFrame, b: JointFrame, reference: Vector | Lane) -> list[Row]:
    """Returns the rows that keep b's orientation relative to a: one in the plane, three in space.

    In the plane φ = θ_b − θ_a − θ₀, with θ₀ the relative angle at assembly. In space e = q_a* q_b
    q₀* is the rotation error, with q₀ the relative orientation at assembly. Then φ = 2 vec(e), with
    the sign of e chosen so that its scalar part is positive. With ω̃ = q₀ ω_b q₀* and ė = ½(e ω̃ −
    ω_a e),

        φ̇ = vec(e ω̃ − ω_a e) = e₀ (ω̃ − ω_a) + e⃗ × (ω̃ + ω_a),   γ = vec(ė ω̃ − ω_a ė).

    Components are along a's axes, so the rows turn with the joint and no frame is preferred.

    Args:
        a: motion of the first body.
        b: motion of the second body.
        reference: θ₀ [rad] in the plane, the quaternion q₀ in space.
    """
    if not isinstance(reference, Vector):
        value = b.angle - a.angle - reference
        laps = minus(b.laps, a.laps)
        row = Row(value, b.omega - a.omega, 0.0, (a.turn(-1.0), b.turn(1.0)))
        if isinstance(laps, float):
            return [row]
        return [row._replace(value=value + 2 * jnp.pi * laps, reduced=(value, laps))]
    relative = quaternion.multiply(quaternion.conjugate(a.quaternion), b.quaternion)
    e = quaternion.multiply(relative, quaternion.conjugate(reference))
    e = e * jnp.where(e[0] < 0, -1.0, 1.0).astype(e[0].dtype)
    to_a = quaternion.rotation(reference)
    ω_a, ω_b = a.omega, to_a @ b.omega
    ė = _rate(e, ω_a, ω_b) * 0.5
    φ̇, γ = _rate(e, ω_a, ω_b)[1:], _rate(ė, ω_a, ω_b)[1:]
    scalar, vector = quaternion.split(e)
    return [
        Row(
            times(2, e[1 + i]),
            φ̇[i],
            γ[i],
            # n·φ̇ = (e₀ n − e⃗ × n)·ω̃ − (e₀ n + e⃗ × n)·ω_a for the axis n of the row
            (
                a.turn(-(n * scalar + vector.cross(n))),
                b.turn(to_a.T @ (n * scalar - vector.cross(n))),
            ),
        )
        for i, n in enumerate(axes(3))
    ]


def _rate(e: Vector, ω_a: Vector, ω_b: Vector) -> Vector:
    """Returns e ω_b − ω_a e, twice the rate of the rotation error e, as a quaternion."""
    right = quaternion.multiply(e, Vector(0.0, *ω_b))
    return right - quaternion.multiply(Vector(0.0, *ω_a), e)


def turn(first: Direction, second: Direction, pointer: Direction) -> Row:
    """Returns the row of the angle from `first` to `pointer`, in [−π, π].

    The pointer is a direction of b. `first` and `second` are perpendicular directions of a. The
    angle is measured in their plane, and positive from `first` towards `second`.
    """
    return bearing(angle_between(first, pointer), angle_between(second, pointer))


def bearing(c: Row, s: Row) -> Row:
    """Returns the row of the angle θ = atan2(s, c) in [−π, π], for the rows of c and s.

    The rate is θ̇ = (c ṡ − s ċ)/(c² + s²). The bias, the part of θ̈ without accelerations, is

        (c s̈ − s c̈)/(c² + s²) − 2 θ̇ (c ċ + s ṡ)/(c² + s²)

    with c̈ and s̈ the biases of c and s.
    """
    # divide twice by √(c² + s²): the derivative of 1/(c² + s²) overflows in float32 if c² + s² is
    # 1e-10
    inverse = numerics.safe_divide(1.0, numerics.norm(Vector(c.value, s.value)))
    along, across = c.value * inverse * inverse, s.value * inverse * inverse
    rate = along * s.rate - across * c.rate
    radial = along * c.rate + across * s.rate
    bias = along * s.bias - across * c.bias - 2 * rate * radial
    pulls = [y * along - x * across for x, y in zip(c.pulls, s.pulls, strict=True)]
    return Row(numerics.safe_arctan2(s.value, c.value), rate, bias, (pulls[0], pulls[1]))
