"""Double-float arithmetic: a number is stored as the unevaluated sum of two floats.

Near 1e5 s, float32 resolves time only to 8 ms. A time stored as the sum of two float32 has 48 bits
instead of 24. The phase of a motion that is computed from this time has 48 bits, too.

XLA does not reassociate sums, but a CPU may contract a product and a sum into one rounding (FMA).
Products are therefore computed from factors that are split into halves of their bits. The products
of halves are exact, so contraction does not change them.

References:
    Dekker, A floating-point technique for extending the available precision,
    Numerische Mathematik 18 (1971).
    Knuth, The Art of Computer Programming, volume 2 (1997), section 4.2.2.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from jaxcon.core.closures import apply_equation
from jaxcon.core.jaxprs import called
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType, PyTree, Scalar

TWO_PI = (6.283185307179586, 2.4492935982947064e-16, -5.989539619436679e-33)
"""Three 64-bit floats whose sum is 2π."""


@pytree
class Doubled:
    """A double-float number high + low, where `high` is the float nearest to the sum.

    Derivatives are those of exact arithmetic. They are stored in the tangent of `high`.

    Attributes:
        high: the rounded number, any shape.
        low: the remainder, of the same shape.
    """

    high: Array
    low: Array

    @classmethod
    def of(cls, x: Doubled | Scalar) -> Doubled:
        """Converts a float to a `Doubled` with remainder zero; returns a `Doubled` unchanged."""
        return x if isinstance(x, Doubled) else cls(x, jnp.zeros_like(x))  # type: ignore[arg-type]

    def __add__(self, other: Doubled | Array) -> Doubled:
        """Returns x + y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        s, rest = _two_sum(x.high, y.high)
        return _carrying(s, rest + (x.low + y.low), self.value + other.value)

    def __neg__(self) -> Doubled:
        """Returns −x."""
        return Doubled(-self.high, -self.low)

    def __sub__(self, other: Doubled | Array) -> Doubled:
        """Returns x − y."""
        return self + -Doubled.of(other)

    def __mul__(self, other: Doubled | Array) -> Doubled:
        """Returns x y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        p, rest = _two_product(x.high, y.high)
        rest = rest + (x.high * y.low + x.low * y.high)
        return _carrying(p, rest, self.value * other.value)

    def __rmul__(self, other: Scalar) -> Doubled:
        """Returns y x."""
        return self * jnp.asarray(other, self.high.dtype)

    def __truediv__(self, other: Doubled | Array) -> Doubled:
        """Returns x / y."""
        other = Doubled.of(other)
        x, y = jax.lax.stop_gradient((self, other))
        first = x.high / y.high
        second = (x - y * first).high / y.high
        return _carrying(first, second, self.value / other.value)

    @property
    def value(self) -> Array:
        """The number as a float, high + low: equal to `high`, but with the tangents of both."""
        return self.high + self.low

    @property
    def turns(self) -> Array:
        """The number of whole turns (multiples of 2π) that `reduced` removes from an angle."""
        return jnp.round(jax.lax.stop_gradient(self.high) / TWO_PI[0])

    def reduced(self) -> Doubled:
        """Returns the angle minus whole turns, in [−π, π]; its derivative is 1."""
        x, turns = jax.lax.stop_gradient(self), self.turns
        for part in two_pi(x.high.dtype):
            x = x - Doubled(*_two_product(turns, jnp.full_like(turns, part)))
        return Doubled(_carry(x.high, self.value), x.low)


@dataclass(frozen=True)
class Tangent:
    """A tangent, as a plain float: derivatives need no double-float precision.

    Attributes:
        high: the tangent, any shape.
    """

    high: Array


Operand: TypeAlias = Doubled | Tangent | Scalar
"""An operand of a primitive: a float with or without a remainder, or a tangent."""


def rounded(x: Operand) -> Any:
    """Returns `high` of a `Doubled` or `Tangent`, and any other operand unchanged."""
    return x.high if isinstance(x, Doubled | Tangent) else x


@functools.cache
def two_pi(dtype: DType) -> tuple[float, ...]:
    """Returns three floats of a dtype whose sum is 2π."""
    left, parts = sum(map(Fraction, TWO_PI)), []
    for _ in range(3):
        parts.append(float(np.asarray(float(left), dtype)))
        left -= Fraction(parts[-1])
    return tuple(parts)


@jax.custom_jvp
def _carry(x: Array, like: Array) -> Array:
    """Returns x, with the derivative of `like` in place of the derivative of x."""
    return x


@_carry.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return _carry(*primals), tangents[1]


def _carrying(large: Array, small: Array, like: Array) -> Doubled:
    """Returns large + small without rounding (Dekker), with the derivative of `like`.

    Args:
        large: a float, at least as large as `small` in magnitude.
        small: a float.
        like: a float with the derivative of the sum.
    """
    high = large + small
    return Doubled(_carry(high, like), small - (high - large))


def _two_sum(x: Array, y: Array) -> tuple[Array, Array]:
    """Returns the rounded sum x + y and its exact rounding error (Knuth)."""
    s = x + y
    other = s - x
    return s, (x - (s - other)) + (y - other)


def _halves(x: Array) -> tuple[Array, Array]:
    """Splits x into a sum of two floats with half the bits each, so that their products are exact.

    The upper half is x with its lower bits masked. The usual formula C x − (C x − x) fails if a
    CPU contracts the product and the difference.
    """
    bits = {32: (jnp.int32, -1 << 12), 64: (jnp.int64, -1 << 27)}
    integer, mask = bits[jnp.finfo(x.dtype).bits]
    cut = jax.lax.bitcast_convert_type(x, integer) & jnp.asarray(mask, integer)
    upper = jax.lax.bitcast_convert_type(cut, x.dtype)
    return upper, x - upper


def _two_product(x: Array, y: Array) -> tuple[Array, Array]:
    """Returns the product x y, accurate to the last bit but one, and its rounding error."""
    (a, b), (c, d) = _halves(x), _halves(y)
    middle, rest = _two_sum(a * d, b * c)
    p, error = _two_sum(a * c, middle)
    return p, error + (rest + b * d)


def evaluate(function: Callable[..., Array], x: Doubled, *args: PyTree) -> Doubled:
    """Evaluates function(x, *args) with sums and products in double-float arithmetic.

    Branches, loops, called functions and complex numbers are supported. Arguments of sines, cosines
    and complex exponentials are first reduced to [−π, π]. `rem`, `floor`, `ceil` and `round` apply
    to the sum of both floats. Every other operation f is linearized: f(high) + f′(high) low.
    Conditions use the rounded number `high`. Double-float results can overflow earlier than floats;
    the result is then function(high, *args), in plain floats.

    Args:
        function: a pure function that returns an array.
        x: the first argument, in double-float precision.
        args: pytrees of arrays, the other arguments.
    """
    closed, leaves = jax.make_jaxpr(function)(x.high, *args), jax.tree.leaves(args)
    (result,) = map(Doubled.of, Evaluation().run(closed.jaxpr, closed.consts, [x, *leaves]))
    (plain,) = jaxpr_as_fun(closed)(x.high, *leaves)
    finite = jnp.isfinite(result.high) & jnp.isfinite(result.low)
    return Doubled(jnp.where(finite, result.high, plain), jnp.where(finite, result.low, 0))


def rounding_operations(function: Callable[..., Array], x: Doubled, *args: PyTree) -> list[str]:
    """Returns the names of primitives in a function for which `evaluate` loses precision.

    Primitives such as `cumsum` contain large sums or products. `evaluate` linearizes them as a
    whole, so the sums and products are rounded like plain floats.

    Args:
        function: a pure function that returns an array.
        x: the first argument, in double-float precision.
        args: pytrees of arrays, the other arguments.
    """
    evaluation, closed = Evaluation(), jax.make_jaxpr(function)(x.high, *args)
    jax.eval_shape(
        lambda x, *leaves: evaluation.run(closed.jaxpr, closed.consts, [x, *leaves]),
        x,
        *jax.tree.leaves(args),
    )
    return sorted(evaluation.rounding)


class Evaluation:
    """The evaluation of a jaxpr in double-float arithmetic.

    Attributes:
        rounding: the names of the evaluated primitives that were linearized as a whole, although
            they contain large sums or products.
    """

    def __init__(self) -> None:
        """Creates an evaluation in which no primitive has been evaluated."""
        self.rounding: set[str] = set()

    def run(self, jaxpr: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
        """Evaluates an open jaxpr; inputs and results are plain arrays or `Doubled`."""
        values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *inputs), strict=True))

        def read(x: Var | Literal) -> Any:
            return x.val if isinstance(x, Literal) else values[x]

        for equation in jaxpr.eqns:
            results = self._apply(jaxpr, equation, [read(x) for x in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _apply(self, jaxpr: Jaxpr, equation: JaxprEqn, inputs: list[Any]) -> list[Any]:
        """Evaluates one equation of a jaxpr; inputs are plain arrays, `Doubled` or `Tangent`."""
        name, params = equation.primitive.name, equation.params
        if not any(isinstance(x, Doubled | Tangent) for x in inputs):
            return apply_equation(jaxpr, equation, inputs)
        linear = any(isinstance(x, Tangent) for x in inputs)
        if name in FLOW and not linear:
            return FLOW[name](self, params, inputs)
        if name == "custom_jvp_call" and not linear:
            return self._with_own_derivative(jaxpr, equation, inputs)
        if name != "custom_vjp_call" and (inner := called(equation)) is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
        if linear:
            return list(map(Tangent, apply_equation(jaxpr, equation, list(map(rounded, inputs)))))
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

    def _closed(self, closed: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
        """Evaluates a closed jaxpr; results are `Doubled`, except integers and booleans."""
        return list(map(_doubled, self.run(closed.jaxpr, closed.consts, inputs)))

    def _cond(self, params: Mapping[str, Any], inputs: list[Any]) -> list[Any]:
        """Evaluates `lax.cond` and `lax.switch`; rounded numbers determine the branch index."""
        branches = [functools.partial(self._closed, branch) for branch in params["branches"]]
        return jax.lax.switch(inputs[0], branches, inputs[1:])

    def _scan(self, params: Mapping[str, Any], inputs: list[Any]) -> list[Any]:
        """Evaluates `lax.scan`, and `lax.fori_loop` with concrete bounds."""
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]

        def body(carry: list[Any], x: list[Any]) -> tuple[list[Any], list[Any]]:
            results = self._closed(params["jaxpr"], [*inputs[:first], *carry, *x])
            return results[: last - first], results[last - first :]

        start = list(map(_doubled, inputs[first:last]))
        options = {key: params[key] for key in ("length", "reverse", "unroll")}
        carry, stacked = jax.lax.scan(body, start, inputs[last:], **options)
        return [*carry, *stacked]

    def _while(self, params: Mapping[str, Any], inputs: list[Any]) -> list[Any]:
        """Evaluates `lax.while_loop`; rounded numbers determine when the loop ends."""
        first, last = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]

        def goes_on(carry: list[Any]) -> Any:
            return self._closed(params["cond_jaxpr"], [*inputs[:first], *carry])[0]

        def body(carry: list[Any]) -> list[Any]:
            return self._closed(params["body_jaxpr"], [*inputs[first:last], *carry])

        return jax.lax.while_loop(goes_on, body, list(map(_doubled, inputs[last:])))

    def _with_own_derivative(
        self, jaxpr: Jaxpr, equation: JaxprEqn, inputs: list[Any]
    ) -> list[Any]:
        """Evaluates a `jax.custom_jvp` function and its derivative rule in double floats."""
        inner = equation.params["call_jaxpr"]

        @jax.custom_jvp
        def function(inputs: list[Any]) -> list[Any]:
            return self._closed(inner, inputs)

        @function.defjvp
        def _(primals: tuple[list[Any]], tangents: tuple[list[Any]]) -> Any:
            (inputs,), (moved,) = primals, tangents
            values = [rounded(x) for x in inputs]
            slopes = [x.value if isinstance(x, Doubled) else x for x in moved]
            free = [i for i, x in enumerate(slopes) if x.dtype != jax.dtypes.float0]

            def slope(values: list[Any], slopes: list[Any]) -> Any:
                def bound(*some: Array) -> list[Any]:
                    given = dict(zip(free, some, strict=True))
                    return apply_equation(
                        jaxpr, equation, [given.get(i, x) for i, x in enumerate(values)]
                    )

                return jax.jvp(bound, [values[i] for i in free], slopes)[1]

            rule = jax.make_jaxpr(slope)(values, [slopes[i] for i in free])
            moving = [Tangent(slopes[i]) for i in free]
            changes = self.run(rule.jaxpr, rule.consts, [*inputs, *moving])
            results = function(inputs)
            return results, [_tangent(x, dx) for x, dx in zip(results, changes, strict=True)]

        return function(inputs)


FLOW: dict[str, Callable[[Evaluation, Mapping[str, Any], list[Any]], list[Any]]] = {
    "cond": Evaluation._cond,
    "scan": Evaluation._scan,
    "while": Evaluation._while,
}
"""The method of `Evaluation` for each primitive with branches or loops."""

ROUNDING = frozenset({"cumsum", "cumprod", "reduce_prod", "conv_general_dilated", "fft"})
"""Primitives with large sums or products that are linearized as a whole, and lose precision."""


def _is_jaxpr(x: PyTree | Jaxpr | ClosedJaxpr) -> bool:
    """Returns True if a parameter of an equation is a jaxpr, open or closed."""
    return hasattr(x, "eqns") or hasattr(x, "jaxpr")


def _is_complex(x: Operand) -> bool:
    """Returns True if an operand is complex."""
    return jnp.issubdtype(rounded(x).dtype, jnp.complexfloating)


def _doubled(x: Operand) -> Any:
    """Converts a float to a `Doubled` with remainder zero; integers and booleans stay plain."""
    if isinstance(x, Doubled):
        return x
    x = jnp.asarray(x)
    return Doubled.of(x) if jnp.issubdtype(x.dtype, jnp.inexact) else x


def _tangent(x: Doubled | Array, change: Operand) -> Any:
    """Converts the derivative of a result to the tangent type that `jax.custom_jvp` needs.

    The tangent of a `Doubled` has the derivative in `high`, and zero in `low`. An integer or
    boolean has a tangent of dtype float0.

    Args:
        x: the result.
        change: the derivative of x.
    """
    if not isinstance(x, Doubled):
        return np.zeros(jnp.shape(x), jax.dtypes.float0)
    slope = rounded(change)
    return Doubled(slope, jnp.zeros_like(slope))


def _linearized(jaxpr: Jaxpr, equation: JaxprEqn, inputs: list[Any]) -> list[Any]:
    """Evaluates one equation by linearization of its operation f: f(high) + f′(high) low."""
    where = [i for i, x in enumerate(inputs) if isinstance(x, Doubled)]

    def function(*highs: Array) -> list[Any]:
        given = dict(zip(where, highs, strict=True))
        return apply_equation(jaxpr, equation, [given.get(i, x) for i, x in enumerate(inputs)])

    parts = [inputs[i] for i in where]
    values, changes = jax.jvp(function, [x.high for x in parts], [x.low for x in parts])
    return [
        _carrying(*jax.lax.stop_gradient((y, low)), y + low)
        if jnp.issubdtype(y.dtype, jnp.inexact)
        else y
        for y, low in zip(values, changes, strict=True)
    ]


def _sum(x: Doubled, axes: Sequence[int]) -> Doubled:
    """Returns the sums of an array over some of its axes, by pairwise summation."""
    for axis in sorted(axes, reverse=True):
        x = jax.tree.map(lambda part, axis=axis: jnp.moveaxis(part, axis, 0), x)
        while x.high.shape[0] > 1:
            # a row of zeros is appended if the number of rows is odd
            x = jax.tree.map(
                lambda part: jnp.concatenate([part, jnp.zeros_like(part[: len(part) % 2])]), x
            )
            first, second = (jax.tree.map(lambda part, i=i: part[i::2], x) for i in (0, 1))
            x = first + second
        x = jax.tree.map(lambda part: jnp.sum(part, axis=0), x)
    return x


def _dot(
    x: Doubled, y: Doubled, contracted: Sequence[Sequence[int]], batched: Sequence[Sequence[int]]
) -> Doubled:
    """Evaluates `lax.dot_general` as an elementwise product and a sum."""
    batch, last = len(batched[0]), len(contracted[0])
    free = [z.high.ndim - batch - last for z in (x, y)]
    missing = [batch + free[0] + i for i in range(free[1])], [batch + i for i in range(free[0])]

    def arranged(side: int, part: Array) -> Array:
        """Transposes an operand to (batch axes, axes of x, axes of y, contracted axes).

        Axes of the other operand have size 1.

        Args:
            side: 0 for the operand x, 1 for y.
            part: `high` or `low` of the operand.
        """
        fixed = (*batched[side], *contracted[side])
        free_axes = [i for i in range(part.ndim) if i not in fixed]
        return jnp.expand_dims(
            jnp.transpose(part, (*batched[side], *free_axes, *contracted[side])), missing[side]
        )

    x, y = (jax.tree.map(functools.partial(arranged, side), z) for side, z in enumerate((x, y)))
    first = batch + sum(free)
    return _sum(x * y, range(first, first + last))


def _parts(x: Doubled) -> tuple[Doubled, Doubled]:
    """Returns the real and the imaginary part of a complex number."""
    return jax.tree.map(jnp.real, x), jax.tree.map(jnp.imag, x)


def _joined(real: Doubled, imaginary: Doubled) -> Doubled:
    """Returns the complex number with the given real and imaginary part."""
    return jax.tree.map(jax.lax.complex, real, imaginary)


def _product(x: Doubled, y: Doubled) -> Doubled:
    """Returns the product x y of real or complex numbers."""
    if not _is_complex(x):
        return x * y
    (a, b), (c, d) = _parts(x), _parts(y)
    return _joined(a * c - b * d, a * d + b * c)


def _quotient(x: Doubled, y: Doubled) -> Doubled:
    """Returns the quotient x / y of real or complex numbers."""
    if not _is_complex(x):
        return x / y
    a, b = _parts(y)
    above, below = _product(x, _joined(a, -b)), a * a + b * b
    return _joined(*(part / below for part in _parts(above)))


def _power(x: Doubled, exponent: int) -> Doubled:
    """Returns xⁿ for an integer exponent n, by repeated squaring."""
    if exponent < 0:
        return _quotient(Doubled.of(jnp.ones_like(x.high)), _power(x, -exponent))
    result = Doubled.of(jnp.ones_like(x.high))
    for bit in bin(exponent)[2:]:
        result = _product(result, result)
        result = _product(result, x) if bit == "1" else result
    return result


def _remainder(x: Doubled, y: Doubled) -> Doubled:
    """Evaluates `jax.lax.rem`: subtracts a multiple of y from x.

    The result has the sign of x, and its magnitude is less than |y|.
    """
    derivative = jax.lax.rem(x.value, y.value)
    x, y = jax.lax.stop_gradient((x, y))
    rest = jax.lax.rem(x.high, y.high)
    multiple = jnp.round((x.high - rest) / y.high)
    size = Doubled.of(rest) + jax.lax.rem(x.low, y.high) - multiple * y.low
    # |x| minus multiples of |y| lies between −|y| and 2|y|
    side, period = jnp.where(x.high < 0, -1, 1).astype(rest.dtype), y * jnp.sign(y.high)
    size = size * side
    size = _select((size - period).high >= 0, size - period, size)
    size = _select(size.high < 0, size + period, size) * side
    return Doubled(_carry(size.high, derivative), size.low)


def _select(where: Array, x: Doubled, y: Doubled) -> Doubled:
    """Returns x where a mask is True, and y elsewhere."""
    return jax.tree.map(functools.partial(jnp.where, where), x, y)


def _floor(x: Doubled) -> Doubled:
    """Returns the largest integer that is not above x."""
    x = jax.lax.stop_gradient(x)
    whole = jnp.floor(x.high)
    # |low| is at most half a spacing of `high`: it decides only where `high` is whole
    return _carrying(whole, jnp.where(whole == x.high, jnp.floor(x.low), 0), whole)


def _rounded_to_whole(x: Doubled, ties: jax.lax.RoundingMethod) -> Doubled:
    """Rounds x to the nearest integer, and numbers halfway between integers by the rule `ties`."""
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
"""The functions that evaluate primitives in double-float arithmetic, without linearization."""
