"""Many copies of an environment in one program, each reset with a fresh key when it is done."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.environments.environment import Environment, Episode, Outcome

Randomize = Callable[[Environment, Array], Environment]
"""(environment, key) → the same with other numbers: the world of one copy, for one episode."""

MODES = ("NextStep", "SameStep", "Disabled")
"""When a copy that is done is reset, by the names that Gymnasium gives them."""

PARTS, LEAST_PART = (16, 4, 1), 64
"""By which parts of all copies they are started, and how many at least."""


@pytree
class Copies:
    """Where all copies stand; every array has a first axis of their number n.

    Attributes:
        episode: of each.
        done: which are done, (n,).
        world: the environment of each where these differ; () where all share one.
    """

    episode: Episode
    done: Array
    world: PyTree = ()


def begin(
    environment: Environment, key: Array, count: int, randomize: Randomize | None = None
) -> tuple[Copies, Array]:
    """All copies at the start of an episode, and what they see.

    Args:
        environment: of all of them.
        key: each copy gets one of its own, which does not depend on how many there are.
        count: n.
        randomize: draws the world of each copy, afresh for each episode.

    Returns:
        The copies and their observations (n, …).
    """
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
    """One action of every copy; pure, and good to scan.

    Args:
        environment: of all of them.
        copies: where they stand.
        actions: (n, number of actions).
        mode: "NextStep": a copy that was done is reset instead of acting, with reward 0;
            "SameStep": it is reset after the action that ends it, whose observation and info are
            `final_obs` and `final_info` of the info; "Disabled": it goes on.
        randomize: as of `begin`.

    Returns:
        The copies, and the outcome of each, (n, …).

    Raises:
        ValueError: an unknown mode.
    """
    if mode not in MODES:
        raise ValueError(f"advance: mode must be one of {', '.join(MODES)}, got {mode!r}.")
    after = simulate(environment, copies, actions)
    reward, terminated, truncated = over(environment, copies, "judge", actions, after)
    stepped = dataclasses.replace(copies, episode=after, done=terminated | truncated)
    if mode == "NextStep":
        waiting = copies.done
        reward = jnp.where(waiting, 0, reward)
        terminated, truncated = terminated & ~waiting, truncated & ~waiting
        stepped = dataclasses.replace(stepped, done=terminated | truncated)
        stepped = restart(environment, stepped, waiting, randomize)
    final: dict[str, Any] = {}
    if mode == "SameStep":
        seen, info = look(environment, stepped)
        final = {"final_obs": seen, "_final_obs": stepped.done}
        final |= {"final_info": info, "_final_info": stepped.done}
        stepped = restart(environment, stepped, stepped.done, randomize)
    seen, info = look(environment, stepped)
    return stepped, Outcome(seen, reward, terminated, truncated, info | final)


def restart(
    environment: Environment, copies: Copies, chosen: Array, randomize: Randomize | None = None
) -> Copies:
    """The copies with those that are chosen, (n,), at the start of a new episode.

    Few starts are computed where few are chosen: none, or as many as the smallest of `PARTS` of
    all copies that holds them. There is no loop, so that both modes of differentiation go through.

    Args:
        environment: of all of them.
        copies: where they stand.
        chosen: which, (n,) of bools.
        randomize: as of `begin`.
    """
    count = chosen.shape[0]
    sizes = sorted({min(count, max(LEAST_PART, -(-count // part))) for part in PARTS})
    old = copies.episode, copies.world

    def started(size: int) -> tuple[Episode, PyTree]:
        so_far, which = jnp.cumsum(chosen), jnp.arange(1, size + 1)
        index = jnp.searchsorted(so_far, which, method="scan_unrolled")  # n beyond the last
        fresh = _start(environment, old[0].key.at[index].get(mode="clip"), randomize)
        return jax.tree.map(lambda x, y: x.at[index].set(y, mode="drop"), old, fresh)

    cases = [lambda: old, *(functools.partial(started, size) for size in sizes)]
    case = jnp.sum(jnp.sum(chosen) > jnp.asarray([0, *sizes[:-1]]))
    episode, world = jax.lax.switch(case, cases)
    return Copies(episode, copies.done, world)


def _start(
    environment: Environment, keys: Array, randomize: Randomize | None
) -> tuple[Episode, PyTree]:
    """An episode for each key, and its world where worlds differ."""

    def one(key: Array) -> tuple[Episode, PyTree]:
        if randomize is None:
            return environment.reset(key), ()
        own, key = jax.random.split(key)
        world = randomize(environment, own)
        return world.reset(key), world

    return jax.vmap(one)(keys)


def simulate(environment: Environment, copies: Copies, actions: Array) -> Episode:
    """The episodes of all copies after an action.

    On a CPU one lot of copies follows the other: many leave its cache in each of the operations
    that a step consists of, and are then 1.3 to 7 times slower.

    Args:
        environment: of all of them.
        copies: where they stand.
        actions: (n, number of actions).
    """
    size = size_of_lot(len(copies.done), environment.at_once)
    if size is None or jax.default_backend() != "cpu":
        return over(environment, copies, "transition", actions)

    def apart(x: Array) -> Array:
        return x.reshape(-1, size, *x.shape[1:])

    lots = jax.tree.map(apart, (copies, actions))
    after = jax.lax.map(lambda own: over(environment, own[0], "transition", own[1]), lots)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), after)


def size_of_lot(count: int, most: int) -> int | None:
    """How many of so many copies are simulated at once; None for all.

    The most that divide them, since a last lot of its own would be compiled for itself.
    """
    if count <= most:
        return None
    sizes = range(most, most // 4, -1)
    return next((size for size in sizes if count % size == 0), None)


def look(environment: Environment, copies: Copies) -> tuple[Array, dict[str, Array]]:
    """What all copies see, and their info."""
    return over(environment, copies, "look")


def over(environment: Environment, copies: Copies, verb: str, *args: Any) -> Any:
    """A method of the environment for all copies, each in its world.

    Args:
        environment: of all of them.
        copies: whose episodes come first among the arguments.
        verb: the name of the method.
        args: what else it takes, with a first axis of n.
    """

    def one(world: PyTree, *own: Any) -> Any:
        return getattr(environment if isinstance(world, tuple) else world, verb)(*own)

    return jax.vmap(one)(copies.world, copies.episode, *args)
