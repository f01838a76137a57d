"""Gymnasium's interface to many copies of an environment in one program."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import Array
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import AutoresetMode, VectorEnv, batch_space, gymnasium
from jaxcon.environments.copies import Copies, Randomize, advance, begin, look, restart
from jaxcon.environments.environment import Environment
from jaxcon.environments.registry import make

# the environment is an argument, so that all of one structure share what was compiled
_look = jax.jit(look)
_begin = jax.jit(begin, static_argnums=(2, 3))
_advance = jax.jit(advance, static_argnums=(3, 4))
_restart = jax.jit(restart, static_argnums=3)


class GymnasiumVectorEnv(VectorEnv):
    """Many copies in one program on the device, with arrays of JAX.

    All copies act in one call, and those that are done are reset in it with keys of their own; the
    host is not asked. Wrap it into `gymnasium.wrappers.vector.JaxToNumpy` or `JaxToTorch` for
    policies that live elsewhere. A copy that diverges, as after an action of NaN, is truncated,
    flagged as `diverged` in the info, and reset like any other.

    Args:
        task: the name of a task, or an environment.
        num_envs: copies.
        max_episode_steps: actions until an episode is truncated; the task's unless given.
        render_mode: None or "rgb_array".
        autoreset_mode: when a copy that is done is reset: on the next step (default), on the same,
            whose info then has `final_obs` and `final_info`, or only by
            `reset(options={"reset_mask": …})`.
        randomize: (environment, key) → the environment of a copy for an episode.
        options: of the task's `build`.

    Raises:
        ValueError: a horizon, which `max_episode_steps` says.
    """

    def __init__(
        self,
        task: str | Environment,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        randomize: Randomize | None = None,
        **options: Any,
    ) -> None:
        adapters.check_no_horizon(options)
        environment = make(task, **options)
        limit = environment.horizon if max_episode_steps is None else max_episode_steps
        self.environment = dataclasses.replace(environment, horizon=limit)
        self.randomize, self.num_envs = randomize, num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        kind = {"autoreset_mode": self.autoreset_mode, "jax": True}
        self.metadata = adapters.describe(self.environment) | kind
        self.render_mode = adapters.check_render_mode(render_mode)
        self.single_observation_space = adapters.observation_space(environment)
        self.single_action_space = adapters.action_space(environment)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.copies: Copies | None = None
        self._canvas: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Starts an episode in every copy, or in those of `options["reset_mask"]`, (n,) of bools.

        Args:
            seed: of all that is drawn from now on, by those that are reset; None goes on drawing.
            options: `reset_mask`, or none.

        Raises:
            ValueError: unknown options, or a mask of another shape.
        """
        adapters.check_options(options, ("reset_mask",))
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            key = adapters.key_from(self.np_random)
            self.copies, _ = _begin(self.environment, key, self.num_envs, self.randomize)
            return _look(self.environment, self.copies)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"reset: options['reset_mask'] must be {self.num_envs} bools, got {mask.dtype} of"
                f" shape {mask.shape}."
            )
        copies = self._running()
        if seed is not None:  # else each goes on with its own key
            copies = _with_keys(copies, jnp.asarray(mask), adapters.key_from(self.np_random))
        copies = _restart(self.environment, copies, jnp.asarray(mask), self.randomize)
        self.copies = dataclasses.replace(copies, done=copies.done & ~mask)
        return _look(self.environment, self.copies)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One action of every copy, (n, number of actions), clipped to −1 to 1.

        Args:
            actions: (n, number of actions).

        Raises:
            ValueError: the actions have another shape.
        """
        copies = self._running()
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(
                f"{type(self.environment).__name__}: actions must have shape"
                f" {self.action_space.shape}, got {np.shape(actions)}; the numbers of each are"
                f" {', '.join(self.environment.actions)}."
            )
        mode = self.autoreset_mode.value
        self.copies, outcome = _advance(
            self.environment, copies, jnp.asarray(actions), mode, self.randomize
        )
        ends = outcome.terminated, outcome.truncated
        return outcome.observation, outcome.reward, *ends, outcome.info

    def save(self) -> dict[str, Any]:
        """Where all copies stand and what will be drawn next, as arrays of numpy to keep."""
        return {
            "copies": jax.tree.map(np.array, self._running()),
            "random": self.np_random.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Goes on from what `save` gave, with the very same numbers.

        Args:
            saved: from `save`.
        """
        self.copies = jax.tree.map(jnp.asarray, saved["copies"])
        self.np_random.bit_generator.state = saved["random"]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each copy, (height, width, 3), of bytes."""
        if self.render_mode is None:
            adapters.warn_of_no_mode()
            return None
        if self._canvas is None:
            self._canvas = render.canvas(self.environment)
        episodes = jax.tree.map(np.asarray, self._running().episode)
        each = (jax.tree.map(lambda x, i=i: x[i], episodes) for i in range(self.num_envs))
        return tuple(render.image(self.environment, episode, self._canvas) for episode in each)

    def close_extras(self, **kwargs: Any) -> None:
        """Lets go of the canvas."""
        self._canvas = None

    def _running(self) -> Copies:
        """The copies.

        Raises:
            gymnasium.error.ResetNeeded: there are none yet.
        """
        if self.copies is None:
            raise gymnasium.error.ResetNeeded("call reset before step, save or render.")
        return self.copies


def _with_keys(copies: Copies, chosen: Array, key: Array) -> Copies:
    """The copies with those keys for the chosen ones, (n,), that `begin` gives to all of them."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(chosen)))
    keys = jnp.where(chosen[:, None], keys, copies.episode.key)
    return dataclasses.replace(copies, episode=dataclasses.replace(copies.episode, key=keys))
