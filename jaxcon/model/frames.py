"""The motion of bodies by lanes, and the points and directions attached to them.

A `Frame` holds the motion of many bodies of one kind, one lane a component. Joints ask it for a
`Point` or a `Direction` attached to the body, and these answer the four questions from which every
row is made: where, how fast, with which acceleration when a = 0, and which generalized force a
world force n is (`pull`). So no joint knows in which dimension it lives.

For a point s of a spatial body with rotation R and body rate ω:
    p = x + R s,  ṗ = ẋ + Rω × R s,  p̈ = ẍ + R(ω̇ × s) + Rω × (Rω × R s),
so a force n at p does the work n·ṗ = n·ẋ + (s × Rᵀn)·ω.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from jaxcon.core.lanes import Matrix, Vector, perpendicular, times, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Lane
from jaxcon.geometry import quaternion
from jaxcon.model.turning import cos_sin


@dataclass(frozen=True)
class Point:
    """A point of a body: where it is, how it moves, and what a force there does.

    Attributes:
        position, velocity: world frame [m], [m/s].
        bias: its acceleration when the body's a is zero [m/s²].
        pull: the generalized force on the body of a world force there.
    """

    position: Vector
    velocity: Vector
    bias: Vector
    pull: Callable[[Vector], Vector]


@dataclass(frozen=True)
class Direction:
    """A unit vector fixed in a body; attributes as of `Point`, `pull` of n the gradient of n·u."""

    position: Vector
    velocity: Vector
    bias: Vector
    pull: Callable[[Vector], Vector]


@pytree
class Frame:
    """The motion of bodies of one kind; the world itself where there is nothing more.

    Attributes:
        position, velocity: of the frame's origin, world frame [m], [m/s].
    """

    position: Vector
    velocity: Vector
    oriented: ClassVar[bool] = False

    def point(self, anchor: Any) -> Point:
        """The origin: only bodies with an orientation have other points."""
        return Point(self.position, self.velocity, zeros(len(self.position)), lambda n: n)

    def material(self, place: Vector) -> Point:
        """What of the body is now at a place of the world, moving as its origin does."""
        return Point(place, self.velocity, zeros(len(place)), lambda n: n)

    def gather(self, take: Callable[[Lane], Lane]) -> Frame:
        """The frames of some of the bodies."""
        return jax.tree.map(take, self)


@pytree
class WorldFrame:
    """The frame that does not move, and every frame fixed to it."""

    dim: int = static()
    oriented: ClassVar[bool] = True

    def point(self, anchor: Any) -> Point:
        """A point of the world."""
        rest = zeros(self.dim)
        return Point(Vector.of(anchor), rest, rest, lambda n: Vector())

    def material(self, place: Vector) -> Point:
        """The point of the world itself."""
        return self.point(place)

    def direction(self, axis: Any) -> Direction:
        """A direction of the world."""
        rest = zeros(self.dim)
        return Direction(Vector.of(axis), rest, rest, lambda n: Vector())

    @property
    def angle(self) -> Lane:
        """No turn (in the plane)."""
        return 0.0

    laps: ClassVar[float] = 0.0

    @property
    def quaternion(self) -> Vector:
        """No turn (in space)."""
        return quaternion.IDENTITY

    @property
    def omega(self) -> Any:
        """No turning."""
        return 0.0 if self.dim == 2 else zeros(3)

    @property
    def spin(self) -> Vector:
        """No turning (in space)."""
        return zeros(3)

    def turn(self, torque: Any) -> Vector:
        """The world takes up no torque."""
        return Vector()

    def torque(self, n: Vector) -> Vector:
        """The world takes up no torque (in space)."""
        return Vector()


@pytree
class PlanarFrame(Frame):
    """Rigid bodies in the plane; `angle` [rad] lacks `laps` whole turns, `omega` [rad/s]."""

    angle: Lane
    omega: Lane
    rotation: Matrix
    laps: Lane = 0.0
    oriented: ClassVar[bool] = True

    @classmethod
    def of(cls, q: Vector, v: Vector) -> PlanarFrame:
        """From coordinates (x, y, θ) and velocities (ẋ, ẏ, ω)."""
        c, s = cos_sin(q[2])
        rotation = Matrix(Vector(c, -s), Vector(s, c))
        return cls(Vector(*q[:2]), Vector(*v[:2]), q[2], v[2], rotation)

    def after(self, laps: Lane) -> PlanarFrame:
        """The frames after whole turns that the angle does not have."""
        return dataclasses.replace(self, laps=laps)

    def point(self, anchor: Any) -> Point:
        """p = x + R s, ṗ = ẋ + ω s⊥, bias −ω² R s, pull (n, R s × n)."""
        r = self.rotation @ Vector.of(anchor)
        return Point(
            self.position + r,
            self.velocity + perpendicular(r) * self.omega,
            r * -times(self.omega, self.omega),
            lambda n: Vector(*n, r.cross(n)),
        )

    def material(self, place: Vector) -> Point:
        """What of the body is now at a place of the world."""
        return self.point(self.rotation.T @ (place - self.position))

    def direction(self, axis: Any) -> Direction:
        """u = R û, u̇ = ω u⊥, bias −ω² u, pull (0, 0, u × n)."""
        u = self.rotation @ Vector.of(axis)
        return Direction(
            u,
            perpendicular(u) * self.omega,
            u * -times(self.omega, self.omega),
            lambda n: Vector(0.0, 0.0, u.cross(n)),
        )

    def turn(self, torque: Lane) -> Vector:
        """The generalized force of a torque [N m]."""
        return Vector(0.0, 0.0, torque)


@pytree
class SpatialFrame(Frame):
    """Rigid bodies in space.

    Attributes:
        omega, spin: the angular velocity in the body frame and in the world frame [rad/s].
        rotation: body to world.
    """

    quaternion: Vector
    omega: Vector
    rotation: Matrix
    spin: Vector
    oriented: ClassVar[bool] = True

    @classmethod
    def of(cls, q: Vector, v: Vector) -> SpatialFrame:
        """From coordinates (x, q) and velocities (ẋ, ω)."""
        turn = Vector(*q[3:])
        rotation = quaternion.rotation(turn)
        omega = Vector(*v[3:])
        return cls(Vector(*q[:3]), Vector(*v[:3]), turn, omega, rotation, rotation @ omega)

    def point(self, anchor: Any) -> Point:
        """p = x + R s, ṗ = ẋ + Rω × R s, bias Rω × (Rω × R s), pull (n, s × Rᵀn)."""
        s = Vector.of(anchor)
        arm = self.rotation @ s
        swing = self.spin.cross(arm)
        return Point(
            self.position + arm,
            self.velocity + swing,
            self.spin.cross(swing),
            lambda n: Vector(*n, *s.cross(self.rotation.T @ n)),
        )

    def material(self, place: Vector) -> Point:
        """What of the body is now at a place of the world."""
        return self.point(self.rotation.T @ (place - self.position))

    def direction(self, axis: Any) -> Direction:
        """u = R û, u̇ = Rω × u, bias Rω × (Rω × u), pull (0, û × Rᵀn)."""
        axis = Vector.of(axis)
        u = self.rotation @ axis
        swing = self.spin.cross(u)
        return Direction(
            u,
            swing,
            self.spin.cross(swing),
            lambda n: Vector(*zeros(3), *axis.cross(self.rotation.T @ n)),
        )

    def turn(self, torque: Vector) -> Vector:
        """The generalized force of a torque in the body frame [N m]."""
        return Vector(*zeros(3), *torque)

    def torque(self, n: Vector) -> Vector:
        """The generalized force of a torque in the world frame [N m], the gradient of n·Rω."""
        return self.turn(self.rotation.T @ n)
