"""Islands: velocities that equality rows connect, directly or through other velocities."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array
from jaxcon.solvers.jacobian import Jacobian


def islands(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """The island numbers of rows, (n_c,), and of velocities, (n_v,).

    Args:
        jacobian: of the equality rows, (n_c, n_v).
    """
    n_c, n_v = jacobian.shape
    parent = list(range(n_c + n_v))  # a forest of rows, then velocities

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for row, column in zip(*_entries(jacobian), strict=True):
        parent[root(int(row))] = root(n_c + int(column))
    label = np.unique([root(i) for i in range(n_c + n_v)], return_inverse=True)[1]
    return label[:n_c], label[n_c:]


def largest_by_island(jacobian: Jacobian, x: Array) -> Array | None:
    """The largest number in the island of each row, (n_c, …); None where there is one island.

    Args:
        jacobian: of the equality rows, (n_c, n_v).
        x: by row, (n_c, …).
    """
    _, label = np.unique(islands(jacobian)[0], return_inverse=True)
    count = int(label.max(initial=-1)) + 1
    if count < 2:
        return None
    return jax.ops.segment_max(x, label, count)[label]


def rows_beside_contact(jacobian: Jacobian, bounds: Any, multipliers: Array) -> Array | None:
    """A mask of the equality rows in whose island a stop or contact acts, (n_c, …).

    Joint friction and velocity-limited motors do not count.

    Args:
        jacobian: of the equality rows, (n_c, n_v).
        bounds: the inequality rows, of which only the structure is read.
        multipliers: of the inequality rows, (n, …).

    Returns:
        The mask; None where no stop or contact touches an island that has rows.
    """
    of_rows, of_velocities = islands(jacobian)
    touches = np.zeros((max(of_velocities, default=-1) + 1, len(multipliers)), bool)
    rows, columns = _entries(bounds.jacobian)
    touches[of_velocities[columns], rows] = True
    touches[:, ~bounds.kinds.one_sided] = False
    touched = touches[of_rows]
    reaching = np.flatnonzero(touched.any(axis=0))
    if not reaching.size:
        return None
    acting = multipliers != 0
    if touched[:, reaching].all():  # each of them touches all islands
        acting = jnp.any(acting[reaching], axis=0)
        return jnp.broadcast_to(acting, (len(of_rows), *acting.shape))
    patterns, which = np.unique(touched, axis=0, return_inverse=True)
    worlds = acting.reshape(len(acting), -1).astype(jnp.float32)
    found = jnp.asarray(patterns, jnp.float32) @ worlds > 0
    return found.reshape(len(patterns), *acting.shape[1:])[which.reshape(-1)]


def _entries(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """Row and column numbers of the entries of J, without order."""
    rows, columns = [np.zeros(0, int)], [np.zeros(0, int)]
    for block in jacobian.blocks:
        m, k = block.shape
        row = block.start + k * np.arange(m)[:, None, None] + np.arange(k)
        pair = np.broadcast_arrays(row, block.columns.index()[None])
        rows.append(pair[0].ravel())
        columns.append(pair[1].ravel())
    return np.concatenate(rows), np.concatenate(columns)
