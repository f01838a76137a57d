"""The angles of two or three hinges in series between two bodies, and their rates.

From the first body to the second, hinges about n₁, n₂, n₃ turn one after the other, so that with
the axes h of assembly R = Exp(h₁ θ₁) Exp(h₂ θ₂) Exp(h₃ θ₃). n₁ is fixed in the first body, the last
axis in the second, and the axes need not be perpendicular.

References:
    Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), section 3.3.2:
    the subproblems of Paden and Kahan.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.primitives import Row
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose

IN_B = ("axis_2", "first_2", "second_2")
"""What two axes keep in the second body."""


def attach_two(axes: list[Array], a: Pose, b: Pose) -> dict[str, Array]:
    """Both axes, and in each body the directions between which the other one's axis turns."""
    n, m = axes
    n_across, m_across = m - jnp.dot(n, m) * n, n - jnp.dot(n, m) * m
    n_across, m_across = n_across / numerics.norm(n_across), m_across / numerics.norm(m_across)
    return {
        "axis_1": a.local_direction(n),
        "first_1": a.local_direction(n_across),
        "second_1": a.local_direction(jnp.cross(n, n_across)),
        "axis_2": b.local_direction(m),
        "first_2": b.local_direction(m_across),
        "second_2": b.local_direction(jnp.cross(m_across, m)),
        "cosine": jnp.dot(n, m),
    }


def two_rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
    """n₁·n₂ stays what it was at assembly."""
    row = primitives.angle_between(a.direction(p["axis_1"]), b.direction(p["axis_2"]))
    return [row._replace(value=row.value - p["cosine"])]


def two_angles(i: int, p: dict[str, Any], a: Any, b: Any) -> Row:
    """θ₁, by which n₂ has turned about n₁ in a, or θ₂, by which n₁ has turned back in b."""
    if i == 1:
        first, second = a.direction(p["first_1"]), a.direction(p["second_1"])
        return primitives.turn(first, second, b.direction(p["axis_2"]))
    first, second = b.direction(p["first_2"]), b.direction(p["second_2"])
    row = primitives.turn(first, second, a.direction(p["axis_1"]))
    return row._replace(pulls=row.pulls[::-1])


def attach_three(axes: list[Array], a: Pose, b: Pose) -> dict[str, Array]:
    """The axes of assembly in both bodies."""
    named = {f"axis_{i}": n for i, n in enumerate(axes, 1)}
    in_a = {f"{name}_a": a.local_direction(n) for name, n in named.items()}
    return in_a | {f"{name}_b": b.local_direction(n) for name, n in named.items()}


def three_angles(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
    """θ₁, θ₂, θ₃, on the dual basis of the axes: ω_b − ω_a = n₁ θ̇₁ + n₂ θ̇₂ + n₃ θ̇₃.

    With d₁ = n₂ × n₃ / (n₁·(n₂ × n₃)) and so on, θ̇ᵢ = dᵢ·(ω_b − ω_a). Differentiated,

        θ̈ᵢ = dᵢ·(ω̇_b − ω̇_a − ω_a × n₁ θ̇₁ − (ω_a + n₁ θ̇₁) × n₂ θ̇₂ − ω_b × n₃ θ̇₃),

    since n₁ turns with a, n₃ with b, and n₂ with what lies between the first two hinges. Where the
    axes fall into a plane (gimbal lock) there is no dual basis, and the rows are zero.
    """
    θ, n, spin = _angles(p, a, b)
    n_1, n_2, n_3 = n[0].position, n[1], n[2].position
    duals = Vector(n_2.cross(n_3), n_3.cross(n_1), n_1.cross(n_2))
    scale = numerics.safe_divide(1.0, n_1.dot(duals[0]))
    relative = b.spin - a.spin
    rates = [d.dot(relative) * scale for d in duals]
    between = (spin + n_1 * rates[0]).cross(n_2)
    drift = n[0].velocity * rates[0] + between * rates[1] + n[2].velocity * rates[2]
    scaled = [d * scale for d in duals]
    return [
        Row(angle, rate, -d.dot(drift), (a.torque(-d), b.torque(d)))
        for angle, rate, d in zip(θ, rates, scaled, strict=True)
    ]


def _angles(p: dict[str, Any], a: Any, b: Any) -> Any:
    """θ, the axes as they stand, and ω_a.

    n₁·n₃ = h₁·Exp(h₂ θ₂) h₃ gives θ₂; then n₃ has turned in a from Exp(h₂ θ₂) h₃ by θ₁ about n₁,
    and n₁ in b from Exp(−h₂ θ₂) h₁ by −θ₃ about n₃.
    """
    h_1, h_2, h_3 = (Vector.of(p[f"axis_{i}_a"]) for i in (1, 2, 3))
    first, last = a.direction(h_1), b.direction(p["axis_3_b"])
    middle = _middle(h_1, h_2, h_3, first.position.dot(last.position))
    start = a.direction(_turned(h_2, middle, h_3)).position
    end = b.direction(_turned(Vector.of(p["axis_2_b"]), -middle, Vector.of(p["axis_1_b"]))).position
    outer = _angle(first.position, start, last.position)
    inner = _angle(last.position, first.position, end)
    second = a.direction(_turned(h_1, outer, h_2)).position
    return (outer, middle, inner), (first, second, last), a.spin


def _middle(h_1: Vector, h_2: Vector, h_3: Vector, cosine: Lane) -> Lane:
    """The θ₂ with h₁·Exp(h₂ θ₂) h₃ = A + B cos θ₂ + C sin θ₂ = A + ρ cos(θ₂ − φ) of this value.

    Of the two solutions that between the gimbal locks that enclose θ₂ = 0.
    """
    fixed = h_1.dot(h_2) * h_2.dot(h_3)
    along, across = h_1.dot(h_3) - fixed, h_1.dot(h_2.cross(h_3))
    z = cosine - fixed
    lean = jnp.arctan2(numerics.safe_sqrt(along * along + across * across - z * z), z)
    return jnp.arctan2(across, along) - jnp.sign(across) * lean


def _turned(n: Vector, angle: Lane, x: Vector) -> Vector:
    """Exp(n θ) x = x cos θ + n × x sin θ + n (n·x)(1 − cos θ)."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return x * cos + n.cross(x) * sin + n * (n.dot(x) * (1 - cos))


def _angle(n: Vector, x: Vector, y: Vector) -> Lane:
    """By which x turns about n to lie over y."""
    return numerics.safe_arctan2(n.dot(x.cross(y)), x.dot(y) - n.dot(x) * n.dot(y))
