"""Gymnasium's vector interface: many copies of an environment in one program."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from jaxcon.core import checks
from jaxcon.core.cores import compiler_options
from jaxcon.core.devices import over_devices, shard
from jaxcon.core.typing import Array, PyTree
from jaxcon.environments import adapters, render
from jaxcon.environments.adapters import AutoresetMode, VectorEnv, batch_space, gymnasium
from jaxcon.environments.copies import (
    Copies,
    Randomize,
    advance,
    begin,
    check_actions,
    look,
    restart,
)
from jaxcon.environments.environment import Environment, Option
from jaxcon.environments.registry import make

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

Batch = TypeVar("Batch", bound=PyTree)

# the environment is an argument, so that environments of equal structure share a compiled program
_begin = jax.jit(begin, static_argnums=(2, 3))


@functools.partial(jax.jit, static_argnums=2)
def _look(environment: Environment, copies: Copies, mesh: Mesh | None) -> Any:
    return _per_device(look, mesh)(environment, copies)


# the buffers of the old copies are donated to the new ones: this saves a tenth of a CartPole step
@functools.partial(
    jax.jit,
    static_argnums=(3, 4, 5),
    donate_argnums=1,
    compiler_options=dict(compiler_options),
)
def _advance(
    environment: Environment,
    copies: Copies,
    actions: Array,
    mode: str,
    randomize: Randomize | None,
    mesh: Mesh | None,
) -> Any:
    def on_device(shared: Environment, batch: tuple[Copies, Array]) -> Any:
        return advance(shared, *batch, mode, randomize)

    return _per_device(on_device, mesh)(environment, (copies, actions))


@functools.partial(jax.jit, static_argnums=(3, 4))
def _restart(
    environment: Environment,
    copies: Copies,
    chosen: Array,
    randomize: Randomize | None,
    mesh: Mesh | None,
) -> Copies:
    def on_device(shared: Environment, batch: tuple[Copies, Array]) -> Copies:
        return restart(shared, *batch, randomize)

    return _per_device(on_device, mesh)(environment, (copies, chosen))


def _per_device(
    function: Callable[[Any, Any], Any], mesh: Mesh | None
) -> Callable[[Any, Any], Any]:
    """Returns a function that calls `function` on each device, with the device's shard of a batch.

    Both functions take (environment, batch). Devices do not wait for each other. A device restarts
    copies only if some copies on it are finished.
    """
    return function if mesh is None else over_devices(function, mesh)


class GymnasiumVectorEnv(VectorEnv):
    """Many copies of an environment in one program on the device, with JAX arrays.

    One call steps all copies and resets the finished ones, without transfers to the host. Each copy
    has its own random key. For policies outside of JAX, wrap the environment into
    `gymnasium.wrappers.vector.JaxToNumpy` or `JaxToTorch`. A copy that diverges, such as after an
    action of NaN, is truncated and reset. Its info has `diverged`.

    The attribute `copies` holds the state of all copies. `step` donates the arrays of this state to
    the next state; to keep a state, use `save`.

    Args:
        task: the name of a task, or an environment.
        num_envs: the number of copies.
        max_episode_steps: the number of actions after which an episode is truncated; None for the
            horizon of the task, and −1 for no limit, as in Gymnasium.
        render_mode: None or "rgb_array".
        autoreset_mode: "NextStep" (default) resets a finished copy in the next step. "SameStep"
            resets it in the step that finishes it; the info then has `final_obs` and `final_info`.
            "Disabled" leaves it to `reset(options={"reset_mask": …})`.
        randomize: (environment, key) → the environment of a copy for one episode.
        devices: the number of devices over which the copies are sharded; it must divide `num_envs`.
            On a CPU, `jc.use_all_cores(2)` before the first use of JAX makes two devices.
        options: options of the task's `build`.

    Raises:
        ValueError: a count is not a whole number from 1, JAX has fewer devices, `devices` does not
            divide `num_envs`, or `horizon` is given instead of `max_episode_steps`.
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
        **options: Option,
    ) -> None:
        adapters.check_no_horizon(options)
        checks.count("VectorEnv", "num_envs", num_envs)
        self.mesh = _mesh(devices, num_envs)
        environment = make(task, **options)
        limit = adapters.time_limit(max_episode_steps, environment.horizon)
        environment = dataclasses.replace(environment, horizon=limit)
        if self.mesh is not None:  # a copy of the environment on every device
            environment = jax.device_put(environment, NamedSharding(self.mesh, PartitionSpec()))
        self.environment = environment
        self.randomize, self.num_envs = randomize, num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        batched = {"autoreset_mode": self.autoreset_mode, "jax": True}
        self.metadata = adapters.describe(self.environment) | batched
        self.render_mode = adapters.check_render_mode(render_mode)
        self.single_observation_space = adapters.observation_space(environment)
        self.single_action_space = adapters.action_space(environment)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.copies: Copies | None = None
        self._canvas: FigureCanvasAgg | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Starts an episode in every copy, or in the copies that `options["reset_mask"]` selects.

        Args:
            seed: seed of the new episodes; None continues the sequence of random numbers.
            options: `reset_mask`, a boolean array (n,); or None.

        Raises:
            ValueError: an option is unknown, or the mask has the wrong shape or dtype.
        """
        adapters.check_options(options, ("reset_mask",))
        mask = (options or {}).get("reset_mask")
        if mask is None:
            super().reset(seed=seed)
            key = adapters.key_from(self.np_random)
            copies, _ = _begin(self.environment, key, self.num_envs, self.randomize)
            self.copies = self._spread(copies)
            return _look(self.environment, self.copies, self.mesh)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"reset: options['reset_mask'] must be {self.num_envs} bools, got {mask.dtype} of"
                f" shape {mask.shape}."
            )
        chosen, running = self._spread(jnp.asarray(mask)), self._running()
        super().reset(seed=seed)  # after the checks: a refused mask does not seed the generator
        if seed is not None:  # otherwise each copy continues with its own key
            key = adapters.key_from(self.np_random)
            # keys as in `begin`: a seed gives a copy equal starts in a full and in a masked reset
            keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(self.num_envs))
            keys = jnp.where(chosen[:, None], keys, running.episode.key)
            episode = dataclasses.replace(running.episode, key=keys)
            running = dataclasses.replace(running, episode=episode)
        copies = _restart(self.environment, running, chosen, self.randomize, self.mesh)
        self.copies = dataclasses.replace(copies, done=copies.done & ~chosen)
        return _look(self.environment, self.copies, self.mesh)

    def step(self, actions: ArrayLike | Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Takes one action in every copy, clipped to −1 to 1.

        Args:
            actions: (n, number of actions).

        Raises:
            ValueError: the actions have the wrong shape or are not numbers.
        """
        copies = self._running()
        # JAX arrays are not converted: `jnp.asarray` would cost a tenth of a CartPole step
        actions = check_actions(self.environment, self.num_envs, actions)
        if not isinstance(actions, jax.Array):
            actions = np.asarray(actions, self.environment.dtype)
        mode, actions = self.autoreset_mode.value, self._spread(actions)
        self.copies, outcome = _advance(
            self.environment, copies, actions, mode, self.randomize, self.mesh
        )
        ends = outcome.terminated, outcome.truncated
        return outcome.observation, outcome.reward, *ends, outcome.info

    def save(self) -> dict[str, Any]:
        """Returns the state of all copies and of the random generator, as NumPy arrays."""
        return {
            "copies": jax.tree.map(np.array, self._running()),
            "random": self.np_random.bit_generator.state,
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Restores all copies from the result of `save`. They continue bit for bit.

        Args:
            saved: the result of `save`.

        Raises:
            ValueError: the save is from another task, precision or number of copies.
        """
        key = jax.ShapeDtypeStruct((2,), np.uint32)
        like, _ = _begin.eval_shape(self.environment, key, self.num_envs, self.randomize)
        adapters.check_saved(saved["copies"], like)
        self.copies = self._spread(jax.tree.map(jnp.asarray, saved["copies"]))
        self.np_random.bit_generator.state = saved["random"]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns an image of each copy, (height, width, 3), of bytes.

        Without a render mode, the method warns and returns None.
        """
        if self.render_mode is None:
            adapters.warn_of_no_mode()
            return None
        if self._canvas is None:
            self._canvas = render.canvas(self.environment)
        episodes = jax.tree.map(np.asarray, self._running().episode)
        each = (jax.tree.map(lambda x, i=i: x[i], episodes) for i in range(self.num_envs))
        return tuple(render.image(self.environment, episode, self._canvas) for episode in each)

    def close_extras(self, **kwargs: Option) -> None:
        """Releases the canvas of the images."""
        self._canvas = None

    def _spread(self, batch: Batch) -> Batch:
        """Shards arrays with a leading axis of copies over the devices."""
        return batch if self.mesh is None else shard(batch, self.mesh)

    def _running(self) -> Copies:
        """Returns the current copies.

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self.copies is None:
            raise gymnasium.error.ResetNeeded("call reset before step, save or render.")
        return self.copies


def _mesh(devices: int, copies: int) -> Mesh | None:
    """Returns the mesh of devices over which copies are sharded, or None for a single device.

    Raises:
        ValueError: JAX has fewer devices, or `devices` does not divide the number of copies.
    """
    available = jax.devices()
    if not 1 <= devices <= len(available):
        raise ValueError(
            f"devices must be from 1 to the {len(available)} of JAX, got {devices}; on a CPU,"
            " jc.use_all_cores(…) makes more, before JAX is used."
        )
    if copies % devices:
        raise ValueError(f"num_envs={copies} does not divide over {devices} devices.")
    return None if devices == 1 else Mesh(np.array(available[:devices]), ("worlds",))
