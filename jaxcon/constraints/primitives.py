"""The rows from which joints are made, in closed form.

Each row is a scalar function φ of the bodies' positions with its rate φ̇, the part γ of φ̈ that holds
no acceleration, and its gradient on each body: the generalized force of a unit multiplier. They
follow from points p and directions u fixed in the bodies by the product rule alone, since p̈ and ü
split into a part linear in a and a part without it:

    (u · w)¨  = ü·w + 2 u̇·ẇ + u·ẅ
    (u · d)¨  = ü·d + 2 u̇·ḋ + u·d̈,   d = p_b − p_a
    ‖d‖¨      = n·d̈ + (ḋ·ḋ − (n·ḋ)²)/‖d‖,   n = d/‖d‖

References:
    Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems (1989), section 9.4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, axes, minus, plus, times
from jaxcon.core.typing import Lane
from jaxcon.geometry import quaternion
from jaxcon.model.frames import Direction, Point


class Row(NamedTuple):
    """One scalar row of many equal constraints.

    Attributes:
        value, rate, bias: φ, φ̇, γ, lanes (element,).
        pulls: ∂φ̇/∂v on each body.
        holonomic: whether there is a φ; without one the row is ψ(q, v, t) = 0, value zero, rate ψ.
        reduced: the angle φ less whole turns, and these turns, where both are known: a large φ is
            rounded, and differences of large angles are computed from these.
        swing: of a rod, the square of the rate at which its direction turns [rad²/s²].
    """

    value: Lane
    rate: Lane
    bias: Lane
    pulls: tuple[Vector, ...]
    holonomic: bool = True
    reduced: tuple[Lane, Lane] | None = None
    swing: Lane | None = None


def meet(p: Point, r: Point) -> list[Row]:
    """r − p = 0 in the world frame: as many rows as the space has dimensions."""
    d, ḋ, bias = r.position - p.position, r.velocity - p.velocity, r.bias - p.bias
    return [Row(d[i], ḋ[i], bias[i], (-p.pull(e), r.pull(e))) for i, e in enumerate(axes(len(d)))]


def angle_between(u: Direction, w: Direction) -> Row:
    """u · w, the cosine of the angle between two directions."""
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
    """φ_x − φ_y."""
    pulls = (x.pulls[0] - y.pulls[0], x.pulls[1] - y.pulls[1])
    return Row(x.value - y.value, x.rate - y.rate, x.bias - y.bias, pulls)


def travel(u: Direction, p: Point, r: Point) -> Row:
    """u · (r − p): how far r lies from p along a direction of p's body."""
    d, ḋ, bias = r.position - p.position, r.velocity - p.velocity, r.bias - p.bias
    return Row(
        u.position.dot(d),
        plus(u.velocity.dot(d), u.position.dot(ḋ)),
        plus(plus(u.bias.dot(d), u.position.dot(bias)), times(2, u.velocity.dot(ḋ))),
        (u.pull(d) - p.pull(u.position), r.pull(u.position)),
    )


def distance(p: Point, r: Point, length: Lane) -> Row:
    """‖r − p‖ − l; at ‖r − p‖ = 0 the row has no direction and is zero."""
    d, ḋ = r.position - p.position, r.velocity - p.velocity
    span = numerics.norm(d)
    inverse = numerics.safe_divide(1.0, span)
    n = d * inverse
    speed = n.dot(ḋ)
    across = ḋ.dot(ḋ) - speed * speed
    # the derivative of a quotient would multiply this by that of the span, beyond float32
    bias = n.dot(r.bias - p.bias) + across * inverse
    swing = across * inverse * inverse
    return Row(span - length, speed, bias, (-p.pull(n), r.pull(n)), swing=swing)


def same_orientation(a: Any, b: Any, reference: Any) -> list[Row]:
    """b keeps the orientation that it has in a at assembly: one row in the plane, three in space.

    In the plane φ = θ_b − θ_a − θ₀. In space e = q_a* q_b q₀* is the turn still left, and
    φ = 2 vec(e), the sign of e chosen so that its scalar part is positive. From ė = ½(e ω̃ − ω_a e)
    with ω̃ = q₀ ω_b q₀*,

        φ̇ = vec(e ω̃ − ω_a e) = e₀ (ω̃ − ω_a) + e⃗ × (ω̃ + ω_a),   γ = vec(ė ω̃ − ω_a ė).

    Components are along a's axes, so the rows turn with the joint and prefer no frame.
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
    """e ω_b − ω_a e, twice the rate of the turn e."""
    right = quaternion.multiply(e, Vector(0.0, *ω_b))
    return right - quaternion.multiply(Vector(0.0, *ω_a), e)


def turn(first: Direction, second: Direction, pointer: Direction) -> Row:
    """The angle of a pointer of b in the plane of two directions of a, in [−π, π]."""
    return bearing(angle_between(first, pointer), angle_between(second, pointer))


def bearing(c: Row, s: Row) -> Row:
    """θ = atan2(s, c) of two rows, in [−π, π].

    θ̇ = (c ṡ − s ċ)/(c² + s²), and its own rate without a is
    (c s̈ − s c̈)/(c² + s²) − 2 θ̇ (c ċ + s ṡ)/(c² + s²). It is divided by the root of c² + s² twice:
    the derivative of 1/(c² + s²) would overflow in float32 where the root is 1e-10.
    """
    inverse = numerics.safe_divide(1.0, numerics.norm(Vector(c.value, s.value)))
    along, across = c.value * inverse * inverse, s.value * inverse * inverse
    rate = along * s.rate - across * c.rate
    radial = along * c.rate + across * s.rate
    bias = along * s.bias - across * c.bias - 2 * rate * radial
    pulls = [y * along - x * across for x, y in zip(c.pulls, s.pulls, strict=True)]
    return Row(numerics.safe_arctan2(s.value, c.value), rate, bias, (pulls[0], pulls[1]))
