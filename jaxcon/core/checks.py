"""Checks of what a user gave: each error names the culprit, what was got and what was expected.

Shapes and dtypes are checked always; values only where they are concrete, since a tracer has none.
"""

import inspect
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxcon.core.typing import Array, PyTree

FEW = 12
"""Numbers that a message shows whole."""

TURN = 2 * np.pi * 1.001
"""An angle beyond a turn, and beyond what rounding to four digits makes of one [rad]."""

LONG = 80
"""Letters of what was given that a message shows."""

_waiting_is_forbidden = ContextVar("_waiting_is_forbidden", default=False)
_constructing = ContextVar("_constructing", default=False)


def is_concrete(x: Any) -> bool:
    """Returns True where every leaf has a value that can be read now: none is traced.

    Within `without_waiting` an array of JAX has none either.
    """
    unknown = jax.Array if _waiting_is_forbidden.get() else Tracer
    return not any(isinstance(leaf, unknown) for leaf in jax.tree.leaves(x))


@contextmanager
def without_waiting() -> Iterator[None]:
    """Leaves the values of JAX's arrays unread, since a device may still compute them.

    Their shapes and dtypes are checked all the same, and what they are is judged by the status.
    """
    token = _waiting_is_forbidden.set(True)
    try:
        yield
    finally:
        _waiting_is_forbidden.reset(token)


class Checked:
    """A part of a method that checks its numbers where it is constructed, as far as they are known.

    Traced numbers, and the shapes of arrays, are checked by `init`, `rollout` and `step`: a part
    constructed with arrays may be meant for a batch of worlds. JAX rebuilds a part without this
    check; see `pytree`.
    """

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: a number is out of range.
            TypeError: a part is of another kind.
        """
        token = _constructing.set(True)
        try:
            self.check()
        finally:
            _constructing.reset(token)

    def check(self) -> None:
        """Checks the numbers; nothing by default."""


def is_floating(x: Any) -> bool:
    """Returns True for a real number or an array of such; the name of a dtype is none."""
    return isinstance(x, float) or jnp.issubdtype(getattr(x, "dtype", bool), jnp.floating)


def chosen_dtype(*trees: Any) -> Any:
    """The dtype of the first floating array of JAX in them, else that in use.

    NumPy's arrays are numbers like others, and choose none.
    """
    own = (x.dtype for x in jax.tree.leaves(trees) if isinstance(x, jax.Array))
    return next((x for x in own if jnp.issubdtype(x, jnp.floating)), jnp.result_type(float))


def plain_zero(x: Any) -> bool:
    """Returns True for the plain number 0, which leaves no trace in the compiled step."""
    return isinstance(x, int | float) and not isinstance(x, bool) and x == 0


def real(
    owner: str, what: str, x: Any, dtype: Any, shape: tuple[int, ...] = (), **limits: Any
) -> Array:
    """Real numbers as an array of this dtype and shape.

    Args:
        owner: whose number it is, for errors.
        what: the number is.
        x: as it was given.
        dtype: of the scene.
        shape: of the array.
        limits: as of `check`.

    Raises:
        ValueError: not real numbers, another shape, another floating dtype of a JAX array, or a
            value that is known and out of range.
    """
    known = isinstance(x, jax.Array) and not x.aval.weak_type  # a Python number is no choice
    if known and jnp.issubdtype(x.dtype, jnp.floating) and x.dtype != dtype:
        raise ValueError(
            f"{owner}: {what} is {x.dtype}, but the scene is {jnp.dtype(dtype).name};"
            " mixed dtypes are not promoted: convert it, or build the scene with dtype=."
        )
    return jnp.asarray(check(owner, what, x, shape, dtype=dtype, **limits), dtype)


def check(
    owner: str,
    what: str,
    x: Any,
    shape: tuple[int, ...] | None = None,
    *,
    dtype: Any = None,
    above: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
    finite: bool = True,
    optional: bool = False,
) -> Any:
    """Checks real numbers: their kind and shape always, and their values where these are known.

    Args:
        owner: whose number it is, for errors.
        what: the number is.
        x: as it was given.
        shape: that it must have; any if None.
        dtype: in whose range it must lie.
        above: below all that is allowed.
        least: the smallest that is allowed.
        most: the largest.
        finite: whether infinity is refused; NaN always is.
        optional: whether it may be None.

    Returns:
        The numbers: an array of JAX as it is, anything else as an array; None as it is.

    Raises:
        ValueError: not real numbers, another shape, or a value out of range.
    """
    if x is None and optional:
        return None
    array = _numbers(owner, what, x, "a real number" if shape == () else "real numbers")
    batched = _constructing.get() and hasattr(x, "shape")
    if shape is not None and array.shape != shape and not batched:
        raise ValueError(f"{owner}: {what} must have shape {shape}, got {array.shape}.")
    if isinstance(array, jax.Array) and not is_concrete(array):
        return array
    given = np.asarray(array, float)
    values = given if dtype is None else _narrowed(owner, what, given, dtype)
    good = (values > above) | (above == -np.inf)
    good &= (values >= least) & (values <= most) & (np.isfinite(values) | (not finite))
    if not np.all(good):
        wanted = _limits(above, least, most, finite)
        raise ValueError(f"{owner}: {what} must {wanted}, got {_shown(values, good)}.")
    return array


def _narrowed(owner: str, what: str, given: np.ndarray, dtype: Any) -> np.ndarray:
    """The numbers in the dtype of the scene.

    Raises:
        ValueError: one is beyond its range.
    """
    if given.dtype == dtype:
        return given
    with np.errstate(over="ignore"):
        values = given.astype(dtype)
    overflow = np.isinf(values) & ~np.isinf(given)
    if np.any(overflow):
        raise ValueError(
            f"{owner}: {what} must be in the range of {jnp.dtype(dtype).name}, got"
            f" {_shown(given, ~overflow)}."
        )
    return values


def _limits(above: float, least: float, most: float, finite: bool) -> str:
    """The values that are allowed, in words."""
    ending = " and finite" if finite else ""
    if above > -np.inf and most < np.inf:
        return f"be above {above:g} and at most {most:g}"
    if most < np.inf:
        return f"lie between {least:g} and {most:g}"
    if above > -np.inf:
        return ("be positive" if above == 0 else f"be above {above:g}") + ending
    if least > -np.inf:
        return ("be zero or more" if least == 0 else f"be {least:g} or more") + ending
    return "be finite" if finite else "not be NaN"


def _numbers(owner: str, what: str, x: Any, wanted: str = "real numbers") -> Any:
    """Real numbers as an array, of JAX where it is one or has one in it.

    Args:
        owner: whose they are, for errors.
        what: they are.
        x: as it was given.
        wanted: what they must be, in words.

    Raises:
        ValueError: they are none, or not of one shape.
    """
    if isinstance(x, jax.Array):
        array = x
    elif type(x) is float:
        return np.asarray(x)
    else:
        array = _from_host(owner, what, x, wanted)
    # by kind, since NumPy counts durations among the integers; bfloat16 has one of its own
    kind = getattr(array.dtype, "kind", "?")
    if kind not in "fiu" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"{owner}: {what} must be {wanted}, got {shortened(x)}.")
    return array


def _from_host(owner: str, what: str, x: Any, wanted: str) -> Any:
    """An array of what is no array of JAX."""
    leaves = jax.tree.leaves(x) if isinstance(x, list | tuple) else [x]
    wrong = next((y for y in leaves if isinstance(y, bool | np.bool_)), None)
    if x is None or wrong is not None:
        raise ValueError(f"{owner}: {what} must be {wanted}, got {shortened(x)}.")
    try:
        if any(isinstance(y, jax.Array) for y in leaves) or hasattr(x, "__jax_array__"):
            return jnp.asarray(x)
        if isinstance(x, np.ma.MaskedArray):
            x = np.ma.filled(x.astype(float), np.nan)
        with warnings.catch_warnings():  # of ragged lists, by older versions of NumPy
            warnings.simplefilter("error")
            array = np.asarray(x)
        integers = array.dtype == object and all(type(y) is int for y in array.ravel())
        return array.astype(float) if integers else array  # those beyond 64 bits
    except OverflowError as error:
        raise ValueError(
            f"{owner}: {what} is beyond the range of floating numbers, got {shortened(x)}."
        ) from error
    except (TypeError, ValueError, Warning) as error:
        raise ValueError(
            f"{owner}: {what} must be real numbers of one shape, got {shortened(x)}."
        ) from error


def components(owner: str, **given: tuple[Any, tuple[int, ...]]) -> list[Any]:
    """Real numbers whose first axes enumerate components; values are not read.

    Args:
        owner: whose numbers they are, for errors.
        given: by name, the numbers and the sizes of their first axes.

    Returns:
        Arrays of floating numbers.

    Raises:
        ValueError: not real numbers, other sizes, or further axes that do not broadcast.
    """
    arrays = []
    for what, (x, sizes) in given.items():
        array = _numbers(owner, what, x)
        array = jnp.asarray(float(x) if isinstance(x, int | float) else array)  # weakly typed
        if array.shape[: len(sizes)] != sizes:
            wanted = f"({', '.join(map(str, sizes))}, …)" if sizes else "()"
            raise ValueError(f"{owner}: {what} must have shape {wanted}, got {array.shape}.")
        floating = jnp.issubdtype(array.dtype, jnp.floating)
        arrays.append(array if floating else array.astype(jnp.result_type(float)))
    batches = [x.shape[len(n) :] for x, (_, n) in zip(arrays, given.values(), strict=True)]
    try:
        np.broadcast_shapes(*batches)
    except ValueError as error:
        shapes = " and ".join(f"{what} {x.shape}" for what, x in zip(given, arrays, strict=True))
        raise ValueError(
            f"{owner}: the further axes of {shapes} do not broadcast against each other."
        ) from error
    return arrays


def shortened(x: Any) -> str:
    """Describes a value that was given, in few words."""
    try:
        text = repr(x)
    except Exception:  # an integer of too many digits, or a faulty object of the user's
        return f"a value of type {type(x).__name__}"
    return clipped(text)


def clipped(text: str) -> str:
    """The text, cut where it is long."""
    return text if len(text) <= LONG else f"{text[:LONG]}…"


def numerals(x: Any) -> str:
    """Numbers as a message shows them: seven digits, without the noise of float32.

    Args:
        x: an array, nested lists or a number.
    """
    if np.ndim(x):
        return f"[{', '.join(map(numerals, x))}]"
    text = f"{float(x):.7g}"
    return f"{text}.0" if text.lstrip("-").isdigit() else text


def _shown(values: np.ndarray, good: np.ndarray) -> str:
    """Numbers in words: all where they are few, else the first that is not good and its place."""
    if values.size <= FEW:
        return numerals(values)
    place = tuple(int(i) for i in np.argwhere(~good)[0])
    return f"{numerals(values[place])} at {list(place)} of an array {values.shape}"


def count(owner: str, what: str, x: Any, least: int = 1, most: int = 2**31 - 1) -> None:
    """Checks that a value is a whole number within limits.

    Raises:
        ValueError: it is not.
    """
    whole = isinstance(x, int | np.integer) and not isinstance(x, bool | np.timedelta64)
    if not whole or x < least:
        raise ValueError(
            f"{owner}: {what} must be a whole number from {least}, got {shortened(x)}."
        )
    if x > most:
        raise ValueError(f"{owner}: {what} must be at most {most}, got {shortened(x)}.")


def flag(owner: str, what: str, x: Any) -> None:
    """Checks that a value is True or False.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(x, bool):
        raise ValueError(f"{owner}: {what} must be True or False, got {shortened(x)}.")


def nonzero(owner: str, what: str, x: Any) -> None:
    """Checks that a vector has a direction.

    Raises:
        ValueError: it has none, or is none of numbers.
    """
    values = _numbers(owner, what, x)
    if is_concrete(values):
        values = np.asarray(values, float)
        if not np.all(np.isfinite(values)) or not np.linalg.norm(values) > 0:
            raise ValueError(f"{owner}: {what} must have a length, got {numerals(values)}.")


def radians(owner: str, what: str, x: Any) -> None:
    """Warns of an angle of more than a turn, which is more likely to be one in degrees.

    Args:
        owner: whose angle it is.
        what: the angle is.
        x: angle () [rad]; infinity is no angle.
    """
    if is_concrete(x) and TURN < abs(float(x)) < np.inf:
        warnings.warn(
            f"{owner}: {what} is {float(x):g} rad, more than a turn; give radians, of degrees"
            " np.deg2rad(…). Filter this warning where whole turns are meant.",
            stacklevel=2,
        )


def recorded(owner: str, what: str, x: Any) -> Any:
    """Real numbers, NaN where they are masked.

    Raises:
        ValueError: they are none.
    """
    kind = x.dtype if isinstance(x, jax.Array) else np.asarray(x).dtype
    if getattr(kind, "kind", "?") not in "fiu" and not jnp.issubdtype(kind, jnp.floating):
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
    """Returns True where an array broadcasts to a shape, and that shape to none larger."""
    pairs = zip(reversed(shape), reversed(into), strict=False)
    return len(shape) <= len(into) and all(n in (1, m) for n, m in pairs)
