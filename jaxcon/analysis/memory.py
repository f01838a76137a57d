"""How much memory a batch of worlds takes, as the compiler counts it. Host code, for people."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import PyTree
from jaxcon.model.state import State
from jaxcon.simulation.adjoints import EVERY_STEP, check_adjoint
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.simulation.segments import bytes_of
from jaxcon.simulation.step import check_step, controls_in, idle, step_quietly

BATCHES = 64, 256
"""Sizes that are compiled: what a world takes is in proportion from here on."""
SHORT, LONGER = 4, 68
"""Steps of the gradients that are compiled."""
DT = 1e-3
"""A step [s]; sizes do not depend on it."""


@dataclass(frozen=True)
class Memory:
    """What a step of a batch takes: `shared` + worlds · (`state` + `working`).

    Attributes:
        state: all leaves of one world's state [B].
        working: what a step needs for one world beside the state it is given: the new state, the
            `StepInfo`, and what lies between [B].
        shared: what does not grow with the batch [B].
    """

    state: int
    working: float
    shared: float

    def of(self, worlds: int) -> float:
        """Returns the memory of a step of some worlds, their states included [B].

        Args:
            worlds: how many.
        """
        return self.shared + worlds * (self.state + self.working)

    def __str__(self) -> str:
        return (
            f"memory of a world in a batch: {self.state} B of state and"
            f" {self.working:.0f} B of working memory in a step"
        )


def memory(system: Any, method: Method, state: State, control: PyTree = None) -> Memory:
    """The memory of `jax.jit(jax.vmap(step))` by world, as XLA plans it for this device.

    A step is compiled for two sizes of a batch, which takes seconds; the difference is what worlds
    add. The scene's own numbers and the code are not counted, nor is what a derivative keeps.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: of one world.
        control: of one world, as of `step`; motors idle unless given.

    Returns:
        The `Memory`.

    Raises:
        ValueError: state and control do not fit, as in `step`.
        RuntimeError: the compiler of this device does not say what it plans.
    """
    control = jax.tree.map(jnp.asarray, check_step(system, method, state, idle(system, control)))

    def step(state: State, control: PyTree) -> Any:
        return step_quietly(system, method, state, control, DT)

    small, large = (_planned(step, (state, control), worlds) for worlds in BATCHES)
    working = (large - small) / (BATCHES[1] - BATCHES[0])
    return Memory(bytes_of(state), working, small - working * BATCHES[0])


@dataclass(frozen=True)
class GradientMemory:
    """What the gradient of a rollout by its start takes, for any number of steps and any adjoint.

    Attributes:
        start: shapes and dtypes of the state of one world.
        state: what a checkpoint keeps of one world [B].
        step: what the derivative of a step needs of one world, beside parameters [B].
        working: what one world needs at any length [B].
        shared: what grows neither with the batch nor with the steps [B]; the numbers of the steps
            come on top.
    """

    start: State
    state: int
    step: float
    working: float
    shared: float

    def of(self, worlds: int, steps: int, adjoint: Any = EVERY_STEP) -> float:
        """Returns the memory of a batch, without what is recorded and given as control [B].

        Args:
            worlds: of the batch.
            steps: of the rollout.
            adjoint: as of `rollout`.

        Raises:
            ValueError: worlds or steps are no whole numbers, or too few.
        """
        checks.count("gradient memory", "worlds", worlds)
        checks.count("gradient memory", "steps", steps, 0)
        check_adjoint(adjoint)
        *checkpoints, last = adjoint.kept(steps, self.start)
        own = self.working + sum(checkpoints) * self.state + last * self.step
        return self.shared + _numbers(steps) + worlds * own

    def __str__(self) -> str:
        return (
            f"memory of a world in a batch for a gradient: {self.state} B by checkpoint,"
            f" {self.step:.0f} B by step between checkpoints, and {self.working:.0f} B besides"
        )


def gradient_memory(
    system: Any, method: Method, state: State, control: PyTree = None
) -> GradientMemory:
    """The memory of `jax.jit(jax.vmap(jax.grad(…)))` of a rollout, as XLA plans it for this device.

    Gradients through a few steps are compiled for two sizes of a batch and two lengths, which takes
    seconds; the differences are what worlds and steps add.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: of one world.
        control: of one step of one world, or a function of the state, as of `rollout`.

    Returns:
        The `GradientMemory`.

    Raises:
        ValueError: state and control do not fit, as in `step`.
        RuntimeError: the compiler of this device does not say what it plans.
    """
    policy = control if callable(control) else None

    def planned(steps: int, worlds: int) -> int:
        one = None if policy else controls_in(state.q.dtype, idle(system, control))
        controls = policy or jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * steps), one)

        def end(moved: tuple[Any, Any], rest: State) -> Any:
            start = dataclasses.replace(rest, q=moved[0], v=moved[1])
            final, _ = rollout(system, method, start, controls, DT, steps, record=nothing)
            return jnp.sum(final.q) + jnp.sum(final.v)

        return _planned(jax.grad(end), ((state.q, state.v), state), worlds)

    small, large = (planned(SHORT, worlds) for worlds in BATCHES)
    longer = planned(LONGER, BATCHES[0])
    own = (large - small) / (BATCHES[1] - BATCHES[0])
    added = longer - small - _numbers(LONGER - SHORT)
    step = added / (LONGER - SHORT) / BATCHES[0]
    start = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    shared = small - _numbers(SHORT) - own * BATCHES[0]
    return GradientMemory(start, bytes_of(state), step, own - SHORT * step, shared)


def nothing(state: State, info: Any) -> None:
    """Recorded of a step."""


def _numbers(steps: int) -> int:
    """What the numbers of the steps take, which a rollout counts once for all worlds [B]."""
    return steps * np.dtype(jnp.result_type(int)).itemsize


def _planned(step: Any, args: PyTree, worlds: int) -> int:
    """Results and temporary memory of a compiled step of a batch [B]."""
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), args)
    plan = jax.jit(jax.vmap(step)).lower(*batch).compile().memory_analysis()
    if plan is None:
        raise RuntimeError(
            f"memory: the compiler of '{jax.default_backend()}' does not say how much it plans."
        )
    return plan.output_size_in_bytes + plan.temp_size_in_bytes
