"""Mass, centre of mass and principal moments of common solids and of any tensor.

Each constructor returns an `Inertia` in the solid's own frame, whose origin lies at its geometric
centre. `Scene.add_body(inertia=…)` takes it: the simulated frame then lies at the centre of mass
along the principal axes, which makes the mass matrix constant and diagonal, while positions given
and read stay in the solid's frame.

References:
    Goldstein, Classical Mechanics (3rd ed.), section 5.3.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion

APART = 0.45
"""Exponent of ε by which moments are apart where axes are differentiated.

What is off by that is then 1e-7 in float64 and 8e-4 in float32; less would make the turn of the
axes so fast that its rounding, 1/ε^0.45 times that of the motion, is more.
"""


@pytree
class Inertia:
    """Mass properties of a rigid body in its own frame.

    Attributes:
        mass: () [kg].
        moments: principal moments about the centre of mass, (3,) [kg m²].
        center: centre of mass, (3,) [m].
        axes: principal axes, unit quaternion (4,) principal to own frame; None where they coincide.
    """

    mass: Any
    moments: Any
    center: Any = None
    axes: Array | None = None


def sphere(mass: Any, radius: Any) -> Inertia:
    """Homogeneous ball: I = 2/5 m r².

    Args:
        mass: () [kg].
        radius: () [m].
    """
    _check("sphere", mass=mass, radius=radius)
    moment = mass * radius**2 * 0.4
    return Inertia(mass, (moment, moment, moment))


def box(mass: Any, size: Any) -> Inertia:
    """Homogeneous box with edges size (3,): I_x = m (b² + c²) / 12, and so on.

    Args:
        mass: () [kg].
        size: edges along x, y and z, (3,) [m].
    """
    _check("box", mass=mass, size=size)
    x, y, z = (edge**2 for edge in size)
    return Inertia(mass, (mass * (y + z) / 12, mass * (z + x) / 12, mass * (x + y) / 12))


def cylinder(mass: Any, radius: Any, length: Any) -> Inertia:
    """Homogeneous cylinder along z: I_z = m r² / 2, I_x = I_y = m (3 r² + l²) / 12.

    Args:
        mass: () [kg].
        radius: () [m].
        length: along z, () [m].
    """
    _check("cylinder", mass=mass, radius=radius, length=length)
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (across, across, mass * radius**2 / 2))


def rod(mass: Any, *, length: Any, radius: Any) -> Inertia:
    """Rod along x of circular section: I_x = m r² / 2, I_y = I_z = m (3 r² + l²) / 12.

    Its sizes go by name: `cylinder` and `capsule`, which are thick and lie along z, have the radius
    first.

    A rod without thickness cannot be turned about itself in space; in the plane use
    `inertia=mass * length**2 / 12`.

    Args:
        mass: () [kg].
        length: along x, () [m].
        radius: () [m].
    """
    _check("rod", mass=mass, length=length, radius=radius)
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (mass * radius**2 / 2, across, across))


def capsule(mass: Any, radius: Any, length: Any) -> Inertia:
    """Homogeneous capsule along z: a cylinder of this length between two half balls.

    A half ball of mass m_h has its centre of mass 3r/8 from its flat face, and m_h r² · 83/320
    about it across.

    Args:
        mass: () [kg].
        radius: () [m].
        length: of the cylinder, without the half balls, () [m].
    """
    _check("capsule", mass=mass, radius=radius, length=length)
    share = 3 * length / (3 * length + 4 * radius)  # the cylinder's share of the volume
    tube, balls = mass * share, mass * (1 - share)
    arm = length / 2 + 3 * radius / 8
    along = tube * radius**2 / 2 + balls * radius**2 * 0.4
    across = tube * (3 * radius**2 + length**2) / 12 + balls * (radius**2 * (83 / 320) + arm**2)
    return Inertia(mass, (across, across, along))


def from_tensor(mass: Any, tensor: Any, center: Any = None, owner: str = "inertia") -> Inertia:
    """From a full tensor (3, 3) about the centre of mass, by its principal axes.

    It is differentiable also where principal moments coincide (`principal_axes`): to 1e-6 in
    float64, to some percent by products of inertia in float32.

    Args:
        mass: () [kg].
        tensor: symmetric, (3, 3) [kg m²].
        center: centre of mass in the same frame, (3,) [m]; the origin unless given.
        owner: what messages begin with.

    Raises:
        ValueError: not 3×3, not symmetric, not positive definite, or against the triangle
            inequality, which no distribution of mass can violate.
    """
    tensor = jnp.asarray(checks.check(owner, "the tensor", tensor))
    if tensor.shape != (3, 3):
        raise ValueError(f"{owner}: the tensor must have shape (3, 3), got {tensor.shape}.")
    moments, axes = principal_axes(tensor)
    if checks.is_concrete(tensor):
        _check_tensor(owner, tensor, moments)
    return Inertia(mass, moments, center, quaternion.from_matrix(axes))


def from_log_cholesky(theta: Any) -> Inertia:
    """The body of ten free numbers, every choice of which is one that can exist.

    With θ = (α, d₁, d₂, d₃, s₁₂, s₂₃, s₁₃, t₁, t₂, t₃), mass m = e^{2α}, centre of mass t and

        Σ = m V Vᵀ,   V = [[e^{d₁}, s₁₂, s₁₃], [0, e^{d₂}, s₂₃], [0, 0, e^{d₃}]],   I = tr(Σ) 1 − Σ,

    Σ being the second moments of mass about the centre and I the tensor there: m, every moment and
    the triangle inequality are positive whatever θ, which is what a fit by gradient wants.

    Args:
        theta: (10,).

    Raises:
        ValueError: another shape.

    References:
        Rucker, Wensing, Smooth Parameterization of Rigid-Body Inertia, IEEE Robotics and Automation
        Letters 7 (2022).
    """
    theta = jnp.asarray(checks.check("inertia", "theta", theta))
    theta = theta.astype(jnp.result_type(theta, float))
    if theta.shape != (10,):
        raise ValueError(f"inertia: theta must have shape (10,), got {theta.shape}.")
    α, d1, d2, d3, s12, s23, s13 = theta[:7]
    zero = jnp.zeros_like(α)
    rows = ((jnp.exp(d1), s12, s13), (zero, jnp.exp(d2), s23), (zero, zero, jnp.exp(d3)))
    v = jnp.stack([jnp.stack(row) for row in rows])
    mass = jnp.exp(2 * α)
    spread = mass * (v @ v.T)
    return from_tensor(mass, jnp.trace(spread) * jnp.eye(3, dtype=v.dtype) - spread, theta[7:])


def log_cholesky(body: Inertia) -> Array:
    """The ten numbers (10,) of a body in space, as `from_log_cholesky` takes them.

    Args:
        body: whose moments satisfy the triangle inequality strictly: it is not flat.
    """
    moments = jnp.asarray(body.moments, jnp.result_type(float, *body.moments))
    axes = jnp.eye(4, dtype=moments.dtype)[0] if body.axes is None else body.axes
    turn = quaternion.matrix(axes.astype(moments.dtype))
    along = jnp.sum(moments) / 2 - moments
    share = turn @ (along[:, None] * turn.T) / body.mass
    v = jnp.linalg.cholesky(share[::-1, ::-1])[::-1, ::-1]
    center = jnp.zeros(3) if body.center is None else jnp.asarray(body.center)
    free = jnp.stack([jnp.log(body.mass) / 2, *jnp.log(jnp.diagonal(v)), v[0, 1], v[1, 2], v[0, 2]])
    return jnp.concatenate([free.astype(moments.dtype), center.astype(moments.dtype)])


@jax.custom_jvp
def principal_axes(tensor: Array) -> tuple[Array, Array]:
    """I = A diag(moments) Aᵀ with A a rotation.

    Args:
        tensor: symmetric, (3, 3) [kg m²].

    Returns:
        moments (3,), ascending, and A (3, 3). Tangents of the axes follow
        dA = A Ω, Ω_ij = dI_ij / (I_j − I_i). Where moments coincide any axes of their plane are
        principal, and there is no such Ω, while the motion of the body does have a derivative. What
        is differentiated is therefore the body whose moments are apart by ε^0.45 of the largest,
        1e-7 in float64: its derivatives, and the moments returned beside them, are off by about as
        much, by products of inertia ten times as much. Second derivatives want moments apart.
    """
    moments, axes = jnp.linalg.eigh((tensor + tensor.T) / 2)
    return moments, axes.at[:, 2].multiply(jnp.linalg.det(axes))


@principal_axes.defjvp
def _principal_axes_jvp(primals: Any, tangents: Any) -> Any:
    moments, axes = principal_axes(*primals)
    moments = _apart(moments)
    (d_tensor,) = tangents
    inside = axes.T @ ((d_tensor + d_tensor.T) / 2) @ axes
    turn = numerics.safe_divide(inside, moments[None, :] - moments[:, None])
    return (moments, axes), (jnp.diagonal(inside), axes @ turn)


def _apart(moments: Array) -> Array:
    """Ascending moments, none nearer to the one before than ε^0.45 of the largest."""
    least = float(jnp.finfo(moments.dtype).eps) ** APART * jnp.max(jnp.abs(moments))
    first, second, third = moments
    second = jnp.maximum(second, first + least)
    moved = jnp.stack([first, second, jnp.maximum(third, second + least)])
    return moments + jax.lax.stop_gradient(moved - moments)


def _check(solid: str, **values: Any) -> None:
    for what, value in values.items():
        checks.check(solid, what, value, (3,) if what == "size" else (), above=0)


def _check_tensor(owner: str, tensor: Array, moments: Array) -> None:
    known = np.asarray(tensor)
    if np.max(np.abs(known - known.T)) > 1e-6 * np.max(np.abs(known)):
        raise ValueError(f"{owner}: the tensor must be symmetric, got {checks.numerals(known)}.")
    checks.check(owner, "the principal moments", moments, above=0)
    check_triangle(owner, moments)


def check_triangle(owner: str, moments: Any) -> None:
    """Checks I₁ + I₂ ≥ I₃, which every real body satisfies.

    Args:
        owner: what the message begins with.
        moments: principal moments, (3,) [kg m²].

    Raises:
        ValueError: one moment exceeds the sum of the others by more than round-off.
    """
    if checks.is_concrete(moments):
        values = np.sort(np.asarray(moments)).tolist()
        if values[2] > (values[0] + values[1]) * (1 + 1e-5):
            raise ValueError(
                f"{owner}: principal moments {checks.numerals(values)} violate the triangle"
                " inequality I₁ + I₂ ≥ I₃, which every distribution of mass satisfies."
            )
