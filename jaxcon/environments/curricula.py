"""Curricula: schedules over training, and environments with scheduled or randomized parameters.

Schedules are pure functions of arrays, traced or not. Their results become leaves of the
environment, so new values do not recompile.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, Scalar
from jaxcon.environments.environment import Environment, Number, check_environment
from jaxcon.methods.gains import keyed
from jaxcon.methods.penalty import Penalty

OWNER = "vary and jitter"
"""The prefix of error messages."""


def decay(t: Scalar, initial: Number, time: Number) -> Array:
    """Returns the size of noise that decays exponentially, σ(t) = σ₀ exp(−t/τ).

    Args:
        t: training progress in any unit, (…).
        initial: σ₀, the size of the noise at t = 0.
        time: τ, the decay time, in the unit of t.

    Raises:
        ValueError: an argument is not a number, or τ is not positive.
    """
    for what, x in (("t", t), ("initial", initial)):
        checks.check("decay", what, x)
    checks.check("decay", "time", time, above=0)
    return initial * jnp.exp(-jnp.asarray(t) / time)


def warm_up(episode: Scalar, begin: Number, end: Number, least: Number = 0.1) -> Array:
    """Returns the strength of a constraint: `least` in early episodes, then a ramp to 1.

    Args:
        episode: the number of finished episodes, (…).
        begin: the episode at which the ramp begins.
        end: the episode at which the ramp reaches 1; greater than `begin`.
        least: the strength before the ramp.

    Raises:
        ValueError: an argument is not a number, or `end` is not greater than `begin`.
    """
    for what, x in (("episode", episode), ("begin", begin), ("end", end), ("least", least)):
        checks.check("warm_up", what, x)
    if checks.is_concrete((begin, end)) and not np.all(np.less(begin, end)):
        raise ValueError(f"warm_up: end must lie beyond begin, got {end} and {begin}.")
    progress = (jnp.asarray(episode, jnp.result_type(float)) - begin) / (end - begin)
    return least + (1 - least) * jnp.clip(progress, 0, 1)


def by_performance(
    performance: Scalar,
    least: Number,
    most: Number,
    middle: Number = 0.0,
    width: Number = 1.0,
) -> Array:
    """Returns a stiffness k that grows with performance p.

    It is k = k_min + (k_max − k_min) sigmoid((p − p₀)/w).

    Args:
        performance: p, such as the mean reward of recent episodes, (…).
        least: k_min, the lowest stiffness.
        most: k_max, the highest stiffness.
        middle: p₀, the performance at which k is halfway.
        width: w > 0, the width of the transition; at p₀ ± w, the sigmoid is 0.27 and 0.73.

    Raises:
        ValueError: an argument is not a number, or w is not positive.
    """
    given = {"performance": performance, "least": least, "most": most, "middle": middle}
    for what, x in given.items():
        checks.check("by_performance", what, x)
    checks.check("by_performance", "width", width, above=0)
    return least + (most - least) * jax.nn.sigmoid((jnp.asarray(performance) - middle) / width)


def with_stiffness(
    environment: Environment,
    stiffness: Scalar | Mapping[str, Scalar],
    damping: Scalar | Mapping[str, Scalar],
) -> Environment:
    """Returns the environment with `Penalty` springs in place of its constraints.

    Args:
        environment: the environment; only the stabilizer of its method is replaced.
        stiffness: the stiffness of `jc.stabilizers.Penalty`: one value for all constraints, or
            values by constraint name.
        damping: the damping of `jc.stabilizers.Penalty`: one value for all constraints, or values
            by constraint name.

    Raises:
        ValueError: a value is negative or not a number, or a name is unknown.
    """
    check_environment("with_stiffness", environment)
    Penalty(stiffness, damping)  # checks the numbers before they are cast
    names = tuple(name for group in environment.system.constraints for name in group.names)
    for given in (stiffness, damping):
        if isinstance(given, Mapping):
            keyed(given, names, "with_stiffness")
    dtype = environment.dtype
    k, d = jax.tree.map(lambda x: jnp.asarray(x, dtype), (stiffness, damping))
    method = dataclasses.replace(environment.method, stabilizer=Penalty(k, d))
    return dataclasses.replace(environment, method=method)


def vary(
    environment: Environment, key: Array, shares: Mapping[str, Mapping[str, Number]]
) -> Environment:
    """Multiplies parameters by 1 + u, with u drawn uniformly between −share and share.

    Args:
        environment: the environment; `environment.system.params` lists its parameters.
        key: a JAX key.
        shares: {body or element: {field: share}}; each component of a field gets its own u.

    Raises:
        ValueError: a name or field is unknown.
    """

    def scaled(key: Array, x: Array, share: Number) -> Array:
        return x * (1 + jax.random.uniform(key, x.shape, x.dtype, -share, share))

    return _perturbed(environment, key, shares, scaled)


def jitter(
    environment: Environment, key: Array, sizes: Mapping[str, Mapping[str, Number]]
) -> Environment:
    """Adds normally distributed noise, N(0, σ²), to parameters.

    Noise on anchors, lengths or centers of mass shifts the constraints. An episode then starts with
    a violation of about σ. The default feedback removes it within one step of size h, with a
    velocity of about σ/h.

    Args:
        environment: the environment; `environment.system.params` lists its parameters.
        key: a JAX key.
        sizes: {constraint: {field: σ}}, in the unit of the field; σ may be traced.

    Raises:
        ValueError: a name or field is unknown.
    """

    def moved(key: Array, x: Array, size: Number) -> Array:
        return x + jnp.asarray(size, x.dtype) * jax.random.normal(key, x.shape, x.dtype)

    return _perturbed(environment, key, sizes, moved)


def _perturbed(
    environment: Environment,
    key: Array,
    sizes: Mapping[str, Mapping[str, Number]],
    change: Callable[[Array, Array, Number], Array],
) -> Environment:
    """Returns the environment with each named parameter replaced by change(key, parameter, size).

    Raises:
        ValueError: a size is negative or not a number, or a name or field is unknown.
        TypeError: the environment or the key has the wrong type.
    """
    check_environment(OWNER, environment)
    checks.random_key(OWNER, "key", key)
    for name, fields in sizes.items() if isinstance(sizes, Mapping) else [("", sizes)]:
        if not isinstance(fields, Mapping):
            raise ValueError(
                f"{OWNER}: give numbers by name and field, {{'arm': {{'mass': 0.1}}}}, got"
                f" {checks.shortened(sizes)}."
            )
        for field, x in fields.items():
            checks.check(OWNER, f"{field} of '{name}'", x, least=0)
    params = environment.system.params
    chosen = [(name, field) for name, fields in sizes.items() for field in fields]
    for name, field in chosen:
        if not isinstance(params.get(name), Mapping):
            names = sorted(x for x, fields in params.items() if isinstance(fields, Mapping))
            raise ValueError(f"'{name}' has no numbers; those that have are {names}.")
        if field not in params[name]:
            raise ValueError(f"'{name}' has no {field!r}, it has {sorted(params[name])}.")
    changes: dict[str, dict[str, Array]] = {name: {} for name in sizes}
    for field_key, (name, field) in zip(jax.random.split(key, len(chosen)), chosen, strict=True):
        changes[name][field] = change(field_key, params[name][field], sizes[name][field])
    return dataclasses.replace(environment, system=environment.system.with_params(changes))
