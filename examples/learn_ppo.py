"""A policy learns by trial: proximal policy optimization, all of it on the device.

    python examples/learn_ppo.py [--task CartPole] [--seed 0] [--seconds 900]

Many copies act at once. Gaussian noise tries what is near the policy's action; what led to more
than the value function expected becomes likelier, within a trust region. Five of five seeds reach
a mean return of 440 of 500 on CartPole, by 0.4 M actions, and of 320 of 400 on Parking, by 0.8 M:
in a minute or two on two cores, most of it compiling (`python -m benchmarks.training`).

References:
    Schulman et al., Proximal policy optimization algorithms (2017), arXiv:1707.06347.
    Schulman et al., High-dimensional continuous control using generalized advantage estimation
    (2016), arXiv:1506.02438.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from learning import Algorithm, Seen, layers, main, perceptron, staggered, unseen

from jaxcon import environments


class Setting(NamedTuple):
    """How a task is learnt.

    Attributes:
        goal: a return that five of five seeds reach.
        updates: rounds of collecting and improving.
        discount: γ, what a reward is worth an action later.
        copies: that act side by side.
        window: actions of each for an update.
        epochs: how often an update goes through what was collected.
        batches: parts in which it does so.
        rate: of Adam at the beginning; it falls to 0.
    """

    goal: float
    updates: int
    discount: float = 0.99
    copies: int = 256
    window: int = 32
    epochs: int = 4
    batches: int = 8
    rate: float = 1e-3


SETTINGS = {"CartPole": Setting(440.0, 100), "Parking": Setting(320.0, 150)}
TRACE, CLIP = 0.95, 0.2
"""λ of the advantages, and the width of the trust region."""


class Learner(NamedTuple):
    """Weights, the state of Adam, what was seen, and where the copies stand."""

    params: dict
    adam: Any
    seen: Seen
    copies: environments.Copies
    x: jax.Array
    key: jax.Array


class Sample(NamedTuple):
    """What copies saw, did, how likely that was, what it earned, and what they saw after it."""

    x: jax.Array
    action: jax.Array
    likely: jax.Array
    reward: jax.Array
    after: jax.Array
    terminated: jax.Array
    ended: jax.Array


def policy(learner: Learner, x: jax.Array) -> jax.Array:
    """The action for an observation, without noise."""
    return perceptron(learner.params["policy"], learner.seen.normalize(x))


def value(params: dict, x: jax.Array) -> jax.Array:
    """(1 − γ) Σ γᵏ r expected from a normalized observation on."""
    return perceptron(params["value"], x)[0]


def likelihood(params: dict, x: jax.Array, action: jax.Array) -> jax.Array:
    """Logarithm of an action's density, but for a constant, at a normalized observation."""
    off = (action - perceptron(params["policy"], x)) / jnp.exp(params["noise"])
    return -jnp.sum(off**2 / 2 + params["noise"])


def optimizer(setting: Setting) -> optax.GradientTransformation:
    """Adam on bounded gradients, at a rate that falls to zero."""
    steps = setting.updates * setting.epochs * setting.batches
    rate = optax.linear_schedule(setting.rate, 0.0, steps)
    return optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))


def begin(environment: Any, setting: Setting, key: jax.Array, randomize: Any = None) -> Learner:
    """A policy of noise alone; `randomize` draws worlds, as of `environments.begin`."""
    first, second, start, key = jax.random.split(key, 4)
    copies, x = staggered(environment, start, setting.copies, randomize)
    saw, acts, dtype = x.shape[1], len(environment.actions), x.dtype
    params = {
        "policy": layers(first, (saw, 64, 64, acts), 0.01, dtype),
        "value": layers(second, (saw, 64, 64, 1), 0.01, dtype),
        "noise": jnp.full(acts, -0.5, dtype),
    }
    adam = optimizer(setting).init(params)
    return Learner(params, adam, unseen(saw, dtype), copies, x, key)


def collect(environment: Any, setting: Setting, learner: Learner, draw: Any) -> tuple:
    """The learner after a window of actions of every copy, and the samples, (window, copies, …)."""
    act_on = jax.vmap(functools.partial(policy, learner))
    size = learner.params["noise"][None]

    def act(now: tuple, key: jax.Array) -> tuple:
        copies, x = now
        mean = act_on(x)
        noise = jax.random.normal(key, mean.shape, mean.dtype)
        action, likely = mean + jnp.exp(size) * noise, -jnp.sum(noise**2 / 2 + size, axis=1)
        copies, outcome = environments.advance(environment, copies, action, "SameStep", draw)
        ends = outcome.terminated, outcome.terminated | outcome.truncated
        after = outcome.info["final_obs"]
        return (copies, outcome.observation), Sample(
            x, action, likely, outcome.reward, after, *ends
        )

    key, own = jax.random.split(learner.key)
    start, keys = (learner.copies, learner.x), jax.random.split(own, setting.window)
    (copies, x), samples = jax.lax.scan(act, start, keys)
    return learner._replace(copies=copies, x=x, key=key), samples


def advantages(setting: Setting, now: jax.Array, after: jax.Array, samples: Sample) -> jax.Array:
    """Σ (γλ)ᵏ δ with δ = (1 − γ) r + γ V(after) − V(now), until an episode ends."""
    γ = setting.discount
    δ = (1 - γ) * samples.reward + γ * jnp.where(samples.terminated, 0, after) - now

    def back(later: jax.Array, at: tuple) -> tuple:
        total = at[0] + γ * TRACE * jnp.where(at[1], 0, later)
        return total, total

    return jax.lax.scan(back, jnp.zeros_like(δ[0]), (δ, samples.ended), reverse=True)[1]


def loss(params: dict, x: jax.Array, sample: Sample, gain: jax.Array, aim: jax.Array) -> jax.Array:
    """Less advantage times likelihood, clipped, and the squared error of the value."""
    likely = jax.vmap(functools.partial(likelihood, params))(x, sample.action)
    ratio = jnp.exp(likely - sample.likely)
    gain = (gain - jnp.mean(gain)) / (jnp.std(gain) + 1e-6)
    better = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
    miss = jax.vmap(functools.partial(value, params))(x) - aim
    return jnp.mean(miss**2 - better)


def improve(setting: Setting, learner: Learner, data: tuple) -> Learner:
    """Steps of Adam on batches of the data, whose arrays are (samples, …)."""

    def step(now: tuple, chosen: jax.Array) -> tuple:
        params, adam = now
        batch = jax.tree.map(lambda a: a[chosen], data)
        change, adam = optimizer(setting).update(jax.grad(loss)(params, *batch), adam)
        return (optax.apply_updates(params, change), adam), None

    key, own = jax.random.split(learner.key)
    count = setting.copies * setting.window
    shuffle = jax.vmap(lambda k: jax.random.permutation(k, count))
    order = shuffle(jax.random.split(own, setting.epochs))
    order = order.reshape(setting.epochs * setting.batches, -1)
    (params, adam), _ = jax.lax.scan(step, (learner.params, learner.adam), order)
    return learner._replace(params=params, adam=adam, key=key)


def learn(setting: Setting, learner: Learner, samples: Sample) -> Learner:
    """The learner improved by a window of all copies."""
    seen = learner.seen
    x, after = (jax.vmap(jax.vmap(seen.normalize))(z) for z in (samples.x, samples.after))
    expected = jax.vmap(jax.vmap(functools.partial(value, learner.params)))
    now = expected(x)
    gain = advantages(setting, now, expected(after), samples)
    data = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (x, samples, gain, now + gain))
    learner = improve(setting, learner, data)
    return learner._replace(seen=seen.also(samples.x))


def update(environment: Any, setting: Setting, learner: Learner, randomize: Any = None) -> tuple:
    """Collects a window of all copies and improves by it; also the mean reward."""
    learner, samples = collect(environment, setting, learner, randomize)
    return learn(setting, learner, samples), jnp.mean(samples.reward)


PPO = Algorithm("ppo", SETTINGS, begin, update, policy)

if __name__ == "__main__":
    main(PPO)
