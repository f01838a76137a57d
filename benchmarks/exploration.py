"""What feasible exploration and layered control do to learning by trial, by experiment.

    python -m benchmarks.exploration [--seeds 0 1 2 3 4] [--updates 100]

`CartPole` by PPO as in `examples/learn_ppo.py`, on a short track: an episode is over where the cart
is 1 m from the middle. "free": as it is. "feasible": what the policy wants, noise and all, goes
through `feasible_action` with the limits ±(x + T v) ≤ X: the cart always could stop. "layered": the
policy sets the speed of the cart, for five actions each, and a controller follows it.
A crash is an episode that ends at the end of the track. Returns are means of 64 episodes without
noise, of 500 at most; of layers, whose episodes have a fifth of the actions, five times that.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import timing
from jaxcon import environments
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.environments import Episode
from jaxcon.environments.tasks.cart_pole import CartPole

sys.path.insert(0, str(timing.ROOT / "examples"))

import learn_ppo  # noqa: E402
from learning import mean_return  # noqa: E402

END, KEPT, AHEAD = 1.0, 0.9, 0.3
"""Of the track [m], X of the limits [m], and T [s]."""
HOLD, FASTEST, GAIN = 5, 3.0, 4.0
"""Actions of the controller for a speed, the most of these [m/s], and its gain [s/m]."""


@pytree
class Short(CartPole):
    """On a short track."""

    def terminal(self, episode: Episode) -> Array:
        """Whether the cart has come to the end of the track."""
        return jnp.abs(self.cart(episode)[0]) > END


@pytree
class Feasible(Short):
    """Whose actions are as near to what is wanted as the cart can stop after."""

    def transition(self, episode: Episode, action: Any) -> Episode:
        """The episode after the action that limits leave of one."""
        kept = environments.feasible_action(self, episode, action, self.limits)
        return super().transition(episode, kept)

    def limits(self, episode: Episode) -> Array:
        """±(x + T v) − X, (2,) [m]."""
        x, v = self.cart(episode)
        return jnp.stack([x + AHEAD * v, -x - AHEAD * v]) - KEPT


def follow(environment: Any, episode: Episode, target: Array) -> Array:
    """A push towards the wanted speed."""
    speed = jc.velocity(environment.system, episode.state, "cart")[0]
    return GAIN * (FASTEST * target - speed[None])


def arms() -> dict[str, Any]:
    """The environments."""
    cart = environments.make("CartPole")
    values = {field.name: getattr(cart, field.name) for field in dataclasses.fields(cart)}
    targets = (f"speed, of {FASTEST} m/s",)
    layered = environments.Layered.build(Short(**values), follow, targets, HOLD)
    return {"free": Short(**values), "feasible": Feasible(**values), "layered": layered}


@functools.partial(jax.jit, static_argnums=1)
def update(environment: Any, setting: Any, learner: Any) -> tuple[Any, jax.Array]:
    """One update; and of the episodes that end in it, how many crash and how many there are."""
    learner, samples = learn_ppo.collect(environment, setting, learner, None)
    learner = learn_ppo.learn(setting, learner, samples)
    return learner, jnp.stack([samples.terminated.sum(), samples.ended.sum()])


begin = jax.jit(learn_ppo.begin, static_argnums=1)
earned = jax.jit(functools.partial(mean_return, learn_ppo.policy))


def train(environment: Any, setting: Any, seed: int) -> tuple[float, float, float]:
    """The return after a third of the updates and after all, and crashes an episode on the way."""
    learner, ends, found = begin(environment, setting, jax.random.key(seed)), 0, []
    for i in range(1, setting.updates + 1):
        learner, own = update(environment, setting, learner)
        ends = ends + np.asarray(own)
        if i in (setting.updates // 3, setting.updates):
            found.append(float(earned(environment, learner, jax.random.key(seed + 1))))
    return *found, float(ends[0] / ends[1])


ARMS = ("free", "feasible", "layered")


def measure(name: str, seeds: list[int], updates: int) -> np.ndarray:
    """What `train` finds of an arm, a row for each seed; returns are of the bare actions."""
    setting = learn_ppo.SETTINGS["CartPole"]._replace(updates=updates)
    rows = np.array([train(arms()[name], setting, seed) for seed in seeds])
    return rows * np.array([HOLD, HOLD, 1.0]) if name == "layered" else rows


def main() -> None:
    """Prints a row for each way to train: mean and extremes of the seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--arms", nargs="*", choices=ARMS, default=ARMS)
    given = parser.parse_args()
    print(timing.machine())
    print("| actions | return, a third of the way | return | crashes, of episodes |")
    print("|---|---|---|---|", flush=True)
    for name in given.arms:
        trials = measure(name, given.seeds, given.updates)
        cells = [f"{x.mean():.3g} ({x.min():.3g} to {x.max():.3g})" for x in trials.T]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
