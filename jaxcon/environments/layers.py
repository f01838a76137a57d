"""Hierarchical control: a slow policy sets targets, and a fast controller tracks them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Channel, Environment, Episode
from jaxcon.system.state import State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Controller = Callable[[Environment, Episode, Array], Array]
"""(environment, episode, target within −1 to 1) → an action of the low-level task."""


@pytree
class Layered(Environment):
    """A task whose actions are targets. A controller tracks them in a low-level task.

    The controller is called before every action of the low-level task. It may be constrained, for
    example by `feasible_action`. Observation, initial state and termination are those of the
    low-level task. The reward of a target is the low-level reward over the time that the target is
    held.

    Attributes:
        task: the low-level task. Its system, method and dt are fields of this environment.
        controller: a pure function; define it once, since every new function object recompiles.
        targets: the name of each component of a target, with the quantity that ±1 stands for.
        hold: the number of low-level actions for which a target is held.
    """

    task: Environment
    controller: Controller = static()
    targets: tuple[str, ...] = static()
    hold: int = static()

    @classmethod
    def build(
        cls, task: Environment, controller: Controller, targets: tuple[str, ...], hold: int
    ) -> Layered:
        """Builds the environment. Its horizon counts targets.

        Args:
            task: the low-level task.
            controller: (environment, episode, target within −1 to 1) → action of the task.
            targets: the name of each component of a target, with the quantity that ±1 stands for.
            hold: the number of low-level actions for which a target is held.

        Raises:
            ValueError: `hold` is not a whole number from 1.
        """
        checks.count("Layered", "hold", hold)
        horizon = None if task.horizon is None else -(-task.horizon // hold)
        skip = task.skip * hold
        return cls(
            task.system,
            task.method,
            task.dt,
            skip,
            horizon,
            task,
            controller,
            tuple(targets),
            hold,
        )

    @property
    def below(self) -> Environment:
        """The low-level task with the system, method and step size of this environment."""
        return dataclasses.replace(self.task, system=self.system, method=self.method, dt=self.dt)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The observation channels of the low-level task."""
        return self.task.observed

    @property
    def actions(self) -> tuple[str, ...]:
        """The components of an action: `targets`, because an action is a target."""
        return self.targets

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of images of the low-level task, (left, right) and (bottom, top) [m]."""
        return self.task.frame

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """Returns the current view of the low-level task."""
        return self.below.window(episode)

    def start(self, key: Array) -> tuple[State, Any]:
        """Draws the initial state and goal of the low-level task."""
        return self.below.start(key)

    def observation(self, episode: Episode) -> Array:
        """Returns the observation of the low-level task."""
        return self.below.observation(episode)

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the low-level task has ended."""
        return self.below.terminal(episode)

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the marks of the low-level task."""
        self.below.marks(axes, episode)

    def act(self, episode: Episode, action: Array) -> Episode:
        """Lets the controller track a target for `hold` actions, or until the task ends."""
        below = self.below

        def follow(now: Episode, _: None) -> tuple[Episode, Array]:
            after = below.transition(now, self.controller(below, now, action))
            over = below.terminal(now)
            after = jax.tree.map(lambda a, b: jnp.where(over, a, b), now, after)
            return after, after.violation

        last, worst = jax.lax.scan(follow, episode, None, self.hold)
        return dataclasses.replace(last, steps=episode.steps + 1, violation=jnp.max(worst))

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns the reward of the low-level task over the time for which a target is held.

        The low-level reward also needs a low-level action. It gets the action that the controller
        chooses at the end of that time.
        """
        low_level = self.below.allowed(self.controller(self.below, after, action))
        return dataclasses.replace(self.below, skip=self.skip).reward(before, low_level, after)
