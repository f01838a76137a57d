"""What a policy earns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment, Episode


def returns(
    environment: Environment,
    policy: Callable[[Array], Array],
    key: Array,
    count: int,
    actions: int | None = None,
) -> Array:
    """Σ rewards of whole episodes under a policy: each ends where it terminates or is truncated.

    Args:
        environment: of all episodes.
        policy: from an observation to an action.
        key: each episode gets one of its own, which does not depend on how many there are.
        count: n episodes, side by side.
        actions: of an episode at most; the horizon unless given.

    Returns:
        The sums, (n,).

    Raises:
        ValueError: neither `actions` nor a horizon bounds an episode.
    """
    checks.count("returns", "count", count)
    if actions is not None:
        checks.count("returns", "actions", actions)
    most = environment.horizon if actions is None else actions
    if most is None:
        raise ValueError("returns: the environment has no horizon; say how many actions to take.")

    def act(now: tuple[Episode, Array], _: Any) -> tuple[tuple[Episode, Array], Array]:
        episode, going = now
        episode, outcome = environment.step(episode, policy(environment.observe(episode)))
        ended = outcome.terminated | outcome.truncated
        return (episode, going & ~ended), jnp.where(going, outcome.reward, 0)

    def earned(number: Array) -> Array:
        start = environment.reset(jax.random.fold_in(key, number)), jnp.ones((), bool)
        return jnp.sum(jax.lax.scan(act, start, None, most)[1])

    return jax.vmap(earned)(jnp.arange(count))
