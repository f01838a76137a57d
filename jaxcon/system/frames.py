"""The motion of bodies as lanes (body, …), and the points and directions attached to them.

A `Frame` has the motion of many bodies of one kind, with one lane for each component. Joints get
from it a `Point` or a `Direction` attached to the body. Both have a position, a velocity, a bias
(the acceleration if the body's acceleration a is zero), and a `pull`. The pull maps a force n in
the world frame to the generalized force on the body, from which rows are made. The code of a joint
is therefore the same in the plane and in space.

For a point s of a spatial body with rotation R and body rate ω:
    p = x + R s,  ṗ = ẋ + Rω × R s,  p̈ = ẍ + R(ω̇ × s) + Rω × (Rω × R s),
so the power of a force n at p is n·ṗ = n·ẋ + (s × Rᵀn)·ω.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax

from jaxcon.core.lanes import Matrix, Vector, perpendicular, times, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry import quaternion
from jaxcon.system.turning import cos_sin


@dataclass(frozen=True)
class Point:
    """A point of a body, with its motion and the generalized force of a force there.

    Attributes:
        position, velocity: position [m] and velocity [m/s] of the point, world frame.
        bias: acceleration of the point for a zero acceleration of the body [m/s²].
        pull: maps a force at the point, world frame, to the generalized force on the body.
    """

    position: Vector
    velocity: Vector
    bias: Vector
    pull: Callable[[Vector], Vector]


class Direction(Point):
    """A unit vector u fixed in a body, with the attributes of `Point`; `pull(n)` is ∂(n·u̇)/∂v."""


class BodyFrame(Protocol):
    """The interface by which elements read the motion of bodies of one kind, or of the world.

    Particles have `point` and `material` only; elements with `oriented` set get no particles.
    """

    @property
    def rotation(self) -> Matrix:
        """The rotation matrix R, body to world."""
        ...

    @property
    def position(self) -> Vector:
        """The origin of the body's frame, world frame [m]."""
        ...

    @property
    def velocity(self) -> Vector:
        """The velocity of the origin, world frame [m/s]."""
        ...

    def point(self, anchor: Vector | Array) -> Point:
        """Returns the point of the body at an anchor, given in the body's frame."""
        ...

    def material(self, place: Vector) -> Point:
        """Returns the material point of the body at a position in the world frame."""
        ...

    def direction(self, axis: Vector | Array) -> Direction:
        """Returns the direction of the body along an axis, given in the body's frame."""
        ...

    def turn(self, torque: Any) -> Vector:
        """Returns the generalized force of a torque in the body frame [N m]."""
        ...


@pytree
class Frame:
    """The motion of particles, and the base class of frames of rigid bodies.

    Attributes:
        position, velocity: position [m] and velocity [m/s] of the frame's origin, world frame.
    """

    position: Vector
    velocity: Vector

    def point(self, anchor: Vector | Array) -> Point:
        """Returns the origin for every anchor: a particle has no other point."""
        return Point(self.position, self.velocity, zeros(len(self.position)), lambda n: n)

    def material(self, place: Vector) -> Point:
        """Returns a point at a position in the world frame, with the velocity of the origin."""
        return Point(place, self.velocity, zeros(len(place)), lambda n: n)

    def gather(self, take: Callable[[Lane], Lane]) -> Frame:
        """Returns the frames of some of the bodies; `take` gathers their values from a lane."""
        return jax.tree.map(take, self)


@pytree
class WorldFrame:
    """The world frame, and every frame fixed to it.

    Attributes:
        dim: 2 or 3.
    """

    dim: int = static()

    def point(self, anchor: Vector | Array) -> Point:
        """Returns a point of the world, which does not move."""
        rest = zeros(self.dim)
        return Point(Vector.of(anchor), rest, rest, lambda n: Vector())

    material = point

    def direction(self, axis: Vector | Array) -> Direction:
        """Returns a direction of the world, which does not turn."""
        rest = zeros(self.dim)
        return Direction(Vector.of(axis), rest, rest, lambda n: Vector())

    angle: ClassVar[float] = 0.0
    laps: ClassVar[float] = 0.0
    quaternion: ClassVar[Vector] = quaternion.IDENTITY
    spin: ClassVar[Vector] = zeros(3)

    @property
    def omega(self) -> float | Vector:
        """The angular velocity: zero."""
        return 0.0 if self.dim == 2 else zeros(3)

    def turn(self, torque: Lane | Vector) -> Vector:
        """Returns an empty generalized force: the world has no velocities."""
        return Vector()

    torque = turn


@pytree
class RigidFrame(Frame):
    """The motion of bodies with an orientation.

    Attributes:
        rotation: the rotation matrix R, body to world.
    """

    rotation: Matrix

    def material(self, place: Vector) -> Point:
        """Returns the material point of the body at a position in the world frame."""
        return self.point(self.rotation.T @ (place - self.position))


@pytree
class PlanarFrame(RigidFrame):
    """The motion of rigid bodies in the plane.

    Attributes:
        angle: θ without whole turns [rad].
        omega: angular velocity ω [rad/s].
        laps: the number of whole turns to add to `angle`.
    """

    angle: Lane
    omega: Lane
    laps: Lane = 0.0

    @classmethod
    def of(cls, q: Vector, v: Vector) -> PlanarFrame:
        """Returns the frames for coordinates (x, y, θ) and velocities (ẋ, ẏ, ω)."""
        c, s = cos_sin(q[2])
        rotation = Matrix(Vector(c, -s), Vector(s, c))
        return cls(Vector(*q[:2]), Vector(*v[:2]), rotation, q[2], v[2])

    def after(self, laps: Lane) -> PlanarFrame:
        """Returns the frames with a number of whole turns, `laps`, to add to their angles."""
        return dataclasses.replace(self, laps=laps)

    def point(self, anchor: Vector | Array) -> Point:
        """Returns the point p = x + R s at an anchor s of the body's frame.

        With s⊥ = R s turned by +90°, its velocity is ẋ + ω s⊥. Its bias is −ω² R s, and its pull is
        (n, R s × n) for a force n.
        """
        r = self.rotation @ Vector.of(anchor)
        return Point(
            self.position + r,
            self.velocity + perpendicular(r) * self.omega,
            r * -times(self.omega, self.omega),
            lambda n: Vector(*n, r.cross(n)),
        )

    def direction(self, axis: Vector | Array) -> Direction:
        """Returns the direction u = R û along an axis û of the body's frame.

        With u⊥ = u turned by +90°, its velocity is ω u⊥. Its bias is −ω² u, and its pull is (0, 0,
        u × n) for a vector n.
        """
        u = self.rotation @ Vector.of(axis)
        return Direction(
            u,
            perpendicular(u) * self.omega,
            u * -times(self.omega, self.omega),
            lambda n: Vector(0.0, 0.0, u.cross(n)),
        )

    def turn(self, torque: Lane) -> Vector:
        """Returns the generalized force of a torque [N m]."""
        return Vector(0.0, 0.0, torque)


@pytree
class SpatialFrame(RigidFrame):
    """The motion of rigid bodies in space.

    Attributes:
        omega, spin: angular velocity in the body frame and in the world frame [rad/s].
        rotation: the rotation matrix R, body to world.
        quaternion: the unit quaternion of R.
    """

    quaternion: Vector
    omega: Vector
    spin: Vector

    @classmethod
    def of(cls, q: Vector, v: Vector) -> SpatialFrame:
        """Returns the frames for coordinates (x, quaternion) and velocities (ẋ, ω)."""
        turn = Vector(*q[3:])
        rotation = quaternion.rotation(turn)
        omega = Vector(*v[3:])
        return cls(Vector(*q[:3]), Vector(*v[:3]), rotation, turn, omega, rotation @ omega)

    def point(self, anchor: Vector | Array) -> Point:
        """Returns the point p = x + R s at an anchor s of the body's frame.

        Its velocity is ẋ + Rω × R s, and its bias is Rω × (Rω × R s). Its pull is (n, s × Rᵀn) for
        a force n.
        """
        s = Vector.of(anchor)
        arm = self.rotation @ s
        swing = self.spin.cross(arm)
        return Point(
            self.position + arm,
            self.velocity + swing,
            self.spin.cross(swing),
            lambda n: Vector(*n, *s.cross(self.rotation.T @ n)),
        )

    def direction(self, axis: Vector | Array) -> Direction:
        """Returns the direction u = R û along an axis û of the body's frame.

        Its velocity is Rω × u, and its bias is Rω × (Rω × u). Its pull is (0, û × Rᵀn) for a vector
        n.
        """
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
        """Returns the generalized force of a torque in the body frame [N m]."""
        return Vector(*zeros(3), *torque)

    def torque(self, n: Vector) -> Vector:
        """Returns the generalized force of a torque n in the world frame [N m].

        It is the gradient of n·Rω with respect to the body's velocities.
        """
        return self.turn(self.rotation.T @ n)
