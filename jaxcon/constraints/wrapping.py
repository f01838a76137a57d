"""Spans that wrap around a sphere or a cylinder of a third body.

In the frame of the surface, the ends x₀ and x₁ of a span are projected to a plane: normal to the
cylinder, or through both ends and the center of the sphere. They lie at distances r₀ and r₁ from
the center of a circle of radius R, with the angle θ between them. The length in the plane is

    L = √(r₀² − R²) + R γ + √(r₁² − R²),   γ = θ − arccos R/r₀ − arccos R/r₁,

where γ is the angle of the arc on which the span touches the circle. Along a cylinder the length is
ℓ = √(L² + Δz²), since the shortest path is straight on the unrolled surface. The gradient of ℓ by
x₀ is minus the unit vector along the span at x₀. If γ < 0, the straight line misses the circle, and
the span is straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.base import Joint
from jaxcon.constraints.couplings import combination
from jaxcon.constraints.joints import basis, unit_vector
from jaxcon.constraints.primitives import Row, travel
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector, total
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import label, own_point

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

LOCAL = ("first_c", "second_c", "axis_c")
"""The axes of the frame of the surface; the last one is the axis of a cylinder."""
SIDES = ((2, 0),) * 3 + ((2, 1),) * 3
"""The bodies of the components of both ends in the frame of the surface."""


@dataclass(frozen=True)
class WrappedSpan(Joint):
    """Two points and a line between them, in space, that wraps around a sphere or a cylinder.

    It has no rows and one coordinate, "stretch" = ℓ − ℓ₀, with the length ℓ of the line and its
    length ℓ₀ at assembly. Other elements act on it through a `Tendon`. The line takes the shorter
    way around the surface. It is straight where it does not meet the surface, and if an end is
    within the surface. The second derivative of the length jumps where the line begins to wrap.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies of the two points, or `WORLD`.
        body_c: name of the body with the surface, or `WORLD`; it may also be body_a or body_b.
        radius: R > 0 [m].
        center: the center of the sphere, or a point on the axis of the cylinder, world frame at
            assembly, (3,) [m]; the position of body_c unless given.
        axis: the axis of the cylinder, world frame at assembly, (3,); None for a sphere.
        point_a, point_b: world points at assembly, (3,) [m]; the centers of mass unless given.

    References:
        MuJoCo documentation, Computation, Actuation model: spatial tendons.
    """

    body_c: str
    radius: Any
    center: Any = None
    axis: Any = None
    point_a: Any = None
    point_b: Any = None
    dims = (3,)
    coordinates = MappingProxyType({"stretch": "m"})
    ranges = MappingProxyType({"radius": checks.NumberRange(above=0)})
    repeats: ClassVar[bool] = True
    relative: ClassVar[bool] = True

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies of both points and of the surface."""
        return (self.body_a, self.body_b, self.body_c)

    @property
    def kind(self) -> type[WrappedSpan]:
        """The class by which spans are grouped: around spheres, or around cylinders."""
        return AroundSphere if self.axis is None else AroundCylinder

    def attach(  # type: ignore[override]
        self, a: Pose, b: Pose, c: Pose
    ) -> dict[str, Array]:
        """Returns the points and the surface in the frames of their bodies, and the length."""
        owner, dtype = label(self), a.position.dtype
        start = own_point(self, "point_a", self.point_a, a)
        end = own_point(self, "point_b", self.point_b, b)
        center = own_point(self, "center", self.center, c)
        upright = jnp.eye(3, dtype=dtype)[2] if self.axis is None else self.axis
        n, u, w = basis(unit_vector(self, "axis", upright, c))
        axes = (u, w, n)
        numbers = {
            "anchor_a": a.local_point(start),
            "anchor_b": b.local_point(end),
            "anchor_c": c.local_point(center),
            "radius": checks.real(owner, "radius", self.radius, dtype),
            **{field: c.local_direction(x) for field, x in zip(LOCAL, axes, strict=True)},
        }
        start, end = (Vector(*(x @ (p - center) for x in axes)) for p in (start, end))
        length, _ = path((start, end), numbers["radius"], self.kind.cylinder)
        return numbers | {"length": length}

    cylinder: ClassVar[bool] = False

    @staticmethod
    def rows(  # type: ignore[override]
        p: dict[str, Any], a: JointFrame, b: JointFrame, c: JointFrame
    ) -> list[Row]:
        """Returns an empty list: a span constrains nothing."""
        return []

    @classmethod
    def coordinate_rows(  # type: ignore[override]
        cls, name: str, p: dict[str, Any], a: JointFrame, b: JointFrame, c: JointFrame
    ) -> dict[str, Row]:
        """Returns the row of the stretch, with pulls on both points and on the surface.

        With the components x of both ends in the frame of the surface, its rate is ∇ℓ·ẋ, and the
        curvature ẋᵀ ∇²ℓ ẋ is part of its bias.
        """
        center, axes = c.point(p["anchor_c"]), [c.direction(p[field]) for field in LOCAL]
        ends = (a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        rows = [travel(u, center, end) for end in ends for u in axes]
        like = 0 * total(row.value for row in rows)
        x, ẋ = (
            Vector(*(like + getattr(row, field) for row in rows)) for field in ("value", "rate")
        )

        def gradient(x: Vector) -> tuple[Vector, Lane]:
            """Returns ∇ℓ, and ℓ."""
            ends = Vector(*x[:3]), Vector(*x[3:])
            length, slope = path(ends, p["radius"], cls.cylinder)
            return slope, length

        slope, change, length = jax.jvp(gradient, (x,), (ẋ,), has_aux=True)
        row = combination(length - p["length"], tuple(slope), rows, SIDES, 3)
        return {name: row._replace(bias=row.bias + change.dot(ẋ))}


class AroundSphere(WrappedSpan):
    """The class of a group of spans around spheres."""

    relative = True


class AroundCylinder(WrappedSpan):
    """The class of a group of spans around cylinders."""

    cylinder = True
    relative = True


def path(ends: tuple[Vector, Vector], radius: Lane, cylinder: bool) -> tuple[Array, Vector]:
    """Returns the length ℓ of a span, and its gradient by both ends (6 components).

    Args:
        ends: x₀ and x₁ in the frame of the surface.
        radius: R [m].
        cylinder: True for a cylinder along z, False for a sphere.
    """
    apart = ends[1] - ends[0]
    straight = numerics.norm(apart)
    line = apart * numerics.safe_divide(1.0, straight)
    u, w = (Vector(*x[:2]) for x in ends) if cylinder else ends
    across = u.cross(w)
    sine = jnp.abs(across) if cylinder else numerics.norm(across)
    found = tangent(u, w, radius), tangent(w, u, radius)
    angle = numerics.safe_arctan2(sine, u.dot(w)) - found[0].angle - found[1].angle
    wraps = found[0].outside & found[1].outside & (angle > 0)
    flat = found[0].length + radius * angle + found[1].length
    rise = apart[2] if cylinder else 0.0
    wrapped = numerics.norm(Vector(flat, rise)) if cylinder else flat
    share, climb = (numerics.safe_divide(x, wrapped) for x in (flat, rise))
    slopes: list[Lane] = []
    for sign, point in zip((1, -1), found, strict=True):
        inplane = point.direction * -share
        slopes += (*inplane, -sign * climb) if cylinder else inplane
    plain = (*(-line), *line)
    chosen = [jnp.where(wraps, x, y) for x, y in zip(slopes, plain, strict=True)]
    return jnp.where(wraps, wrapped, straight), Vector(*chosen)


class Tangent(NamedTuple):
    """The tangent from a point at the distance r to a circle of radius R.

    Attributes:
        outside: True if the point is outside of the circle.
        length: √(r² − R²), the distance from the point to the point of contact.
        angle: arccos R/r, the angle between both, seen from the center.
        direction: the unit vector from the point to the point of contact.
    """

    outside: Any
    length: Lane
    angle: Lane
    direction: Vector


def tangent(x: Vector, other: Vector, radius: Lane) -> Tangent:
    """Returns the tangent from a point to a circle about the origin.

    Of the two tangents, it is the one on the side of another point.

    Args:
        x: the point.
        other: the other point, which spans the plane with x and the origin.
        radius: the radius R of the circle.
    """
    square = x.dot(x)
    length = numerics.safe_sqrt(square - radius * radius)
    inverse = numerics.safe_divide(1.0, numerics.norm(x))
    outward = x * inverse
    aside = numerics.unit(other - outward * other.dot(outward))
    direction = aside * (radius * inverse) - outward * (length * inverse)
    outside = square >= radius * radius
    return Tangent(outside, length, numerics.safe_arctan2(length, radius), direction)
