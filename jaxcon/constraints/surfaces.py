"""Planes fixed in a body, on which other bodies roll and slide."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import basis, unit
from jaxcon.constraints.primitives import Row
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.frames import Direction, Point


class Plane:
    """A plane or line fixed in a body: its point, normal and tangents, by lanes."""

    def __init__(self, p: dict[str, Any], a: Any) -> None:
        self.point = a.point(p["anchor_a"])
        self.normal: Any = a.direction(p["normal"]) if "normal" in p else None
        self.tangents = [a.direction(p[side]) for side in ("first_a", "second_a") if side in p]

    def height(self, center: Point) -> Row:
        """n·(c − p)."""
        return primitives.travel(self.normal, self.point, center)

    def along(self, tangent: Direction, center: Point) -> Row:
        """t·(c − p), whose rate is that of c over the plane along t."""
        return primitives.travel(tangent, self.point, center)


def normal(joint: Any, a: Pose) -> Array:
    """The unit normal of a joint's plane, world frame; the last axis of the world unless given."""
    if joint.normal is None:
        return jnp.eye(a.position.shape[0], dtype=a.position.dtype)[-1]
    return unit(joint, "normal", a)


def surface(n: Array, a: Pose) -> dict[str, Array]:
    """The normal and the tangents of a plane in its body's frame."""
    directions = zip(("normal", "first_a", "second_a"), basis(n), strict=False)
    return {name: a.local_direction(x) for name, x in directions}
