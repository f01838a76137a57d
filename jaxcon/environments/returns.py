"""Returns of a policy: sums of rewards over whole episodes."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxcon.core import checks, functions
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment, Episode, check_environment


def returns(
    environment: Environment,
    policy: Callable[[Array], Array],
    key: Array,
    count: int,
    actions: int | None = None,
) -> Array:
    """Returns the sum of rewards of whole episodes under a policy.

    An episode ends when it terminates or is truncated.

    Args:
        environment: the environment.
        policy: a function from an observation to an action.
        key: a JAX key. The key of each episode is derived from it and does not depend on n.
        count: n, the number of episodes, which run as a batch.
        actions: the largest number of actions in an episode; None for the horizon.

    Returns:
        The sums of rewards, (n,).

    Raises:
        ValueError: neither `actions` nor a horizon bounds an episode.
        TypeError: an argument has the wrong type, or the policy does not return an array of numbers
            or needs the value of a traced number.
    """
    check_environment("returns", environment)
    checks.takes("returns", "policy", policy, ("observation",))
    checks.random_key("returns", "key", key)
    checks.count("returns", "count", count)
    if actions is not None:
        checks.count("returns", "actions", actions)
    limit = environment.horizon if actions is None else actions
    if limit is None:
        raise ValueError("returns: the environment has no horizon; say how many actions to take.")

    def act(carry: tuple[Episode, Array], _: None) -> tuple[tuple[Episode, Array], Array]:
        episode, running = carry
        action = functions.call("returns", "policy", policy, environment.observe(episode))
        action = functions.array("returns", "policy", action)
        episode, outcome = environment.step(episode, action)
        ended = outcome.terminated | outcome.truncated
        return (episode, running & ~ended), jnp.where(running, outcome.reward, 0)

    def episode_return(number: Array) -> Array:
        start = environment.reset(jax.random.fold_in(key, number)), jnp.ones((), bool)
        return jnp.sum(jax.lax.scan(act, start, None, limit)[1])

    return jax.vmap(episode_return)(jnp.arange(count))
