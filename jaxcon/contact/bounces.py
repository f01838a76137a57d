"""Target velocities by Newton's law of restitution."""

from __future__ import annotations

import jax.numpy as jnp

from jaxcon.contact.rows import BoundRows
from jaxcon.core.typing import Array


def restitution_gain(rows: BoundRows, e: Array, dt: Array) -> Array:
    """Returns the amount by which restitution raises the target velocity u* of each row, (n,).

    Args:
        rows: the inequality rows. A row whose gap closes within dt gets the target −e φ̇, where φ̇ is
            its rate, if this exceeds its previous target.
        e: coefficient of restitution, (n,); negative for rows that do not bounce.
        dt: step size h, () [s].
    """
    gain = -e * rows.rate - rows.target
    closes = (rows.rate < 0) & (rows.gap <= -dt[None] * rows.rate)
    return jnp.where(closes & (e >= 0) & (gain > 0), gain, 0)
