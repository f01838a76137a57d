"""Memory use of a batch of worlds, as planned by the compiler. Host code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.execution.adjoints import EVERY_STEP, check_adjoint
from jaxcon.execution.rollout import rollout
from jaxcon.execution.segments import bytes_of
from jaxcon.execution.step import step_quietly
from jaxcon.execution.validation import check_step, checked_control, idle
from jaxcon.methods.method import Method
from jaxcon.protocols import Adjoint, System
from jaxcon.step import StepInfo
from jaxcon.system.state import State, checked_system

BATCHES = 64, 256
"""The two batch sizes for which programs are compiled.

From the smaller one on, memory grows linearly with the batch size.
"""
SHORT, LONGER = 4, 68
"""The lengths of the two rollouts whose gradients are compiled [steps]."""
DT = 1e-3
"""The step size [s]; memory does not depend on it."""


@dataclass(frozen=True)
class Memory:
    """Memory to step a batch: `shared` + worlds · (`state` + `working`).

    Attributes:
        state: size of all leaves of one world's state [B].
        working: memory of a step per world, without its input state [B]: the new state, the
            `StepInfo` and temporaries.
        shared: memory that does not depend on the batch size [B].
    """

    state: int
    working: float
    shared: float

    def of(self, worlds: int) -> float:
        """Returns the memory to step a batch, including its states [B].

        Args:
            worlds: number of worlds.
        """
        return self.shared + worlds * (self.state + self.working)

    def __str__(self) -> str:
        return (
            f"memory of a world in a batch: {self.state} B of state and"
            f" {self.working:.0f} B of working memory in a step"
        )


def memory(system: System, method: Method, state: State, control: PyTree = None) -> Memory:
    """Returns the memory per world of `jax.jit(jax.vmap(step))`, as XLA plans it for this device.

    A step is compiled for two batch sizes, which takes seconds. The difference gives the memory per
    world. Memory of scene parameters, code and residuals for derivatives is not included.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: state of one world.
        control: control input of one world, as in `jc.step`; by default zero for all motors.

    Returns:
        A `jc.analysis.Memory`.

    Raises:
        ValueError: state and control do not fit, as in `jc.step`.
        RuntimeError: the compiler of this device does not report its memory plan.
    """
    control = jax.tree.map(jnp.asarray, check_step(system, method, state, idle(system, control)))

    def step(state: State, control: PyTree) -> tuple[State, StepInfo]:
        return step_quietly(system, method, state, control, DT)

    small, large = (_planned(step, (state, control), worlds) for worlds in BATCHES)
    working = (large - small) / (BATCHES[1] - BATCHES[0])
    return Memory(bytes_of(state), working, small - working * BATCHES[0])


@dataclass(frozen=True)
class GradientMemory:
    """Memory for the gradient of a rollout with respect to its initial q and v.

    The length of the rollout and its adjoint are arguments of `of`.

    Attributes:
        start: the state of one world, as shapes and dtypes.
        state: size of one checkpoint (a kept state) of one world [B].
        step: size of the residuals (intermediate values) that the reverse pass needs, per step and
            world, without parameters [B].
        working: memory per world that does not depend on the number of steps [B].
        shared: memory that depends neither on the batch size nor on the number of steps [B]. The
            step indices are not included.
    """

    start: State
    state: int
    step: float
    working: float
    shared: float

    def of(self, worlds: int, steps: int, adjoint: Adjoint = EVERY_STEP) -> float:
        """Returns the memory to differentiate a batch of rollouts [B].

        Recorded values and control inputs are not included.

        Args:
            worlds: number of worlds.
            steps: number of steps of the rollout.
            adjoint: adjoint, as in `jc.rollout`.

        Raises:
            ValueError: `worlds` or `steps` is not an integer, or is too small.
        """
        checks.count("gradient memory", "worlds", worlds)
        checks.count("gradient memory", "steps", steps, 0)
        check_adjoint(adjoint)
        *checkpoints, last = adjoint.kept(steps, self.start)
        world = self.working + sum(checkpoints) * self.state + last * self.step
        return self.shared + _numbers(steps) + worlds * world

    def __str__(self) -> str:
        return (
            f"memory of a world in a batch for a gradient: {self.state} B by checkpoint,"
            f" {self.step:.0f} B by step between checkpoints, and {self.working:.0f} B besides"
        )


def gradient_memory(
    system: System, method: Method, state: State, control: PyTree = None
) -> GradientMemory:
    """Returns the memory to differentiate a batch of rollouts, as XLA plans it for this device.

    `jax.jit(jax.vmap(jax.grad(…)))` of a short rollout is compiled for two batch sizes and two
    lengths, which takes seconds. The differences give the memory per world and per step.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: state of one world.
        control: control input of one world for one step, or a policy as in `jc.rollout`.

    Returns:
        A `jc.analysis.GradientMemory`.

    Raises:
        ValueError: state and control do not fit, as in `jc.step`.
        RuntimeError: the compiler of this device does not report its memory plan.
    """
    policy = control if callable(control) else None
    checked_system(system, state, "jc.analysis.gradient_memory(system, method, s)")
    if not policy:
        control = idle(system, control)
        control = checked_control("gradient_memory", system, control, state.q.dtype)

    def planned(steps: int, worlds: int) -> int:
        controls = policy or jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * steps), control)

        def end(moved: tuple[Array, Array], rest: State) -> Array:
            start = dataclasses.replace(rest, q=moved[0], v=moved[1])
            final, _ = rollout(system, method, start, controls, DT, steps, record=nothing)
            return jnp.sum(final.q) + jnp.sum(final.v)

        return _planned(jax.grad(end), ((state.q, state.v), state), worlds)

    small, large = (planned(SHORT, worlds) for worlds in BATCHES)
    longer = planned(LONGER, BATCHES[0])
    world = (large - small) / (BATCHES[1] - BATCHES[0])
    # all worlds share the step indices, so their memory does not grow with the batch
    added = longer - small - _numbers(LONGER - SHORT)
    step = added / (LONGER - SHORT) / BATCHES[0]
    start = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    shared = small - _numbers(SHORT) - world * BATCHES[0]
    return GradientMemory(start, bytes_of(state), step, world - SHORT * step, shared)


def nothing(state: State, info: StepInfo) -> None:
    """Records no values; the `record` function of rollouts that need only the final state."""


def _numbers(steps: int) -> int:
    """Returns the size of the step indices of both passes [B]. All worlds share these arrays."""
    return 2 * steps * np.dtype(jnp.result_type(int)).itemsize


def _planned(f: Callable[..., Any], args: PyTree, worlds: int) -> int:
    """Compiles a batched function; returns the memory of its results and temporaries [B].

    Args:
        f: function of one world.
        args: arguments of one world.
        worlds: number of worlds.
    """
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), args)
    plan = jax.jit(jax.vmap(f)).lower(*batch).compile().memory_analysis()
    if plan is None:
        raise RuntimeError(
            f"memory: the compiler of '{jax.default_backend()}' does not say how much it plans."
        )
    return plan.output_size_in_bytes + plan.temp_size_in_bytes
