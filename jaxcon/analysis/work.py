"""What a step of one world costs: operations counted from its trace, and time where it is asked."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.operations import count, instructions
from jaxcon.core.typing import PyTree
from jaxcon.model.state import State
from jaxcon.simulation.method import Method
from jaxcon.simulation.step import check_step, step_quietly

WORLDS = 128
"""In the batch whose step is counted: what worlds share is then shared among so many."""
DT = 1e-3
"""A step [s]; costs do not depend on it."""
REPEATS, LONG = 5, 0.02
"""The number of repeats of what is timed, and how long each is at least [s]."""


@dataclass(frozen=True)
class Work:
    """What a step of one world takes in a batch.

    Attributes:
        operations: arithmetic of floating-point numbers, loops of unknown length counted as one
            round, and of alternatives the dearest.
        usual: the same, of alternatives the cheapest, as where rows are independent.
        instructions: of the program before it is compiled.
    """

    operations: float
    usual: float
    instructions: int

    def __str__(self) -> str:
        most = "" if self.operations == self.usual else f", at worst {self.operations:.0f}"
        return f"{self.usual:.0f} operations a step{most}, {self.instructions} instructions"


def work(system: Any, method: Method, state: State, control: PyTree = None) -> Work:
    """The operations of a step, counted from its trace; nothing is compiled.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: of one world.
        control: of one world, as of `step`, or None.
    """
    jaxpr = jax.make_jaxpr(_many(system, method))(*_batch(system, method, state, control, WORLDS))
    most, least = (count(jaxpr.jaxpr, branch) / WORLDS for branch in (max, min))
    return Work(most, least, instructions(jaxpr.jaxpr))


def seconds(
    system: Any, method: Method, state: State, control: PyTree = None, batch: int = 1
) -> float:
    """How long a step of a batch takes on this device, by world [s]: the median of five repeats.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: of one world.
        control: of one world, as of `step`, or None.
        batch: worlds.
    """
    shapes = _batch(system, method, state, control, batch)
    one = state, check_step(system, method, state, control)
    args = jax.tree.map(
        lambda x, s: jnp.broadcast_to(jnp.asarray(x, s.dtype), s.shape), one, shapes
    )
    run = jax.jit(_many(system, method)).lower(*args).compile()

    def elapsed(times: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready([run(*args) for _ in range(times)][-1])
        return time.perf_counter() - start

    elapsed(1)
    times = max(1, int(LONG / max(elapsed(1), 1e-9)))
    return float(np.median([elapsed(times) / times for _ in range(REPEATS)])) / batch


def _many(system: Any, method: Method) -> Any:
    """The step of a batch, without what it saw."""

    def one(state: State, control: PyTree) -> State:
        return step_quietly(system, method, state, control, DT)[0]

    return jax.vmap(one)


def _batch(system: Any, method: Method, state: State, control: PyTree, worlds: int) -> Any:
    """Shapes of the states and controls of so many worlds."""
    known = jax.tree.map(jnp.asarray, (state, check_step(system, method, state, control)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), known)
