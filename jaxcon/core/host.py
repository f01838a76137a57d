"""Evaluation of JAX functions with NumPy, for functions that run only once.

XLA takes 4 s to compile the constraint rows of a humanoid; NumPy evaluates the same 4700 equations
in 0.1 s. Primitives without a NumPy function below are evaluated in JAX, one by one.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var

from jaxcon.core.closures import apply_equation
from jaxcon.core.jaxprs import CALLS
from jaxcon.core.typing import PyTree


def evaluate(function: Callable[..., Any], *args: PyTree) -> Any:
    """Evaluates function(*args) with NumPy, without compilation; returns a tree of NumPy arrays.

    Args:
        function: a function that JAX can trace.
        args: pytrees of numbers and arrays.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    pairs = zip(jax.tree.leaves(args), closed.jaxpr.invars, strict=True)
    given = [np.asarray(x, place.aval.dtype) for x, place in pairs]
    with np.errstate(all="ignore"):
        results = _evaluate(closed.jaxpr, closed.consts, given)
    return jax.tree.unflatten(jax.tree.structure(shapes), [np.asarray(x) for x in results])


def _evaluate(jaxpr: Jaxpr, constants: Sequence[Any], given: Sequence[Any]) -> list[Any]:
    """Evaluates an open jaxpr with NumPy; skips unused equations."""
    places = [*jaxpr.constvars, *jaxpr.invars]
    values = dict(zip(places, [*map(np.asarray, constants), *given], strict=True))

    def read(x: Var | Literal) -> Any:
        if isinstance(x, Literal):
            return np.asarray(x.val, x.aval.dtype)  # type: ignore[attr-defined]
        return values[x]

    wanted = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    needed = []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or any(x in wanted for x in equation.outvars):
            needed.append(equation)
            wanted.update(x for x in equation.invars if not isinstance(x, Literal))
    for equation in reversed(needed):
        results = _apply(jaxpr, equation, [read(x) for x in equation.invars])
        values.update(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _apply(jaxpr: Jaxpr, equation: JaxprEqn, inputs: list[Any]) -> Sequence[Any]:
    """Evaluates one equation of a jaxpr with NumPy, or with JAX if NumPy has no equivalent."""
    name, params = equation.primitive.name, equation.params
    inner = params.get(CALLS.get(name, ""))
    if inner is not None:
        return _evaluate(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
    truncates = name == "div" and np.issubdtype(inputs[0].dtype, np.integer)
    if name in ELEMENTWISE and not truncates:
        return [ELEMENTWISE[name](*inputs)]
    pads_plainly = all(min(ends) >= 0 and not ends[2] for ends in params.get("padding_config", ()))
    if name in STRUCTURAL and pads_plainly:
        return [STRUCTURAL[name](params, *inputs)]
    if name == "split":
        return np.split(inputs[0], np.cumsum(params["sizes"])[:-1], params["axis"])
    results = apply_equation(jaxpr, equation, [jnp.asarray(x) for x in inputs])
    return [np.asarray(x) for x in results]


ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "square": np.square,
    "exp": np.exp,
    "log": np.log,
    "pow": np.power,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "tanh": np.tanh,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "is_finite": np.isfinite,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "copy": np.asarray,
    "stop_gradient": np.asarray,
}
"""The NumPy function of each elementwise primitive."""


def _broadcast(params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for size, axis in zip(np.shape(x), params["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(np.reshape(x, shape), params["shape"])


def _reshape(params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    order = params["dimensions"]
    return np.reshape(x if order is None else np.transpose(x, order), params["new_sizes"])


def _slice(params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * np.ndim(x)
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*bound) for bound in bounds)]


def _rows(x: np.ndarray, places: Sequence[int]) -> np.ndarray:
    rows = np.concatenate([x, np.zeros((1, *x.shape[1:]), x.dtype)])
    return rows[list(places)]  # the place of zeros is −1, the last row


def _select(_: Mapping[str, Any], which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    return np.where(which, cases[1], cases[0]) if len(cases) == 2 else np.choose(which, cases)


def _iota(params: Mapping[str, Any]) -> np.ndarray:
    shape, axis = params["shape"], params["dimension"]
    sizes = [size if i == axis else 1 for i, size in enumerate(shape)]
    return np.broadcast_to(np.arange(shape[axis], dtype=params["dtype"]).reshape(sizes), shape)


STRUCTURAL: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *x: np.concatenate(x, params["dimension"]),
    "convert_element_type": lambda params, x: np.asarray(x, params["new_dtype"]),
    "integer_pow": lambda params, x: (
        x * x if params["y"] == 2 else np.power(x, np.asarray(params["y"], x.dtype))
    ),
    "iota": _iota,
    "pad": lambda params, x, value: np.pad(
        x, [ends[:2] for ends in params["padding_config"]], constant_values=value
    ),
    "reduce_max": lambda params, x: np.max(x, tuple(params["axes"])),
    "reduce_min": lambda params, x: np.min(x, tuple(params["axes"])),
    "reduce_sum": lambda params, x: np.sum(x, tuple(params["axes"]), dtype=np.asarray(x).dtype),
    "reshape": _reshape,
    "select_n": _select,
    "select_rows": lambda params, x: _rows(x, params["places"]),
    "slice": _slice,
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: np.transpose(x, params["permutation"]),
}
"""The NumPy function (params, *inputs) of each primitive that moves or reduces array entries."""
