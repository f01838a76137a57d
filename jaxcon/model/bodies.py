"""How each kind of body moves: particles and rigid bodies, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, cramer, zeros
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.model.frames import Frame, PlanarFrame, SpatialFrame


@dataclass(frozen=True)
class Particle:
    """A point mass: q = x, v = ẋ."""

    dim: int

    @property
    def n_q(self) -> int:
        """Coordinates a body."""
        return self.dim

    @property
    def n_v(self) -> int:
        """Velocities a body."""
        return self.dim

    def frame(self, q: Vector, v: Vector) -> Any:
        """The bodies' motion."""
        return Frame(q, v)

    def kinematics(self, q: Vector, v: Vector) -> Vector:
        """q̇ = v."""
        return v

    def retract(self, q: Vector, step: Vector) -> Vector:
        """q + Δ."""
        return q + step

    def normalize(self, q: Vector) -> Vector:
        """Nothing to do."""
        return q

    def mass(self, mass: Array, moments: Any) -> Vector:
        """The diagonal of M: m for each direction."""
        return Vector(*(mass,) * self.dim)

    def gyroscopic(self, v: Vector, moments: Any) -> Vector:
        """None."""
        return zeros(self.n_v)

    def coadjoint(self, v: Vector, p: Vector) -> Vector:
        """None: these velocities are rates of coordinates."""
        return v.map(jnp.zeros_like)

    def carry(self, step: Vector, p: Vector) -> Vector:
        """p: these velocities are rates of coordinates."""
        return p

    def kicked(self, v: Vector, change: Vector, moments: Any, dt: Lane) -> Vector:
        """v + Δv: these velocities are rates of coordinates."""
        return v + change

    def motion(self, q: Array, v: Array) -> Motion:
        """The motion of one body for a user's function."""
        return Motion(q, None, v, None)

    def coordinates(self, motion: Motion) -> tuple[Array, Array]:
        """q and v of one body."""
        return motion.position, motion.velocity


@dataclass(frozen=True)
class PlanarRigid(Particle):
    """A rigid body in the plane: q = (x, y, θ), v = q̇."""

    dim: int = 2

    @property
    def n_q(self) -> int:
        """Coordinates a body."""
        return 3

    @property
    def n_v(self) -> int:
        """Velocities a body."""
        return 3

    def frame(self, q: Vector, v: Vector) -> Any:
        """The bodies' motion."""
        return PlanarFrame.of(q, v)

    def mass(self, mass: Array, moments: Array) -> Vector:
        """The diagonal of M: (m, m, I)."""
        return Vector(mass, mass, moments)

    def motion(self, q: Array, v: Array) -> Motion:
        """The motion of one body for a user's function."""
        return Motion(q[:2], q[2], v[:2], v[2])

    def coordinates(self, motion: Any) -> tuple[Array, Array]:
        """q and v of one body."""
        return (
            jnp.append(motion.position, motion.orientation),
            jnp.append(motion.velocity, motion.angular_velocity),
        )


@dataclass(frozen=True)
class SpatialRigid(Particle):
    """A rigid body in space: q = (x, quaternion wxyz), v = (ẋ world, ω body)."""

    dim: int = 3

    @property
    def n_q(self) -> int:
        """Coordinates a body."""
        return 7

    @property
    def n_v(self) -> int:
        """Velocities a body."""
        return 6

    def frame(self, q: Vector, v: Vector) -> Any:
        """The bodies' motion."""
        return SpatialFrame.of(q, v)

    def kinematics(self, q: Vector, v: Vector) -> Vector:
        """q̇ = (ẋ, ½ q ⊗ ω)."""
        return Vector(*v[:3], *quaternion.derivative(Vector(*q[3:]), Vector(*v[3:])))

    def retract(self, q: Vector, step: Vector) -> Vector:
        """(x + Δx, normalized q ⊗ exp(Δφ)): exact for a constant body rate."""
        turned = quaternion.multiply(Vector(*q[3:]), quaternion.exp(Vector(*step[3:])))
        return Vector(*(Vector(*q[:3]) + Vector(*step[:3])), *quaternion.normalize(turned))

    def normalize(self, q: Vector) -> Vector:
        """Brings the quaternion back to unit length."""
        return Vector(*q[:3], *quaternion.normalize(Vector(*q[3:])))

    def mass(self, mass: Array, moments: Array) -> Vector:
        """The diagonal of M: (m, m, m, I₁, I₂, I₃)."""
        return Vector(mass, mass, mass, *Vector.of(moments))

    def gyroscopic(self, v: Vector, moments: Array) -> Vector:
        """−ω × Iω [N m], Euler's equations in the body frame."""
        i1, i2, i3 = Vector.of(moments)
        x, y, z = v[3:]
        return Vector(*zeros(3), (i2 - i3) * y * z, (i3 - i1) * z * x, (i1 - i2) * x * y)

    def coadjoint(self, v: Vector, p: Vector) -> Vector:
        """p × ω of an angular momentum p in the body frame; with p = Iω the gyroscopic torque."""
        none = (jnp.zeros_like(x) for x in v[:3])
        return Vector(*none, *Vector(*p[3:]).cross(Vector(*v[3:])))

    def carry(self, step: Vector, p: Vector) -> Vector:
        """(dexp⁻¹_φ)ᵀ p = p + ½ φ × p + c φ × (φ × p) of an angular momentum in the body frame.

        References:
            Iserles, Munthe-Kaas, Nørsett, Zanna, Lie-group methods, Acta Numerica 9 (2000).
        """
        φ, p_φ = Vector(*step[3:]), Vector(*p[3:])
        across = φ.cross(p_φ)
        turned = p_φ + across * 0.5 + φ.cross(across) * numerics.inverse_exponential(φ.dot(φ))
        return Vector(*p[:3], *turned)

    def kicked(self, v: Vector, change: Vector, moments: Array, dt: Lane) -> Vector:
        """The velocity Ω after a change h a, the gyroscopic torque by the trapezoidal rule.

            I Ω = I ω + h (I a + ω × Iω) − ½ h (ω × Iω + Ω × IΩ)

        is, but for terms of (hω)², what the discrete Lagrangian ½ ω·Iω of a body that turns by hω
        and then by hΩ leads to: turning freely it neither gains energy nor loses any. The equation
        is quadratic, and one step of Newton's method from ω + h a is enough.

        Rows were asked for ω + h a, which a body that turns fast within a step would miss by too
        much for feedback to be stable: from a third to half a radian a step it goes back to that.
        """
        inertia, ω = Vector.of(moments), Vector(*v[3:])
        after = ω + Vector(*change[3:])
        weight = dt / 2 * jnp.clip(1.5 - 5 * dt * dt * after.dot(after), 0, 1)
        grown = after.cross(scaled(inertia, after)) - ω.cross(scaled(inertia, ω))
        after = after - cramer(gyroscopic_slope(inertia, after, weight), grown * weight)
        return Vector(*(Vector(*v[:3]) + Vector(*change[:3])), *after)

    def motion(self, q: Array, v: Array) -> Motion:
        """The motion of one body for a user's function."""
        return Motion(q[:3], q[3:], v[:3], v[3:])

    def coordinates(self, motion: Any) -> tuple[Array, Array]:
        """q and v of one body."""
        return (
            jnp.concatenate([motion.position, motion.orientation]),
            jnp.concatenate([motion.velocity, motion.angular_velocity]),
        )


def scaled(x: Vector, y: Vector) -> Vector:
    """(x₁y₁, x₂y₂, …)."""
    return Vector(*(a * b for a, b in zip(x, y, strict=True)))


def gyroscopic_slope(inertia: Vector, ω: Vector, weight: Lane) -> tuple[Vector, ...]:
    """Rows of I + w ∂(ω × Iω)/∂ω."""
    (i1, i2, i3), (x, y, z) = inertia, ω * weight
    a, b, c = i3 - i2, i1 - i3, i2 - i1
    return Vector(i1, a * z, a * y), Vector(b * z, i2, b * x), Vector(c * y, c * x, i3)


def rest(pose: Pose) -> Motion:
    """The motion of a frame that does not move."""
    spin = None if pose.orientation is None else jnp.zeros_like(pose.position)
    if pose.position.shape[0] == 2 and spin is not None:
        spin = jnp.zeros((), pose.position.dtype)
    return Motion(pose.position, pose.orientation, jnp.zeros_like(pose.position), spin)
