"""Contact of boxes with planes and with each other, at up to four points.

Two boxes touch along their best separating axis, where one face is clipped to another.

References:
    Gottschalk, Lin, Manocha, OBBTree: a hierarchical structure for rapid interference detection,
        SIGGRAPH (1996).
    Ericson, Real-Time Collision Detection (2005), sections 4.4.1 and 5.3.3.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.solids import (
    Gap,
    Solid,
    from_plane,
    largest,
    per_point,
    pick,
    sign,
    stack_points,
    where,
)

POINTS = 4
"""The number of contact points of two boxes."""

FACES_FIRST = 0.01
"""The share of the smallest half edge by which an axis across two edges must separate better.

Two boxes that lie on each other touch with faces. Their axes across two edges are then nearly the
normals of these faces, and rounding must not select one of them, which has one contact point only.
"""

FIRST_BOX = 1e-3
"""The share of the smallest half edge by which a face of the second box must separate better."""

CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
"""The corners of a face in turn, as signs of its half edges."""

STEADY = (1e-5, 2e-5)
"""Slopes added to the gap when the lowest point is chosen, so that rounding does not choose it."""


class Face(NamedTuple):
    """The face of one solid that is the reference, and the solid on the other side.

    Attributes:
        normal, x, y: outward normal and the directions of the edges, world frame.
        center: center of the face.
        half_x, half_y: half the edges.
        of_second: True if the face belongs to the second solid.
        separation: the separation of the solids along the normal.
        other: the other solid.
    """

    normal: Vector
    x: Vector
    y: Vector
    center: Vector
    half_x: Lane
    half_y: Lane
    of_second: Lane
    separation: Lane
    other: Solid


class Points(NamedTuple):
    """Candidates for contact points, lanes (element, k, …).

    Attributes:
        x, y: coordinates along the edges of the reference face.
        z: the distance from the face, negative inside the box.
        valid: True for points of the overlap of both faces.
    """

    x: Array
    y: Array
    z: Array
    valid: Array


def plane_box(plane: Solid, box: Solid) -> list[Gap]:
    """Returns the gaps between a plane and the corners of the box's face that is most parallel.

    The lowest corner is one of them. If an edge or a face of the box is parallel to the plane, all
    of its corners are.
    """
    middle, first, second = facing(box, plane.axis)
    corners = [middle + first * s + second * t for s, t in CORNERS]
    return [from_plane(plane, corner, 0.0) for corner in corners]


def box_box(a: Solid, b: Solid) -> list[Gap]:
    """Returns the gaps between two boxes at four points.

    The normal is the axis that separates the boxes best: the normal of a face, or the direction
    across an edge of each box. Two crossing edges touch at one point. Otherwise the face of the
    other box that is most antiparallel is clipped to the sides of the reference face. Of the
    resulting polygon, the lowest corner is a contact point, the corner farthest from it, and the
    corners farthest from the line between both, on either side. A point that does not exist has a
    gap larger than the boxes.

    For boxes that overlap, the largest depth is exact up to 1 % of the smallest half edge. For
    boxes that are apart, the gap is the distance along the normal.
    """
    smallest = least_of([*a.half, *b.half])
    face = _reference_face(a, b, smallest)
    edge, edge_separation = _edges(a, b)
    by_edge = edge_separation > face.separation + FACES_FIRST * smallest
    points = clipped(face, *facing(face.other, face.normal))
    size = sum(a.half[1:], a.half[0]) + sum(b.half[1:], b.half[0])
    separation = jnp.maximum(face.separation, edge_separation)
    none = jnp.maximum(separation, 0) + size
    normal = where(face.of_second, -face.normal, face.normal)
    result = []
    for k, (x, y, z, valid) in enumerate(spread(points)):
        place = face.center + face.x * x + face.y * y + face.normal * (z / 2)
        gap = jnp.where(valid, z, none)
        if k == 0:
            gap = jnp.where(by_edge, edge.distance, gap)
            place = where(by_edge, edge.place, place)
            result.append(Gap(gap, where(by_edge, edge.normal, normal), place))
        else:
            result.append(Gap(jnp.where(by_edge, none, gap), normal, place))
    return result


def least_of(lanes: Sequence[Lane]) -> Lane:
    """Returns the smallest of several lanes."""
    result = lanes[0]
    for x in lanes[1:]:
        result = jnp.minimum(result, x)
    return result


def pick_vector(marks: Array, vectors: Sequence[Vector]) -> Vector:
    """Returns the marked one of several vectors."""
    return Vector(*(pick(marks, lanes) for lanes in zip(*vectors, strict=True)))


def _turned(items: Sequence, by: int) -> list:
    """Returns three items, or twice three, with each three rotated: the axis after each axis."""
    return [items[3 * (i // 3) + (i % 3 + by) % 3] for i in range(len(items))]


def _reference_face(a: Solid, b: Solid, smallest: Lane) -> Face:
    """Returns the face that separates two boxes best."""
    offset = b.center - a.center
    cosines = [[u.dot(w) for w in b.axes] for u in a.axes]
    along = [u.dot(offset) for u in (*a.axes, *b.axes)]
    reach = [
        h
        + sum(
            (abs(c) * g for c, g in zip(row[1:], b.half[1:], strict=True)), abs(row[0]) * b.half[0]
        )
        for h, row in zip(a.half, cosines, strict=True)
    ]
    columns = list(zip(*cosines, strict=True))
    reach += [
        h
        + sum(
            (abs(c) * g for c, g in zip(row[1:], a.half[1:], strict=True)), abs(row[0]) * a.half[0]
        )
        for h, row in zip(b.half, columns, strict=True)
    ]
    separations = [abs(d) - r for d, r in zip(along, reach, strict=True)]
    bias = FIRST_BOX * smallest
    marks = largest(stack_points([s + bias for s in separations[:3]] + separations[3:]))
    axes, halves = [*a.axes, *b.axes], [*a.half, *b.half]
    normal = pick_vector(marks, axes)
    half = pick(marks, halves)
    of_second = jnp.any(marks[:, 3:], axis=1)
    toward = pick(marks, along[:3] + [-x for x in along[3:]])
    normal = normal * sign(toward)
    other = Solid(
        where(of_second, a.center, b.center),
        tuple(where(of_second, u, w) for u, w in zip(a.axes, b.axes, strict=True)),
        half=where(of_second, a.half, b.half),
    )
    return Face(
        normal,
        pick_vector(marks, _turned(axes, 1)),
        pick_vector(marks, _turned(axes, 2)),
        where(of_second, b.center, a.center) + normal * half,
        pick(marks, _turned(halves, 1)),
        pick(marks, _turned(halves, 2)),
        of_second,
        pick(marks, separations),
        other,
    )


def _edges(a: Solid, b: Solid) -> tuple[Gap, Lane]:
    """Returns the contact of the two edges whose common normal separates two boxes best.

    Returns:
        The gap, and the separation along the normal. For parallel edges it is below that of faces.
    """
    offset = b.center - a.center
    c = [[u.dot(w) for w in b.axes] for u in a.axes]
    d = [u.dot(offset) for u in a.axes]
    pairs = list(itertools.product(range(3), repeat=2))
    of, to = ([pair[k] for pair in pairs] for k in (0, 1))
    first, second = ([(i + k) % 3 for i in of] for k in (1, 2))
    third, fourth = ([(j + k) % 3 for j in to] for k in (1, 2))

    def each(lanes: list[Lane], places: list[int]) -> Array:
        return stack_points([lanes[i] for i in places])

    def cosine(rows: list[int], columns: list[int]) -> Array:
        return stack_points([c[i][j] for i, j in zip(rows, columns, strict=True)])

    second_c, first_c = cosine(second, to), cosine(first, to)
    along = each(d, second) * first_c - each(d, first) * second_c
    a_half, b_half = list(a.half), list(b.half)
    reach = each(a_half, first) * abs(second_c) + each(a_half, second) * abs(first_c)
    reach = reach + each(b_half, third) * abs(cosine(of, fourth))
    reach = reach + each(b_half, fourth) * abs(cosine(of, third))
    square = first_c * first_c + second_c * second_c
    crosses = square > 1e-6
    length = jnp.sqrt(jnp.where(crosses, square, 1))
    size = per_point(sum(a.half[1:], a.half[0]) + sum(b.half[1:], b.half[0]))
    separation = jnp.where(crosses, (abs(along) - reach) / length, -2 * size)
    marks = largest(separation)
    u = [jnp.any(marks[:, 3 * i : 3 * i + 3], axis=1) for i in range(3)]
    w = [jnp.any(marks[:, j::3], axis=1) for j in range(3)]
    edge_a = _chosen(u, a.axes)
    edge_b = _chosen(w, b.axes)
    normal = edge_a.cross(edge_b)
    long = numerics.norm(normal)
    inverse = numerics.safe_divide(sign(normal.dot(offset)), long)
    normal = normal * inverse
    start, end = a.center, b.center
    for mine, axis, half in zip(u, a.axes, a.half, strict=True):
        start = start + axis * jnp.where(mine, 0, half * sign(normal.dot(axis)))
    for mine, axis, half in zip(w, b.axes, b.half, strict=True):
        end = end - axis * jnp.where(mine, 0, half * sign(normal.dot(axis)))
    apart, cos = end - start, edge_a.dot(edge_b)
    p, q = apart.dot(edge_a), apart.dot(edge_b)
    scale = numerics.safe_divide(1.0, long * long)
    half_a, half_b = _chosen_lane(u, a.half), _chosen_lane(w, b.half)
    s = jnp.clip((p - cos * q) * scale, -half_a, half_a)
    t = jnp.clip((cos * p - q) * scale, -half_b, half_b)
    place = (start + edge_a * s + end + edge_b * t) * 0.5
    return Gap(normal.dot(apart), normal, place), pick(marks, separation)


def _chosen(marks: Sequence[Lane], vectors: Sequence[Vector]) -> Vector:
    """Returns the marked one of three vectors; the third if none is marked."""
    return where(marks[0], vectors[0], where(marks[1], vectors[1], vectors[2]))


def _chosen_lane(marks: Sequence[Lane], lanes: Sequence[Lane]) -> Lane:
    """Returns the marked one of three lanes; the third if none is marked."""
    return jnp.where(marks[0], lanes[0], jnp.where(marks[1], lanes[1], lanes[2]))


def facing(box: Solid, normal: Vector) -> tuple[Vector, Vector, Vector]:
    """Returns the face of a box whose outward normal is most opposite to a direction.

    Returns:
        The center of the face, and half its edges, as vectors in the world frame.
    """
    cosines = [u.dot(normal) for u in box.axes]
    marks = largest(stack_points([abs(c) for c in cosines]))
    side = -sign(pick(marks, cosines))
    axes, halves = list(box.axes), list(box.half)
    center = box.center + pick_vector(marks, axes) * (side * pick(marks, halves))
    first = pick_vector(marks, _turned(axes, 1)) * pick(marks, _turned(halves, 1))
    return center, first, pick_vector(marks, _turned(axes, 2)) * pick(marks, _turned(halves, 2))


def clipped(face: Face, center: Vector, first: Vector, second: Vector) -> Points:
    """Clips a parallelogram of the other solid to the sides of the reference face.

    The candidates are the starts and ends of the four clipped edges of the parallelogram, and the
    corners of the reference face that lie within it.

    Args:
        face: the reference face.
        center: center of the parallelogram.
        first: half of one edge; zero for a point.
        second: half of the other edge; zero for a line.
    """
    frame = (face.x, face.y, face.normal)
    middle, p, q = (
        Vector(*(per_point(u.dot(v)) for u in frame)) for v in (center - face.center, first, second)
    )
    like = middle[0]
    eps = float(jnp.finfo(like.dtype).eps)
    # a tolerance, since sides of stacked boxes coincide
    half_x, half_y = per_point(face.half_x), per_point(face.half_y)
    wide_x, wide_y = half_x * (1 + eps**0.5), half_y * (1 + eps**0.5)

    def signs(numbers: Sequence[float]) -> Array:
        return jnp.asarray(numbers, like.dtype).reshape(1, -1, *(1,) * (like.ndim - 2))

    s, t = signs([i for i, _ in CORNERS]), signs([j for _, j in CORNERS])
    corner = middle + p * s + q * t
    edge = p * signs([-2.0, 0.0, 2.0, 0.0]) + q * signs([0.0, -2.0, 0.0, 2.0])
    low, high = 0.0, 1.0
    for x, dx, limit in ((corner[0], edge[0], wide_x), (corner[1], edge[1], wide_y)):
        moves = abs(dx) > 16 * eps * limit
        inverse = numerics.safe_divide(1.0, jnp.where(moves, dx, 0))
        ends = (-limit - x) * inverse, (limit - x) * inverse
        inside = jnp.where(abs(x) <= limit, 0.0, 2.0).astype(like.dtype)
        low = jnp.maximum(low, jnp.where(moves, jnp.minimum(*ends), inside))
        high = jnp.minimum(high, jnp.where(moves, jnp.maximum(*ends), 1 - inside))
    hit = low <= high
    low, high = (jnp.where(hit, x, 0) for x in (low, high))
    start, end = corner + edge * low, corner + edge * high
    determinant = p[0] * q[1] - p[1] * q[0]
    inverse = numerics.safe_divide(1.0, determinant)
    x, y = half_x * s - middle[0], half_y * t - middle[1]
    alpha = (x * q[1] - y * q[0]) * inverse
    beta = (y * p[0] - x * p[1]) * inverse
    within = (determinant != 0) & (abs(alpha) <= 1 + eps**0.5) & (abs(beta) <= 1 + eps**0.5)
    z = middle[2] + alpha * p[2] + beta * q[2]
    xs, ys, zs, valid = (
        jnp.concatenate(jnp.broadcast_arrays(*parts), axis=1)
        for parts in (
            (start[0], end[0], half_x * s),
            (start[1], end[1], half_y * t),
            (start[2], end[2], z),
            (hit, hit & (high < 1), within),
        )
    )
    # an overlap that clipping misses: the lowest corner of the incident face
    none = ~jnp.any(valid, axis=1, keepdims=True) & (per_point(face.separation) <= 0)
    lowest = largest(-corner[2])
    corners = jnp.concatenate([lowest, jnp.zeros_like(lowest), jnp.zeros_like(lowest)], axis=1)
    xs, ys, zs = (
        jnp.where(none, jnp.concatenate([c, c, c], axis=1), x)
        for c, x in zip(corner, (xs, ys, zs), strict=True)
    )
    return Points(xs, ys, zs, valid | (none & corners))


def spread(points: Points) -> list[tuple[Lane, Lane, Lane, Lane]]:
    """Chooses up to four points that span the contact.

    Returns:
        x, y, z and a mask of existing points, for each point.
    """
    x, y, z, valid = points
    far = jnp.asarray(jnp.inf, z.dtype)
    chosen = []

    def add(score: Array, least: Lane | None = None) -> tuple[Lane, Lane]:
        marks = largest(jnp.where(valid, score, -far))
        exists = jnp.any(marks & valid, axis=1)
        if least is not None:
            exists &= jnp.max(jnp.where(valid, score, -far), axis=1) > least
        at = [pick(marks, lanes) for lanes in (x, y, z)]
        chosen.append((*at, exists))
        return at[0], at[1]

    x0, y0 = (per_point(c) for c in add(-(z + STEADY[0] * x + STEADY[1] * y)))
    dx, dy = x - x0, y - y0
    square = dx * dx + dy * dy
    x1, y1 = (per_point(c) for c in add(square, 0.0))
    ux, uy = x1 - x0, y1 - y0
    area = ux * dy - uy * dx
    tiny = 1e-6 * jnp.max(ux * ux + uy * uy, axis=1)
    add(area, tiny)
    add(-area, tiny)
    return chosen
