"""Curricula: numbers as functions of training, and environments with these numbers.

Schedules are pure; what they return goes into leaves, so that no number makes a new trace. They
take arrays and may be traced.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.environments.environment import Environment
from jaxcon.stabilization.penalty import Penalty

OWNER = "vary and jitter"
"""The first words of their errors."""


def decay(t: Any, initial: Any, time: Any) -> Array:
    """σ(t) = σ₀ exp(−t/τ): noise that fades.

    Args:
        t: how far training has come, in any unit, (…).
        initial: σ₀.
        time: τ, in the unit of t.

    Raises:
        ValueError: a number is none, or τ is not positive.
    """
    for what, x in (("t", t), ("initial", initial)):
        checks.check("decay", what, x)
    checks.check("decay", "time", time, above=0)
    return initial * jnp.exp(-jnp.asarray(t) / time)


def warm_up(episode: Any, begin: Any, end: Any, least: Any = 0.1) -> Array:
    """The strength of a constraint by episode: `least` up to `begin`, a ramp, 1 from `end` on.

    Args:
        episode: how many have been, (…).
        begin: where the ramp begins.
        end: where it ends; beyond `begin`.
        least: the strength before.

    Raises:
        ValueError: a number is none, or `end` is not beyond `begin`.
    """
    for what, x in (("episode", episode), ("begin", begin), ("end", end), ("least", least)):
        checks.check("warm_up", what, x)
    if checks.is_concrete((begin, end)) and not np.all(np.less(begin, end)):
        raise ValueError(f"warm_up: end must lie beyond begin, got {end} and {begin}.")
    done = (jnp.asarray(episode, jnp.result_type(float)) - begin) / (end - begin)
    return least + (1 - least) * jnp.clip(done, 0, 1)


def by_performance(
    performance: Any, least: Any, most: Any, middle: Any = 0.0, width: Any = 1.0
) -> Array:
    """k = k_min + (k_max − k_min) sigmoid((p − p₀)/w): the better, the stiffer.

    Args:
        performance: p, such as the mean reward of the last episodes, (…).
        least: k_min.
        most: k_max.
        middle: p₀, where k is halfway.
        width: w > 0; from 0.27 to 0.73 of the way within one of it either side.

    Raises:
        ValueError: a number is none, or w is not positive.
    """
    given = {"performance": performance, "least": least, "most": most, "middle": middle}
    for what, x in given.items():
        checks.check("by_performance", what, x)
    checks.check("by_performance", "width", width, above=0)
    return least + (most - least) * jax.nn.sigmoid((jnp.asarray(performance) - middle) / width)


def with_stiffness(environment: Environment, stiffness: Any, damping: Any) -> Environment:
    """The environment with springs instead of its constraints; stiff ones hold nearly as well.

    Args:
        environment: whose method is taken but for its stabiliser.
        stiffness: of `Penalty`, by constraint or of all.
        damping: of `Penalty`.
    """
    dtype = environment.dtype
    k, d = jax.tree.map(lambda x: jnp.asarray(x, dtype), (stiffness, damping))
    method = dataclasses.replace(environment.method, stabilizer=Penalty(k, d))
    return dataclasses.replace(environment, method=method)


def vary(
    environment: Environment, key: Array, shares: Mapping[str, Mapping[str, float]]
) -> Environment:
    """The environment with some of its numbers times 1 + u, u uniform within ± a share.

    Args:
        environment: `environment.system.params` lists its numbers.
        key: of the draw.
        shares: {body or element: {field: share}}; each component of a field gets its own u.

    Raises:
        ValueError: an unknown name or field.
    """

    def scaled(key: Array, x: Array, share: float) -> Array:
        return x * (1 + jax.random.uniform(key, x.shape, x.dtype, -share, share))

    return _changed(environment, key, shares, scaled)


def jitter(
    environment: Environment, key: Array, sizes: Mapping[str, Mapping[str, Any]]
) -> Environment:
    """The environment with noise of N(0, σ²) added to some of its numbers: C + N(0, σ²).

    Noise on anchors, lengths or centres of mass moves what the constraints ask for by as much, and
    an episode begins as far off them: the default feedback takes that back within a step, at a
    speed of σ/h.

    Args:
        environment: `environment.system.params` lists its numbers.
        key: of the draw.
        sizes: {constraint: {field: σ}}, in the unit of the field; may be traced.

    Raises:
        ValueError: an unknown name or field.
    """

    def moved(key: Array, x: Array, size: Any) -> Array:
        return x + jnp.asarray(size, x.dtype) * jax.random.normal(key, x.shape, x.dtype)

    return _changed(environment, key, sizes, moved)


def _changed(environment: Environment, key: Array, which: Any, change: Any) -> Environment:
    """With change(key, number, how) in place of each number that is named."""
    _check_sizes(which)
    known = environment.system.params
    wanted = [(name, field) for name, fields in which.items() for field in fields]
    _check_names(wanted, known)
    changes: dict[str, dict[str, Array]] = {name: {} for name in which}
    for own, (name, field) in zip(jax.random.split(key, len(wanted)), wanted, strict=True):
        changes[name][field] = change(own, known[name][field], which[name][field])
    return dataclasses.replace(environment, system=environment.system.with_params(changes))


def _check_sizes(which: Any) -> None:
    """Checks that there is a number, zero or more, for each field by name.

    Raises:
        ValueError: there is not.
    """
    for name, fields in which.items() if isinstance(which, Mapping) else [("", which)]:
        if not isinstance(fields, Mapping):
            raise ValueError(
                f"{OWNER}: give numbers by name and field, {{'arm': {{'mass': 0.1}}}}, got"
                f" {checks.shortened(which)}."
            )
        for field, x in fields.items():
            checks.check(OWNER, f"{field} of '{name}'", x, least=0)


def _check_names(wanted: Sequence[tuple[str, str]], known: Mapping[str, Any]) -> None:
    """Checks that every number is one of the system's.

    Raises:
        ValueError: one is not.
    """
    for name, field in wanted:
        if not isinstance(known.get(name), Mapping):
            named = sorted(x for x, fields in known.items() if isinstance(fields, Mapping))
            raise ValueError(f"'{name}' has no numbers; those that have are {named}.")
        if field not in known[name]:
            raise ValueError(f"'{name}' has no {field!r}, it has {sorted(known[name])}.")
