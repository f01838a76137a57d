"""A few steps of a method, to see what they leave open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import linearize
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State, at
from jaxcon.simulation.initialize import init
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout

STEPS = 32
"""The steps of a probe; a start that is off is corrected in the first half by default gains."""


@dataclass(frozen=True)
class Probe:
    """What some steps from a state left open.

    Attributes:
        steps: how many.
        violation: max |φ| over the second half of them, in the units of the rows.
        missed: by how much laws of bounded rows were missed, the worst [m/s, rad/s].
        status: at the end.
    """

    steps: int
    violation: float
    missed: float
    status: Status


def probe(system: Any, method: Method, state: State, control: PyTree, dt: float) -> Probe:
    """Some steps under a control that is held.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: of one world, as `begun` gives it.
        control: as of `step`, or None.
        dt: h [s].
    """
    end, (off, missed) = _run(method, system, state, control, jnp.asarray(dt, state.q.dtype))
    later = np.asarray(off)[STEPS // 2 :]
    return Probe(STEPS, float(np.max(later)), float(np.max(missed)), Status(int(end.status)))


def begun(system: Any, method: Method, state: State) -> State:
    """The state with the memory of a method as at a start; that of another one is forgotten."""
    turns = state.turns if jax.tree.leaves(state.turns) else None
    return init(system, method, state.q, state.v, state.time, turns)


@jax.jit
def _run(method: Method, system: Any, start: State, control: PyTree, dt: Array) -> Any:
    def record(state: State, info: Any) -> tuple[Array, Array]:
        rows = linearize(at(system, state), state.q, state.v, state.instant)
        none = jnp.zeros((), state.q.dtype)
        missed = none if info.reactions is None else info.reactions.residual
        return jnp.max(jnp.abs(rows.residual), initial=0), missed

    controls = jax.tree.map(lambda x: jnp.stack([x] * STEPS), control)
    return rollout(system, method, start, controls, dt, STEPS, record=record)
