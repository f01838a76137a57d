"""Operation count of a step, from its trace; and the measured time of a step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import PyTree
from jaxcon.execution.step import step_quietly
from jaxcon.execution.validation import check_step
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.staging.operations import count, instructions
from jaxcon.system.state import State

WORLDS = 128
"""The batch size of the counted step. Counts are divided by it to get the count per world."""
DT = 1e-3
"""The step size [s]; costs do not depend on it."""
REPEATS, LONG = 5, 0.02
"""The number of timed runs, and the least duration of each [s]."""


@dataclass(frozen=True)
class Work:
    """Number of operations of a step, per world of a batch.

    Attributes:
        operations: floating-point operations if every conditional takes its costliest branch. A
            while loop counts as one iteration.
        usual: floating-point operations if every conditional takes its cheapest branch, for example
            the branch for independent rows.
        instructions: number of instructions of the traced program.
    """

    operations: float
    usual: float
    instructions: int

    def __str__(self) -> str:
        most = "" if self.operations == self.usual else f", at worst {self.operations:.0f}"
        return f"{self.usual:.0f} operations a step{most}, {self.instructions} instructions"


def work(system: System, method: Method, state: State, control: PyTree = None) -> Work:
    """Counts the operations of a step by tracing it; nothing is compiled.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: state of one world.
        control: control input of one world, as in `jc.step`, or None.
    """
    jaxpr = jax.make_jaxpr(_many(system, method))(*_batch(system, method, state, control, WORLDS))
    costliest, cheapest = (count(jaxpr.jaxpr, branch) / WORLDS for branch in (max, min))
    return Work(costliest, cheapest, instructions(jaxpr.jaxpr))


def seconds(
    system: System, method: Method, state: State, control: PyTree = None, batch: int = 1
) -> float:
    """Measures the time of one step of a batch, divided by the number of worlds [s].

    The result is the median of five runs.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: state of one world.
        control: control input of one world, as in `jc.step`, or None.
        batch: number of worlds.
    """
    shapes = _batch(system, method, state, control, batch)
    world = state, check_step(system, method, state, control)
    args = jax.tree.map(
        lambda x, s: jnp.broadcast_to(jnp.asarray(x, s.dtype), s.shape), world, shapes
    )
    run = jax.jit(_many(system, method)).lower(*args).compile()

    def elapsed(times: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready([run(*args) for _ in range(times)][-1])
        return time.perf_counter() - start

    elapsed(1)
    times = max(1, int(LONG / max(elapsed(1), 1e-9)))
    return float(np.median([elapsed(times) / times for _ in range(REPEATS)])) / batch


def _many(system: System, method: Method) -> Callable[[State, PyTree], State]:
    """Returns a function that steps a batch and discards the `StepInfo`."""

    def step(state: State, control: PyTree) -> State:
        return step_quietly(system, method, state, control, DT)[0]

    return jax.vmap(step)


def _batch(system: System, method: Method, state: State, control: PyTree, worlds: int) -> Any:
    """Returns the states and controls of a batch, as shapes and dtypes."""
    world = jax.tree.map(jnp.asarray, (state, check_step(system, method, state, control)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), world)
