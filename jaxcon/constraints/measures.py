"""Measures of the motion of a body in another one: joints without rows, with one coordinate.

Like `Span` and `Twist`, they constrain nothing. Limits, springs, dampers and actuators act on their
coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from jaxcon.constraints.base import Joint
from jaxcon.constraints.joints import anchors, relative_orientation
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import label

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame


@dataclass(frozen=True)
class RotationAngle(Joint):
    """The angle by which b is turned in a since assembly, about any axis: no rows, one coordinate.

    The coordinate "angle" is θ = ‖φ‖ in [0, π], with φ the rotation vector of b in a. Its rate is
    n·(ω_b − ω_a), with the axis n = φ/θ of the rotation. At θ = 0 the axis is undefined, and the
    rate and all forces along θ are zero. A `Limit` with `upper` keeps a ball joint within a cone of
    rotations.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        point: the reference point of wrenches, world frame at assembly, (3,) [m]; the second body's
            center of mass unless given.
    """

    point: Any = None
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"angle": "half turn"})
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies, and the orientation of b in a."""
        return anchors(self, a, b) | {"orientation": relative_orientation(a, b)}

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns an empty list: an angle constrains nothing."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the angle θ, its rate n·(ω_b − ω_a) and its bias ṅ·(ω_b − ω_a).

        e = q_a* q_b q₀* is the rotation since assembly as a unit quaternion, with q₀ the relative
        orientation at assembly. n = e⃗/‖e⃗‖ has the same components along the axes of a and along
        those of b at assembly.
        """
        relative = quaternion.multiply(quaternion.conjugate(a.quaternion), b.quaternion)
        e = quaternion.multiply(relative, quaternion.conjugate(Vector.of(p["orientation"])))
        e = e * (1 - 2 * (e[0] < 0).astype(e[0].dtype))
        scalar, vector = quaternion.split(e)
        size = numerics.norm(vector)
        inverse = numerics.safe_divide(1.0, size)
        n = vector * inverse
        to_a = quaternion.rotation(Vector.of(p["orientation"]))
        ω_a, ω_b = a.omega, to_a @ b.omega
        # ė⃗ = ½ (e₀ (ω_b − ω_a) + e⃗ × (ω_b + ω_a)); ṅ is its part normal to n, over ‖e⃗‖
        change = ((ω_b - ω_a) * scalar + vector.cross(ω_b + ω_a)) * 0.5
        bend = (change - n * n.dot(change)) * inverse
        turning = ω_b - ω_a
        pulls = a.turn(-n), b.turn(to_a.T @ n)
        angle = 2 * numerics.safe_arctan2(size, scalar)
        return Row(angle, n.dot(turning), bend.dot(turning), pulls)


@dataclass(frozen=True)
class Thrust(Joint):
    """The line of action of a thruster, fixed in b: no rows, one coordinate, "thrust".

    A force f along the coordinate acts on b as the force f n at a point p and the torque f m. The
    opposite wrench acts on a at the same point. n and m are fixed in b. The rate of the coordinate
    is n·ṗ + m·ω, relative to a. It is not the derivative of any function of the pose, and the value
    of the coordinate is zero. Motors, servos and dampers may act on it.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`; a is `WORLD` for a thruster.
        point: p, world frame at assembly, (3,) [m]; the second body's center of mass unless given.
        force: n, world frame at assembly, (3,), of any length.
        torque: m, world frame at assembly, (3,) [m] if n has no unit, of any length.
    """

    point: Any = None
    force: Any = (0.0, 0.0, 0.0)
    torque: Any = (0.0, 0.0, 0.0)
    oriented = True
    dims = (3,)
    coordinates = MappingProxyType({"thrust": "rotation"})
    in_b = ("axis", "travel")
    relative = True

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the point in the frames of both bodies, and n and m in the frame of b."""
        owner, dtype = label(self), b.position.dtype
        force = checks.real(owner, "force", self.force, dtype, (3,))
        torque = checks.real(owner, "torque", self.torque, dtype, (3,))
        directions = {"travel": b.local_direction(force), "axis": b.local_direction(torque)}
        return anchors(self, a, b) | directions

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns an empty list: a thruster constrains nothing."""
        return []

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns the coordinate with the value zero and the rate n·ṗ + m·ω of b relative to a.

        The bias is n·p̈ + ṅ·ṗ + ṁ·ω without the accelerations of the bodies.
        """
        end, n, m = b.point(p["anchor_b"]), b.direction(p["travel"]), b.direction(p["axis"])
        start = a.material(end.position)
        speed, turning = end.velocity - start.velocity, b.spin - a.spin
        rate = n.position.dot(speed) + m.position.dot(turning)
        # the material point of a moves with a, not with the point of b, which adds ω_a × speed
        drag = a.spin.cross(speed)
        bias = n.position.dot(end.bias - start.bias - drag)
        bias = bias + n.velocity.dot(speed) + m.velocity.dot(turning)
        pulls = (
            -(start.pull(n.position) + a.torque(m.position)),
            end.pull(n.position) + b.torque(m.position),
        )
        return Row(0 * rate, rate, bias, pulls)
