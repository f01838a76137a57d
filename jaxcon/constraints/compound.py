"""Several sliders and hinges in series between two bodies, as one joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints import gimbal, primitives
from jaxcon.constraints.joints import (
    anchors,
    normals,
    relative_orientation,
    unit_vector,
)
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label

DEPENDENT = 1e-6
"""The volume that unit axes span below which they count as dependent."""


@dataclass(frozen=True)
class Freedoms:
    """How compound joints of one group move: their rows and coordinates.

    Attributes:
        slides, hinges: how many of them, at most three each.
        ball: whether every turn is free.
    """

    slides: int
    hinges: int
    ball: bool
    in_b = gimbal.IN_B

    @property
    def coordinates(self) -> dict[str, str]:
        """The units of "travel_1", …, then of "angle_1", and so on."""
        travels = {f"travel_{i + 1}": "m" for i in range(self.slides)}
        return travels | {f"angle_{i + 1}": "rad" for i in range(self.hinges)}

    def rows(self, p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """Nothing moves across the slides or turns but about the hinges."""
        points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        if not self.slides:
            rows = primitives.meet(*points)
        else:
            across = [p[f"normal_{i + 1}"] for i in range(3 - self.slides)]
            rows = [primitives.travel(a.direction(n), *points) for n in across]
        if self.ball or self.hinges == 3:
            return rows
        if not self.hinges:
            return rows + primitives.same_orientation(a, b, p["orientation"])
        if self.hinges == 2:
            return rows + gimbal.two_rows(p, a, b)
        n = a.direction(p["axis_1"])
        sides = (b.direction(p["first_b"]), b.direction(p["second_b"]))
        return rows + [primitives.angle_between(n, u) for u in sides]

    def coordinate_rows(self, name: str, p: dict[str, Any], a: Any, b: Any) -> dict[str, Row]:
        """A travel since assembly [m], or an angle about a hinge [rad]; three angles at once."""
        if self.hinges == 3 and name.startswith("angle"):
            angles = gimbal.three_angles(p, a, b)
            return {f"angle_{i}": row for i, row in enumerate(angles, 1)}
        return {name: self._coordinate(name, p, a, b)}

    def _coordinate(self, name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """The row of one travel or angle."""
        kind, _, index = name.partition("_")
        if kind == "travel":
            points = a.point(p["anchor_a"]), b.point(p["anchor_b"])
            return primitives.travel(a.direction(p[name]), *points)
        if self.hinges == 2:
            return gimbal.two_angles(int(index), p, a, b)
        first, second = a.direction(p["first_1"]), a.direction(p["second_1"])
        return primitives.turn(first, second, b.direction(p["first_b"]))


@dataclass(frozen=True)
class Compound:
    """Up to three slides, then up to three hinges through one point, in series; in space.

    The point of b slides in a along the first axes, which move with a, and b turns about the hinges
    one after the other, the first fixed in a and the last in b. Axes need not be perpendicular. No
    massless bodies lie between: 6 rows less the freedoms remain.

    Its coordinates are "travel_1", …, "angle_1", …, in the order of the axes, and springs, motors
    and the rest act on each by name. Of three hinges the middle one stays between the two positions
    where the axes fall into a plane (gimbal lock), ±90° where they are perpendicular: there its
    rate is not that of any motion.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point: through which all hinges go, world frame at assembly, (3,) [m]; the second body's
            centre of mass unless given.
        slides: axes, world frame at assembly, each (3,), any length but zero; independent.
        hinges: axes likewise; no two in succession parallel, three not in one plane.
        ball: every turn is free, in place of hinges; turns then have no coordinates.
    """

    name: str
    body_a: str
    body_b: str
    point: Any = None
    slides: tuple[Any, ...] = ()
    hinges: tuple[Any, ...] = ()
    ball: bool = False
    oriented = True
    dims = (3,)

    def __post_init__(self) -> None:
        checks.flag(label(self), "ball", self.ball)

    @property
    def kind(self) -> Freedoms:
        """What joints that move alike share."""
        return Freedoms(len(self.slides), len(self.hinges), self.ball)

    @property
    def coordinates(self) -> dict[str, str]:
        """The unit of each by its name."""
        return self.kind.coordinates

    def rows(self, p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """Returns the rows of joints of this kind."""
        return self.kind.rows(p, a, b)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The point in both frames, the axes, and what reads travels and angles.

        Raises:
            ValueError: too many axes, or dependent ones.
        """
        slides = self._axes("slides", a)
        hinges = self._axes("hinges", a)
        if self.ball and hinges:
            raise ValueError(f"{label(self)}: a ball joint turns freely; give hinges or ball.")
        params = anchors(self, a, b) | self._travels(slides, a)
        if len(hinges) == 3:
            return params | gimbal.attach_three(hinges, a, b)
        if len(hinges) == 2:
            return params | gimbal.attach_two(hinges, a, b)
        if len(hinges) == 1:
            (n,) = hinges
            u, w = normals(n)
            in_a = {"axis_1": n, "first_1": u, "second_1": w}
            params |= {key: a.local_direction(x) for key, x in in_a.items()}
            return params | {"first_b": b.local_direction(u), "second_b": b.local_direction(w)}
        return params if self.ball else params | {"orientation": relative_orientation(a, b)}

    def _travels(self, slides: list[Array], a: Pose) -> dict[str, Array]:
        """The dual basis of the slides, d_i·s_j = δ_ij, in their span, and normals of that."""
        if not slides:
            return {}
        across: list[Array] = []
        if len(slides) == 1:
            across = normals(slides[0])
        elif len(slides) == 2:
            n = jnp.cross(slides[0], slides[1])
            across = [n / jnp.sqrt(jnp.dot(n, n))]
        x, y, z = *slides, *across
        volume = jnp.dot(x, jnp.cross(y, z))
        duals = (jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y))[: len(slides)]
        travels = {f"travel_{i}": a.local_direction(d / volume) for i, d in enumerate(duals, 1)}
        return travels | {f"normal_{i}": a.local_direction(n) for i, n in enumerate(across, 1)}

    def _axes(self, what: str, pose: Pose) -> list[Array]:
        """Unit vectors, checked.

        Raises:
            ValueError: there are more than three, or they are dependent.
        """
        given = getattr(self, what)
        if not isinstance(given, tuple) or len(given) > 3:
            raise ValueError(
                f"{label(self)}: {what} must be a tuple of at most 3 axes, got {given!r}."
            )
        axes = [unit_vector(self, f"{what}[{i}]", x, pose) for i, x in enumerate(given)]
        if checks.is_concrete(axes):
            few = np.array(axes, float).reshape(-1, 3)
            volume = np.sqrt(max(np.linalg.det(few @ few.T), 0.0))
            if volume < DEPENDENT:
                raise ValueError(
                    f"{label(self)}: its {what} must have independent axes, got"
                    f" {checks.numerals(few)}."
                )
        return axes
