"""Gymnasium's interface to one copy of an environment, and its registry."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import PICTURES, gymnasium
from jaxcon.environments.environment import Environment, Episode
from jaxcon.environments.registry import TASKS, horizon, make

# the environment is an argument, so that all of one structure share what was compiled
_reset = jax.jit(lambda environment, key: environment.reset(key))
_look = jax.jit(lambda environment, episode: environment.look(episode))
_step = jax.jit(lambda environment, episode, action: environment.step(episode, action))


def register() -> None:
    """Tells Gymnasium of every task, as "jaxcon/CartPole-v0"."""
    for task in TASKS:
        name = f"jaxcon/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="jaxcon.environments.gym:GymnasiumEnv",
                vector_entry_point="jaxcon.environments.vector:GymnasiumVectorEnv",
                max_episode_steps=horizon(task),
                kwargs={"task": task},
            )


class GymnasiumEnv(gymnasium.Env):
    """One copy, with arrays of numpy.

    Out-of-range actions are clipped, as those of Gymnasium's pendulum. The info of a step says
    whether the simulation `diverged`, in which case the episode is truncated, its `status` in a
    word, and the largest `violation` of a constraint. Time limits are those of `gymnasium.make`.

    Args:
        task: the name of a task, or an environment.
        render_mode: None or "rgb_array".
        options: of the task's `build`.

    Raises:
        ValueError: a horizon, which `gymnasium.make` takes as `max_episode_steps`.
    """

    metadata: dict[str, Any] = {"render_modes": [PICTURES], "render_fps": 50}

    def __init__(
        self, task: str | Environment, render_mode: str | None = None, **options: Any
    ) -> None:
        adapters.check_no_horizon(options)
        environment = make(task, **options)
        self.environment = dataclasses.replace(environment, horizon=None)
        self.metadata = adapters.describe(self.environment)
        self.render_mode = adapters.check_render_mode(render_mode)
        self.observation_space = adapters.observation_space(environment)
        self.action_space = adapters.action_space(environment)
        self.episode: Episode | None = None
        self._canvas: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; those after a seed are the same whenever the seed is.

        Args:
            seed: of all that is drawn from now on; None goes on drawing.
            options: none.

        Raises:
            ValueError: options, of which there are none.
        """
        adapters.check_options(options, ())
        super().reset(seed=seed)
        self.episode = _reset(self.environment, adapters.key_from(self.np_random))
        observation, info = _look(self.environment, self.episode)
        return np.array(observation), in_words(info)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One action, (number of actions,), clipped to −1 to 1.

        Args:
            action: (number of actions,).

        Raises:
            ValueError: the action has another shape, or is not a number.
        """
        episode = self._running()
        action, names = np.asarray(action, self.environment.dtype), self.environment.actions
        if action.shape != (len(names),) or np.isnan(action).any():
            raise ValueError(
                f"{type(self.environment).__name__}: an action must be {len(names)} numbers"
                f" from -1 to 1 ({', '.join(names)}), got {action}."
            )
        self.episode, outcome = _step(self.environment, episode, action)
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return np.array(outcome.observation), float(outcome.reward), *ends, in_words(outcome.info)

    def save(self) -> dict[str, Any]:
        """Where the episode stands and what will be drawn next, as arrays of numpy to keep.

        Actions are counted by `gymnasium.make`'s wrapper for its time limit, which this is not of.
        """
        return {
            "episode": jax.tree.map(np.array, self._running()),
            "random": self.np_random.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Goes on from what `save` gave, with the very same numbers.

        Args:
            saved: from `save`.

        Raises:
            ValueError: it is of another task or precision.
        """
        key = jax.ShapeDtypeStruct((2,), np.uint32)
        adapters.check_saved(saved["episode"], _reset.eval_shape(self.environment, key))
        self.episode = jax.tree.map(jnp.asarray, saved["episode"])
        self.np_random.bit_generator.state = saved["random"]

    def render(self) -> np.ndarray | None:
        """The picture, (height, width, 3), of bytes.

        Raises:
            ImportError: matplotlib is not installed.
        """
        if self.render_mode is None:
            adapters.warn_of_no_mode()
            return None
        if self._canvas is None:
            self._canvas = render.canvas(self.environment)
        return render.image(self.environment, self._running(), self._canvas)

    def close(self) -> None:
        """Lets go of the canvas."""
        self._canvas = None

    def _running(self) -> Episode:
        """The episode.

        Raises:
            gymnasium.error.ResetNeeded: there is none yet.
        """
        if self.episode is None:
            raise gymnasium.error.ResetNeeded("call reset before step, save or render.")
        return self.episode


def in_words(info: dict[str, Array]) -> dict[str, Any]:
    """An info of one copy in Python's types."""
    return {
        "diverged": bool(info["diverged"]),
        "status": Status(int(info["status"])).name,
        "violation": float(info["violation"]),
    }
