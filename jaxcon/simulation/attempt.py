"""One attempt at a step, or at a part of one: advance, remember, correct, judge."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Violation
from jaxcon.core import status
from jaxcon.core.pytree import pytree
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.forward import Dynamics
from jaxcon.dynamics.parts import Part
from jaxcon.model.state import MethodMemory, State, at_instant, is_finite, recall
from jaxcon.simulation.integrators import reached
from jaxcon.simulation.method import Method
from jaxcon.solvers.saddle import Solution


@pytree
class StepInfo:
    """What a step saw at its start; zeros in a world that failed.

    Attributes:
        acceleration: a, (n_v,).
        multipliers: λ, (n_c,).
        violation: φ and φ̇ by constraint.
        status: what became of this step, or what stopped the world before, ().
        reactions: what bounded rows did during it; None in a scene without.
        impacts: those at which it was split; None without `Events`.
        state: the state to which a and λ belong, without the memory of the method. That is the
            state before the step, and for `GeneralizedAlpha` the point that it reached.
    """

    acceleration: Array
    multipliers: Array
    violation: Violation
    status: Array
    reactions: Any = None
    impacts: Any = None
    state: Any = None


def attempt(
    system: Any, method: Method, state: State, control: PyTree, dt: Array, part: Part | None = None
) -> Any:
    """(new state, info) and the status of this step of dt alone, or of a part of it."""
    # a step computes with angles less their whole turns, where floats are dense
    known = recall(system, state.turns, state.angle_remainder)
    system, q = known.unwind(state.q)
    given, state = state, dataclasses.replace(state, q=q)
    dynamics = _dynamics(system, method, state, control, dt, part)
    length, memory = dt if part is None else part.length, MethodMemory(*state.memory)
    advanced = method.integrator.advance(dynamics, state, memory.integrator, length)
    (q, v, time), solution, rows = advanced.point, advanced.solution, advanced.rows
    new = at_instant(dataclasses.replace(state, q=q, v=v), reached(state, time, length))
    stabilizer = method.feedback(dt)
    own = stabilizer.remember(stabilizer.advance(rows, memory.stabilizer, dt), solution)
    new, corrected = stabilizer.correct(system, method.solver, state, new, own, length)
    here = system.snapshot(state.q, state.v, state.instant)
    turns, missed = system.expect(here, new.v, length, _reads_within(method))
    # as the state came, with or without them, so that it can be the carry of a scan
    multipliers = rows.reactions.multipliers if _has_multipliers(memory) else ()
    kept = (advanced.memory, own, memory.recovery, multipliers)
    kept = MethodMemory(*kept) if state.memory else ()
    new = dataclasses.replace(new, turns=turns, memory=kept)
    wound = _rewound(system, given, new)
    code = status.first(judge(wound, solution), corrected)
    if jax.tree.leaves(own):
        code = status.first(code, judge_memory(own, new))
    if system.counted:
        lost = jnp.where(missed < jnp.pi, Status.OK, Status.LOST_TURNS).astype(jnp.int32)
        code = status.first(code, lost)
    if method.recovery is not None:
        code = status.first(code, method.recovery.judge(system, new))
    seen = (solution.acceleration, solution.multipliers, rows.violation)
    place = None
    if advanced.ends:
        place = at_instant(dataclasses.replace(bare(state), q=q, v=v), reached(state, time, length))
        place = _rewound(system, given, place)
    reactions = rows.reactions
    if reactions is not None:
        reactions = dataclasses.replace(reactions, jump=None)
    return (wound, StepInfo(*seen, code, reactions, state=place)), code


def _rewound(system: Any, given: State, after: State) -> State:
    """The state after a step with whole turns, and their remainder where it has a place for it.

    Args:
        system: of the states.
        given: the state at the start of the step.
        after: where the step led, from that state without whole turns.
    """
    q, remainder = system.rewind(given.q, after.q)
    if isinstance(given.angle_remainder, tuple):
        remainder = ()
    return dataclasses.replace(after, q=q, angle_remainder=remainder)


def nothing_seen(info: StepInfo, state: State) -> StepInfo:
    """Returns the info of a failed world: zeros, and no impacts."""
    blank = jax.tree.map(jnp.zeros_like, info)
    if info.impacts is not None:
        blank = dataclasses.replace(blank, impacts=info.impacts.none())
    return blank if info.state is None else dataclasses.replace(blank, state=bare(state))


def bare(state: State) -> State:
    """The state without the memory of a method."""
    return dataclasses.replace(state, memory=())


def _reads_within(method: Method) -> bool:
    """Returns True where the integrator reads angles between the ends of a step, as most do."""
    return getattr(method.integrator, "reads_within", True)


def _has_multipliers(memory: MethodMemory) -> bool:
    """Returns True where a state carries the inequality multipliers of the last step."""
    return bool(jax.tree.leaves(memory.bounded))


def dynamics_at(
    system: Any,
    method: Method,
    state: State,
    control: PyTree,
    dt: Array,
    part: Part | None = None,
) -> Dynamics:
    """What an integrator sees of the system during a step from this state, or a part of it."""
    system = recall(system, state.turns, state.angle_remainder)
    return _dynamics(system, method, state, control, dt, part)


def _dynamics(
    system: Any, method: Method, state: State, control: PyTree, dt: Array, part: Part | None
) -> Dynamics:
    """The dynamics of a system that remembers the turns of the state."""
    stabilizer, memory = method.feedback(dt), MethodMemory(*state.memory)
    if method.recovery is not None:
        stabilizer = method.recovery.relax(stabilizer, memory.recovery)
    own = (system, stabilizer, method.solver, control, memory.stabilizer, dt)
    if not system.bounds:
        return Dynamics(*own)
    solver = method.resolve(system, state).bounded
    guess = memory.bounded if solver.warm and _has_multipliers(memory) else None
    return Dynamics(*own, solver, guess, part=part)


def judge_memory(memory: PyTree, state: State) -> Array:
    """NON_FINITE where a number is not finite that the stabiliser is to remember, ().

    The next step would fail by it, when the derivative of this one is NaN already.
    """
    good, worlds = jnp.ones_like(state.status, bool), state.status.ndim
    for x in jax.tree.leaves(memory):
        good &= jnp.all(jnp.isfinite(x), axis=tuple(range(x.ndim - worlds)))
    return jnp.where(good, Status.OK, Status.NON_FINITE).astype(jnp.int32)


def judge(state: State, solution: Solution) -> Array:
    """What the solver said, or NON_FINITE where the new state is."""
    code = jnp.where(is_finite(state), Status.OK, Status.NON_FINITE).astype(jnp.int32)
    return status.first(solution.status, code)
