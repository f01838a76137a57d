"""Where a body is and how it moves, as arrays for user functions and accessors.

The hot path works on lanes instead (`model.bodies`); these classes are the readable face.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion


@pytree
class Pose:
    """Position and orientation of a frame in the world.

    Attributes:
        position: (2,) or (3,) [m].
        orientation: angle () [rad] in the plane, unit quaternion (4,) in space; None for a
            particle.
    """

    position: Array
    orientation: Any = None

    @property
    def rotation(self) -> Array:
        """R, body to world: (2, 2) or (3, 3); the identity for a particle."""
        if self.orientation is None:
            return jnp.eye(self.position.shape[0], dtype=self.position.dtype)
        if self.position.shape[0] == 3:
            return quaternion.matrix(self.orientation)
        c, s = jnp.cos(self.orientation), jnp.sin(self.orientation)
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])

    def point(self, local: Array) -> Array:
        """x + R s: a point of the body in the world frame.

        Args:
            local: s, in the body frame, (dim,) [m].
        """
        return self.position + self.direction(local)

    def direction(self, local: Array) -> Array:
        """R u: a direction of the body in the world frame.

        Args:
            local: u, in the body frame, (dim,).
        """
        return local if self.orientation is None else self.rotation @ local

    def local_point(self, world: Array) -> Array:
        """Rᵀ (p − x): a world point in the body frame.

        Args:
            world: p, (dim,) [m].
        """
        return self.local_direction(world - self.position)

    def local_direction(self, world: Array) -> Array:
        """Rᵀ n: a world direction in the body frame.

        Args:
            world: n, (dim,).
        """
        return world if self.orientation is None else self.rotation.T @ world

    def then(self, other: Pose) -> Pose:
        """In the world, a frame that is given in this one.

        Args:
            other: of that frame in this one; without an orientation it is not turned.
        """
        position, turn = self.point(other.position), self.orientation
        if turn is None or other.orientation is None:
            return Pose(position, other.orientation if turn is None else turn)
        if self.position.shape[0] == 2:
            return Pose(position, turn + other.orientation)
        return Pose(position, quaternion.multiply(turn, other.orientation))

    @property
    def inverse(self) -> Pose:
        """The world as seen from this frame."""
        position = -self.local_direction(self.position)
        if self.orientation is None or self.position.shape[0] == 2:
            return Pose(position, None if self.orientation is None else -self.orientation)
        return Pose(position, quaternion.conjugate(self.orientation))


@pytree
class WorldPose(Pose):
    """A frame fixed to the world: its own points and directions are those of the world."""

    def local_point(self, world: Array) -> Array:
        """The point itself."""
        return world

    def local_direction(self, world: Array) -> Array:
        """The direction itself."""
        return world


@pytree
class Motion(Pose):
    """A pose and its rate of change.

    Attributes:
        position, orientation: as of `Pose`.
        velocity: of the frame's origin, world frame, (2,) or (3,) [m/s].
        angular_velocity: () in the plane, (3,) in the body frame in space [rad/s]; None for a
            particle.
    """

    velocity: Any = None
    angular_velocity: Any = None

    @property
    def pose(self) -> Pose:
        """The pose alone."""
        return Pose(self.position, self.orientation)

    def seen_from(self, offset: Pose | None) -> Motion:
        """The motion of a frame fixed in this body at the pose `offset` in it.

        Args:
            offset: of the frame in the body; None for the body's own.
        """
        if offset is None:
            return self
        position, velocity = self.point(offset.position), self.point_velocity(offset.position)
        if self.position.shape[0] == 2 or offset.orientation is None:
            return Motion(position, self.orientation, velocity, self.angular_velocity)
        turned = quaternion.multiply(self.orientation, offset.orientation)
        omega = offset.rotation.T @ self.angular_velocity
        return Motion(position, turned, velocity, omega)

    def point_velocity(self, local: Array) -> Array:
        """ẋ + R (ω × s): the velocity of a point of the body, world frame [m/s].

        Args:
            local: s, in the body frame, (dim,) [m].
        """
        if self.angular_velocity is None:
            return self.velocity
        if self.position.shape[0] == 3:
            return self.velocity + self.rotation @ jnp.cross(self.angular_velocity, local)
        lever = self.rotation @ local
        turned = jnp.stack([-lever[1], lever[0]])
        return self.velocity + self.angular_velocity * turned
