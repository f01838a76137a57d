"""The distance of two points as a coordinate: measured and driven, not constrained."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from jaxcon.constraints import primitives
from jaxcon.constraints.joints import Distance
from jaxcon.constraints.primitives import Row
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose


@dataclass(frozen=True)
class Span:
    """Two points and the line between them: no rows, one coordinate, "stretch" = ‖p_b − p_a‖ − l.

    l is the distance at assembly. Motors, servos, springs and drives on it make hydraulic
    cylinders, tendons and winches, `Pulley` makes a rope over a pulley of two. Where the points
    meet the line has no direction, and what acts along it vanishes.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        point_a, point_b: world points at assembly, (dim,) [m]; the centres of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    point_a: Any = None
    point_b: Any = None
    coordinates = MappingProxyType({"stretch": "m"})

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The two points in their frames, and their distance."""
        ends = {"point_a": self.point_a, "point_b": self.point_b}
        return Distance(self.name, self.body_a, self.body_b, **ends).attach(a, b)

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """None."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """‖p_b − p_a‖ − l [m]."""
        return primitives.distance(a.point(p["anchor_a"]), b.point(p["anchor_b"]), p["length"])
