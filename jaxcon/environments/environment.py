"""Environments as pure functions of pytrees: reset, step, observe, reward.

An `Environment` is a frozen dataclass. Its physical parameters are leaves, so `jax.vmap` over
environments randomizes them, and `jax.grad` differentiates with respect to them. Names, counts and
choices are static. A task adds four functions to its mechanism: the initial state, the control
inputs of an action, the observation and the reward.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, DType, Scalar
from jaxcon.execution.rollout import rollout
from jaxcon.methods.method import Method
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Number: TypeAlias = Array | float
"""A float or an array, possibly traced, that can be added to and multiplied by arrays."""

Option: TypeAlias = Scalar | Sequence[Scalar] | Method | DType | None
"""An option of a task's `build`: a number, a sequence of numbers, a method or a dtype."""


class Channel(NamedTuple):
    """The description of one component of an observation, and the bounds to which it is clipped.

    Attributes:
        name: a description, such as "rate of crank".
        unit: such as "m" or "rad/s"; "1" for a dimensionless number.
        least, most: the bounds.
    """

    name: str
    unit: str
    least: float
    most: float


@pytree
class Episode:
    """The state of an episode. A saved episode continues bit for bit when it is restored.

    Attributes:
        state: the state of the mechanism.
        goal: the target that the task drew for this episode; () for none.
        steps: the number of actions taken, ().
        key: the JAX key for the next draws of this episode.
        violation: the largest constraint violation |φ| during the last action, () [m or rad],
            evaluated at the start of each step.
    """

    state: State
    goal: Any
    steps: Array
    key: Array
    violation: Array


@pytree
class Outcome:
    """The result of one action.

    Attributes:
        observation: (n,); `Environment.observed` describes its components.
        reward: (); 0 if the simulation diverged.
        terminated: True if the task ended, ().
        truncated: True if the episode reached its horizon or diverged, ().
        info: `diverged`, the `status` code of the simulation, and `violation`.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    info: dict[str, Any]


@pytree
class Environment:
    """A mechanism with a task: the base class of all tasks.

    Attributes:
        system: the mechanism.
        method: integrator, stabilizer and solvers.
        dt: the step size h of the simulation, () [s].
        skip: the number of steps for which an action is held.
        horizon: the number of actions after which an episode is truncated; None for no limit.
    """

    system: BodySystem
    method: Method
    dt: Array
    skip: int = static()
    horizon: int | None = static()
    at_once: ClassVar[int] = 128
    """The largest number of copies simulated at once on a CPU. Larger batches run in chunks."""

    @property
    def dtype(self) -> np.dtype:
        """The floating dtype of the system."""
        return self.system.gravity.dtype

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The channels of an observation, one per component."""
        raise NotImplementedError

    @property
    def actions(self) -> tuple[str, ...]:
        """The name of each component of an action, with the quantity that ±1 stands for."""
        raise NotImplementedError

    @property
    def frame(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The view of a rendered image at the start: (left, right) and (bottom, top) [m]."""
        raise NotImplementedError

    def window(self, episode: Episode) -> tuple[tuple[float, float], tuple[float, float]]:
        """Returns the view of a rendered image, by default `frame`.

        The view must be as wide and as high as `frame`: all images of a task share a canvas.

        Args:
            episode: the episode that is drawn.
        """
        return self.frame

    def start(self, key: Array) -> tuple[State, Any]:
        """Draws the initial state of an episode and its goal.

        Args:
            key: a JAX key.
        """
        raise NotImplementedError

    def control(self, episode: Episode, action: Array) -> Array:
        """Returns the control inputs (n_u,) for an action within −1 to 1.

        By default, these are the action itself.

        Args:
            episode: the episode before the action.
            action: (number of actions,).
        """
        return action

    def observation(self, episode: Episode) -> Array:
        """Returns the observation before clipping, (n,).

        Args:
            episode: the current episode.
        """
        raise NotImplementedError

    def reward(self, before: Episode, action: Array, after: Episode) -> Array:
        """Returns the reward of an action, ().

        Rewards lie between 0 and 1, except for `HalfCheetah`, which has Gymnasium's reward.

        Args:
            before: the episode before the action.
            action: (number of actions,), each within −1 to 1.
            after: the episode after the action.
        """
        raise NotImplementedError

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the task has ended, (). By default it never ends.

        Args:
            episode: the current episode.
        """
        return jnp.zeros((), bool)

    def marks(self, axes: Axes, episode: Episode) -> None:
        """Draws the parts of an image that are not bodies, such as the goal; nothing by default.

        Args:
            axes: Matplotlib axes.
            episode: the current episode.
        """

    def reset(self, key: Array) -> Episode:
        """Starts an episode. All its random numbers derive from the key.

        Args:
            key: a JAX key.

        Raises:
            TypeError: the key is no key, or an array of keys.
        """
        checks.random_key(f"{type(self).__name__}.reset", "key", key)
        start_key, key = jax.random.split(key)
        state, goal = self.start(start_key)
        zero = jnp.zeros((), jnp.int32)
        return Episode(state, goal, zero, key, jnp.zeros((), self.dtype))

    def transition(self, episode: Episode, action: Scalar) -> Episode:
        """Returns the episode after one action, which is held for `skip` steps.

        Args:
            episode: the episode before the action.
            action: (number of actions,); components are clipped to −1 to 1.

        Raises:
            ValueError: the action is not real or has the wrong shape (at trace time).
            TypeError: `episode` is not an `Episode`.
        """
        self._check_episode(episode)
        return self.act(episode, self.allowed(action))

    def act(self, episode: Episode, action: Array) -> Episode:
        """Returns the episode after one action, without clipping the action."""
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

    def allowed(self, action: Scalar) -> Array:
        """Returns the action as an array, clipped to −1 to 1.

        Raises:
            ValueError: the action is not real, or does not have one component for each name in
                `actions`.
        """
        action = checks.numbers(type(self).__name__, "the action", action)
        action = jnp.asarray(action).astype(self.dtype)
        if action.shape != (len(self.actions),):
            raise ValueError(
                f"{type(self).__name__}: an action must have shape ({len(self.actions)},), got"
                f" {action.shape}; its numbers are {', '.join(self.actions)}."
            )
        return jnp.clip(action, -1, 1)

    def observe(self, episode: Episode) -> Array:
        """Returns the observation, clipped to the bounds of its channels, (n,).

        Raises:
            TypeError: `episode` is not an `Episode`.
        """
        self._check_episode(episode)
        least = jnp.asarray([channel.least for channel in self.observed], self.dtype)
        most = jnp.asarray([channel.most for channel in self.observed], self.dtype)
        return jnp.clip(self.observation(episode), least, most)

    def judge(self, before: Episode, action: Scalar, after: Episode) -> tuple[Array, Array, Array]:
        """Returns reward, terminated and truncated, () each.

        The reward is 0 if the simulation diverged.

        Raises:
            ValueError: the action is not real or has the wrong shape (at trace time).
            TypeError: `before` or `after` is not an `Episode`.
        """
        self._check_episode(before)
        self._check_episode(after)
        diverged = failed(after.state.status)
        # where the reward is masked, a NaN in the action would still make its gradient NaN
        action = jnp.nan_to_num(self.allowed(action))
        reward = jnp.where(diverged, 0, self.reward(before, action, after))
        late = jnp.zeros((), bool) if self.horizon is None else after.steps >= self.horizon
        return reward, self.terminal(after) & ~diverged, late | diverged

    def info(self, episode: Episode) -> dict[str, Array]:
        """Returns `diverged`, the status code and the constraint violation of the last action."""
        status = episode.state.status
        return {"diverged": failed(status), "status": status, "violation": episode.violation}

    def look(self, episode: Episode) -> tuple[Array, dict[str, Array]]:
        """Returns the observation and the info of an episode."""
        return self.observe(episode), self.info(episode)

    def step(self, episode: Episode, action: Scalar) -> tuple[Episode, Outcome]:
        """Takes one action. An episode that has ended is not reset.

        Args:
            episode: the result of `reset` or of an earlier `step`.
            action: (number of actions,), clipped to −1 to 1. NaN makes the simulation diverge.

        Returns:
            The episode and the outcome. If the simulation diverged, the episode is at its last
            finite state.

        Raises:
            ValueError: the action is not real or has the wrong shape (at trace time).
            TypeError: `episode` is not an `Episode`.
        """
        after = self.transition(episode, action)
        reward, terminated, truncated = self.judge(episode, action, after)
        observation, info = self.look(after)
        return after, Outcome(observation, reward, terminated, truncated, info)

    def _check_episode(self, episode: Episode) -> None:
        """Raises a TypeError if a value is not an `Episode`."""
        expected = "an Episode, the result of reset or step"
        checks.instance(type(self).__name__, "the episode", episode, Episode, expected)


def check_environment(owner: str, environment: Environment) -> None:
    """Raises a TypeError that names the function `owner` if a value is not an `Environment`."""
    expected = "an Environment such as jc.environments.make('CartPole')"
    checks.instance(owner, "environment", environment, Environment, expected)


def near(x: Array, scale: float) -> Array:
    """Returns the reward term 1 / (1 + (x/s)²) of an error x with scale s.

    It is 1 at x = 0 and ½ at x = ±s. Its slope is nonzero except at x = 0.

    Args:
        x: an error, of any shape.
        scale: s, in the unit of x.

    Raises:
        ValueError: x is not real, or the scale is not positive.
    """
    checks.numbers("near", "x", x)
    checks.check("near", "scale", scale, above=0)
    return 1 / (1 + (x / scale) ** 2)


def spread(key: Array, size: float, shape: tuple[int, ...], dtype: DType) -> Array:
    """Draws an array of uniform random numbers between −size and size."""
    # drawn flat, then reshaped: under vmap, XLA draws shape (2, 2) three times slower than (4,)
    return jax.random.uniform(key, (math.prod(shape),), dtype, -size, size).reshape(shape)


def angle_channels(name: str, most: float) -> tuple[Channel, ...]:
    """Returns the channels of an angle: its cosine, its sine, and its rate within ± `most`."""
    direction = [Channel(f"{f} of {name}", "1", -1.0, 1.0) for f in ("cosine", "sine")]
    return (*direction, Channel(f"rate of {name}", "rad/s", -most, most))
