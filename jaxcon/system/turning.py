"""Angles of bodies in the plane, computed without their whole turns.

A float32 near 200 π is a multiple of 6e-5, too coarse for a constraint. Users see continuous angles
θ, rounded to a float; the state also keeps the rounding error ε. A step computes with the reduced
angle

    r = θ + ε − 2π n,    where n is the number of whole turns in θ,

and its result r⁺ gives the new angle θ⁺ + ε⁺ = θ + (r⁺ − (θ − 2π n)). If |θ| is below half a turn,
then n = 0, and r rounds to θ. The derivatives dr/dθ and dθ⁺/dr⁺ are 1. In float64 angles are not
reduced: near 200 π they are multiples of 1e-13.
"""

from __future__ import annotations

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.doubled import TWO_PI
from jaxcon.core.numerics import alternating
from jaxcon.core.typing import Array, DType

Arrays = tuple[Array, ...]

DIGITS = 8
"""The number of binary digits in the first and in the second of three floats whose sum is 2π.

The product of either with an integer up to 65 536 is exact in float32.
"""

QUARTER = 4
"""The number of terms of the float32 series of cosine and sine, for up to an eighth of a turn."""


def coarse(dtype: DType) -> bool:
    """Returns True for dtypes in which angles are computed without whole turns (below 64 bits)."""
    return jnp.finfo(dtype).bits < 64


@functools.cache
def two_pi() -> tuple[float, float, float]:
    """Returns 2π as a sum of three floats; the first two have few binary digits."""
    left, parts = sum(map(Fraction, TWO_PI)), []
    for exponent in (2, 2 - DIGITS):  # the power of two of the first digit
        unit = Fraction(2) ** (exponent - DIGITS + 1)
        parts.append(left // unit * unit)
        left -= parts[-1]
    return float(parts[0]), float(parts[1]), float(left)


def _without_turns(angle: Array) -> tuple[Array, Array]:
    """Returns the reduced angle θ − 2π n, and the number n of whole turns."""
    turns = jnp.round(angle * (1 / (2 * np.pi)))
    left = angle
    for part in two_pi():
        left = left - turns * part
    return left, turns


@jax.custom_jvp
def cos_sin(angle: Array) -> tuple[Array, Array]:
    """Returns cos θ and sin θ; in float32 with an error below 1.2e-7 for θ up to 1e5 rad.

    In float32, both are series in the angle that remains after subtracting quarter turns. In
    float64, XLA's own functions are used; on a CPU they are not vectorized and take five times as
    long.
    """
    if not coarse(angle.dtype):
        return jnp.cos(angle), jnp.sin(angle)
    quarters = jnp.round(angle * (2 / np.pi))
    rest = angle
    for part in two_pi():
        rest = rest - quarters * (part / 4)
    square, count = rest * rest, quarters.astype(jnp.int32)
    cos, sin = alternating(square, 0, QUARTER), rest * alternating(square, 1, QUARTER)
    odd = count & 1 == 1
    first, second = jnp.where(odd, sin, cos), jnp.where(odd, cos, sin)
    return (
        jnp.where((count + 1) & 2 == 0, first, -first),
        jnp.where(count & 2 == 0, second, -second),
    )


@cos_sin.defjvp
def _(primals: Arrays, tangents: Arrays) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    cos, sin = cos_sin(*primals)
    return (cos, sin), (-sin * tangents[0], cos * tangents[0])


@jax.custom_jvp
def reduced(angle: Array, remainder: Array) -> tuple[Array, Array]:
    """Returns the reduced angle r = θ + ε − 2π n and the number n of turns, both (bodies,).

    If θ was replaced, the old ε may exceed the rounding error of the new θ; ε then counts as zero.

    Args:
        angle: θ, (bodies,) [rad].
        remainder: the rounding error ε of θ, (bodies,) [rad].
    """
    left, turns = _without_turns(angle)
    return left + jnp.where(angle + remainder == angle, remainder, 0), turns


@reduced.defjvp
def _(primals: Arrays, tangents: Arrays) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    left, turns = reduced(*primals)
    return (left, turns), (tangents[0], jnp.zeros_like(turns))


@jax.custom_jvp
def continued(angle: Array, after: Array) -> tuple[Array, Array]:
    """Returns the angles θ⁺ after a step and their rounding errors ε⁺, both (bodies,) [rad].

    Args:
        angle: θ at the start of the step, (bodies,) [rad].
        after: the reduced angle r⁺ after the step, (bodies,) [rad].
    """
    change = after - _without_turns(angle)[0]
    new = angle + change
    return new, change - (new - angle)


@continued.defjvp
def _(primals: Arrays, tangents: Arrays) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    angle, remainder = continued(*primals)
    return (angle, remainder), (tangents[1], jnp.zeros_like(remainder))
