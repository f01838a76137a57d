"""Balls and points on a height field."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import point_sets
from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.touching import MATERIAL, Touch, material, touching
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.heights import LEAST, Surface
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import Grid, label

STRAIGHT = 0.1
"""The sine up to which the way from a surface to a point counts as normal to it."""


@dataclass(frozen=True)
class HeightFieldContact:
    """A ball or a point of a body, or several, on the ground z = h(x, y) that another has.

    h is C¹ between the heights of a grid and goes through them (`geometry.heights`); beyond the
    grid it goes on straight. φ is the distance from the surface to the ball, at its nearest point,
    and φ̇ the velocity along its normal. A ball touches in one point: in a valley that is narrower
    than the ball, in the nearest one to which a descent leads from the place below its centre. A
    box or a capsule touches by the points that are given, `center=jc.box_corners(…)`; what of the
    ground lies between them is not felt. λ of one ball is (1 + tangents,), of k (k, 1 + tangents).

    Attributes:
        name: unique in the scene.
        body_a: that has the field, or `WORLD`.
        body_b: that has the ball.
        heights: z at the points of the grid, (n_x, n_y), in the plane (n_x,), at least 4 along each
            axis [m].
        size: the edges of the rectangle from the first to the last points of the grid, (2,), in
            the plane () [m].
        radius: r ≥ 0 [m].
        center: of the ball, world, at assembly, (dim,) [m], or of several with one radius,
            (k, dim); the centre of mass unless given.
        position: of the middle of the rectangle, where z = 0, world, at assembly, (dim,) [m]; the
            origin of the frame in which body a was given unless given.
        orientation: of x, y and z in the world at assembly, an angle [rad] in the plane and a
            quaternion (4,) in space; those of that frame unless given.
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
    heights: Any
    size: Any
    radius: Any = 0.0
    center: Any = None
    position: Any = None
    orientation: Any = None
    friction: Any = 0.0
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    rolling: Any = 0.0
    spinning: Any = 0.0
    framed = True
    optional = MATERIAL

    def attach(self, a: Pose, b: Pose, own_a: Pose, own_b: Pose) -> dict[str, Array]:
        """The field in the frame of a, the ball in that of b, and the material.

        Raises:
            ValueError: a wrong shape, or a number out of range.
        """
        owner, dtype, axes = label(self), b.position.dtype, b.position.shape[0] - 1
        check_oriented(self, a)
        size = checks.real(owner, "size", self.size, dtype, (2,) if axes == 2 else (), above=0)
        radius = checks.real(owner, "radius", self.radius, dtype, least=0)
        middle, frame = point_sets.own_frame(self, a, own_a)
        center = point_sets.own_points(self, "center", self.center, b)
        field = {"heights": Grid(self._grid(axes, dtype)), "size": size, "anchor_a": middle} | frame
        return field | {"anchor_b": center, "radius": radius} | material(self, a, b)

    def _grid(self, axes: int, dtype: Any) -> Array:
        """The heights, checked."""
        owner = label(self)
        try:
            shape = np.shape(self.heights)
        except ValueError as error:
            raise ValueError(f"{owner}: heights must be numbers, as many in each row.") from error
        if len(shape) != axes or min(shape, default=0) < LEAST:
            wanted = "(n_x, n_y)" if axes == 2 else "(n_x,)"
            raise ValueError(
                f"{owner}: heights must have shape {wanted}, at least {LEAST} along each axis, got"
                f" {shape}."
            )
        return checks.real(owner, "heights", self.heights, dtype, shape)

    points = staticmethod(point_sets.given_points)

    @staticmethod
    def bounds(p: dict[str, Any], a: Any, b: Any, dt: Any) -> tuple[list[Row], dict[str, Any]]:
        """n·(c − x) − r, with x the nearest point of the surface and n its normal there."""
        center = b.point(p["anchor_b"]).position
        axes = [a.direction(p[name]).position for name in point_sets.AXES[: len(center)]]
        offset = center - a.point(p["anchor_a"]).position
        local = Vector(*(u.dot(offset) for u in axes))
        distance, normal = above(surface(p, center[0]), local)
        n = functools.reduce(operator.add, (u * x for u, x in zip(axes, normal, strict=True)))
        gap = distance - p["radius"]
        middle = center - n * (p["radius"] + gap / 2)
        return touching(p, Touch(gap, n, middle, a, b), dt)


def surface(p: dict[str, Any], like: Lane) -> Surface:
    """The surfaces of elements, each lane on that of its own."""
    heights = p["heights"].values
    lanes, fields = jnp.shape(like)[0], heights.shape[0]
    size = p["size"] if isinstance(p["size"], Vector) else Vector(p["size"])
    return Surface(heights, np.arange(lanes) // (lanes // fields), size)


def above(ground: Surface, point: Vector) -> tuple[Lane, Vector]:
    """How far a point lies above the nearest one of the ground, and the normal there.

    Where that one has not been found, as high above rough ground, it is the distance from the last
    place looked at, which is not less; its sign is that of the height above the place below.
    """
    place = ground.nearest(point)
    shape = ground.at(place)
    slope = shape.slope
    normal = Vector(*(-slope), 1.0) * (1 / jnp.sqrt(1 + slope.dot(slope)))
    apart = point - Vector(*place, shape.height)
    straight, length = normal.dot(apart), numerics.norm(apart)
    below = ground.at(Vector(*point[:-1])).height
    side = jnp.where(point[-1] > below, 1.0, -1.0).astype(length.dtype)
    across = numerics.norm(apart - normal * straight)
    tiny = STRAIGHT**3 * jnp.min(ground.steps.stack(), axis=0)
    found = (across <= STRAIGHT * length) & (straight * side >= 0) | (length <= tiny)
    return jnp.where(jax.lax.stop_gradient(found), straight, side * length), normal
