"""Islands: sets of velocities that equality constraints couple, directly or indirectly."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array
from jaxcon.linear.jacobian import Jacobian


def islands(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """Returns the island number of each equality row, (n_c,), and of each velocity, (n_v,).

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

    for row, column in zip(*_entries(jacobian), strict=True):
        parent[root(int(row))] = root(n_c + int(column))
    label = np.unique([root(i) for i in range(n_c + n_v)], return_inverse=True)[1]
    return label[:n_c], label[n_c:]


def largest_by_island(jacobian: Jacobian, x: Array) -> Array | None:
    """Returns for each row the largest x among the rows of its island, (n_c, …).

    The result is None if there is only one island.

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v).
        x: one number for each equality row, (n_c, …).
    """
    values, label = np.unique(islands(jacobian)[0], return_inverse=True)
    return jax.ops.segment_max(x, label, len(values))[label] if len(values) > 1 else None


def rows_beside_contact(jacobian: Jacobian, bounds: Any, multipliers: Array) -> Array | None:
    """Marks the equality rows in whose island a joint limit or a contact is active.

    Joint friction and velocity-limited motors do not count.

    Args:
        jacobian: the Jacobian of the equality rows, (n_c, n_v).
        bounds: the inequality rows; only their structure is read.
        multipliers: the multipliers of the inequality rows, (n, …); nonzero where a row is active.

    Returns:
        A mask of the equality rows, (n_c, …). None if no joint limit or contact touches an island
        that contains equality rows.
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
    if touched[:, reaching].all():  # all islands share one mask
        acting = jnp.any(acting[reaching], axis=0)
        return jnp.broadcast_to(acting, (len(of_rows), *acting.shape))
    patterns, which = np.unique(touched, axis=0, return_inverse=True)
    worlds = acting.reshape(len(acting), -1).astype(jnp.float32)
    touching = jnp.asarray(patterns, jnp.float32) @ worlds > 0
    return touching.reshape(len(patterns), *acting.shape[1:])[which.reshape(-1)]


def _entries(jacobian: Jacobian) -> tuple[np.ndarray, np.ndarray]:
    """Returns the row and column numbers of the structural nonzeros of J, in no fixed order."""
    entries = [np.zeros((2, 0), int)]
    for block in jacobian.blocks:
        m, k = block.shape
        row = block.start + k * np.arange(m)[:, None, None] + np.arange(k)
        pair = np.broadcast_arrays(row, block.columns.index()[None])
        entries.append(np.stack(pair).reshape(2, -1))
    rows, columns = np.concatenate(entries, axis=1)
    return rows, columns
