"""Gains by constraint, by group of constraints and by row; sums over the rows of constraints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import TypeAlias, TypedDict

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows, layout_of
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, total
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.typing import Array, Scalar
from jaxcon.protocols import System

Gain: TypeAlias = Scalar | Mapping[str, Scalar]
"""A gain as the user gives it: a number, an array by row (n_c,), or numbers by constraint name."""


class Limits(TypedDict, total=False):
    """The valid range of a number, as keyword arguments of `checks.check`."""

    least: float
    above: float
    most: float
    optional: bool


def by_row(
    gain: Gain | None, fallback: Scalar | None, rows: Rows, owner: str = "Baumgarte"
) -> Array:
    """Returns a gain by row, (n_c,), or (1,) if all rows share it. Infinite gains become NaN.

    Args:
        gain: a number, an array by row, or a mapping to numbers. Its keys are names of constraints,
            or shell patterns such as "leg*" for a group of constraints.
        fallback: the gain of constraints that are not in the mapping.
        rows: the linearized constraints.
        owner: the name of the class with the gain, for error messages.

    Raises:
        ValueError: a name is unknown, a pattern matches nothing, two patterns match one constraint,
            or an array has another size.
    """
    dtype, worlds = rows.bias.dtype, rows.bias.ndim - 1
    if isinstance(gain, Mapping):
        default = jnp.asarray(fallback, dtype)
        result = default.reshape(1, *(default.shape or (1,) * worlds))
        for key, names in keyed(gain, rows.layout.names, owner).items():
            chosen = column(rows_of(rows.layout, names), rows)
            result = jnp.where(chosen, jnp.asarray(gain[key], dtype)[None], result)
        return finite_or_nan(result)
    array = jnp.asarray(gain, dtype)
    if array.ndim == worlds:
        return finite_or_nan(array[None])
    if array.ndim != worlds + 1 or array.shape[0] != rows.bias.shape[0]:
        raise ValueError(
            f"{owner}: a gain must be a number, an array {rows.bias.shape[:1]} by row, or a"
            f" mapping by constraint name; got shape {array.shape[: array.ndim - worlds]}."
        )
    return finite_or_nan(array)


def keyed(keys: Iterable[str], names: tuple[str, ...], owner: str) -> dict[str, list[str]]:
    """Returns the constraints that each key matches. An exact name takes precedence over patterns.

    Args:
        keys: names of constraints or shell patterns.
        names: names of all constraints.
        owner: the name of the class with the keys, for error messages.

    Raises:
        ValueError: a key matches nothing, or two patterns match one constraint.
    """
    keys = sorted(keys)
    matches = {key: [x for x in names if x == key or fnmatchcase(x, key)] for key in keys}
    if unknown := [key for key in keys if not matches[key]]:
        raise ValueError(f"{owner}: there is no constraint {unknown}; there are {list(names)}.")
    chosen = {key: [x for x in matches[key] if x == key or x not in keys] for key in keys}
    for name in names:
        patterns = [key for key in keys if name in chosen[key]]
        if len(patterns) > 1:
            raise ValueError(
                f"{owner}: constraint '{name}' has a gain by each of the patterns {patterns}; name"
                " it itself, which outranks patterns."
            )
    return chosen


def rows_of(layout: RowLayout, names: Iterable[str]) -> np.ndarray:
    """Returns a mask of the rows of the named constraints, (n_c,)."""
    chosen = np.zeros(layout.size, bool)
    for name in names:
        chosen[layout.rows(name)] = True
    return chosen


def named(gain: Gain | None, layout: RowLayout, owner: str) -> np.ndarray:
    """Returns a mask of the rows that a gain applies to, (n_c,).

    A mapping applies to the constraints that it names. Any other gain applies to all rows except
    those of rotors.
    """
    if not isinstance(gain, Mapping):
        return layout.holds
    matches = keyed(gain, layout.names, owner).values()
    return rows_of(layout, (name for names in matches for name in names))


def column(mask: np.ndarray, rows: Rows) -> np.ndarray:
    """Returns a mask of rows, (n_c,), with an axis of size 1 appended for each batch axis."""
    return mask.reshape(-1, *(1,) * (rows.bias.ndim - 1))


def zeros_by_row(system: System, q: Array, v: Array) -> Array:
    """Returns zeros, one for each equality row of a system, (n_c,)."""
    return jnp.zeros(layout_of(system, q, v, jnp.zeros((), q.dtype)).size, q.dtype)


def sums(x: Array, layout: RowLayout) -> Array:
    """Returns, for each row, the sum of x over all rows of its constraint, (n_c,)."""
    lanes: list[Array] = []
    place = 0
    while place < len(layout.entries):
        _, first, rows, elements = layout.entries[place]
        lanes += [total(Vector.of_rows(x, first, rows, elements))] * rows
        place += elements
    return jnp.concatenate(lanes) if lanes else x


def squares(x: Array, layout: RowLayout) -> Array:
    """Returns, for each row, the sum of x² over all rows of its constraint, (n_c,).

    The result is smooth at x = 0.
    """
    return sums(x * x, layout)


def check_gains(
    owner: str, limits: Limits | None = None, optional: bool = True, **gains: Gain | None
) -> None:
    """Checks that gains are finite and in range. Traced gains are not checked.

    Args:
        owner: the name of the class with the gains, for error messages.
        limits: the valid range; None for non-negative numbers.
        optional: True if a gain may be None.
        gains: the gains by name; each is a number, an array by row, or a mapping by constraint.

    Raises:
        ValueError: a gain is out of range, or not a number.
    """
    limits = {"least": 0} if limits is None else limits
    for what, gain in gains.items():
        if isinstance(gain, Mapping):
            for name, value in gain.items():
                if not isinstance(name, str):
                    raise ValueError(
                        f"{owner}: {what} by constraint wants names as its keys, got {name!r}."
                    )
                checks.check(owner, f"{what} of '{name}'", value, (), **limits)
        elif gain is not None or not optional:
            checks.check(owner, what, gain, **limits)


def check_numbers(part: checks.Checked, **limits: Limits) -> None:
    """Checks that fields of a dataclass are numbers in their valid range.

    Args:
        part: a dataclass, such as a stabilizer.
        limits: the valid range of each field, by its name.

    Raises:
        ValueError: a field is out of range, or not a number.
    """
    for field, limit in limits.items():
        checks.check(type(part).__name__, field, getattr(part, field), (), **limit)
