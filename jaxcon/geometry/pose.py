"""Poses and motions of single bodies as arrays, for accessors and users' functions.

The step functions use lanes over many bodies instead; see `system.frames`.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion


@pytree
class Pose:
    """The position and orientation of a frame in the world.

    Attributes:
        position: the origin of the frame, (2,) or (3,) [m].
        orientation: an angle () [rad] in the plane; a unit quaternion (4,) in space; None for a
            particle.
    """

    position: Array
    orientation: Any = None

    @property
    def rotation(self) -> Array:
        """The rotation matrix R from the frame to the world, (2, 2) or (3, 3).

        For a particle, R is the identity.
        """
        if self.orientation is None:
            return jnp.eye(self.position.shape[0], dtype=self.position.dtype)
        if self.position.shape[0] == 3:
            return quaternion.matrix(self.orientation)
        c, s = jnp.cos(self.orientation), jnp.sin(self.orientation)
        return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])

    def point(self, local: Array) -> Array:
        """Converts a point from the body frame to the world frame: x + R s.

        Args:
            local: the point s in the body frame, (dim,) [m].
        """
        return self.position + self.direction(local)

    def direction(self, local: Array) -> Array:
        """Converts a direction from the body frame to the world frame: R u.

        Args:
            local: the direction u in the body frame, (dim,).
        """
        return local if self.orientation is None else self.rotation @ local

    def local_point(self, world: Array) -> Array:
        """Converts a point from the world frame to the body frame: Rᵀ (p − x).

        Args:
            world: the point p in the world frame, (dim,) [m].
        """
        return self.local_direction(world - self.position)

    def local_direction(self, world: Array) -> Array:
        """Converts a direction from the world frame to the body frame: Rᵀ n.

        Args:
            world: the direction n in the world frame, (dim,).
        """
        return world if self.orientation is None else self.rotation.T @ world

    def then(self, other: Pose) -> Pose:
        """Returns the world pose of another frame, whose pose relative to this frame is given.

        Args:
            other: the pose of the other frame in this frame. An orientation of None means no
                rotation.
        """
        position, turn = self.point(other.position), self.orientation
        if turn is None or other.orientation is None:
            return Pose(position, other.orientation if turn is None else turn)
        if self.position.shape[0] == 2:
            return Pose(position, turn + other.orientation)
        return Pose(position, quaternion.multiply(turn, other.orientation))

    @property
    def inverse(self) -> Pose:
        """The inverse pose: the position and orientation of the world frame in this frame."""
        position = -self.local_direction(self.position)
        if self.orientation is None or self.position.shape[0] == 2:
            return Pose(position, None if self.orientation is None else -self.orientation)
        return Pose(position, quaternion.conjugate(self.orientation))


@pytree
class WorldPose(Pose):
    """The pose of a frame fixed to the world; users give its local points in the world frame."""

    def local_point(self, world: Array) -> Array:
        """Returns the point unchanged: local points of this frame are world points."""
        return world

    def local_direction(self, world: Array) -> Array:
        """Returns the direction unchanged: local directions of this frame are world directions."""
        return world


@pytree
class Motion(Pose):
    """The pose and the velocity of a frame.

    Attributes:
        position, orientation: see `Pose`.
        velocity: the velocity of the origin in the world frame, (2,) or (3,) [m/s].
        angular_velocity: () in the plane; (3,) in space, in the body frame [rad/s]. None for a
            particle.
    """

    velocity: Any = None
    angular_velocity: Any = None

    @property
    def pose(self) -> Pose:
        """The position and orientation as a `Pose`."""
        return Pose(self.position, self.orientation)

    def seen_from(self, offset: Pose | None) -> Motion:
        """Returns the motion of another frame that is fixed to the same body.

        Args:
            offset: the pose of the other frame in the body frame; None for the body frame itself.
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
        """Returns the velocity ẋ + R (ω × s) of a point of the body, world frame, (dim,) [m/s].

        Args:
            local: the point s in the body frame, (dim,) [m].
        """
        if self.angular_velocity is None:
            return self.velocity
        if self.position.shape[0] == 3:
            return self.velocity + self.rotation @ jnp.cross(self.angular_velocity, local)
        x, y = self.rotation @ local
        return self.velocity + self.angular_velocity * jnp.stack([-y, x])
