"""Contact of a cylinder with a box or with another cylinder.

The normal is the direction that separates the two solids best. The separation along a unit vector
n is n·d − h_a(n) − h_b(n), with the distance d of the centers and the extents h of the solids. The
best direction is the normal of a face, the normal of two edges or sides, a direction across one
edge or side, or a general direction between corners and rims. The first two are known, and the
others are found by a search with a fixed number of steps.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.boxes import (
    CORNERS,
    FACES_FIRST,
    FIRST_BOX,
    Face,
    Points,
    clipped,
    facing,
    least_of,
    pick_vector,
    spread,
)
from jaxcon.geometry.solids import (
    Gap,
    Solid,
    largest,
    nearest,
    per_point,
    pick,
    sign,
    stack_points,
    where,
)

ANGLES = 16
"""The number of directions across each edge from which the search starts."""

STEPS = 40
"""The number of steps of the search; a step in vain shortens the next one by `SHORTER`."""

SHORTER = 0.6

FLAT = 1e-3
"""The sine of the angle below which an edge counts as parallel to the plane of contact."""


def is_box(solid: Solid) -> bool:
    """Returns True for boxes, and False for cylinders."""
    return isinstance(solid.half, Vector)


def box_cylinder(box: Solid, cylinder: Solid) -> list[Gap]:
    """Returns the gaps between a box and a cylinder at four points."""
    return _touching(box, cylinder)


def cylinder_cylinder(a: Solid, b: Solid) -> list[Gap]:
    """Returns the gaps between two cylinders at four points."""
    return _touching(a, b)


def _touching(a: Solid, b: Solid) -> list[Gap]:
    """Returns the gaps between two solids at four points.

    If a face separates best, the other solid's face, side or disc is clipped to it. A disc counts
    as the square of four of its rim points, one of them the lowest. Otherwise there is one point.
    """
    size = _size(a) + _size(b)
    smallest = least_of([*_halves(a), *_halves(b)])
    faces = [_faces(a, b, of_second=False), _faces(b, a, of_second=True)]
    second = faces[1].separation > faces[0].separation + FIRST_BOX * smallest
    separation = jnp.where(second, faces[1].separation, faces[0].separation)
    normal, free_separation = _best_direction(a, b)
    by_face = separation >= free_separation - FACES_FIRST * smallest
    single = _single(a, b, normal, free_separation)
    of_first, of_second = (_on_face(x, f) for x, f in zip((a, b), faces, strict=True))
    mixed = Points(
        *(jnp.where(per_point(second), y, x) for x, y in zip(of_first, of_second, strict=True))
    )
    one, other = faces
    outward, x_axis, y_axis, center = (
        where(second, y, x)
        for x, y in (
            (one.normal, other.normal),
            (one.x, other.x),
            (one.y, other.y),
            (one.center, other.center),
        )
    )
    normal = where(second, -outward, outward)
    none = jnp.maximum(jnp.maximum(separation, free_separation), 0) + size
    result = []
    for k, (x, y, z, valid) in enumerate(spread(mixed)):
        place = center + x_axis * x + y_axis * y + outward * (z / 2)
        gap = jnp.where(valid, z, none)
        if k:
            result.append(Gap(jnp.where(by_face, gap, none), normal, place))
            continue
        # a face that separates best without an overlap, such as a corner beyond the clipped square
        good = by_face & valid
        use = jnp.logical_not(by_face) | (jnp.logical_not(valid) & (separation <= 0))
        gap = jnp.where(use, single.distance, jnp.where(good, gap, none))
        result.append(Gap(gap, where(use, single.normal, normal), where(use, single.place, place)))
    return result


def _on_face(solid: Solid, face: Face) -> Points:
    """Returns candidates for contact points on a face of a solid.

    On a disc, these include corners of the other solid that lie beyond the square, but on the disc.
    """
    middle, first, second = _feature(face.other, face.normal)
    points = clipped(face, middle, first, second)
    frame = (face.x, face.y, face.normal)
    corners = [middle + first * s + second * t for s, t in CORNERS]
    x, y, z = (stack_points([u.dot(c - face.center) for c in corners]) for u in frame)
    beyond = jnp.zeros(x.shape, bool)
    if not is_box(solid):
        beyond = x * x + y * y <= per_point(solid.radius * solid.radius)
    more = Points(x, y, z, beyond)
    return Points(*(jnp.concatenate(parts, axis=1) for parts in zip(points, more, strict=True)))


def _halves(solid: Solid) -> list[Lane]:
    """Returns the lengths of a solid from its center."""
    return list(solid.half) if is_box(solid) else [solid.half, solid.radius]


def _size(solid: Solid) -> Lane:
    """Returns an upper bound of the extent of a solid."""
    first, *rest = _halves(solid)
    return sum(rest, first)


def _extent(solid: Solid, n: Vector) -> Lane:
    """Returns the extent of a solid from its center along a unit vector."""
    if is_box(solid):
        x, y, z = (abs(u.dot(n)) * h for u, h in zip(solid.axes, solid.half, strict=True))
        return x + y + z
    cosine = solid.axis.dot(n)
    return solid.radius * numerics.norm(n - solid.axis * cosine) + solid.half * abs(cosine)


def _spread_solid(solid: Solid) -> Solid:
    """Returns a solid as lanes (element, 1, …)."""
    half = solid.half.map(per_point) if is_box(solid) else per_point(solid.half)
    axes = tuple(u.map(per_point) for u in solid.axes)
    return Solid(solid.center.map(per_point), axes, per_point(solid.radius), half)


def _faces(solid: Solid, other: Solid, of_second: bool) -> Face:
    """Returns the face of a solid that separates it best from another one.

    The face of a cylinder is the square within a disc.
    """
    offset = other.center - solid.center
    if is_box(solid):
        axes, halves = list(solid.axes), list(solid.half)
        along = [u.dot(offset) for u in axes]
        apart = [
            abs(d) - h - _extent(other, u) for u, d, h in zip(axes, along, halves, strict=True)
        ]
        marks = largest(stack_points(apart))
        normal = pick_vector(marks, axes) * sign(pick(marks, along))
        center = solid.center + normal * pick(marks, halves)
        x, y = (pick_vector(marks, [*axes[k:], *axes[:k]]) for k in (1, 2))
        half_x, half_y = (pick(marks, [*halves[k:], *halves[:k]]) for k in (1, 2))
        return Face(normal, x, y, center, half_x, half_y, of_second, pick(marks, apart), other)
    along = solid.axis.dot(offset)
    normal = solid.axis * sign(along)
    side = solid.radius * 0.5**0.5
    center, apart = solid.center + normal * solid.half, abs(along) - solid.half
    separation = apart - _extent(other, solid.axis)
    x, y, _ = solid.axes
    return Face(normal, x, y, center, side, side, of_second, separation, other)


def _feature(solid: Solid, normal: Vector) -> tuple[Vector, Vector, Vector]:
    """Returns the face, disc or line of a solid that faces against a normal, as a parallelogram.

    Returns:
        Its center and its half edges. The square within a disc has a corner at its lowest point.
    """
    if is_box(solid):
        return facing(solid, normal)
    cosine = normal.dot(solid.axis)
    down, sine = _outward(solid, normal)
    aside = solid.axis.cross(down)
    disc = sine < abs(cosine)
    on_disc = solid.center - solid.axis * (sign(cosine) * solid.half)
    on_side = solid.center - down * solid.radius
    along = solid.axis * solid.half
    first = where(disc, (down + aside) * (solid.radius / 2), along)
    second = where(disc, (down - aside) * (solid.radius / 2), along * 0.0)
    return where(disc, on_disc, on_side), first, second


def _outward(cylinder: Solid, normal: Vector) -> tuple[Vector, Lane]:
    """Returns the direction of a normal across a cylinder's axis, and the sine of their angle.

    Along the axis, where there is none, the direction is the axis x.
    """
    across = normal - cylinder.axis * normal.dot(cylinder.axis)
    sine = numerics.norm(across)
    tilted = sine > FLAT
    unit = across * numerics.safe_divide(1.0, jnp.where(tilted, sine, 0))
    return where(tilted, unit, cylinder.axes[0]), sine


def _edge_frames(solid: Solid) -> list[tuple[Vector, Vector, Vector]]:
    """Returns the directions of edges and sides, each with two axes across it."""
    x, y, z = solid.axes
    return [(x, y, z), (y, z, x), (z, x, y)] if is_box(solid) else [(z, x, y)]


def _best_direction(a: Solid, b: Solid) -> tuple[Vector, Lane]:
    """Returns the best direction that is not the normal of a face, and the separation along it.

    The derivative of the direction is that of the normal of two edges. Other directions are
    constants: their derivative is left out. The separation has the derivative of a constant
    direction.
    """
    crosses = []
    for edge, *_ in _edge_frames(a):
        for other, *_ in _edge_frames(b):
            both = edge.cross(other)
            square = both.dot(both)
            skew = square > FLAT * FLAT
            inverse = numerics.safe_divide(1.0, numerics.safe_sqrt(jnp.where(skew, square, 0)))
            crosses.append((both * inverse, skew))
    fixed = jax.lax.stop_gradient((a, b))
    wide = tuple(map(_spread_solid, fixed))
    offset = wide[1].center - wide[0].center

    def separation(n: Vector) -> Array:
        return jnp.abs(n.dot(offset)) - _extent(wide[0], n) - _extent(wide[1], n)

    low = -4 * (_size(wide[0]) + _size(wide[1]))
    stacked = Vector(*(stack_points(x) for x in zip(*(n for n, _ in crosses), strict=True)))
    stacked = jax.lax.stop_gradient(stacked)
    masks = stack_points([m for _, m in crosses])
    scores = jnp.where(masks, separation(stacked), low)
    marks = largest(scores)
    cross = pick_vector(marks, [n for n, _ in crosses])
    cross_score = pick(marks, scores)
    free, free_score = _search(fixed, separation)
    smooth = free_score > cross_score + 1e-9 * _size(a)
    normal = where(smooth, jax.lax.stop_gradient(free), cross)
    normal = normal * sign(normal.dot(b.center - a.center))
    return normal, jnp.where(smooth, free_score, cross_score)


def _search(
    solids: tuple[Solid, Solid], separation: Callable[[Vector], Array]
) -> tuple[Vector, Lane]:
    """Searches for the best direction across an edge or side, and from there for the best of all.

    Args:
        solids: the two solids.
        separation: the separation along unit vectors, lanes (element, k, …).
    """
    frames = [f for solid in solids for f in _edge_frames(solid)]
    edge, first, second = (
        Vector(*(stack_points(x) for x in zip(*(f[k] for f in frames), strict=True)))
        for k in range(3)
    )
    like = edge[0]
    angles = np.arange(ANGLES) * np.pi / ANGLES
    shape = (1, 1, ANGLES, *(1,) * (like.ndim - 2))
    cosines, sines = (jnp.asarray(f(angles), like.dtype).reshape(shape) for f in (np.cos, np.sin))
    starts = Vector(
        *(
            jnp.expand_dims(x, 2) * cosines + jnp.expand_dims(y, 2) * sines
            for x, y in zip(first, second, strict=True)
        )
    )
    scores = separation(starts.map(lambda x: x.reshape(x.shape[0], -1, *x.shape[3:])))
    scores = scores.reshape(starts[0].shape)
    places = jnp.arange(ANGLES, dtype=jnp.int32).reshape(shape)
    marks = places == jnp.expand_dims(jnp.argmax(scores, axis=2).astype(jnp.int32), 2)
    across = starts.map(lambda x: jnp.sum(jnp.where(marks, x, 0), axis=2))

    def turn(_: Array, carry: tuple[Vector, Array, Array]) -> tuple[Vector, Array, Array]:
        """Turns the directions across an edge by ±δ about it, if that is better."""
        n, score, delta = carry
        aside, better = edge.cross(n), jnp.zeros(score.shape, bool)
        for side in (1.0, -1.0):
            tried = numerics.unit(n + aside * (side * delta))
            found = separation(tried)
            wins = found > score
            n, score, better = where(wins, tried, n), jnp.where(wins, found, score), better | wins
        return n, score, jnp.where(better, delta, delta * SHORTER)

    wide = jnp.full_like(like, np.pi / ANGLES)
    across, scores, _ = jax.lax.fori_loop(0, STEPS, turn, (across, separation(across), wide))
    marks = largest(scores)
    start = Vector(*(per_point(pick(marks, x)) for x in across))

    def step(_: Array, carry: tuple[Vector, Array, Array]) -> tuple[Vector, Array, Array]:
        """Moves a direction by δ to one of four sides, if that is better."""
        n, score, delta = carry
        x, y = _tangents(n)
        sides = [x, x * -1.0, y, y * -1.0]
        tried = Vector(
            *(jnp.concatenate([c + s[i] * delta for s in sides], axis=1) for i, c in enumerate(n))
        )
        tried = numerics.unit(tried)
        found = separation(tried)
        marks = largest(found)
        best = per_point(pick(marks, found))
        wins = best > score
        moved = Vector(*(per_point(pick(marks, c)) for c in tried))
        return (
            where(wins, moved, n),
            jnp.where(wins, best, score),
            jnp.where(wins, delta, delta * SHORTER),
        )

    wide = jnp.full_like(start[0], np.pi / ANGLES)
    n, score, _ = jax.lax.fori_loop(0, STEPS, step, (start, separation(start), wide))
    return Vector(*(x[:, 0] for x in n)), score[:, 0]


def _tangents(n: Vector) -> tuple[Vector, Vector]:
    """Returns two unit vectors across a unit vector, in lanes of any shape."""
    x, y, z = n
    side = sign(z)
    a = -1 / (side + z)
    b = x * y * a
    return (
        Vector(1 + side * x * x * a, side * b, -side * x),
        Vector(b, side + y * y * a, -y),
    )


def _support(solid: Solid, n: Vector) -> tuple[Vector, Vector]:
    """Returns the support of a solid along a unit vector, as a segment.

    Returns:
        The middle of the segment, and its half; zero for a point. An edge or side that is nearly
        across the vector is a segment.
    """
    if is_box(solid):
        cosines = [u.dot(n) for u in solid.axes]
        marks = largest(stack_points([-abs(c) for c in cosines]))
        middle, half = solid.center, solid.center * 0.0
        for k, (axis, c, h) in enumerate(zip(solid.axes, cosines, solid.half, strict=True)):
            flat = marks[:, k] & (abs(c) < FLAT)
            middle = middle + axis * jnp.where(flat, 0, h * sign(c))
            half = half + axis * jnp.where(flat, h, 0)
        return middle, half
    cosine = solid.axis.dot(n)
    outward, sine = _outward(solid, n)
    flat = abs(cosine) < FLAT
    rim = jnp.where(sine > FLAT, solid.radius, 0)
    middle = solid.center + outward * rim
    middle = middle + solid.axis * jnp.where(flat, 0, solid.half * sign(cosine))
    return middle, solid.axis * jnp.where(flat, solid.half, 0)


def _single(a: Solid, b: Solid, normal: Vector, separation: Lane) -> Gap:
    """Returns the contact of two corners, edges, sides or rims.

    Args:
        a: the first solid.
        b: the second solid.
        normal: the direction that separates them best.
        separation: the separation along it, whose value is used.
    """
    (middle_a, half_a), (middle_b, half_b) = _support(a, normal), _support(b, -normal)
    x, y, *_ = nearest(middle_a - half_a, middle_a + half_a, middle_b - half_b, middle_b + half_b)
    # the distance of the two points has the derivative of the gap: they are those of the bodies
    along = normal.dot(y - x)
    distance = along + jax.lax.stop_gradient(separation - along)
    return Gap(distance, normal, (x + y) * 0.5)
