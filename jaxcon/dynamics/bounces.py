"""What restitution asks of a step."""

from __future__ import annotations

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


def bounces(rows: BoundRows, e: Array, fall: Array, free: Array, dt: Array) -> Bounce:
    """What rows with restitution e ask of a step h, in which gravity accelerates them by g.

    Positions move by h w, w = φ̇₀ + h g, the velocity in the middle of the step. What arrives,
    φ + h w ≤ 0, does so after the time τ of the parabola

        φ + (w − g h/2) τ + g τ²/2 = 0,   with v = w + g (τ − h/2).

    It leaves with −e v, and has, half a step before the end as velocities have it, and at the end,

        u = −e v + g (h/2 − τ),    φ⁺ = (h − τ) (−e v + g (h − τ)/2).

    So what falls and bounces is exact, keeps its energy where e = 1, and the derivatives contain
    that of τ. Other forces are no part of it: those of the start of the step, along the parabola,
    would let energy in where they change along it, as a spring does; and as a kick before it, let
    balls hop for ever, in time with the steps.

    Args:
        rows: the bounded rows.
        e: restitution, (n,), negative of rows that do not bounce.
        fall: h g, (n,), of rows that move `freely`, and zero of others.
        free: which rows those are, (n,).
        dt: h, () [s].
    """
    arrives = arrival(rows, e, fall, dt)
    start = -rows.rate - fall / 2
    whole = numerics.safe_divide(jnp.where(arrives, jnp.maximum(rows.gap, 0), 0), dt[None])
    size = jnp.where(free, start, 1)  # no quotients by what may be as slow as it likes
    closed = 2 * whole / (1 + jnp.sqrt(1 - 2 * (fall / size) * (whole / size)))
    before = closed / size
    slowed = 1 - fall / size * before
    later, last = fall * (0.5 - before), fall * (1 - before) ** 2 / 2
    more, travel = e * start * slowed + later - rows.target, e * (start - closed) * slowed + last
    up = arrives & (more > 0) & (travel >= 0)
    return Bounce(*(jnp.where(up, x, 0) for x in (more, travel, later)))


def arrival(rows: BoundRows, e: Array, fall: Array, dt: Array) -> Array:
    """Which rows with restitution close within the step, φ + h w ≤ 0 with w = φ̇₀ + h g, (n,)."""
    mean = rows.rate + fall
    return (mean < 0) & (rows.gap <= -dt[None] * mean) & (e >= 0)


def freely(
    rows: BoundRows,
    e: Array,
    change: Array,
    fall: Array,
    dt: Array,
    matrix: Array,
    acts: Array,
) -> Array:
    """Which rows close as gravity alone lets their bodies, (n,).

    Those that are faster than accelerations can make them in a step, where no other row that acts
    pulls on the same bodies: it may bear some of it, as a floor bears a plate on which something
    falls.

    Args:
        rows: the bounded rows.
        e: restitution, (n,), negative of rows that do not bounce.
        change: h a without bounded rows, (n,).
        fall: what gravity has in it, (n,).
        dt: h, () [s].
        matrix: G, (n, n), a constant.
        acts: which rows act at all, (n,).
    """
    kinds, numbers = rows.kinds, jnp.finfo(rows.rate.dtype)
    slow = float(numbers.tiny) ** 0.25  # up to its square there are derivatives of quotients
    fast = rows.rate < -(jnp.abs(change) + 2 * jnp.abs(fall) + slow)
    up = fast & arrival(rows, e, fall, dt)
    rounding = ROUNDING * float(numbers.eps)
    size = jnp.max(jnp.maximum(jnp.abs(rows.rate), jnp.abs(change)), axis=0, keepdims=True)
    least = rows.target + rounding * jnp.maximum(size, jnp.abs(rows.target))
    touch = kinds.split((rows.rate + change <= least) & ~up)
    box, discs = jax.tree.map(jnp.ones_like, (touch.box, touch.discs))
    bears = acts & kinds.under_normals(touch._replace(box=box, discs=discs))
    length = jnp.sqrt(jnp.maximum(gauss_jordan.diagonal(matrix), 0))
    bound = jnp.abs(matrix) > rounding * length[:, None] * length[None]
    return jax.lax.stop_gradient(fast & ~jnp.any(bound & bears[None], axis=1))
