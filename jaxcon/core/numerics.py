"""Guards: every function with a singular point, finite and with a finite gradient there.

Each takes the safe branch of the input before the singular operation (the "double where"), since a
`where` after it would still multiply an infinite derivative by zero.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane, PyTree


def safe_sqrt(x: Lane) -> Array:
    """√x, and 0 with zero gradient where x ≤ 0; NaN stays NaN."""
    low = x <= 0
    return jnp.where(low, 0, jnp.sqrt(jnp.where(low, 1, x)))


def safe_divide(numerator: Lane, denominator: Lane) -> Array:
    """n / d where d ≠ 0, and 0 with zero gradient elsewhere."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1), 0)


def finite_or_nan(x: Lane) -> Array:
    """A number, and NaN for an infinite one, which a quotient or a comparison would hide."""
    return jnp.where(jnp.isfinite(x), x, jnp.nan)


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


def negligible(x: Array) -> Array:
    """ε^⅔ (1 + max |x|) by world: what an iteration may leave open at x (n, …), a constant."""
    size = 1 + jnp.max(jnp.abs(x), axis=0, initial=0)
    return jax.lax.stop_gradient(float(jnp.finfo(x.dtype).eps) ** (2 / 3) * size)


def wrap(angle: Lane) -> Array:
    """The angle brought to [−π, π] by whole turns; its derivative is 1."""
    turn = 2 * jnp.pi
    return angle - turn * jnp.round(angle / turn)


TERMS = {32: 6, 64: 11}
"""The number of terms of the series of cos r and sin r / r in r², by the bits of a float: the next
term is below half of the last place for r up to π/2."""


def cos_sinc(square: Lane) -> tuple[Array, Array]:
    """cos √s and sin √s / √s as smooth functions of s ≥ 0, at s = 0 too.

    With n the whole half turns in √s and r = √s − n π, cos √s = (−1)ⁿ cos r and
    sin √s = (−1)ⁿ sin r, and both are series in r²; near s = 0 that is s itself.
    """
    near = square < (jnp.pi / 2) ** 2
    root = jnp.sqrt(jnp.where(near, 1, square))
    half_turns = jnp.round(root / jnp.pi)
    rest = root - half_turns * jnp.pi
    sign = 1 + 4 * jnp.floor(half_turns / 2) - 2 * half_turns
    s = jnp.where(near, square, rest * rest)
    cos, sinc = alternating(s, 0), alternating(s, 1)
    return sign * cos, jnp.where(near, sinc, sign * sinc * rest / root)


def alternating(s: Array, odd: int, terms: int | None = None) -> Array:
    """1 − s/(2 + odd)! + s²/(4 + odd)! − …: cos √s, or with odd = 1 sin √s / √s."""
    terms = TERMS[jnp.finfo(s.dtype).bits] if terms is None else terms
    total = jnp.full_like(s, (-1) ** terms / math.factorial(2 * terms + odd))
    for k in range(terms - 1, -1, -1):
        total = total * s + (-1) ** k / math.factorial(2 * k + odd)
    return total


BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798)
"""|B₂|, |B₄|, … of (x/2) cot(x/2) = 1 − Σ |B₂ₙ| x²ⁿ / (2n)!; exact to the last place for x < 1."""


def inverse_exponential(square: Lane) -> Array:
    """c(s) = (1 − (√s/2) cot(√s/2)) / s as a smooth function of 0 ≤ s < (2π)², 1/12 at s = 0.

    The coefficient of dexp⁻¹_φ = 1 − ½ φ× + c(φ·φ) φ×φ× of the rotation group.
    """
    near = square < 1
    s = jnp.where(near, square, 1)
    series = jnp.zeros_like(s)
    for k in range(len(BERNOULLI), 0, -1):
        series = series * s + BERNOULLI[k - 1] / math.factorial(2 * k)
    far = jnp.where(near, 1, square)
    cos, sinc = cos_sinc(far / 4)
    return jnp.where(near, series, (1 - safe_divide(cos, sinc)) / far)


def all_finite(tree: PyTree) -> Array:
    """Returns True where every number of a tree is finite, ()."""
    good = jnp.ones((), bool)
    for x in jax.tree.leaves(tree):
        good &= jnp.all(jnp.isfinite(x))
    return good
