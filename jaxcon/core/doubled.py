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
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxcon.core.jaxprs import called
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


@dataclass(frozen=True)
class Tangent:
    """A float on which results depend linearly, so that its products need no remainder.

    Attributes:
        high: the number, any shape.
    """

    high: Array


def rounded(x: Any) -> Any:
    """The float nearest to a number that may have a remainder."""
    return x.high if isinstance(x, Doubled | Tangent) else x


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

    That holds within branches, loops and called functions, too, and for complex numbers. Sines,
    cosines and complex exponentials get their argument within half a turn of zero. Remainders, and
    the whole numbers of floor, ceil and round, are those of the sum. Every other operation f is
    linearized, f(high) + f′(high) low; conditions see the rounded number. Where two floats
    overflow, which is before one does, the result is that of the rounded number.

    Args:
        function: pure; returns an array.
        x: its first argument.
        args: pytrees of arrays.
    """
    closed, leaves = jax.make_jaxpr(function)(x.high, *args), jax.tree.leaves(args)
    (result,) = map(Doubled.of, Evaluation().run(closed.jaxpr, closed.consts, [x, *leaves]))
    (plain,) = jaxpr_as_fun(closed)(x.high, *leaves)
    finite = jnp.isfinite(result.high) & jnp.isfinite(result.low)
    return Doubled(jnp.where(finite, result.high, plain), jnp.where(finite, result.low, 0))


def rounding_operations(function: Callable[..., Array], x: Doubled, *args: Any) -> list[str]:
    """The names of the operations on x in which `evaluate` sees the rounded number alone.

    Args:
        function: pure; returns an array.
        x: its first argument.
        args: pytrees of arrays.
    """
    evaluation = Evaluation()

    def run(x: Doubled, leaves: Any) -> list[Any]:
        return evaluation.run(closed.jaxpr, closed.consts, [x, *leaves])

    closed = jax.make_jaxpr(function)(x.high, *args)
    jax.eval_shape(run, x, jax.tree.leaves(args))
    return sorted(evaluation.rounding)


class Evaluation:
    """The evaluation of a jaxpr in sums of two floats.

    Attributes:
        rounding: names of the operations that were linearized as a whole, though sums and products
            within them may be large.
    """

    def __init__(self) -> None:
        """Has met no operation yet."""
        self.rounding: set[str] = set()

    def run(self, jaxpr: Any, consts: Any, inputs: Any) -> list[Any]:
        """The results of a jaxpr, of which some inputs have remainders."""
        known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *inputs), strict=True))

        def read(x: Any) -> Any:
            return x.val if isinstance(x, Literal) else known[x]

        for equation in jaxpr.eqns:
            results = self._apply(jaxpr, equation, [read(x) for x in equation.invars])
            known.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _apply(self, jaxpr: Any, equation: Any, inputs: list[Any]) -> list[Any]:
        """The results of one equation of a jaxpr."""
        name, params = equation.primitive.name, equation.params
        if not any(isinstance(x, Doubled | Tangent) for x in inputs):
            return _bound(jaxpr, equation, inputs)
        linear = any(isinstance(x, Tangent) for x in inputs)
        if name in FLOW and not linear:
            return FLOW[name](self, params, inputs)
        if name == "custom_jvp_call" and not linear:
            return self._with_own_derivative(jaxpr, equation, inputs)
        if name != "custom_vjp_call" and (inner := called(equation)) is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
        if linear:
            return list(map(Tangent, _bound(jaxpr, equation, list(map(rounded, inputs)))))
        if name in RULES:
            return [RULES[name](*map(_doubled, inputs))]
        if name == "round":
            return [_rounded_to_whole(inputs[0], params["rounding_method"])]
        if name == "integer_pow":
            return [_power(inputs[0], params["y"])]
        if name == "reduce_sum":
            return [_sum(inputs[0], params["axes"])]
        if name == "dot_general":
            return [_dot(*map(_doubled, inputs), *params["dimension_numbers"])]
        if name in ("sin", "cos", "tan"):
            inputs = [inputs[0].reduced()]
        if name == "exp" and _is_complex(inputs[0]):
            size, phase = _parts(inputs[0])
            inputs = [_joined(size, phase.reduced())]
        if name in ROUNDING or any(map(_is_jaxpr, jax.tree.leaves(params, is_leaf=_is_jaxpr))):
            self.rounding.add(name)
        return _linearized(jaxpr, equation, inputs)

    def _closed(self, closed: Any, inputs: Any) -> list[Any]:
        """The results of a closed jaxpr, all but integers and truth values with remainders."""
        return list(map(_doubled, self.run(closed.jaxpr, closed.consts, inputs)))

    def _cond(self, params: Any, inputs: list[Any]) -> list[Any]:
        """`lax.cond` and `lax.switch`, by the index of the rounded number."""
        branches = [functools.partial(self._closed, branch) for branch in params["branches"]]
        return jax.lax.switch(inputs[0], branches, inputs[1:])

    def _scan(self, params: Any, inputs: list[Any]) -> list[Any]:
        """`lax.scan`, and `lax.fori_loop` between known bounds."""
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]

        def body(carry: list[Any], x: list[Any]) -> tuple[list[Any], list[Any]]:
            results = self._closed(params["jaxpr"], [*inputs[:first], *carry, *x])
            return results[: last - first], results[last - first :]

        start = list(map(_doubled, inputs[first:last]))
        options = {key: params[key] for key in ("length", "reverse", "unroll")}
        carry, stacked = jax.lax.scan(body, start, inputs[last:], **options)
        return [*carry, *stacked]

    def _while(self, params: Any, inputs: list[Any]) -> list[Any]:
        """`lax.while_loop`, by the condition of the rounded number."""
        first, last = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]

        def goes_on(carry: list[Any]) -> Any:
            return self._closed(params["cond_jaxpr"], [*inputs[:first], *carry])[0]

        def body(carry: list[Any]) -> list[Any]:
            return self._closed(params["body_jaxpr"], [*inputs[first:last], *carry])

        return jax.lax.while_loop(goes_on, body, list(map(_doubled, inputs[last:])))

    def _with_own_derivative(self, jaxpr: Any, equation: Any, inputs: list[Any]) -> list[Any]:
        """A `jax.custom_jvp` function, whose rule is evaluated in sums of two floats, too."""
        inner = equation.params["call_jaxpr"]

        @jax.custom_jvp
        def function(inputs: list[Any]) -> list[Any]:
            return self._closed(inner, inputs)

        @function.defjvp
        def _(primals: Any, tangents: Any) -> Any:
            (inputs,), (moved,) = primals, tangents
            values = [rounded(x) for x in inputs]
            slopes = [x.value if isinstance(x, Doubled) else x for x in moved]
            free = [i for i, x in enumerate(slopes) if x.dtype != jax.dtypes.float0]

            def slope(values: list[Any], slopes: list[Any]) -> Any:
                def bound(*some: Any) -> list[Any]:
                    given = dict(zip(free, some, strict=True))
                    return _bound(jaxpr, equation, [given.get(i, x) for i, x in enumerate(values)])

                return jax.jvp(bound, [values[i] for i in free], slopes)[1]

            rule = jax.make_jaxpr(slope)(values, [slopes[i] for i in free])
            moving = [Tangent(slopes[i]) for i in free]
            changes = self.run(rule.jaxpr, rule.consts, [*inputs, *moving])
            results = function(inputs)
            return results, [_tangent(x, dx) for x, dx in zip(results, changes, strict=True)]

        return function(inputs)


FLOW: dict[str, Callable[[Evaluation, Any, list[Any]], list[Any]]] = {
    "cond": Evaluation._cond,
    "scan": Evaluation._scan,
    "while": Evaluation._while,
}
"""Branches and loops."""

ROUNDING = frozenset({"cumsum", "cumprod", "reduce_prod", "conv_general_dilated", "fft"})
"""Primitives that add and multiply, and yet are linearized as a whole."""


def _is_jaxpr(x: Any) -> bool:
    """Returns True for a parameter of an equation that is a function."""
    return hasattr(x, "eqns") or hasattr(x, "jaxpr")


def _is_complex(x: Any) -> bool:
    """Returns True for complex numbers."""
    return jnp.issubdtype(rounded(x).dtype, jnp.complexfloating)


def _doubled(x: Any) -> Any:
    """A number with a remainder; an integer or truth value as it is."""
    if isinstance(x, Doubled):
        return x
    x = jnp.asarray(x)
    return Doubled.of(x) if jnp.issubdtype(x.dtype, jnp.inexact) else x


def _tangent(x: Any, change: Any) -> Any:
    """The tangent of a result, of which `high` carries the derivative."""
    if not isinstance(x, Doubled):
        return np.zeros(jnp.shape(x), jax.dtypes.float0)
    change = rounded(change)
    return Doubled(change, jnp.zeros_like(change))


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
        _summed(y, low) if jnp.issubdtype(y.dtype, jnp.inexact) else y
        for y, low in zip(values, changes, strict=True)
    ]


def _summed(y: Array, low: Array) -> Doubled:
    """The sum of a number and a small one."""
    return _carrying(*jax.lax.stop_gradient((y, low)), y + low)


def _sum(x: Doubled, axes: Any) -> Doubled:
    """The sum over axes, by halves."""
    for axis in sorted(axes, reverse=True):
        x = jax.tree.map(lambda part, axis=axis: jnp.moveaxis(part, axis, 0), x)
        while x.high.shape[0] > 1:
            x = jax.tree.map(_even, x)
            first, second = (jax.tree.map(lambda part, i=i: part[i::2], x) for i in (0, 1))
            x = first + second
        x = jax.tree.map(lambda part: jnp.sum(part, axis=0), x)
    return x


def _even(x: Array) -> Array:
    """The rows of an array, and one of zeros where their number is odd."""
    return jnp.concatenate([x, jnp.zeros_like(x[: x.shape[0] % 2])])


def _dot(x: Doubled, y: Doubled, contracted: Any, batched: Any) -> Doubled:
    """`lax.dot_general`: the products, and their sum."""
    batch, last = len(batched[0]), len(contracted[0])
    free = [z.high.ndim - batch - last for z in (x, y)]
    missing = [batch + free[0] + i for i in range(free[1])], [batch + i for i in range(free[0])]

    def arranged(side: int, part: Array) -> Array:
        """(batch, free of x, free of y, contracted)."""
        fixed = (*batched[side], *contracted[side])
        own = [i for i in range(part.ndim) if i not in fixed]
        return jnp.expand_dims(
            jnp.transpose(part, (*batched[side], *own, *contracted[side])), missing[side]
        )

    x, y = (jax.tree.map(functools.partial(arranged, side), z) for side, z in enumerate((x, y)))
    first = batch + sum(free)
    return _sum(x * y, range(first, first + last))


def _parts(x: Doubled) -> tuple[Doubled, Doubled]:
    """The real and the imaginary part."""
    return jax.tree.map(jnp.real, x), jax.tree.map(jnp.imag, x)


def _joined(real: Doubled, imaginary: Doubled) -> Doubled:
    """The complex number of two parts."""
    return jax.tree.map(jax.lax.complex, real, imaginary)


def _product(x: Doubled, y: Doubled) -> Doubled:
    """x y, of complex numbers by their parts."""
    if not _is_complex(x):
        return x * y
    (a, b), (c, d) = _parts(x), _parts(y)
    return _joined(a * c - b * d, a * d + b * c)


def _quotient(x: Doubled, y: Doubled) -> Doubled:
    """x / y, of complex numbers by their parts."""
    if not _is_complex(x):
        return x / y
    a, b = _parts(y)
    above, below = _product(x, _joined(a, -b)), a * a + b * b
    return _joined(*(part / below for part in _parts(above)))


def _power(x: Doubled, exponent: int) -> Doubled:
    """xⁿ by repeated squares."""
    if exponent < 0:
        return _quotient(Doubled.of(jnp.ones_like(x.high)), _power(x, -exponent))
    result = Doubled.of(jnp.ones_like(x.high))
    for bit in bin(exponent)[2:]:
        result = _product(result, result)
        result = _product(result, x) if bit == "1" else result
    return result


def _remainder(x: Doubled, y: Doubled) -> Doubled:
    """`jax.lax.rem`: x less whole multiples of y, of the sign of x and smaller than y."""
    derivative = jax.lax.rem(x.value, y.value)
    x, y = jax.lax.stop_gradient((x, y))
    rest = jax.lax.rem(x.high, y.high)
    multiple = jnp.round((x.high - rest) / y.high)
    size = Doubled.of(rest) + jax.lax.rem(x.low, y.high) - multiple * y.low
    # |x| less multiples of |y| lies between −|y| and 2|y|
    side, period = jnp.where(x.high < 0, -1, 1).astype(rest.dtype), y * jnp.sign(y.high)
    size = size * side
    size = _select((size - period).high >= 0, size - period, size)
    size = _select(size.high < 0, size + period, size) * side
    return Doubled(_carry(size.high, derivative), size.low)


def _select(where: Array, x: Doubled, y: Doubled) -> Doubled:
    """x where a mask is True, and y elsewhere."""
    return jax.tree.map(functools.partial(jnp.where, where), x, y)


def _floor(x: Doubled) -> Doubled:
    """The largest whole number that is not above x."""
    x = jax.lax.stop_gradient(x)
    whole = jnp.floor(x.high)
    # |low| is at most half a spacing of `high`: it decides only where `high` is whole
    return _carrying(whole, jnp.where(whole == x.high, jnp.floor(x.low), 0), whole)


def _rounded_to_whole(x: Doubled, ties: Any) -> Doubled:
    """The whole number nearest to x; `ties` decide where two are."""
    x = jax.lax.stop_gradient(x)
    whole, below = jax.lax.round(x.high, ties), jnp.floor(x.high)
    halfway = (x.high - below == 0.5) & (x.low != 0)
    whole = jnp.where(halfway, jnp.where(x.low > 0, below + 1, below), whole)
    return _carrying(whole, jnp.where(whole == x.high, jax.lax.round(x.low, ties), 0), whole)


RULES: dict[str, Callable[..., Doubled]] = {
    "add": Doubled.__add__,
    "add_any": Doubled.__add__,
    "sub": Doubled.__sub__,
    "mul": _product,
    "div": _quotient,
    "neg": Doubled.__neg__,
    "square": lambda x: _product(x, x),
    "rem": _remainder,
    "floor": _floor,
    "ceil": lambda x: -_floor(-x),
}
"""The primitives that are computed in sums of two floats."""
