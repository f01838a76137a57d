"""Elementary functions by the instructions of one thread, which has none that are accurate.

Numbers are reduced to a small range in 64 bits, where a power series is short. The errors are a few
roundings: within 3e-7 of the result or of 1, whichever is larger, in float32, and 1e-15 in float64.
For angles, the error grows beyond 1e9 rad, and sine and cosine are NaN beyond 3e15 rad.

Reference: Muller, Elementary Functions (2016), chapters 11 and 12.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from jaxcon.staging.thread import Scalar, Thread, UnsupportedError

HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
"""Three numbers whose sum is π/2. The first two have 33 bits: products with integers are exact."""

LOG_2 = (0.6931471804855391, 7.440617110012397e-11)
"""Two numbers whose sum is the logarithm of 2; the first has 33 bits."""

SHIFT = np.float64(1.5 * 2.0**52)
"""A number whose sum with an integer of less than 2⁵¹ has no bits for a fraction."""

LARGEST_ANGLE = 3e15
"""The largest angle whose sine and cosine are numbers [rad]."""

TERMS = {"float32": 5, "float64": 9}
"""The number of terms of the series of sine and cosine, for angles up to π/4."""


def _series(thread: Thread, x: Scalar, coefficients: Sequence[float]) -> Scalar:
    """Returns c₀ + c₁ x + c₂ x² + …, by Horner's rule."""
    *others, total = [x.dtype.type(c) for c in coefficients]
    result: Scalar = total
    for c in reversed(others):
        result = thread.fma(result, x, c)
    return result


def _quarter_turns(thread: Thread, x: Scalar) -> tuple[Scalar, Scalar]:
    """Returns an angle less the nearest multiple of π/2, and the number of quarter turns."""
    wide = thread.convert(x, np.float64)
    turns, bits = _nearest(thread, wide, np.float64(2 / math.pi))
    back = thread.apply("neg", turns)
    rest: Scalar = wide
    for part in HALF_PI:
        rest = thread.fma(back, np.float64(part), rest)
    small = thread.apply("lt", thread.apply("abs", wide), np.float64(LARGEST_ANGLE))
    rest = thread.select(small, rest, np.float64(np.nan))
    return thread.convert(rest, x.dtype), bits


def _nearest(thread: Thread, x: Scalar, by: np.float64) -> tuple[Scalar, Scalar]:
    """Returns the integer next to a product of less than 2⁵¹, as a float and as an integer.

    The sum with `SHIFT` has no bits for a fraction, and ends with the bits of the integer.
    """
    shifted = thread.fma(x, by, SHIFT)
    bits = thread.apply("sub", thread.bits(shifted, np.int64), SHIFT.view(np.int64))
    return thread.apply("sub", shifted, SHIFT), bits


def _sine_of(thread: Thread, x: Scalar, shift: int) -> Scalar:
    """Returns sin(x + shift π/2)."""
    if x.dtype.name not in TERMS:
        raise UnsupportedError(f"a sine of {x.dtype.name}")
    rest, turns = _quarter_turns(thread, x)
    square = thread.apply("mul", rest, rest)
    count = TERMS[x.dtype.name]
    odd = [(-1) ** k / math.factorial(2 * k + 1) for k in range(1, count)]
    even = [(-1) ** k / math.factorial(2 * k) for k in range(1, count + 1)]
    # the first terms are added last, so that they are rounded only once
    sine = thread.fma(thread.apply("mul", rest, square), _series(thread, square, odd), rest)
    cosine = thread.fma(square, _series(thread, square, even), x.dtype.type(1))
    quarter = thread.apply("add", turns, np.int64(shift))
    swapped = _bit(thread, quarter, 1)
    value = thread.select(swapped, cosine, sine)
    return thread.select(_bit(thread, quarter, 2), thread.apply("neg", value), value)


def _odd(thread: Thread, x: Scalar, value: Scalar) -> Scalar:
    """Returns the value of an odd function at x, which keeps the sign of 0."""
    return thread.select(thread.apply("eq", x, x.dtype.type(0)), x, value)


def _bit(thread: Thread, x: Scalar, bit: int) -> Scalar:
    """Returns True if a bit of an integer is set."""
    return thread.apply("ne", thread.apply("and", x, np.int64(bit)), np.int64(0))


def _tan(thread: Thread, x: Scalar) -> Scalar:
    return thread.apply("div", _sine_of(thread, x, 0), _sine_of(thread, x, 1))


def _atan2(thread: Thread, y: Scalar, x: Scalar) -> Scalar:
    """Returns the angle of the point (x, y)."""
    double, dtype = np.float64, y.dtype
    wide_y, wide_x = thread.convert(y, double), thread.convert(x, double)
    a, b = thread.apply("abs", wide_y), thread.apply("abs", wide_x)
    high, low = thread.apply("max", a, b), thread.apply("min", a, b)
    both = thread.apply("eq", a, b)  # 0/0 and ∞/∞
    zero = thread.apply("eq", high, double(0))
    ratio = thread.select(both, double(1), thread.apply("div", low, high))
    ratio = thread.select(zero, double(0), ratio)
    angle = _atan_within(thread, ratio)
    steep = thread.apply("gt", a, b)
    angle = thread.select(steep, thread.apply("sub", double(math.pi / 2), angle), angle)
    # the sign bit, since x may be −0
    left = thread.apply("lt", thread.bits(wide_x, np.int64), np.int64(0))
    angle = thread.select(left, thread.apply("sub", double(math.pi), angle), angle)
    angle = thread.emit("copysign", double, angle, wide_y)
    nan = thread.emit("unordered", bool, wide_x, wide_y)
    return thread.convert(thread.select(nan, double(np.nan), angle), dtype)


def _atan_within(thread: Thread, x: Scalar) -> Scalar:
    """Returns atan(x) in float64, for 0 ≤ x ≤ 1.

    With c the nearest of 0, 1/4, 1/2, 3/4 and 1, it is atan(c) + atan(t), t = (x − c) / (1 + c x).
    """
    double = np.float64
    quarters = thread.emit("round", double, thread.apply("mul", x, double(4)))
    c = thread.apply("mul", quarters, double(0.25))
    start: Scalar = double(0)
    for k in range(1, 5):
        at = thread.apply("eq", quarters, double(k))
        start = thread.select(at, double(math.atan(k / 4)), start)
    below = thread.fma(c, x, double(1))
    t = thread.apply("div", thread.apply("sub", x, c), below)
    square = thread.apply("mul", t, t)
    series = _series(thread, square, [(-1) ** k / (2 * k + 1) for k in range(1, 10)])
    near = thread.fma(thread.apply("mul", t, square), series, t)
    return thread.apply("add", start, near)


def _atan(thread: Thread, x: Scalar) -> Scalar:
    return _atan2(thread, x, x.dtype.type(1))


def _other_leg(thread: Thread, x: Scalar) -> Scalar:
    """Returns √(1 − x²)."""
    one = x.dtype.type(1)
    product = thread.apply("mul", thread.apply("sub", one, x), thread.apply("add", one, x))
    return thread.apply("sqrt", product)


def _asin(thread: Thread, x: Scalar) -> Scalar:
    return _atan2(thread, x, _other_leg(thread, x))


def _acos(thread: Thread, x: Scalar) -> Scalar:
    return _atan2(thread, _other_leg(thread, x), x)


def _exp(thread: Thread, x: Scalar) -> Scalar:
    """Returns eˣ = 2ⁿ eʳ, with r = x − n log 2."""
    double = np.float64
    wide = thread.convert(x, double)
    wide = thread.apply("clamp", double(-800), wide, double(800))
    n, power = _nearest(thread, wide, double(1 / math.log(2)))
    back = thread.apply("neg", n)
    rest = thread.fma(back, double(LOG_2[1]), thread.fma(back, double(LOG_2[0]), wide))
    value = _series(thread, rest, [1 / math.factorial(k) for k in range(14)])
    # 2ⁿ as the product of two powers: it may be too large or too small for one number
    half = thread.apply("shift_right_arithmetic", power, np.int64(1))
    for part in (half, thread.apply("sub", power, half)):
        value = thread.apply("mul", value, _two_to(thread, part))
    return thread.select(thread.apply("ne", x, x), x, thread.convert(value, x.dtype))


def _two_to(thread: Thread, n: Scalar) -> Scalar:
    """Returns 2ⁿ for an integer n from −1022 to 1023, by its bits."""
    raised = thread.apply("add", n, np.int64(1023))
    return thread.bits(thread.apply("shift_left", raised, np.int64(52)), np.float64)


def _log(thread: Thread, x: Scalar) -> Scalar:
    """Returns log x = n log 2 + 2 atanh((m − 1) / (m + 1)), with x = 2ⁿ m."""
    double = np.float64
    wide = thread.convert(x, double)
    tiny = thread.apply("lt", wide, double(2.0**-1022))  # without a leading 1 in its bits
    scaled = thread.select(tiny, thread.apply("mul", wide, double(2.0**54)), wide)
    bits = thread.bits(scaled, np.int64)
    # the exponent of the number next below √2, so that m lies between 1/√2 and √2
    shifted = thread.apply("sub", bits, np.int64(np.float64(math.sqrt(0.5)).view(np.int64)))
    n = thread.apply("shift_right_arithmetic", shifted, np.int64(52))
    mantissa = thread.apply("sub", bits, thread.apply("shift_left", n, np.int64(52)))
    m = thread.bits(mantissa, double)
    s = thread.apply("div", thread.apply("sub", m, double(1)), thread.apply("add", m, double(1)))
    square = thread.apply("mul", s, s)
    series = _series(thread, square, [2 / (2 * k + 1) for k in range(1, 12)])
    near = thread.fma(thread.apply("mul", s, square), series, thread.apply("mul", double(2), s))
    whole = thread.convert(n, double)
    whole = thread.select(tiny, thread.apply("sub", whole, double(54)), whole)
    value = thread.fma(whole, double(LOG_2[0]), thread.fma(whole, double(LOG_2[1]), near))
    zero = thread.apply("eq", wide, double(0))
    value = thread.select(zero, double(-np.inf), value)
    infinite = thread.apply("eq", wide, double(np.inf))
    value = thread.select(infinite, double(np.inf), value)
    valid = thread.apply("ge", wide, double(0))
    return thread.convert(thread.select(valid, value, double(np.nan)), x.dtype)


def rounded(thread: Thread, x: Scalar, to_even: bool) -> Scalar:
    """Returns the nearest integer; of two, the even one, or that farther from 0."""
    if to_even:
        return thread.emit("round", x.dtype, x)
    down = thread.emit("truncate", x.dtype, x)
    rest = thread.apply("abs", thread.apply("sub", x, down))
    one = thread.emit("copysign", x.dtype, x.dtype.type(1), x)
    farther = thread.apply("ge", rest, x.dtype.type(0.5))
    return thread.select(farther, thread.apply("add", down, one), down)


def _of_float32(function: Callable[..., Scalar]) -> Callable[..., Scalar]:
    """Permits only float32, for functions that lose bits in 64-bit arithmetic."""

    def write(thread: Thread, *operands: Scalar) -> Scalar:
        if operands[0].dtype != np.float32:
            raise UnsupportedError(f"{function.__name__.strip('_')} of {operands[0].dtype.name}")
        wide = [thread.convert(x, np.float64) for x in operands]
        return thread.convert(function(thread, *wide), np.float32)

    return write


def _tanh(thread: Thread, x: Scalar) -> Scalar:
    """Returns tanh x = sign(x) (1 − 2 / (e^{2|x|} + 1)); a series near 0."""
    double = np.float64
    size = thread.apply("abs", x)
    grown = _exp(thread, thread.apply("mul", double(2), size))
    far = thread.apply("div", double(2), thread.apply("add", grown, double(1)))
    far = thread.apply("sub", double(1), far)
    square = thread.apply("mul", x, x)
    series = _series(thread, square, [1.0, -1 / 3, 2 / 15, -17 / 315, 62 / 2835])
    near = thread.apply("mul", size, series)
    small = thread.apply("lt", size, double(0.1))
    value = thread.select(small, near, far)
    return thread.emit("copysign", double, value, x)


def _logistic(thread: Thread, x: Scalar) -> Scalar:
    double = np.float64
    below = thread.apply("add", double(1), _exp(thread, thread.apply("neg", x)))
    return thread.apply("div", double(1), below)


FUNCTIONS: dict[str, Callable[..., Scalar]] = {
    "sin": lambda thread, x: _odd(thread, x, _sine_of(thread, x, 0)),
    "cos": lambda thread, x: _sine_of(thread, x, 1),
    "tan": lambda thread, x: _odd(thread, x, _tan(thread, x)),
    "atan": _atan,
    "atan2": _atan2,
    "asin": _asin,
    "acos": _acos,
    "exp": _exp,
    "log": _log,
    "tanh": _of_float32(_tanh),
    "logistic": _of_float32(_logistic),
}
"""The instructions of each elementary function: (thread, *operands) → result."""
