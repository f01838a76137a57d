"""Newton's law of restitution."""

from __future__ import annotations

import jax.numpy as jnp

from jaxcon.constraints.bounds import BoundRows
from jaxcon.core.typing import Array


def restitution_gain(rows: BoundRows, e: Array, dt: Array) -> Array:
    """Returns the addition of restitution to u*, (n,): rows that close within dt leave with -e u.

    Args:
        rows: the bounded rows.
        e: restitution, (n,), negative of rows that do not bounce.
        dt: h, () [s].
    """
    more = -e * rows.rate - rows.target
    closes = (rows.rate < 0) & (rows.gap <= -dt[None] * rows.rate)
    return jnp.where(closes & (e >= 0) & (more > 0), more, 0)
