"""Calls of user functions, with errors that name the function and the expected result."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.errors import (
    ConcretizationTypeError,
    TracerArrayConversionError,
    TracerIntegerConversionError,
)

from jaxcon.core import derivatives
from jaxcon.core.checks import shortened
from jaxcon.core.typing import Array, PyTree

UNKNOWN = (ConcretizationTypeError, TracerArrayConversionError, TracerIntegerConversionError)
"""The errors that JAX raises when code needs the concrete value of a tracer."""


def call(owner: str, what: str, function: Callable[..., Any], *args: PyTree) -> Any:
    """Returns function(*args) for a user's function, and explains errors about traced values.

    Args:
        owner: the caller, for error messages.
        what: the role of the function, for error messages.
        function: the user's function.
        args: the arguments of the function.

    Raises:
        TypeError: the function reads the value of a tracer.
    """
    try:
        with derivatives.taken(True):  # the function may contain derivatives of its own
            return function(*args)
    except UNKNOWN as error:
        raise TypeError(
            f"{owner}: {what}, {title(function)}, needs the value of a number that is traced, as"
            " Python's `if`, `while` and `float()` and NumPy's functions do; use jnp.where,"
            " jax.lax.cond and jax.numpy."
        ) from error


def title(function: Callable[..., Any]) -> str:
    """Returns the name of a function with its file and line, for messages."""
    name = getattr(function, "__qualname__", type(function).__name__)
    code = getattr(function, "__code__", None)
    return f"'{name}'" + (f" ({code.co_filename}:{code.co_firstlineno})" if code else "")


def array(owner: str, what: str, x: PyTree) -> Array:
    """Converts the result of a user's function to an array of real numbers.

    Raises:
        TypeError: the result is no array of real numbers.
    """
    try:
        result = None if x is None or isinstance(x, str | bool) else jnp.asarray(x)
    except (TypeError, ValueError):
        result = None
    real = result is not None and jnp.issubdtype(result.dtype, jnp.floating)
    if result is None or not (real or getattr(result.dtype, "kind", "?") in "iu"):
        missing = "; is a return missing?" if x is None else "."
        got = f"an array of {result.dtype}" if result is not None else shortened(x)
        raise TypeError(f"{owner}: {what} must return an array of numbers, got {got}{missing}")
    return result


def tree(owner: str, what: str, x: PyTree) -> PyTree:
    """Checks that the result of a user's function is a pytree of arrays; returns it unchanged.

    Raises:
        TypeError: a leaf is not an array or a number, or an array of dates, strings or objects.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        valid = isinstance(leaf, bool | int | float | complex)
        if hasattr(leaf, "dtype"):
            valid = getattr(leaf.dtype, "kind", "?") not in "mMOSU"
        if not valid:
            at = jax.tree_util.keystr(path)
            raise TypeError(
                f"{owner}: {what} must return arrays, got {shortened(leaf)}"
                f"{' at ' + at if at else ''}."
            )
    return x
