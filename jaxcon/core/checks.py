"""Checks of user input, with errors that name the argument, its value and the expected value.

Shapes and dtypes are always checked. Values are checked only if they are concrete, not traced.
"""

import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, SupportsIndex, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxcon.core.typing import Array, DType, PyTree, Scalar

FEW = 12
"""The largest number of array entries that a message shows in full."""

TURN = 2 * np.pi * 1.001
"""The largest angle without a warning [rad]: one turn, plus a margin for four-digit rounding."""

LONG = 80
"""The largest number of characters of a value that a message shows."""

_waiting_is_forbidden = ContextVar("_waiting_is_forbidden", default=False)
_constructing = ContextVar("_constructing", default=False)


def is_concrete(x: PyTree) -> bool:
    """Returns True if no leaf of a tree is traced, so that all values can be read.

    Within the context `without_waiting`, JAX arrays count as traced.
    """
    unknown = jax.Array if _waiting_is_forbidden.get() else Tracer
    return not any(isinstance(leaf, unknown) for leaf in jax.tree.leaves(x))


@contextmanager
def without_waiting() -> Iterator[None]:
    """Makes checks skip the values of JAX arrays, so that they do not wait for a device.

    Shapes and dtypes are still checked. Invalid values appear later, in the status.
    """
    token = _waiting_is_forbidden.set(True)
    try:
        yield
    finally:
        _waiting_is_forbidden.reset(token)


class NumberRange(TypedDict, total=False):
    """The keyword arguments of `check` that limit the allowed values."""

    above: float
    least: float
    most: float
    finite: bool
    optional: bool


class Checked:
    """A base class of solvers, integrators and the like, whose constructor checks its fields.

    Only concrete values are checked. Shapes of arrays are checked later, by `init`, `rollout` and
    `step`, because a field may be an array over a batch of worlds. JAX rebuilds instances without
    these checks; see `pytree`.
    """

    def __post_init__(self) -> None:
        """Checks the fields by `check`, after the constructor has set them.

        Raises:
            ValueError: a field is out of range.
            TypeError: a field has the wrong type.
        """
        token = _constructing.set(True)
        try:
            self.check()
        finally:
            _constructing.reset(token)

    def check(self) -> None:
        """Checks the fields. Subclasses override this method, which does nothing here."""


def derives(owner: str, what: str, value: object, protocol: type) -> None:
    """Checks that a user's part of a method, such as a solver, derives from its protocol.

    Args:
        owner: the class that takes the part, for error messages.
        what: the name of the argument for the part, for error messages.
        value: the part.
        protocol: the protocol, a class of `jc.extend` with defaults for most methods.

    Raises:
        TypeError: the class of the part does not derive from the protocol.
    """
    if protocol not in type(value).__mro__:
        raise TypeError(
            f"{owner}: {what}: {type(value).__name__} must derive from"
            f" jc.extend.{protocol.__name__}, which has defaults for most methods."
        )


def instance(owner: str, what: str, x: object, kind: type, expected: str) -> None:
    """Checks that an argument is an instance of a class.

    Args:
        owner: the function that takes the argument, for error messages.
        what: the name of the argument, for error messages.
        x: the user's value.
        kind: the class.
        expected: a description of the right value, for error messages.

    Raises:
        TypeError: the argument has another type.
    """
    if not isinstance(x, kind):
        raise TypeError(f"{owner}: {what} must be {expected}, got {type(x).__name__}.")


def random_key(owner: str, what: str, key: Any) -> None:
    """Checks that an argument is one random key of JAX: typed, or raw with the dtype uint32.

    Raises:
        TypeError: the argument is no key, or an array of keys.
    """
    dtype = key.dtype if isinstance(key, jax.Array | np.ndarray) else np.dtype(bool)
    typed = jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not typed and dtype != np.uint32:
        raise TypeError(
            f"{owner}: {what} must be a random key such as jax.random.key(0), got {shortened(key)}."
        )
    if key.ndim == 0 and not typed:
        raise TypeError(f"{owner}: {what} must be a random key, got the number {key}.")
    if key.ndim != (0 if typed else 1):
        raise TypeError(f"{owner}: {what} must be a single key, got an array {key.shape} of keys.")


def names(owner: str, what: str, x: Any) -> tuple[str, ...]:
    """Returns one or several names as a tuple.

    Raises:
        ValueError: the value is neither a name nor an iterable of names.
    """
    given: tuple[Any, ...] = (None,)
    if isinstance(x, Iterable) and getattr(x, "ndim", 1) == 1:
        given = (x,) if isinstance(x, str) else tuple(x)
    if not all(isinstance(name, str) for name in given):
        raise ValueError(f"{owner}: {what} must be names, got {shortened(x)}.")
    return given


def parameters(owner: str, params: PyTree, finite: bool = True) -> None:
    """Checks the parameters of a user's function: real numbers, booleans, integers or random keys.

    A function may use booleans and integers as flags, masks and indices.

    Args:
        owner: the class or function that takes the parameters, for error messages.
        params: the parameters.
        finite: True to refuse infinity; NaN is always refused.

    Raises:
        ValueError: a leaf is of another kind, is NaN, or is infinite.
    """
    for path, x in jax.tree_util.tree_leaves_with_path(params):
        if not is_discrete(x):
            at = jax.tree_util.keystr(path, simple=True, separator="/")
            check(owner, f"params '{at}'" if at else "params", x, finite=finite)


def is_discrete(x: object) -> bool:
    """Returns True if x is a boolean, or an array of integers, of booleans or of random keys."""
    if isinstance(x, bool):
        return True
    if not isinstance(x, jax.Array | np.ndarray | np.generic):
        return False
    # NumPy counts timedelta64 as an integer; keys have a dtype without `kind`
    kind = getattr(x.dtype, "kind", "")
    return kind in ("b", "i", "u") or jnp.issubdtype(x.dtype, jax.dtypes.extended)


def is_floating(x: PyTree) -> bool:
    """Returns True if x is a float or a floating array, and False for any other object."""
    return isinstance(x, float) or jnp.issubdtype(getattr(x, "dtype", bool), jnp.floating)


def chosen_dtype(*trees: PyTree) -> np.dtype:
    """Returns the dtype of the first floating JAX array in trees, or JAX's default dtype.

    NumPy arrays and Python numbers do not affect the result.
    """
    dtypes = (x.dtype for x in jax.tree.leaves(trees) if isinstance(x, jax.Array))
    return next((x for x in dtypes if jnp.issubdtype(x, jnp.floating)), jnp.result_type(float))


def plain_zero(x: PyTree) -> bool:
    """Returns True if x is the Python number 0; callers then leave out terms with the factor x."""
    return isinstance(x, int | float) and not isinstance(x, bool) and x == 0


def real(
    owner: str,
    what: str,
    x: PyTree,
    dtype: DType,
    shape: tuple[int, ...] = (),
    **limits: Unpack[NumberRange],
) -> Array:
    """Checks a value of the user, and returns it as a real array of the scene's dtype.

    Args:
        owner: the class or function that takes the value, for error messages.
        what: the name of the argument, for error messages.
        x: the user's value.
        dtype: the dtype of the scene.
        shape: the required shape.
        limits: bounds on the value; see `check`.

    Raises:
        ValueError: x is not real, has another shape, is a JAX array of another floating dtype, or
            has a concrete value out of range.
    """
    # weakly typed arrays come from Python numbers, which choose no dtype
    typed = x if isinstance(x, jax.Array) and not x.aval.weak_type else None
    if typed is not None and jnp.issubdtype(typed.dtype, jnp.floating) and typed.dtype != dtype:
        raise ValueError(
            f"{owner}: {what} is {typed.dtype}, but the scene is {jnp.dtype(dtype).name};"
            " mixed dtypes are not promoted: convert it, or build the scene with dtype=."
        )
    return jnp.asarray(check(owner, what, x, shape, dtype=dtype, **limits), dtype)


def check(
    owner: str,
    what: str,
    x: PyTree,
    shape: tuple[int, ...] | None = None,
    *,
    dtype: DType | None = None,
    above: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
    finite: bool = True,
    optional: bool = False,
) -> Any:
    """Checks that x is a real number or array of a given shape and, if concrete, within bounds.

    Args:
        owner: the class or function that takes the value, for error messages.
        what: the name of the argument, for error messages.
        x: the user's value.
        shape: the required shape; None for any shape.
        dtype: a dtype whose range must contain the numbers; None for no such limit.
        above: an exclusive lower bound.
        least: an inclusive lower bound.
        most: an inclusive upper bound.
        finite: True to refuse infinity; NaN is always refused.
        optional: True to allow None.

    Returns:
        The numbers as an array; a JAX array or None is returned unchanged.

    Raises:
        ValueError: x is not real, has another shape, or has a value out of range.
    """
    if x is None and optional:
        return None
    array = numbers(owner, what, x, "a real number" if shape == () else "real numbers")
    batched = _constructing.get() and hasattr(x, "shape")
    if shape is not None and array.shape != shape and not batched:
        raise ValueError(f"{owner}: {what} must have shape {shape}, got {array.shape}.")
    if isinstance(array, jax.Array) and not is_concrete(array):
        return array
    given = values = np.asarray(array, float)
    if dtype is not None:
        with np.errstate(over="ignore"):
            values = given.astype(dtype)
        overflow = np.isinf(values) & ~np.isinf(given)
        if np.any(overflow):
            raise ValueError(
                f"{owner}: {what} must be in the range of {jnp.dtype(dtype).name}, got"
                f" {_shown(given, ~overflow)}."
            )
    good = (values > above) | (above == -np.inf)
    good &= (values >= least) & (values <= most) & (np.isfinite(values) | (not finite))
    if not np.all(good):
        wanted = _limits(above, least, most, finite)
        raise ValueError(f"{owner}: {what} must {wanted}, got {_shown(values, good)}.")
    return array


def _limits(above: float, least: float, most: float, finite: bool) -> str:
    """Describes the range that the bounds of `check` allow, in words, for error messages."""
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


def numbers(owner: str, what: str, x: PyTree, wanted: str = "real numbers") -> Any:
    """Converts a value of the user to an array of real numbers.

    The result is a JAX array if x is or contains a JAX array, otherwise a NumPy array. Values are
    not read, so NaN and infinity pass.

    Args:
        owner: the class or function that takes the value, for error messages.
        what: the name of the argument, for error messages.
        x: the user's value.
        wanted: the expected kind of value in words, for error messages.

    Raises:
        ValueError: x is not real, or is a ragged list.
    """
    if isinstance(x, jax.Array):
        array = x
    elif type(x) is float:
        return np.asarray(x)
    elif type(x) is np.ndarray and x.dtype.kind in "fiu":
        return x
    else:
        array = _from_host(owner, what, x, wanted)
    # tests dtype.kind, since NumPy counts timedelta64 as an integer; bfloat16 has an unusual kind
    kind = getattr(array.dtype, "kind", "?")
    if kind not in "fiu" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"{owner}: {what} must be {wanted}, got {shortened(x)}.")
    return array


def _from_host(owner: str, what: str, x: PyTree, wanted: str) -> Any:
    """Converts a list, NumPy array or Python number to an array.

    The result is a JAX array if a list contains one, otherwise a NumPy array.

    Raises:
        ValueError: x is not numeric, is ragged, or exceeds the range of floats.
    """
    leaves = jax.tree.leaves(x) if isinstance(x, list | tuple) else [x]
    wrong = next((y for y in leaves if isinstance(y, bool | np.bool_)), None)
    if x is None or wrong is not None:
        raise ValueError(f"{owner}: {what} must be {wanted}, got {shortened(x)}.")
    try:
        if any(isinstance(y, jax.Array) for y in leaves) or hasattr(x, "__jax_array__"):
            return jnp.asarray(x)
        if isinstance(x, np.ma.MaskedArray):
            x = np.ma.filled(x.astype(float), np.nan)
        with warnings.catch_warnings():  # older versions of NumPy only warn about ragged lists
            warnings.simplefilter("error")
            array = np.asarray(x)
        integers = array.dtype == object and all(type(y) is int for y in array.ravel())
        return array.astype(float) if integers else array  # Python integers beyond 64 bits
    except OverflowError as error:
        raise ValueError(
            f"{owner}: {what} is beyond the range of floating numbers, got {shortened(x)}."
        ) from error
    except (TypeError, ValueError, Warning) as error:
        raise ValueError(
            f"{owner}: {what} must be real numbers of one shape, got {shortened(x)}."
        ) from error


def components(owner: str, **given: tuple[Any, tuple[int, ...]]) -> list[Any]:
    """Converts arguments to floating arrays, checking the sizes of their first axes.

    Values are not read, so traced arrays are accepted.

    Args:
        owner: the function that takes the arguments, for error messages.
        given: by argument name, a pair: the value, and the required sizes of its first axes.

    Raises:
        ValueError: a value is not real, has other sizes, or the further axes of the arguments do
            not broadcast against each other.
    """
    arrays = []
    for what, (x, sizes) in given.items():
        array = numbers(owner, what, x)
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
    """Returns the repr of a value, cut to `LONG` characters, for messages."""
    try:
        text = repr(x)
    except Exception:  # an integer with too many digits, or a user's object with a faulty repr
        return f"a value of type {type(x).__name__}"
    return clipped(text)


def clipped(text: str) -> str:
    """Cuts a text after `LONG` characters, and marks the cut by an ellipsis."""
    return text if len(text) <= LONG else f"{text[:LONG]}…"


def numerals(x: Any) -> str:
    """Formats numbers with seven digits, for messages; this hides the rounding noise of float32.

    Args:
        x: an array, nested lists or a number.
    """
    if np.ndim(x):
        return f"[{', '.join(map(numerals, x))}]"
    text = f"{float(x):.7g}"
    return f"{text}.0" if text.lstrip("-").isdigit() else text


def _shown(values: np.ndarray, good: np.ndarray) -> str:
    """Formats an array for error messages: all of it, or only its first invalid entry.

    Arrays of more than `FEW` entries are not shown as a whole.

    Args:
        values: the array.
        good: a mask of the valid entries.
    """
    if values.size <= FEW:
        return numerals(values)
    place = tuple(int(i) for i in np.argwhere(~good)[0])
    return f"{numerals(values[place])} at {list(place)} of an array {values.shape}"


def count(
    owner: str, what: str, x: PyTree | SupportsIndex, least: int = 1, most: int = 2**31 - 1
) -> None:
    """Checks that a value is an integer from `least` to `most`.

    Raises:
        ValueError: the value is no integer, or out of range.
    """
    if not isinstance(x, int | np.integer) or isinstance(x, bool | np.timedelta64) or x < least:
        raise ValueError(
            f"{owner}: {what} must be a whole number from {least}, got {shortened(x)}."
        )
    if x > most:
        raise ValueError(f"{owner}: {what} must be at most {most}, got {shortened(x)}.")


def flag(owner: str, what: str, x: PyTree) -> None:
    """Checks that a value is True or False.

    Raises:
        ValueError: the value is no bool.
    """
    if not isinstance(x, bool):
        raise ValueError(f"{owner}: {what} must be True or False, got {shortened(x)}.")


def nonzero(owner: str, what: str, x: PyTree, dtype: DType | None = None) -> None:
    """Checks that a number or vector is finite and not zero, in a floating-point dtype.

    A vector is to be divided by its length. Its squared length must therefore not overflow. XLA
    replaces subnormal squares by zero, so they must not matter in the squared length either.

    Args:
        owner: the class or function that takes the value, for error messages.
        what: the name of the argument, for error messages.
        x: the value.
        dtype: the dtype; None for that of a floating array, and float64 for other values.

    Raises:
        ValueError: the value is zero, not finite or not numeric.
    """
    values = numbers(owner, what, x)
    if is_concrete(values):
        values = np.asarray(values)
        if dtype is None:
            dtype = values.dtype if values.dtype.kind == "f" else np.dtype(float)
        values = values.astype(dtype)
        with np.errstate(over="ignore", under="ignore"):
            square = np.sum(values * values)
        least = np.finfo(dtype).tiny / np.finfo(dtype).eps
        good = least <= square < np.inf if values.ndim else values != 0
        if not (good and np.all(np.isfinite(values))):
            wanted = "have a length" if values.ndim else "be finite and not zero"
            if np.isinf(square) and np.all(np.isfinite(values)):
                wanted = f"have a length whose square is in the range of {values.dtype.name}"
            raise ValueError(f"{owner}: {what} must {wanted}, got {numerals(values)}.")


def radians(owner: str, what: str, x: Scalar) -> None:
    """Warns if an angle exceeds a full turn, because it is probably given in degrees.

    Args:
        owner: the class or function that takes the angle, for the message.
        what: the name of the argument, for the message.
        x: the angle, () [rad]; infinity gives no warning.
    """
    if is_concrete(x) and TURN < abs(float(x)) < np.inf:
        warnings.warn(
            f"{owner}: {what} is {float(x):g} rad, more than a turn; give radians, of degrees"
            " np.deg2rad(…). Filter this warning where whole turns are meant.",
            stacklevel=2,
        )


def recorded(owner: str, what: str, x: Scalar) -> Any:
    """Checks that recorded data of the user are real; returns them with NaN for masked entries.

    Raises:
        ValueError: the data are not real.
    """
    kind = x.dtype if isinstance(x, jax.Array) else np.asarray(x).dtype
    if getattr(kind, "kind", "?") not in "fiu" and not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(
            f"{owner}: {what} must be real numbers, NaN where nothing was seen, got {kind}."
        )
    if not isinstance(x, np.ma.MaskedArray):
        return x
    return np.ma.filled(x.astype(kind if kind.kind == "f" else float), np.nan)


def takes(
    owner: str, what: str, function: Callable[..., Any], given: tuple[str, ...], why: str = ""
) -> None:
    """Checks that a user's function accepts as many positional arguments as a call will pass.

    Args:
        owner: the function that takes the user's function, for error messages.
        what: the name of the argument, for error messages.
        function: the user's function.
        given: the names of the arguments that the call passes, for error messages.
        why: the reason why the call passes these arguments, for error messages.

    Raises:
        TypeError: `function` is no function, or does not accept these arguments.
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
    """Describes the arrays of a tree by name and shape, for messages."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    if [path for path, _ in leaves] == [()]:
        return f"an array {jnp.shape(leaves[0][1])}"
    shapes = {jax.tree_util.keystr(path, simple=True, separator="/"): x for path, x in leaves}
    return ", ".join(f"{name} {jnp.shape(x)}" for name, x in shapes.items()) or "nothing"


def fits(shape: tuple[int, ...], into: tuple[int, ...]) -> bool:
    """Returns True if an array of shape `shape` can be broadcast to exactly the shape `into`."""
    pairs = zip(reversed(shape), reversed(into), strict=False)
    return len(shape) <= len(into) and all(n in (1, m) for n, m in pairs)
