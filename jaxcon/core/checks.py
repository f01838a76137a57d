"""Checks of what a user gave: each error names the culprit, what was got and what was expected.

Shapes and dtypes are checked always; values only where they are concrete, since a tracer has none.
"""

import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxcon.core.typing import Array, PyTree

FEW = 12
"""Numbers that a message shows whole."""


def is_concrete(x: Any) -> bool:
    """Whether every leaf has a value now."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(x))


def is_floating(x: Any) -> bool:
    """Whether a leaf is a real number, or an array of such; a name of a dtype is none."""
    return isinstance(x, float) or jnp.issubdtype(getattr(x, "dtype", bool), jnp.floating)


def chosen_dtype(*trees: Any) -> Any:
    """The dtype of the first floating array of JAX in them, else that in use.

    NumPy's arrays are numbers like others, and choose none.
    """
    own = (x.dtype for x in jax.tree.leaves(trees) if isinstance(x, jax.Array))
    return next((x for x in own if jnp.issubdtype(x, jnp.floating)), jnp.result_type(float))


def plain_zero(x: Any) -> bool:
    """Whether a user gave the number 0 itself, which leaves no trace in the compiled step."""
    return isinstance(x, int | float) and x == 0


def number(owner: str, what: str, x: Any, dtype: Any, shape: tuple[int, ...] = ()) -> Array:
    """The value as an array of this dtype and shape.

    Raises:
        ValueError: another shape, another floating dtype of a JAX array, or not a number.
    """
    known = isinstance(x, jax.Array) and not x.aval.weak_type  # a Python number is no choice
    if known and jnp.issubdtype(x.dtype, jnp.floating) and x.dtype != dtype:
        raise ValueError(
            f"{owner}: {what} is {x.dtype}, but the scene is {jnp.dtype(dtype).name};"
            " mixed dtypes are not promoted: convert it, or build the scene with dtype=."
        )
    try:
        if isinstance(x, str):
            raise TypeError("a string is no number")
        array = jnp.asarray(x, dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{owner}: {what} must be numbers, got {x!r}.") from error
    if array.shape != shape:
        raise ValueError(f"{owner}: {what} must have shape {shape}, got {array.shape}.")
    return array


def positive(owner: str, what: str, x: Any, strictly: bool = True) -> None:
    """Checks that every value is positive (or not negative) and finite.

    Raises:
        ValueError: one is not, or is no number.
    """
    if is_concrete(x):
        values = _values(owner, what, x)
        good = np.isfinite(values) & ((values > 0) if strictly else (values >= 0))
        if not np.all(good):
            bound, found = "positive" if strictly else "zero or more", _shown(values, good)
            raise ValueError(f"{owner}: {what} must be {bound} and finite, got {found}.")


def amount(owner: str, what: str, x: Any, dtype: Any) -> Array:
    """The value as an array () of this dtype, zero or more and finite.

    Raises:
        ValueError: as of `number` and `positive`.
    """
    value = number(owner, what, x, dtype)
    positive(owner, what, value, strictly=False)
    return value


def between(owner: str, what: str, x: Any, low: float, high: float) -> None:
    """Checks that every value lies between two.

    Raises:
        ValueError: one does not, or is no number.
    """
    if is_concrete(x):
        values = _values(owner, what, x)
        good = (values >= low) & (values <= high)
        if not np.all(good):
            found = _shown(values, good)
            raise ValueError(f"{owner}: {what} must lie between {low} and {high}, got {found}.")


def _values(owner: str, what: str, x: Any) -> np.ndarray:
    """Real numbers as an array of the host.

    Raises:
        ValueError: they are none.
    """
    try:
        values = np.asarray([np.asarray(y) for y in x] if isinstance(x, list | tuple) else x)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{owner}: {what} must be numbers of one shape, got {x!r}.") from error
    if not any(jnp.issubdtype(values.dtype, kind) for kind in (jnp.floating, jnp.integer)):
        raise ValueError(f"{owner}: {what} must be a real number, got {x!r}.")
    return values.astype(float)


def _shown(values: np.ndarray, good: np.ndarray) -> str:
    """Numbers in words: all where they are few, else the first that is not good and its place."""
    if values.size <= FEW:
        return str(values.tolist())
    place = tuple(int(i) for i in np.argwhere(~good)[0])
    return f"{values[place]} at {list(place)} of an array {values.shape}"


def count(owner: str, what: str, x: Any, least: int = 1) -> None:
    """Checks that a value is a whole number, and not below the least one.

    Raises:
        ValueError: it is not.
    """
    whole = isinstance(x, int | np.integer) and not isinstance(x, bool)
    if not whole or x < least:
        raise ValueError(f"{owner}: {what} must be a whole number from {least}, got {x!r}.")


def nonzero(owner: str, what: str, x: Any) -> None:
    """Checks that a vector has a direction.

    Raises:
        ValueError: it has none, or is none of numbers.
    """
    if is_concrete(x):
        values = _values(owner, what, x)
        if not np.all(np.isfinite(values)) or not np.linalg.norm(values) > 0:
            raise ValueError(f"{owner}: {what} must have a length, got {values.tolist()}.")


def finite(owner: str, what: str, x: Any) -> None:
    """Checks that every value is finite.

    Raises:
        ValueError: one is not, or is no number.
    """
    if is_concrete(x):
        values = _values(owner, what, x)
        good = np.isfinite(values)
        if not np.all(good):
            found = _shown(values, good)
            raise ValueError(f"{owner}: {what} must be finite, got {found}.")


def recorded(owner: str, what: str, x: Any) -> Any:
    """Real numbers, NaN where they are masked.

    Raises:
        ValueError: they are none.
    """
    kind = x.dtype if isinstance(x, jax.Array) else np.asarray(x).dtype
    if kind.kind not in "fiu" and not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(
            f"{owner}: {what} must be real numbers, NaN where nothing was seen, got {kind}."
        )
    if not isinstance(x, np.ma.MaskedArray):
        return x
    return np.ma.filled(x.astype(kind if kind.kind == "f" else float), np.nan)


def takes(owner: str, what: str, function: Any, given: tuple[str, ...], why: str = "") -> None:
    """Checks that a user's function can be called with so many arguments.

    Args:
        owner: that calls it.
        what: the function is.
        function: as it was given.
        given: what it is called with, in words.
        why: it is called so.

    Raises:
        TypeError: it is no function, or one of other arguments.
    """
    if not callable(function):
        raise TypeError(f"{owner}: {what} must be a function of {given[0]}, got {function!r}.")
    try:
        inspect.signature(function).bind(*given)
    except TypeError as error:
        raise TypeError(
            f"{owner}: {what} is called as {what}({', '.join(given)}){why}, and does not accept"
            f" that: {error}."
        ) from error
    except ValueError:  # a function without a signature
        return


def described(tree: PyTree) -> str:
    """The shapes of arrays by name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    if [path for path, _ in leaves] == [()]:
        return f"an array {jnp.shape(leaves[0][1])}"
    shapes = {jax.tree_util.keystr(path, simple=True, separator="/"): x for path, x in leaves}
    return ", ".join(f"{name} {jnp.shape(x)}" for name, x in shapes.items()) or "nothing"


def fits(shape: tuple[int, ...], into: tuple[int, ...]) -> bool:
    """Whether an array broadcasts to a shape, and that shape to none larger."""
    pairs = zip(reversed(shape), reversed(into), strict=False)
    return len(shape) <= len(into) and all(n in (1, m) for n, m in pairs)
