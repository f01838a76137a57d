"""Leaves of a pytree by name, and the coordinates in which they are searched."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree


@pytree
class Space:
    """y ↔ parameters x: y = log x of positive leaves and y = x of others, low ≤ x ≤ high.

    Leaves that are no floating numbers are kept as they are.

    Attributes:
        fixed: leaves that are not searched, None for those that are.
        low: of each leaf that is searched, in its shape.
        high: the same.
        structure: of the parameters.
        names: of the leaves that are searched.
        positive: whether each of them is.
    """

    fixed: tuple[Any, ...]
    low: tuple[Array, ...]
    high: tuple[Array, ...]
    structure: Any = static()
    names: tuple[str, ...] = static()
    positive: tuple[bool, ...] = static()

    def encode(self, params: PyTree) -> tuple[Array, ...]:
        """y of parameters."""
        leaves = jax.tree.leaves(params)
        found = [x for x, f in zip(leaves, self.fixed, strict=True) if f is None]
        free = [jnp.asarray(x, jnp.result_type(x)) for x in found]  # of no weak type
        return tuple(jnp.log(x) if p else x for x, p in zip(free, self.positive, strict=True))

    def decode(self, y: tuple[Array, ...]) -> PyTree:
        """Parameters of y, which lies within the bounds: what exp rounds beyond one is put back."""
        x = [jnp.exp(z) if p else z for z, p in zip(y, self.positive, strict=True)]
        inside = map(jnp.clip, x, self.low, self.high)
        # a clip has no derivative at the bound itself, where a search must be able to turn back
        pairs = zip(x, inside, strict=True)
        return self.fill(
            jnp.where(jnp.isinf(z), c, z + jax.lax.stop_gradient(c - z)) for z, c in pairs
        )

    def fill(self, leaves: Iterable[Any]) -> PyTree:
        """These in the place of the leaves that are searched."""
        free = iter(leaves)
        whole = [next(free) if f is None else f for f in self.fixed]
        return jax.tree.unflatten(self.structure, whole)

    def flatten(self, y: Iterable[Array]) -> Array:
        """All numbers of y in one array."""
        return jnp.concatenate([jnp.ravel(z) for z in y])

    @property
    def logarithms(self) -> np.ndarray:
        """Which of all numbers of y are logarithms."""
        return np.repeat(self.positive, [x.size for x in self.low])

    def split(self, flat: Array) -> tuple[Array, ...]:
        """y of all its numbers."""
        ends = np.cumsum([x.size for x in self.low])[:-1]
        return tuple(
            z.reshape(x.shape).astype(x.dtype)
            for z, x in zip(jnp.split(flat, ends), self.low, strict=True)
        )

    def clip(self, y: tuple[Array, ...]) -> tuple[Array, ...]:
        """The nearest y within the bounds."""
        limits = zip(y, *self.limits, strict=True)
        return tuple(jnp.clip(z, low, high) for z, low, high in limits)

    def free(self, y: tuple[Array, ...], slope: tuple[Array, ...]) -> Array:
        """A mask of the numbers of y that may follow −slope: on a bound, only back inside, (n,)."""
        sides = zip(y, slope, *self.limits, strict=True)
        return jnp.concatenate(
            [jnp.ravel(jnp.where(g > 0, z > low, z < high) | (g == 0)) for z, g, low, high in sides]
        )

    @property
    def limits(self) -> tuple[list[Array], list[Array]]:
        """The bounds of y."""
        log = [jnp.log if p else jnp.asarray for p in self.positive]
        ends = (self.low, self.high)
        low, high = ([f(x) for f, x in zip(log, end, strict=True)] for end in ends)
        return low, high


def flat(y: PyTree) -> tuple[Array, Any]:
    """All numbers of a tree in one array of the widest dtype, and what restores the tree."""
    with jax.numpy_dtype_promotion("standard"):  # leaves may have several precisions
        return ravel_pytree(y)


def space_of(params: PyTree, positive: Any, bounds: Any, owner: str) -> Space:
    """The coordinates of parameters, checked at the start.

    Args:
        params: the start.
        positive: True, a name or names of leaves, or a pytree of bools like the parameters.
        bounds: None, a pair (low, high), or a mapping from names to pairs.
        owner: for errors.

    Raises:
        ValueError: an unknown name, nothing to search, or a start that is not positive, not finite
            or out of its bounds.
        TypeError: they are traced.
    """
    found, structure = jax.tree_util.tree_flatten_with_path(params)
    names = [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in found]
    leaves = [x for _, x in found]
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
    own = tuple(names[i] for i in searched)
    return Space(fixed, low, high, structure, own, tuple(logs[i] for i in searched))


def _check_numbers(names: list[str], leaves: list[Any], owner: str) -> None:
    """Checks that there are numbers, and no whole one was written where a real one is meant.

    Those that JAX holds, such as the status of a state, are parts of trees that nobody wrote.

    Raises:
        ValueError: there is something else.
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


def is_searched(leaf: Any) -> bool:
    """True if a leaf has floating numbers."""
    return checks.is_floating(leaf)


def by_name(values: Mapping[str, Any], names: Iterable[str], default: Any, owner: str) -> list[Any]:
    """For each name the value of the key that stands for it.

    A key is a name, such as "stabilizer/alpha"; the first part of names, "stabilizer"; or a shell
    pattern, "*/mass". A name itself outranks the others.

    Raises:
        ValueError: a key stands for nothing, or two for one name.
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
    return key == name or name.startswith(key + "/") or fnmatchcase(name, key)


def _flags(positive: Any, params: PyTree, names: list[str], owner: str) -> list[bool]:
    """The flag of each leaf: True if it is positive."""
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


def _limits(name: str, pair: Any, start: Any, log: bool, owner: str) -> tuple[Array, Array]:
    """The bounds of a leaf in its shape.

    Raises:
        ValueError: no pair of numbers, or a start beyond them.
    """
    what = f"{owner}: '{name}'" if name else f"{owner}: the parameter"
    start = jnp.asarray(start)
    if not np.all(np.isfinite(start)):
        raise ValueError(f"{what} must be finite at the start, got {checks.numerals(start)}.")
    if log and not np.all(np.asarray(start) >= jnp.finfo(start.dtype).tiny):
        raise ValueError(
            f"{what} is to stay positive and must start so, got {checks.numerals(start)}."
        )
    try:
        low, high = pair
        ends = -jnp.inf if low is None else low, jnp.inf if high is None else high
        low, high = (jnp.broadcast_to(jnp.asarray(x, start.dtype), start.shape) for x in ends)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{what} needs bounds (low, high), numbers or arrays {start.shape}, got {pair!r}."
        ) from error
    if log:  # beyond these exp may round to zero, or to infinity
        known = jnp.finfo(start.dtype)
        low = jnp.maximum(low, known.tiny)
        high = jnp.minimum(high, jnp.maximum(start, known.max / 2))
    if not np.all(np.asarray(low) <= np.asarray(high)):
        raise ValueError(f"{what} needs bounds (low, high) with low ≤ high, got {pair!r}.")
    if not np.all((np.asarray(low) <= start) & (start <= np.asarray(high))):
        raise ValueError(
            f"{what} must start within its bounds {checks.numerals(low)} to"
            f" {checks.numerals(high)}, got {checks.numerals(start)}."
        )
    return low, high
