"""Gains by constraint, by group of constraints and by row, and violations by constraint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, total
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.typing import Array


def by_row(gain: Any, fallback: Any, rows: Rows, owner: str = "Baumgarte") -> Array:
    """A gain as an array by row, (n_c,), or (1,) where all rows share it; NaN for an infinite one.

    Args:
        gain: a number, an array by row, or a mapping from names of constraints, or from shell
            patterns such as "leg*" that name a group of them, to numbers.
        fallback: of the constraints that a mapping leaves out.
        rows: the constraints.
        owner: whose gain it is, for errors.

    Raises:
        ValueError: an unknown name, a pattern that names nothing, two patterns for one constraint,
            or an array of another size.
    """
    dtype = rows.bias.dtype
    if isinstance(gain, Mapping):
        return finite_or_nan(_from_names(gain, jnp.asarray(fallback, dtype), rows, owner))
    gain = jnp.asarray(gain, dtype)
    worlds = rows.bias.ndim - 1
    if gain.ndim == worlds:
        return finite_or_nan(gain[None])
    if gain.ndim != worlds + 1 or gain.shape[0] != rows.bias.shape[0]:
        raise ValueError(
            f"{owner}: a gain must be a number, an array {rows.bias.shape[:1]} by row, or a"
            f" mapping by constraint name; got shape {gain.shape[: gain.ndim - worlds]}."
        )
    return finite_or_nan(gain)


def _from_names(gain: Mapping[str, Any], fallback: Array, rows: Rows, owner: str) -> Array:
    layout, worlds = rows.layout, rows.bias.ndim - 1
    result = fallback.reshape(1, *(fallback.shape or (1,) * worlds))
    for key, names in keyed(gain, layout.names, owner).items():
        chosen = column(rows_of(layout, names), rows)
        result = jnp.where(chosen, jnp.asarray(gain[key], rows.bias.dtype)[None], result)
    return result


def keyed(keys: Iterable[str], names: tuple[str, ...], owner: str) -> dict[str, list[str]]:
    """The names of constraints that each key stands for; a name itself outranks patterns.

    Raises:
        ValueError: a key stands for nothing, or two patterns for one constraint.
    """
    keys = sorted(keys)
    unknown = [key for key in keys if not any(stands_for(key, name) for name in names)]
    if unknown:
        raise ValueError(f"{owner}: there is no constraint {unknown}; there are {list(names)}.")
    found = {
        key: [x for x in names if x == key or (x not in keys and stands_for(key, x))]
        for key in keys
    }
    for name in names:
        several = [key for key, own in found.items() if name in own]
        if len(several) > 1:
            raise ValueError(
                f"{owner}: constraint '{name}' has a gain by each of the patterns {several}; name"
                " it itself, which outranks patterns."
            )
    return found


def stands_for(key: str, name: str) -> bool:
    """Returns True where a key is a constraint's name, or a pattern of it."""
    return key == name or fnmatchcase(name, key)


def rows_of(layout: RowLayout, names: Iterable[str]) -> np.ndarray:
    """Returns a mask of the rows that belong to one of the constraints, (n_c,)."""
    chosen = np.zeros(layout.size, bool)
    for name in names:
        chosen[layout.rows(name)] = True
    return chosen


def named(gain: Any, layout: RowLayout, owner: str) -> np.ndarray:
    """Returns a mask of the rows, (n_c,), for which a gain is given."""
    if not isinstance(gain, Mapping):
        return layout.holds
    names = keyed(gain, layout.names, owner).values()
    return rows_of(layout, (name for own in names for name in own))


def column(mask: np.ndarray, rows: Rows) -> np.ndarray:
    """A choice of rows, (n_c,), with the trailing axes of the worlds."""
    return mask.reshape(-1, *(1,) * (rows.bias.ndim - 1))


def sums(x: Array, layout: RowLayout) -> Array:
    """Σ x_i over the constraint to which a row belongs, by row, (n_c,)."""
    lanes: list[Array] = []
    place = 0
    while place < len(layout.entries):
        _, first, rows, elements = layout.entries[place]
        lanes += [total(Vector.of_rows(x, first, rows, elements))] * rows
        place += elements
    return jnp.concatenate(lanes) if lanes else x


def squares(x: Array, layout: RowLayout) -> Array:
    """‖x‖² of the constraint to which a row belongs, by row, (n_c,); smooth where x = 0."""
    return sums(x * x, layout)


def check_gains(owner: str, strictly: bool = False, optional: bool = True, **gains: Any) -> None:
    """Checks that gains are zero or more (or positive) and finite, as far as they are known.

    Args:
        owner: whose gains they are, for errors.
        strictly: whether zero is refused.
        optional: whether a gain may be None.
        gains: by name, each a number, an array by row, or a mapping by constraint.

    Raises:
        ValueError: one is not, or is not a number.
    """
    limit = {"above": 0} if strictly else {"least": 0}
    for what, gain in gains.items():
        if gain is not None or not optional:
            _check_gain(owner, what, gain, **limit)


def check_between(owner: str, what: str, value: Any, low: float, high: float) -> None:
    """Checks that a number, or each of a mapping, lies between two, as far as it is known.

    Raises:
        ValueError: one does not.
    """
    _check_gain(owner, what, value, least=low, most=high)


def _check_gain(owner: str, what: str, gain: Any, **limits: Any) -> None:
    """Checks a number, an array by row, or a mapping of names to numbers."""
    if not isinstance(gain, Mapping):
        checks.check(owner, what, gain, **limits)
        return
    for name, value in gain.items():
        if not isinstance(name, str):
            raise ValueError(
                f"{owner}: {what} by constraint wants names as its keys, got {name!r}."
            )
        checks.check(owner, f"{what} of '{name}'", value, (), **limits)
