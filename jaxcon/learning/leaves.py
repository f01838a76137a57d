"""Named leaves of a pytree, and the search coordinates of parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree, Scalar

T = TypeVar("T")

Pair: TypeAlias = tuple[Scalar | None, Scalar | None]
"""The bounds (low, high) of a leaf; None stands for no bound."""
Bounds: TypeAlias = Pair | Mapping[str, Pair] | None
"""The bounds of all leaves, or a mapping from names to bounds; None for no bounds."""


@pytree
class Space:
    """The map between parameters x and search coordinates y, with bounds on x.

    y = log x for positive leaves, and y = x for the others. Leaves without floating-point numbers
    are constant.

    Attributes:
        fixed: for each leaf its value if it is constant, or None if it is searched.
        low: lower bounds of the searched leaves, in their shapes.
        high: upper bounds of the searched leaves, in their shapes.
        structure: tree structure of the parameters.
        names: names of the searched leaves.
        positive: for each searched leaf, True if it must stay positive.
    """

    fixed: tuple[Scalar | None, ...]
    low: tuple[Array, ...]
    high: tuple[Array, ...]
    structure: Any = static()
    names: tuple[str, ...] = static()
    positive: tuple[bool, ...] = static()

    def encode(self, params: PyTree) -> tuple[Array, ...]:
        """Converts parameters to search coordinates y."""
        leaves = zip(jax.tree.leaves(params), self.fixed, strict=True)
        # an explicit dtype, so that the arrays are not weakly typed
        free = [jnp.asarray(x, jnp.result_type(x)) for x, f in leaves if f is None]
        return tuple(jnp.log(x) if p else x for x, p in zip(free, self.positive, strict=True))

    def decode(self, y: tuple[Array, ...]) -> Any:
        """Converts y to parameters, clipped to their bounds since exp may round beyond a bound."""
        x = [jnp.exp(z) if p else z for z, p in zip(y, self.positive, strict=True)]
        inside = map(jnp.clip, x, self.low, self.high)
        # straight-through estimator: at a bound, the derivative of clip would be zero
        pairs = zip(x, inside, strict=True)
        return self.fill(
            jnp.where(jnp.isinf(z), c, z + jax.lax.stop_gradient(c - z)) for z, c in pairs
        )

    def fill(self, leaves: Iterable[Array]) -> Any:
        """Returns the tree of parameters, made of the searched `leaves` and the constant leaves."""
        free = iter(leaves)
        whole = [next(free) if f is None else f for f in self.fixed]
        return jax.tree.unflatten(self.structure, whole)

    def flatten(self, y: Iterable[Array]) -> Array:
        """Concatenates all numbers of y to one array, (n,)."""
        return jnp.concatenate([jnp.ravel(z) for z in y])

    @property
    def logarithms(self) -> np.ndarray:
        """The mask of the numbers in y that are logarithms, (n,)."""
        return np.repeat(self.positive, [x.size for x in self.low])

    def split(self, flat: Array) -> tuple[Array, ...]:
        """Splits an array of all numbers (n,) into y; inverse of `flatten`."""
        ends = np.cumsum([x.size for x in self.low])[:-1]
        return tuple(
            z.reshape(x.shape).astype(x.dtype)
            for z, x in zip(jnp.split(flat, ends), self.low, strict=True)
        )

    def clip(self, y: tuple[Array, ...]) -> tuple[Array, ...]:
        """Clips search coordinates y to their bounds."""
        limits = zip(y, *self.limits, strict=True)
        return tuple(jnp.clip(z, low, high) for z, low, high in limits)

    def free(self, y: tuple[Array, ...], slope: tuple[Array, ...]) -> Array:
        """Returns the mask of numbers in y that a descent step does not push out of bounds, (n,).

        Args:
            y: search coordinates.
            slope: gradient of the loss by y; the step is along −slope.
        """
        sides = zip(y, slope, *self.limits, strict=True)
        return jnp.concatenate(
            [jnp.ravel(jnp.where(g > 0, z > low, z < high) | (g == 0)) for z, g, low, high in sides]
        )

    @property
    def limits(self) -> tuple[list[Array], list[Array]]:
        """The lower and the upper bounds of y."""
        maps = [jnp.log if p else jnp.asarray for p in self.positive]
        low = [f(x) for f, x in zip(maps, self.low, strict=True)]
        return low, [f(x) for f, x in zip(maps, self.high, strict=True)]


def flat(y: T) -> tuple[Array, Callable[[Array], T]]:
    """Returns the leaves of a tree as one array in the widest dtype, and the inverse function."""
    with jax.numpy_dtype_promotion("standard"):  # leaves may have several precisions
        return ravel_pytree(y)


def space_of(params: PyTree, positive: PyTree, bounds: Bounds, owner: str) -> Space:
    """Checks initial parameters, and returns the map to their search coordinates.

    Args:
        params: the initial parameters.
        positive: leaves that must stay positive: True for all, one or several names, or a pytree of
            bools.
        bounds: None, a pair (low, high) for all leaves, or a mapping from names to pairs.
        owner: name of the caller, for error messages.

    Raises:
        ValueError: a name is unknown, no leaf can be searched, or a parameter is not finite, not
            positive or out of bounds.
        TypeError: the parameters are traced.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(params)
    names = [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in paths]
    leaves = [x for _, x in paths]
    for name, times in Counter(names).items():
        if times > 1:
            raise ValueError(f"{owner}: {times} leaves of the parameters are named '{name}'.")
    if not checks.is_concrete(leaves):
        raise TypeError(
            f"{owner}: the parameters are traced; {owner} is host code around a program of its own."
            " Call it outside of jit, vmap and grad, and map over worlds in the loss."
        )
    _check_numbers(names, leaves, owner)
    free = [is_searched(x) for x in leaves]
    if not any(free):
        raise ValueError(f"{owner}: there is no floating number among the parameters {names}.")
    logs = _flags(positive, params, names, owner)
    pairs = bounds if isinstance(bounds, Mapping) or bounds is None else {"*": bounds}
    limits = by_name(pairs or {}, names, (None, None), f"{owner}: bounds")
    searched = [i for i in range(len(names)) if free[i]]
    ends = [_limits(names[i], limits[i], leaves[i], logs[i], owner) for i in searched]
    fixed = tuple(None if f else x for f, x in zip(free, leaves, strict=True))
    low, high = zip(*ends, strict=True)
    names = [names[i] for i in searched]
    return Space(fixed, low, high, structure, tuple(names), tuple(logs[i] for i in searched))


def _check_numbers(names: list[str], leaves: list[PyTree], owner: str) -> None:
    """Checks that all leaves are numbers other than Python or NumPy integers.

    A user who writes an integer probably means a float. Integer arrays of JAX are allowed, since
    larger trees contain them, such as the status of a state.

    Raises:
        ValueError: a leaf is not a number, or is a Python or NumPy integer.
    """
    for name, x in zip(names, leaves, strict=True):
        what = f"'{name}'" if name else "the parameter"
        if not isinstance(x, complex | int | float | np.generic | np.ndarray | jax.Array):
            raise ValueError(
                f"{owner}: {what} is {x!r} and no number; leave it out of the parameters, and"
                " close over it."
            )
        written = isinstance(x, int | np.integer | np.ndarray) and not isinstance(x, bool)
        if written and jnp.issubdtype(jnp.result_type(x), jnp.integer):
            raise ValueError(
                f"{owner}: {what} is a whole number, {x!r}, along which there is no derivative;"
                " write it as a float to have it searched, or leave it out of the parameters."
            )


def is_searched(leaf: PyTree) -> bool:
    """Returns True if a leaf has floating-point numbers."""
    return checks.is_floating(leaf)


def by_name(values: Mapping[str, T], names: Iterable[str], default: T, owner: str) -> list[T]:
    """Looks up a value for each leaf by its name.

    A key matches a name if it is the name itself ("stabilizer/alpha"), the first part of the name
    ("stabilizer"), or a shell pattern ("*/mass"). The name itself takes precedence.

    Args:
        values: values by key.
        names: names of leaves.
        default: value for leaves without a matching key.
        owner: name of the caller, for error messages.

    Raises:
        ValueError: a key matches no name, or several keys match one name.
    """
    names = list(names)
    for key in values:
        if not isinstance(key, str) or not any(_stands_for(key, name) for name in names):
            raise ValueError(f"{owner}: there is no leaf '{key}'; there are {names}.")
    result = []
    for name in names:
        keys = [name] if name in values else [key for key in values if _stands_for(key, name)]
        if len(keys) > 1:
            raise ValueError(f"{owner}: '{name}' is meant by each of {keys}; name it itself.")
        result.append(values[keys[0]] if keys else default)
    return result


def _stands_for(key: str, name: str) -> bool:
    """Returns True if a key matches the name of a leaf; see `by_name`."""
    return key == name or name.startswith(key + "/") or fnmatchcase(name, key)


def _flags(positive: PyTree, params: PyTree, names: list[str], owner: str) -> list[bool]:
    """Returns for each leaf True if it must stay positive.

    Raises:
        ValueError: `positive` has other values than bools and names, or another structure.
    """
    chosen = jax.tree.leaves(positive)
    if all(isinstance(x, str) for x in chosen):
        return by_name(dict.fromkeys(chosen, True), names, False, f"{owner}: positive")
    if not all(isinstance(x, bool | np.bool_) for x in chosen):
        raise ValueError(f"{owner}: positive must be bools or names of leaves, got {positive!r}.")
    try:
        return [bool(x) for x in jax.tree.leaves(jax.tree.broadcast(positive, params))]
    except ValueError as error:
        raise ValueError(
            f"{owner}: positive must have the structure of the parameters, or of their first"
            f" levels, got {positive!r} for {names}; or give names of leaves."
        ) from error


def _limits(name: str, pair: Pair, leaf: Scalar, log: bool, owner: str) -> tuple[Array, Array]:
    """Checks the bounds of a leaf, and returns them in the leaf's shape.

    Args:
        name: name of the leaf.
        pair: the user's bounds (low, high).
        leaf: the initial value of the leaf.
        log: True if the leaf must stay positive, so that its logarithm is searched.
        owner: name of the caller, for error messages.

    Raises:
        ValueError: the bounds are not a pair of numbers, or the initial value is not within them.
    """
    what = f"{owner}: '{name}'" if name else f"{owner}: the parameter"
    start = jnp.asarray(leaf)
    if not np.all(np.isfinite(start)):
        raise ValueError(f"{what} must be finite at the start, got {checks.numerals(start)}.")
    if log and not np.all(np.asarray(start) >= jnp.finfo(start.dtype).tiny):
        raise ValueError(
            f"{what} is to stay positive and must start so, got {checks.numerals(start)}."
        )
    try:
        low, high = pair
        ends = -jnp.inf if low is None else low, jnp.inf if high is None else high
        ends = (checks.check(what, "bounds", x, finite=False) for x in ends)
        low, high = (jnp.broadcast_to(jnp.asarray(x, start.dtype), start.shape) for x in ends)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{what} needs bounds (low, high), numbers or arrays {start.shape}, got {pair!r}."
        ) from error
    if log:  # beyond these bounds exp may round to zero or to infinity
        limits = jnp.finfo(start.dtype)
        low = jnp.maximum(low, limits.tiny)
        high = jnp.minimum(high, jnp.maximum(start, limits.max / 2))
    if not np.all(np.asarray(low) <= np.asarray(high)):
        raise ValueError(f"{what} needs bounds (low, high) with low ≤ high, got {pair!r}.")
    if not np.all((np.asarray(low) <= start) & (start <= np.asarray(high))):
        raise ValueError(
            f"{what} must start within its bounds {checks.numerals(low)} to"
            f" {checks.numerals(high)}, got {checks.numerals(start)}."
        )
    return low, high
