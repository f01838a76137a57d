"""Islands: sets of velocities that equality constraints couple, directly or indirectly."""

import jax
import numpy as np

from jaxcon.core.typing import Array
from jaxcon.linear.jacobian import Jacobian


def islands(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """Numbers the islands: sets of rows and velocities that are coupled to each other.

    Returns the island number of each equality row, (n_c,), and of each velocity, (n_v,).

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v).
    """
    n_c, n_v = jacobian.shape
    parent = list(range(n_c + n_v))  # union-find over rows, followed by velocities

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for row, column in zip(*nonzeros(jacobian), strict=True):
        parent[root(int(row))] = root(n_c + int(column))
    label = np.unique([root(i) for i in range(n_c + n_v)], return_inverse=True)[1]
    return label[:n_c], label[n_c:]


def largest_by_island(jacobian: Jacobian, x: Array) -> Array | None:
    """Returns for each equality row the largest x among the rows of its island, (n_c, …).

    An island is a set of rows that are coupled through common velocities. The result is None if
    there is only one island.

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v).
        x: one number for each equality row, (n_c, …).
    """
    values, label = np.unique(islands(jacobian)[0], return_inverse=True)
    return jax.ops.segment_max(x, label, len(values))[label] if len(values) > 1 else None


def nonzeros(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """Returns the row and column numbers of the structural nonzeros of J, in no fixed order."""
    entries = [np.zeros((2, 0), int)]
    for block in jacobian.blocks:
        m, k = block.shape
        row = block.start + k * np.arange(m)[:, None, None] + np.arange(k)
        pair = np.broadcast_arrays(row, block.columns.index()[None])
        entries.append(np.stack(pair).reshape(2, -1))
    rows, columns = np.concatenate(entries, axis=1)
    return rows, columns
