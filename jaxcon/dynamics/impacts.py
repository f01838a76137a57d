"""Impacts within a plain step: when they are, what they do, and the derivative of both.

An impact at t + τ takes the velocities v⁻ = v + τ a⁻ to v⁺ = v⁻ + Δv; then the bodies move on with
other accelerations a⁺. At the end of a step h, with r = h − τ the rest of it,

    v_end = v + h a⁻ + Δv + r (a⁺ − a⁻),
    q_end = q ⊕ (h v + h² a⁻/2) ⊕ (r Δv + r² (a⁺ − a⁻)/2 − r² ω × Δω/2).

The derivative of the last term in each line by τ is what a saltation matrix adds: everything that
an impulse moves, along tangents and through joints too, moves with v⁻ before τ and with v⁺ after.

After an impact without rebound φ̇ = 0, and φ̈ = J a⁺ + J̇ v⁺ decides what follows: the contact
forces obey 0 ≤ λ ⊥ φ̈ ≥ 0 and Coulomb's law. The end of a rod that turns fast lifts off at once.
Plain steps of rows that make impacts contain J̇ v, too, so that the next step comes to the same
decision, however long the rest r is.

The impulse is found at the place of the impact q* = q ⊕ (τ v + τ² a⁻/2), not at the start of the
step: a normal that turns on the way would turn the impulse with it, by the phase of τ in the step.

Nothing here knows how impulses are found. `Laws` says what is asked of a contact solver.

References:
    Kong, Payne, Zhu and Johnson, Saltation matrices: the essential tool for linearizing hybrid
        dynamical systems, Proceedings of the IEEE 112 (2024).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.bound_layout import BoundLayout
from jaxcon.constraints.bounds import BoundRows
from jaxcon.core import numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.core.worlds import keep, where_wanted
from jaxcon.dynamics.parts import mask
from jaxcon.solvers.saddle import Solution

ROUNDING = 64
"""The rounding error of a velocity, in spacings of the largest one at hand."""

PREFIX = "gradients through impacts: "
"""How the warning begins."""

SLOW = 2
"""Impacts slower than this many times h |a| do not bounce: the row comes to rest."""


class Seen(NamedTuple):
    """The kind of observations of impacts: rows that hit (n,), those that bounce (n,), time, h.

    Attributes:
        layout: rows by element.
    """

    layout: BoundLayout


@pytree
class Jump:
    """The change of velocity and displacement that impacts cause at the end of a step.

    Attributes:
        velocity: Δv + (a⁺ − a⁻) r, (n_v,).
        travel: what it adds to the displacement of the step, (n_v,) [m, rad].
    """

    velocity: Array
    travel: Array


def jump_of(reactions: Any) -> Jump | None:
    """The jump of a step by its reactions; None where there are none, or no impacts to come."""
    return None if reactions is None else reactions.jump


def with_jump(solution: Solution, jump: Jump | None, dt: Any) -> Solution:
    """The solution with the mean acceleration over a step of dt, its impacts included."""
    if jump is None:
        return solution
    a = solution.acceleration + numerics.safe_divide(jump.velocity, dt[None])
    return solution._replace(acceleration=a)


class Found(NamedTuple):
    """The solution of the inequality constraints at one instant, at an impact or over a step.

    Attributes:
        change: Δv of an impact, or a, (n_v,).
        multipliers: Λ or λ of bounded rows, (n,).
        joints: likewise of equality rows, (n_c,).
        residual, kept: as of `Reactions`, ().
    """

    change: Array
    multipliers: Array
    joints: Array
    residual: Array
    kept: Array


class Laws(Protocol):
    """The part of the dynamics that an impact uses, whichever solver finds the multipliers."""

    def rows(self, q: Array, v: Array, t: Any) -> BoundRows:
        """The bounded rows at a state."""
        ...

    def rate_change(self, rows: BoundRows, q: Array, v: Array, t: Any) -> Array:
        """The `rate_change` of the bounded rows at a state, (n,)."""
        ...

    def find(self, q: Array, v: Array, t: Any, rows: BoundRows, acts: Array, lasts: Array) -> Found:
        """The impulses of the rows that act; or, where it lasts, (), the forces over a step."""
        ...


@pytree
class Arrivals:
    """Which rows arrive within a step, and when.

    Attributes:
        hits: rows that close within the step by an impact, (n,).
        bounces: those of them that are fast enough to bounce, (n,).
        times: τ by row, (n,) [s].
        leads: shares of rows in the time of each velocity, that of the first impact that changes
            it, (n_v, n) or (1, n).
        touched: velocities that an arriving row moves, (n_v,).
        happens: whether there is an impact, ().
    """

    hits: Array
    bounces: Array
    times: Array
    leads: Array
    touched: Array
    happens: Array

    @property
    def first(self) -> Array:
        """The first τ of the world, () [s]; zero where there is none."""
        least = jnp.min(jnp.where(self.hits, self.times, jnp.inf), axis=0)
        return jnp.where(self.happens, least, 0)

    @property
    def by_velocity(self) -> Array:
        """τ by velocity, (n_v,) or (1,) [s]."""
        return jnp.sum(self.leads * self.times[None], axis=1)

    def refined(self, rows: BoundRows) -> Arrivals:
        """Refines the times by one Newton step on the gaps at the place of the impact.

        Parabolas do not know how a normal turns on the way, and of τ the derivative counts.
        """
        closing = self.hits & (rows.rate < -(float(jnp.finfo(rows.rate.dtype).tiny) ** 0.8))
        late = quotient(jnp.where(closing, rows.gap, 0), jnp.where(closing, -rows.rate, 1))
        late = rows.kinds.by_contact(jnp.where(jnp.abs(late) <= self.times, late, 0))
        return dataclasses.replace(self, times=self.times + late)


def candidates(rows: BoundRows, free: Array, dt: Array) -> Array:
    """Rows that may arrive within the step, (n,): they make an impact, and bear nothing till then.

    One too many does no harm where it stays open. Rows without restitution must be faster than
    what accelerations make in a step: slower ones rest, and bear what presses on them. Rows that
    touch must be faster than what accelerations could make. In a stack, whose blocks fall together
    without contacts, J a is zero, and rates are rounding.

    Args:
        rows: the bounded rows at the start of the step.
        free: a without bounded rows, (n_v,).
        dt: h, () [s].
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
    """The speed below which a row cannot be told from one at rest, (1,)."""
    numbers = jnp.finfo(rows.rate.dtype)
    size = jnp.maximum(jnp.abs(rows.rate), jnp.abs(change))
    rounding = ROUNDING * float(numbers.eps) * jnp.max(size, axis=0, keepdims=True)
    return jax.lax.stop_gradient(rounding + float(numbers.tiny) ** 0.8)


def quotient(x: Array, y: Array) -> Array:
    """x / y where y may be tiny: the derivative of a plain quotient has 1/y², which overflows."""
    size = jax.lax.stop_gradient(1 / y)
    return (x * size) / (y * size)


def arrive(
    rows: BoundRows, may: Array, change: Array, lag: Any, dt: Array, response: Array | None
) -> Arrivals:
    """Which rows arrive, after φ + τ u + ½ τ² c = 0 with u from `at_start` and c = J a⁻ + J̇ v.

    Args:
        rows: the bounded rows at the start of the step.
        may: the `candidates`, (n,).
        change: h c, (n,), with the forces of the other rows.
        lag: velocities are those of lag · h before the positions.
        dt: h, () [s].
        response: ∂a/∂λ, (n_v, n), whose pattern says which row moves which velocity; None where
            that is not known.
    """
    speed = -at_start(rows, change, lag)
    fast = may & (speed > 0)
    size = jnp.where(fast, speed, 1)
    gap = jnp.where(fast & (rows.gap > 0), rows.gap, 0)
    bend = numerics.safe_divide(change, dt[None])
    whole = quotient(gap, size)
    # the smaller root in a form that subtracts nothing; no root where the row turns round
    root = numerics.safe_sqrt(1 - 2 * quotient(bend, size) * whole)
    τ = 2 * whole / (1 + root)
    hits = fast & (τ <= dt[None]) & (2 * bend * whole <= size)
    τ = jnp.where(hits, τ, 0)
    closing = speed - change * numerics.safe_divide(τ, dt[None])
    bounces = hits & (closing > SLOW * jnp.abs(change))
    all_hits, all_times = rows.kinds.by_contact(hits), rows.kinds.by_contact(τ)
    if response is None:
        # weights that do not cancel where two rows pull on one body
        weights = (1 + np.arange(len(τ)) / len(τ)).reshape(-1, *(1,) * (τ.ndim - 1))
        pulls = jnp.where(all_hits, jnp.asarray(weights, τ.dtype), 0)
        moved, touched = all_hits[None], rows.jacobian.transpose(pulls) != 0
    else:
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
    """Returns True where a joint crosses the range between two elastic stops in a time, or None.

    Args:
        rows: as they are linearized, with both stops.
        speed: |θ̇|, (n,), zero for rows that are not asked for.
        time: (n,) [s].

    Returns:
        By world, ().
    """
    if rows.far is None or rows.restitution is None:
        return None
    return jnp.any((rows.restitution >= 0) & (speed * time > rows.gap + rows.far), axis=0)


def leaving_speeds(
    rows: BoundRows, e: Array, arrivals: Arrivals, change: Array, lag: Any, dt: Array
) -> Array:
    """The speeds with which rows leave after an impact, e |φ̇|, (n,); zero for those that stay.

    Args:
        rows: the bounded rows at the start of the step.
        e: restitution, (n,).
        arrivals: which arrive, and when.
        change: h c, (n,), with the forces of the other rows.
        lag: velocities are those of lag · h before the positions.
        dt: h, () [s].
    """
    rate = at_start(rows, change, lag) + change * numerics.safe_divide(arrivals.times, dt[None])
    return jnp.where(arrivals.bounces, e * jnp.abs(rate), 0)


def at_start(rows: BoundRows, change: Array, lag: Any) -> Array:
    """φ̇ at the start of the step, (n,), of rows whose velocities are those of lag · h before.

    Only forces have changed it since, as J of `rows.rate` = J v is that of the start already.
    """
    forced = change if rows.rate_change is None else change - rows.rate_change
    return rows.rate + lag * forced


def at_impact(
    rows: BoundRows, arrivals: Arrivals, dt: Array, lasts: Array
) -> tuple[BoundRows, Array]:
    """Returns the rows with their targets for an impact, and a mask of those that act, (n,).

    Rows that arrive leave with e |φ̇|, or stay if they are slow. The others may close their gap in
    the time of a step, and none is driven apart by the impact of others. Where it lasts, (), this
    is the motion after the impact, in which rows want what they want of a step and none bounces.
    """
    ends, hits = mask(rows.ends, rows), arrivals.hits
    hard = mask(rows.hard, rows)
    nearing = numerics.safe_divide(-jnp.maximum(rows.gap, 0), dt[None])
    least = jnp.minimum(jnp.where(ends, nearing, rows.target), rows.rate)
    e = rows.restitution
    if e is not None:
        e = jnp.where(arrivals.bounces & ~lasts, e, -1)
    asked = dataclasses.replace(
        rows,
        gap=jnp.where(ends & ~lasts, 0, rows.gap),
        target=jnp.where(lasts, rows.target, jnp.where(hits | ~hard, 0, least)),
        restitution=e,
        far=None,
    )
    return asked, lasts | rows.kinds.by_contact(hard & arrivals.happens[None])


def closing(rows: BoundRows, change: Array, dt: Array) -> Array:
    """Rows without restitution that close within the step and do not rest, (n,).

    Args:
        rows: the bounded rows at the start of the step.
        change: h J a without bounded rows, (n,).
        dt: h, () [s].
    """
    fast = rows.rate < -(jnp.abs(change) + slowest(rows, change))
    return mask(rows.ends, rows) & fast & (rows.gap > 0) & (rows.gap < -dt[None] * rows.rate)


def landing(rows: BoundRows, change: Array, dt: Array) -> BoundRows:
    """Sets the targets of contacts without restitution for a step in which they may land.

    A contact that closes after τ = s h is to end the step with the mean of its velocity over it:
    s u⁻ along the normal, which closes the gap, and as much along the tangents, which holds
    friction back until τ. The next step does the rest of the impact. As both impulses are the
    shares 1 − s and s of one, at the places before and after, the two steps have the time of the
    impact and its place in the mean. That costs nothing, unlike an `Impact`, and is for solvers
    that trade accuracy for speed.

    Args:
        rows: the bounded rows at the start of the step.
        change: h J a without bounded rows, (n,), a constant: what is no faster rests.
        dt: h, () [s].
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
    """Why derivatives of plain steps through impacts may be wrong, by structure; None if not.

    Args:
        rows: the bounded rows; only their static fields are read.
        shares: the solver beside which `landing` shares a landing over two steps; None if none.
        some: whether the solver leaves rows out.
    """
    reasons = []
    if shares is not None and rows.lands:
        reasons.append(
            f"beside {shares} a landing of {', '.join(rows.lands)} takes two steps, so that"
            " where a body turns as it lands on a corner or on another body, its derivative is"
            " right only in the mean over the phases of a step; Method(bounded=InteriorPoint()),"
            " restitution=jnp.zeros(()) or Events() makes it one"
        )
    if some and any(rows.ends):
        reasons.append(
            "beside Nearest, impacts of several bodies within one step have the time of the first;"
            " InteriorPoint() alone, or Events(), tells them apart"
        )
    return f"{PREFIX}{'; '.join(reasons)}." if reasons else None


class Outcome(NamedTuple):
    """The effect of the impacts within a step.

    Attributes:
        jump: the change of velocity and displacement at the end of the step.
        impulses: the impulses added to those of the smooth forces.
        lost: the result of `passes_range` for the rebound, (); None without elastic stops in pairs.
    """

    jump: Jump
    impulses: Found
    lost: Array | None


@pytree
class Impact:
    """The impact of a step, between what leads to it and what follows.

    Attributes:
        laws: of the dynamics.
        system: of bodies or generalized coordinates.
        q, v, t: the state at the start of the step.
        rows: the bounded rows there, with the stops that they face and their restitution.
        stops: the rows as they are linearized, with both stops of a joint.
        may: the `candidates`, (n,).
        acceleration: a⁻, (n_v,).
        multipliers, joints: λ of bounded rows and of equality rows before it, (n,) and (n_c,).
        dt: h, () [s].
        response: ∂a/∂λ, (n_v, n); None where it is not known.
        lag: velocities are those of lag · h before the positions; where it is not 0, the travel is
            added to the displacement of the step before bodies turn by the sum.
    """

    laws: Laws
    system: Any
    q: Array
    v: Array
    t: Any
    rows: BoundRows
    stops: BoundRows
    may: Array
    acceleration: Array
    multipliers: Array
    joints: Array
    dt: Array
    response: Array | None
    lag: float = static(default=0.0)

    def arrivals(self) -> Arrivals:
        """The rows that arrive within the step, with their times."""
        change = self.rows.change(self.acceleration, self.dt)
        return arrive(self.rows, self.may, change, self.lag, self.dt, self.response)

    def outcome(self) -> Outcome:
        """Computes the impact in the worlds that have candidates for one; others skip it."""
        return where_wanted(jnp.any(self.may, axis=0), Impact._strikes, self, self._still())

    def _still(self) -> Outcome:
        """The outcome of a step without an impact."""
        none, one = jnp.zeros_like(self.v), jnp.ones(self.v.shape[1:], self.v.dtype)
        rows, joints = jnp.zeros_like(self.multipliers), jnp.zeros_like(self.joints)
        lost = passes_range(self.stops, 0 * self.stops.gap, 0 * self.stops.gap)
        return Outcome(Jump(none, none), Found(none, rows, joints, 0 * one, one), lost)

    def _strikes(self) -> Outcome:
        h, a = self.dt[None], self.acceleration
        arrivals = self.arrivals()
        lost = self._lost(arrivals)
        rows = self.laws.rows(*self._there(arrivals))
        arrivals = arrivals.refined(rows)
        place, before, time = self._there(arrivals)
        τ = arrivals.by_velocity

        def find(v: Array, lasts: Array) -> tuple[Array, Found]:
            known = self.laws.rows(place, v, time)
            rows, acts = at_impact(known, arrivals, self.dt, lasts)
            # its derivative would add O(r) to that of the motion after the impact
            change = jax.lax.stop_gradient(self.laws.rate_change(known, place, v, time))
            rows = dataclasses.replace(rows, rate_change=jnp.where(lasts, change, 0))
            found = self.laws.find(place, v, time, rows, acts, lasts)
            return v + jnp.where(lasts, 0, found.change), found

        # the impact and what follows are one program, which halves what there is to compile
        _, found = jax.lax.scan(find, before, jnp.asarray([False, True]))
        struck, after = (jax.tree.map(lambda x, i=i: x[i], found) for i in range(2))
        rest, left = h - τ, (1 - self.lag) * h - τ
        # from the acceleration just before the impact, not from that at the start of the step
        smooth = self._gyroscopic(before) - self._gyroscopic(self.v)
        more = jnp.where(arrivals.touched, after.change - a - smooth, 0)
        # bodies that turn by τ ω, then by r (ω + Δω), are ahead of the sum of both turns by
        # ½ τ r ω × Δω, and behind h ω followed by r Δω by ½ r² ω × Δω
        across = self.system.coadjoint(place, before, struck.change)  # Δω × ω
        swing = (-τ if self.lag else rest) * rest / 2 * across
        travel = rest * struck.change + rest * rest / 2 * more + swing
        jump = Jump(struck.change + left * more, travel)
        share = ((1 - self.lag) * self.dt - arrivals.first)[None]
        joints = struck.joints + share * (after.joints - self.joints)
        # forces of half a step before positions may end before the impact; one-sided rows then have
        # no share in it, as they would pull
        one_sided = rows.kinds.by_contact(mask(rows.ends, rows))
        share = jnp.where(one_sided, jnp.maximum(share, 0), share)
        impulses = struck.multipliers + share * (after.multipliers - self.multipliers)
        struck = struck._replace(multipliers=impulses, joints=joints)
        return keep(arrivals.happens, Outcome(jump, struck, lost), self._still())

    def _lost(self, arrivals: Arrivals) -> Array | None:
        """The result of `passes_range` for the rebound."""
        e, speed = self.rows.restitution, 0 * arrivals.times
        if e is not None:
            change = self.rows.change(self.acceleration, self.dt)
            speed = leaving_speeds(self.rows, e, arrivals, change, self.lag, self.dt)
        return passes_range(self.stops, speed, self.dt[None] - arrivals.times)

    def _there(self, arrivals: Arrivals) -> tuple[Array, Array, Array]:
        """q*, v⁻ and the time of the impact."""
        h, a, τ = self.dt[None], self.acceleration, arrivals.by_velocity
        place = self.system.retract(self.q, τ * (self.v + (self.lag * h + τ / 2) * a))
        since = self.lag * h + τ
        # a body that spins fast precesses on the way, which is of first order in the derivative
        turned = self._gyroscopic(self.v + since / 2 * a) - self._gyroscopic(self.v)
        return place, self.v + since * (a + turned), self.t + arrivals.first

    def _gyroscopic(self, v: Array) -> Array:
        """The gyroscopic acceleration of bodies without joints, (n_v,); of others zero."""
        if not self.system.turns_in_space or self.joints.size:
            return jnp.zeros_like(v)
        mass = self.system.mass(self.q)
        return mass.solve(self.system.coadjoint(self.q, v, mass.apply(v)))
