"""What restitution asks of a step."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.bounds import BoundRows
from jaxcon.core import numerics
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan

ROUNDING = 64
"""What rounding makes of a velocity, in spacings of the largest at hand."""


class Bounce(NamedTuple):
    """What restitution asks of a step, by row, (n,).

    Attributes:
        more: what it adds to u* at the end of the step.
        travel: what it adds to the mean u of the step, by which positions move.
        later: what gravity adds to u after the arrival.
    """

    more: Array
    travel: Array
    later: Array


def bounces(rows: BoundRows, e: Array, change: Array, fall: Array, dt: Array) -> Bounce:
    """What rows with restitution e ask of a step h.

    Forces other than gravity kick at the start of the step; within it the row moves as gravity
    alone lets it, by an acceleration g of its own. With w = φ̇₀ + h a the velocity in the middle of
    the step, what arrives, φ + h w ≤ 0, does so after the time τ of the parabola

        φ + (w − g h/2) τ + g τ²/2 = 0,   with v = w + g (τ − h/2).

    It leaves with −e v, and has, half a step before the end as velocities have it, and at the end,

        u = −e v + g (h/2 − τ),    φ⁺ = (h − τ) (−e v + g (h − τ)/2).

    So what falls and bounces without losses keeps its energy, and the derivatives contain that of
    τ. Each of the two, the kick and the parabola with its bounce, is symplectic where e = 1, as is
    the step without them: that is why other forces, which change along the parabola, are not in it.

    Args:
        rows: the bounded rows.
        e: restitution, (n,), negative of rows that do not bounce.
        change: h a, (n,), of rows that move `freely`, and zero of others.
        fall: h g, (n,), of the same rows.
        dt: h, () [s].
    """
    mean = rows.rate + change
    arrives = (mean < 0) & (rows.gap <= -dt[None] * mean) & (e >= 0)
    start = jnp.where(arrives, fall / 2 - mean, 1)
    gap = jnp.where(arrives, jnp.maximum(rows.gap, 0), 0)
    away = numerics.safe_divide(gap, dt[None]) / start
    before = 2 * away / (1 + jnp.sqrt(1 - 2 * fall / start * away))
    after = 1 - before
    leaves, later = e * (start - fall * before), fall * (0.5 - before)
    more, travel = leaves + later - rows.target, after * (leaves + fall * after / 2)
    up = arrives & (more > 0) & (travel > 0)
    return Bounce(*(jnp.where(up, x, 0) for x in (more, travel, later)))


def freely(
    rows: BoundRows,
    e: Array,
    change: Array,
    fall: Array,
    dt: Array,
    matrix: Array,
    acts: Array,
) -> Array:
    """Which rows close with the acceleration that their bodies have without bounded rows, (n,).

    Those that are faster than it can make them in a step, where no other row that acts pulls on the
    same bodies: it may bear some of it, as a floor bears a plate on which something falls.

    Args:
        rows: the bounded rows.
        e: restitution, (n,), negative of rows that do not bounce.
        change: h a without them, (n,).
        fall: what gravity has in it, (n,).
        dt: h, () [s].
        matrix: G, (n, n), a constant.
        acts: which rows act at all, (n,).
    """
    kinds, mean = rows.kinds, rows.rate + change
    fast = rows.rate < -(jnp.abs(change) + 2 * jnp.abs(fall))
    arrives = rows.gap <= -dt[None] * mean
    rounding = ROUNDING * float(jnp.finfo(mean.dtype).eps)
    sizes = map(jnp.abs, (rows.rate, change, rows.target))
    most = jnp.max(functools.reduce(jnp.maximum, sizes), axis=0, keepdims=True)
    bounces = fast & arrives & (e >= 0)
    parts = kinds.split((mean <= rows.target + rounding * most) & ~bounces)
    bears = acts & kinds.by_normals(parts._replace(box=jnp.ones_like(parts.box)))
    size = jnp.sqrt(jnp.maximum(gauss_jordan.diagonal(matrix), 0))
    bound = jnp.abs(matrix) > rounding * size[:, None] * size[None]
    return jax.lax.stop_gradient(fast & ~jnp.any(bound & bears[None], axis=1))
