"""An environment as pure functions of pytrees: reset, step, observe, reward.

An environment is a value. Its physical numbers are leaves, so that `jax.vmap` over environments
gives every copy a world of its own, and `jax.grad` reaches them; names, counts and choices are
static. What a task adds to its mechanism is four functions: where an episode starts, what an
action does, what is seen and what it is worth.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout


class Channel(NamedTuple):
    """One number of an observation, with the bounds to which it is clipped.

    Attributes:
        name: what it is.
        unit: as "m" or "rad/s"; "1" where there is none.
        least, most: the bounds.
    """

    name: str
    unit: str
    least: float
    most: float


@pytree
class Episode:
    """Where an episode stands; saved and restored as it is, it goes on with the very same numbers.

    Attributes:
        state: of the mechanism.
        goal: what the task drew for this episode.
        steps: actions taken, ().
        key: for what this copy draws next.
        violation: the largest |φ| that the last action's steps began with, ().
    """

    state: State
    goal: PyTree
    steps: Array
    key: Array
    violation: Array


@pytree
class Outcome:
    """What an action led to.

    Attributes:
        observation: (n,), by `Environment.observed`.
        reward: (); 0 where the world diverged.
        terminated: whether the task is over, ().
        truncated: whether the episode ends for another reason: its time is over, or it diverged.
        info: `diverged`, the `status` code of the world, and `violation`.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    info: dict[str, Any]


@pytree
class Environment:
    """A mechanism with a task; what the tasks of `jaxcon.environments.tasks` derive from.

    Attributes:
        system: the mechanism.
        method: how it is simulated.
        dt: h of a step of the simulation, () [s].
        skip: how many of these an action is held for.
        horizon: actions until an episode is truncated; None, and it is not.
    """

    system: Any
    method: Method
    dt: Array
    skip: int = static()
    horizon: int | None = static()
    at_once: ClassVar[int] = 128
    """The largest number of copies simulated at once on a CPU; more run one chunk after another."""

    @property
    def dtype(self) -> Any:
        """The dtype of every number."""
        return self.system.gravity.dtype

    @property
    def observed(self) -> tuple[Channel, ...]:
        """What an observation consists of."""
        raise NotImplementedError

    @property
    def actions(self) -> tuple[str, ...]:
        """What an action consists of: names with the unit of an action's −1 to 1."""
        raise NotImplementedError

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """What a picture shows at the start: (left, right) and (low, high) [m]."""
        raise NotImplementedError

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """The part of the world in a picture, as large as `frame`, which it is unless overridden.

        Args:
            episode: where it stands.
        """
        return self.frame

    def start(self, key: Array) -> tuple[State, PyTree]:
        """A state of the mechanism in which an episode begins, and its goal.

        Args:
            key: of JAX.
        """
        raise NotImplementedError

    def control(self, episode: Episode, action: Array) -> Array:
        """The control inputs (n_u,) for an action within −1 to 1; the action unless overridden.

        Args:
            episode: where it stands.
            action: (number of actions,).
        """
        return action

    def observation(self, episode: Episode) -> Array:
        """What is seen, before it is clipped, (n,).

        Args:
            episode: where it stands.
        """
        raise NotImplementedError

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """What an action within −1 to 1 was worth, ().

        From 0 to 1 in the tasks here but `HalfCheetah`, which has Gymnasium's reward.

        Args:
            before: the episode before the action.
            action: (number of actions,).
            after: the episode after it.
        """
        raise NotImplementedError

    def terminal(self, episode: Episode) -> Array:
        """Returns True where the task is over, ().

        Args:
            episode: where it stands.
        """
        return jnp.zeros((), bool)

    def marks(self, axes: Any, episode: Episode) -> None:
        """Draws into a picture what bodies do not show, such as the goal.

        Args:
            axes: of matplotlib.
            episode: where it stands.
        """

    def reset(self, key: Array) -> Episode:
        """The start of an episode, all of whose randomness comes from the key.

        Args:
            key: of JAX.
        """
        own, key = jax.random.split(key)
        state, goal = self.start(own)
        zero = jnp.zeros((), jnp.int32)
        return Episode(state, goal, zero, key, jnp.zeros((), self.dtype))

    def transition(self, episode: Episode, action: Any) -> Episode:
        """The episode after one action, held for `skip` steps.

        Args:
            episode: where it stands.
            action: (number of actions,); what lies outside of −1 to 1 is clipped.

        Raises:
            ValueError: the action has another shape (at trace time).
        """
        return self.act(episode, self.allowed(action))

    def act(self, episode: Episode, action: Array) -> Episode:
        """The episode after an action, which is not clipped."""
        control = self.control(episode, action)
        controls = jnp.broadcast_to(control, (self.skip, *control.shape))
        state, worst = rollout(
            self.system,
            self.method,
            episode.state,
            controls,
            self.dt,
            self.skip,
            record=lambda state, info: info.violation.worst,
        )
        return dataclasses.replace(
            episode, state=state, steps=episode.steps + 1, violation=jnp.max(worst)
        )

    def allowed(self, action: Any) -> Array:
        """The action, clipped to −1 to 1 and checked.

        Raises:
            ValueError: it has another shape than `actions` says.
        """
        action = jnp.asarray(action).astype(self.dtype)
        if action.shape != (len(self.actions),):
            raise ValueError(
                f"{type(self).__name__}: an action must have shape ({len(self.actions)},), got"
                f" {action.shape}; its numbers are {', '.join(self.actions)}."
            )
        return jnp.clip(action, -1, 1)

    def observe(self, episode: Episode) -> Array:
        """The observation, clipped to the bounds of its channels, (n,)."""
        least, most = (
            jnp.asarray([getattr(c, side) for c in self.observed], self.dtype)
            for side in ("least", "most")
        )
        return jnp.clip(self.observation(episode), least, most)

    def judge(self, before: Episode, action: Any, after: Episode) -> tuple[Array, Array, Array]:
        """Reward, terminated and truncated, () each; a world that diverged earns nothing."""
        diverged = failed(after.state.status)
        action = jnp.nan_to_num(self.allowed(action))
        reward = jnp.where(diverged, 0, self.reward(before, action, after))
        late = jnp.zeros((), bool) if self.horizon is None else after.steps >= self.horizon
        return reward, self.terminal(after) & ~diverged, late | diverged

    def info(self, episode: Episode) -> dict[str, Array]:
        """Returns whether the world diverged, why, and how far it was off its constraints."""
        status = episode.state.status
        return {"diverged": failed(status), "status": status, "violation": episode.violation}

    def look(self, episode: Episode) -> tuple[Array, dict[str, Array]]:
        """Observation and info."""
        return self.observe(episode), self.info(episode)

    def step(self, episode: Episode, action: Any) -> tuple[Episode, Outcome]:
        """One action: the episode after it, and what it led to; never resets.

        Args:
            episode: from `reset` or `step`.
            action: (number of actions,), clipped to −1 to 1. NaN makes the world diverge.

        Returns:
            The episode, in a world that diverged where it last was finite, and the outcome.

        Raises:
            ValueError: the action has another shape (at trace time).
        """
        after = self.transition(episode, action)
        reward, terminated, truncated = self.judge(episode, action, after)
        observation, info = self.look(after)
        return after, Outcome(observation, reward, terminated, truncated, info)


def near(x: Any, scale: float) -> Array:
    """1 / (1 + (x/s)²): 1 at x = 0, ½ at x = ±s, with a slope everywhere else.

    Args:
        x: of any shape.
        scale: s, in the unit of x.
    """
    return 1 / (1 + (x / scale) ** 2)


def spread(key: Array, size: float, shape: tuple[int, ...], dtype: Any) -> Array:
    """Uniform numbers from −size to size.

    Drawn in a row: of many copies, XLA draws two rows of two at a third of the pace of one of four.
    """
    return jax.random.uniform(key, (math.prod(shape),), dtype, -size, size).reshape(shape)


def angle_channels(name: str, most: float) -> tuple[Channel, ...]:
    """Cosine, sine and rate of an angle."""
    turn = [Channel(f"{f} of {name}", "1", -1.0, 1.0) for f in ("cosine", "sine")]
    return (*turn, Channel(f"rate of {name}", "rad/s", -most, most))
