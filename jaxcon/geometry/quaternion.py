"""Unit quaternions `wxyz`, body to world.

Every function takes arrays whose first axis enumerates components, or Vectors of lanes; trailing
axes are batches. Angular velocities are in the body frame, so that q̇ = ½ q ⊗ (0, ω).

A ValueError names what is not of real numbers, or of another shape. Values are not read: NaN in an
argument becomes NaN in the result.

References:
    Solà, Quaternion kinematics for the error-state Kalman filter (2017), sections 1-4.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Matrix, Vector, componentwise, minus, plus, times
from jaxcon.core.typing import Array, Lane

IDENTITY = Vector(1.0, 0.0, 0.0, 0.0)


def _of_components(*sizes: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Lets a function of Vectors of these sizes also take arrays, which it checks.

    Raises:
        ValueError: by the function, of arrays that are not real numbers or of other shapes.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        owner, lanes = f"quaternion.{function.__name__}", componentwise(function)
        names = tuple(inspect.signature(function).parameters)
        signature = inspect.signature(function)

        @functools.wraps(function)
        def wrapped(*args: Any, **named: Any) -> Any:
            values = signature.bind(*args, **named).args
            if any(isinstance(x, Vector) for x in values):
                return function(*values)
            given = zip(values, ((n,) for n in sizes), strict=True)
            return lanes(*checks.components(owner, **dict(zip(names, given, strict=True))))

        return wrapped

    return decorate


@_of_components(4, 4)
def multiply(p: Any, q: Any) -> Any:
    """p ⊗ q: first turn by q, then by p.

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
def conjugate(q: Any) -> Any:
    """q*: the inverse of a unit quaternion (4, …).

    Args:
        q: (4, …).
    """
    return Vector(q[0], *(times(-1, x) for x in q[1:]))


@_of_components(4, 3)
def rotate(q: Any, x: Any) -> Any:
    """q x q*: a vector of the body (3, …) in the world frame.

    Args:
        q: (4, …).
        x: in the body frame, (3, …).
    """
    scalar, vector = split(q)
    twice = vector.cross(x) * 2.0
    return x + twice * scalar + vector.cross(twice)


@_of_components(4)
def matrix(q: Any) -> Any:
    """The rotation matrix R (3, 3, …) with R x = q x q*.

    Args:
        q: (4, …).
    """
    return rotation(q)


def rotation(q: Vector) -> Matrix:
    """The rotation matrix of lanes, R x = q x q*.

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
def derivative(q: Any, omega: Any) -> Any:
    """q̇ = ½ q ⊗ (0, ω), ω (3, …) in the body frame [rad/s].

    Args:
        q: (4, …).
        omega: ω, (3, …) [rad/s].
    """
    return multiply(q, Vector(0.0, *omega)) * 0.5


@_of_components(3)
def exp(phi: Any) -> Any:
    """The turn by ‖φ‖ about φ (3, …) [rad]: (cos ½‖φ‖, φ sin ½‖φ‖ / ‖φ‖), smooth at φ = 0.

    Args:
        phi: φ, (3, …) [rad].
    """
    cos, sinc = numerics.cos_sinc(phi.dot(phi) * 0.25)
    return Vector(cos, *(phi * (sinc * 0.5)))


@_of_components(4)
def log(q: Any) -> Any:
    """The rotation vector φ (3, …) [rad] of the shorter turn: exp(φ) = ± q, smooth at identity.

    Args:
        q: (4, …).
    """
    scalar, vector = split(q)
    sine = numerics.norm(vector)
    half = jnp.arctan2(sine, jnp.abs(scalar))
    series = 2 * (1 + sine * sine * (1 / 6 + sine * sine * (3 / 40)))
    small = sine < 1e-3
    scale = jnp.where(small, series, 2 * half / jnp.where(small, 1, sine))
    return vector * jnp.where(scalar < 0, -scale, scale)


@_of_components(4)
def normalize(q: Any) -> Any:
    """q / ‖q‖ (4, …).

    Args:
        q: (4, …), not zero.
    """
    return numerics.unit(q)


def from_axis_angle(axis: Any, angle: Any) -> Array:
    """The turn by an angle () [rad] about an axis (3,) of any length but zero.

    Args:
        axis: (3,), of any length but zero.
        angle: () [rad].

    Raises:
        ValueError: not real numbers, or another shape.
    """
    with checks.without_waiting():
        checks.check("quaternion.from_axis_angle", "axis", axis, (3,))
        checks.check("quaternion.from_axis_angle", "angle", angle, ())
    axis = jnp.asarray(axis)
    if not jnp.issubdtype(axis.dtype, jnp.floating):
        axis = axis.astype(jnp.result_type(float))
    return exp(numerics.unit(Vector.of(axis)).stack() * angle)


def from_matrix(r: Array) -> Array:
    """The unit quaternion (4,) of a rotation matrix (3, 3), differentiable at every rotation.

    The column of 4 q qᵀ with the largest diagonal entry, which is never near zero.

    Args:
        r: R, (3, 3).

    Raises:
        ValueError: not real numbers, or another shape.

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


def split(q: Vector) -> tuple[Lane, Vector]:
    """The scalar and the vector part.

    Args:
        q: a `Vector` of 4 lanes.
    """
    return q[0], Vector(*q[1:])
