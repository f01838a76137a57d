"""Measured costs of a step in a batch on this device: time, memory and time of the gradient."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled

from jaxcon.analysis.memory import nothing
from jaxcon.analysis.reference import Reference
from jaxcon.analysis.trials import Lowered, Points, Problem
from jaxcon.core.precision import cast, precision
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.execution.rollout import rollout
from jaxcon.execution.step import step_quietly
from jaxcon.methods.method import Method
from jaxcon.system.state import State

STEPS = 16
"""The number of steps of a rollout whose gradient is timed."""
LONG = 0.03
"""The intended duration of one timed run [s], from which its number of steps is computed."""
FEW, MANY = 4, 1000
"""The least and the largest number of steps of a timed run."""
REPEATS = 5
"""The number of timed runs; their median is used."""


@dataclass(frozen=True)
class Batch:
    """A batch of worlds that start at different points of the reference motion.

    Neighboring worlds therefore have different states.

    Attributes:
        problem: the problem of one world.
        points: initial points, with a leading axis of worlds.
        rows: control inputs, with a leading axis of worlds. None without control inputs, or with a
            policy.
        worlds: number of worlds.
    """

    problem: Problem
    points: Points
    rows: PyTree
    worlds: int

    @classmethod
    def of(cls, problem: Problem, reference: Reference, worlds: int) -> Batch:
        """Returns a batch whose world i starts at the reference state at the start of part i.

        Only the parts of the horizon up to the time `reference.until` are used, since the reference
        is inaccurate later. If there are more worlds than parts, the parts are used repeatedly.
        """
        index = np.arange(worlds) % reference.last
        points = jax.tree.map(lambda x: x[index], reference.points)
        return cls(problem, points, jax.tree.map(lambda x: x[index], problem.inputs.rows), worlds)


class Pace(Lowered):
    """The program that steps a batch with one method.

    The step size h and the number of steps are traced.
    """

    def __init__(self, batch: Batch, method: Method, dtype: str | DType) -> None:
        self.batch, self.dtype = batch, np.dtype(dtype)
        with precision(dtype):
            system, method = cast((batch.problem.system, method), dtype)
            policy = batch.problem.inputs.policy

            def many(points: Points, rows: PyTree, h: Array, count: Array) -> State:
                def world(point: Points, control: PyTree) -> State:
                    state = point.begin(system, method)
                    control = control if policy is None else policy(state)

                    def step(_: Array, state: State) -> State:
                        return step_quietly(system, method, state, control, h)[0]

                    return jax.lax.fori_loop(0, count, step, state)

                return jax.vmap(world)(points, rows)

            self.args = cast((batch.points, batch.rows), dtype)
            self.lowered = jax.jit(many).lower(*self.args, *self.numbers(1e-3, 1))

    @property
    def memory(self) -> float:
        """Memory per world of the batch [B]: states before and after a step, and temporaries."""
        return planned(self.program) / self.batch.worlds

    def seconds(self, dt: float) -> float:
        """Measures the time of one step of the batch, divided by the number of worlds [s].

        The result is the median of several runs.

        Args:
            dt: step size [s].
        """
        with precision(self.dtype):

            def run(count: int) -> Callable[[], Any]:
                numbers = self.numbers(dt, count)
                return lambda: self.program(*self.args, *numbers)

            timed(run(FEW))  # the first run allocates memory
            count = int(np.clip(FEW * LONG / timed(run(FEW)), FEW, MANY))
            spent = np.median([timed(run(count)) for _ in range(REPEATS)])
        return float(spent) / count / self.batch.worlds


class Slope(Lowered):
    """The program that differentiates short rollouts of a batch with respect to initial q and v.

    The step size h is traced.
    """

    def __init__(self, batch: Batch, method: Method, dtype: str | DType) -> None:
        self.batch, self.dtype = batch, np.dtype(dtype)
        with precision(dtype):
            system, method = cast((batch.problem.system, method), dtype)
            policy = batch.problem.inputs.policy

            def end(moved: tuple[Array, Array], point: Points, control: PyTree, h: Array) -> Array:
                state = point._replace(q=moved[0], v=moved[1]).begin(system, method)
                rows = jax.tree.map(lambda x: jnp.stack([x] * STEPS), control)
                controls = policy or rows
                final, _ = rollout(system, method, state, controls, h, STEPS, record=nothing)
                return jnp.sum(final.q) + jnp.sum(final.v)

            def many(points: Points, rows: PyTree, h: Array) -> Any:
                def world(point: Points, control: PyTree) -> Any:
                    return jax.value_and_grad(end)((point.q, point.v), point, control, h)

                return jax.vmap(world)(points, rows)

            self.args = cast((batch.points, batch.rows), dtype)
            self.lowered = jax.jit(many).lower(*self.args, jnp.asarray(1e-3, self.dtype))

    def seconds(self, dt: float) -> float:
        """Measures the time to compute the value and gradient of a rollout, per step and world [s].

        The result is the median of several runs.

        Args:
            dt: step size [s].
        """
        with precision(self.dtype):
            h = jnp.asarray(dt, self.dtype)

            def run() -> Any:
                return self.program(*self.args, h)

            timed(run)
            spent = np.median([timed(run) for _ in range(REPEATS)])
        return float(spent) / STEPS / self.batch.worlds


def planned(program: Compiled) -> float:
    """Returns a compiled program's memory, including arguments and results [B]; NaN if unknown."""
    plan = program.memory_analysis()
    if plan is None:
        return float("nan")
    ends = plan.argument_size_in_bytes + plan.output_size_in_bytes
    return float(ends + plan.temp_size_in_bytes)


def timed(run: Callable[[], Any]) -> float:
    """Calls a function and returns the time until its results are ready [s]."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin
