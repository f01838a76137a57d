"""Derivatives along directions by central differences that choose their own step. Host code."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array

LEVELS = 10
"""The number of differences, each with half the step of the one before."""
ROUNDING = 64
"""What a long computation makes of the rounding of one number, in spacings of the result."""


def steps(eps: float) -> np.ndarray:
    """From ε^⅛ down by halves, relative."""
    return eps**0.125 * 0.5 ** np.arange(LEVELS)


def unseen(eps: float) -> float:
    """The derivative that rounding hides, relative to the values of f."""
    return ROUNDING * eps / steps(eps)[0]


def differences(
    of: Any, at: list[Array], moves: list[Array], eps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives along directions, and how exact they are.

    Args:
        of: a list of arrays → a number.
        at: where.
        moves: directions, (n, …) in each array.
        eps: ε of the coarsest number on the way.

    Returns:
        Derivatives (n,), extrapolated from all `steps`, and their uncertainties (n,).
    """
    sizes = jnp.asarray(steps(eps), at[0].dtype)

    def along(move: list[Array], step: Array) -> Array:
        return of([x + step.astype(x.dtype) * dx for x, dx in zip(at, move, strict=True)])

    every = jax.jit(jax.vmap(jax.vmap(along, (None, 0)), (0, None)))
    values = np.asarray(every(moves, jnp.concatenate([sizes, -sizes])), np.float64)
    ahead, behind = np.split(values, 2, axis=1)
    return ridders((ahead - behind) / (2 * np.asarray(sizes, np.float64)))


def ridders(slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The limit of central differences whose steps are halved, and its uncertainty.

    Each column of Neville's table takes away the next even power of the step. The entry that
    differs least from the two that it is made of is taken for the best. That one may owe it to
    chance, and so the fourth least of these differences says how exact it is, or its `scatter`
    where that is more. `scatter` does not choose the entry, since a kink within the larger steps
    makes it large for all of them.

    Args:
        slopes: (directions, levels), from the largest step on.
    """
    columns = neville(slopes)
    apart = [
        np.maximum(np.abs(after - before[:, 1:]), np.abs(after - before[:, :-1]))
        for before, after in itertools.pairwise(columns)
    ]
    table, spread = np.concatenate(columns[1:], axis=1), np.concatenate(apart, axis=1)
    order = np.argsort(np.where(np.isfinite(spread), spread, np.inf), axis=1)
    best, fourth = order[:, :1], order[:, 3:4]
    noise = np.nan_to_num(scatter(slopes), nan=np.inf)
    value, rounding = (np.take_along_axis(x, best, axis=1) for x in (table, noise))
    doubt = np.maximum(np.take_along_axis(spread, fourth, axis=1), rounding)
    return value[:, 0], doubt[:, 0]


def neville(slopes: np.ndarray) -> list[np.ndarray]:
    """The columns of Neville's table: (directions, levels), (directions, levels − 1) and so on."""
    columns = [slopes]
    for power in range(1, slopes.shape[1]):
        factor, last = 4.0**power, columns[-1]
        columns.append((factor * last[:, 1:] - last[:, :-1]) / (factor - 1))
    return columns


def scatter(slopes: np.ndarray) -> np.ndarray:
    """What rounding makes of each entry of Neville's table after its first column, (directions, n).

    Rounding of f over the step is taken for independent noise of size σ 2ᵏ in the slope k, and what
    Neville's table makes of that is known. σ is told by the differences of the third column at the
    smallest steps, where the motion itself, of the order h⁶, adds less.

    Args:
        slopes: (directions, levels), from the largest step on.
    """
    columns, unit = neville(slopes), neville(np.diag(2.0 ** np.arange(slopes.shape[1])))
    between = np.linalg.norm(np.diff(unit[2], axis=1), axis=0)
    last = (np.diff(columns[2], axis=1) / between)[:, -3:]
    own = np.sqrt(np.mean(last**2, axis=1, keepdims=True))
    return own * np.concatenate([np.linalg.norm(x, axis=0) for x in unit[1:]])
