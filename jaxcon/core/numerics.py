"""Guards: every function with a singular point, finite and with a finite gradient there.

Each takes the safe branch of the input before the singular operation (the "double where"), since a
`where` after it would still multiply an infinite derivative by zero.
"""

from typing import Any

import jax.numpy as jnp

from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane


def safe_sqrt(x: Lane) -> Array:
    """√x where x > 0, and 0 with zero gradient elsewhere."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(numerator: Lane, denominator: Lane) -> Array:
    """n / d where d ≠ 0, and 0 with zero gradient elsewhere."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1), 0)


def norm(x: Any) -> Array:
    """‖x‖ over the first axis (or a Vector's components), with zero gradient at x = 0."""
    x = Vector.of(x)
    return safe_sqrt(x.dot(x))


def unit(x: Vector) -> Vector:
    """x / ‖x‖, and 0 with zero gradient at x = 0."""
    return x * safe_divide(1.0, norm(x))


def safe_arctan2(y: Lane, x: Lane) -> Array:
    """The angle of (x, y), and 0 with zero gradient at the origin."""
    origin = (x == 0) & (y == 0)
    return jnp.arctan2(jnp.where(origin, 0, y), jnp.where(origin, 1, x))


def wrap(angle: Lane) -> Array:
    """The angle brought to [−π, π] by whole turns; its derivative is 1."""
    turn = 2 * jnp.pi
    return angle - turn * jnp.round(angle / turn)


def cos_sinc(square: Lane) -> tuple[Array, Array]:
    """cos √s and sin √s / √s as smooth functions of s ≥ 0, at s = 0 too.

    Below s = 0.01 both are their Taylor series to s⁵, exact to the last place of float64.
    """
    small = square < 0.01
    s = jnp.where(small, square, 0)
    cos_series = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90))))
    sinc_series = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110))))
    root = jnp.sqrt(jnp.where(small, 1, square))
    cos = jnp.where(small, cos_series, jnp.cos(root))
    return cos, jnp.where(small, sinc_series, jnp.sin(root) / root)
