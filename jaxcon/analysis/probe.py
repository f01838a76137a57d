"""Runs a few steps of a method to measure the constraint violation that remains."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.execution.initialize import init
from jaxcon.execution.rollout import rollout
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.step import StepInfo
from jaxcon.system.state import State, checked_system

STEPS = 32
"""The number of steps. Default gains correct a violating initial state within the first half."""


@dataclass(frozen=True)
class Probe:
    """The constraint violation that remains after some steps.

    Attributes:
        steps: number of steps.
        violation: max |φ| over the second half of the steps, in the units of the rows.
        missed: the largest residual of the inequality constraints [m/s, rad/s].
        status: status at the end.
    """

    steps: int
    violation: float
    missed: float
    status: Status


def probe(system: System, method: Method, state: State, control: PyTree, dt: float) -> Probe:
    """Takes `STEPS` steps with a constant control, and measures the remaining violation.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: state of one world, with the initial memory of the method (see `begun`).
        control: control input, as in `jc.step`, or None.
        dt: step size h [s].
    """
    end, (violation, missed) = _run(method, system, state, control, jnp.asarray(dt, state.q.dtype))
    later = np.asarray(violation)[STEPS // 2 :]
    return Probe(STEPS, float(np.max(later)), float(np.max(missed)), Status(int(end.status)))


def begun(system: System, method: Method, state: State) -> State:
    """Replaces the method memory of a state by the initial memory of the given method."""
    turns = state.turns if jax.tree.leaves(state.turns) else None
    return init(system, method, state.q, state.v, state.time, turns)


@jax.jit
def _run(
    method: Method, system: System, start: State, control: PyTree, dt: Array
) -> tuple[State, tuple[Array, Array]]:
    """Takes `STEPS` steps with a constant control; compiled.

    Returns:
        The final state; and for each step max |φ| and the residual of the inequality constraints,
        (STEPS,) each.
    """

    def record(state: State, info: StepInfo) -> tuple[Array, Array]:
        rows = linearize(checked_system(system, state), state.q, state.v, state.instant)
        none = jnp.zeros((), state.q.dtype)
        missed = none if info.reactions is None else info.reactions.residual
        return jnp.max(jnp.abs(rows.residual), initial=0), missed

    controls = jax.tree.map(lambda x: jnp.stack([x] * STEPS), control)
    return rollout(system, method, start, controls, dt, STEPS, record=record)
