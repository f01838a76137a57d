"""Angles of bodies in the plane less their whole turns.

A float32 near 200 π is a multiple of 6e-5, too coarse for a constraint. Users see angles that go on
from turn to turn, θ rounded to a float, and the state holds what they lack, ε. A step computes with

    r = θ + ε − 2π n,    n the whole turns in θ,

and returns to θ⁺ + ε⁺ = r⁺ + 2π n. Within half a turn of zero all of this is r = θ and ε = 0. The
derivative of each way is 1. Angles of float64 are left as they are: near 200 π they are multiples
of 1e-13.
"""

from __future__ import annotations

import functools
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.doubled import TWO_PI
from jaxcon.core.typing import Array


def coarse(dtype: Any) -> bool:
    """Whether angles of this dtype are computed with less their turns."""
    return jnp.finfo(dtype).bits < 64


@functools.cache
def turn(dtype: Any) -> tuple[float, float]:
    """2π as a sum of two floats, of which the first is short: times 65 536 it is exact."""
    whole, digits = sum(map(Fraction, TWO_PI)), jnp.finfo(dtype).nmant + 1 - 16
    short = Fraction(round(whole * 2 ** (digits - 3)), 2 ** (digits - 3))
    return float(short), float(whole - short)


@jax.custom_jvp
def unwound(angle: Array, remainder: Array) -> tuple[Array, Array]:
    """r and n of θ and ε, all (bodies,).

    An ε that no longer fits, since θ was replaced, counts as zero.
    """
    short, rest = turn(angle.dtype)
    turns = jnp.round(angle * (1 / (2 * np.pi)))
    remainder = jnp.where(angle + remainder == angle, remainder, 0)
    return ((angle - turns * short) - turns * rest) + remainder, turns


@unwound.defjvp
def _(primals: Any, tangents: Any) -> Any:
    reduced, turns = unwound(*primals)
    return (reduced, turns), (tangents[0], jnp.zeros_like(turns))


@jax.custom_jvp
def rewound(reduced: Array, turns: Array) -> tuple[Array, Array]:
    """θ and ε of r and n, all (bodies,)."""
    short, rest = turn(reduced.dtype)
    whole = turns * short
    total = whole + reduced
    left = (reduced - (total - whole)) + turns * rest
    angle = total + left
    return angle, left - (angle - total)


@rewound.defjvp
def _(primals: Any, tangents: Any) -> Any:
    angle, remainder = rewound(*primals)
    return (angle, remainder), (tangents[0], jnp.zeros_like(remainder))
