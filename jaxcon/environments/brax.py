"""Brax's interface to an environment, for training code written for Brax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp

from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment, Episode
from jaxcon.environments.registry import make

try:
    from brax.envs.base import Env, State  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError("Brax's interface needs brax: pip install 'jaxcon[brax]'.") from error


class BraxEnv(Env):
    """An environment with Brax's interface.

        train(environment=BraxEnv("CartPole"), episode_length=500, num_timesteps=2_000_000, …)

    Brax's wrappers count actions and reset each copy to its first initial state. Pass the horizon
    of the task as `episode_length`. An environment that diverges is done. `sys` is the
    `Environment`, a pytree. A `randomization_fn` receives it and returns a batch of environments
    with the axes to map over.

    Args:
        task: the name of a task, or an environment.
        options: options of the task's `build`.

    References:
        Freeman et al., Brax: a differentiable physics engine for large scale rigid body simulation
        (2021), arXiv:2106.13281.
    """

    def __init__(self, task: str | Environment, **options: Any) -> None:
        self.sys = dataclasses.replace(make(task, **options), horizon=None)

    def reset(self, rng: Array) -> State:
        """Starts an episode. All its random numbers derive from the key."""
        episode = self.sys.reset(rng)
        zero = jnp.zeros((), self.sys.dtype)
        metrics = {"violation": zero, "diverged": zero}
        return State(episode, self.sys.observe(episode), zero, zero, metrics)

    def step(self, state: State, action: Array) -> State:
        """Takes one action, clipped to −1 to 1."""
        before: Episode = state.pipeline_state
        episode, outcome = self.sys.step(before, action)
        done, diverged = outcome.terminated | outcome.truncated, outcome.info["diverged"]
        metrics = {"violation": outcome.info["violation"], "diverged": diverged}
        dtype = self.sys.dtype
        return state.replace(
            pipeline_state=episode,
            obs=outcome.observation,
            reward=outcome.reward,
            done=done.astype(dtype),
            metrics=state.metrics | {name: x.astype(dtype) for name, x in metrics.items()},
        )

    @property
    def observation_size(self) -> int:
        """The number of components of an observation."""
        return len(self.sys.observed)

    @property
    def action_size(self) -> int:
        """The number of components of an action."""
        return len(self.sys.actions)

    @property
    def backend(self) -> str:
        """The name of the physics engine."""
        return "jaxcon"

    @property
    def dt(self) -> Array:
        """The duration of an action [s]."""
        return self.sys.dt * self.sys.skip
