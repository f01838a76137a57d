"""Layered control: a slow policy sets targets, a fast controller follows them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.environments.environment import Channel, Environment, Episode
from jaxcon.model.state import State

Controller = Callable[[Environment, Episode, Array], Array]
"""(environment, episode, target within −1 to 1) → the action of the environment."""


@pytree
class Layered(Environment):
    """A task whose actions are targets, each held for several actions of a controller below.

    The controller is asked before every action of the task below; it may be constrained, as by
    `feasible_action`. Observation, start and end are those of the task below, and the reward is
    that of the task where a target ends, or the task is over.

    Attributes:
        task: the one below; its system, method and dt are those of this environment.
        controller: pure; define it once.
        targets: what a target consists of: names with the unit of its −1 to 1.
        hold: actions below for each target.
    """

    task: Environment
    controller: Controller = static()
    targets: tuple[str, ...] = static()
    hold: int = static()

    @classmethod
    def build(
        cls, task: Environment, controller: Controller, targets: tuple[str, ...], hold: int
    ) -> Layered:
        """The task under a controller; its horizon counts targets.

        Args:
            task: the one below.
            controller: (environment, episode, target within −1 to 1) → action of the task.
            targets: names with the unit of a target's −1 to 1.
            hold: actions below for each target.

        Raises:
            ValueError: `hold` is no whole number from 1.
        """
        checks.count("Layered", "hold", hold)
        horizon = None if task.horizon is None else -(-task.horizon // hold)
        own = task.system, task.method, task.dt, task.skip * hold, horizon
        return cls(*own, task, controller, tuple(targets), hold)

    @property
    def below(self) -> Environment:
        """The task with the numbers of this environment."""
        return dataclasses.replace(self.task, system=self.system, method=self.method, dt=self.dt)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """As below."""
        return self.task.observed

    @property
    def actions(self) -> tuple[str, ...]:
        """The targets."""
        return self.targets

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """As below."""
        return self.task.frame

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """As below."""
        return self.below.window(episode)

    def start(self, key: Array) -> tuple[State, PyTree]:
        """As below."""
        return self.below.start(key)

    def observation(self, episode: Episode) -> Array:
        """As below."""
        return self.below.observation(episode)

    def terminal(self, episode: Episode) -> Array:
        """As below."""
        return self.below.terminal(episode)

    def marks(self, axes: Any, episode: Episode) -> None:
        """As below."""
        self.below.marks(axes, episode)

    def act(self, episode: Episode, action: Array) -> Episode:
        """The controller follows a target for `hold` actions, or until the task is over."""
        below = self.below

        def follow(now: Episode, _: Any) -> tuple[Episode, Array]:
            after, over = below.transition(now, self.controller(below, now, action)), below.terminal
            after = jax.tree.map(lambda a, b: jnp.where(over(now), a, b), now, after)
            return after, after.violation

        last, worst = jax.lax.scan(follow, episode, None, self.hold)
        return dataclasses.replace(last, steps=episode.steps + 1, violation=jnp.max(worst))

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """As below over the time of a target, for what the controller does where it has come to."""
        own = self.below.allowed(self.controller(self.below, after, action))
        return dataclasses.replace(self.below, skip=self.skip).reward(before, own, after)
