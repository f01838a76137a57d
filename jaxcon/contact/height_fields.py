"""Contact of balls and points with a height field."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.pairs import check_oriented
from jaxcon.constraints.primitives import Row
from jaxcon.contact import point_sets
from jaxcon.contact.contact_rows import MATERIAL, Touch, contact_rows, material
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.geometry.heights import LEAST, Surface
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import BetweenBodies, Grid, label

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

STRAIGHT = 0.1
"""The tolerance of the search for the nearest point: the sine of an angle.

The angle is between the surface normal and the line from the surface point to the given point. It
is zero at the exact nearest point.
"""


@dataclass(frozen=True)
class HeightFieldContact(BetweenBodies):
    """Contact of a body's balls or points with another body's ground z = h(x, y).

    The height h is continuously differentiable and interpolates a grid (`geometry.heights`); beyond
    the grid it is extrapolated linearly. φ is the distance of a ball from the nearest point of the
    surface, and φ̇ its velocity along the normal there. A ball touches at one point. In a valley
    narrower than the ball, this point is a local minimum of the distance, found by descent from the
    point below the center. A box or capsule touches only at the given points, such as
    `center=jc.contacts.box_corners(…)`; the ground between them has no effect. λ has the shape (1 +
    tangents,) for one ball, and (k, 1 + tangents) for k balls.

    Attributes:
        name: name of the element, unique in the scene.
        body_a: the body with the field, or `WORLD`.
        body_b: the body with the ball.
        heights: height z at the points of the grid [m], (n_x, n_y), or (n_x,) in the plane, with at
            least 4 points along each axis. A world fails if the search for the nearest point reads
            a NaN or infinite height; such heights elsewhere have no effect.
        size: edge lengths of the rectangle between the first and last points of the grid [m], (2,),
            or () in the plane.
        radius: radius r ≥ 0 [m].
        center: center of the ball in the world at assembly, (dim,) [m], or centers of k balls with
            the same radius, (k, dim). If None, the center of mass.
        position: center of the rectangle at z = 0, in the world at assembly, (dim,) [m]. If None,
            the origin of the user's frame of body a.
        orientation: orientation of the axes x, y and z in the world at assembly, an angle [rad] in
            the plane and a quaternion (4,) in space. If None, the orientation of the user's frame.
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
        """Returns the field in a's frame, the balls in b's frame, and the material parameters.

        Raises:
            ValueError: a field has a wrong shape, or a number is out of range.
        """
        owner, dtype, axes = label(self), b.position.dtype, b.position.shape[0] - 1
        check_oriented(self, a)
        size = checks.real(owner, "size", self.size, dtype, (2,) if axes == 2 else (), above=0)
        radius = checks.real(owner, "radius", self.radius, dtype, least=0)
        middle, frame = point_sets.own_frame(self, a, own_a)
        center = point_sets.own_points(self, "center", self.center, b)
        field = {"heights": Grid(self._grid(axes, dtype)), "size": size, "anchor_a": middle} | frame
        return field | {"anchor_b": center, "radius": radius} | material(self, a, b)

    def _grid(self, axes: int, dtype: DType) -> Array:
        """Returns the heights after checking their shape and values."""
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
    def bounds(
        p: dict[str, Any], a: JointFrame, b: JointFrame, dt: Array
    ) -> tuple[list[Row], dict[str, Any]]:
        """Returns the contact rows of each ball, and further fields of their `BoundSet`.

        The gap is n·(c − x) − r, with center c and radius r of the ball. x is the nearest point of
        the surface, and n the normal there.
        """
        center = b.point(p["anchor_b"]).position
        axes = [a.direction(p[name]).position for name in point_sets.AXES[: len(center)]]
        offset = center - a.point(p["anchor_a"]).position
        local = Vector(*(u.dot(offset) for u in axes))
        distance, normal = above(surface(p, center[0]), local)
        n = functools.reduce(operator.add, (u * x for u, x in zip(axes, normal, strict=True)))
        gap = distance - p["radius"]
        middle = center - n * (p["radius"] + gap / 2)
        return contact_rows(p, Touch(gap, n, middle, a, b), dt)


def surface(p: dict[str, Any], like: Lane) -> Surface:
    """Returns the surface of each element, repeated for each of its contact points."""
    heights = p["heights"].values
    lanes, fields = jnp.shape(like)[0], heights.shape[0]
    size = p["size"] if isinstance(p["size"], Vector) else Vector(p["size"])
    return Surface(heights, np.arange(lanes) // (lanes // fields), size)


def above(ground: Surface, point: Vector) -> tuple[Lane, Vector]:
    """Returns the distance of a point from the ground, and the normal at the nearest point.

    High above rough ground the search for the nearest point may not converge. The result is
    then the distance to the last iterate, an upper bound. It is positive if the point is higher
    than the ground at its horizontal position, and negative otherwise.
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
    converged = (across <= STRAIGHT * length) & (straight * side >= 0) | (length <= tiny)
    return jnp.where(jax.lax.stop_gradient(converged), straight, side * length), normal
