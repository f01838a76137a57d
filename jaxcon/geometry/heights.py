"""Interpolated height fields z = h(x, y), or z = h(x) in the plane, vectorized over lanes.

The interpolation is cubic convolution. Along an axis, let u be the coordinate in grid steps, and
t = u − i the position in cell i. With the weights w of the four surrounding heights,

    h = Σ w_k(t) h_{i−1+k},   w = ½ (−t + 2t² − t³, 2 − 5t² + 3t³, t + 4t² − 3t³, −t² + t³).

Over two axes, the weights are multiplied. h passes through the given heights and has a continuous
slope. It is exact for polynomials of second degree; for other surfaces the error is of third order
in the grid step. At an edge, the missing height is extrapolated by a parabola through the last
three heights. Beyond the edge, h is linear, with the slope at the edge.

References:
    Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. Acoust., Speech,
        Signal Process. 29 (1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.lanes import Matrix, Vector, total
from jaxcon.core.typing import Array
from jaxcon.staging.worlds import expand_like, per_world

LEAST = 4
"""The number of grid heights along each axis from which h is interpolated at one place."""

NEWTON = 12
"""The number of Newton steps to find a nearest point; on smooth ground, four usually suffice."""


class Shape(NamedTuple):
    """The local shape of a surface at a place x.

    Attributes:
        height: h [m].
        slope: the gradient ∂h/∂x.
        bend: the second derivatives ∂²h/∂x² [1/m].
    """

    height: Array
    slope: Vector
    bend: Matrix


class _Search(NamedTuple):
    """The state of the Newton search for the surface point nearest to a given point.

    Attributes:
        place: the current iterate x [m].
        step: the full Newton step at the iterate [m].
        share: the damping factor of the step.
        square: the squared distance between the surface at x and the given point [m²].
    """

    place: Vector
    step: Vector
    share: Array
    square: Array


@dataclass(frozen=True)
class Surface:
    """Height fields over rectangles, for the entries of a lane such as contacts with the ground.

    Several entries may share one height field.

    Attributes:
        heights: the grid heights, (surface, n_x, n_y) in space and (surface, n_x) in the plane [m].
        owner: for each lane entry, the index of its height field in `heights`.
        size: the edges of the rectangle, lanes [m]; its center is the origin.
    """

    heights: Array
    owner: np.ndarray
    size: Vector

    @property
    def steps(self) -> Vector:
        """The distance between grid points along each axis [m]."""
        return Vector(*(x * (1 / (n - 1)) for x, n in zip(self.size, self._counts, strict=True)))

    @property
    def _counts(self) -> tuple[int, ...]:
        return self.heights.shape[1 : 1 + len(self.size)]

    def at(self, place: Vector) -> Shape:
        """Returns the height, slope and second derivatives of the surface at a place x [m]."""
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
                x = total(expand_like(w[k], x[k]) * x[k] for k in range(LEAST))
            for axis in axes:
                x = x / steps[axis]
            return x

        every = range(len(place))
        bend = (Vector(*(derivative(i, j) for j in every)) for i in every)
        return Shape(derivative(), Vector(*(derivative(i) for i in every)), Matrix(*bend))

    def nearest(self, point: Vector) -> Vector:
        """Finds the surface point nearest to a given point; returns its horizontal place x [m].

        The given point is (x, z) in the plane or (x, y, z) in space. Newton's method starts
        vertically below it. A step that increases the distance is undone and repeated with a
        quarter of its length. On rough ground, the result may be a local minimum of the distance.
        First derivatives are exact (implicit differentiation). The result is NaN if the search
        reaches a height that is not finite.
        """
        constants = jax.lax.stop_gradient((self.heights, self.size, point))
        fixed, point_now = Surface(constants[0], self.owner, constants[1]), constants[2]

        def once(_: Array, search: _Search) -> _Search:
            place = search.place - search.step * search.share
            shape = fixed.at(place)
            tried = _Search(
                place,
                _newton(shape, place, point_now),
                jnp.minimum(2 * search.share, 1),
                _square(shape, place, point_now),
            )
            failed = search._replace(share=0.25 * search.share)
            # steps to a NaN or infinite distance are accepted, so that the result becomes NaN
            farther = (tried.square > search.square) & (tried.square < jnp.inf)
            return jax.tree.map(lambda x, y: jnp.where(farther, x, y), failed, tried)

        below = Vector(*point_now[:-1])
        shape = fixed.at(below)
        start = _Search(
            below,
            _newton(shape, below, point_now),
            jnp.ones_like(shape.height),
            _square(shape, below, point_now),
        )
        end = jax.lax.fori_loop(0, NEWTON, once, start).place
        rest = _newton(self.at(end), end, point, fixed.at(end))
        return end - (rest - jax.lax.stop_gradient(rest))

    def _window(self, starts: list[Array]) -> Array:
        """Returns the grid heights around each lane entry: (4, lane), or (4, 4, lane) in space.

        Args:
            starts: for each axis, the index of the first of the four heights, a lane.
        """
        axes = len(starts)

        def window(heights: Array, *starts: Array) -> Array:
            index = [jnp.asarray(self.owner, jnp.int32).reshape(*(1,) * axes, -1)]
            for axis, start in enumerate(starts):
                four = [1] * (axes + 1)
                four[axis] = LEAST
                steps = jnp.arange(LEAST, dtype=jnp.int32).reshape(four)
                index.append(start.reshape(*(1,) * axes, -1) + steps)
            return heights.at[tuple(index)].get(mode="clip")

        return per_world(window, starts[0].ndim - 1)(self.heights, *starts)


def _weights(u: Array, count: int) -> tuple[Array, tuple[Vector, Vector, Vector]]:
    """Returns the weights of the four grid heights around a place, along one axis.

    Args:
        u: the coordinate in grid steps.
        count: the number of grid heights along the axis.

    Returns:
        The index of the first of the four heights, and the weights (w, w′, w″): w and its first and
        second derivative with respect to u.
    """
    inside = jnp.clip(u, 0, count - 1)
    cell = jax.lax.stop_gradient(jnp.clip(jnp.floor(inside), 0, count - 2))
    t, beyond = inside - cell, u - inside
    start = jnp.clip(cell - 1, 0, count - LEAST).astype(jnp.int32)
    first, last = cell == 0, cell == count - 2
    value, slope, bend = (_at_edges(w, first, last) for w in _cubics(t))
    bend = bend * (beyond == 0).astype(u.dtype)
    return start, (value + slope * beyond, slope, bend)


def _cubics(t: Array) -> tuple[Vector, Vector, Vector]:
    """Returns the four interpolation weights w in the interior, and their derivatives w′ and w″.

    Args:
        t: the position in a cell, from 0 to 1. The weights belong to the heights at −1, 0, 1 and 2.
    """
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
    """Converts interior weights to the weights of four heights inside the grid.

    In a cell at an edge, one of the four heights would lie outside the grid. It is extrapolated as
    3h₀ − 3h₁ + h₂ from the three heights nearest to the edge, which receive its weight. The fourth
    height inside the grid has the weight 0.

    Args:
        w: the interior weights.
        first: True in the first cell of the axis.
        last: True in the last cell of the axis.
    """
    a, b, c, d = w
    left = b + 3 * a, c - 3 * a, d + a, 0 * a
    right = 0 * a, a + d, b - 3 * d, c + 3 * d
    weights = zip(left, right, w, strict=True)
    return Vector(*(jnp.where(first, x, jnp.where(last, y, z)) for x, y, z in weights))


def _square(shape: Shape, place: Vector, point: Vector) -> Array:
    """Returns the squared distance ‖x − X‖² + (h − Z)² between (x, h) and (X, Z).

    Args:
        shape: the surface at x, of which the height h is used.
        place: x.
        point: (X, Z).
    """
    aside, off = place - Vector(*point[:-1]), shape.height - point[-1]
    return total(x * x for x in aside) + off * off


def _newton(shape: Shape, place: Vector, point: Vector, at: Shape | None = None) -> Vector:
    """Returns the Newton step H⁻¹ g, to be subtracted from x, toward the nearest surface point.

    The step minimizes half the squared distance of the surface point at x from a point (X, Z). The
    gradient is g = x − X + (h − Z) ∇h, and the Hessian is H = 1 + ∇h ∇hᵀ + (h − Z) ∇²h. If H is
    not clearly positive definite, its last term is left out.

    Args:
        shape: the surface at x, from which g is computed.
        place: x.
        point: (X, Z).
        at: the surface at x, constant under differentiation, from which H is computed; None to
            compute H from `shape`, too.
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


def _determinant(h: Sequence[Sequence[Array]]) -> Array:
    return h[0][0] if len(h) == 1 else h[0][0] * h[1][1] - h[0][1] * h[1][0]


def _solve(h: Sequence[Sequence[Array]], y: Vector) -> Vector:
    if len(h) == 1:
        return y * (1 / h[0][0])
    x = Vector(h[1][1] * y[0] - h[0][1] * y[1], h[0][0] * y[1] - h[1][0] * y[0])
    return x * (1 / _determinant(h))
