"""Gymnasium's functional interface to an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxcon.core.typing import Array, Scalar
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import FuncEnv
from jaxcon.environments.environment import Environment, Episode, Option
from jaxcon.environments.registry import make

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg


class FunctionalEnv(FuncEnv):
    """Gymnasium's functional interface. Its `params` are an `Environment`.

    To change parameters, pass an environment of equal structure with other numbers as `params`.
    Under `jax.vmap`, a batch of environments gives each copy its own environment.

    Args:
        task: the name of a task, or an environment.
        options: options of the task's `build`.
    """

    def __init__(self, task: str | Environment, **options: Option) -> None:
        self.environment = make(task, **options)
        self.observation_space = adapters.observation_space(self.environment)
        self.action_space = adapters.action_space(self.environment)
        super().__init__()

    def get_default_params(self, **kwargs: Option) -> Environment:
        """Returns the environment with which this interface was created."""
        return self.environment

    def initial(self, rng: Array, params: Environment | None = None) -> Episode:
        """Starts an episode, with `rng` as its JAX key."""
        return self._chosen(params).reset(rng)

    def transition(
        self, state: Episode, action: Scalar, rng: Array, params: Environment | None = None
    ) -> Episode:
        """Returns the episode after one action. `rng` is not used: an episode has its own key."""
        return self._chosen(params).transition(state, action)

    def observation(self, state: Episode, rng: Array, params: Environment | None = None) -> Array:
        """Returns the observation of an episode. `rng` is not used."""
        return self._chosen(params).observe(state)

    def reward(
        self,
        state: Episode,
        action: Scalar,
        next_state: Episode,
        rng: Array,
        params: Environment | None = None,
    ) -> Array:
        """Returns the reward of the action that led to `next_state`. `rng` is not used."""
        return self._chosen(params).judge(state, action, next_state)[0]

    def terminal(self, state: Episode, rng: Array, params: Environment | None = None) -> Array:
        """Returns True if the task has ended or the simulation diverged. `rng` is not used."""
        environment = self._chosen(params)
        return environment.terminal(state) | environment.info(state)["diverged"]

    def state_info(self, state: Episode, params: Environment | None = None) -> dict[str, Array]:
        """Returns `diverged`, the status code and the constraint violation of the last action."""
        return self._chosen(params).info(state)

    def transition_info(
        self, state: Episode, action: Scalar, next_state: Episode, params: Environment | None = None
    ) -> dict[str, Array]:
        """Returns `diverged`, the status code and the constraint violation of `next_state`."""
        return self._chosen(params).info(next_state)

    def render_init(self, params: Environment | None = None, **kwargs: Option) -> FigureCanvasAgg:
        """Creates the canvas on which `render_image` draws."""
        return render.canvas(self._chosen(params))

    def render_image(
        self, state: Episode, render_state: FigureCanvasAgg, params: Environment | None = None
    ) -> tuple[FigureCanvasAgg, np.ndarray]:
        """Returns the canvas and the image, (height, width, 3), of bytes."""
        return render_state, render.image(self._chosen(params), state, render_state)

    def render_close(
        self, render_state: FigureCanvasAgg, params: Environment | None = None
    ) -> None:
        """Does nothing: a canvas holds no resources that must be released."""

    def _chosen(self, params: Environment | None) -> Environment:
        """Returns the given environment, or the default environment for None."""
        return self.environment if params is None else params
