"""Simulated states at the times of a reference."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

RK4 = jc.Method(integrator=jc.RK4())
"""The classical method with the default feedback, at most 10/s: what most cases run with."""


def sample(
    system: Any, state: jc.State, times: Sequence[float], dt: float, method: jc.Method = RK4
) -> jc.State:
    """The states at some times, in one rollout of constant step.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: at t = 0.
        times: multiples of dt, 0 allowed [s].
        dt: h [s].
        method: integrator, stabiliser and solver.

    Returns:
        The states as a batch, in the order of the times.

    Raises:
        ValueError: a time is no multiple of dt.
        SimulationError: the world failed.
    """
    steps = [round(t / dt) for t in times]
    if any(abs(n * dt - t) > 1e-9 * (1 + t) for n, t in zip(steps, times, strict=True)):
        raise ValueError(f"sample: {times} are not all multiples of {dt}.")
    every = math.gcd(*steps)
    states = run(system, method, state, dt, every, max(steps) // every)
    jc.raise_for_status(states)
    rows = np.array(steps) // every
    return jax.tree.map(lambda x: x[rows], states)


@functools.partial(jax.jit, static_argnames=("every", "count"))
def run(
    system: Any, method: jc.Method, state: jc.State, dt: Any, every: int, count: int
) -> jc.State:
    """The start and `count` states, `every` steps apart, as a batch; the step is traced once."""

    def leap(state: jc.State, _: None) -> tuple[jc.State, jc.State]:
        final, _ = jc.rollout(system, method, state, None, dt, every, record=nothing)
        return final, final

    _, later = jax.lax.scan(leap, state, None, count)
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), state, later)


def nothing(state: jc.State, info: jc.StepInfo) -> None:
    """Records nothing: only the final state of a rollout is wanted."""


@jax.jit
def solve(system: Any, states: jc.State, dt: Any = 1e-3, method: jc.Method = RK4) -> Any:
    """Accelerations and multipliers at a batch of states."""
    return jax.vmap(lambda s: jc.forward_dynamics(system, s, None, method, dt))(states)


def multipliers(system: Any, states: jc.State, name: str) -> np.ndarray:
    """λ of one constraint at a batch of states, (states, rows)."""
    first = jax.tree.map(lambda x: x[0], states)
    return np.asarray(solve(system, states).multipliers)[:, rows_of(system, first, name)]


def rows_of(system: Any, state: jc.State, name: str) -> np.ndarray:
    """The row numbers of a constraint."""
    return jc.violation(system, state).layout.rows(name)
