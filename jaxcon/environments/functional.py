"""Gymnasium's functional interface to an environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcon.core.typing import Array
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import FuncEnv
from jaxcon.environments.environment import Environment, Episode
from jaxcon.environments.registry import make


class FunctionalEnv(FuncEnv):
    """Gymnasium's functional interface; its `params` are the environment itself.

    `params` of the same structure with other numbers make another world: a batch of them under
    `jax.vmap` gives each copy its own.

    Args:
        task: the name of a task, or an environment.
        options: of the task's `build`.
    """

    def __init__(self, task: str | Environment, **options: Any) -> None:
        self.environment = make(task, **options)
        self.observation_space = adapters.observation_space(self.environment)
        self.action_space = adapters.action_space(self.environment)
        super().__init__()

    def get_default_params(self, **kwargs: Any) -> Environment:
        """The environment."""
        return self.environment

    def initial(self, rng: Array, params: Any = None) -> Episode:
        """The start of an episode."""
        return self._of(params).reset(rng)

    def transition(self, state: Episode, action: Any, rng: Any, params: Any = None) -> Episode:
        """The episode after an action; the draws of a copy come from its own key."""
        return self._of(params).transition(state, action)

    def observation(self, state: Episode, rng: Any, params: Any = None) -> Array:
        """What is seen."""
        return self._of(params).observe(state)

    def reward(
        self, state: Episode, action: Any, next_state: Episode, rng: Any, params: Any = None
    ) -> Array:
        """What the action was worth."""
        return self._of(params).judge(state, action, next_state)[0]

    def terminal(self, state: Episode, rng: Any, params: Any = None) -> Array:
        """Returns True where the task is over, or the world diverged."""
        environment = self._of(params)
        return environment.terminal(state) | environment.info(state)["diverged"]

    def state_info(self, state: Episode, params: Any = None) -> dict[str, Array]:
        """Returns whether the world diverged, why, and the violation."""
        return self._of(params).info(state)

    def transition_info(
        self, state: Episode, action: Any, next_state: Episode, params: Any = None
    ) -> dict[str, Array]:
        """Returns `state_info` of the state after an action."""
        return self._of(params).info(next_state)

    def render_init(self, params: Any = None, **kwargs: Any) -> Any:
        """A canvas."""
        return render.canvas(self._of(params))

    def render_image(
        self, state: Episode, render_state: Any, params: Any = None
    ) -> tuple[Any, np.ndarray]:
        """The canvas, and the picture, (height, width, 3), of bytes."""
        return render_state, render.image(self._of(params), state, render_state)

    def render_close(self, render_state: Any, params: Any = None) -> None:
        """Nothing is left to close."""

    def _of(self, params: Any) -> Environment:
        return self.environment if params is None else params
