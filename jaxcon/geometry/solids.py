"""Gaps between planes, balls, capsules, cylinders, boxes and ellipsoids, in closed form.

All functions are written in lanes (element, …). The results point from the first solid to the
second. Functions that return several gaps return one for each contact point.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, total
from jaxcon.core.typing import Array, Lane

UPRIGHT = 1e-4
"""The tilt of a cylinder [rad] below which its lowest point moves from the rim to the center.

The lowest point of a disc parallel to the plane is not unique. Without this blend its derivative
would be infinite there. The error of the gap is at most a quarter of `UPRIGHT` radii.
"""

ELLIPSOID_STEPS = 10
"""The number of Newton steps for the nearest point of an ellipsoid."""

CYLINDER_STEPS = 24
"""The number of steps, by Newton's method or bisection, for the nearest point of a segment."""


class Solid(NamedTuple):
    """A solid in the world frame.

    Attributes:
        center: the center [m]; for a plane, one of its points.
        axes: the axes x, y and z of the solid, world frame. A ball has none, and a capsule only its
            axis z. A plane has its outward normal.
        radius: radius of a ball, capsule or cylinder [m].
        half: half the length of a capsule or cylinder; half the edges of a box, a Vector; or the
            semi-axes of an ellipsoid, a Vector [m].
    """

    center: Vector
    axes: tuple[Vector, ...] = ()
    radius: Any = 0.0
    half: Any = 0.0
    points: Any = None

    @property
    def axis(self) -> Vector:
        """The last axis: z, or the normal of a plane."""
        return self.axes[-1]

    def local(self, point: Vector) -> Vector:
        """Returns the coordinates of a point along the solid's axes, from its center."""
        offset = point - self.center
        return Vector(*(u.dot(offset) for u in self.axes))

    def direction(self, local: Vector) -> Vector:
        """Returns a direction in the world frame from its components along the solid's axes."""
        x, y, z = (u * s for u, s in zip(self.axes, local, strict=True))
        return x + y + z


class Gap(NamedTuple):
    """The gap of two solids at one contact point.

    Attributes:
        distance: the distance of the surfaces along the normal, negative if they overlap [m].
        normal: unit normal from the first solid to the second, world frame.
        place: the point halfway between the surfaces, world frame.
    """

    distance: Lane
    normal: Vector
    place: Vector

    def swapped(self) -> Gap:
        """Returns the gap with the two solids in exchanged order."""
        return Gap(self.distance, -self.normal, self.place)


def where(condition: Lane, x: Vector, y: Vector) -> Vector:
    """Returns x where the condition holds, and y elsewhere."""
    return Vector(*(jnp.where(condition, a, b) for a, b in zip(x, y, strict=True)))


def sign(x: Lane) -> Lane:
    """Returns −1 for negative numbers and 1 for others, with zero gradient."""
    return jnp.where(x < 0, -1.0, 1.0).astype(jnp.result_type(x))


def nearest(p: Vector, q: Vector, r: Vector, s: Vector) -> tuple[Vector, Vector, Lane, Array]:
    """Returns the closest points of the segments pq and rs.

    Parallel segments are closest along the part where they face each other; the result is the
    middle of this part. If they do not face each other, the result is the two closest ends.

    Returns:
        The two points; True if the segments are not parallel; and True if they are not parallel and
        both points lie between the ends.

    References:
        Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    u, w, d = q - p, s - r, p - r
    a, e, b = u.dot(u), w.dot(w), u.dot(w)
    c, f = u.dot(d), w.dot(d)
    apart = a * e - b * b
    tiny = 16 * float(jnp.finfo(jnp.result_type(*p)).eps)
    skew = apart > tiny * a * e
    x = jnp.clip(numerics.safe_divide(b * f - c * e, jnp.where(skew, apart, 0)), 0, 1)
    facing = [jnp.clip(numerics.safe_divide(end, a), 0, 1) for end in (-c, b - c)]
    x = jnp.where(skew, x, (facing[0] + facing[1]) / 2)
    y = jnp.clip(numerics.safe_divide(b * x + f, e), 0, 1)
    x = jnp.clip(numerics.safe_divide(b * y - c, a), 0, 1)
    crossing = skew & (x > 0) & (x < 1) & (y > 0) & (y < 1)
    return p + u * x, r + w * y, skew, crossing


def from_plane(plane: Solid, center: Vector, radius: Lane) -> Gap:
    """Returns the gap between a plane and a ball; a ball of radius zero is a point."""
    n = plane.axis
    distance = n.dot(center - plane.center) - radius
    return Gap(distance, n, center - n * (radius + distance / 2))


def plane_ball(plane: Solid, ball: Solid) -> list[Gap]:
    """Returns the gap between a plane and a ball."""
    return [from_plane(plane, ball.center, ball.radius)]


def plane_capsule(plane: Solid, capsule: Solid) -> list[Gap]:
    """Returns the gaps between a plane and both ends of a capsule."""
    along = capsule.axis * capsule.half
    ends = capsule.center - along, capsule.center + along
    return [from_plane(plane, end, capsule.radius) for end in ends]


def plane_hull(plane: Solid, hull: Solid) -> list[Gap]:
    """Returns the gaps between a plane and all points of a hull, as lanes (element, k, …)."""
    arms = [Vector(*map(per_point, u)) * s for u, s in zip(hull.axes, hull.points, strict=True)]
    points = Vector(*map(per_point, hull.center)) + arms[0] + arms[1] + arms[2]
    wide = Solid(Vector(*map(per_point, plane.center)), (Vector(*map(per_point, plane.axis)),))
    return [from_plane(wide, points, 0.0)]


def plane_ellipsoid(plane: Solid, ellipsoid: Solid) -> list[Gap]:
    """Returns the gap between a plane and an ellipsoid, at its lowest point.

    With semi-axes a_i and components n_i of the normal, the lowest point is −a_i² n_i / s from the
    center, where s² = Σ a_i² n_i².
    """
    n = Vector(*(u.dot(plane.axis) for u in ellipsoid.axes))
    scaled = Vector(*(a * x for a, x in zip(ellipsoid.half, n, strict=True)))
    reach = numerics.norm(scaled)
    down = Vector(*(a * x for a, x in zip(ellipsoid.half, scaled, strict=True)))
    lowest = ellipsoid.center - ellipsoid.direction(down * numerics.safe_divide(1.0, reach))
    return [from_plane(plane, lowest, 0.0)]


def plane_cylinder(plane: Solid, cylinder: Solid) -> list[Gap]:
    """Returns the gaps between a plane and five points of a cylinder.

    The first two are the lowest points of the two discs, on which a lying cylinder rolls. The
    others are three points of the lower disc, fixed to the body and 120° apart, on which a cylinder
    stands. With the angle θ between axis and normal, they lie at the share cos²θ of the radius. So
    they are higher than the first two points unless the cylinder is upright, and do not disturb its
    rolling.
    """
    x, y, z = cylinder.axes
    n, radius = plane.axis, cylinder.radius
    cosine = n.dot(z)
    across = n - z * cosine  # its length is the sine of the angle between axis and normal
    sine = numerics.norm(across)
    down = across * (radius / jnp.maximum(sine, UPRIGHT))
    lower = z * (-sign(cosine) * cylinder.half)
    inner = radius * cosine * cosine
    rim = [(1.0, 0.0), (-0.5, 0.75**0.5), (-0.5, -(0.75**0.5))]
    points = [lower - down, -lower - down]
    points += [lower + (x * c + y * s) * inner for c, s in rim]
    return [from_plane(plane, cylinder.center + point, 0.0) for point in points]


def ball_on(distance: Lane, normal: Vector, center: Vector, radius: Lane) -> Gap:
    """Returns the gap between a solid and a ball.

    Args:
        distance: the signed distance of the ball's center from the surface of the solid [m].
        normal: the unit normal from the solid to the center, world frame.
        center: the center of the ball.
        radius: the radius of the ball [m].
    """
    gap = distance - radius
    return Gap(gap, normal, center - normal * (radius + gap / 2))


def point_box(point: Vector, half: Vector) -> tuple[Lane, Vector]:
    """Returns the signed distance of a point from a box, and the normal there, in its frame.

    Inside the box, the distance is that of the nearest face, as a negative number.
    """
    signs = [sign(x) for x in point]
    excess = [s * x - h for s, x, h in zip(signs, point, half, strict=True)]
    beyond = Vector(*(jnp.where(e > 0, e, 0) for e in excess))
    length = numerics.norm(beyond)
    outside = length > 0
    first = (excess[0] >= excess[1]) & (excess[0] >= excess[2])
    second = ~first & (excess[1] >= excess[2])
    faces = (first, second, ~first & ~second)
    deepest = jnp.where(first, excess[0], jnp.where(second, excess[1], excess[2]))
    inverse = numerics.safe_divide(1.0, length)
    normal = Vector(
        *(
            s * jnp.where(outside, e * inverse, face.astype(jnp.result_type(e)))
            for s, e, face in zip(signs, beyond, faces, strict=True)
        )
    )
    return jnp.where(outside, length, deepest), normal


def box_ball(box: Solid, ball: Solid) -> list[Gap]:
    """Returns the gap between a box and a ball."""
    distance, normal = point_box(box.local(ball.center), box.half)
    return [ball_on(distance, box.direction(normal), ball.center, ball.radius)]


def point_cylinder(cylinder: Solid, point: Vector) -> tuple[Lane, Vector]:
    """Returns the signed distance of a point from a cylinder, and the normal there, world frame.

    Inside the cylinder, the distance is that of the nearest of its side and its two discs, as a
    negative number. On the axis, where the side has no nearest point, the normal is the axis x.
    """
    offset, axis = point - cylinder.center, cylinder.axis
    z = axis.dot(offset)
    radial = offset - axis * z
    rho = numerics.norm(radial)
    inverse = numerics.safe_divide(1.0, rho)
    outward = where(rho > 0, radial * inverse, cylinder.axes[0])
    side = sign(z)
    out_r, out_z = rho - cylinder.radius, side * z - cylinder.half
    out_r_only, out_z_only = jnp.where(out_r > 0, out_r, 0), jnp.where(out_z > 0, out_z, 0)
    length = numerics.norm(Vector(out_r_only, out_z_only))
    outside, to_side = length > 0, out_r >= out_z
    share = numerics.safe_divide(1.0, length)
    along_r = jnp.where(outside, out_r_only * share, jnp.where(to_side, 1.0, 0.0))
    along_z = jnp.where(outside, out_z_only * share, jnp.where(to_side, 0.0, 1.0))
    inside = jnp.where(to_side, out_r, out_z)
    return jnp.where(outside, length, inside), outward * along_r + axis * (side * along_z)


def cylinder_ball(cylinder: Solid, ball: Solid) -> list[Gap]:
    """Returns the gap between a cylinder and a ball."""
    return [ball_on(*point_cylinder(cylinder, ball.center), ball.center, ball.radius)]


def ellipsoid_ball(ellipsoid: Solid, ball: Solid) -> list[Gap]:
    """Returns the gap between an ellipsoid and a ball.

    The normal at the point that is nearest to p has the direction p_i / (a_i² + t), with semi-axes
    a_i and the largest root t of f(t) = Σ (a_i p_i / (a_i² + t))² = 1. Newton's method on 1/√f,
    which is nearly linear in t, starts left of the root. The distance follows from the normal n, as
    n·p − √(Σ a_i² n_i²). At the center the normal is the axis z.

    References:
        Eberly, Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid (2013).
    """
    a, p = ellipsoid.half, ellipsoid.local(ball.center)
    squares = Vector(*(x * x for x in a))
    least = jnp.minimum(jnp.minimum(squares[0], squares[1]), squares[2])
    # in the plane across the shortest axis, deep inside, two points would be nearest
    lowest = least * (float(jnp.finfo(jnp.result_type(least)).eps) ** 0.5 - 1)

    def newton(t: Lane, p: Vector, squares: Vector, lowest: Lane) -> Lane:
        inverse = [numerics.safe_divide(1.0, s + t) for s in squares]
        terms = [s * x * x * i * i for s, x, i in zip(squares, p, inverse, strict=True)]
        f, slope = total(terms), -2 * total(x * i for x, i in zip(terms, inverse, strict=True))
        # a step of 1/√f − 1 = 0
        step = numerics.safe_divide(2 * f * (numerics.safe_sqrt(f) - 1), -slope)
        return jnp.maximum(t + step, lowest)

    fixed = jax.lax.stop_gradient((p, squares, lowest))
    starts = [jnp.sqrt(s) * abs(x) - s for s, x in zip(fixed[1], fixed[0], strict=True)]
    start = jnp.maximum(jnp.maximum(starts[0], starts[1]), jnp.maximum(starts[2], fixed[2]))
    t = jax.lax.fori_loop(0, ELLIPSOID_STEPS, lambda _, t: newton(t, *fixed), start)
    t = jax.lax.stop_gradient(t)
    for _ in range(2):  # exact first and second derivatives of t
        t = newton(t, p, squares, lowest)
    direction = Vector(
        *(x * numerics.safe_divide(1.0, s + t) for x, s in zip(p, squares, strict=True))
    )
    length = numerics.norm(direction)
    normal = direction * numerics.safe_divide(1.0, length)
    normal = where(length > 0, normal, Vector(0.0, 0.0, 1.0))
    reach = numerics.norm(Vector(*(x * y for x, y in zip(a, normal, strict=True))))
    distance = normal.dot(p) - reach
    return [ball_on(distance, ellipsoid.direction(normal), ball.center, ball.radius)]


def _segment_range(middle: Lane, slope: Lane, limit: Lane) -> tuple[Lane, Lane]:
    """Returns the range of t in which |middle + slope t| ≤ limit; (2, −2) if there is none."""
    eps = 16 * float(jnp.finfo(jnp.result_type(middle)).eps)
    moves = abs(slope) > eps * (abs(middle) + limit)
    inverse = numerics.safe_divide(1.0, jnp.where(moves, slope, 0))
    ends = (-limit - middle) * inverse, (limit - middle) * inverse
    inside = jnp.where(abs(middle) <= limit, -2.0, 2.0).astype(jnp.result_type(middle))
    low = jnp.where(moves, jnp.minimum(*ends), inside)
    return low, jnp.where(moves, jnp.maximum(*ends), -inside)


def box_capsule(box: Solid, capsule: Solid) -> list[Gap]:
    """Returns the gaps between a box and a capsule at two points.

    One is the point of the capsule's axis that is nearest to the box. The other is the farther end
    of the part of the axis that lies over the nearest face, so that a capsule can lie on a face.

    The squared distance from the box is convex along the axis, and its slope is piecewise linear,
    with kinks where the axis crosses the planes of the faces. So the nearest point lies at a kink,
    at an end of the axis, or between two neighbors of these, by linear interpolation.
    """
    middle = box.local(capsule.center)
    slope = Vector(*(u.dot(capsule.axis) * capsule.half for u in box.axes))
    ranges = [_segment_range(m, s, h) for m, s, h in zip(middle, slope, box.half, strict=True)]
    places = [jnp.clip(x, -1, 1) for pair in ranges for x in pair]
    places += [jnp.full_like(places[0], -1.0), jnp.full_like(places[0], 1.0)]
    t = stack_points(places)
    at = [per_point(m) + per_point(s) * t for m, s in zip(middle, slope, strict=True)]
    halves = [per_point(h) for h in box.half]
    beyond = [x - jnp.clip(x, -h, h) for x, h in zip(at, halves, strict=True)]
    first, second, third = (per_point(s) * x for s, x in zip(slope, beyond, strict=True))
    rise = jnp.asarray(first + second + third)
    # not `jnp.max`, whose derivative XLA may round to 0/0
    falls, rises = rise <= 0, rise >= 0
    before, after = (largest(jnp.where(m, x, -2)) for m, x in ((falls, t), (rises, -t)))
    start, end = pick(before, t), jnp.where(jnp.any(rises, axis=1), pick(after, t), 1)
    down, up = -pick(before, rise), pick(after, rise)
    between = jnp.any(falls, axis=1) & jnp.any(rises, axis=1) & (start < end)
    share = numerics.safe_divide(jnp.where(between, down, 0), jnp.where(between, down + up, 1))
    # the axis may be parallel to a face, where all points between end and start are nearest
    nearest = jnp.where(between, start + (end - start) * share, jnp.minimum(start, end))
    nearest = jnp.where(jnp.any(falls, axis=1), nearest, -1)
    point = middle + slope * nearest
    excess = [abs(x) - h for x, h in zip(point, box.half, strict=True)]
    first = (excess[0] >= excess[1]) & (excess[0] >= excess[2])
    second = ~first & (excess[1] >= excess[2])
    start, end = -1.0, 1.0
    for face, (low_t, high_t) in zip((first, second, ~first & ~second), ranges, strict=True):
        start = jnp.maximum(start, jnp.where(face, -1, low_t))
        end = jnp.minimum(end, jnp.where(face, 1, high_t))
    over = start <= end
    other = jnp.where(nearest - start > end - nearest, start, end)
    other = jnp.where(over, other, nearest)
    result = []
    for at in (jnp.minimum(nearest, other), jnp.maximum(nearest, other)):
        distance, normal = point_box(middle + slope * at, box.half)
        center = capsule.center + capsule.axis * (capsule.half * at)
        result.append(ball_on(distance, box.direction(normal), center, capsule.radius))
    return result


def cylinder_capsule(cylinder: Solid, capsule: Solid) -> list[Gap]:
    """Returns the gaps between a cylinder and a capsule at three points.

    One is the point of the capsule's axis that is nearest to the cylinder, found by bisection and
    Newton's method on the slope of the squared distance, which is convex along the axis. The others
    are the ends of the part of the axis that lies over the nearest disc, or along the side.
    """
    u, along = cylinder.axis, capsule.axis * capsule.half
    offset = capsule.center - cylinder.center
    z, dz = u.dot(offset), u.dot(along)
    radial, change = offset - u * z, along - u * dz
    square, mixed, quadratic = radial.dot(radial), radial.dot(change), change.dot(change)
    numbers = (z, dz, square, mixed, quadratic, cylinder.radius, cylinder.half)

    def slopes(t: Lane, numbers: Sequence[Lane]) -> tuple[Lane, Lane]:
        """The first and second derivative of half the squared distance."""
        z, dz, square, mixed, quadratic, radius, half = numbers
        rho = numerics.safe_sqrt(square + t * (2 * mixed + t * quadratic))
        inverse = numerics.safe_divide(1.0, rho)
        rate = (mixed + t * quadratic) * inverse
        out = jnp.where(rho > radius, rho - radius, 0)
        at = z + dz * t
        out_z = jnp.where(abs(at) > half, at - sign(at) * half, 0)
        bend = jnp.where(out > 0, rate * rate + out * inverse * (quadratic - rate * rate), 0)
        bend = bend + jnp.where(out_z != 0, dz * dz, 0)
        return out * rate + out_z * dz, bend

    def once(_: Array, search: tuple[Lane, Lane, Lane]) -> tuple[Lane, Lane, Lane]:
        t, low, high = search
        slope, bend = slopes(t, fixed)
        low, high = jnp.where(slope < 0, t, low), jnp.where(slope < 0, high, t)
        newton = t - numerics.safe_divide(slope, bend)
        inside = (newton > low) & (newton < high)
        return jnp.where(inside, newton, (low + high) / 2), low, high

    fixed = jax.lax.stop_gradient(jnp.broadcast_arrays(*numbers))
    zero = jnp.zeros_like(fixed[0])
    # a step beyond the ends, so that they are reached
    t, *_ = jax.lax.fori_loop(0, CYLINDER_STEPS, once, (zero, zero - 1.001, zero + 1.001))
    t = jax.lax.stop_gradient(jnp.clip(t, -1, 1))
    for _ in range(2):  # exact first and second derivatives of t
        slope, bend = slopes(t, numbers)
        inner = (abs(t) < 1) & (bend > 0)
        step = numerics.safe_divide(jnp.where(inner, slope, 0), jnp.where(inner, bend, 1))
        t = jnp.clip(t - step, -1, 1)
    rho = numerics.safe_sqrt(square + t * (2 * mixed + t * quadratic))
    on_disc = abs(z + dz * t) - cylinder.half >= rho - cylinder.radius
    side_low, side_high = _segment_range(z, dz, cylinder.half)
    disc_low, disc_high = _chord(square - cylinder.radius * cylinder.radius, mixed, quadratic)
    start = jnp.clip(jnp.where(on_disc, disc_low, side_low), -1, 1)
    end = jnp.clip(jnp.where(on_disc, disc_high, side_high), -1, 1)
    empty = jnp.where(on_disc, disc_low > disc_high, side_low > side_high)
    empty |= jnp.where(
        on_disc, (disc_low > 1) | (disc_high < -1), (side_low > 1) | (side_high < -1)
    )
    result = []
    for at in (t, jnp.where(empty, t, start), jnp.where(empty, t, end)):
        center = capsule.center + along * at
        result.append(ball_on(*point_cylinder(cylinder, center), center, capsule.radius))
    return result


def _chord(constant: Lane, mixed: Lane, quadratic: Lane) -> tuple[Lane, Lane]:
    """Returns the range of t in which constant + 2 mixed t + quadratic t² ≤ 0.

    If there is none, the result is (2, −2).
    """
    eps = 16 * float(jnp.finfo(jnp.result_type(constant)).eps)
    moves = quadratic > eps * eps
    root = mixed * mixed - quadratic * constant
    inverse = numerics.safe_divide(1.0, jnp.where(moves, quadratic, 0))
    half = numerics.safe_sqrt(root) * inverse
    inside = jnp.where(constant <= 0, -2.0, 2.0).astype(jnp.result_type(constant))
    hits = root > 0
    low = jnp.where(moves, jnp.where(hits, -mixed * inverse - half, 2), inside)
    return low, jnp.where(moves, jnp.where(hits, half - mixed * inverse, -2), -inside)


def stack_points(lanes: Sequence[Lane]) -> Array:
    """Stacks lanes (element, …) along a new second axis, (element, k, …)."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, lanes)), axis=1)


def per_point(x: Lane) -> Lane:
    """Inserts the axis of contact points into a lane, (element, 1, …); keeps Python numbers."""
    return jnp.expand_dims(x, 1) if jnp.ndim(x) else x


def largest(scores: Array) -> Array:
    """Marks the largest entry along the axis of points, the first one of equal entries."""
    shape = (1, scores.shape[1], *(1,) * (scores.ndim - 2))
    places = jnp.arange(scores.shape[1], dtype=jnp.int32).reshape(shape)
    return places == jnp.expand_dims(jnp.argmax(scores, axis=1).astype(jnp.int32), 1)


def pick(marks: Array, lanes: Array | Sequence[Lane]) -> Array:
    """Returns the marked one of several lanes."""
    stacked = lanes if not isinstance(lanes, Sequence) else stack_points(lanes)
    return jnp.sum(jnp.where(marks, stacked, 0), axis=1)
