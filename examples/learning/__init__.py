"""What the examples of learning share: a perceptron, a scale of observations, the loop, a picture.

An algorithm is three functions and a setting for each task, `Algorithm`.
"""

import argparse
import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon import environments

CALM = 5.0
"""Bound of a normalized observation."""
EPISODES = 64
"""Whose mean return is reported."""
LOOKS = 20
"""How often it is, on the way."""


@dataclasses.dataclass(frozen=True, eq=False)
class Algorithm:
    """How policies are learnt.

    Attributes:
        name: for pictures.
        settings: by task; each has a `goal`, a return that five of five seeds reach, `updates`, the
            number of `copies`, and the `window` of actions that each takes for an update.
        begin: (environment, setting, key) → a learner, anything that can be a carry.
        update: (environment, setting, learner) → the learner, and the mean reward on the way.
        policy: (learner, observation) → the action without noise.
    """

    name: str
    settings: dict[str, Any]
    begin: Callable[..., Any]
    update: Callable[..., Any]
    policy: Callable[..., Any]


class Look(NamedTuple):
    """Where training stands after so many updates, actions of all copies and seconds."""

    updates: int
    actions: int
    seconds: float
    earned: float


class Seen(NamedTuple):
    """Σ (1, x, x²) of all that was seen."""

    count: jax.Array
    total: jax.Array
    squares: jax.Array

    def also(self, x: jax.Array) -> "Seen":
        """With observations (…, k)."""
        rows = x.reshape(-1, x.shape[-1])
        count = jnp.asarray(len(rows), x.dtype)
        return Seen(self.count + count, self.total + rows.sum(0), self.squares + (rows**2).sum(0))

    def normalize(self, x: jax.Array) -> jax.Array:
        """An observation (k,) by the mean and the spread."""
        mean = self.total / self.count
        spread = jnp.sqrt(jnp.maximum(self.squares / self.count - mean**2, 1e-6))
        return jnp.clip((x - mean) / spread, -CALM, CALM)


def unseen(size: int, dtype: Any) -> Seen:
    """As if one observation had mean 0 and spread 1."""
    return Seen(jnp.ones((), dtype), jnp.zeros(size, dtype), jnp.ones(size, dtype))


def layers(key: jax.Array, sizes: tuple[int, ...], last: float, dtype: Any) -> list:
    """Random weights of a perceptron, those of the last layer times a factor."""
    pairs = list(zip(sizes[:-1], sizes[1:], strict=True))
    scales = [1.0] * (len(pairs) - 1) + [last]
    keys = jax.random.split(key, len(pairs))
    return [
        (jax.random.normal(k, pair, dtype) * (s / math.sqrt(pair[0])), jnp.zeros(pair[1], dtype))
        for k, pair, s in zip(keys, pairs, scales, strict=True)
    ]


def perceptron(weights: list, x: jax.Array) -> jax.Array:
    """Of one vector (k,): hidden layers of tanh, a linear last one."""
    for matrix, offset in weights[:-1]:
        x = jnp.tanh(x @ matrix + offset)
    return x @ weights[-1][0] + weights[-1][1]


def staggered(environment: Any, key: jax.Array, count: int, randomize: Any = None) -> tuple:
    """Copies and what they see; their first episodes end at different times, as all later do."""
    own, ages = jax.random.split(key)
    copies, x = environments.begin(environment, own, count, randomize)
    steps = jax.random.randint(ages, (count,), 0, environment.horizon or 1, jnp.int32)
    episode = dataclasses.replace(copies.episode, steps=steps)
    return dataclasses.replace(copies, episode=episode), x


def learning(
    algorithm: Algorithm, environment: Any, setting: Any, seed: int, looks: int = LOOKS
) -> Iterator[tuple[Any, Look]]:
    """Trains, and now and then gives the learner and where it stands, at last after all updates."""
    update = jax.jit(algorithm.update, static_argnums=1)
    start, key = time.perf_counter(), jax.random.key(seed)
    learner = jax.jit(algorithm.begin, static_argnums=1)(environment, setting, key)
    earned = jax.jit(mean_return, static_argnums=0)
    for i in range(setting.updates + 1):
        if i % max(setting.updates // looks, 1) == 0 or i == setting.updates:
            found = float(earned(algorithm.policy, environment, learner, jax.random.key(seed + 1)))
            actions = i * setting.copies * setting.window
            yield learner, Look(i, actions, time.perf_counter() - start, found)
        learner, _ = update(environment, setting, learner)


def mean_return(policy: Callable, environment: Any, learner: Any, key: jax.Array) -> jax.Array:
    """Of whole episodes without noise."""

    def act(x: jax.Array) -> jax.Array:
        return policy(learner, x)

    return jnp.mean(environments.returns(environment, act, key, EPISODES))


def draw(title: str, curves: dict[str, list[Look]], goal: float, picture: str) -> None:
    """Returns over actions, and the goal."""
    from jaxcon import view

    figure, axes = view.pyplot().subplots(layout="constrained")
    for name, curve in curves.items():
        axes.plot([x.actions for x in curve], [x.earned for x in curve], ".-", label=name)
    axes.axhline(goal, color="gray", ls="--", label="what five of five seeds reach")
    axes.set(title=title, xlabel="actions", ylabel="mean return")
    axes.legend(fontsize=8)
    figure.savefig(picture)
    view.pyplot().close(figure)
    print(f"wrote {picture}")


def main(algorithm: Algorithm) -> None:
    """A command line: trains one task and draws its learning curve."""
    tasks = list(algorithm.settings)
    parser = argparse.ArgumentParser(description=f"Learns a task by {algorithm.name}.")
    parser.add_argument("--task", choices=tasks, default=tasks[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=900.0, help="ends training early")
    parser.add_argument("--updates", type=int, help="of the policy, instead of those of the task")
    given = parser.parse_args()
    setting = algorithm.settings[given.task]
    setting = setting._replace(updates=given.updates or setting.updates)
    curve: list[Look] = []
    for _, look in learning(algorithm, environments.make(given.task), setting, given.seed):
        print(
            f"{look.updates} updates, {look.actions:.2e} actions, {look.seconds:.0f} s:"
            f" return {look.earned:.1f}",
            flush=True,
        )
        curve.append(look)
        if look.seconds > given.seconds:
            break
    title = f"{given.task} by {algorithm.name}"
    draw(title, {f"seed {given.seed}": curve}, setting.goal, f"learn_{algorithm.name}.png")
