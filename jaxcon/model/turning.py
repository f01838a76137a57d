"""Angles of bodies in the plane less their whole turns.

A float32 near 200 π is a multiple of 6e-5, too coarse for a constraint. Users see continuous angles
θ, rounded to a float, and the state holds what rounding took from them, ε. A step computes with

    r = θ + ε − 2π n,    n the whole turns in θ,

and returns to θ⁺ + ε⁺ = θ + (r⁺ − (θ − 2π n)). Within half a turn of zero r is θ and ε is below the
rounding of θ. The derivative of each way is the identity. Angles of float64 are left as they are:
near 200 π they are multiples of 1e-13.
"""

from __future__ import annotations

import functools
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.doubled import TWO_PI
from jaxcon.core.numerics import alternating
from jaxcon.core.typing import Array

DIGITS = 8
"""Binary digits of the first two parts of 2π: 65 536 times each of them is exact in float32."""

QUARTER = 4
"""Terms of the series of cosine and sine of up to an eighth of a turn in float32."""


def coarse(dtype: Any) -> bool:
    """Returns True for dtypes whose angles are computed with less their turns."""
    return jnp.finfo(dtype).bits < 64


@functools.cache
def two_pi() -> tuple[float, float, float]:
    """2π as a sum of three floats, of which the first two have few digits."""
    left, parts = sum(map(Fraction, TWO_PI)), []
    for exponent in (2, 2 - DIGITS):  # of the first digit
        unit = Fraction(2) ** (exponent - DIGITS + 1)
        parts.append(left // unit * unit)
        left -= parts[-1]
    return float(parts[0]), float(parts[1]), float(left)


def _without_turns(angle: Array) -> tuple[Array, Array]:
    """θ − 2π n and n."""
    turns = jnp.round(angle * (1 / (2 * np.pi)))
    left = angle
    for part in two_pi():
        left = left - turns * part
    return left, turns


@jax.custom_jvp
def cos_sin(angle: Array) -> tuple[Array, Array]:
    """cos θ and sin θ, in float32 within 1.2e-7 at the float θ up to 1e5 rad.

    Both are series of θ less its quarter turns. XLA's own functions, which float64 has here, take
    one number at a time on a CPU, and five times as long.
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
def _(primals: Any, tangents: Any) -> Any:
    cos, sin = cos_sin(*primals)
    return (cos, sin), (-sin * tangents[0], cos * tangents[0])


@jax.custom_jvp
def reduced(angle: Array, remainder: Array) -> tuple[Array, Array]:
    """r and n of θ and ε, all (bodies,).

    An ε that no longer fits, since θ was replaced, counts as zero.
    """
    left, turns = _without_turns(angle)
    return left + jnp.where(angle + remainder == angle, remainder, 0), turns


@reduced.defjvp
def _(primals: Any, tangents: Any) -> Any:
    left, turns = reduced(*primals)
    return (left, turns), (tangents[0], jnp.zeros_like(turns))


@jax.custom_jvp
def continued(angle: Array, after: Array) -> tuple[Array, Array]:
    """θ⁺ and ε⁺ of θ and r⁺, all (bodies,)."""
    change = after - _without_turns(angle)[0]
    new = angle + change
    return new, change - (new - angle)


@continued.defjvp
def _(primals: Any, tangents: Any) -> Any:
    angle, remainder = continued(*primals)
    return (angle, remainder), (tangents[1], jnp.zeros_like(remainder))
