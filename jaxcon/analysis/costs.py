"""What a step costs in a batch on this device: time, memory, and the time of its gradient."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.memory import nothing
from jaxcon.analysis.reference import Reference
from jaxcon.analysis.trials import Lowered, Points, Problem
from jaxcon.core.precision import cast, precision
from jaxcon.core.typing import Array, PyTree
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.simulation.step import step_quietly

STEPS = 16
"""The number of steps of the rollouts whose gradients are timed."""
LONG = 0.03
"""What one repeat should take [s]; its steps are chosen for that, from `FEW` to `MANY`."""
FEW, MANY = 4, 1000
REPEATS = 5


@dataclass(frozen=True)
class Batch:
    """Worlds that start all along the reference, so that no two beside each other are alike.

    Attributes:
        problem: of one world.
        points: where they start, with a first axis of worlds.
        rows: their control inputs, likewise; None without, or where a policy gives them.
        worlds: how many.
    """

    problem: Problem
    points: Points
    rows: PyTree
    worlds: int

    @classmethod
    def of(cls, problem: Problem, reference: Reference, worlds: int) -> Batch:
        """At the starts of the parts that the reference is good for, in turn."""
        index = np.arange(worlds) % reference.last
        points = jax.tree.map(lambda x: x[index], reference.points)
        return cls(problem, points, jax.tree.map(lambda x: x[index], problem.inputs.rows), worlds)


class Pace(Lowered):
    """The steps of a batch under one method, with h and their number traced."""

    def __init__(self, batch: Batch, method: Method, dtype: Any) -> None:
        self.batch, self.dtype = batch, np.dtype(dtype)
        with precision(dtype):
            system, own = cast((batch.problem.system, method), dtype)
            policy = batch.problem.inputs.policy

            def many(points: Points, rows: PyTree, h: Array, count: Array) -> Any:
                def world(point: Points, control: PyTree) -> Any:
                    state = point.begin(system, own)
                    control = control if policy is None else policy(state)

                    def one(_: Any, state: Any) -> Any:
                        return step_quietly(system, own, state, control, h)[0]

                    return jax.lax.fori_loop(0, count, one, state)

                return jax.vmap(world)(points, rows)

            self.args = cast((batch.points, batch.rows), dtype)
            self.lowered = jax.jit(many).lower(*self.args, *self.numbers(1e-3, 1))

    @property
    def memory(self) -> float:
        """The memory of the batch by world: its states, the new ones, and what lies between [B]."""
        return planned(self.program) / self.batch.worlds

    def seconds(self, dt: float) -> float:
        """Returns the time of a step of one world: the median of several runs of the batch [s]."""
        with precision(self.dtype):

            def run(count: int) -> Callable[[], Any]:
                numbers = self.numbers(dt, count)
                return lambda: self.program(*self.args, *numbers)

            timed(run(FEW))  # the first touches memory that the later ones have
            count = int(np.clip(FEW * LONG / timed(run(FEW)), FEW, MANY))
            spent = np.median([timed(run(count)) for _ in range(REPEATS)])
        return float(spent) / count / self.batch.worlds


class Slope(Lowered):
    """The gradient of a rollout of `STEPS` steps by its start, in a batch, with h traced."""

    def __init__(self, batch: Batch, method: Method, dtype: Any) -> None:
        self.batch, self.dtype = batch, np.dtype(dtype)
        with precision(dtype):
            system, own = cast((batch.problem.system, method), dtype)
            policy = batch.problem.inputs.policy

            def end(moved: Any, point: Points, control: PyTree, h: Array) -> Array:
                state = point._replace(q=moved[0], v=moved[1]).begin(system, own)
                rows = jax.tree.map(lambda x: jnp.stack([x] * STEPS), control)
                given = (state, policy or rows, h, STEPS)
                final, _ = rollout(system, own, *given, record=nothing)
                return jnp.sum(final.q) + jnp.sum(final.v)

            def many(points: Points, rows: PyTree, h: Array) -> Any:
                def world(point: Points, control: PyTree) -> Any:
                    return jax.value_and_grad(end)((point.q, point.v), point, control, h)

                return jax.vmap(world)(points, rows)

            self.args = cast((batch.points, batch.rows), dtype)
            self.lowered = jax.jit(many).lower(*self.args, jnp.asarray(1e-3, self.dtype))

    def seconds(self, dt: float) -> float:
        """Returns the time of value and gradient by step of one world [s]."""
        with precision(self.dtype):
            h = jnp.asarray(dt, self.dtype)

            def run() -> Any:
                return self.program(*self.args, h)

            timed(run)
            spent = np.median([timed(run) for _ in range(REPEATS)])
        return float(spent) / STEPS / self.batch.worlds


def planned(program: Any) -> float:
    """Arguments, results and temporary memory of a compiled program [B]; NaN where unknown."""
    plan = program.memory_analysis()
    if plan is None:
        return float("nan")
    kept = plan.argument_size_in_bytes + plan.output_size_in_bytes
    return float(kept + plan.temp_size_in_bytes)


def timed(run: Callable[[], Any]) -> float:
    """How long it takes until its results are there [s]."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin
