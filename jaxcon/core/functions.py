"""Functions of the user's: errors of theirs say which function it is, and what it should do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.errors import (
    ConcretizationTypeError,
    TracerArrayConversionError,
    TracerIntegerConversionError,
)

from jaxcon.core.checks import shortened
from jaxcon.core.typing import Array, PyTree

UNKNOWN = (ConcretizationTypeError, TracerArrayConversionError, TracerIntegerConversionError)
"""The errors that JAX raises where a program asks for the value of a traced number."""


def call(owner: str, what: str, function: Callable[..., Any], *args: Any) -> Any:
    """function(*args), which is traced.

    Args:
        owner: that calls it, for errors.
        what: the function is.
        function: the user's.
        args: its arguments.

    Raises:
        TypeError: the function needs the value of a number that is traced.
    """
    try:
        return function(*args)
    except UNKNOWN as error:
        raise TypeError(
            f"{owner}: {what}, {title(function)}, needs the value of a number that is traced, as"
            " Python's `if`, `while` and `float()` and NumPy's functions do; use jnp.where,"
            " jax.lax.cond and jax.numpy."
        ) from error


def title(function: Any) -> str:
    """A function's name, and where it is written."""
    name = getattr(function, "__qualname__", type(function).__name__)
    code = getattr(function, "__code__", None)
    return f"'{name}'" + (f" ({code.co_filename}:{code.co_firstlineno})" if code else "")


def array(owner: str, what: str, x: Any) -> Array:
    """The result of a function, as an array of real numbers.

    Raises:
        TypeError: it is none.
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
    """The result of a function, a pytree of arrays as it is.

    Raises:
        TypeError: a leaf of it is something else.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        if not hasattr(leaf, "dtype") and not isinstance(leaf, bool | int | float | complex):
            at = jax.tree_util.keystr(path)
            raise TypeError(
                f"{owner}: {what} must return arrays, got {shortened(leaf)}"
                f"{' at ' + at if at else ''}."
            )
    return x
