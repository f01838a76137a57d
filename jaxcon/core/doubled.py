"""Numbers as the sum of two floats, and functions evaluated in such numbers.

A float32 of 1e5 s is a multiple of 8 ms. A time as the sum of two floats has 48 bits instead of 24,
and so has the phase of a motion that is computed from it.

XLA does not reassociate sums, but a CPU may contract a product and a sum into one rounding. All
products here are therefore of halves, which are exact, so that a contraction changes nothing.

References:
    Dekker, A floating-point technique for extending the available precision,
    Numerische Mathematik 18 (1971).
    Knuth, The Art of Computer Programming, volume 2 (1997), section 4.2.2.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

TWO_PI = (6.283185307179586, 2.4492935982947064e-16, -5.989539619436679e-33)
"""2π as a sum of three floats of 64 bits."""


@pytree
class Doubled:
    """high + low, where high is the float nearest to the sum.

    Derivatives are those of exact arithmetic, and `high` carries them.

    Attributes:
        high: the rounded number, any shape.
        low: what it lacks, of the same shape.
    """

    high: Array
    low: Array

    @classmethod
    def of(cls, x: Any) -> Doubled:
        """The number itself, or a float without a remainder."""
        return x if isinstance(x, Doubled) else cls(x, jnp.zeros_like(x))

    def __add__(self, other: Any) -> Doubled:
        """x + y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        s, rest = _two_sum(x.high, y.high)
        return _carrying(s, rest + (x.low + y.low), self.value + other.value)

    def __neg__(self) -> Doubled:
        """−x."""
        return Doubled(-self.high, -self.low)

    def __sub__(self, other: Any) -> Doubled:
        """x − y."""
        return self + -Doubled.of(other)

    def __mul__(self, other: Any) -> Doubled:
        """x y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        p, rest = _two_product(x.high, y.high)
        rest = rest + (x.high * y.low + x.low * y.high)
        return _carrying(p, rest, self.value * other.value)

    def __rmul__(self, other: Any) -> Doubled:
        """y x."""
        return self * jnp.asarray(other, self.high.dtype)

    def __truediv__(self, other: Any) -> Doubled:
        """x / y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        first = x.high / y.high
        second = (x - y * first).high / y.high
        return _carrying(first, second, self.value / other.value)

    @property
    def value(self) -> Array:
        """`high`, with the derivative by both parts."""
        return self.high + self.low

    @property
    def turns(self) -> Array:
        """The whole turns that `reduced` leaves out."""
        return jnp.round(jax.lax.stop_gradient(self.high) / TWO_PI[0])

    def reduced(self) -> Doubled:
        """The number less whole turns, within half a turn of zero; its derivative is 1."""
        x, turns = jax.lax.stop_gradient(self), self.turns
        for part in two_pi(x.high.dtype):
            x = x - Doubled(*_two_product(turns, jnp.full_like(turns, part)))
        return Doubled(_carry(x.high, self.value), x.low)


def rounded(x: Any) -> Any:
    """The float nearest to a number that may have a remainder."""
    return x.high if isinstance(x, Doubled) else x


@functools.cache
def two_pi(dtype: Any) -> tuple[float, ...]:
    """2π as a sum of three floats of a dtype."""
    left, parts = sum(map(Fraction, TWO_PI)), []
    for _ in range(3):
        parts.append(float(np.asarray(float(left), dtype)))
        left -= Fraction(parts[-1])
    return tuple(parts)


@jax.custom_jvp
def _carry(x: Array, like: Array) -> Array:
    """x, with the derivative of `like`."""
    return x


@_carry.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return _carry(*primals), tangents[1]


def _carrying(large: Array, small: Array, like: Array) -> Doubled:
    """The sum of a number and a small one (Dekker), with the derivative of a plain sum."""
    high = large + small
    return Doubled(_carry(high, like), small - (high - large))


def _two_sum(x: Array, y: Array) -> tuple[Array, Array]:
    """x + y rounded, and what rounding took (Knuth)."""
    s = x + y
    other = s - x
    return s, (x - (s - other)) + (y - other)


def _halves(x: Array) -> tuple[Array, Array]:
    """x as a sum of two floats of half the bits: their products are exact.

    The upper half is cut from the bits. The usual C x − (C x − x) fails where the product and the
    difference are contracted.
    """
    bits = {32: (jnp.int32, -1 << 12), 64: (jnp.int64, -1 << 27)}
    integer, mask = bits[jnp.finfo(x.dtype).bits]
    cut = jax.lax.bitcast_convert_type(x, integer) & jnp.asarray(mask, integer)
    upper = jax.lax.bitcast_convert_type(cut, x.dtype)
    return upper, x - upper


def _two_product(x: Array, y: Array) -> tuple[Array, Array]:
    """x y, rounded to its last bit but one, and what rounding took."""
    (a, b), (c, d) = _halves(x), _halves(y)
    middle, rest = _two_sum(a * d, b * c)
    p, more = _two_sum(a * c, middle)
    return p, more + (rest + b * d)


def evaluate(function: Callable[..., Array], x: Doubled, *args: Any) -> Doubled:
    """function(x, *args), computed in sums of two floats where it adds and multiplies.

    Sines and cosines get their argument within half a turn of zero. Every other operation f is
    linearized, f(high) + f′(high) low; conditions see the rounded number. Where two floats
    overflow, which is before one does, the result is that of the rounded number.

    Args:
        function: pure; returns an array.
        x: its first argument.
        args: pytrees of arrays.
    """
    closed, leaves = jax.make_jaxpr(function)(x.high, *args), jax.tree.leaves(args)
    (result,) = map(Doubled.of, _run(closed.jaxpr, closed.consts, [x, *leaves]))
    (plain,) = jaxpr_as_fun(closed)(x.high, *leaves)
    finite = jnp.isfinite(result.high) & jnp.isfinite(result.low)
    return Doubled(jnp.where(finite, result.high, plain), jnp.where(finite, result.low, 0))


def _run(jaxpr: Any, consts: Any, inputs: Any) -> list[Any]:
    """The results of a jaxpr, of which some inputs have remainders."""
    known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *inputs), strict=True))

    def read(x: Any) -> Any:
        return x.val if isinstance(x, Literal) else known[x]

    for equation in jaxpr.eqns:
        results = _apply(jaxpr, equation, [read(x) for x in equation.invars])
        known.update(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _apply(jaxpr: Any, equation: Any, inputs: list[Any]) -> list[Any]:
    """The results of one equation of a jaxpr."""
    name = equation.primitive.name
    if not any(isinstance(x, Doubled) for x in inputs):
        return _bound(jaxpr, equation, inputs)
    if name == "jit":  # of jnp's own functions, such as where
        inner = equation.params["jaxpr"]
        return _run(inner.jaxpr, inner.consts, inputs)
    if name in RULES:
        wide = [x if isinstance(x, Doubled) else Doubled.of(jnp.asarray(x)) for x in inputs]
        return [RULES[name](*wide)]
    if name == "integer_pow":
        return [_power(inputs[0], equation.params["y"])]
    if name in ("sin", "cos", "tan"):
        inputs = [inputs[0].reduced()]
    return _linearized(jaxpr, equation, inputs)


def _bound(jaxpr: Any, equation: Any, inputs: list[Any]) -> list[Any]:
    """The results of an equation for inputs without remainders, by a jaxpr of it alone."""
    pairs = zip(equation.invars, inputs, strict=True)
    given = {x: value for x, value in pairs if not isinstance(x, Literal)}
    outputs, effects = list(equation.outvars), equation.effects
    alone = jaxpr.replace(
        constvars=[], invars=[*given], outvars=outputs, eqns=[equation], effects=effects
    )
    return jaxpr_as_fun(ClosedJaxpr(alone, ()))(*given.values())


def _linearized(jaxpr: Any, equation: Any, inputs: list[Any]) -> list[Any]:
    """f(high) + f′(high) low."""
    where = [i for i, x in enumerate(inputs) if isinstance(x, Doubled)]

    def function(*highs: Array) -> list[Any]:
        given = dict(zip(where, highs, strict=True))
        return _bound(jaxpr, equation, [given.get(i, x) for i, x in enumerate(inputs)])

    parts = [inputs[i] for i in where]
    values, changes = jax.jvp(function, [x.high for x in parts], [x.low for x in parts])
    return [
        _summed(y, low) if jnp.issubdtype(y.dtype, jnp.floating) else y
        for y, low in zip(values, changes, strict=True)
    ]


def _summed(y: Array, low: Array) -> Doubled:
    """The sum of a number and a small one."""
    return _carrying(*jax.lax.stop_gradient((y, low)), y + low)


def _power(x: Doubled, exponent: int) -> Doubled:
    """xⁿ by repeated squares."""
    if exponent < 0:
        return Doubled.of(jnp.ones_like(x.high)) / _power(x, -exponent)
    result = Doubled.of(jnp.ones_like(x.high))
    for bit in bin(exponent)[2:]:
        result = result * result
        result = result * x if bit == "1" else result
    return result


RULES: dict[str, Callable[..., Doubled]] = {
    "add": Doubled.__add__,
    "add_any": Doubled.__add__,
    "sub": Doubled.__sub__,
    "mul": Doubled.__mul__,
    "div": Doubled.__truediv__,
    "neg": Doubled.__neg__,
    "square": lambda x: x * x,
}
"""The primitives that are computed in sums of two floats."""
