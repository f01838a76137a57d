"""One attempt at a step, or at a part of one: advance, remember, correct, judge."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.rows import Violation
from jaxcon.core import status
from jaxcon.core.pytree import pytree
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.forward import Dynamics
from jaxcon.dynamics.parts import Part
from jaxcon.model.state import State, at_instant, recall
from jaxcon.simulation.integrators import reached
from jaxcon.simulation.method import Memory, Method
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
    """

    acceleration: Array
    multipliers: Array
    violation: Violation
    status: Array
    reactions: Any = None
    impacts: Any = None


def attempt(
    system: Any, method: Method, state: State, control: PyTree, dt: Array, part: Part | None = None
) -> Any:
    """(new state, info) and the status of this step of dt alone, or of a part of it."""
    dynamics = dynamics_at(system, method, state, control, dt, part)
    length = dt if part is None else part.length
    system, memory = dynamics.system, Memory(*state.memory)
    advanced = method.integrator.advance(dynamics, state, memory.integrator, length)
    (q, v, time), solution, rows = advanced.point, advanced.solution, advanced.rows
    new = at_instant(dataclasses.replace(state, q=q, v=v), reached(state, time, length))
    stabilizer = method.feedback(dt)
    own = stabilizer.remember(stabilizer.advance(rows, memory.stabilizer, dt), solution)
    new, corrected = stabilizer.correct(system, method.solver, state, new, own, length)
    here = system.snapshot(state.q, state.v, state.instant)
    turns, missed = system.expect(here, new.v, length, _reads_within(method))
    react = rows.reactions.multipliers if _keeps_reactions(system, method) else ()
    kept = Memory(advanced.memory, own, memory.recovery, react) if state.memory else ()
    new = dataclasses.replace(new, turns=turns, memory=kept)
    code = status.first(judge(new, solution), corrected)
    if system.counted:
        lost = jnp.where(missed < jnp.pi, Status.OK, Status.LOST_TURNS).astype(jnp.int32)
        code = status.first(code, lost)
    if method.recovery is not None:
        code = status.first(code, method.recovery.judge(system, new))
    seen = (solution.acceleration, solution.multipliers, rows.violation)
    return (new, StepInfo(*seen, code, rows.reactions)), code


def _reads_within(method: Method) -> bool:
    """Whether the integrator reads angles between the ends of a step, as all but one do."""
    return getattr(method.integrator, "reads_within", True)


def _keeps_reactions(system: Any, method: Method) -> bool:
    """Whether the next step starts from what bounded rows did in this one."""
    return bool(system.bounds) and method.bounded.warm


def dynamics_at(
    system: Any,
    method: Method,
    state: State,
    control: PyTree,
    dt: Array,
    part: Part | None = None,
) -> Dynamics:
    """What an integrator sees of the system during a step from this state, or a part of it."""
    stabilizer, memory = method.feedback(dt), Memory(*state.memory)
    if method.recovery is not None:
        stabilizer = method.recovery.relax(stabilizer, memory.recovery)
    system = recall(system, state.turns)
    own = (system, stabilizer, method.solver, control, memory.stabilizer, dt)
    if not system.bounds:
        return Dynamics(*own)
    guess = memory.bounded if method.bounded.warm else None
    return Dynamics(*own, method.bounded, guess, part=part)


def judge(state: State, solution: Solution) -> Array:
    """What the solver said, or NON_FINITE where the new state is."""
    finite = jnp.all(jnp.isfinite(state.q), axis=0) & jnp.all(jnp.isfinite(state.v), axis=0)
    code = jnp.where(finite, Status.OK, Status.NON_FINITE).astype(jnp.int32)
    return status.first(solution.status, code)
