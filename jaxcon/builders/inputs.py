"""Resolves the user's description of a body to its principal frame at the center of mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.geometry.solid import resolve_inertia, resolve_mass
from jaxcon.system.bodies import Particle, PlanarRigid, SpatialRigid


@dataclass(frozen=True)
class BodyInput:
    """The arguments of `add_body` or `add_particle`, as the user gave them.

    `winds` is True for a body in the plane whose angle may exceed a turn, as in a spiral.
    """

    name: str
    mass: Any
    inertia: Any
    position: Any
    orientation: Any
    velocity: Any
    angular_velocity: Any
    rigid: bool
    fixed: bool
    winds: bool = False


@dataclass(frozen=True)
class Resolved:
    """A body in its principal frame.

    Attributes:
        kind: the kinematics of the body (`system.bodies`); None for a fixed body.
        motion: motion of the principal frame at assembly.
        mass, moments: mass [kg] and moments of inertia [kg m²].
        offset: pose of the user's frame in the principal frame; None if they coincide.
    """

    kind: Any
    motion: Motion
    mass: Array | None
    moments: Array | None
    offset: Pose | None


def resolve(body: BodyInput, dim: int, dtype: DType) -> Resolved:
    """Checks the user's description of a body, and converts it to the principal frame.

    Raises:
        ValueError: a shape or dtype is wrong, a mass or inertia is not positive, or a fixed body
            has a mass, inertia or velocity.
    """
    motion = _motion(body, dim, dtype)
    moving = (body.mass, body.inertia, body.velocity, body.angular_velocity)
    if body.fixed and any(x is not None for x in moving):
        raise ValueError(
            f"{_label(body)}: it is fixed to the world, so it takes no mass, inertia or velocity."
        )
    if body.fixed:
        return Resolved(None, motion, None, None, None)
    if not body.rigid:
        mass = resolve_mass(_label(body), body.mass, dtype)
        return Resolved(Particle(dim, dim, dim), motion, mass, None, None)
    solid = resolve_inertia(_label(body), body.mass, body.inertia, dim, dtype)
    kind = PlanarRigid() if dim == 2 else SpatialRigid()
    if solid.center is None and solid.axes is None:
        return Resolved(kind, motion, solid.mass, solid.moments, None)
    center = jnp.zeros(dim, dtype)
    if solid.center is not None:
        center = checks.real(_label(body), "inertia.center", solid.center, dtype, (dim,))
    principal = Pose(center)
    if dim == 3:
        axes = jnp.eye(4, dtype=dtype)[0] if solid.axes is None else solid.axes
        principal = Pose(center, axes.astype(dtype))
    return Resolved(kind, motion.seen_from(principal), solid.mass, solid.moments, principal.inverse)


def _motion(body: BodyInput, dim: int, dtype: DType) -> Motion:
    """Checks the user's pose and velocity of a body; returns the motion of the user's frame."""
    zero = (0.0,) * dim
    spin_shape = () if dim == 2 else (3,)

    def given(what: str, x: PyTree, default: PyTree, shape: tuple[int, ...]) -> Array:
        return checks.real(_label(body), what, default if x is None else x, dtype, shape)

    position = given("position", body.position, zero, (dim,))
    velocity = given("velocity", body.velocity, zero, (dim,))
    if not body.rigid:
        return Motion(position, None, velocity, None)
    spin = given(
        "angular_velocity", body.angular_velocity, jnp.zeros(spin_shape, dtype), spin_shape
    )
    if dim == 2:
        angle = given("angle", body.orientation, 0.0, ())
        if not body.winds:
            checks.radians(_label(body), "angle", angle)
        return Motion(position, angle, velocity, spin)
    turn = given("quaternion", body.orientation, (1.0, 0.0, 0.0, 0.0), (4,))
    checks.nonzero(_label(body), "quaternion", turn)
    return Motion(position, quaternion.normalize(turn), velocity, spin)


def _label(body: BodyInput) -> str:
    """Returns a text such as "body 'rod'" or "particle 'bob'", for error messages."""
    return f"{'body' if body.rigid else 'particle'} '{body.name}'"
