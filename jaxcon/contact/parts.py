"""Parts of a step before and after an impact, and the inequality rows of a part.

Hard stops, ropes and contacts have impacts. At the start of a part, each of their rows is closed or
open. A closed row acts as in a step that is not split. An open row is inactive until its gap
closes, which ends the part. A row is closed if it is at rest: its gap and speed are no larger than
accelerations could make them in a step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxcon.contact.rows import BoundRows
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array

SHORTEST = 1e-6
"""The smallest length, as a fraction of a step, by which the targets of open rows are divided."""

ROUNDING = 64
"""The rounding error of a gap, in floating-point spacings of 1 + max |q|."""

SLIPS = 1e-3
"""The smallest slip whose end is detected, as a fraction of the speed change in a step."""


@pytree
class StepPart:
    """A part of a step of size h.

    Attributes:
        length: length s of the part, () [s].
        open: mask of the open rows, (n,).
        awaited: True if an impact of an open row ends the part, so open rows are inactive. False if
            open rows act as in a plain step of length s, ().
    """

    length: Array
    open: Array
    awaited: Array

    def ask(self, bounds: Callable[[Array], BoundRows], dt: Array) -> BoundRows:
        """Returns the rows of the part, with a mask of the active rows.

        Closed rows have the targets of the whole step. Otherwise every part, however short, would
        close the same fraction of a penetration.

        Args:
            bounds: function of the length of a step that returns the rows with their targets.
            dt: step size h, () [s].
        """
        rows, rest = bounds(dt), bounds(jnp.maximum(self.length, SHORTEST * dt))
        target = jnp.where(self.open, rest.target, rows.target)
        return dataclasses.replace(rows, target=target, acts=~(self.open & self.awaited[None]))


@pytree
class Sliding:
    """The contacts that slide at the start of a part.

    Attributes:
        speed: slip speed, (contacts,) [m/s]; zero for contacts that do not slide.
        way: direction of the slip, a Vector of (contacts,).
    """

    speed: Array
    way: Vector

    @classmethod
    def of(
        cls, rows: BoundRows, open_: Array, gap_curvature: Array, rounding: Array, dt: Array
    ) -> Sliding:
        """Returns speed and direction of the slip of closed contacts; slow slip counts as zero."""
        kinds, near = rows.kinds, rows.gap <= jnp.maximum(gap_curvature, rounding[None])
        slip, speeds = kinds.split(rows.rate).discs[0], kinds.split(gap_curvature).normal
        speed = numerics.norm(slip)
        fast = speed * dt[None] > SLIPS * speeds + rounding[None]
        slides = kinds.split(near & ~open_).normal & fast
        way = slip * numerics.safe_divide(1.0, speed)
        return cls(jnp.where(slides, speed, 0), way)

    def clearance(self, rows: BoundRows, multipliers: Array) -> Array:
        """Returns the slip left at the end of a part, (contacts,); negative if slip has ended.

        The result is d·u − v₀ (1 + d·λ_t/(μ λ_n)), where d is the direction of the slip and v₀ its
        speed. It crosses zero when the slip ends. The second term is nonzero for friction below its
        bound, and makes the slope continuous.
        """
        here, given = rows.kinds.split(rows.rate), rows.kinds.split(multipliers)
        used = numerics.safe_divide(self.way.dot(given.discs[0]), rows.friction * given.normal)
        spare = jnp.where(given.normal > 0, 1 + used, 0)
        return self.way.dot(here.discs[0]) - self.speed * spare


@pytree
class ContactForecast:
    """The state of rows at the start of a part, from which impacts in the part are predicted.

    Attributes:
        gap, rate: gap φ and rate φ̇ at the start of the part, (n,).
        gap_curvature: largest change ½ h² |J| |a| of a gap by accelerations in a step, (n,).
        rounding: rounding error of a gap, ().
        open: mask of the open rows, (n,).
        arriving: mask of the open rows whose gap is zero and closing, (n,).
        sliding: sliding contacts; None if the end of sliding is not to be detected.
    """

    gap: Array
    rate: Array
    gap_curvature: Array
    rounding: Array
    open: Array
    arriving: Array
    sliding: Sliding | None = None

    def watched(self, dt: Array) -> ContactForecast:
        """Returns the forecast with a further row for each contact; its gap is h times the slip."""
        if self.sliding is None:
            return self
        speed = self.sliding.speed
        slips = {"gap": dt[None] * speed, "rate": 0 * speed, "open": speed > 0}
        slips |= {"gap_curvature": 0 * speed, "arriving": jnp.zeros_like(slips["open"])}
        both = {name: jnp.concatenate([getattr(self, name), x]) for name, x in slips.items()}
        return dataclasses.replace(self, **both)


def forecast(
    rows: BoundRows, acceleration: Array, q: Array, dt: Array, slips: bool = False
) -> ContactForecast:
    """Returns the forecast of impacts, from the rows at the start of a part.

    Args:
        rows: inequality rows at the start.
        acceleration: acceleration a without inequality rows, (n_v,).
        q: positions, (n_q,).
        dt: step size h, () [s].
        slips: True to include the end of sliding.
    """
    size = 1 + jnp.max(jnp.abs(q), axis=0)
    rounding = ROUNDING * float(jnp.finfo(q.dtype).eps) * size
    gap_curvature = dt[None] ** 2 / 2 * rows.jacobian.reach(acceleration)
    rests = resting(rows, gap_curvature, rounding, dt)
    open_ = mask(rows.ends, rows) & ~rests & (rows.gap >= -rounding[None])
    arriving = open_ & (rows.gap <= rounding[None]) & (rows.rate < 0)
    sliding = (
        Sliding.of(rows, open_, gap_curvature, rounding, dt)
        if slips and rows.kinds.contacts
        else None
    )
    return ContactForecast(rows.gap, rows.rate, gap_curvature, rounding, open_, arriving, sliding)


def resting(rows: BoundRows, gap_curvature: Array, rounding: Array, dt: Array) -> Array:
    """Returns a mask of the rows at rest, (n,): their gap and speed are small."""
    near = rows.gap <= jnp.maximum(gap_curvature, rounding[None])
    return near & slow(rows, gap_curvature, rounding, dt)


def slow(rows: BoundRows, gap_curvature: Array, rounding: Array, dt: Array) -> Array:
    """Returns a mask of the rows no faster than accelerations could make them in a step, (n,)."""
    return jnp.abs(rows.rate) * dt[None] <= gap_curvature + rounding[None]


@pytree
class ImpactSet:
    """The rows that take part in an impact.

    Attributes:
        forecast: forecast of the part before the impact.
        first: mask of the row whose closing gap caused the impact, (n,).
        happens: True for worlds with an impact, ().
    """

    forecast: ContactForecast
    first: Array
    happens: Array

    def ask(self, rows: BoundRows, dt: Array) -> tuple[BoundRows, Array]:
        """Returns the rows with their targets for the impact, and a mask of the active rows.

        All rows in contact are active at once: no gap closes further, and rows that were closing
        leave with e |φ̇|.
        """
        gap_curvature, rounding = self.forecast.gap_curvature, self.forecast.rounding
        ends = mask(rows.ends, rows)
        touching = (
            self.first | (rows.gap <= rounding[None]) | resting(rows, gap_curvature, rounding, dt)
        )
        acts = mask(rows.hard, rows) & (touching | ~ends) & self.happens[None]
        tangents = mask(np.arange(rows.kinds.size) >= rows.kinds.normal + rows.kinds.contacts, rows)
        gap, target = (jnp.where(ends, 0, x) for x in (rows.gap, rows.target))
        e = rows.restitution
        if e is not None:
            e = jnp.where(acts & ~slow(rows, gap_curvature, rounding, dt), e, -1)
        with_targets = dataclasses.replace(rows, gap=gap, target=target, restitution=e, far=None)
        return with_targets, acts | tangents


def mask(flags: Sequence[bool] | np.ndarray, rows: BoundRows) -> Array:
    """Returns flags by row as an array (n,), with singleton axes for the batch."""
    return jnp.asarray(flags, bool).reshape(-1, *(1,) * (rows.gap.ndim - 1))
