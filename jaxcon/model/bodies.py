"""How each kind of body moves: particles and rigid bodies, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector, zeros
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.model.frames import Frame, PlanarFrame, SpatialFrame


@dataclass(frozen=True)
class Particle:
    """A point mass: q = x, v = ẋ."""

    dim: int
    turns: ClassVar[bool] = False
    """True where the last coordinate is an angle."""

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

    def in_turned_frames(self, step: Vector, p: Vector) -> Vector:
        """p: these velocities are rates of coordinates."""
        return p

    def gyroscopic_acceleration(self, v: Vector, moments: Any) -> Vector:
        """None: these velocities are rates of coordinates."""
        return v.map(jnp.zeros_like)

    def rotate(self, v: Vector, moments: Any, dt: Lane) -> Vector:
        """v: these velocities are rates of coordinates."""
        return v

    def kick(self, v: Vector, acceleration: Vector, moments: Any, dt: Lane) -> Vector:
        """v + h a: these velocities are rates of coordinates."""
        return v + acceleration * dt

    def kick_little(self, v: Vector, acceleration: Vector, moments: Any, dt: Lane) -> Vector:
        """v + h a: these velocities are rates of coordinates."""
        return v + acceleration * dt

    def coast(self, v: Vector, moments: Any, dt: Lane) -> Vector:
        """None: these velocities are rates of coordinates."""
        return v.map(jnp.zeros_like)

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
    turns: ClassVar[bool] = True

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

    def in_turned_frames(self, step: Vector, p: Vector) -> Vector:
        """(p_x, exp(−Δφ) p_φ): p_φ in the frame of the body that has turned by Δφ."""
        back = quaternion.exp(Vector(*step[3:]) * -1.0)
        return Vector(*p[:3], *quaternion.rotate(back, Vector(*p[3:])))

    def gyroscopic_acceleration(self, v: Vector, moments: Array) -> Vector:
        """(0, −I⁻¹ (ω × Iω)), by the shares of `spun`."""
        shares = shares_of(Vector.of(moments))
        return Vector(*zeros(3), *(spun(shares, Vector(*v[3:])) * -1.0))

    def rotate(self, v: Vector, moments: Array, dt: Lane) -> Vector:
        """v after a free rotation of h."""
        moments_ = Vector.of(moments)
        ω = rotate_freely(Vector(*v[3:]), moments_, shares_of(moments_), dt)
        return Vector(*v[:3], *ω)

    def kick(self, v: Vector, acceleration: Vector, moments: Array, dt: Lane) -> Vector:
        """Half a step of free rotation, h times all that is not gyroscopic in a, half a step more.

        This is Strang's splitting of v̇ = a. An explicit gyroscopic torque would add energy in every
        step, in proportion to h. The free rotation keeps |Iω| exactly and ½ ω·Iω to 1e-4 at a turn
        of one radian a step.

        Args:
            v: velocities before the step.
            acceleration: a, which contains −I⁻¹ (ω × Iω) at v.
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

    def kick_little(self, v: Vector, acceleration: Vector, moments: Array, dt: Lane) -> Vector:
        """`kick` for small turns: the implicit midpoint rule for the gyroscopic part of a.

        With ω̄ = (ω + ω⁺)/2 it is ω⁺ = ω + h (a + g(ω) − g(ω̄)) and g = I⁻¹ (ω × Iω), which would
        keep |Iω| and ½ ω·Iω of a free body. ω̄ is found by two iterations, the second one half the
        way. The energy so swings by up to (h|ω|)²/16, |Iω| by half as much, and both drift by less
        than (h|ω|)⁶/64 a step.

        Args:
            v: velocities before the step.
            acceleration: a, which contains −g(ω).
            moments: principal moments of inertia [kg m²].
            dt: h [s].
        """
        shares, ω, a = shares_of(Vector.of(moments)), Vector(*v[3:]), Vector(*acceleration[3:])
        at_start, middle = spun(shares, ω), ω + a * (dt / 2)
        middle = middle + (at_start - spun(shares, middle)) * (dt / 4)
        turned = ω + (a + at_start - spun(shares, middle)) * dt
        return Vector(*(Vector(*v[:3]) + Vector(*acceleration[:3]) * dt), *turned)

    def coast(self, v: Vector, moments: Array, dt: Lane) -> Vector:
        """The mean gyroscopic acceleration of a step of free rotation, less that at its start."""
        moments_, half = Vector.of(moments), dt / 2
        shares, ω = shares_of(moments_), Vector(*v[3:])
        turned = rotate_freely(ω, moments_, shares, half)
        turned = rotate_freely(turned, moments_, shares, half)
        mean = (turned - ω).map(lambda x: numerics.safe_divide(x, dt))
        return Vector(*zeros(3), *(mean + spun(shares, ω)))

    def motion(self, q: Array, v: Array) -> Motion:
        """The motion of one body for a user's function."""
        return Motion(q[:3], q[3:], v[:3], v[3:])

    def coordinates(self, motion: Any) -> tuple[Array, Array]:
        """q and v of one body."""
        return (
            jnp.concatenate([motion.position, motion.orientation]),
            jnp.concatenate([motion.velocity, motion.angular_velocity]),
        )


def shares_of(moments: Vector) -> Vector:
    """((I₃ − I₂)/I₁, (I₁ − I₃)/I₂, (I₂ − I₁)/I₃): of a body's moments each is at most 1."""
    i1, i2, i3 = moments
    return Vector((i3 - i2) * (1 / i1), (i1 - i3) * (1 / i2), (i2 - i1) * (1 / i3))


def spun(shares: Vector, ω: Vector) -> Vector:
    """I⁻¹ (ω × Iω)."""
    (a, b, c), (x, y, z) = shares, ω
    return Vector(a * y * z, b * z * x, c * x * y)


def rotate_freely(ω: Vector, moments: Vector, shares: Vector, dt: Lane) -> Vector:
    """ω after a body has turned without torque: I ω̇ = −ω × Iω by the implicit midpoint rule.

    With s̄ = h/2 ω̄, the rule p⁺ − p = −s̄ × (p + p⁺) for p = Iω is a rotation of p, by the Cayley
    map p⁺ = p + 2 (s̄ × (s̄ × p) − s̄ × p) / (1 + s̄·s̄), so |p| is kept whatever ω̄ is. With
    ω̄ = (ω + ω⁺)/2 energy is kept as well. One step of Newton's method from ω finds ω̄ up to
    (h|ω|/2)³.

    With s = h/2 ω and G the derivative of g(s) = I⁻¹ (s × Is), it is s̄ = s − (1 + G)⁻¹ g. As g is
    quadratic, G s = 2 g, and the change has a closed form by Cramer's rule. Differences of moments
    are in the shares alone: those of products, divided by a small moment, would spin a thin rod by
    what rounding leaves.

    Args:
        ω: angular velocity in the body's frame [rad/s].
        moments: principal moments of inertia [kg m²].
        shares: as of `shares_of`.
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
    """The motion of a frame that does not move."""
    spin = None if pose.orientation is None else jnp.zeros_like(pose.position)
    if pose.position.shape[0] == 2 and spin is not None:
        spin = jnp.zeros((), pose.position.dtype)
    return Motion(pose.position, pose.orientation, jnp.zeros_like(pose.position), spin)
