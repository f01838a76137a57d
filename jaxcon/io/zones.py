"""Rays from points to the zones of touch sensors."""

from __future__ import annotations

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.typing import Array

SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box")


def meets(shape: str, size: Array, start: Array, ray: Array) -> Array:
    """Returns True where a ray from a point meets a zone, or starts within it, (n,).

    Args:
        shape: the shape of the zone, one of `SHAPES`.
        size: MuJoCo's size of the zone, (3,) [m]; its axis is z.
        start: the start of each ray in the frame of the zone, (n, 3) [m].
        ray: the direction of each ray in the frame of the zone, (n, 3).
    """
    if shape == "box":
        low, high = _between(start, ray, size[None])
        return jnp.max(low, axis=1) <= jnp.min(high, axis=1)
    if shape in ("sphere", "ellipsoid"):
        radii = size[None] if shape == "ellipsoid" else size[None, :1]
        low, high = _in_ball(start / radii, ray / radii)
        return low <= high
    low, high = _in_ball(start[:, :2] / size[0], ray[:, :2] / size[0])
    first, last = _between(start[:, 2:], ray[:, 2:], size[None, 1:2])
    meets_side = jnp.maximum(low, first[:, 0]) <= jnp.minimum(high, last[:, 0])
    if shape == "cylinder":
        return meets_side
    end = jnp.stack([jnp.zeros_like(size[1]), jnp.zeros_like(size[1]), size[1]])
    caps = [_in_ball((start - c[None]) / size[0], ray / size[0]) for c in (end, -end)]
    return meets_side | (caps[0][0] <= caps[0][1]) | (caps[1][0] <= caps[1][1])


def _between(start: Array, ray: Array, half: Array) -> tuple[Array, Array]:
    """Returns the interval of s ≥ 0 in which |start + s ray| ≤ half, for each component.

    The interval is (∞, −∞) if it is empty.
    """
    still = ray == 0
    ends = [numerics.safe_divide(sign * half - start, ray) for sign in (-1, 1)]
    low, high = jnp.maximum(jnp.minimum(*ends), 0), jnp.maximum(*ends)
    inside = jnp.abs(start) <= half
    low = jnp.where(still, jnp.where(inside, 0, jnp.inf), low)
    high = jnp.where(still, jnp.where(inside, jnp.inf, -jnp.inf), high)
    return low, high


def _in_ball(start: Array, ray: Array) -> tuple[Array, Array]:
    """Returns the interval of s ≥ 0 in which ‖start + s ray‖ ≤ 1, (n,) each.

    The interval is (∞, −∞) if it is empty.
    """
    a, b = jnp.sum(ray * ray, axis=1), jnp.sum(start * ray, axis=1)
    c = jnp.sum(start * start, axis=1) - 1
    square = b * b - a * c
    root = numerics.safe_sqrt(jnp.maximum(square, 0))
    low = jnp.maximum(numerics.safe_divide(-b - root, a), 0)
    high = numerics.safe_divide(-b + root, a)
    still = a == 0
    low = jnp.where(still, jnp.where(c <= 0, 0, jnp.inf), jnp.where(square < 0, jnp.inf, low))
    high = jnp.where(still, jnp.where(c <= 0, jnp.inf, -jnp.inf), high)
    return low, jnp.where(~still & (square < 0), -jnp.inf, high)
