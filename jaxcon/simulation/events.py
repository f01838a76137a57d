"""Steps that are split at the time of an impact."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.bound_layout import BoundLayout, Reactions
from jaxcon.constraints.bounds import BoundRows, has_ends
from jaxcon.core import checks, numerics, status
from jaxcon.core.doubled import rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.dynamics.forward import lost_impacts
from jaxcon.dynamics.impacts import passes_range
from jaxcon.dynamics.parts import Outlook, Part, Struck, look
from jaxcon.model.state import State, at_instant, recall
from jaxcon.simulation.arrival import Arrival, Search
from jaxcon.simulation.attempt import StepInfo, attempt, dynamics_at
from jaxcon.simulation.method import Method


@pytree
class Impacts:
    """The impacts at which a step was split, in order.

    Attributes:
        count: how many, ().
        times: of each, (splits,) [s]; infinite beyond the last. They have derivatives.
        elements: which element of `names` made each, (splits,); −1 beyond the last.
        names: of all elements with bounded rows.
    """

    count: Array
    times: Array
    elements: Array
    names: tuple[str, ...] = static()

    def none(self) -> Impacts:
        """No impacts, of as many."""
        times, elements = jnp.full_like(self.times, jnp.inf), jnp.full_like(self.elements, -1)
        return Impacts(jnp.zeros_like(self.count), times, elements, self.names)


@pytree
class Events(checks.Checked):
    """A step is split where a hard stop, rope or contact is hit, at that time.

    Let F(x, s) be the method's own step of length s in which open rows do nothing. The first s at
    which the gap of one of them is closed splits the step:

        φ(F(x, s*)) = 0,    x⁺ = x⁻ ⊕ M⁻¹Jᵀ Λ(x⁻),  x⁻ = F(x, s*),    then F(x⁺, h − s*)

    Time stands still in the impact; Λ obeys the laws of plain stepping, with all rows that touch at
    once, φ̇⁺ ≥ −e φ̇⁻, friction, and a cap on energy. Joints take part by impulses of their own. A
    step so keeps the order of its integrator across an impact, and its derivative contains that of
    the time, ∂s* = −∂φ/φ̇, which is what a saltation matrix adds. It is implicit, and first
    derivatives are exact for the step as computed where φ̇ is more than rounding; where a row is
    only grazed the time has no derivative, and is taken to have none. Second derivatives through an
    impact are finite, but not right.

    After so many impacts in one step the rest of it is plain. A joint that would then cross the
    range between two elastic stops ends with the status `LOST_IMPACTS`.

    Rows that rest are plain, too: those whose gap and speed are no more than what accelerations
    make in a step, ½ h² |J||a| and ½ h |J||a|. There a ball that bounces ever lower comes to lie,
    within one step of when it would.

    A row that closes and opens again within one step is not seen, nor the first of two crossings by
    the nearest row. Soft stops and contacts, friction in joints and motors are forces, and split
    nothing. A step costs three or four plain ones, and one in which some world of a batch has an
    impact as many more as tries are needed to find it.

    Attributes:
        splits: how many impacts a step may have.
        iterations: tries at s*, at most; secants, and bisection where they leave what is known to
            enclose it. Some four are enough where φ bends little in a step.
        slips: whether a step is split, too, where a contact that slides comes to rest. Friction is
            one force over a part of a step, so that without it the place where a block stops is
            right to second order beside Runge–Kutta methods, and its derivatives to first.

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
        """Checks the numbers.

        Raises:
            ValueError: there are no splits or no iterations, or slips is neither true nor false.
        """
        checks.count("Events", "splits", self.splits)
        checks.count("Events", "iterations", self.iterations)
        checks.flag("Events", "slips", self.slips)

    def attempt(self, system: Any, method: Method, state: State, control: PyTree, dt: Array) -> Any:
        """(new state, info) and the status of a step, split at impacts."""
        if not has_ends(recall(system, state.turns), state.q, state.v, state.time, control, dt):
            return attempt(system, method, state, control, dt)
        world = World(system, method, control, dt)
        rows = jax.eval_shape(world.rows, state)
        zero = 0 * state.time  # with a tangent, though of zero, which saves a round of tracing
        none = jnp.broadcast_to(zero[None], rows.gap.shape)
        start = Progress(
            state,
            jnp.broadcast_to(dt, zero.shape),
            jnp.ones(zero.shape, bool),
            jnp.zeros_like(state.status),
            none,
            zero,
            zero + 1,
        )
        awaited = jnp.arange(self.splits + 1) < self.splits
        done, (seen, told) = jax.lax.scan(world.go, start, awaited)
        first = jax.tree.map(lambda x: x[0], seen)
        mean = numerics.safe_divide(done.impulses, dt[None])
        gap = world.rows(state).gap
        reactions = Reactions(mean, gap, done.residual, done.kept, None, rows.layout)
        new = at_instant(done.state, state.instant + dt)
        impacts = list_impacts(told, rows.layout)
        info = dataclasses.replace(first, status=done.code, reactions=reactions, impacts=impacts)
        return (new, info), done.code


def list_impacts(told: Impact, layout: BoundLayout) -> Impacts:
    """Returns the impacts of all parts of a step, of which the last awaits none."""
    happened, times, rows = (x[:-1] for x in told)
    elements = jnp.asarray(layout.owners)[rows]
    return Impacts(
        jnp.sum(happened, axis=0, dtype=jnp.int32),
        jnp.where(happened, times, jnp.inf),
        jnp.where(happened, elements, -1),
        layout.names,
    )


class Impact(NamedTuple):
    """An impact: whether there was one, when, and the row that made it, () each."""

    happened: Array
    time: Array
    row: Array


class Impulses(NamedTuple):
    """Impulses of bounded rows: ∫λ dt (n,), and the other numbers of `Reactions`, by world."""

    multipliers: Array
    residual: Array
    kept: Array


class Passed(NamedTuple):
    """What a part of a step did.

    Attributes:
        state: at its end.
        seen: at its start.
        code: its status.
        impulses: of bounded rows.
    """

    state: State
    seen: StepInfo
    code: Array
    impulses: Impulses


class Progress(NamedTuple):
    """How far a step has come, by world.

    Attributes:
        state: there.
        left: what is left of the step, () [s].
        active: whether anything is, ().
        code: status so far, ().
        impulses: of bounded rows so far, (n,).
        residual, kept: as of `Reactions`, the worst so far, ().
    """

    state: State
    left: Array
    active: Array
    code: Array
    impulses: Array
    residual: Array
    kept: Array

    def beyond(self, impulses: Impulses) -> Progress:
        """Returns the progress with more impulses."""
        return self._replace(
            impulses=self.impulses + impulses.multipliers,
            residual=jnp.maximum(self.residual, impulses.residual),
            kept=jnp.minimum(self.kept, impulses.kept),
        )


@pytree
class World:
    """What stays the same during a step.

    Attributes:
        system, method, control: as of `step`.
        dt: h, () [s].
    """

    system: Any
    method: Any
    control: PyTree
    dt: Array

    def part(self, state: State, part: Part) -> Passed:
        """A part of the step; the memory is that after all of it."""
        (new, info), code = attempt(self.system, self.method, state, self.control, self.dt, part)
        known = info.reactions
        own = Impulses(part.length[None] * known.multipliers, known.residual, known.kept)
        return Passed(new, dataclasses.replace(info, reactions=None), code, own)

    def rows(self, state: State) -> BoundRows:
        """The bounded rows at a state."""
        return self.dynamics(state).bounds(state.q, state.v, state.instant, self.dt)

    def dynamics(self, state: State) -> Any:
        """What an integrator sees of the system."""
        return dynamics_at(self.system, self.method, state, self.control, self.dt)

    def outlook(self, state: State) -> Outlook:
        """What is to be expected from here on."""
        free = self.dynamics(state).unbounded(state.q, state.v, state.instant)
        return look(self.rows(state), free, state.q, self.dt, self.method.events.slips)

    def clearances(self, outlook: Outlook, passed: Passed) -> Array:
        """What is left of gaps at the end of a part, and then, times h, of slips."""
        rows = self.rows(passed.state)
        if outlook.sliding is None:
            return rows.gap
        slips = outlook.sliding.clearance(rows, passed.impulses.multipliers)
        return jnp.concatenate([rows.gap, self.dt[None] * slips])

    def go(self, progress: Progress, awaited: Array) -> tuple[Progress, tuple[StepInfo, Impact]]:
        """As far as the next impact, if it is awaited, and else as far as the step leads."""
        state, active = progress.state, progress.active
        length = jnp.where(active, progress.left, self.dt / 2)  # of no use, but harmless, elsewhere
        still, at, most = jax.lax.stop_gradient((self, state, length))
        outlook, awaited = still.outlook(at), active & awaited

        def gaps(s: Array) -> Array:
            return still.clearances(outlook, still.part(at, Part(s, outlook.open, awaited)))

        watched, tries = outlook.watched(still.dt), self.method.events.iterations
        found = Search(gaps, watched, most, awaited, tries).run()
        hit = found.happens & (found.row < len(outlook.gap))
        time = jnp.where(found.happens, found.here, length)
        least = outlook.rounding / jnp.where(still.dt > 0, still.dt, 1)
        given = (self, state, outlook, awaited, found.row)
        passed, time = Arrival(flow, gap_of)(given, time, found.happens, least)
        there = dataclasses.replace(passed.state, memory=state.memory)
        struck = Struck(outlook, chosen(found.row, outlook.open), hit)
        jump, impulses = jax.lax.cond(somewhere(hit), strike, no_strike, self, there, struck)
        final = keep(found.happens, dataclasses.replace(there, v=there.v + jump), passed.state)
        rows = still.rows(at)
        speed = jnp.where(awaited[None], 0, jnp.abs(rows.rate))
        lost = passes_range(rows, speed, length[None])
        code = status.first(progress.code, lost_impacts(passed.code, lost))
        new = progress._replace(state=final, left=length - time, active=found.happens, code=code)
        new = new.beyond(passed.impulses).beyond(impulses)
        told = Impact(hit, rounded(state.instant + time), jnp.where(hit, found.row, 0))
        return keep(active, new, progress), (passed.seen, told)


def flow(given: Any, s: Array) -> Passed:
    """F(x, s)."""
    world, state, outlook, awaited, _ = given
    return world.part(state, Part(s, outlook.open, awaited))


def gap_of(given: Any, passed: Passed) -> Array:
    """φ of the row that arrives."""
    world, _, outlook, _, row = given
    gaps = world.clearances(outlook, passed)
    return jnp.sum(jnp.where(chosen(row, gaps), gaps, 0), axis=0)


def chosen(row: Array, like: Array) -> Array:
    """Which row it is, (n,)."""
    rows = jnp.arange(len(like), dtype=row.dtype)
    return rows.reshape(-1, *(1,) * row.ndim) == row[None]


def strike(world: World, state: State, struck: Struck) -> tuple[Array, Impulses]:
    """Δv of an impact and its impulses."""
    jump, known = world.dynamics(state).impact(state.q, state.v, state.instant, struck)
    return jump, Impulses(known.multipliers, known.residual, known.kept)


def no_strike(world: World, state: State, struck: Struck) -> tuple[Array, Impulses]:
    """Returns the change and impulses of no impact."""
    none, zero = jnp.zeros_like(struck.outlook.gap), jnp.zeros_like(state.time)
    return jnp.zeros_like(state.v), Impulses(none, zero, zero + 1)
