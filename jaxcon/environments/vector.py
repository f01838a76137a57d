"""Gymnasium's interface to many copies of an environment in one program."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcon.core import checks
from jaxcon.core.devices import over_devices, shard
from jaxcon.core.typing import Array
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import AutoresetMode, VectorEnv, batch_space, gymnasium
from jaxcon.environments.copies import Copies, Randomize, advance, begin, look, restart
from jaxcon.environments.environment import Environment
from jaxcon.environments.registry import make

# the environment is an argument, so that all of one structure share what was compiled
_begin = jax.jit(begin, static_argnums=(2, 3))


@functools.partial(jax.jit, static_argnums=2)
def _look(environment: Environment, copies: Copies, mesh: Mesh | None) -> Any:
    return _apart(look, mesh)(environment, copies)


# it gives up the copies it gets, whose memory the new ones take: a tenth of a step of CartPole
@functools.partial(jax.jit, static_argnums=(3, 4, 5), donate_argnums=1)
def _advance(
    environment: Environment,
    copies: Copies,
    actions: Array,
    mode: str,
    randomize: Randomize | None,
    mesh: Mesh | None,
) -> Any:
    def own(shared: Environment, batch: tuple[Copies, Array]) -> Any:
        return advance(shared, *batch, mode, randomize)

    return _apart(own, mesh)(environment, (copies, actions))


@functools.partial(jax.jit, static_argnums=(3, 4))
def _restart(
    environment: Environment,
    copies: Copies,
    chosen: Array,
    randomize: Randomize | None,
    mesh: Mesh | None,
) -> Copies:
    def own(shared: Environment, batch: tuple[Copies, Array]) -> Copies:
        return restart(shared, *batch, randomize)

    return _apart(own, mesh)(environment, (copies, chosen))


def _apart(function: Callable[[Any, Any], Any], mesh: Mesh | None) -> Callable[[Any, Any], Any]:
    """function(environment, batch), where each device has its own part of the copies.

    So none waits for another, or starts episodes because copies of another are done.
    """
    return function if mesh is None else over_devices(function, mesh)


class GymnasiumVectorEnv(VectorEnv):
    """Many copies in one program on the device, with arrays of JAX.

    All copies act in one call, and those that are done are reset in it with keys of their own; the
    host is not asked. Wrap it into `gymnasium.wrappers.vector.JaxToNumpy` or `JaxToTorch` for
    policies that live elsewhere. A copy that diverges, as after an action of NaN, is truncated,
    flagged as `diverged` in the info, and reset like any other.

    `copies` is where they stand, whose arrays the next step takes: `save` keeps them.

    Args:
        task: the name of a task, or an environment.
        num_envs: copies.
        max_episode_steps: actions until an episode is truncated; the task's unless given, and as
            many as it takes for Gymnasium's −1.
        render_mode: None or "rgb_array".
        autoreset_mode: when a copy that is done is reset: on the next step (default), on the same,
            whose info then has `final_obs` and `final_info`, or only by
            `reset(options={"reset_mask": …})`.
        randomize: (environment, key) → the environment of a copy for an episode.
        devices: over how many the copies are spread, which must divide them; on a CPU,
            `jax.config.update("jax_num_cpu_devices", 2)`, before JAX is used, makes two of it.
        options: of the task's `build`.

    Raises:
        ValueError: a number that is no count, JAX has fewer devices, the copies do not divide over
            them, or a horizon is given, which `max_episode_steps` says.
    """

    def __init__(
        self,
        task: str | Environment,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        randomize: Randomize | None = None,
        devices: int = 1,
        **options: Any,
    ) -> None:
        adapters.check_no_horizon(options)
        checks.count("VectorEnv", "num_envs", num_envs)
        self.mesh = _line(devices, num_envs)
        environment = make(task, **options)
        limit = adapters.time_limit(max_episode_steps, environment.horizon)
        self.environment = self._everywhere(dataclasses.replace(environment, horizon=limit))
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
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            return self._reset_some(np.asarray(mask), seed)
        super().reset(seed=seed)
        key = adapters.key_from(self.np_random)
        copies, _ = _begin(self.environment, key, self.num_envs, self.randomize)
        self.copies = self._spread(copies)
        return _look(self.environment, self.copies, self.mesh)

    def _reset_some(self, mask: np.ndarray, seed: int | None) -> tuple[Array, dict[str, Any]]:
        """As `reset` of the copies of a mask; one that is refused leaves the generator alone."""
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"reset: options['reset_mask'] must be {self.num_envs} bools, got {mask.dtype} of"
                f" shape {mask.shape}."
            )
        chosen, running = self._spread(jnp.asarray(mask)), self._running()
        super().reset(seed=seed)
        if seed is not None:  # else each goes on with its own key
            running = _with_keys(running, chosen, adapters.key_from(self.np_random))
        copies = _restart(self.environment, running, chosen, self.randomize, self.mesh)
        self.copies = dataclasses.replace(copies, done=copies.done & ~chosen)
        return _look(self.environment, self.copies, self.mesh)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One action of every copy, (n, number of actions), clipped to −1 to 1.

        Args:
            actions: (n, number of actions).

        Raises:
            ValueError: the actions have another shape, or are no numbers.
        """
        copies = self._running()
        # an array of JAX stays what it is: to ask JAX for it takes a tenth of a step of CartPole
        if not isinstance(actions, jax.Array):
            actions = np.asarray(actions, self.environment.dtype)
        if actions.shape != self.action_space.shape:
            raise ValueError(
                f"{type(self.environment).__name__}: actions must have shape"
                f" {self.action_space.shape}, got {actions.shape}; the numbers of each are"
                f" {', '.join(self.environment.actions)}."
            )
        mode, own = self.autoreset_mode.value, self._spread(actions)
        self.copies, outcome = _advance(
            self.environment, copies, own, mode, self.randomize, self.mesh
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

        Raises:
            ValueError: it is of another task, precision or number of copies.
        """
        key = jax.ShapeDtypeStruct((2,), np.uint32)
        like, _ = _begin.eval_shape(self.environment, key, self.num_envs, self.randomize)
        adapters.check_saved(saved["copies"], like)
        self.copies = self._spread(jax.tree.map(jnp.asarray, saved["copies"]))
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

    def _everywhere(self, environment: Environment) -> Environment:
        """The environment on every device."""
        if self.mesh is None:
            return environment
        return jax.device_put(environment, NamedSharding(self.mesh, PartitionSpec()))

    def _spread(self, batch: Any) -> Any:
        """Copies, or what each of them gets, over the devices."""
        return batch if self.mesh is None else shard(batch, self.mesh)

    def _running(self) -> Copies:
        """The copies.

        Raises:
            gymnasium.error.ResetNeeded: there are none yet.
        """
        if self.copies is None:
            raise gymnasium.error.ResetNeeded("call reset before step, save or render.")
        return self.copies


def _line(devices: int, copies: int) -> Mesh | None:
    """The devices, or None where there is only one.

    Raises:
        ValueError: JAX has fewer, or the copies do not divide over them.
    """
    there = jax.devices()
    if not 1 <= devices <= len(there):
        raise ValueError(
            f"devices must be from 1 to the {len(there)} of JAX, got {devices}; on a CPU,"
            ' jax.config.update("jax_num_cpu_devices", …) makes more, before JAX is used.'
        )
    if copies % devices:
        raise ValueError(f"num_envs={copies} does not divide over {devices} devices.")
    return None if devices == 1 else Mesh(np.array(there[:devices]), ("worlds",))


def _with_keys(copies: Copies, chosen: Array, key: Array) -> Copies:
    """The copies with those keys for the chosen ones, (n,), that `begin` gives to all of them."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(chosen)))
    keys = jnp.where(chosen[:, None], keys, copies.episode.key)
    return dataclasses.replace(copies, episode=dataclasses.replace(copies.episode, key=keys))
