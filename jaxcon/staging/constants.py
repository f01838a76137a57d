"""Simplifies operations on constants: products with 0 or 1, sums with 0, and pure constants.

Parameters of a scene that are not traced are constants of the program. Many of them are 0 or 1:
components of axes and of attachment points, for example. XLA keeps the product of a float and 0,
because it is NaN if the float is infinite or NaN, and has the float's sign otherwise. Here it is 0,
so that 0·x does not tell whether x is finite; x − x does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import JaxprEqn

from jaxcon.core.host import ELEMENTWISE, STRUCTURAL
from jaxcon.core.typing import Scalar

MAX_SIZE = 4096
"""The largest number of different entries of a constant on which operations are evaluated."""

EXACT = frozenset(
    {"abs", "add", "and", "convert_element_type", "eq", "ge", "gt", "is_finite", "le", "lt", "max"}
    | {"div", "min", "mul", "ne", "neg", "not", "or", "select_n", "square", "sub"}
)
"""Elementwise primitives for which NumPy and XLA give the same bits."""

MOVES = ("broadcast_in_dim", "concatenate", "reshape", "slice", "squeeze", "transpose")
"""Primitives that only move entries."""


class Constant:
    """An operand of an operation that is known when the program is traced.

    Attributes:
        value: a literal, or an array over which the function closes. A NumPy array may have axes
            with a stride of 0, along which all entries are the same.
    """

    def __init__(self, value: Scalar | np.generic) -> None:
        self.value = value

    def array(self) -> np.ndarray | None:
        """Returns the value as a NumPy array.

        None for values that are traced, on other processes or random keys, and for large arrays of
        JAX, which would be copied from their device.
        """
        x = self.value
        if isinstance(x, np.ndarray):
            return x
        if isinstance(x, Tracer) or np.size(x) > MAX_SIZE:
            return None
        dtype = jax.numpy.result_type(x)
        if isinstance(x, jax.Array) and not x.is_fully_addressable:
            return None
        return None if jax.numpy.issubdtype(dtype, jax.dtypes.extended) else np.asarray(x, dtype)

    def number(self) -> np.generic | None:
        """Returns the number to which all entries are equal; None if they are not equal."""
        x = self.array()
        once = None if x is None else without_repetition(x)
        if once is None or not 0 < once.size <= MAX_SIZE:
            return None
        return once.flat[0] if np.all(once == once.flat[0]) else None


def uniform(number: int, aval: Any) -> Constant:
    """Returns an array of equal numbers as a constant, with the shape and dtype of `aval`."""
    return Constant(np.broadcast_to(np.asarray(number, aval.dtype), aval.shape))


Operand = int | Constant
"""An operand of an operation: the number of a value, or a constant."""


def without_repetition(x: np.ndarray, axes: Sequence[int] | None = None) -> np.ndarray:
    """Returns an array with size 1 along axes that repeat the same entries.

    Args:
        x: the array. It repeats its entries along the axes that have a stride of 0.
        axes: the axes to look at; None for all.
    """
    among = range(x.ndim) if axes is None else axes
    repeats = [a in among and n > 1 and x.strides[a] == 0 for a, n in enumerate(x.shape)]
    return x[tuple(slice(0, 1) if flag else slice(None) for flag in repeats)]


def simplified(equation: JaxprEqn, args: Sequence[Operand]) -> Operand | None:
    """Returns the result of an equation if it is a constant or one of the operands, else None.

    Args:
        equation: an equation with one result, whose shape has no symbolic size.
        args: its operands.
    """
    constants = [x for x in args if isinstance(x, Constant)]
    if not constants:
        return None
    if len(constants) < len(args):
        return _equal_operand(equation, args)
    arrays = [x.array() for x in constants]
    known = [x for x in arrays if x is not None]
    result = _evaluated(equation, known) if len(known) == len(arrays) else None
    return None if result is None else Constant(result)


def _evaluated(equation: JaxprEqn, args: Sequence[np.ndarray]) -> np.ndarray | None:
    """Returns the result of an equation for constant operands; None if it stays an operation."""
    name, params = equation.primitive.name, equation.params
    aval: Any = equation.outvars[0].aval
    if name in MOVES:
        result = _moved(name, params, args)
    elif name in EXACT:
        result = _computed(name, params, [without_repetition(x) for x in args])
    else:
        return None
    if result is None or result.dtype != aval.dtype:
        return None
    result = np.broadcast_to(result, aval.shape)
    return result if without_repetition(result).size <= MAX_SIZE else None


def _moved(name: str, params: Mapping[str, Any], args: Sequence[np.ndarray]) -> np.ndarray | None:
    """Evaluates a primitive that moves entries; None if repeated entries would be stored singly."""
    if name == "reshape":
        (x,) = args
        once = without_repetition(x)
        if once.size == 1:
            return np.broadcast_to(once.reshape(()), params["new_sizes"])
        if once.size < x.size or x.size > MAX_SIZE:
            return None
    if name == "concatenate":
        others = set(range(args[0].ndim)) - {params["dimension"]}
        same = [a for a in others if all(x.strides[a] == 0 or x.shape[a] == 1 for x in args)]
        args = [without_repetition(x, same) for x in args]
        singly = any(without_repetition(x, [*others]).size < x.size for x in args)
        if singly or sum(x.size for x in args) > MAX_SIZE:
            return None
    return STRUCTURAL[name](params, *args)


def _computed(
    name: str, params: Mapping[str, Any], args: Sequence[np.ndarray]
) -> np.ndarray | None:
    """Evaluates an elementwise primitive."""
    if math.prod(np.broadcast_shapes(*(x.shape for x in args))) > MAX_SIZE:
        return None
    if name == "select_n":
        return np.choose(args[0].astype(int), args[1:], mode="clip")
    if name == "convert_element_type":
        floating = np.issubdtype(args[0].dtype, np.inexact)
        if floating and np.issubdtype(params["new_dtype"], np.integer):
            return None  # XLA clamps numbers beyond the range, NumPy does not
        return args[0].astype(params["new_dtype"])
    if name == "div" and not np.issubdtype(args[0].dtype, np.inexact):
        return None  # XLA rounds quotients of integers toward zero, NumPy makes them floats
    with np.errstate(all="ignore"):
        return ELEMENTWISE[name](*args)


def _equal_operand(equation: JaxprEqn, args: Sequence[Operand]) -> Operand | None:
    """Returns the operand that the result of an equation equals, or 0 for a product with 0."""
    name = equation.primitive.name
    aval: Any = equation.outvars[0].aval
    if name == "select_n":
        which = args[0].number() if isinstance(args[0], Constant) else None
        return None if which is None else args[1 + min(max(int(which), 0), len(args) - 2)]
    for place, neutral in NEUTRAL.get(name, ()):
        constant, other = args[place], args[1 - place]
        number = constant.number() if isinstance(constant, Constant) else None
        whole: Any = equation.invars[1 - place].aval
        if name == "mul" and number is not None and number == 0:
            return uniform(0, aval)
        if number is not None and number == neutral and whole.shape == aval.shape:
            return other
    return None


NEUTRAL: dict[str, tuple[tuple[int, int], ...]] = {
    "mul": ((0, 1), (1, 1)),
    "add": ((0, 0), (1, 0)),
    "sub": ((1, 0),),
    "div": ((1, 1),),
}
"""Neutral elements: pairs (place of an operand, its neutral number) of each primitive.

With that number in that place, the result is the other operand: 1·x = x, x + 0 = x.
"""
