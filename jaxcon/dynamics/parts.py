"""Parts of a step, before and after an impact, and what bounded rows do in them and at it.

Rows that can make an impact, those of hard stops, ropes and contacts, are in one of two conditions
when a part begins. Closed, they act as in plain stepping. Open, they do nothing until their gap is
closed, which ends the part. What rests is closed: its gap and its speed are no more than what the
accelerations of its bodies make of them in a step, so that it cannot be told from what is at rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.bounds import BoundRows
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

SHORTEST = 1e-6
"""The least time for which rows are asked, as a share of a step: they divide by it."""

ROUNDING = 64
"""What rounding makes of a gap, in spacings of 1 + max |q|."""


@pytree
class Part:
    """A part of a step h.

    Attributes:
        length: s, () [s].
        open: which rows are open, (n,).
        awaited: whether open rows do nothing, because their impact would end the part; or they act
            as in a plain step of length s, ().
    """

    length: Array
    open: Array
    awaited: Array

    def ask(self, bounds: Callable[[Any], BoundRows], dt: Array) -> tuple[BoundRows, Array]:
        """The rows, and which of them act.

        Those that are closed are asked as in the whole step: what is taken back in each step would
        otherwise be taken back in each part, however short.

        Args:
            bounds: what a step of some length wants of the rows.
            dt: h, () [s].
        """
        rows, rest = bounds(dt), bounds(jnp.maximum(self.length, SHORTEST * dt))
        names = [n for n in ("target", "bounce", "travel") if getattr(rows, n) is not None]
        asked = {n: jnp.where(self.open, getattr(rest, n), getattr(rows, n)) for n in names}
        return dataclasses.replace(rows, **asked), ~(self.open & self.awaited[None])


@pytree
class Outlook:
    """What is to be expected of rows in a part.

    Attributes:
        gap, rate: at its start, (n,).
        bend: ½ h² |J| |a|, what accelerations can make of a gap in a step, (n,).
        rounding: what rounding makes of a gap, ().
        open: which rows are open, (n,).
        arriving: which of these are closed already, but move on, (n,).
    """

    gap: Array
    rate: Array
    bend: Array
    rounding: Array
    open: Array
    arriving: Array


def look(rows: BoundRows, acceleration: Array, q: Array, dt: Array) -> Outlook:
    """Which rows are open when a part begins.

    Args:
        rows: with their gaps.
        acceleration: a without bounded rows, (n_v,).
        q: positions, (n_q,).
        dt: h, () [s].
    """
    size = 1 + jnp.max(jnp.abs(q), axis=0)
    rounding = ROUNDING * float(jnp.finfo(q.dtype).eps) * size
    bend = dt[None] ** 2 / 2 * rows.jacobian.reach(acceleration)
    rests = resting(rows, bend, rounding, dt)
    open_ = mask(rows.ends, rows) & ~rests & (rows.gap >= -rounding[None])
    arriving = open_ & (rows.gap <= rounding[None]) & (rows.rate < 0)
    return Outlook(rows.gap, rows.rate, bend, rounding, open_, arriving)


def resting(rows: BoundRows, bend: Array, rounding: Array, dt: Array) -> Array:
    """Which rows cannot be told from rows at rest, (n,)."""
    near = rows.gap <= jnp.maximum(bend, rounding[None])
    return near & slow(rows, bend, rounding, dt)


def slow(rows: BoundRows, bend: Array, rounding: Array, dt: Array) -> Array:
    """Which rows move no faster than accelerations make them in a step, (n,)."""
    return jnp.abs(rows.rate) * dt[None] <= bend + rounding[None]


@pytree
class Struck:
    """Which rows take part in an impact.

    Attributes:
        outlook: before it.
        first: which row made it, (n,).
        happens: by world, ().
    """

    outlook: Outlook
    first: Array
    happens: Array

    def ask(self, rows: BoundRows, dt: Array) -> tuple[BoundRows, Array]:
        """What the rows want at that instant, and which of them act.

        All that touch do, at once: none goes on closing, and those that closed leave with e |φ̇|.
        """
        bend, rounding = self.outlook.bend, self.outlook.rounding
        ends = mask(rows.ends, rows)
        touching = self.first | (rows.gap <= rounding[None]) | resting(rows, bend, rounding, dt)
        acts = mask(rows.hard, rows) & (touching | ~ends) & self.happens[None]
        tangents = mask(np.arange(rows.kinds.size) >= rows.kinds.normal + rows.kinds.contacts, rows)
        target = jnp.where(ends, 0, rows.target)
        bounce = rows.bounce
        if bounce is not None:
            fast = acts & (rows.rate < 0) & ~slow(rows, bend, rounding, dt)
            # a bounce is given as what is added to the target
            bounce = jnp.where(fast & (bounce > 0), bounce + rows.target, 0)
        asked = dataclasses.replace(rows, target=target, bounce=bounce, travel=None)
        return asked, acts | tangents


def mask(flags: Any, rows: BoundRows) -> Array:
    """Flags by row, (n,), for arrays with the axes of a lane."""
    return jnp.asarray(flags, bool).reshape(-1, *(1,) * (rows.gap.ndim - 1))
