"""Inertia of common solids and of arbitrary tensors: mass, center of mass and principal moments.

Each constructor returns an `Inertia` for `Scene.add_body(inertia=…)`, in the solid's own frame,
whose origin is its geometric center. Users give and read positions in this frame. Internally, the
simulation uses the principal frame at the center of mass, where the mass matrix is constant and
diagonal.

References:
    Goldstein, Classical Mechanics (3rd ed.), section 5.3.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.geometry import quaternion

__all__ = [
    "Inertia",
    "sphere",
    "box",
    "cylinder",
    "rod",
    "capsule",
    "from_tensor",
    "from_log_cholesky",
    "log_cholesky",
    "principal_axes",
    "check_triangle",
]


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


APART = 0.45
"""The exponent p of the smallest relative distance ε^p between principal moments.

To differentiate the principal axes, moments that are closer than this distance are moved apart; ε
is the machine precision. The resulting error is 1e-7 in float64 and 8e-4 in float32. A smaller
distance would amplify rounding errors by more than 1/ε^0.45.
"""


@pytree
class Inertia:
    """The mass properties of a rigid body in its own frame.

    Attributes:
        mass: () [kg].
        moments: the principal moments about the center of mass, (3,) [kg m²].
        center: the center of mass, (3,) [m]; None for the origin.
        axes: the rotation from the principal frame to the body's own frame, a unit quaternion (4,);
            None if both frames have the same axes.
    """

    mass: Any
    moments: Any
    center: Any = None
    axes: Array | None = None


def sphere(mass: Scalar, radius: Scalar) -> Inertia:
    """The inertia of a homogeneous ball: I = 2/5 m r².

    Args:
        mass: () [kg].
        radius: () [m].
    """
    _check("sphere", mass=mass, radius=radius)
    moment = mass * radius**2 * 0.4
    return Inertia(mass, (moment, moment, moment))


def box(mass: Scalar, size: Array | np.ndarray | Sequence[Scalar]) -> Inertia:
    """The inertia of a homogeneous box with edges (a, b, c): I_x = m (b² + c²) / 12, and so on.

    Args:
        mass: () [kg].
        size: edges along x, y and z, (3,) [m].
    """
    _check("box", mass=mass, size=size)
    x, y, z = (edge**2 for edge in size)
    return Inertia(mass, (mass * (y + z) / 12, mass * (z + x) / 12, mass * (x + y) / 12))


def cylinder(mass: Scalar, radius: Scalar, length: Scalar) -> Inertia:
    """The inertia of a homogeneous cylinder along z: I_z = m r²/2, I_x = I_y = m (3 r² + l²)/12.

    Args:
        mass: () [kg].
        radius: () [m].
        length: the length along z, () [m].
    """
    _check("cylinder", mass=mass, radius=radius, length=length)
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (across, across, mass * radius**2 / 2))


def rod(mass: Scalar, *, length: Scalar, radius: Scalar) -> Inertia:
    """The inertia of a homogeneous round rod along x: I_x = m r²/2, I_y = I_z = m (3 r² + l²)/12.

    Length and radius are keyword arguments, because `cylinder` and `capsule`, which lie along z,
    take the radius first. The radius must be positive: a rod without thickness has no moment about
    its own axis. In the plane, use `inertia=mass * length**2 / 12`.

    Args:
        mass: () [kg].
        length: the length along x, () [m].
        radius: () [m].
    """
    _check("rod", mass=mass, length=length, radius=radius)
    across = mass * (3 * radius**2 + length**2) / 12
    return Inertia(mass, (mass * radius**2 / 2, across, across))


def capsule(mass: Scalar, radius: Scalar, length: Scalar) -> Inertia:
    """The inertia of a homogeneous capsule along z: a cylinder between two half balls.

    The center of mass of a half ball of mass m_h lies 3r/8 from its flat face. Its moment of
    inertia about a transverse axis through its center of mass is 83/320 m_h r².

    Args:
        mass: () [kg].
        radius: () [m].
        length: the length of the cylinder, without the half balls, () [m].
    """
    _check("capsule", mass=mass, radius=radius, length=length)
    share = 3 * length / (3 * length + 4 * radius)  # the cylinder's share of the volume
    tube, balls = mass * share, mass * (1 - share)
    arm = length / 2 + 3 * radius / 8
    along = tube * radius**2 / 2 + balls * radius**2 * 0.4
    across = tube * (3 * radius**2 + length**2) / 12 + balls * (radius**2 * (83 / 320) + arm**2)
    return Inertia(mass, (across, across, along))


def from_tensor(
    mass: PyTree,
    tensor: PyTree,
    center: Scalar | Sequence[Scalar] | None = None,
    owner: str = "inertia",
) -> Inertia:
    """The inertia of a body whose full inertia tensor about the center of mass is known.

    The tensor is diagonalized. Derivatives exist also if principal moments coincide (see
    `principal_axes`). Their relative error is then 1e-6 in float64. In float32, derivatives with
    respect to products of inertia have an error of a few percent.

    Args:
        mass: () [kg].
        tensor: the symmetric inertia tensor, (3, 3) [kg m²].
        center: the center of mass in the same frame, (3,) [m]; None for the origin.
        owner: the first words of error messages.

    Raises:
        ValueError: the tensor is not 3×3, not symmetric or not positive definite, or it violates
            the triangle inequality.
    """
    tensor = jnp.asarray(checks.check(owner, "the tensor", tensor))
    if tensor.shape != (3, 3):
        raise ValueError(f"{owner}: the tensor must have shape (3, 3), got {tensor.shape}.")
    moments, axes = principal_axes(tensor)
    if checks.is_concrete(tensor):
        values = np.asarray(tensor)
        if np.max(np.abs(values - values.T)) > 1e-6 * np.max(np.abs(values)):
            raise ValueError(
                f"{owner}: the tensor must be symmetric, got {checks.numerals(values)}."
            )
        checks.check(owner, "the principal moments", moments, above=0)
        check_triangle(owner, moments)
    return Inertia(mass, moments, center, quaternion.from_matrix(axes))


def from_log_cholesky(theta: Scalar | Sequence[Scalar]) -> Inertia:
    """The inertia of a body from ten unconstrained parameters.

    The inertia is physically consistent for all values of the parameters, which are
    θ = (α, d₁, d₂, d₃, s₁₂, s₂₃, s₁₃, t₁, t₂, t₃). The mass is m = e^{2α}, and the center of mass
    is t = (t₁, t₂, t₃). The matrix Σ of second moments of mass about the center and the inertia
    tensor I about the center are

        Σ = m V Vᵀ,   V = [[e^{d₁}, s₁₂, s₁₃], [0, e^{d₂}, s₂₃], [0, 0, e^{d₃}]],   I = tr(Σ) 1 − Σ.

    For every θ, m and all moments are positive, and the triangle inequality holds. Gradient-based
    fits of θ therefore need no constraints.

    Args:
        theta: θ, (10,).

    Raises:
        ValueError: `theta` has another shape.

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
    """Returns the parameters θ (10,) of a body in space; inverts `from_log_cholesky`.

    Args:
        body: an inertia that satisfies the triangle inequality strictly. A flat body, for which one
            moment is the sum of the other two, has no such parameters.
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
    """Diagonalizes an inertia tensor I: I = A diag(moments) Aᵀ with a rotation A.

    Args:
        tensor: the symmetric tensor I, (3, 3) [kg m²].

    Returns:
        The principal moments (3,) in ascending order, and A (3, 3), whose columns are the principal
        axes. The tangent of A is dA = A Ω with Ω_ij = dI_ij / (I_j − I_i), where dI is expressed in
        the principal axes.

        If moments coincide, Ω does not exist, although the motion of the body has a derivative.
        Under differentiation, moments are therefore separated by at least ε^0.45 of the largest
        moment: 1e-7 in float64. This is also the relative error of the derivatives, and of moments
        computed together with derivatives. For derivatives with respect to products of inertia, the
        error is ten times as large. Second derivatives need distinct moments.
    """
    moments, axes = jnp.linalg.eigh((tensor + tensor.T) / 2)
    return moments, axes.at[:, 2].multiply(jnp.linalg.det(axes))


@principal_axes.defjvp
def _principal_axes_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    moments, axes = principal_axes(*primals)
    (d_tensor,) = tangents
    # moves ascending moments apart, to a distance of at least ε^0.45 of the largest moment
    least = float(jnp.finfo(moments.dtype).eps) ** APART * jnp.max(jnp.abs(moments))
    first, second, third = moments
    second = jnp.maximum(second, first + least)
    moved = jnp.stack([first, second, jnp.maximum(third, second + least)])
    moments = moments + jax.lax.stop_gradient(moved - moments)
    inside = axes.T @ ((d_tensor + d_tensor.T) / 2) @ axes
    turn = numerics.safe_divide(inside, moments[None, :] - moments[:, None])
    return (moments, axes), (jnp.diagonal(inside), axes @ turn)


def _check(solid: str, **values: PyTree) -> None:
    """Checks that the mass and the lengths of a solid are positive.

    Args:
        solid: the name of the solid, for error messages.
        values: the mass and the lengths by argument name; `size` has three lengths.
    """
    for what, value in values.items():
        checks.check(solid, what, value, (3,) if what == "size" else (), above=0)


def check_triangle(owner: str, moments: Scalar | Sequence[Scalar]) -> None:
    """Checks the triangle inequality I₁ + I₂ ≥ I₃, which every distribution of mass satisfies.

    Args:
        owner: the first words of the error message.
        moments: principal moments, (3,) [kg m²].

    Raises:
        ValueError: one moment exceeds the sum of the other two by more than rounding.
    """
    if checks.is_concrete(moments):
        values = np.sort(np.asarray(moments)).tolist()
        if values[2] > (values[0] + values[1]) * (1 + 1e-5):
            raise ValueError(
                f"{owner}: principal moments {checks.numerals(values)} violate the triangle"
                " inequality I₁ + I₂ ≥ I₃, which every distribution of mass satisfies."
            )
