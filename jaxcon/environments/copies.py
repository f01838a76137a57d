"""A batch of copies of an environment in one program; each copy resets when its episode ends."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment, Episode, Outcome, check_environment

T = TypeVar("T")

Randomize = Callable[[Environment, Array], Environment]
"""(environment, key) → an environment of equal structure, for one copy and one episode."""

MODES = ("NextStep", "SameStep", "Disabled")
"""Gymnasium's names of the modes. A mode determines when a finished copy is reset."""

RESTART_SHARES, LEAST_RESTARTS = (16, 4, 1), 64
"""Initial states are computed for 1/16, 1/4 or all of the copies, but for at least 64."""


@pytree
class Copies:
    """The state of n copies of an environment. All arrays have a leading axis of length n.

    Attributes:
        episode: the episode of each copy.
        done: True for copies whose episode has ended, (n,).
        world: the environment of each copy if copies are randomized; otherwise (), as all copies
            share one environment.
    """

    episode: Episode
    done: Array
    world: Any = ()


def begin(
    environment: Environment, key: Array, count: int, randomize: Randomize | None = None
) -> tuple[Copies, Array]:
    """Starts an episode in every copy.

    Args:
        environment: the environment to copy.
        key: a JAX key. The key of each copy is derived from it and does not depend on n.
        count: n, the number of copies.
        randomize: draws a copy's environment anew for each episode; None for equal copies.

    Returns:
        The copies and their observations (n, …).

    Raises:
        ValueError: `count` is not a whole number from 1.
        TypeError: another argument has the wrong type.
    """
    check_environment("begin", environment)
    checks.random_key("begin", "key", key)
    checks.count("begin", "count", count)
    if randomize is not None:
        checks.takes("begin", "randomize", randomize, ("environment", "key"))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(count))
    episode, world = _start(environment, keys, randomize)
    copies = Copies(episode, jnp.zeros(count, bool), world)
    return copies, look(environment, copies)[0]


def advance(
    environment: Environment,
    copies: Copies,
    actions: Array,
    mode: str = "NextStep",
    randomize: Randomize | None = None,
) -> tuple[Copies, Outcome]:
    """Takes one action in every copy. The function is pure and can be scanned.

    Args:
        environment: the environment given to `begin`.
        copies: the copies before the actions.
        actions: (n, number of actions).
        mode: "NextStep": a finished copy ignores its action, is reset and gets reward 0.
            "SameStep": a copy is reset right after its last action; the info then has the
            observation and info before the reset, as `final_obs` and `final_info`. "Disabled":
            copies are never reset.
        randomize: the function given to `begin`.

    Returns:
        The copies, and the outcome of each, (n, …).

    Raises:
        ValueError: the mode is unknown, or the actions are not real or have the wrong shape.
        TypeError: the environment or the copies have the wrong type.
    """
    check_environment("advance", environment)
    checks.instance("advance", "copies", copies, Copies, "the first result of begin or advance")
    if mode not in MODES:
        raise ValueError(f"advance: mode must be one of {', '.join(MODES)}, got {mode!r}.")
    actions = jnp.asarray(check_actions(environment, len(copies.done), actions))
    after = simulate(environment, copies, actions)
    reward, terminated, truncated = over(
        environment,
        copies,
        lambda world, *judged: world.judge(*judged),
        actions,
        after,
    )
    stepped = dataclasses.replace(copies, episode=after, done=terminated | truncated)
    if mode == "NextStep":
        waiting = copies.done
        reward = jnp.where(waiting, 0, reward)
        terminated, truncated = terminated & ~waiting, truncated & ~waiting
        stepped = dataclasses.replace(stepped, done=terminated | truncated)
        stepped = restart(environment, stepped, waiting, randomize)
    final: dict[str, Any] = {}
    if mode == "SameStep":
        observation, info = look(environment, stepped)
        final = {"final_obs": observation, "_final_obs": stepped.done}
        final |= {"final_info": info, "_final_info": stepped.done}
        stepped = restart(environment, stepped, stepped.done, randomize)
    observation, info = look(environment, stepped)
    return stepped, Outcome(observation, reward, terminated, truncated, info | final)


def check_actions(environment: Environment, count: int, actions: Any) -> Any:
    """Checks the actions of all copies, and returns them as an array of NumPy or JAX.

    Args:
        environment: the environment given to `begin`.
        count: n, the number of copies.
        actions: (n, number of actions).

    Raises:
        ValueError: the actions are not real or have the wrong shape.
    """
    owner, shape = type(environment).__name__, (count, len(environment.actions))
    array = checks.numbers(owner, "actions", actions)
    if array.shape != shape:
        raise ValueError(
            f"{owner}: actions must have shape {shape}, got {array.shape}; the numbers of each are"
            f" {', '.join(environment.actions)}."
        )
    return array


def restart(
    environment: Environment, copies: Copies, chosen: Array, randomize: Randomize | None = None
) -> Copies:
    """Starts a new episode in the chosen copies.

    Shapes are static, so initial states are computed for a fixed number of copies. That number is
    zero if no copy is chosen. Otherwise, it is the smallest number given by `RESTART_SHARES` that
    is at least the number of chosen copies.

    Args:
        environment: the environment given to `begin`.
        copies: the current copies.
        chosen: a mask of the copies to restart, (n,).
        randomize: the function given to `begin`.
    """
    count = chosen.shape[0]
    sizes = sorted(
        {min(count, max(LEAST_RESTARTS, -(-count // share))) for share in RESTART_SHARES}
    )
    old = copies.episode, copies.world

    def restarted(size: int) -> tuple[Episode, Any]:
        # index[i] is the i-th copy to restart, from i = 0; n if fewer copies restart
        index = jnp.searchsorted(
            jnp.cumsum(chosen), jnp.arange(1, size + 1), method="scan_unrolled"
        )
        fresh = _start(environment, old[0].key.at[index].get(mode="clip"), randomize)
        return jax.tree.map(lambda x, y: x.at[index].set(y, mode="drop"), old, fresh)

    # a switch over a few static sizes: unlike a loop, both modes of differentiation support it
    branches = [lambda: old, *(functools.partial(restarted, size) for size in sizes)]
    branch = jnp.sum(jnp.sum(chosen) > jnp.asarray([0, *sizes[:-1]]))
    episode, world = jax.lax.switch(branch, branches)
    return Copies(episode, copies.done, world)


def _start(
    environment: Environment, keys: Array, randomize: Randomize | None
) -> tuple[Episode, Any]:
    """Returns a new episode for each key, with its environment, or () if all copies share one."""

    def start(key: Array) -> tuple[Episode, Any]:
        if randomize is None:
            return environment.reset(key), ()
        world_key, key = jax.random.split(key)
        world = randomize(environment, world_key)
        return world.reset(key), world

    return jax.vmap(start)(keys)


def simulate(environment: Environment, copies: Copies, actions: Array) -> Episode:
    """Returns the episodes of all copies after one action each.

    On a CPU, large batches run in chunks of at most `at_once` copies. Larger chunks exceed the
    cache in each operation of a step, which is then 1.3 to 7 times slower.

    Args:
        environment: the environment given to `begin`.
        copies: the copies before the actions.
        actions: (n, number of actions).
    """

    def transition(chunk: tuple[Copies, Array]) -> Episode:
        return over(environment, chunk[0], lambda world, *given: world.transition(*given), chunk[1])

    size = chunk_size(len(copies.done), environment.at_once)
    if size is None or jax.default_backend() != "cpu":
        return transition((copies, actions))
    chunks = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), (copies, actions))
    after = jax.lax.map(transition, chunks)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), after)


def chunk_size(count: int, most: int) -> int | None:
    """Returns the number of copies in a chunk: the largest divisor of `count` in (most/4, most].

    Returns None, for one batch of all copies, if `count` is at most `most` or has no such divisor.
    """
    if count <= most:
        return None
    # only divisors: a smaller last chunk would be compiled separately
    sizes = range(most, most // 4, -1)
    return next((size for size in sizes if count % size == 0), None)


def look(environment: Environment, copies: Copies) -> tuple[Array, dict[str, Array]]:
    """Returns the observations and the info of all copies."""
    return over(environment, copies, lambda world, episode: world.look(episode))


def over(
    environment: Environment,
    copies: Copies,
    function: Callable[..., T],
    *args: Array | Episode,
) -> T:
    """Calls a function for each copy, with the environment and the episode of the copy.

    Args:
        environment: the environment that copies share unless they are randomized.
        copies: the copies.
        function: (environment, episode, *args) → a pytree.
        args: further arguments, with a leading axis of length n.
    """

    def call(world: Environment | tuple[()], *given: Array | Episode) -> T:
        return function(environment if isinstance(world, tuple) else world, *given)

    return jax.vmap(call)(copies.world, copies.episode, *args)
