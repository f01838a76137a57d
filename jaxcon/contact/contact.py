"""Ropes and contacts with friction: geometry and rows.

The pairs that may touch are fixed when the scene is built. In each step, every pair computes its
gap, the normal from the first body to the second, and the point of contact. `contact_rows` makes
the rows from these and the motion of the bodies.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.joints import POSITIVE_LENGTH, stretched, unit_vector
from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.primitives import Row, distance
from jaxcon.contact.contact_rows import MATERIAL, Touch, across, contact_rows, material
from jaxcon.contact.limits import Ranged, one_sided, stop
from jaxcon.contact.point_sets import given_points, own_points, spread, spread_place
from jaxcon.contact.rows import BoundSet
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType, Lane, PyTree
from jaxcon.geometry.pose import Pose
from jaxcon.geometry.solids import nearest
from jaxcon.system.elements import BetweenBodies, label, own_point

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame
    from jaxcon.contact.boxes import BoxContact
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class Rope(BetweenBodies):
    """Limits the distance of two points: φ = l − ‖p_b − p_a‖ ≥ 0. λ is the tension.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        length: length l > 0 [m]. If None, the distance at assembly.
        point_a, point_b: end points in the world at assembly, (dim,) [m]. If None, the centers of
            mass.
        restitution: coefficient of restitution e, from 0 to 1, of the impact when the rope becomes
            taut.
        stiffness: stiffness k of an elastic rope [N/m]; None for an inextensible rope.
        damping: damping c of an elastic rope [N s/m].
        recovery: largest speed at which an overstretched rope shortens [m/s].
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
    ranges = POSITIVE_LENGTH

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the rope's ends in the body frames, its length, and its parameters as a stop."""
        return stretched(self, a, b) | stop(self, a.position.dtype)

    @staticmethod
    def bounds(
        p: dict[str, Any], a: JointFrame, b: JointFrame, dt: Array
    ) -> tuple[list[Row], dict[str, Any]]:
        """Returns the one-sided row of each rope, and further fields of its `BoundSet`.

        The gap is l − ‖p_b − p_a‖, with the end points p_a, p_b and the length l.
        """
        row = distance(a.point(p["anchor_a"]), b.point(p["anchor_b"]), p["length"])
        pulls = tuple(-pull for pull in row.pulls)
        slack, fields = one_sided(p, Row(-row.value, -row.rate, 0.0, pulls), dt)
        return [slack], fields


@dataclass(frozen=True)
class PlaneContact(BetweenBodies):
    """Contact of one or more balls of a body with another body's plane.

    A ball of radius zero is a point. λ has the shape (1 + tangents,) for one ball, and (k, 1 +
    tangents) for k balls. For a capsule, give the two balls at the ends of its axis, `center` of
    shape (2, dim).

    Attributes:
        name: name of the element, unique in the scene.
        body_a: the body with the plane, or `WORLD`.
        body_b: the body with the ball.
        radius: radius r ≥ 0 [m].
        center: center of the ball in the world at assembly, (dim,) [m], or centers of k balls with
            the same radius, (k, dim). If None, the center of mass.
        normal: outward normal of the plane in the world at assembly, (dim,). If None, the last
            axis.
        point: a point of the plane in the world at assembly, (dim,) [m]. If None, the origin.
        friction: coefficient of friction μ ≥ 0. With the number 0 there is a normal row only.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness, damping: spring and damper of a soft contact [N/m], [N s/m]. Without a stiffness,
            contact is hard.
        recovery: the largest speed at which a penetration closes [m/s].
        rolling: length c ≥ 0 of rolling resistance [m], ‖τ‖ ≤ c λ_n for its moment τ; 0 for none.
        spinning: length c ≥ 0 of resistance to spinning about the normal, in space [m]; 0 for none.
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
        """Returns the plane in a's frame, the balls in b's frame, and the material parameters."""
        radius = checks.real(label(self), "radius", self.radius, b.position.dtype, least=0)
        ball = {"anchor_b": own_points(self, "center", self.center, b), "radius": radius}
        return plane(self, a) | ball | material(self, a, b)

    points = staticmethod(given_points)

    @staticmethod
    def bounds(
        p: dict[str, Any], a: JointFrame, b: JointFrame, dt: Array
    ) -> tuple[list[Row], dict[str, Any]]:
        """Returns the contact rows of each ball, and further fields of their `BoundSet`.

        The gap is n·(p_b − p_a) − r, with the plane's normal n and point p_a, and the ball's center
        p_b and radius r.
        """
        n = a.direction(p["normal"]).position
        center = b.point(p["anchor_b"]).position
        gap = n.dot(center - a.point(p["anchor_a"]).position) - p["radius"]
        middle = center - n * (p["radius"] + gap / 2)
        return contact_rows(p, Touch(gap, n, middle, a, b), dt)


@dataclass(frozen=True)
class CapsuleContact(BetweenBodies):
    """Contact of two capsules at one point; a capsule whose segment has no length is a ball.

    The normal points from the closest point of the first axis to the closest point of the second.
    If the axes cross between their ends in space, the normal is perpendicular to both. If the axes
    intersect in the plane, or are collinear and overlap, it is perpendicular to the longer axis.
    For two balls with the same center it is the world's x axis.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        radius_a, radius_b: radii r ≥ 0 [m].
        segment_a, segment_b: the two ends of each capsule's axis in the world at assembly, (2, dim)
            [m]. If None, both ends are the center of mass.
        friction: coefficient of friction μ ≥ 0. With the number 0 there is a normal row only.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness, damping: spring and damper of a soft contact [N/m], [N s/m]. Without a stiffness,
            contact is hard.
        recovery: the largest speed at which a penetration closes [m/s].
        rolling: length c ≥ 0 of rolling resistance [m], ‖τ‖ ≤ c λ_n for its moment τ; 0 for none.
        spinning: length c ≥ 0 of resistance to spinning about the normal, in space [m]; 0 for none.
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
        """Returns the capsules in the frames of their bodies, and the material parameters.

        Raises:
            ValueError: both radii are the number 0; segments without thickness never overlap.
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
            radius_given = getattr(self, f"radius_{side}")
            radius = checks.real(
                label(self), f"radius_{side}", radius_given, pose.position.dtype, least=0
            )
            result[f"radius_{side}"] = radius
        return result | material(self, a, b)

    @staticmethod
    def bounds(
        p: dict[str, Any], a: JointFrame, b: JointFrame, dt: Array
    ) -> tuple[list[Row], dict[str, Any]]:
        """Returns the contact rows of two capsules, and further fields of their `BoundSet`.

        The gap is ‖x_b − x_a‖ − r_a − r_b, with the closest points x_a, x_b of the two axes and the
        radii r_a, r_b.
        """
        ends = [
            f.point(p[f"{e}_{s}"]).position
            for f, s in ((a, "a"), (b, "b"))
            for e in ("start", "end")
        ]
        x_a, x_b, skew, crossing = nearest(*ends)
        apart, radii = x_b - x_a, p["radius_a"] + p["radius_b"]
        length = numerics.norm(apart)
        resolved = length > rounding_of(ends, x_a, x_b, radii)
        if len(apart) == 2:  # crossing axes in the plane intersect
            resolved &= ~crossing
        # if the axes u and w cross between their ends, u × w has the direction of x_b − x_a, with
        # less rounding error
        across_both = ~resolved | crossing
        aside = across_axes(ends[1] - ends[0], ends[3] - ends[2], skew)
        aside = aside * jnp.where(resolved & (aside.dot(apart) < 0), -1.0, 1.0)
        n = apart * numerics.safe_divide(1.0, length)
        n = Vector(*(jnp.where(across_both, y, x) for x, y in zip(n, aside, strict=True)))
        # where the axes intersect, the norm has no derivative; the gap then changes along n
        gap = jnp.where(across_both, n.dot(apart), length) - radii
        middle = x_a + n * (p["radius_a"] + gap / 2)
        return contact_rows(p, Touch(gap, n, middle, a, b), dt)


@pytree
class Contacts(Ranged):
    """A group of ropes or contacts of the class `law`, between bodies of the same kinds."""

    def check_numbers(self, name: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks the parameters of one element by its class and by `check_ranges`.

        Args:
            name: name of the element, for errors.
            numbers: the parameters by field.
            dtype: dtype of the scene, in which they are compared.
        """
        self.law.check_numbers(name, numbers, dtype)
        super().check_numbers(name, numbers, dtype)

    def bounds(self, snapshot: Snapshot, control: PyTree, dt: Array) -> BoundSet:
        """Returns the inequality rows at one instant, with their targets for a step of dt."""
        p, places = self.params, self.places
        if hasattr(self.law, "touches"):
            return self._shape_bounds(snapshot, dt)
        points = self.law.points(p) if hasattr(self.law, "points") else None
        if points is not None:
            p = spread(p, points)
            places = tuple(spread_place(place, points[0].shape[1]) for place in places)
        rows, fields = self.law.bounds(p, *(snapshot.frame(place) for place in places), dt)
        law = "contact" if "friction" in p else "single"
        each = None if points is None else points[0].shape[1]
        return BoundSet(law, tuple(rows), places, points=each, **fields)

    def _shape_bounds(self, snapshot: Snapshot, dt: Array) -> BoundSet:
        """Returns the rows of shapes, whose contact points are functions of the poses."""
        p, places = self.params, self.places
        gap, *vectors = self.law.touches(p, *(snapshot.frame(place) for place in places))
        count = gap.shape[1]

        def flat(x: Array) -> Array:
            return x.reshape(-1, *x.shape[2:])

        given = {name: x for name, x in p.items() if isinstance(x, jax.Array)}
        if count > 1:
            given = {name: jnp.repeat(x, count, axis=0) for name, x in given.items()}
            places = tuple(spread_place(place, count) for place in places)
        normal, place = (v.map(flat) for v in vectors)
        a, b = (snapshot.frame(place) for place in places)
        rows, fields = contact_rows(given, Touch(flat(gap), normal, place, a, b), dt)
        law = "contact" if "friction" in p else "single"
        each = None if count == 1 else count
        return BoundSet(law, tuple(rows), places, points=each, **fields)


def rounding_of(ends: Sequence[Vector], x_a: Vector, x_b: Vector, radii: Lane) -> Lane:
    """Estimates the rounding error of the distance of two segments' closest points [m].

    It is zero for two balls, and at most a thousandth of the sum of the radii.

    Args:
        ends: p, q, r and s, the ends of the segments pq and rs.
        x_a: closest point of the first segment.
        x_b: closest point of the second segment.
        radii: the sum of the radii [m].
    """
    p, q, r, s = ends
    eps = float(jnp.finfo(jnp.result_type(*p)).eps)
    size = functools.reduce(jnp.maximum, (abs(x) for x in (*x_a, *x_b)))
    has_axis = (q - p).dot(q - p) + (s - r).dot(s - r) > 0
    return jnp.where(has_axis, jnp.minimum(16 * eps * size, 1e-3 * radii), 0)


def across_axes(u: Vector, w: Vector, skew: Lane) -> Vector:
    """Returns a unit vector across the axes u and w of two capsules.

    It is u × w / ‖u × w‖ in space. In the plane, and for parallel axes in space, it is
    perpendicular to the longer axis. For two balls, whose axes are zero, it is the world's x axis.

    Args:
        u: axis of the first capsule, any length.
        w: axis of the second capsule.
        skew: True where the axes are not parallel.
    """
    square_u, square_w = u.dot(u), w.dot(w)
    longer = square_u >= square_w
    square = jnp.where(longer, square_u, square_w)
    # two balls have no axis: take the last world axis, downwards; the direction across it is e_x
    down = (0.0,) * (len(u) - 1) + (-1.0,)
    unit = numerics.safe_divide(1.0, numerics.safe_sqrt(square))
    along = (
        jnp.where(square > 0, jnp.where(longer, x, y) * unit, z)
        for x, y, z in zip(u, w, down, strict=True)
    )
    aside = across(Vector(*along))[0]
    if len(u) == 2:
        return aside
    both = u.cross(w)
    unit = numerics.safe_divide(1.0, numerics.safe_sqrt(jnp.where(skew, both.dot(both), 0)))
    return Vector(*(jnp.where(skew, x * unit, y) for x, y in zip(both, aside, strict=True)))


def plane(element: PlaneContact | BoxContact, a: Pose) -> dict[str, Array]:
    """Returns the normal and a point of a plane in the frame of its body.

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
