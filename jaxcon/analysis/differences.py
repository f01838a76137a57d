"""Directional derivatives by extrapolated central differences. Host code."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array

LEVELS = 10
"""The number of central differences; each uses half the step of the previous one."""
ROUNDING = 64
"""The assumed rounding error of a long computation, in units of ε times its result."""


def steps(eps: float) -> np.ndarray:
    """Returns the relative step sizes of the differences: ε^⅛, then halved at each level."""
    return eps**0.125 * 0.5 ** np.arange(LEVELS)


def unseen(eps: float) -> float:
    """Returns the smallest derivative that differences can resolve, relative to the value of f.

    It is the assumed relative rounding error of f, divided by the largest relative step size.

    Args:
        eps: ε of the coarsest dtype in the computation.
    """
    return ROUNDING * eps / steps(eps)[0]


def differences(
    f: Callable[[list[Array]], Array], at: list[Array], moves: list[Array], eps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Computes directional derivatives of f by central differences, with uncertainties.

    Args:
        f: function from a list of arrays to a number.
        at: the arrays at which f is differentiated.
        moves: n directions, an array (n, …) for each array of `at`.
        eps: ε of the coarsest dtype in the computation.

    Returns:
        Derivatives (n,), extrapolated to step size zero, and their uncertainties (n,).
    """
    sizes = jnp.asarray(steps(eps), at[0].dtype)

    def along(move: list[Array], step: Array) -> Array:
        return f([x + step.astype(x.dtype) * dx for x, dx in zip(at, move, strict=True)])

    all_moves = jax.jit(jax.vmap(jax.vmap(along, (None, 0)), (0, None)))
    values = np.asarray(all_moves(moves, jnp.concatenate([sizes, -sizes])), np.float64)
    ahead, behind = np.split(values, 2, axis=1)
    return ridders((ahead - behind) / (2 * np.asarray(sizes, np.float64)))


def ridders(slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extrapolates central differences with halved steps to zero step size.

    Each column of Neville's table eliminates the next even power of the step. Each entry is
    computed from two entries of the previous column. The spread of an entry is its distance from
    the farther one of these two. The entry with the smallest spread is the derivative. A single
    spread may be small by chance. The uncertainty is therefore the fourth smallest spread in the
    table, or the rounding error (`scatter`) of the selected entry if that is larger.

    The estimated rounding errors do not select the entry: if f has a kink within the larger steps,
    these estimates are too large for all entries.

    Args:
        slopes: central differences, (directions, levels), the largest step first.

    Returns:
        Derivatives (directions,) and their uncertainties (directions,).
    """
    columns = neville(slopes)
    distances = [
        np.maximum(np.abs(after - before[:, 1:]), np.abs(after - before[:, :-1]))
        for before, after in itertools.pairwise(columns)
    ]
    table, spread = np.concatenate(columns[1:], axis=1), np.concatenate(distances, axis=1)
    order = np.argsort(np.where(np.isfinite(spread), spread, np.inf), axis=1)
    # ten levels give 45 entries, so the fourth smallest spread is still among the best
    best, fourth = order[:, :1], order[:, 3:4]
    noise = np.nan_to_num(scatter(slopes), nan=np.inf)
    value, rounding = (np.take_along_axis(x, best, axis=1) for x in (table, noise))
    doubt = np.maximum(np.take_along_axis(spread, fourth, axis=1), rounding)
    return value[:, 0], doubt[:, 0]


def neville(slopes: np.ndarray) -> list[np.ndarray]:
    """Returns the columns of Neville's table: (directions, levels), (directions, levels − 1), ….

    Args:
        slopes: central differences, (directions, levels), the largest step first.
    """
    columns = [slopes]
    for power in range(1, slopes.shape[1]):
        factor, last = 4.0**power, columns[-1]
        columns.append((factor * last[:, 1:] - last[:, :-1]) / (factor - 1))
    return columns


def scatter(slopes: np.ndarray) -> np.ndarray:
    """Estimates the rounding errors in Neville's table.

    The rounding error of f, divided by the step, is modeled as independent noise with standard
    deviation σ 2ᵏ in difference k. Neville's table combines the differences linearly. σ is
    estimated from the third column at the smallest steps. There the truncation error, of order h⁶,
    is smaller than the noise.

    Args:
        slopes: central differences, (directions, levels), the largest step first.

    Returns:
        Standard deviations of the rounding errors of all entries after the first column, column by
        column, (directions, n).
    """
    columns, unit = neville(slopes), neville(np.diag(2.0 ** np.arange(slopes.shape[1])))
    between = np.linalg.norm(np.diff(unit[2], axis=1), axis=0)
    last = (np.diff(columns[2], axis=1) / between)[:, -3:]
    σ = np.sqrt(np.mean(last**2, axis=1, keepdims=True))
    return σ * np.concatenate([np.linalg.norm(x, axis=0) for x in unit[1:]])
