"""A surface z = h(x, y) between heights on a grid, by lanes; in the plane a line z = h(x).

Along an axis, with u in steps of the grid and t = u − i the way into cell i,

    h = Σ w_k(t) h_{i−1+k},   w = ½ (−t + 2t² − t³, 2 − 5t² + 3t³, t + 4t² − 3t³, −t² + t³),

and over two axes the product of both. h goes through the heights given, its slope is continuous,
and polynomials of second degree are met exactly, other surfaces to third order in the steps. At an
edge the height that is missing lies on the parabola of the last three; beyond it h goes on straight
with the slope that it has there, so that the surface has no end.

References:
    Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. Acoust., Speech,
        Signal Process. 29 (1981).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.lanes import Matrix, Vector, total
from jaxcon.core.typing import Array
from jaxcon.core.worlds import lift, per_world

LEAST = 4
"""Heights along each axis."""

NEWTON = 12
"""Steps in which the nearest point is found; four are usual, rough ground takes more."""


class Shape(NamedTuple):
    """A surface at a place: its height, slope ∂h/∂x and bend ∂²h/∂x²."""

    height: Array
    slope: Vector
    bend: Matrix


class _Search(NamedTuple):
    """Where a search for the nearest point is: its place, next step, how much of it, distance²."""

    place: Vector
    step: Vector
    share: Array
    square: Array


@dataclass(frozen=True)
class Surface:
    """Surfaces over rectangles, and which of them each lane is about.

    Attributes:
        heights: (surface, n_x, n_y), in the plane (surface, n_x) [m].
        owner: of each lane, its surface.
        size: edges of the rectangle, lanes [m]; its middle is the origin.
    """

    heights: Array
    owner: np.ndarray
    size: Vector

    @property
    def steps(self) -> Vector:
        """The steps of the grid, along each axis [m]."""
        return Vector(*(x * (1 / (n - 1)) for x, n in zip(self.size, self._counts, strict=True)))

    @property
    def _counts(self) -> tuple[int, ...]:
        return self.heights.shape[1 : 1 + len(self.size)]

    def at(self, place: Vector) -> Shape:
        """Height, slope and bend."""
        counts, steps = self._counts, self.steps
        triples = zip(place, self.size, steps, strict=True)
        along = [
            _weights((x + size / 2) / step, n)
            for (x, size, step), n in zip(triples, counts, strict=True)
        ]
        values = self._window([start for start, _ in along])

        def derivative(*axes: int) -> Array:
            x = values
            for axis, (_, orders) in enumerate(along):
                w = orders[axes.count(axis)]
                x = total(lift(w[k], x[k]) * x[k] for k in range(LEAST))
            for axis in axes:
                x = x / steps[axis]
            return x

        every = range(len(place))
        bend = (Vector(*(derivative(i, j) for j in every)) for i in every)
        return Shape(derivative(), Vector(*(derivative(i) for i in every)), Matrix(*bend))

    def nearest(self, point: Vector) -> Vector:
        """The place below the point of the surface that is nearest to a point (x, …, z).

        By Newton's method from the place below the point itself. A step that does not come nearer
        is taken back and tried again by a quarter, which rough ground needs: there the search ends
        in the first hollow that it finds, which need not be the nearest. Differentiated at its end
        as the solution that it is, to first order.
        """
        known = jax.lax.stop_gradient((self.heights, self.size, point))
        fixed, point_now = Surface(known[0], self.owner, known[1]), known[2]

        def once(_: Any, search: _Search) -> _Search:
            place = search.place - search.step * search.share
            shape = fixed.at(place)
            found = _Search(
                place,
                _newton(shape, place, point_now),
                jnp.minimum(2 * search.share, 1),
                _square(shape, place, point_now),
            )
            failed = search._replace(share=0.25 * search.share)
            nearer = found.square <= search.square
            return jax.tree.map(lambda x, y: jnp.where(nearer, x, y), found, failed)

        below = Vector(*point_now[:-1])
        shape = fixed.at(below)
        start = _Search(
            below,
            _newton(shape, below, point_now),
            jnp.ones_like(shape.height),
            _square(shape, below, point_now),
        )
        found = jax.lax.fori_loop(0, NEWTON, once, start).place
        rest = _newton(self.at(found), found, point, fixed.at(found))
        return found - (rest - jax.lax.stop_gradient(rest))

    def _window(self, starts: list[Array]) -> Array:
        """The four heights along each axis around each lane, (4, …, lane)."""
        axes = len(starts)

        def one(heights: Array, *starts: Array) -> Array:
            index = [jnp.asarray(self.owner, jnp.int32).reshape(*(1,) * axes, -1)]
            for axis, start in enumerate(starts):
                four = [1] * (axes + 1)
                four[axis] = LEAST
                steps = jnp.arange(LEAST, dtype=jnp.int32).reshape(four)
                index.append(start.reshape(*(1,) * axes, -1) + steps)
            return heights.at[tuple(index)].get(mode="clip")

        return per_world(one, starts[0].ndim - 1)(self.heights, *starts)


def _weights(u: Array, count: int) -> tuple[Array, tuple[Vector, Vector, Vector]]:
    """The first of four heights, and the weights of these with two derivatives by u."""
    inside = jnp.clip(u, 0, count - 1)
    cell = jax.lax.stop_gradient(jnp.clip(jnp.floor(inside), 0, count - 2))
    t, beyond = inside - cell, u - inside
    start = jnp.clip(cell - 1, 0, count - LEAST).astype(jnp.int32)
    first, last = cell == 0, cell == count - 2
    value, slope, bend = (_at_edges(w, first, last) for w in _cubics(t))
    bend = bend * (beyond == 0).astype(u.dtype)
    return start, (value + slope * beyond, slope, bend)


def _cubics(t: Array) -> tuple[Vector, Vector, Vector]:
    """w, w′ and w″ of the heights at −1, 0, 1 and 2."""
    square = t * t
    value = (
        (2 - t) * square - t,
        (3 * t - 5) * square + 2,
        (4 - 3 * t) * square + t,
        (t - 1) * square,
    )
    slope = (4 - 3 * t) * t - 1, (9 * t - 10) * t, (8 - 9 * t) * t + 1, (3 * t - 2) * t
    bend = 4 - 6 * t, 18 * t - 10, 8 - 18 * t, 6 * t - 2
    return Vector(*value) * 0.5, Vector(*slope) * 0.5, Vector(*bend) * 0.5


def _at_edges(w: Vector, first: Array, last: Array) -> Vector:
    """Weights of four heights that are there: before the first, h = 3h₀ − 3h₁ + h₂."""
    a, b, c, d = w
    left = b + 3 * a, c - 3 * a, d + a, 0 * a
    right = 0 * a, a + d, b - 3 * d, c + 3 * d
    known = zip(left, right, w, strict=True)
    return Vector(*(jnp.where(first, x, jnp.where(last, y, z)) for x, y, z in known))


def _square(shape: Shape, place: Vector, point: Vector) -> Array:
    """Returns the square of the distance, ‖x − X‖² + (h − Z)²."""
    aside, off = place - Vector(*point[:-1]), shape.height - point[-1]
    return total(x * x for x in aside) + off * off


def _newton(shape: Shape, place: Vector, point: Vector, at: Shape | None = None) -> Vector:
    """H⁻¹ g of the half square of the distance, g = x − X + (h − Z) ∇h.

    H = 1 + ∇h ∇hᵀ + (h − Z) ∇²h, without the last term where it would not be positive.

    Args:
        shape: of the surface at the place, for g.
        place: x.
        point: (X, Z).
        at: for H, where it is to be without derivatives.
    """
    off = shape.height - point[-1]
    right = place - Vector(*point[:-1]) + shape.slope * off
    fixed = shape if at is None else at
    away = off if at is None else jax.lax.stop_gradient(off)
    p, rank = fixed.slope, range(len(place))
    plain = [[p[i] * p[j] + float(i == j) for j in rank] for i in rank]
    full = [[plain[i][j] + away * fixed.bend[i][j] for j in rank] for i in rank]
    convex = (full[0][0] > 0.1) & (_determinant(full) > 0.1)
    return _solve([[jnp.where(convex, full[i][j], plain[i][j]) for j in rank] for i in rank], right)


def _determinant(h: Any) -> Array:
    return h[0][0] if len(h) == 1 else h[0][0] * h[1][1] - h[0][1] * h[1][0]


def _solve(h: Any, y: Vector) -> Vector:
    if len(h) == 1:
        return y * (1 / h[0][0])
    x = Vector(h[1][1] * y[0] - h[0][1] * y[1], h[0][0] * y[1] - h[1][0] * y[0])
    return x * (1 / _determinant(h))
