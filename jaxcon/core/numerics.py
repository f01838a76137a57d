"""Functions with finite values and gradients at singular points, such as √x at x = 0.

Each function replaces a singular input before the operation (the "double where"). A single `where`
after the operation would multiply an infinite derivative by zero in reverse mode, which gives NaN.
"""

import math

import jax
import jax.numpy as jnp

from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, Lane, PyTree


def safe_sqrt(x: Lane) -> Array:
    """Returns √x for x > 0, 0 with zero gradient for x ≤ 0, and NaN for NaN."""
    low = x <= 0
    return jnp.where(low, 0, jnp.sqrt(jnp.where(low, 1, x)))


def safe_divide(numerator: Lane, denominator: Lane) -> Array:
    """Returns numerator / denominator; 0 with zero gradient where the denominator is 0."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1), 0)


def finite_or_nan(x: Lane) -> Array:
    """Returns x for finite x, and NaN otherwise.

    NaN makes an error visible: a quotient such as 1/∞ = 0 or a comparison would hide infinity.
    """
    return jnp.where(jnp.isfinite(x), x, jnp.nan)


def norm(x: Vector | Array) -> Array:
    """Returns ‖x‖ over the first axis (or a Vector's components), with zero gradient at x = 0."""
    x = Vector.of(x)
    return safe_sqrt(x.dot(x))


def unit(x: Vector) -> Vector:
    """Returns the unit vector x / ‖x‖; 0 with zero gradient at x = 0."""
    return x * safe_divide(1.0, norm(x))


def safe_arctan2(y: Lane, x: Lane) -> Array:
    """Returns the polar angle of the point (x, y); 0 with zero gradient at the origin."""
    origin = (x == 0) & (y == 0)
    return jnp.arctan2(jnp.where(origin, 0, y), jnp.where(origin, 1, x))


def negligible(x: Array) -> Array:
    """Returns a tolerance for iterations on x, (n, …): ε^⅔ (1 + max |x|), one for each world.

    ε is the machine precision.
    """
    size = 1 + jnp.max(jnp.abs(x), axis=0, initial=0)
    return jax.lax.stop_gradient(float(jnp.finfo(x.dtype).eps) ** (2 / 3) * size)


def wrap(angle: Lane) -> Array:
    """Wraps an angle to [−π, π] by subtracting whole turns; its derivative is 1."""
    turn = 2 * jnp.pi
    return angle - turn * jnp.round(angle / turn)


TERMS = {32: 6, 64: 11}
"""The number of terms after the first in the power series of cos r and sin r / r in r².

The keys are the sizes of a float in bits. The first omitted term is below half a unit in the last
place for r up to π/2.
"""


def cos_sinc(square: Lane) -> tuple[Array, Array]:
    """Returns cos √s and sin √s / √s for s = `square`, smooth for all s ≥ 0.

    The argument is reduced by n half turns: r = √s − n π. Then cos √s = (−1)ⁿ cos r and
    sin √s = (−1)ⁿ sin r, and both are evaluated as power series in r². Near s = 0, r² is s itself,
    so no square root is differentiated there.
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
    """Evaluates a power series in s: cos √s for odd = 0, or sin √s / √s for odd = 1.

    Args:
        s: the square of the angle.
        odd: 0 or 1.
        terms: the number of terms after the first; None for full precision up to √s = π/2.
    """
    terms = TERMS[jnp.finfo(s.dtype).bits] if terms is None else terms
    total = jnp.full_like(s, (-1) ** terms / math.factorial(2 * terms + odd))
    for k in range(terms - 1, -1, -1):
        total = total * s + (-1) ** k / math.factorial(2 * k + odd)
    return total


BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798)
"""The Bernoulli numbers |B₂|, |B₄|, … of the series (x/2) cot(x/2) = 1 − Σ |B₂ₙ| x²ⁿ / (2n)!.

The series is used for x < 1.
"""


def inverse_exponential(square: Lane) -> Array:
    """Returns c(s) = (1 − (√s/2) cot(√s/2)) / s, smooth for 0 ≤ s < (2π)², with c(0) = 1/12.

    c is a coefficient of the inverse derivative of the exponential map of rotation vectors φ:
    dexp⁻¹_φ = 1 − ½ φ× + c(φ·φ) φ×φ×.
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
    """Returns True if every number in a tree of arrays is finite, ()."""
    good = jnp.ones((), bool)
    for x in jax.tree.leaves(tree):
        good &= jnp.all(jnp.isfinite(x))
    return good
