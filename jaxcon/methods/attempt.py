"""One step, or a part of it, with whole turns of angles removed before it and counted after it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp

from jaxcon.core import status
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.protocols import System
from jaxcon.step import StepInfo, step
from jaxcon.system.state import State, with_turns

if TYPE_CHECKING:
    from jaxcon.contact.parts import StepPart
    from jaxcon.methods.method import Method


def attempt(
    system: System,
    method: Method,
    state: State,
    control: PyTree,
    dt: Array,
    part: StepPart | None = None,
) -> tuple[tuple[State, StepInfo], Array]:
    """Makes a step, or a part of it, with angles reduced by whole turns.

    Reduced angles have smaller rounding errors. The new state has its whole turns again.

    Args:
        system: the system to step.
        method: the simulation method.
        state: state at the start of the step.
        control: control input u, as arrays.
        dt: step size h, () [s].
        part: the part to advance if the step is split at impacts; None for the whole step.

    Returns:
        ((new state, info of the step), status of this step alone).
    """
    turning, q = with_turns(system, state.turns, state.angle_remainder).unwind(state.q)
    start = dataclasses.replace(state, q=q)
    new, info = step(turning, method, start, control, dt, part)
    here = turning.snapshot(start.q, start.v, start.instant)
    length = dt if part is None else part.length
    turns, missed = turning.expect(here, new.v, length, method.integrator.reads_within)
    new, code = dataclasses.replace(new, turns=turns), info.status
    if turning.counted:
        lost = jnp.where(missed < jnp.pi, Status.OK, Status.LOST_TURNS).astype(jnp.int32)
        code = status.first(code, lost)
    if method.recovery is not None:
        code = status.first(code, method.recovery.judge(turning, new))
    place = None if info.state is None else _rewound(turning, state, info.state)
    new = _rewound(turning, state, new)
    return (new, dataclasses.replace(info, status=code, state=place)), code


def _rewound(system: System, given: State, after: State) -> State:
    """Returns the state after a step, with whole turns added to its angles.

    Args:
        system: the system of both states.
        given: the state at the start of the step. The result has a rounding remainder of its angles
            only if this state has one.
        after: the state at the end of the step, computed without whole turns.
    """
    q, remainder = system.rewind(given.q, after.q)
    if isinstance(given.angle_remainder, tuple):
        remainder = ()
    return dataclasses.replace(after, q=q, angle_remainder=remainder)
