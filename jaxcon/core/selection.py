"""Rows of an array that are evaluate_selection when tracing, and sums of such rows.

The transpose of a selection is a sum of rows, and that of a sum a selection. JAX's own transpose of
`x[indices]` is a scatter, which XLA computes row by row on CPUs, and that of many slices a sum of
padded arrays.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxcon.core.typing import Array

ZEROS = -1
"""The place that stands for a row of zeros."""

MIN_GATHER_RUNS = 8
"""The smallest number of runs of consecutive rows for which one gather replaces slices."""

select_rows_p = Primitive("select_rows")


def select_rows(x: Array, places: Sequence[int]) -> Array:
    """Returns the rows of an array at known places, and zeros for the place `ZEROS`.

    Args:
        x: the array, (row, …).
        places: for each row of the result, its place in x.

    Raises:
        IndexError: x has no row at one of the places.
    """
    if list(places) == list(range(len(x))):
        return x
    if any(place != ZEROS and not 0 <= place < len(x) for place in places):
        raise IndexError(f"places must be rows of an array of {len(x)} rows, got {places}.")
    return select_rows_p.bind(x, places=tuple(places))


def sum_rows(x: Array, sources: Sequence[Sequence[int]]) -> Array:
    """Returns sums of rows of an array at known places, added in pairs.

    Args:
        x: the array, (row, …).
        sources: for each row of the result, the places of its terms in x.
    """
    members = [list(s) for s in sources]
    while any(len(s) > 1 for s in members):
        first: list[int] = []
        second: list[int] = []
        sums: list[list[int]] = []
        for s in members:
            start = len(first)
            first += s[::2]
            second += [*s[1::2], *[ZEROS] * (len(s) % 2)]
            sums.append(list(range(start, len(first))))
        x, members = select_rows(x, first) + select_rows(x, second), sums
    return select_rows(x, [s[0] if s else ZEROS for s in members])


def evaluate_selection(x: Array, places: tuple[int, ...]) -> Array:
    """Evaluates `select_rows` by JAX's operations: a slice, a few slices, or a gather."""
    if not places:
        return x[:0]
    runs = _runs(places)
    if len(runs) < MIN_GATHER_RUNS:
        parts = [_slice(x, run) for run in runs]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts)
    index = np.array(places)
    rows = x.at[np.maximum(index, 0)].get(mode="promise_in_bounds")
    if (index == ZEROS).any():
        kept = (index != ZEROS).reshape(-1, *(1,) * (x.ndim - 1))
        rows = jnp.where(kept, rows, jnp.zeros_like(rows))
    return rows


def _runs(places: tuple[int, ...]) -> list[list[int]]:
    """Cuts places into runs: all of them if their steps are equal, or runs of successive rows."""
    steps = {b - a for a, b in itertools.pairwise(places)}
    if len(steps) == 1 and ZEROS not in places:
        return [list(places)]
    runs: list[list[int]] = []
    for place in places:
        last = runs[-1][-1] if runs else None
        if last == place == ZEROS or (last not in (None, ZEROS) and place == last + 1):
            runs[-1].append(place)
        else:
            runs.append([place])
    return runs


def _slice(x: Array, run: list[int]) -> Array:
    """Returns the rows of a run; see `_runs`."""
    shape = (len(run), *x.shape[1:])
    if run[0] == ZEROS:  # as `x`, which may lie on several devices
        return (
            jnp.broadcast_to(jnp.zeros_like(x[:1]), shape) if len(x) else jnp.zeros(shape, x.dtype)
        )
    step = run[1] - run[0] if len(run) > 1 else 1
    rows = jax.lax.slice_in_dim(x, min(run), max(run) + 1, abs(step) or 1)
    return jax.lax.rev(rows, (0,)) if step < 0 else jnp.broadcast_to(rows, shape)


def _abstract(x: ShapedArray, *, places: tuple[int, ...]) -> Any:
    """The abstract evaluation rule."""
    return x.update(shape=(len(places), *x.shape[1:]))


def _transpose(cotangent: Array, x: Any, *, places: tuple[int, ...]) -> list[Array]:
    """The transpose rule: each row gets the sum of the cotangents of the rows that read it."""
    sources: list[list[int]] = [[] for _ in range(x.aval.shape[0])]
    for row, place in enumerate(places):
        if place != ZEROS:
            sources[place].append(row)
    return [sum_rows(cotangent, sources)]


def _batched(
    args: Sequence[Array], axes: Sequence[int], *, places: tuple[int, ...]
) -> tuple[Array, int]:
    """The batching rule."""
    (x,), (axis,) = args, axes
    if axis == 0:
        x, axis = jnp.moveaxis(x, 0, 1), 1
    return select_rows_p.bind(x, places=places), axis


select_rows_p.def_impl(evaluate_selection)
select_rows_p.def_abstract_eval(_abstract)
mlir.register_lowering(select_rows_p, mlir.lower_fun(evaluate_selection, multiple_results=False))
ad.deflinear2(select_rows_p, _transpose)
batching.primitive_batchers[select_rows_p] = _batched
