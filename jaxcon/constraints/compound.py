"""Several sliders and hinges in series between two bodies, as one joint.

From the first body to the second, hinges about the axes n₁, n₂, n₃ turn one after the other by
θ₁, θ₂, θ₃. The first axis is fixed in the first body and the last axis in the second body. Axes
need not be perpendicular. With hᵢ the axes at assembly, the relative rotation is
R = Exp(h₁ θ₁) Exp(h₂ θ₂) Exp(h₃ θ₃).

References:
    Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), section 3.3.2:
    the subproblems of Paden and Kahan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import primitives
from jaxcon.constraints.base import Joint
from jaxcon.constraints.joints import anchors, basis, normals, relative_orientation, unit_vector
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import Element, label

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

DEPENDENT = 1e-6
"""The volume spanned by unit axes below which the axes count as linearly dependent."""


@dataclass(frozen=True)
class Freedoms(Element):
    """The rows and coordinates of compound joints with given numbers of slides and hinges.

    Attributes:
        slides, hinges: the numbers of slides and of hinges, at most three each.
        ball: True if the bodies turn freely relative to each other.
    """

    slides: int
    hinges: int
    ball: bool
    in_b = ("axis_2", "first_2", "second_2")
    relative = True

    @property
    def coordinates(self) -> dict[str, str]:
        """The unit of each coordinate by its name: "travel_1", … [m], then "angle_1", … [rad]."""
        travels = {f"travel_{i + 1}": "m" for i in range(self.slides)}
        return travels | {f"angle_{i + 1}": "rad" for i in range(self.hinges)}

    def rows(self, p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows: no travel normal to the slides, and no turn except about the hinges."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        if not self.slides:
            rows = primitives.meet(*points)
        else:
            across = [p[f"normal_{i + 1}"] for i in range(3 - self.slides)]
            rows = [primitives.travel(a.direction(n), *points) for n in across]
        if self.ball or self.hinges == 3:
            return rows
        if not self.hinges:
            return rows + primitives.same_orientation(a, b, p["orientation"])
        if self.hinges == 2:
            row = primitives.angle_between(a.direction(p["axis_1"]), b.direction(p["axis_2"]))
            return [*rows, row._replace(value=row.value - p["cosine"])]
        n = a.direction(p["axis_1"])
        sides = (b.direction(p["first_b"]), b.direction(p["second_b"]))
        return rows + [primitives.angle_between(n, u) for u in sides]

    def coordinate_rows(
        self, name: str, p: dict[str, Any], a: JointFrame, b: JointFrame
    ) -> dict[str, Row]:
        """Returns the row of a travel since assembly [m], or of an angle about a hinge [rad].

        For three hinges the result has the rows of all three angles, since they share a
        computation.
        """
        if self.hinges == 3 and name.startswith("angle"):
            angles = three_angles(p, a, b)
            return {f"angle_{i}": row for i, row in enumerate(angles, 1)}
        kind, _, index = name.partition("_")
        if kind == "travel":
            points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
            return {name: primitives.travel(a.direction(p[name]), *points)}
        if self.hinges == 2:
            return {name: two_angles(int(index), p, a, b)}
        first, second = a.direction(p["first_1"]), a.direction(p["second_1"])
        return {name: primitives.turn(first, second, b.direction(p["first_b"]))}


@dataclass(frozen=True)
class Compound(Joint):
    """Up to three slides, then up to three hinges through one point, in series; in space.

    The point of b slides along the axes of the slides, which move with a. b turns about the hinges
    one after the other; the first is fixed in a, the last in b. Axes need not be perpendicular. No
    massless bodies are added between a and b. The joint has 6 rows less its degrees of freedom.

    Its coordinates are "travel_1", …, "angle_1", …, in the order of the axes. Springs, motors and
    other elements act on each by name. The middle angle of three hinges lies between the two
    positions at which the axes lie in one plane (gimbal lock; ±90° for perpendicular axes). At
    these positions the rates of the angles are undefined and returned as zero.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies a and b, or `WORLD`.
        point: the common point of all hinges, world frame at assembly, (3,) [m]; the second body's
            center of mass unless given.
        slides: axes of the slides, world frame at assembly, each (3,), any length but zero;
            linearly independent.
        hinges: axes of the hinges, world frame at assembly, each (3,). Two successive axes must not
            be parallel, and three must not lie in one plane.
        ball: True for a ball joint in place of hinges: b turns freely, without angle coordinates.
    """

    point: Any = None
    slides: tuple[Any, ...] = ()
    hinges: tuple[Any, ...] = ()
    ball: bool = False
    oriented = True
    dims = (3,)

    def __post_init__(self) -> None:
        checks.flag(label(self), "ball", self.ball)

    @property
    def kind(self) -> Freedoms:
        """The numbers of slides and hinges, by which compound joints are grouped."""
        return Freedoms(len(self.slides), len(self.hinges), self.ball)

    @property
    def coordinates(self) -> dict[str, str]:  # type: ignore[override]
        """The unit of each coordinate by its name."""
        return self.kind.coordinates

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the numbers of the joint by field.

        They are the point in the frames of both bodies, and for slides the directions along which
        travels are measured, with the normals of the slides. For hinges, they are the hinge axes
        and, for one or two hinges, the directions from which the angles are measured. A joint with
        neither hinges nor `ball` has the orientation of b in a.

        Raises:
            ValueError: there are more than three axes, or they are linearly dependent.
        """
        slides, hinges = self._axes("slides", self.slides, a), self._axes("hinges", self.hinges, a)
        if self.ball and hinges:
            raise ValueError(f"{label(self)}: a ball joint turns freely; give hinges or ball.")
        params = anchors(self, a, b) | self._travels(slides, a)
        if len(hinges) == 3:
            return params | attach_three(hinges, a, b)
        if len(hinges) == 2:
            return params | attach_two(hinges, a, b)
        if len(hinges) == 1:
            n, u, w = basis(hinges[0])
            in_a = {"axis_1": n, "first_1": u, "second_1": w}
            params |= {key: a.local_direction(x) for key, x in in_a.items()}
            return params | {"first_b": b.local_direction(u), "second_b": b.local_direction(w)}
        return params if self.ball else params | {"orientation": relative_orientation(a, b)}

    def _travels(self, slides: list[Array], a: Pose) -> dict[str, Array]:
        """Returns the dual basis and the normals of the slides s_j, in the frame of a.

        The vectors d_i of the dual basis lie in the span of the slides, and d_i·s_j = δ_ij. For a
        displacement x in this span, d_i·x is the travel along s_i. The normals are unit vectors
        normal to the span.
        """
        if not slides:
            return {}
        across = normals(slides[0]) if len(slides) == 1 else []
        if len(slides) == 2:
            n = jnp.cross(slides[0], slides[1])
            across = [n / jnp.sqrt(jnp.dot(n, n))]
        x, y, z = *slides, *across
        volume = jnp.dot(x, jnp.cross(y, z))
        duals = (jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y))[: len(slides)]
        travels = {f"travel_{i}": a.local_direction(d / volume) for i, d in enumerate(duals, 1)}
        return travels | {f"normal_{i}": a.local_direction(n) for i, n in enumerate(across, 1)}

    def _axes(self, what: str, given: tuple[Any, ...], pose: Pose) -> list[Array]:
        """Checks the axes of slides or hinges; returns them as unit vectors.

        Raises:
            ValueError: there are more than three axes, or they are linearly dependent.
        """
        if not isinstance(given, tuple) or len(given) > 3:
            raise ValueError(
                f"{label(self)}: {what} must be a tuple of at most 3 axes, got {given!r}."
            )
        axes = [unit_vector(self, f"{what}[{i}]", x, pose) for i, x in enumerate(given)]
        if checks.is_concrete(axes):
            few = np.array(axes, float).reshape(-1, 3)
            volume = np.sqrt(max(np.linalg.det(few @ few.T), 0.0))
            if volume < DEPENDENT:
                raise ValueError(
                    f"{label(self)}: its {what} must have independent axes, got"
                    f" {checks.numerals(few)}."
                )
        return axes


def attach_two(axes: list[Array], a: Pose, b: Pose) -> dict[str, Array]:
    """Returns both hinge axes n and m, n·m, and the directions from which angles are measured.

    The first axis and its directions are in the frame of a, the second axis and its directions in
    the frame of b.
    """
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


def two_angles(i: int, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
    """Returns the row of θ₁, the turn of axis n₂ about n₁ in a, or of θ₂, the turn of b about n₂.

    θ₂ is measured in b, where n₁ turns about n₂ by −θ₂.
    """
    if i == 1:
        first, second = a.direction(p["first_1"]), a.direction(p["second_1"])
        return primitives.turn(first, second, b.direction(p["axis_2"]))
    first, second = b.direction(p["first_2"]), b.direction(p["second_2"])
    row = primitives.turn(first, second, a.direction(p["axis_1"]))
    return row._replace(pulls=row.pulls[::-1])


def attach_three(axes: list[Array], a: Pose, b: Pose) -> dict[str, Array]:
    """Returns the three hinge axes at assembly in the frames of both bodies."""
    named = {f"axis_{i}": n for i, n in enumerate(axes, 1)}
    in_a = {f"{name}_a": a.local_direction(n) for name, n in named.items()}
    return in_a | {f"{name}_b": b.local_direction(n) for name, n in named.items()}


def three_angles(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
    """Returns the rows of the hinge angles θ₁, θ₂, θ₃, by the dual basis of the hinge axes.

    The relative angular velocity is ω_b − ω_a = n₁ θ̇₁ + n₂ θ̇₂ + n₃ θ̇₃. With the dual basis
    d₁ = n₂ × n₃ / (n₁·(n₂ × n₃)) and so on, the rates are θ̇ᵢ = dᵢ·(ω_b − ω_a). Differentiated,

        θ̈ᵢ = dᵢ·(ω̇_b − ω̇_a − ω_a × n₁ θ̇₁ − (ω_a + n₁ θ̇₁) × n₂ θ̇₂ − ω_b × n₃ θ̇₃),

    since n₁ turns with a, n₃ with b, and n₂ with the link between the first two hinges. If the axes
    lie in one plane (gimbal lock), there is no dual basis, and rates, biases and pulls are zero.
    """
    θ, n, spin = _angles(p, a, b)
    n_1, n_2, n_3 = n[0].position, n[1], n[2].position
    duals = n_2.cross(n_3), n_3.cross(n_1), n_1.cross(n_2)
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


def _angles(p: dict[str, Any], a: JointFrame, b: JointFrame) -> Any:
    """Returns the hinge angles (θ₁, θ₂, θ₃), the current axes n₁, n₂, n₃, and ω_a of body a.

    Here hᵢ are the axes at assembly. n₁·n₃ = h₁·Exp(h₂ θ₂) h₃ gives θ₂. Seen from a, n₃ has then
    turned from Exp(h₂ θ₂) h₃ by θ₁ about n₁. Seen from b, n₁ has turned from Exp(−h₂ θ₂) h₁ by −θ₃
    about n₃.
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
    """Returns the middle angle θ₂ for a given cosine n₁·n₃ between the outer axes.

    θ₂ solves h₁·Exp(h₂ θ₂) h₃ = A + B cos θ₂ + C sin θ₂ = A + ρ cos(θ₂ − φ) = n₁·n₃, with the axes
    hᵢ at assembly. Of its two solutions the function returns the one in the same interval between
    gimbal locks as θ₂ = 0.
    """
    fixed = h_1.dot(h_2) * h_2.dot(h_3)
    along, across = h_1.dot(h_3) - fixed, h_1.dot(h_2.cross(h_3))
    z = cosine - fixed
    lean = numerics.safe_arctan2(numerics.safe_sqrt(along * along + across * across - z * z), z)
    return numerics.safe_arctan2(across, along) - jnp.sign(across) * lean


def _turned(n: Vector, angle: Lane, x: Vector) -> Vector:
    """Returns the vector x turned by θ about the unit vector n.

    Rodrigues' formula is Exp(n θ) x = x cos θ + n × x sin θ + n (n·x)(1 − cos θ).
    """
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return x * cos + n.cross(x) * sin + n * (n.dot(x) * (1 - cos))


def _angle(n: Vector, x: Vector, y: Vector) -> Lane:
    """Returns the angle about n from x to y, both projected onto the plane normal to n [rad]."""
    return numerics.safe_arctan2(n.dot(x.cross(y)), x.dot(y) - n.dot(x) * n.dot(y))
