"""The turning of a body about an axis of its own, as something that motors and dampers act on."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from jaxcon.constraints.joints import anchors, relative_orientation, unit
from jaxcon.constraints.primitives import Row
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose


@dataclass(frozen=True)
class Twist:
    """How b turns in a about an axis n that moves with b: no rows, one coordinate, "twist".

    Its rate is n·(ω_b − ω_a) and its value n·φ with φ the rotation vector of b in a since assembly,
    at most half a turn. The rate is the derivative of no function of the orientation where turns
    about several axes add up, so motors, springs, dampers and rotors may act on it, such as those
    of a ball joint, and motions may not be prescribed or coupled. Equal springs on three
    perpendicular axes have the torque −k φ and the energy ½ k ‖φ‖²; a spring on one axis alone is
    not conservative, and its part of `energy` is only nominal.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        axis: n, world frame at assembly, (3,), any length but zero.
        point: about which wrenches are read, world frame at assembly, (3,) [m]; the second body's
            centre of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    axis: Any
    point: Any = None
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"twist": "rotation"})
    in_b = ("axis",)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The axis in b, and the orientation of b in a."""
        axis = b.local_direction(unit(self, "axis", b))
        return anchors(self, a, b) | {"axis": axis, "orientation": relative_orientation(a, b)}

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """None."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: Any, b: Any) -> Row:
        """n·φ, with the rate n·(ω_b − ω_a) and its bias (ω_b × n)·(ω_b − ω_a)."""
        relative = quaternion.multiply(quaternion.conjugate(a.quaternion), b.quaternion)
        since = quaternion.multiply(quaternion.conjugate(p["orientation"]), relative)
        value = Vector.of(p["axis"]).dot(quaternion.log(since))
        n = b.direction(p["axis"])
        turning = b.spin - a.spin
        pulls = a.torque(-n.position), b.torque(n.position)
        return Row(value, n.position.dot(turning), n.velocity.dot(turning), pulls)
