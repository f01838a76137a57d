"""The kinematics of particles and rigid bodies, in the plane and in space.

All functions take the coordinates and velocities of many bodies at once, as Vectors of lanes (body,
…).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, zeros
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.system.frames import Frame, PlanarFrame, SpatialFrame

Moments: TypeAlias = Array | Vector
"""Moments of inertia of bodies [kg m²]: (bodies,) in the plane, a Vector of three in space."""


@dataclass(frozen=True)
class Particle:
    """A point mass: q = x, v = ẋ.

    Attributes:
        dim: 2 or 3.
        n_q, n_v: the numbers of coordinates and of velocities of a body.
    """

    dim: int
    n_q: int
    n_v: int
    turns: ClassVar[bool] = False
    """True if the last coordinate is an angle."""

    def frame(self, q: Vector, v: Vector) -> Frame:
        """Returns the frames of the bodies at coordinates q and velocities v."""
        return Frame(q, v)

    def kinematics(self, q: Vector, v: Vector) -> Vector:
        """Returns the rates of coordinates, q̇ = v."""
        return v

    def retract(self, q: Vector, step: Vector) -> Vector:
        """Returns the coordinates after a step, q + Δ."""
        return q + step

    def normalize(self, q: Vector) -> Vector:
        """Returns q unchanged, because it contains no quaternion."""
        return q

    def mass(self, mass: Array, moments: Moments) -> Vector:
        """Returns the diagonal of the mass matrix: the mass m for each direction."""
        return Vector(*(mass,) * self.dim)

    def gyroscopic(self, v: Vector, moments: Moments) -> Vector:
        """Returns the gyroscopic force: zero, since v = q̇."""
        return zeros(self.n_v)

    def coadjoint(self, v: Vector, p: Vector) -> Vector:
        """Returns zero, the rate of a momentum p due to turning axes: v = q̇ is along fixed axes."""
        return v.map(jnp.zeros_like)

    def carry(self, step: Vector, p: Vector) -> Vector:
        """Returns a momentum p pulled back to the start of a step: p unchanged, since v = q̇."""
        return p

    in_turned_frames = carry

    def gyroscopic_acceleration(self, v: Vector, moments: Moments) -> Vector:
        """Returns the gyroscopic acceleration: zero, since v = q̇."""
        return v.map(jnp.zeros_like)

    def rotate(self, v: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the velocities v after a free motion over a step h: unchanged, since v = q̇."""
        return v

    def kick(self, v: Vector, acceleration: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the velocities v + h a after a step h; v = q̇ has no gyroscopic part."""
        return v + acceleration * dt

    kick_little = kick

    def coast(self, v: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns zero: a body with v = q̇ has no gyroscopic acceleration."""
        return v.map(jnp.zeros_like)

    def motion(self, q: Array, v: Array) -> Motion:
        """Returns the motion of one body, from its coordinates q and velocities v as arrays."""
        return Motion(q, None, v, None)

    def coordinates(self, motion: Motion) -> tuple[Array, Array]:
        """Returns the arrays q and v of one body from its motion."""
        return motion.position, motion.velocity


@dataclass(frozen=True)
class PlanarRigid(Particle):
    """A rigid body in the plane: q = (x, y, θ), v = q̇."""

    dim: int = 2
    n_q: int = 3
    n_v: int = 3
    turns: ClassVar[bool] = True

    def frame(self, q: Vector, v: Vector) -> PlanarFrame:
        """Returns the frames of the bodies at coordinates q and velocities v."""
        return PlanarFrame.of(q, v)

    def mass(self, mass: Array, moments: Moments) -> Vector:
        """Returns the diagonal of the mass matrix: (m, m, I)."""
        return Vector(mass, mass, moments)

    def motion(self, q: Array, v: Array) -> Motion:
        """Returns the motion of one body, from its coordinates q and velocities v as arrays."""
        return Motion(q[:2], q[2], v[:2], v[2])

    def coordinates(self, motion: Motion) -> tuple[Array, Array]:
        """Returns the arrays q and v of one body from its motion."""
        return (
            jnp.append(motion.position, motion.orientation),
            jnp.append(motion.velocity, motion.angular_velocity),
        )


def _orientation(q: Vector) -> Vector:
    """Returns q / ‖q‖; NaN for q = 0, which is no orientation, so that the world fails."""
    return q * (1.0 / numerics.norm(q))


@dataclass(frozen=True)
class SpatialRigid(Particle):
    """A rigid body in space: q = (x, quaternion wxyz), v = (ẋ, ω).

    x and ẋ are in the world frame, the angular velocity ω is in the body frame.
    """

    dim: int = 3
    n_q: int = 7
    n_v: int = 6

    def frame(self, q: Vector, v: Vector) -> SpatialFrame:
        """Returns the frames of the bodies at coordinates q and velocities v."""
        return SpatialFrame.of(q, v)

    def kinematics(self, q: Vector, v: Vector) -> Vector:
        """Returns q̇: the velocity ẋ, and ½ q ⊗ ω for the quaternion q."""
        return Vector(*v[:3], *quaternion.derivative(Vector(*q[3:]), Vector(*v[3:])))

    def retract(self, q: Vector, step: Vector) -> Vector:
        """Returns the coordinates after a step (Δx, Δφ): x + Δx and the quaternion q ⊗ exp(Δφ).

        The quaternion is normalized. The result is exact for a constant angular velocity in the
        body frame.
        """
        turned = quaternion.multiply(Vector(*q[3:]), quaternion.exp(Vector(*step[3:])))
        return Vector(*(Vector(*q[:3]) + Vector(*step[:3])), *_orientation(turned))

    def normalize(self, q: Vector) -> Vector:
        """Returns q with the quaternion scaled to length one."""
        return Vector(*q[:3], *_orientation(Vector(*q[3:])))

    def mass(self, mass: Array, moments: Moments) -> Vector:
        """Returns the diagonal of the mass matrix: (m, m, m, I₁, I₂, I₃)."""
        return Vector(mass, mass, mass, *Vector.of(moments))

    def gyroscopic(self, v: Vector, moments: Moments) -> Vector:
        """Returns the gyroscopic torque −ω × Iω in the body frame [N m]."""
        i1, i2, i3 = Vector.of(moments)
        x, y, z = v[3:]
        return Vector(*zeros(3), (i2 - i3) * y * z, (i3 - i1) * z * x, (i1 - i2) * x * y)

    def coadjoint(self, v: Vector, p: Vector) -> Vector:
        """Returns p × ω, the rate of a body-frame angular momentum p due to the turning frame.

        For p = Iω this is the gyroscopic torque.
        """
        none = (jnp.zeros_like(x) for x in v[:3])
        return Vector(*none, *Vector(*p[3:]).cross(Vector(*v[3:])))

    def carry(self, step: Vector, p: Vector) -> Vector:
        """Returns (dexp⁻¹_φ)ᵀ p: an angular momentum p after a turn φ, pulled back to its start.

        p is in the body frame. The result is p + ½ φ × p + c φ × (φ × p), with the coefficient c
        from `numerics.inverse_exponential`.

        References:
            Iserles, Munthe-Kaas, Nørsett, Zanna, Lie-group methods, Acta Numerica 9 (2000).
        """
        φ, p_φ = Vector(*step[3:]), Vector(*p[3:])
        across = φ.cross(p_φ)
        turned = p_φ + across * 0.5 + φ.cross(across) * numerics.inverse_exponential(φ.dot(φ))
        return Vector(*p[:3], *turned)

    def in_turned_frames(self, step: Vector, p: Vector) -> Vector:
        """Returns the vector p = (p_x, p_φ) in body frames that have turned: (p_x, exp(−Δφ) p_φ).

        p_x is in the world frame. p_φ is in the body frame before the turn Δφ.
        """
        back = quaternion.exp(Vector(*step[3:]) * -1.0)
        return Vector(*p[:3], *quaternion.rotate(back, Vector(*p[3:])))

    def gyroscopic_acceleration(self, v: Vector, moments: Moments) -> Vector:
        """Returns the acceleration of bodies without forces, (0, −I⁻¹ (ω × Iω))."""
        shares = shares_of(Vector.of(moments))
        return Vector(*zeros(3), *(spun(shares, Vector(*v[3:])) * -1.0))

    def rotate(self, v: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the velocities v after a free (torque-free) rotation over a step h."""
        m = Vector.of(moments)
        return Vector(*v[:3], *rotate_freely(Vector(*v[3:]), m, shares_of(m), dt))

    def kick(self, v: Vector, acceleration: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the velocities v after a step h of v̇ = a by Strang splitting.

        The step is half a step of free rotation, then h times the part of a that is not gyroscopic,
        then another half step of free rotation. An explicit gyroscopic torque would add energy in
        every step, in proportion to h. The free rotation keeps |Iω| exactly. It keeps ½ ω·Iω to
        1e-4 if a body turns by one radian per step.

        Args:
            v: velocities before the step.
            acceleration: a, including the gyroscopic part −I⁻¹ (ω × Iω) at v.
            moments: principal moments of inertia [kg m²].
            dt: h [s].

        References:
            Hairer, Lubich, Wanner, Geometric Numerical Integration (2006), sections II.5 and VII.5.
        """
        moments_, half = Vector.of(moments), dt / 2
        shares, ω = shares_of(moments_), Vector(*v[3:])
        applied = (Vector(*acceleration[3:]) + spun(shares, ω)) * dt
        turned = rotate_freely(ω, moments_, shares, half)
        turned = rotate_freely(turned + applied, moments_, shares, half)
        return Vector(*(Vector(*v[:3]) + Vector(*acceleration[:3]) * dt), *turned)

    def kick_little(self, v: Vector, acceleration: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the velocities after a step h of v̇ = a, for bodies that turn little in a step.

        The implicit midpoint rule integrates the gyroscopic part of a: ω⁺ = ω + h (a + g(ω) −
        g(ω̄)) with ω̄ = (ω + ω⁺)/2 and g = I⁻¹ (ω × Iω). Solved exactly, it keeps |Iω| and ½ ω·Iω
        of a free body. Here ω̄ comes from two iterations, the second with step length ½. The
        relative energy then oscillates by up to (h|ω|)²/16, and |Iω| by half as much. Both drift by
        less than (h|ω|)⁶/64 a step.

        Args:
            v: velocities before the step.
            acceleration: a, including the gyroscopic part −g(ω).
            moments: principal moments of inertia [kg m²].
            dt: h [s].
        """
        shares, ω, a = shares_of(Vector.of(moments)), Vector(*v[3:]), Vector(*acceleration[3:])
        at_start, middle = spun(shares, ω), ω + a * (dt / 2)
        middle = middle + (at_start - spun(shares, middle)) * (dt / 4)
        turned = ω + (a + at_start - spun(shares, middle)) * dt
        return Vector(*(Vector(*v[:3]) + Vector(*acceleration[:3]) * dt), *turned)

    def coast(self, v: Vector, moments: Moments, dt: Lane) -> Vector:
        """Returns the mean minus the initial gyroscopic acceleration of a free rotation over h."""
        moments_, half = Vector.of(moments), dt / 2
        shares, ω = shares_of(moments_), Vector(*v[3:])
        turned = rotate_freely(ω, moments_, shares, half)
        turned = rotate_freely(turned, moments_, shares, half)
        mean = (turned - ω).map(lambda x: numerics.safe_divide(x, dt))
        return Vector(*zeros(3), *(mean + spun(shares, ω)))

    def motion(self, q: Array, v: Array) -> Motion:
        """Returns the motion of one body, from its coordinates q and velocities v as arrays."""
        return Motion(q[:3], q[3:], v[:3], v[3:])

    def coordinates(self, motion: Motion) -> tuple[Array, Array]:
        """Returns the arrays q and v of one body from its motion."""
        return (
            jnp.concatenate([motion.position, motion.orientation]),
            jnp.concatenate([motion.velocity, motion.angular_velocity]),
        )


def shares_of(moments: Vector) -> Vector:
    """Returns the moment ratios ((I₃ − I₂)/I₁, (I₁ − I₃)/I₂, (I₂ − I₁)/I₃), at most 1 in size."""
    i1, i2, i3 = moments
    return Vector((i3 - i2) * (1 / i1), (i1 - i3) * (1 / i2), (i2 - i1) * (1 / i3))


def spun(shares: Vector, ω: Vector) -> Vector:
    """Returns I⁻¹ (ω × Iω), the negative gyroscopic acceleration.

    Args:
        shares: the moment ratios from `shares_of`.
        ω: angular velocity in the body frame [rad/s].
    """
    (a, b, c), (x, y, z) = shares, ω
    return Vector(a * y * z, b * z * x, c * x * y)


def rotate_freely(ω: Vector, moments: Vector, shares: Vector, dt: Lane) -> Vector:
    """Returns ω after a torque-free step: I ω̇ = −ω × Iω by the implicit midpoint rule.

    With p = Iω and s̄ = h/2 ω̄, the rule is p⁺ − p = −s̄ × (p + p⁺). It rotates p by the Cayley map
    p⁺ = p + 2 (s̄ × (s̄ × p) − s̄ × p) / (1 + s̄·s̄). The map keeps |p| for any ω̄. Energy is kept,
    too, if ω̄ = (ω + ω⁺)/2. One Newton step from ω gives this ω̄ up to (h|ω|/2)³.

    The Newton step is s̄ = s − (1 + G)⁻¹ g with s = h/2 ω, g(s) = I⁻¹ (s × Is) and its derivative
    G. As g is quadratic, G s = 2 g, and Cramer's rule gives the change in closed form. Only the
    moment ratios subtract moments. Differences of products, divided by a small moment, would spin a
    thin rod by their rounding error.

    Args:
        ω: angular velocity in the body frame [rad/s].
        moments: principal moments of inertia [kg m²].
        shares: the moment ratios from `shares_of`.
        dt: h [s].

    References:
        Austin, Krishnaprasad, Wang, Almost Poisson integration of rigid body systems, Journal of
            Computational Physics 107 (1993).
    """
    (a, b, c), s = shares, ω * (dt / 2)
    x, y, z = s
    xx, yy, zz = b * c * x * x, a * c * y * y, a * b * z * z
    product = a * b * c * x * y * z
    inverse = 1 / (1 - xx - yy - zz + 2 * product)
    torque = spun(shares, ω) * (dt / 2)  # I⁻¹ (s × p)
    g = torque * (dt / 2)
    change = Vector(
        (x * (yy + zz - product) - g[0]) * inverse,
        (y * (zz + xx - product) - g[1]) * inverse,
        (z * (xx + yy - product) - g[2]) * inverse,
    )
    middle, p = s + change, Vector(*(i * x for i, x in zip(moments, ω, strict=True)))
    square = middle.dot(middle)
    turned = middle * middle.dot(p) - change.cross(p)
    share = 2 / (1 + square)
    return Vector(
        *(
            ω_i + share * (turned_i * (1 / i) - torque_i - ω_i * square)
            for ω_i, turned_i, torque_i, i in zip(ω, turned, torque, moments, strict=True)
        )
    )


def rest(pose: Pose) -> Motion:
    """Returns the motion of a frame at rest at a pose."""
    spin = None if pose.orientation is None else jnp.zeros_like(pose.position)
    if pose.position.shape[0] == 2 and spin is not None:
        spin = jnp.zeros((), pose.position.dtype)
    return Motion(pose.position, pose.orientation, jnp.zeros_like(pose.position), spin)
