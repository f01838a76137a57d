"""Contact with friction: what touches where, and the rows of a touch.

Candidate pairs are chosen when the scene is built; which of them touch is data. Every pair answers
one question: its gap, the normal from the first body to the second, and where they touch. The rows
follow from that alone (`touching`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.bounds import BoundSet
from jaxcon.constraints.joints import stretched, unit_vector
from jaxcon.constraints.limits import one_sided, stop
from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.point_sets import given_points, own_points, spread, spread_place
from jaxcon.constraints.primitives import Row, distance
from jaxcon.constraints.ranges import Ranged
from jaxcon.constraints.touching import MATERIAL, Touch, material, touching
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, own_point


@dataclass(frozen=True)
class Rope:
    """Two points are no farther apart than a length, φ = l − ‖p_b − p_a‖ ≥ 0; λ is the tension.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        length: l > 0 [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (dim,) [m]; the centres of mass unless given.
        restitution: e, 0 to 1, of the jerk when the rope goes taut.
        stiffness: k of an elastic rope [N/m]; None for an inextensible one.
        damping: its c [N s/m].
        recovery: the fastest way back of a rope that is too long [m/s].
    """

    name: str
    body_a: str
    body_b: str
    length: Any = None
    point_a: Any = None
    point_b: Any = None
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    optional = ("restitution",)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The two points in their frames, the length, and what happens at its end."""
        return stretched(self, a, b) | stop(self, a.position.dtype)

    @staticmethod
    def bounds(p: dict[str, Any], a: Any, b: Any, dt: Any) -> tuple[list[Row], dict[str, Any]]:
        """l − ‖p_b − p_a‖."""
        row = distance(a.point(p["anchor_a"]), b.point(p["anchor_b"]), p["length"])
        pulls = tuple(-pull for pull in row.pulls)
        own, asked = one_sided(p, Row(-row.value, -row.rate, 0.0, pulls), dt)
        return [own], asked


@dataclass(frozen=True)
class PlaneContact:
    """A ball of a body, or with radius zero a point of it, on a plane of another; or several.

    λ of one ball is (1 + tangents,), that of k balls (k, 1 + tangents).
    A capsule touches a plane by the two balls at the ends of its axis, `center` of shape (2, dim).

    Attributes:
        name: unique in the scene.
        body_a: that has the plane, or `WORLD`.
        body_b: that has the ball.
        radius: r ≥ 0 [m].
        center: of the ball, world, at assembly, (dim,) [m], or of several with one radius,
            (k, dim); the centre of mass unless given.
        normal: of the plane, out of it, world, at assembly, (dim,); the last axis unless given.
        point: of the plane, world, at assembly, (dim,) [m]; the origin unless given.
        friction: μ ≥ 0; the number 0 leaves the normal row alone.
        restitution: e, 0 to 1.
        stiffness, damping: of a soft contact [N/m], [N s/m]; hard unless given.
        recovery: the fastest way out of an overlap [m/s].
        rolling: c ≥ 0 of rolling resistance, ‖τ‖ ≤ c λ_n against what rolls; 0 leaves none [m].
        spinning: likewise of spinning about the normal, in space [m].
    """

    name: str
    body_a: str
    body_b: str
    radius: Any = 0.0
    center: Any = None
    normal: Any = None
    point: Any = None
    friction: Any = 0.0
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    rolling: Any = 0.0
    spinning: Any = 0.0
    optional = MATERIAL

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The plane in the frame of a, the ball in that of b, and the material."""
        radius = checks.real(label(self), "radius", self.radius, b.position.dtype, least=0)
        ball = {"anchor_b": own_points(self, "center", self.center, b), "radius": radius}
        return plane(self, a) | ball | material(self, a, b)

    points = staticmethod(given_points)

    @staticmethod
    def bounds(p: dict[str, Any], a: Any, b: Any, dt: Any) -> tuple[list[Row], dict[str, Any]]:
        """n·(p_b − p_a) − r."""
        n = a.direction(p["normal"]).position
        center = b.point(p["anchor_b"]).position
        gap = n.dot(center - a.point(p["anchor_a"]).position) - p["radius"]
        middle = center - n * (p["radius"] + gap / 2)
        return touching(p, Touch(gap, n, middle, a, b), dt)


@dataclass(frozen=True)
class CapsuleContact:
    """Two capsules, or balls where a segment has no length; they touch in one point.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        radius_a, radius_b: r ≥ 0 [m].
        segment_a, segment_b: the ends of each capsule's axis, world, at assembly, (2, dim) [m]; the
            centre of mass twice unless given.
        friction: μ ≥ 0; the number 0 leaves the normal row alone.
        restitution: e, 0 to 1.
        stiffness, damping: of a soft contact [N/m], [N s/m]; hard unless given.
        recovery: the fastest way out of an overlap [m/s].
        rolling: c ≥ 0 of rolling resistance, ‖τ‖ ≤ c λ_n against what rolls; 0 leaves none [m].
        spinning: likewise of spinning about the normal, in space [m].
    """

    name: str
    body_a: str
    body_b: str
    radius_a: Any = 0.0
    radius_b: Any = 0.0
    segment_a: Any = None
    segment_b: Any = None
    friction: Any = 0.0
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    rolling: Any = 0.0
    spinning: Any = 0.0
    optional = MATERIAL

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The capsules in the frames of their bodies, and the material.

        Raises:
            ValueError: both are without a radius: segments never overlap.
        """
        if checks.plain_zero(self.radius_a) and checks.plain_zero(self.radius_b):
            raise ValueError(f"{label(self)}: give radius_a, radius_b or both.")
        result: dict[str, Array] = {}
        for side, pose in (("a", a), ("b", b)):
            given = getattr(self, f"segment_{side}")
            shape = (2, *pose.position.shape)
            ends = jnp.stack([pose.position] * 2) if given is None else given
            ends = checks.real(label(self), f"segment_{side}", ends, pose.position.dtype, shape)
            names = ("start", "end")
            for what, x in zip(names, ends, strict=True):
                point = own_point(self, f"segment_{side}", x, pose)
                result[f"{what}_{side}"] = pose.local_point(point)
            own = getattr(self, f"radius_{side}")
            radius = checks.real(label(self), f"radius_{side}", own, pose.position.dtype, least=0)
            result[f"radius_{side}"] = radius
        return result | material(self, a, b)

    @staticmethod
    def bounds(p: dict[str, Any], a: Any, b: Any, dt: Any) -> tuple[list[Row], dict[str, Any]]:
        """‖x_b − x_a‖ − r_a − r_b of the nearest points of the two axes."""
        ends = [
            f.point(p[f"{e}_{s}"]).position
            for f, s in ((a, "a"), (b, "b"))
            for e in ("start", "end")
        ]
        x_a, x_b = nearest(*ends)
        apart = x_b - x_a
        length = numerics.norm(apart)
        n = apart * numerics.safe_divide(1.0, length)
        gap = length - p["radius_a"] - p["radius_b"]
        middle = x_a + n * (p["radius_a"] + gap / 2)
        return touching(p, Touch(gap, n, middle, a, b), dt)


@pytree
class Touches(Ranged):
    """Ropes or contacts of one class, `law`, between bodies of the same kinds."""

    def bounds(self, snapshot: Any, control: Any, dt: Any) -> BoundSet:
        """The rows at one instant, and what a step of dt wants of them."""
        p, places = self.params, self.places
        points = self.law.points(p) if hasattr(self.law, "points") else None
        if points is not None:
            p = spread(p, points)
            places = tuple(spread_place(place, points[0].shape[1]) for place in places)
        rows, asked = self.law.bounds(p, *(snapshot.frame(place) for place in places), dt)
        law = "contact" if "friction" in p else "single"
        each = None if points is None else points[0].shape[1]
        return BoundSet(law, tuple(rows), places, points=each, **asked)


def nearest(p: Vector, q: Vector, r: Vector, s: Vector) -> tuple[Vector, Vector]:
    """The nearest points of the segments pq and rs; of parallel ones, the middle of what faces.

    Where they do not face each other at all, the two ends that are nearest.

    References:
        Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    u, w, d = q - p, s - r, p - r
    a, e, b = u.dot(u), w.dot(w), u.dot(w)
    c, f = u.dot(d), w.dot(d)
    apart = a * e - b * b
    tiny = 16 * float(jnp.finfo(jnp.result_type(*p)).eps)
    crossing = apart > tiny * a * e
    x = jnp.clip(numerics.safe_divide(b * f - c * e, jnp.where(crossing, apart, 0)), 0, 1)
    facing = [jnp.clip(numerics.safe_divide(end, a), 0, 1) for end in (-c, b - c)]
    x = jnp.where(crossing, x, (facing[0] + facing[1]) / 2)
    y = jnp.clip(numerics.safe_divide(b * x + f, e), 0, 1)
    x = jnp.clip(numerics.safe_divide(b * y - c, a), 0, 1)
    return p + u * x, r + w * y


def plane(element: Any, a: Pose) -> dict[str, Array]:
    """The normal and the point of a plane in the frame of its body.

    Raises:
        ValueError: the body is a particle.
    """
    check_oriented(element, a)
    dim, dtype = a.position.shape[0], a.position.dtype
    given = (0.0,) * (dim - 1) + (1.0,) if element.normal is None else element.normal
    normal = unit_vector(element, "normal", given, a)
    origin = jnp.zeros(dim, dtype) if element.point is None else element.point
    point = own_point(element, "point", origin, a)
    return {"normal": a.local_direction(normal), "anchor_a": a.local_point(point)}
