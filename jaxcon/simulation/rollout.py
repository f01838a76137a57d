"""Many steps in one scan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import PyTree
from jaxcon.model.state import State
from jaxcon.simulation.method import Method
from jaxcon.simulation.recovery import stop_failed
from jaxcon.simulation.step import StepInfo, step

Record = Callable[[State, StepInfo], PyTree]


def record_state(state: State, info: StepInfo) -> State:
    """The whole state: what `rollout` records unless told otherwise."""
    return state


def rollout(
    system: Any,
    method: Method,
    state: State,
    controls: Any,
    dt: Any,
    steps: int,
    *,
    record: Record = record_state,
    every: int = 1,
) -> tuple[State, PyTree]:
    """Steps in one scan, with a trajectory of chosen quantities at a chosen stride.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: the start.
        controls: None; arrays whose first axis enumerates steps; or a function of the state.
        dt: h, () [s].
        steps: how many.
        record: (state, info) → what to keep; the whole state unless given. `info` is what the step
            that led to the state saw at its start.
        every: keep one of so many steps; must divide `steps`.

    Returns:
        The final state, and what was recorded with a first axis of steps // every. A world that
        failed has no gradient in either.

    Raises:
        ValueError: `every` does not divide `steps`, or controls of another length.
        TypeError: `steps` or `every` is not an integer.
    """
    for what, number in (("steps", steps), ("every", every)):
        if not isinstance(number, int):
            raise TypeError(
                f"rollout: {what} must be an integer known when tracing, got {number!r}."
            )
    if steps < 0 or every < 1 or steps % every:
        raise ValueError(f"rollout: every={every} must divide steps={steps}.")
    feedback = controls if callable(controls) else None
    inputs = None if feedback else _split(controls, steps, every)

    def one(carry: tuple[State, StepInfo], control: PyTree) -> Any:
        state, _ = carry
        return step(system, method, state, feedback(state) if feedback else control, dt), None

    def several(state: State, controls: PyTree) -> tuple[State, PyTree]:
        (state, info), _ = jax.lax.scan(one, (state, empty), controls, every)
        return state, record(state, info)

    first = jax.tree.map(lambda x: x[0, 0], inputs)
    shapes = jax.eval_shape(lambda s: one((s, None), first)[0][1], state)  # type: ignore[arg-type]
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    final, trajectory = jax.lax.scan(several, state, inputs, steps // every)
    return stop_failed(final.status, final), stop_failed(final.status, trajectory)


def _split(controls: PyTree, steps: int, every: int) -> PyTree:
    """The controls with a first axis of recorded steps and a second of those between."""

    def split(x: Any) -> Any:
        x = jnp.asarray(x)
        if x.ndim == 0 or x.shape[0] != steps:
            raise ValueError(
                f"rollout: controls must have {steps} rows, one a step, got shape {x.shape}; repeat"
                " a constant one with jnp.tile, or give a function of the state."
            )
        return x.reshape((steps // every, every, *x.shape[1:]))

    return jax.tree.map(split, controls)
