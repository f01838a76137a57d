"""How much memory a batch of worlds takes, as the compiler counts it. Host code, for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import PyTree
from jaxcon.model.state import State
from jaxcon.simulation.method import Method
from jaxcon.simulation.step import check_step, step_quietly

BATCHES = 64, 256
"""Sizes that are compiled: what a world takes is in proportion from here on."""
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
        """Of a step of so many worlds, their states included [B]."""
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
        control: of one world, as of `step`, or None.

    Returns:
        The `Memory`.

    Raises:
        ValueError: state and control do not fit, as in `step`.
        RuntimeError: the compiler of this device does not say what it plans.
    """
    control = jax.tree.map(jnp.asarray, check_step(system, method, state, control))

    def step(state: State, control: PyTree) -> Any:
        return step_quietly(system, method, state, control, DT)

    small, large = (_planned(step, (state, control), worlds) for worlds in BATCHES)
    working = (large - small) / (BATCHES[1] - BATCHES[0])
    own = sum(x.nbytes for x in jax.tree.leaves(state))
    return Memory(own, working, small - working * BATCHES[0])


def _planned(step: Any, args: PyTree, worlds: int) -> int:
    """Results and temporary memory of a compiled step of a batch [B]."""
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((worlds, *x.shape), x.dtype), args)
    plan = jax.jit(jax.vmap(step)).lower(*batch).compile().memory_analysis()
    if plan is None:
        raise RuntimeError(
            f"memory: the compiler of '{jax.default_backend()}' does not say how much it plans."
        )
    return plan.output_size_in_bytes + plan.temp_size_in_bytes
