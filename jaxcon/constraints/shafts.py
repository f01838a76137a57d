"""Joints between shafts at an angle: the cross (Cardan) joint and the constant-velocity joint."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import (
    PERPENDICULAR,
    anchors,
    check_perpendicular,
    triad,
    unit,
)
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label


@dataclass(frozen=True)
class Universal:
    """A cross (Cardan, Hooke) joint in space, 4 rows; two turns are free.

    Two points meet, and an axis n_a of a stays normal to an axis n_b of b: n_a·n_b = 0.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: where the axes cross, world frame at assembly, (3,) [m].
        axis_a, axis_b: of the cross in a and in b, world frame at assembly, (3,), any length but
            zero; perpendicular.
    """

    name: str
    body_a: str
    body_b: str
    point: Any
    axis_a: Any
    axis_b: Any
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"angle_a": "rad", "angle_b": "rad"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, and in each its axis and pointers that read its angle."""
        n_a, n_b = unit(self, "axis_a", a), unit(self, "axis_b", b)
        check_perpendicular(self, n_a, n_b)
        across = jnp.cross(n_a, n_b)
        return anchors(self, a, b) | {
            "axis_a": a.local_direction(n_a),
            "first_a": a.local_direction(n_b),
            "second_a": a.local_direction(across),
            "axis_b": b.local_direction(n_b),
            "first_b": b.local_direction(n_a),
            "second_b": b.local_direction(across),
        }

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """p_b − p_a = 0, n_a·n_b = 0."""
        rows = primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"]))
        n_a, n_b = a.direction(p["axis_a"]), b.direction(p["axis_b"])
        return [*rows, primitives.angle_between(n_a, n_b)]

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """The angle of the cross in a about n_a, or of b in the cross about n_b [rad].

        The cross holds n_a and n_b. Where it has turned by α in a, n_b = cos α n_b⁰ + sin α c with
        c = n_a × n_b⁰; where b has turned by β in the cross, n_a = cos β n_a⁰ + sin β c in b.
        """
        if name == "angle_a":
            first, second = a.direction(p["first_a"]), a.direction(p["second_a"])
            return primitives.turn(first, second, b.direction(p["axis_b"]))
        first, second = b.direction(p["first_b"]), b.direction(p["second_b"])
        row = primitives.turn(first, second, a.direction(p["axis_a"]))
        return row._replace(pulls=row.pulls[::-1])


@dataclass(frozen=True)
class ConstantVelocity:
    """Two shafts at any angle below π that turn equally fast, in space, 4 rows.

    The shafts meet, and the turn from where they would be in line is about an axis normal to both:
    a unit quaternion (w, x, y, z) with z along the shaft of a has z = 0. With a₁, a₂ normal to the
    shaft in a, and b₁, b₂ the same directions in b when the shafts are in line,

        φ = a₂·b₁ − a₁·b₂ = 4 w z = (1 + cos β) sin τ,

    of the bend β and the twist τ. Turning a by α and b by α′ about their own shafts takes φ from 0
    to 2 w² sin(α′ − α), so that α′ = α at every bend.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: where the shafts meet, world frame at assembly, (3,) [m].
        axis: of the shaft of a, world frame at assembly, (3,), any length but zero.
        axis_b: of that of b, in line with `axis` unless given; both shafts turn equally fast in the
            right-handed sense about these.
    """

    name: str
    body_a: str
    body_b: str
    point: Any
    axis: Any
    axis_b: Any = None
    oriented = True
    dims = (3,)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, and the directions normal to the shafts."""
        n, u, w = triad(self, a)
        m = n if self.axis_b is None else unit(self, "axis_b", b)
        check_bend(self, n, m)
        return anchors(self, a, b) | {
            "first_a": a.local_direction(u),
            "second_a": a.local_direction(w),
            "first_b": b.local_direction(bent(n, m, u)),
            "second_b": b.local_direction(bent(n, m, w)),
        }

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """p_b − p_a = 0, a₂·b₁ − a₁·b₂ = 0."""
        a1, a2 = a.direction(p["first_a"]), a.direction(p["second_a"])
        b1, b2 = b.direction(p["first_b"]), b.direction(p["second_b"])
        twist = primitives.difference(
            primitives.angle_between(a2, b1), primitives.angle_between(a1, b2)
        )
        return [*primitives.meet(a.point(p["anchor_a"]), b.point(p["anchor_b"])), twist]


def check_bend(joint: Any, n: Array, m: Array) -> None:
    """Checks, where they are concrete, that two shafts do not point at each other.

    Raises:
        ValueError: they do.
    """
    if checks.is_concrete((n, m)) and float(n @ m) < PERPENDICULAR - 1:
        raise ValueError(
            f"{label(joint)}: axis and axis_b are opposite, which leaves the bend between them"
            " without a plane; let both point on along the shafts, from a to b."
        )


def bent(n: Array, m: Array, x: Array) -> Array:
    """x after the shortest turn from the unit vector n to the unit vector m; m ≠ −n.

    R x = x + k × x + k × (k × x)/(1 + n·m) with k = n × m.
    """
    k = jnp.cross(n, m)
    across = jnp.cross(k, x)
    return x + across + jnp.cross(k, across) / (1 + n @ m)
