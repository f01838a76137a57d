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
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

SHORTEST = 1e-6
"""The least time for which rows are asked, as a share of a step: they divide by it."""

ROUNDING = 64
"""What rounding makes of a gap, in spacings of 1 + max |q|."""

SLIPS = 1e-3
"""The least slip that can end, as a share of what accelerations make of a speed in a step."""


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
        target = jnp.where(self.open, rest.target, rows.target)
        return dataclasses.replace(rows, target=target), ~(self.open & self.awaited[None])


@pytree
class Sliding:
    """Contacts that slide when a part begins.

    Attributes:
        speed: of the slip, (contacts,) [m/s]; zero where nothing slides.
        way: its direction, a Vector of (contacts,).
    """

    speed: Array
    way: Vector

    @classmethod
    def of(cls, rows: BoundRows, open_: Array, bend: Array, rounding: Array, dt: Array) -> Sliding:
        """Returns the sliding of closed contacts; what cannot be told from rolling is none."""
        kinds, near = rows.kinds, rows.gap <= jnp.maximum(bend, rounding[None])
        slip, speeds = kinds.split(rows.rate).discs[0], kinds.split(bend).normal
        speed = numerics.norm(slip)
        fast = speed * dt[None] > SLIPS * speeds + rounding[None]
        slides = kinds.split(near & ~open_).normal & fast
        way = slip * numerics.safe_divide(1.0, speed)
        return cls(jnp.where(slides, speed, 0), way)

    def clearance(self, rows: BoundRows, multipliers: Array) -> Array:
        """What is left of the slip at the end of a part, (contacts,); negative where it has ended.

        There friction λ_t has not been needed in full: with d the direction of the slip and v₀ its
        speed, d·u − v₀ (1 + d·λ_t/μλ_n) goes through zero when the slip ends, with one slope.
        """
        here, given = rows.kinds.split(rows.rate), rows.kinds.split(multipliers)
        used = numerics.safe_divide(self.way.dot(given.discs[0]), rows.friction * given.normal)
        spare = jnp.where(given.normal > 0, 1 + used, 0)
        return self.way.dot(here.discs[0]) - self.speed * spare


@pytree
class Outlook:
    """What is to be expected of rows in a part.

    Attributes:
        gap, rate: at its start, (n,).
        bend: ½ h² |J| |a|, what accelerations can make of a gap in a step, (n,).
        rounding: what rounding makes of a gap, ().
        open: which rows are open, (n,).
        arriving: which of these are closed already, but move on, (n,).
        sliding: contacts that slide; None where their end is not asked for.
    """

    gap: Array
    rate: Array
    bend: Array
    rounding: Array
    open: Array
    arriving: Array
    sliding: Sliding | None = None

    def watched(self, dt: Array) -> Outlook:
        """Returns the outlook on gaps and, behind them, on slips; see `Sliding.clearance`."""
        if self.sliding is None:
            return self
        speed = self.sliding.speed
        more = {"gap": dt[None] * speed, "rate": 0 * speed, "open": speed > 0}
        more |= {"bend": 0 * speed, "arriving": jnp.zeros_like(more["open"])}
        both = {name: jnp.concatenate([getattr(self, name), x]) for name, x in more.items()}
        return dataclasses.replace(self, **both)


def look(rows: BoundRows, acceleration: Array, q: Array, dt: Array, slips: bool = False) -> Outlook:
    """Which rows are open when a part begins.

    Args:
        rows: with their gaps.
        acceleration: a without bounded rows, (n_v,).
        q: positions, (n_q,).
        dt: h, () [s].
        slips: whether contacts that slide are looked for, too.
    """
    size = 1 + jnp.max(jnp.abs(q), axis=0)
    rounding = ROUNDING * float(jnp.finfo(q.dtype).eps) * size
    bend = dt[None] ** 2 / 2 * rows.jacobian.reach(acceleration)
    rests = resting(rows, bend, rounding, dt)
    open_ = mask(rows.ends, rows) & ~rests & (rows.gap >= -rounding[None])
    arriving = open_ & (rows.gap <= rounding[None]) & (rows.rate < 0)
    sliding = Sliding.of(rows, open_, bend, rounding, dt) if slips and rows.kinds.contacts else None
    return Outlook(rows.gap, rows.rate, bend, rounding, open_, arriving, sliding)


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
        gap, target = (jnp.where(ends, 0, x) for x in (rows.gap, rows.target))
        e = rows.restitution
        if e is not None:
            e = jnp.where(acts & ~slow(rows, bend, rounding, dt), e, -1)
        asked = dataclasses.replace(rows, gap=gap, target=target, restitution=e, far=None)
        return asked, acts | tangents


def mask(flags: Any, rows: BoundRows) -> Array:
    """Flags by row, (n,), for arrays with the axes of a lane."""
    return jnp.asarray(flags, bool).reshape(-1, *(1,) * (rows.gap.ndim - 1))
