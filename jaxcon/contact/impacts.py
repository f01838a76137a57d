"""Impacts within a plain step, which is not split at impacts: times, effects and derivatives.

An impact at time t + τ changes the velocities from v⁻ = v + τ a⁻ to v⁺ = v⁻ + Δv. Then the bodies
move on with other accelerations a⁺. At the end of a step h, with the remaining time r = h − τ,

    v_end = v + h a⁻ + Δv + r (a⁺ − a⁻),
    q_end = q ⊕ (h v + h² a⁻/2) ⊕ (r Δv + r² (a⁺ − a⁻)/2 − r² ω × Δω/2).

The derivatives of the terms in r with respect to τ are the extra terms of a saltation matrix. They
hold for every velocity that an impulse changes, also along tangents and through joints: such a
velocity is v⁻ before the impact and v⁺ after it.

After an impact without rebound, φ̇ = 0. The sign of φ̈ = J a⁺ + J̇ v⁺ then decides if the contact
opens: contact forces obey 0 ≤ λ ⊥ φ̈ ≥ 0 and Coulomb's law. For example, the end of a rod that
turns fast lifts off at once. In plain steps, too, the acceleration of rows that can have
impacts includes J̇ v. The next step therefore comes to the same decision, for any remaining time r.

The impulse is computed at the configuration of the impact q* = q ⊕ (τ v + τ² a⁻/2), not at the
start of the step. Otherwise the direction of the impulse would depend on τ if the normal turns
before the impact.

The protocol `Laws` stands for the contact solver, so that this module does not depend on a solver.

References:
    Kong, Payne, Zhu and Johnson, Saltation matrices: the essential tool for linearizing hybrid
        dynamical systems, Proceedings of the IEEE 112 (2024).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jaxcon.contact.parts import mask
from jaxcon.contact.rows import BoundLayout, BoundRows
from jaxcon.core import numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.staging.worlds import where_tree, where_wanted
from jaxcon.system.jump import Jump

if TYPE_CHECKING:
    from jaxcon.core.doubled import Doubled
    from jaxcon.protocols import System

ROUNDING = 64
"""The rounding error of a velocity, in floating-point spacings of the largest velocity."""

PREFIX = "gradients through impacts: "
"""The first words of the warning about derivatives through impacts."""

SLOW = 2
"""The impact speed, in units of h |a|, below which a row comes to rest without a rebound."""


class Seen(NamedTuple):
    """The label of the observations by which a step reports its impacts to `notices`.

    An observation has the mask of the rows that hit, (n,), the mask of the rows that bounce, (n,),
    the time, and the step size h.

    Attributes:
        layout: assignment of rows to elements.
    """

    layout: BoundLayout


class Found(NamedTuple):
    """The solution of the inequality constraints at one instant: an impact, or forces over a step.

    Attributes:
        change: velocity change Δv of an impact, or acceleration a, (n_v,).
        multipliers: impulses Λ or forces λ of inequality rows, (n,).
        joints: impulses Λ or forces λ of equality rows, (n_c,).
        residual, kept: largest violation of the laws, and fraction of the rebound kept, see
            `Reactions`, ().
    """

    change: Array
    multipliers: Array
    joints: Array
    residual: Array
    kept: Array


class Laws(Protocol):
    """The protocol by which an impact calls the dynamics, independent of the contact solver."""

    def rows(self, q: Array, v: Array, t: Doubled | Array) -> BoundRows:
        """Returns the inequality rows at a state."""
        ...

    def rate_change(self, rows: BoundRows, q: Array, v: Array, t: Doubled | Array) -> Array:
        """Returns h J̇ v, (n,): the change of the rows' φ̇ in a step of constant v."""
        ...

    def find(
        self, q: Array, v: Array, t: Doubled | Array, rows: BoundRows, acts: Array, lasts: Array
    ) -> Found:
        """Solves for the response to the active rows: an impact, or the forces of a step.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            rows: the inequality rows, with their targets.
            acts: mask of the active rows, (n,).
            lasts: True for the forces of a step, False for the impulses of an impact, ().
        """
        ...


@pytree
class Arrivals:
    """The rows whose gap closes within a step, and the times of closing.

    Attributes:
        hits: mask of the rows that close within the step by an impact, (n,).
        bounces: mask of the hitting rows that are fast enough to bounce, (n,).
        times: time τ of closing since the start of the step, (n,) [s].
        leads: weights of the row times in the impact time of each velocity, (n_v, n) or (1, n). The
            impact time of a velocity is the time of the first impact that changes it.
        touched: mask of the velocities that a hitting row changes, (n_v,).
        happens: True if there is an impact, ().
    """

    hits: Array
    bounces: Array
    times: Array
    leads: Array
    touched: Array
    happens: Array

    @property
    def first(self) -> Array:
        """The time τ of the first impact in each world, () [s]; zero without an impact."""
        least = jnp.min(jnp.where(self.hits, self.times, jnp.inf), axis=0)
        return jnp.where(self.happens, least, 0)

    @property
    def by_velocity(self) -> Array:
        """The impact time τ of each velocity, (n_v,) or (1,) [s]."""
        return jnp.sum(self.leads * self.times[None], axis=1)

    def refined(self, rows: BoundRows) -> Arrivals:
        """Refines the times by one Newton step on the gaps at the configuration of the impact.

        The parabolas of `arrive` neglect the rotation of normals, which the derivative of τ needs.
        """
        closing = self.hits & (rows.rate < -(float(jnp.finfo(rows.rate.dtype).tiny) ** 0.8))
        late = quotient(jnp.where(closing, rows.gap, 0), jnp.where(closing, -rows.rate, 1))
        late = rows.kinds.by_contact(jnp.where(jnp.abs(late) <= self.times, late, 0))
        return dataclasses.replace(self, times=self.times + late)


def candidates(rows: BoundRows, free: Array, dt: Array) -> Array:
    """Returns a mask of the rows that may hit within the step, (n,).

    Candidates have λ = 0 before the impact, which is harmless if their gap stays open. A row
    without restitution is a candidate only if it closes faster than accelerations change its rate
    in a step, h |J a|; slower rows rest and carry load. If it is in contact, it must close faster
    than the larger bound h |J| |a|. For example, J a is zero in a stack whose blocks fall together,
    and the rates are rounding errors.

    Args:
        rows: inequality rows at the start of the step.
        free: acceleration a without inequality rows, (n_v,).
        dt: step size h, () [s].
    """
    change, most = rows.change(free, dt), rows.largest_change(free, dt)
    e, least = rows.restitution, slowest(rows, change)
    rests = jnp.where(rows.gap > dt[None] * most, jnp.abs(change), most)
    rests = rests if e is None else jnp.where(e >= 0, 0, rests)
    least = least + rests
    reach = dt[None] * (jnp.abs(rows.rate) + 2 * jnp.abs(change))
    may = mask(rows.ends, rows) & (rows.rate < -least) & (rows.gap <= reach)
    return jax.lax.stop_gradient(may & (dt[None] > 0))


def slowest(rows: BoundRows, change: Array) -> Array:
    """Returns the rounding error of the rows' speeds, below which a row counts as at rest, (1,)."""
    numbers = jnp.finfo(rows.rate.dtype)
    size = jnp.maximum(jnp.abs(rows.rate), jnp.abs(change))
    rounding = ROUNDING * float(numbers.eps) * jnp.max(size, axis=0, keepdims=True)
    return jax.lax.stop_gradient(rounding + float(numbers.tiny) ** 0.8)


def quotient(x: Array, y: Array) -> Array:
    """Returns x / y for y that may be tiny.

    The derivative of a plain quotient contains 1/y², which overflows.
    """
    size = jax.lax.stop_gradient(1 / y)
    return (x * size) / (y * size)


def arrive(
    rows: BoundRows, may: Array, change: Array, lag: float, dt: Array, response: Array
) -> Arrivals:
    """Returns the rows that hit within the step, and their times.

    Args:
        rows: inequality rows at the start of the step. The time τ solves φ + τ u + ½ τ² c = 0, with
            the rate u from `at_start` and the acceleration c = J a⁻ + J̇ v of the gap.
        may: mask of the `candidates`, (n,).
        change: rate change h c over the step, (n,), with the forces of the other rows.
        lag: the delay of velocities behind positions, in units of h.
        dt: step size h, () [s].
        response: derivative ∂a/∂λ, (n_v, n), whose nonzeros show which row changes which velocity.
    """
    speed = -at_start(rows, change, lag)
    fast = may & (speed > 0)
    size = jnp.where(fast, speed, 1)
    gap = jnp.where(fast & (rows.gap > 0), rows.gap, 0)
    gap_curvature = numerics.safe_divide(change, dt[None])
    whole = quotient(gap, size)
    # the smaller root without cancellation; there is no root if the row reverses before impact
    root = numerics.safe_sqrt(1 - 2 * quotient(gap_curvature, size) * whole)
    τ = 2 * whole / (1 + root)
    hits = fast & (τ <= dt[None]) & (2 * gap_curvature * whole <= size)
    τ = jnp.where(hits, τ, 0)
    closing = speed - change * numerics.safe_divide(τ, dt[None])
    bounces = hits & (closing > SLOW * jnp.abs(change))
    all_hits, all_times = rows.kinds.by_contact(hits), rows.kinds.by_contact(τ)
    rounding = ROUNDING * float(jnp.finfo(τ.dtype).eps)
    size = jnp.max(jnp.abs(response), axis=0, keepdims=True)
    moved = all_hits[None] & (jnp.abs(response) > rounding * size)
    touched = jnp.any(moved, axis=1)
    moved = jnp.where(touched[:, None], moved, all_hits[None])
    delays = jnp.where(moved, all_times[None], jnp.inf)
    leads = (moved & (delays == jnp.min(delays, axis=1, keepdims=True))).astype(τ.dtype)
    leads = leads / jnp.maximum(jnp.sum(leads, axis=1, keepdims=True), 1)
    fixed = jax.lax.stop_gradient((hits, bounces, leads, touched, jnp.any(hits, axis=0)))
    hits, bounces, leads, touched, happens = fixed
    return Arrivals(hits, bounces, all_times, leads, touched, happens)


def passes_range(rows: BoundRows, speed: Array, time: Array) -> Array | None:
    """Tests whether a joint crosses the range between two elastic stops in a given time.

    Args:
        rows: inequality rows with both stops of each joint.
        speed: speed |θ̇| of each row, (n,), zero for rows to ignore.
        time: the given time for each row, (n,) [s].

    Returns:
        True for each world in which a joint crosses its range, (); None if no joint has two stops,
        or no row can bounce.
    """
    if rows.far is None or rows.restitution is None:
        return None
    return jnp.any((rows.restitution >= 0) & (speed * time > rows.gap + rows.far), axis=0)


def leaving_speeds(
    rows: BoundRows, e: Array, arrivals: Arrivals, change: Array, lag: float, dt: Array
) -> Array:
    """Returns the speeds of rows after an impact, e |φ̇|, (n,); zero for rows that do not bounce.

    Args:
        rows: inequality rows at the start of the step.
        e: coefficient of restitution, (n,).
        arrivals: the hitting rows and their times.
        change: rate change h c over the step, (n,), with the forces of the other rows.
        lag: the delay of velocities behind positions, in units of h.
        dt: step size h, () [s].
    """
    rate = at_start(rows, change, lag) + change * numerics.safe_divide(arrivals.times, dt[None])
    return jnp.where(arrivals.bounces, e * jnp.abs(rate), 0)


def at_start(rows: BoundRows, change: Array, lag: float) -> Array:
    """Returns φ̇ at the start of the step, (n,), from velocities at the time lag · h before it.

    Only forces change φ̇ between these two times, since `rows.rate` = J v already uses J at the
    start of the step.
    """
    forced = change if rows.rate_change is None else change - rows.rate_change
    return rows.rate + lag * forced


def at_impact(
    rows: BoundRows, arrivals: Arrivals, dt: Array, lasts: Array
) -> tuple[BoundRows, Array]:
    """Returns the rows with their targets for an impact, and a mask of the active rows, (n,).

    Hitting rows leave with e |φ̇|, or stay closed if they are slow. The targets of other rows allow
    their gaps to close within a step, so the impact does not push these bodies apart. Where
    `lasts`, (), is True, the result is for the motion after the impact: rows have the targets of a
    step and do not bounce.
    """
    ends, hits = mask(rows.ends, rows), arrivals.hits
    hard = mask(rows.hard, rows)
    nearing = numerics.safe_divide(-jnp.maximum(rows.gap, 0), dt[None])
    least = jnp.minimum(jnp.where(ends, nearing, rows.target), rows.rate)
    e = rows.restitution
    if e is not None:
        e = jnp.where(arrivals.bounces & ~lasts, e, -1)
    with_targets = dataclasses.replace(
        rows,
        gap=jnp.where(ends & ~lasts, 0, rows.gap),
        target=jnp.where(lasts, rows.target, jnp.where(hits | ~hard, 0, least)),
        restitution=e,
        far=None,
    )
    return with_targets, lasts | rows.kinds.by_contact(hard & arrivals.happens[None])


def closing(rows: BoundRows, change: Array, dt: Array) -> Array:
    """Returns a mask of the rows without restitution that close within the step, (n,).

    Args:
        rows: inequality rows at the start of the step. Rows at rest are not in the mask.
        change: rate change h J a without inequality rows, (n,).
        dt: step size h, () [s].
    """
    fast = rows.rate < -(jnp.abs(change) + slowest(rows, change))
    return mask(rows.ends, rows) & fast & (rows.gap > 0) & (rows.gap < -dt[None] * rows.rate)


def landing(rows: BoundRows, change: Array, dt: Array) -> BoundRows:
    """Sets the targets of contacts without restitution for a step in which they may land.

    A contact that closes after τ = s h has the velocity u⁻ until τ, and zero afterwards. The target
    of the step is the mean velocity, s u⁻, and the next step completes the impact. Along the normal
    this target closes the gap, and along the tangents it delays friction until τ. The impulses of
    the two steps are the fractions 1 − s and s of the whole impulse. One acts before and one after
    the impact, so the mean time and place are right. Unlike an `Impact`, this method costs nothing;
    it is meant for solvers that trade accuracy for speed.

    Args:
        rows: inequality rows at the start of the step.
        change: rate change h J a without inequality rows, (n,), a constant; rows that close no
            faster than |h J a| are at rest.
        dt: step size h, () [s].
    """
    kinds = rows.kinds
    if not kinds.contacts:
        return rows
    gap, rate = kinds.split(rows.gap).normal, kinds.split(rows.rate)
    least = kinds.split(jnp.abs(change) + slowest(rows, change)).normal
    way = -dt[None] * rate.normal
    closes = (rate.normal < -least) & (gap > 0) & (gap < way)
    share = quotient(jnp.where(closes, gap, 0), jnp.where(closes, way, 1))
    parts = kinds.split(rows.target)
    discs = tuple(u * disc.of(share) for disc, u in zip(kinds.discs, rate.discs, strict=True))
    return dataclasses.replace(rows, target=kinds.join(parts._replace(discs=discs)))


def doubt(rows: BoundRows, shares: str | None, some: bool) -> str | None:
    """Returns a warning if derivatives of plain steps through impacts may be wrong; else None.

    Args:
        rows: inequality rows; only their static fields are read.
        shares: name of the contact solver if it splits a landing between two steps, see `landing`;
            None for other solvers.
        some: True if the solver leaves rows out.
    """
    reasons = []
    if shares is not None and rows.lands:
        reasons.append(
            f"beside {shares} a landing of {', '.join(rows.lands)} takes two steps, so that"
            " where a body turns as it lands on a corner or on another body, its derivative is"
            " right only in the mean over the phases of a step;"
            " Method(contact_solver=InteriorPoint()), restitution=jnp.zeros(()) or"
            " Events() makes it one"
        )
    if some and any(rows.ends):
        reasons.append(
            "beside ActiveSet, impacts of several bodies within one step have the time of the"
            " first; InteriorPoint() alone, or Events(), tells them apart"
        )
    return f"{PREFIX}{'; '.join(reasons)}." if reasons else None


class ImpactOutcome(NamedTuple):
    """The effect of the impacts within a step.

    Attributes:
        jump: change of velocity and displacement at the end of the step.
        impulses: impulses to add to the impulses of the smooth forces.
        lost: True if a rebound crosses the whole range of its joint, (); None without pairs of
            elastic stops.
    """

    jump: Jump
    impulses: Found
    lost: Array | None


@pytree
class Impact:
    """The impacts within a step, and the motion before and after them.

    Attributes:
        laws: functions of the dynamics.
        system: system of bodies or generalized coordinates.
        q, v, t: the state at the start of the step.
        rows: inequality rows at that state, with their restitution. A joint with two stops has the
            row of the stop that acts.
        stops: inequality rows at that state, with the gaps of both stops of a joint.
        may: mask of the `candidates`, (n,).
        acceleration: acceleration a⁻ before the impact, (n_v,).
        multipliers, joints: forces λ of inequality rows, (n,), and of equality rows, (n_c,), before
            the impact.
        dt: step size h, () [s].
        response: derivative ∂a/∂λ, (n_v, n), or a mask of its nonzeros.
        lag: the delay of velocities behind positions, in units of h. If it is not 0, a body rotates
            once, by the sum of the displacements of the step and of the impact. If it is 0, the
            body rotates by the first, then by the second.
    """

    laws: Laws
    system: System
    q: Array
    v: Array
    t: Doubled | Array
    rows: BoundRows
    stops: BoundRows
    may: Array
    acceleration: Array
    multipliers: Array
    joints: Array
    dt: Array
    response: Array
    lag: float = static(default=0.0)

    def arrivals(self) -> Arrivals:
        """Returns the rows that hit within the step, with their times."""
        change = self.rows.change(self.acceleration, self.dt)
        return arrive(self.rows, self.may, change, self.lag, self.dt, self.response)

    def outcome(self) -> ImpactOutcome:
        """Computes the impacts in worlds with candidates; other worlds skip the computation."""
        return where_wanted(jnp.any(self.may, axis=0), Impact._strikes, self, self._still())

    def _still(self) -> ImpactOutcome:
        """Returns the outcome of a step without an impact: no jump and no impulses."""
        none, ones = jnp.zeros_like(self.v), jnp.ones(self.v.shape[1:], self.v.dtype)
        rows, joints = jnp.zeros_like(self.multipliers), jnp.zeros_like(self.joints)
        lost = passes_range(self.stops, 0 * self.stops.gap, 0 * self.stops.gap)
        return ImpactOutcome(Jump(none, none), Found(none, rows, joints, 0 * ones, ones), lost)

    def _strikes(self) -> ImpactOutcome:
        """Computes the impact, the motion after it, and the changes at the end of the step."""
        h, a = self.dt[None], self.acceleration
        arrivals = self.arrivals()
        lost = self._lost(arrivals)
        rows = self.laws.rows(*self._there(arrivals))
        arrivals = arrivals.refined(rows)
        place, before, time = self._there(arrivals)
        τ = arrivals.by_velocity

        def find(v: Array, lasts: Array) -> tuple[Array, Found]:
            there = self.laws.rows(place, v, time)
            rows, acts = at_impact(there, arrivals, self.dt, lasts)
            # a constant: its derivative would add O(r) to the motion after the impact
            change = jax.lax.stop_gradient(self.laws.rate_change(there, place, v, time))
            rows = dataclasses.replace(rows, rate_change=jnp.where(lasts, change, 0))
            solved = self.laws.find(place, v, time, rows, acts, lasts)
            return v + jnp.where(lasts, 0, solved.change), solved

        # a scan over both problems, impact and motion after it, halves the compile time
        _, solved = jax.lax.scan(find, before, jnp.asarray([False, True]))
        struck, after = (jax.tree.map(lambda x, i=i: x[i], solved) for i in range(2))
        rest, left = h - τ, (1 - self.lag) * h - τ
        # the gyroscopic acceleration before the impact differs from that at the start of the step
        smooth = self._gyroscopic(before) - self._gyroscopic(self.v)
        difference = jnp.where(arrivals.touched, after.change - a - smooth, 0)
        # a body turns by τ ω, then by r (ω + Δω). This rotation is ahead of the sum of both vectors
        # by ½ τ r ω × Δω, and behind the rotation h ω followed by r Δω by ½ r² ω × Δω
        across = self.system.coadjoint(place, before, struck.change)  # Δω × ω
        swing = (-τ if self.lag else rest) * rest / 2 * across
        travel = rest * struck.change + rest * rest / 2 * difference + swing
        jump = Jump(struck.change + left * difference, travel)
        share = ((1 - self.lag) * self.dt - arrivals.first)[None]
        joints = struck.joints + share * (after.joints - self.joints)
        # with a lag, the impact may come after the interval of the forces; the share of one-sided
        # rows is then zero, since a negative share would make them pull
        one_sided = rows.kinds.by_contact(mask(rows.ends, rows))
        share = jnp.where(one_sided, jnp.maximum(share, 0), share)
        impulses = struck.multipliers + share * (after.multipliers - self.multipliers)
        struck = struck._replace(multipliers=impulses, joints=joints)
        return where_tree(arrivals.happens, ImpactOutcome(jump, struck, lost), self._still())

    def _lost(self, arrivals: Arrivals) -> Array | None:
        """Returns True where a rebound crosses the whole range of its joint; see `passes_range`."""
        e, speed = self.rows.restitution, 0 * arrivals.times
        if e is not None:
            change = self.rows.change(self.acceleration, self.dt)
            speed = leaving_speeds(self.rows, e, arrivals, change, self.lag, self.dt)
        return passes_range(self.stops, speed, self.dt[None] - arrivals.times)

    def _there(self, arrivals: Arrivals) -> tuple[Array, Array, Doubled | Array]:
        """Returns the positions q*, the velocities v⁻ and the time of the impact."""
        h, a, τ = self.dt[None], self.acceleration, arrivals.by_velocity
        place = self.system.retract(self.q, τ * (self.v + (self.lag * h + τ / 2) * a))
        since = self.lag * h + τ
        # a fast-spinning body precesses before the impact, a first-order effect in the derivative
        turned = self._gyroscopic(self.v + since / 2 * a) - self._gyroscopic(self.v)
        return place, self.v + since * (a + turned), self.t + arrivals.first

    def _gyroscopic(self, v: Array) -> Array:
        """Returns the gyroscopic acceleration, (n_v,); zero if the system has equality rows."""
        if not self.system.turns_in_space or self.joints.size:
            return jnp.zeros_like(v)
        mass = self.system.mass(self.q)
        return mass.solve(self.system.coadjoint(self.q, v, mass.apply(v)))
