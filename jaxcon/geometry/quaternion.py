"""Unit quaternions (w, x, y, z) that rotate from the body frame to the world frame.

Every function takes arrays whose first axis enumerates components, or Vectors of lanes; trailing
axes are batches. Angular velocities ω are in the body frame, so that q̇ = ½ q ⊗ (0, ω).

If an argument has a wrong shape or is not real, a ValueError names the argument. Values
of JAX arrays are not read: NaN in an argument becomes NaN in the result.

References:
    Solà, Quaternion kinematics for the error-state Kalman filter (2017), sections 1-4.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp

from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Matrix, Vector, componentwise, minus, plus, times
from jaxcon.core.typing import Array, Lane, Scalar

__all__ = [
    "multiply",
    "conjugate",
    "rotate",
    "matrix",
    "derivative",
    "exp",
    "log",
    "normalize",
    "from_axis_angle",
    "from_matrix",
]


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


Components: TypeAlias = Array | Vector
"""The components of a quaternion or vector: an array (component, …), or a Vector of lanes."""

IDENTITY = Vector(1.0, 0.0, 0.0, 0.0)


def _of_components(*sizes: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that lets a function of Vectors also accept arrays.

    The decorated function checks arrays. It raises a ValueError if an array has a wrong shape or
    its numbers are not real.

    Args:
        sizes: the number of components of each argument.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        owner, lanes = f"quaternion.{function.__name__}", componentwise(function)
        signature = inspect.signature(function)

        @functools.wraps(function)
        def wrapped(*args: Components, **named: Components) -> Any:
            values = signature.bind(*args, **named).args
            if any(isinstance(x, Vector) for x in values):
                return function(*values)
            given = zip(signature.parameters, values, sizes, strict=True)
            return lanes(*checks.components(owner, **{name: (x, (n,)) for name, x, n in given}))

        return wrapped

    return decorate


@_of_components(4, 4)
def multiply(p: Components, q: Components) -> Any:
    """Returns the product p ⊗ q: the rotation by q followed by the rotation by p.

    Args:
        p: (4, …).
        q: (4, …).

    Returns:
        (4, …).
    """
    scalar, vector = split(p)
    other, direction = split(q)
    turned = direction * scalar + vector * other + vector.cross(direction)
    return Vector(minus(times(scalar, other), vector.dot(direction)), *turned)


@_of_components(4)
def conjugate(q: Components) -> Any:
    """Returns the conjugate q*, (4, …), which is the inverse of a unit quaternion.

    Args:
        q: (4, …).
    """
    return Vector(q[0], *(times(-1, x) for x in q[1:]))


@_of_components(4, 3)
def rotate(q: Components, x: Components) -> Any:
    """Rotates a vector x from the body frame to the world frame: returns q x q*, (3, …).

    Args:
        q: (4, …).
        x: the vector in the body frame, (3, …).
    """
    (scalar, vector), x = split(q), Vector.of(x)
    twice = vector.cross(x) * 2.0
    return x + twice * scalar + vector.cross(twice)


@_of_components(4)
def matrix(q: Components) -> Any:
    """Returns the rotation matrix R, (3, 3, …), with R x = q x q*.

    Args:
        q: (4, …).
    """
    return rotation(q)


def rotation(q: Components) -> Matrix:
    """Returns the rotation matrix R as a `Matrix` of lanes, with R x = q x q*.

    Args:
        q: a `Vector` of 4 lanes.
    """
    w, x, y, z = q
    xx, yy, zz = times(x, x), times(y, y), times(z, z)
    xy, xz, yz = times(x, y), times(x, z), times(y, z)
    wx, wy, wz = times(w, x), times(w, y), times(w, z)

    def diagonal(a: Lane, b: Lane) -> Lane:
        return minus(1.0, times(2.0, plus(a, b)))

    def twice(a: Lane, b: Lane, sign: int) -> Lane:
        return times(2.0, plus(a, times(sign, b)))

    return Matrix(
        Vector(diagonal(yy, zz), twice(xy, wz, -1), twice(xz, wy, 1)),
        Vector(twice(xy, wz, 1), diagonal(xx, zz), twice(yz, wx, -1)),
        Vector(twice(xz, wy, -1), twice(yz, wx, 1), diagonal(xx, yy)),
    )


@_of_components(4, 3)
def derivative(q: Components, omega: Components) -> Any:
    """Returns the time derivative q̇ = ½ q ⊗ (0, ω), (4, …) [1/s].

    Args:
        q: (4, …).
        omega: the angular velocity ω in the body frame, (3, …) [rad/s].
    """
    return multiply(q, Vector(0.0, *omega)) * 0.5


@_of_components(3)
def exp(phi: Components) -> Any:
    """Returns the quaternion (4, …) of a rotation vector φ: the rotation by ‖φ‖ about φ.

    It is (cos ½‖φ‖, φ sin ½‖φ‖ / ‖φ‖), evaluated smoothly at φ = 0.

    Args:
        phi: the rotation vector φ, (3, …) [rad].
    """
    φ = Vector.of(phi)
    cos, sinc = numerics.cos_sinc(φ.dot(φ) * 0.25)
    return Vector(cos, *(φ * (sinc * 0.5)))


@_of_components(4)
def log(q: Components) -> Any:
    """Returns the shortest rotation vector φ of a quaternion, (3, …) [rad].

    It solves exp(φ) = ±q, and is smooth at the identity.

    Args:
        q: (4, …).
    """
    scalar, vector = split(q)
    sine = numerics.norm(vector)
    series = 2 * (1 + sine * sine * (1 / 6 + sine * sine * (3 / 40)))
    small = sine < 1e-3
    # the branch that is not taken must have a finite derivative, also where q = 0
    safe = jnp.where(small, 1, sine)
    half = jnp.arctan2(safe, jnp.abs(scalar))
    scale = jnp.where(small, series, 2 * half / safe)
    return vector * jnp.where(scalar < 0, -scale, scale)


@_of_components(4)
def normalize(q: Components) -> Any:
    """Returns the unit quaternion q / ‖q‖, (4, …).

    Args:
        q: a nonzero quaternion, (4, …).
    """
    return numerics.unit(Vector.of(q))


def from_axis_angle(axis: Scalar | Sequence[Scalar], angle: Scalar) -> Array:
    """Returns the unit quaternion (4,) of a rotation by an angle about an axis.

    Args:
        axis: the rotation axis, (3,), of any length; zeros give the identity.
        angle: the rotation angle, () [rad].

    Raises:
        ValueError: an argument is not real, or has a wrong shape.
    """
    with checks.without_waiting():
        checks.check("quaternion.from_axis_angle", "axis", axis, (3,))
        checks.check("quaternion.from_axis_angle", "angle", angle, ())
    axis = jnp.asarray(axis)
    if not jnp.issubdtype(axis.dtype, jnp.floating):
        axis = axis.astype(jnp.result_type(float))
    return exp(numerics.unit(Vector.of(axis)).stack() * angle)


def from_matrix(r: Array) -> Array:
    """Returns the unit quaternion (4,) of a rotation matrix, differentiable at every rotation.

    The result is the normalized column of 4 q qᵀ with the largest diagonal entry; that column is
    never near zero.

    Args:
        r: R, (3, 3).

    Raises:
        ValueError: `r` is not real, or has a wrong shape.

    References:
        Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1 (1978).
    """
    with checks.without_waiting():
        r = checks.check("quaternion.from_matrix", "r", r, (3, 3))
    r = jnp.asarray(r)
    r00, r11, r22 = r[0, 0], r[1, 1], r[2, 2]
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    outer = jnp.stack(
        [
            jnp.stack([1 + r00 + r11 + r22, x, y, z]),
            jnp.stack([x, 1 + r00 - r11 - r22, xy, xz]),
            jnp.stack([y, xy, 1 - r00 + r11 - r22, yz]),
            jnp.stack([z, xz, yz, 1 - r00 - r11 + r22]),
        ]
    )
    largest = outer[jnp.argmax(jnp.diagonal(outer))]
    return largest / jnp.sqrt(jnp.sum(largest * largest))


def split(q: Components) -> tuple[Lane, Vector]:
    """Splits a quaternion into its scalar part w and its vector part (x, y, z).

    Args:
        q: a `Vector` of 4 lanes.
    """
    return q[0], Vector(*q[1:])
