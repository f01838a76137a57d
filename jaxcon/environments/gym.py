"""Gymnasium's interface to one copy of an environment, and the registration of tasks."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcon.core.cores import compiler_options
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import RGB_ARRAY, gymnasium
from jaxcon.environments.environment import Environment, Episode, Option
from jaxcon.environments.registry import TASKS, horizon, make

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

# the environment is an argument, so that environments of equal structure share a compiled program
_reset = jax.jit(lambda environment, key: environment.reset(key))
_look = jax.jit(lambda environment, episode: environment.look(episode))
_step = jax.jit(
    lambda environment, episode, action: environment.step(episode, action),
    compiler_options=dict(compiler_options),
)


def register() -> None:
    """Registers every task with Gymnasium, as "jaxcon/CartPole-v0"."""
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
    """One copy of an environment, with NumPy arrays.

    Actions out of range are clipped, as in Gymnasium's pendulum. The info of a step has `diverged`,
    the name of the `status`, and the largest constraint `violation`. An episode that diverges is
    truncated. `gymnasium.make` sets time limits.

    Args:
        task: the name of a task, or an environment.
        render_mode: None or "rgb_array".
        options: options of the task's `build`.

    Raises:
        ValueError: `horizon` is given; pass `max_episode_steps` to `gymnasium.make`.
    """

    metadata: dict[str, Any] = {"render_modes": [RGB_ARRAY], "render_fps": 50}

    def __init__(
        self, task: str | Environment, render_mode: str | None = None, **options: Option
    ) -> None:
        adapters.check_no_horizon(options)
        environment = make(task, **options)
        self.environment = dataclasses.replace(environment, horizon=None)
        self.metadata = adapters.describe(self.environment)
        self.render_mode = adapters.check_render_mode(render_mode)
        self.observation_space = adapters.observation_space(environment)
        self.action_space = adapters.action_space(environment)
        self.episode: Episode | None = None
        self._canvas: FigureCanvasAgg | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode. After a seed, the sequence of episodes is reproducible.

        Args:
            seed: seed of the random generator; None continues its sequence of random numbers.
            options: None or empty; there are no options.

        Raises:
            ValueError: options are given.
        """
        adapters.check_options(options, ())
        super().reset(seed=seed)
        self.episode = _reset(self.environment, adapters.key_from(self.np_random))
        observation, info = _look(self.environment, self.episode)
        return np.array(observation), in_words(info)

    def step(self, action: ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one action, clipped to −1 to 1.

        Args:
            action: (number of actions,).

        Raises:
            ValueError: the action has the wrong shape or contains NaN.
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
        """Returns the episode and the state of the random generator, as NumPy arrays.

        The action count of `gymnasium.make`'s time limit is not included: it is in Gymnasium's
        wrapper.
        """
        return {
            "episode": jax.tree.map(np.array, self._running()),
            "random": self.np_random.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Restores an episode from the result of `save`. It continues bit for bit.

        Args:
            saved: the result of `save`.

        Raises:
            ValueError: the save is from another task or precision.
        """
        key = jax.ShapeDtypeStruct((2,), np.uint32)
        adapters.check_saved(saved["episode"], _reset.eval_shape(self.environment, key))
        self.episode = jax.tree.map(jnp.asarray, saved["episode"])
        self.np_random.bit_generator.state = saved["random"]

    def render(self) -> np.ndarray | None:
        """Returns the image, (height, width, 3), of bytes; None without a render mode.

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
        """Releases the canvas."""
        self._canvas = None

    def _running(self) -> Episode:
        """Returns the current episode.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self.episode is None:
            raise gymnasium.error.ResetNeeded("call reset before step, save or render.")
        return self.episode


def in_words(info: dict[str, Array]) -> dict[str, Any]:
    """Converts the info of one copy to Python types, and the status code to its name."""
    return {
        "diverged": bool(info["diverged"]),
        "status": Status(int(info["status"])).name,
        "violation": float(info["violation"]),
    }
