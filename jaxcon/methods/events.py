"""Splits steps at the times of impacts, so that integrators keep their order across impacts."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.contact.impacts import passes_range
from jaxcon.contact.parts import ContactForecast, ImpactSet, StepPart, forecast
from jaxcon.contact.response import Response, lost_impacts
from jaxcon.contact.rows import BoundRows, Reactions, has_ends, linearize_bounds
from jaxcon.core import checks, numerics, status
from jaxcon.core.doubled import rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree
from jaxcon.methods.arrival import Arrival, ArrivalSearch
from jaxcon.methods.attempt import attempt
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.staging.worlds import where_tree
from jaxcon.step import Dynamics, StepInfo
from jaxcon.system.state import State, at_instant, with_turns


@pytree
class Impacts:
    """The impacts at which a step was split, in order of time.

    Attributes:
        count: the number of impacts, ().
        times: time of each impact, (splits,) [s]; infinite beyond the last impact. Times have
            derivatives.
        elements: index in `names` of the element that each impact hits, (splits,); −1 beyond the
            last impact.
        names: names of all elements with inequality rows.
    """

    count: Array
    times: Array
    elements: Array
    names: tuple[str, ...] = static()

    def none(self) -> Impacts:
        """Returns a record without impacts, in arrays of the same size."""
        times, elements = jnp.full_like(self.times, jnp.inf), jnp.full_like(self.elements, -1)
        return Impacts(jnp.zeros_like(self.count), times, elements, self.names)


@pytree
class Events(checks.Checked):
    """Splits a step at the time of an impact on a hard stop, rope or contact.

    A row is open if its gap is not closed at the start of the step. Let F(x, s) be the method's
    step of length s in which open rows do not act. The step is split at the first time s* at which
    the gap φ of an open row closes:

        φ(F(x, s*)) = 0,    x⁺ = x⁻ ⊕ M⁻¹Jᵀ Λ(x⁻),  x⁻ = F(x, s*),    then F(x⁺, h − s*)

    Here x is the state, and ⊕ adds a change of velocity. An impact takes no time. Its impulses Λ
    obey the laws of a step without `Events`, for all touching rows at once: φ̇⁺ ≥ −e φ̇⁻ with the
    coefficient of restitution e, friction, and a cap on energy. Joints respond by impulses. In this
    way a step keeps the order of its integrator across an impact.

    The derivative of a step includes the derivative of the impact time, ∂s* = −∂φ/φ̇, by implicit
    differentiation. This is the term that a saltation matrix adds. First derivatives are exact for
    the computed step if φ̇ is more than a rounding error. At a grazing contact the time has no
    derivative, and zero is used. Second derivatives through an impact are finite, but wrong.

    After `splits` impacts, the remaining time is advanced by a plain step, without a split. If a
    joint would cross the whole range between two elastic stops in this time, the world ends with
    the status `LOST_IMPACTS`.

    Rows at rest act as in plain steps. A row is at rest if its gap is at most ½ h² |J||a| and its
    speed at most ½ h |J||a|, the changes that accelerations cause in a step. A ball that bounces
    ever lower thus comes to rest within one step of the exact time.

    An impact is missed if its row closes and opens again within one step. If gaps close twice in a
    step, the first closing may be missed, too. Soft stops and contacts, friction in joints and
    motors are forces and do not split a step. A step costs three or four plain steps. If some world
    of a batch has an impact, each evaluation at an estimate of s* costs one more plain step.

    Attributes:
        splits: the largest number of impacts in a step.
        iterations: the largest number of estimates of s*: secants, or bisection where a secant
            leaves the bracket. About four suffice if φ is nearly linear in a step.
        slips: True to split a step also at the time at which a sliding contact comes to rest.
            Friction is constant over a part of a step. Without `slips`, the place where a block
            stops is accurate to second order with Runge–Kutta methods, and its derivatives to first
            order.

    References:
        Kong, Payne, Zhu and Johnson, Saltation matrices: the essential tool for linearizing hybrid
            dynamical systems, Proceedings of the IEEE 112 (2024).
        Zhong, Han and Brikis, Differentiable physics simulations with contacts: do they have
            correct gradients w.r.t. position, velocity and control? (2022).
    """

    splits: int = static(default=1)
    iterations: int = static(default=12)
    slips: bool = static(default=False)

    def check(self) -> None:
        """Checks `splits`, `iterations` and `slips`.

        Raises:
            ValueError: `splits` or `iterations` is not a positive integer, or `slips` is not a
                bool.
        """
        checks.count("Events", "splits", self.splits)
        checks.count("Events", "iterations", self.iterations)
        checks.flag("Events", "slips", self.slips)

    def attempt(
        self, system: System, method: Method, state: State, control: PyTree, dt: Array
    ) -> tuple[tuple[State, StepInfo], Array]:
        """Makes a step that is split at impacts.

        Args:
            system: the system to step.
            method: the simulation method.
            state: state at the start of the step.
            control: control input u, as arrays.
            dt: step size h, () [s].

        Returns:
            ((new state, info of the step), status of this step alone).
        """
        if not has_ends(with_turns(system, state.turns), state.q, state.v, state.time, control, dt):
            return attempt(system, method, state, control, dt)
        world = World(system, method, control, dt)
        rows = jax.eval_shape(world.rows, state)
        zero = 0 * state.time  # has a (zero) tangent, which saves a round of tracing
        none = jnp.broadcast_to(zero[None], rows.gap.shape)
        start = SplitProgress(
            state,
            jnp.broadcast_to(dt, zero.shape),
            jnp.ones(zero.shape, bool),
            jnp.zeros_like(state.status),
            none,
            zero,
            zero + 1,
            None if rows.direction is None else none + 1,
        )
        awaited = jnp.arange(self.splits + 1) < self.splits
        done, (infos, impacts) = jax.lax.scan(world.go, start, awaited)
        first = jax.tree.map(lambda x: x[0], infos)
        mean = numerics.safe_divide(done.impulses, dt[None])
        gap = world.rows(state).gap
        reactions = Reactions(
            mean, gap, done.residual, done.kept, None, rows.layout, done.direction
        )
        new = at_instant(done.state, state.instant + dt)
        happened, times, hit = (x[:-1] for x in impacts)  # the last part ends without an impact
        impacts = Impacts(
            jnp.sum(happened, axis=0, dtype=jnp.int32),
            jnp.where(happened, times, jnp.inf),
            jnp.where(happened, jnp.asarray(rows.layout.owners)[hit], -1),
            rows.layout.names,
        )
        info = dataclasses.replace(first, status=done.code, reactions=reactions, impacts=impacts)
        return (new, info), done.code


class EventImpact(NamedTuple):
    """The impact that may end a part of a step.

    Attributes:
        happened: True if an impact ended the part, ().
        time: time of the end of the part, () [s].
        row: index of the row whose closing gap caused the impact, (); 0 without an impact.
    """

    happened: Array
    time: Array
    row: Array


class Impulses(NamedTuple):
    """Impulses of inequality rows during a part of a step, or in an impact.

    Attributes:
        multipliers: impulses ∫λ dt, (n,) [N s, N m s].
        residual, kept, direction: the fields of `Reactions` with these names.
    """

    multipliers: Array
    residual: Array
    kept: Array
    direction: Array | None


class Passed(NamedTuple):
    """The result of a part of a step.

    Attributes:
        state: state at the end of the part.
        seen: `StepInfo` at the start of the part, without reactions.
        code: status of the part.
        impulses: impulses of the inequality rows during the part.
    """

    state: State
    seen: StepInfo
    code: Array
    impulses: Impulses


class SplitProgress(NamedTuple):
    """The progress of a split step, for each world.

    Attributes:
        state: state at the end of the last part.
        left: remaining time of the step, () [s].
        active: True if the step is not finished, ().
        code: status of the parts so far, ().
        impulses: impulses of the inequality rows so far, (n,).
        residual, kept: the largest `residual` and the smallest `kept` of `Reactions` so far, ().
        direction: `Reactions.direction` of the last stops that acted, (n,); None without stops.
    """

    state: State
    left: Array
    active: Array
    code: Array
    impulses: Array
    residual: Array
    kept: Array
    direction: Array | None

    def beyond(self, impulses: Impulses) -> SplitProgress:
        """Returns the progress with the impulses of one more part or impact added."""
        direction = impulses.direction
        if direction is not None and self.direction is not None:
            direction = jnp.where(impulses.multipliers == 0, self.direction, direction)
        return self._replace(
            impulses=self.impulses + impulses.multipliers,
            residual=jnp.maximum(self.residual, impulses.residual),
            kept=jnp.minimum(self.kept, impulses.kept),
            direction=direction,
        )


@pytree
class World:
    """The arguments of a split step that do not change during it.

    Attributes:
        system, method, control: the arguments of `jc.step`.
        dt: step size h, () [s].
    """

    system: System
    method: Method
    control: PyTree
    dt: Array

    @property
    def events(self) -> Events:
        """The options by which the step is split: `Method.events`."""
        assert self.method.events is not None
        return self.method.events

    def part(self, state: State, part: StepPart) -> Passed:
        """Advances a state by a part of the step, but its memory by the whole step."""
        (new, info), code = attempt(self.system, self.method, state, self.control, self.dt, part)
        reactions = info.reactions
        impulses = Impulses(
            part.length[None] * reactions.multipliers,
            reactions.residual,
            reactions.kept,
            reactions.direction,
        )
        return Passed(new, dataclasses.replace(info, reactions=None), code, impulses)

    def rows(self, state: State) -> BoundRows:
        """Returns the inequality rows, linearized at a state."""
        system = with_turns(self.system, state.turns, state.angle_remainder)
        here = state.q, state.v, state.instant
        return linearize_bounds(system, *here, self.control, self.dt)

    def dynamics(self, state: State) -> tuple[Dynamics, Response]:
        """Returns the equations of motion at a state, and the response of their inequality rows."""
        system = with_turns(self.system, state.turns, state.angle_remainder)
        dynamics = self.method.dynamics(system, state, self.control, self.dt)
        assert dynamics.contact is not None
        return dynamics, dynamics.contact

    def forecast(self, state: State) -> ContactForecast:
        """Returns the gaps and rates at a state from which later impacts are predicted."""
        dynamics, response = self.dynamics(state)
        free = response.without(dynamics, state.q, state.v, state.instant)
        return forecast(self.rows(state), free, state.q, self.dt, self.events.slips)

    def clearances(self, forecast: ContactForecast, passed: Passed) -> Array:
        """Returns the numbers at the end of a part whose zeros end it: gaps and slips.

        The gaps of all rows, (n,), come first. If the end of sliding is predicted, h times the
        remaining slip of each contact is appended, (contacts,).
        """
        rows = self.rows(passed.state)
        if forecast.sliding is None:
            return rows.gap
        slips = forecast.sliding.clearance(rows, passed.impulses.multipliers)
        return jnp.concatenate([rows.gap, self.dt[None] * slips])

    def go(
        self, progress: SplitProgress, awaited: Array
    ) -> tuple[SplitProgress, tuple[StepInfo, EventImpact]]:
        """Advances to the next impact if `awaited` is True, otherwise to the end of the step.

        Worlds that have finished the step do not change.

        Args:
            progress: the progress of the step so far.
            awaited: True if another impact may split the step, ().

        Returns:
            The new progress; and a pair (info at the start of the part, impact that ends it).
        """
        state, active = progress.state, progress.active
        length = jnp.where(active, progress.left, self.dt / 2)  # unused, but valid, if finished
        still, at, most = jax.lax.stop_gradient((self, state, length))
        forecast, awaited = still.forecast(at), active & awaited

        def gaps(s: Array) -> Array:
            return still.clearances(forecast, still.part(at, StepPart(s, forecast.open, awaited)))

        watched, tries = forecast.watched(still.dt), self.events.iterations
        bracket = ArrivalSearch(gaps, watched, most, awaited, tries).run()
        hit = bracket.happens & (bracket.row < len(forecast.gap))
        time = jnp.where(bracket.happens, bracket.here, length)
        least = forecast.rounding / jnp.where(still.dt > 0, still.dt, 1)
        given = (self, state, forecast, awaited, bracket.row)
        passed, time = Arrival(flow, gap_of)(given, time, bracket.happens, least)
        there = dataclasses.replace(passed.state, memory=state.memory)
        struck = ImpactSet(forecast, chosen(bracket.row, forecast.open), hit)
        jump, impulses = jax.lax.cond(
            somewhere(hit), strike, no_strike, self, there, struck, progress.direction
        )
        final = where_tree(
            bracket.happens, dataclasses.replace(there, v=there.v + jump), passed.state
        )
        rows = still.rows(at)
        speed = jnp.where(awaited[None], 0, jnp.abs(rows.rate))
        lost = passes_range(rows, speed, length[None])
        code = status.first(progress.code, lost_impacts(passed.code, lost))
        new = progress._replace(state=final, left=length - time, active=bracket.happens, code=code)
        new = new.beyond(passed.impulses).beyond(impulses)
        impact = EventImpact(hit, rounded(state.instant + time), jnp.where(hit, bracket.row, 0))
        return where_tree(active, new, progress), (passed.seen, impact)


Given = tuple[World, State, ContactForecast, Array, Array]
"""The argument x of a flow: world, state, forecast, `awaited`, and the index of the closing row."""


def flow(given: Given, s: Array) -> Passed:
    """Returns F(x, s) for x = `given`: the result of a part of the step of length s."""
    world, state, forecast, awaited, _ = given
    return world.part(state, StepPart(s, forecast.open, awaited))


def gap_of(given: Given, passed: Passed) -> Array:
    """Returns the gap φ of the closing row at the end of a part, ()."""
    world, _, forecast, _, row = given
    gaps = world.clearances(forecast, passed)
    return jnp.sum(jnp.where(chosen(row, gaps), gaps, 0), axis=0)


def chosen(row: Array, like: Array) -> Array:
    """Returns a mask of the n rows of `like` that is True at the index `row`, (n,)."""
    rows = jnp.arange(len(like), dtype=row.dtype)
    return rows.reshape(-1, *(1,) * row.ndim) == row[None]


def strike(
    world: World, state: State, struck: ImpactSet, direction: Array | None
) -> tuple[Array, Impulses]:
    """Returns the velocity change Δv, (n_v,), and the impulses of an impact on rows `struck`."""
    dynamics, response = world.dynamics(state)
    jump, reactions = response.impact(dynamics, state.q, state.v, state.instant, struck)
    return jump, Impulses(
        reactions.multipliers, reactions.residual, reactions.kept, reactions.direction
    )


def no_strike(
    world: World, state: State, struck: ImpactSet, direction: Array | None
) -> tuple[Array, Impulses]:
    """Replaces `strike` if there is no impact: returns Δv = 0, (n_v,), and zero impulses."""
    none, zero = jnp.zeros_like(struck.forecast.gap), jnp.zeros_like(state.time)
    return jnp.zeros_like(state.v), Impulses(none, zero, zero + 1, direction)
