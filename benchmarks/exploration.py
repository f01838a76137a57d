"""Effect of feasible exploration and layered control on reinforcement learning.

    python -m benchmarks.exploration [--seeds 0 1 2 3 4] [--updates 100]

`CartPole` is trained by PPO as in `examples/learn_ppo.py`, on a short track. An episode ends when
the cart is 1 m from the middle. There are three variants:

- "free": the plain environment.
- "feasible": actions, including their noise, pass through `feasible_action`. Its limits
  ±(x + T v) ≤ X, with position x and velocity v of the cart, let the cart always stop.
- "layered": the policy sets a target speed for five actions, and a controller tracks it.

A crash is an episode in which the cart reaches the end of the track. Returns are means of 64
episodes without noise; the largest possible return is 500. An episode of "layered" has a fifth of
the actions; its return is multiplied by five.
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
"""End of the track [m], bound X of the limits [m], and their look-ahead time T [s]."""
HOLD, FASTEST, GAIN = 5, 3.0, 4.0
"""Actions per target speed, the largest target speed [m/s] and the controller gain [s/m]."""


@pytree
class Short(CartPole):
    """CartPole on a short track."""

    def terminal(self, episode: Episode) -> Array:
        """Returns True if the cart is at the end of the track."""
        return jnp.abs(self.cart(episode)[0]) > END


@pytree
class Feasible(Short):
    """CartPole on a short track. Actions are projected so that the cart can stop."""

    def transition(self, episode: Episode, action: Any) -> Episode:
        """Returns the episode after the feasible action nearest to `action`."""
        feasible = environments.feasible_action(self, episode, action, self.limits)
        return super().transition(episode, feasible)

    def limits(self, episode: Episode) -> Array:
        """Returns the limits ±(x + T v) − X, which are negative where feasible, (2,) [m].

        x and v are position and velocity of the cart, T is `AHEAD` and X is `KEPT`.
        """
        x, v = self.cart(episode)
        return jnp.stack([x + AHEAD * v, -x - AHEAD * v]) - KEPT


def follow(environment: Any, episode: Episode, target: Array) -> Array:
    """Returns the action of a proportional controller towards a target speed."""
    speed = jc.velocity(environment.system, episode.state, "cart")[0]
    return GAIN * (FASTEST * target - speed[None])


def arms() -> dict[str, Any]:
    """Returns the environments of the three variants, by name."""
    cart = environments.make("CartPole")
    values = {field.name: getattr(cart, field.name) for field in dataclasses.fields(cart)}
    targets = (f"speed, of {FASTEST} m/s",)
    layered = environments.Layered.build(Short(**values), follow, targets, HOLD)
    return {"free": Short(**values), "feasible": Feasible(**values), "layered": layered}


@functools.partial(jax.jit, static_argnums=1)
def update(environment: Any, setting: Any, learner: Any) -> tuple[Any, jax.Array]:
    """Runs one update of the learner.

    Returns:
        The learner, and the numbers of crashes and of ended episodes in this update, (2,).
    """
    learner, samples = learn_ppo.collect(environment, setting, learner, None)
    learner = learn_ppo.learn(setting, learner, samples)
    return learner, jnp.stack([samples.terminated.sum(), samples.ended.sum()])


begin = jax.jit(learn_ppo.begin, static_argnums=1)
earned = jax.jit(functools.partial(mean_return, learn_ppo.policy))


def train(environment: Any, setting: Any, seed: int) -> tuple[float, float, float]:
    """Trains with one seed.

    Returns:
        The returns after a third of the updates and after all updates, and crashes per episode in
        training.
    """
    learner, ends, returns = begin(environment, setting, jax.random.key(seed)), 0, []
    for i in range(1, setting.updates + 1):
        learner, counts = update(environment, setting, learner)
        ends = ends + np.asarray(counts)
        if i in (setting.updates // 3, setting.updates):
            returns.append(float(earned(environment, learner, jax.random.key(seed + 1))))
    return *returns, float(ends[0] / ends[1])


ARMS = ("free", "feasible", "layered")


def measure(name: str, seeds: list[int], updates: int) -> np.ndarray:
    """Returns the results of `train` with a row per seed, (seeds, 3).

    Returns of "layered" are scaled to the number of the cart's actions.
    """
    setting = learn_ppo.SETTINGS["CartPole"]._replace(updates=updates)
    rows = np.array([train(arms()[name], setting, seed) for seed in seeds])
    return rows * np.array([HOLD, HOLD, 1.0]) if name == "layered" else rows


def main() -> None:
    """Prints a row of results per variant: mean and range over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--arms", nargs="*", choices=ARMS, default=ARMS)
    options = parser.parse_args()
    print(timing.machine())
    print("| actions | return after a third of training | return | crashes per episode |")
    print("|---|---|---|---|", flush=True)
    for name in options.arms:
        trials = measure(name, options.seeds, options.updates)
        cells = [f"{x.mean():.3g} ({x.min():.3g} to {x.max():.3g})" for x in trials.T]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
