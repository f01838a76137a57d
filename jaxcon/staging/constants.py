"""Simplifies operations on constants: products with 0 or 1, sums with 0, and pure constants.

Parameters of a scene that are not traced are constants of the program. Many of them are 0 or 1:
components of axes and of attachment points, for example. XLA keeps the product of a float and 0,
because it is NaN if the float is infinite. Here it is 0. The program of a chain of 5 links becomes
shorter by a sixth, and runs faster by as much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import JaxprEqn

from jaxcon.core.typing import Scalar

MOST = 4096
"""The largest number of entries of a constant on which operations are evaluated."""


class Constant:
    """An operand of an operation that is known when the program is traced.

    Attributes:
        value: a literal, or an array over which the function closes. A NumPy array may have axes
            with a stride of 0, along which all entries are the same.
    """

    def __init__(self, value: Scalar | np.generic) -> None:
        self.value = value

    def array(self) -> np.ndarray | None:
        """Returns the value as a NumPy array; None if it is large, or no array of numbers."""
        x = self.value
        if isinstance(x, np.ndarray):
            return x
        if isinstance(x, Tracer) or np.size(x) > MOST:
            return None
        dtype = jax.numpy.result_type(x)
        if isinstance(x, jax.Array) and not x.is_fully_addressable:
            return None
        return None if jax.numpy.issubdtype(dtype, jax.dtypes.extended) else np.asarray(x, dtype)

    def number(self) -> np.generic | None:
        """Returns the number to which all entries are equal; None if they are not equal."""
        x = self.array()
        once = None if x is None else without_repetition(x)
        if once is None or not 0 < once.size <= MOST:
            return None
        return once.flat[0] if np.all(once == once.flat[0]) else None


Operand = int | Constant
"""An operand of an operation: the number of a value, or a constant."""


def without_repetition(x: np.ndarray, axes: Sequence[int] | None = None) -> np.ndarray:
    """Returns an array with size 1 along axes that repeat the same entries.

    Args:
        x: the array. It repeats its entries along the axes that have a stride of 0.
        axes: the axes to look at; None for all.
    """
    chosen = range(x.ndim) if axes is None else axes
    repeats = [a in chosen and n > 1 and x.strides[a] == 0 for a, n in enumerate(x.shape)]
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
        return _same(equation, args)
    arrays = [x.array() for x in constants]
    known = [x for x in arrays if x is not None]
    result = _evaluated(equation, known) if len(known) == len(arrays) else None
    return None if result is None else Constant(result)


def _evaluated(equation: JaxprEqn, args: Sequence[np.ndarray]) -> np.ndarray | None:
    """Returns the result of an equation for constant operands; None if this is not possible."""
    name = equation.primitive.name
    aval: Any = equation.outvars[0].aval
    if name in MOVES:
        result = MOVES[name](equation.params, *args)
    elif name in ELEMENTWISE:
        once = [without_repetition(x) for x in args]
        if math.prod(np.broadcast_shapes(*(x.shape for x in once))) > MOST:
            return None
        with np.errstate(all="ignore"):
            result = ELEMENTWISE[name](equation.params, *once)
    else:
        return None
    if result is None or result.dtype != aval.dtype:
        return None
    return np.broadcast_to(result, aval.shape)


def _same(equation: JaxprEqn, args: Sequence[Operand]) -> Operand | None:
    """Returns the operand that an equation with other, constant operands returns, else None."""
    name = equation.primitive.name
    aval: Any = equation.outvars[0].aval
    if name == "select_n":
        which = args[0].number() if isinstance(args[0], Constant) else None
        return None if which is None else args[1 + int(which)]
    if name not in NEUTRAL:
        return None
    for place, neutral, absorbing in NEUTRAL[name]:
        constant, other = args[place], args[1 - place]
        number = constant.number() if isinstance(constant, Constant) else None
        if number is None:
            continue
        if absorbing is not None and number == absorbing:
            return Constant(np.broadcast_to(np.asarray(absorbing, aval.dtype), aval.shape))
        whole: Any = equation.invars[1 - place].aval
        if number == neutral and whole.shape == aval.shape:
            return other
    return None


NEUTRAL: dict[str, tuple[tuple[int, float | bool, float | bool | None], ...]] = {
    "mul": ((0, 1, 0), (1, 1, 0)),
    "add": ((0, 0, None), (1, 0, None)),
    "sub": ((1, 0, None),),
    "div": ((1, 1, None),),
}
"""By primitive: the place of a constant operand, with which number the result is the other operand,
and with which number it is this number (None for no such number)."""

Params = Mapping[str, Any]


def _broadcast(params: Params, x: np.ndarray) -> np.ndarray:
    """Evaluates `broadcast_in_dim`."""
    sizes = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        sizes[axis] = size
    return np.broadcast_to(x.reshape(sizes), params["shape"])


def _reshape(params: Params, x: np.ndarray) -> np.ndarray | None:
    """Evaluates `reshape`."""
    once, sizes = without_repetition(x), params["new_sizes"]
    if once.size == 1:
        return np.broadcast_to(once.reshape(()), sizes)
    return x.reshape(sizes) if math.prod(sizes) <= MOST else None


def _slice(params: Params, x: np.ndarray) -> np.ndarray:
    """Evaluates `slice`."""
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _concatenate(params: Params, *parts: np.ndarray) -> np.ndarray | None:
    """Evaluates `concatenate`."""
    axis = params["dimension"]
    same = [
        a
        for a in range(parts[0].ndim)
        if a != axis and all(x.strides[a] == 0 or x.shape[a] == 1 for x in parts)
    ]
    parts = tuple(without_repetition(x, same) for x in parts)
    return np.concatenate(parts, axis) if sum(x.size for x in parts) <= MOST else None


MOVES: dict[str, Callable[..., np.ndarray | None]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenate,
    "reshape": _reshape,
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "slice": _slice,
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: np.transpose(x, params["permutation"]),
}
"""Functions of (parameters, operands) that evaluate primitives which move entries."""


def _of(operation: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function of (parameters, operands) that ignores the parameters."""
    return lambda params, *args: operation(*args)


ELEMENTWISE: dict[str, Callable[..., np.ndarray]] = {
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
    "abs": _of(np.abs),
    "add": _of(np.add),
    "and": _of(np.bitwise_and),
    "eq": _of(np.equal),
    "ge": _of(np.greater_equal),
    "gt": _of(np.greater),
    "is_finite": _of(np.isfinite),
    "le": _of(np.less_equal),
    "lt": _of(np.less),
    "max": _of(np.maximum),
    "min": _of(np.minimum),
    "mul": _of(np.multiply),
    "ne": _of(np.not_equal),
    "neg": _of(np.negative),
    "not": _of(np.invert),
    "or": _of(np.bitwise_or),
    "square": _of(np.square),
    "sub": _of(np.subtract),
}
"""Functions of (parameters, operands) that evaluate elementwise primitives as XLA does."""
