"""Simulates scenes and returns states, accelerations and multipliers at reference times."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.typing import Scalar
from jaxcon.execution.step import SolutionAt
from jaxcon.protocols import System

RK4 = jc.Method(integrator=jc.RK4())
"""The classical Runge–Kutta method with default feedback of at most 10/s; used in most cases."""


def sample(
    system: System, state: jc.State, times: Sequence[float], dt: float, method: jc.Method = RK4
) -> jc.State:
    """Returns the states at given times, from one rollout with a constant step size.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: the state at t = 0.
        times: multiples of dt; 0 is allowed [s].
        dt: the step size h [s].
        method: integrator, stabilizer and solver.

    Returns:
        The states as a batch, in the order of the times.

    Raises:
        ValueError: a time is not a multiple of dt.
        SimulationError: the simulation failed.
    """
    steps = [round(t / dt) for t in times]
    if any(abs(n * dt - t) > 1e-9 * (1 + t) for n, t in zip(steps, times, strict=True)):
        raise ValueError(f"sample: {times} are not all multiples of {dt}.")
    every = math.gcd(*steps)
    states = run(system, method, state, dt, every, max(steps) // every)
    jc.raise_for_status(states)
    index = np.array(steps) // every
    return jax.tree.map(lambda x: x[index], states)


@functools.partial(jax.jit, static_argnames=("every", "count"))
def run(
    system: System, method: jc.Method, state: jc.State, dt: Scalar, every: int, count: int
) -> jc.State:
    """Returns a batch of the initial state and `count` later states, `every` steps apart.

    The step is traced once.
    """

    def leap(state: jc.State, _: None) -> tuple[jc.State, jc.State]:
        final, _ = jc.rollout(system, method, state, None, dt, every, record=nothing)
        return final, final

    _, later = jax.lax.scan(leap, state, None, count)
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), state, later)


def nothing(state: jc.State, info: jc.extend.StepInfo) -> None:
    """Discards a step: a rollout that records with this function returns only its final state."""


@jax.jit
def solve(
    system: System, states: jc.State, dt: Scalar = 1e-3, method: jc.Method = RK4
) -> SolutionAt:
    """Solves the equations of motion at a batch of states for accelerations and multipliers."""
    return jax.vmap(lambda s: jc.forward_dynamics(system, s, None, method, dt))(states)


def multipliers(system: System, states: jc.State, name: str) -> np.ndarray:
    """Returns the multipliers λ of one constraint at a batch of states, (states, rows)."""
    first = jax.tree.map(lambda x: x[0], states)
    return np.asarray(solve(system, states).multipliers)[:, rows_of(system, first, name)]


def rows_of(system: System, state: jc.State, name: str) -> np.ndarray:
    """Returns the row indices of a constraint."""
    return jc.violation(system, state).layout.rows(name)
