"""Tests the claims of chapters 3.6.2 and 3.6.3 on soft, noisy and relaxed constraints.

    python -m benchmarks.curricula [--algorithms ppo apg] [--seeds 0 1 2 3 4] [--updates 150]
        [--json curricula.json] [--picture curricula.png]

The crank of a four-bar linkage tracks its reference (`FourBarTracking`). Policies are trained on
four kinds of hinges:

- springs of stiffness k with damping 2√(k m), m = 0.3 kg,
- springs whose k rises during training,
- hard hinges whose anchors have noise of standard deviation σ, drawn per copy and episode,
- hard hinges.

Every policy is evaluated on the same 128 episodes without action noise, on three kinds of hinges:
those at the end of its training, hard hinges, and hard hinges with anchor noise of σ = 10 mm. It is
also evaluated on hard hinges after a third of training. The return is a share of the largest
possible return. The violation is the mean over all actions of the largest |φ|.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import timing
from jaxcon import environments

sys.path.insert(0, str(timing.ROOT / "examples"))

import learn_apg  # noqa: E402
import learn_ppo  # noqa: E402

TASK, MASS = "FourBarTracking", 0.3
ANCHORS = ("crank_coupler", "coupler_rocker")
"""Hinges with noisy anchors. The noise amounts to noise on the lengths of all moving bars."""
OFF = 0.01
"""σ of the anchors in the evaluation with noise [m]."""
EPISODES = 128
ALGORITHMS = {
    "apg": (learn_apg.APG, learn_apg.Setting(1.0, 0, window=32, rate=2e-3)),
    "ppo": (learn_ppo.PPO, learn_ppo.Setting(1.0, 0, copies=128)),
}
STIFF = 1e5
"""The final stiffness of relaxed hinges [N/m]."""


class Arm(NamedTuple):
    """A schedule of hinges during training.

    Attributes:
        stiffness: k [N/m] as a function of the share of training done and the recent mean reward;
            None for hard hinges.
        noise: σ of the anchors [m] as a function of the share of training done.
    """

    stiffness: Callable[[float, float], Any]
    noise: Callable[[float], Any] = lambda share: 0.0


TITLES = "training hinges", "hard, after a third", "hard hinges", "anchors off by 10 mm"


class Hinges(NamedTuple):
    """Hinges of one kind: stiffness k [N/m] and standard deviation σ of the anchors [m].

    k is None for hard hinges.
    """

    k: Any
    σ: Any

    def draw(self, environment: Any, key: jax.Array) -> Any:
        """Returns the environment of one copy for one episode, with these hinges.

        The anchors of the hinges get random noise.
        """
        if self.k is not None:
            damping = 2 * jnp.sqrt(self.k * MASS)
            environment = environments.with_stiffness(environment, self.k, damping)
        noise = {name: {"anchor_b": self.σ} for name in ANCHORS}
        return environments.jitter(environment, key, noise)


class Trial(NamedTuple):
    """Evaluations of a trained policy.

    Attributes:
        own: return on the hinges at the end of its training.
        early: return on hard hinges after a third of training.
        hard: return on hard hinges.
        off: return on hard hinges with anchor noise.
        violation: mean violation on the hinges at the end of its training [m].
    """

    own: float
    early: float
    hard: float
    off: float
    violation: float


def constant(k: float | None) -> Arm:
    """Returns a schedule with constant stiffness k [N/m], or with hard hinges for None."""
    return Arm(lambda share, reward: k)


def ramp(share: float, reward: float) -> Any:
    """Returns a tenth of `STIFF` for 30 % of training, then a linear rise to `STIFF` at 70 %."""
    return STIFF * environments.warm_up(share, 0.3, 0.7)


def from_soft(share: float, reward: float) -> Any:
    """Returns `STIFF`/1000 for 30 % of training, then a log-linear rise to `STIFF` at 70 %."""
    return STIFF * 10 ** (-3 * (1 - environments.warm_up(share, 0.3, 0.7, 0.0)))


def by_reward(share: float, reward: float) -> Any:
    """Returns a stiffness that rises with the recent mean reward, from `STIFF`/100 to `STIFF`."""
    return environments.by_performance(reward, 0.01 * STIFF, STIFF, 0.5, 0.1)


def noisy(σ: float, fades: bool) -> Arm:
    """Returns a schedule of hard hinges with anchor noise.

    The noise is constant, or decays if `fades`, with a time constant τ of a quarter of training.
    """
    fade = functools.partial(environments.decay, initial=σ, time=0.25)
    return Arm(lambda share, reward: None, fade if fades else lambda share: σ)


ARMS = {f"k = {k:.0e}": constant(k) for k in (1e2, 1e3, 1e4, 1e5)} | {
    "hard": constant(None),
    "k warmed up from 1e4 to 1e5": Arm(ramp),
    "k warmed up from 1e2 to 1e5": Arm(from_soft),
    "k by performance, 1e3 to 1e5": Arm(by_reward),
    "hard, σ = 10 mm": noisy(1e-2, False),
    "hard, σ = 10 mm exp(−t/τ)": noisy(1e-2, True),
}


@functools.partial(jax.jit, static_argnums=(0, 2))
def begin(algorithm: Any, environment: Any, setting: Any, key: Any, hinges: Hinges) -> Any:
    """Initializes a learner in an environment with the given hinges."""
    return algorithm.begin(environment, setting, key, hinges.draw)


@functools.partial(jax.jit, static_argnums=(0, 2))
def update(algorithm: Any, environment: Any, setting: Any, learner: Any, hinges: Hinges) -> tuple:
    """Runs one update of the learner. Episodes that begin in it draw the given hinges."""
    return algorithm.update(environment, setting, learner, hinges.draw)


@functools.partial(jax.jit, static_argnums=0)
def evaluate(algorithm: Any, environment: Any, learner: Any, hinges: Hinges) -> tuple:
    """Returns mean reward and mean violation over `EPISODES` whole episodes on the given hinges."""

    def episode_means(number: jax.Array) -> tuple:
        hinge_key, key = jax.random.split(jax.random.fold_in(jax.random.key(2), number))
        world = hinges.draw(environment, hinge_key)

        def act(episode: Any, _: Any) -> tuple:
            action = algorithm.policy(learner, world.observe(episode))
            episode, outcome = world.step(episode, action)
            return episode, (outcome.reward, outcome.info["violation"])

        return jax.lax.scan(act, world.reset(key), None, world.horizon)[1]

    rewards, violations = jax.vmap(episode_means)(jnp.arange(EPISODES))
    return jnp.mean(rewards), jnp.mean(violations)


def train(name: str, arm: Arm, updates: int, seed: int) -> tuple[Trial, list[float]]:
    """Trains and evaluates a policy with one seed.

    Returns:
        The evaluations, and the mean reward of every update.
    """
    algorithm, setting = ALGORITHMS[name]
    environment, setting = environments.make(TASK), setting._replace(updates=updates)
    recent, rewards = 0.0, []
    hinges = hinges_at(arm, 0.0, recent)
    learner = begin(algorithm, environment, setting, jax.random.key(seed), hinges)
    zero, early = jnp.zeros(()), 0.0
    for i in range(updates):
        if i == updates // 3:
            early = evaluate(algorithm, environment, learner, Hinges(None, zero))[0]
        hinges = hinges_at(arm, i / updates, recent)
        learner, reward = update(algorithm, environment, setting, learner, hinges)
        rewards.append(float(reward))
        recent += (rewards[-1] - recent) / min(i + 1, 20)
    evaluation = functools.partial(evaluate, algorithm, environment, learner)
    trained, violation = evaluation(hinges_at(arm, 1.0, recent)._replace(σ=zero))
    hard, off = (evaluation(Hinges(None, σ))[0] for σ in (zero, zero + OFF))
    return Trial(*map(float, (trained, early, hard, off, violation))), rewards


def hinges_at(arm: Arm, share: float, recent: float) -> Hinges:
    """Returns the hinges of a schedule at a share of training.

    Their values are arrays, so that new values do not recompile.
    """
    k, σ = arm.stiffness(share, recent), arm.noise(share)
    return Hinges(k if k is None else jnp.asarray(k, float), jnp.asarray(σ, float))


def study(name: str, arms: dict[str, Arm], seeds: list[int], updates: int) -> dict[str, Any]:
    """Trains on every schedule with every seed, and prints a row per schedule.

    A row has mean and range over the seeds.

    Returns:
        Evaluations and rewards by schedule.
    """
    results = {}
    for label, arm in arms.items():
        pairs = [train(name, arm, updates, seed) for seed in seeds]
        trials = np.array([trial for trial, _ in pairs])
        cells = [f"{x.mean():.3f} ({x.min():.3f} to {x.max():.3f})" for x in trials.T[:4]]
        sag = f"{1e3 * trials[:, 4].mean():.2g}"
        print(f"| {name} | {label} | {' | '.join(cells)} | {sag} |", flush=True)
        results[label] = {"trials": trials.tolist(), "rewards": [rewards for _, rewards in pairs]}
    return results


def draw(results: dict[str, Any], picture: str) -> None:
    """Returns the environment of one copy for one episode, with these hinges and random anchors."""
    from jaxcon import view

    pyplot = view.pyplot()
    size = {"figsize": (12, 4 * len(results)), "squeeze": False, "layout": "constrained"}
    figure, panels = pyplot.subplots(len(results), 2, **size)
    for (name, arms), (left, right) in zip(results.items(), panels, strict=True):
        trials = np.array([arm["trials"] for arm in arms.values()])
        places = np.arange(len(arms))
        for i, title in enumerate(TITLES):
            mean, low, high = (f(trials[:, :, i], axis=1) for f in (np.mean, np.min, np.max))
            left.errorbar(
                places + 0.2 * (i - 1.5), mean, (mean - low, high - mean), fmt="o", label=title
            )
        left.set_xticks(places, list(arms), rotation=30, ha="right", fontsize=8)
        left.set(title=name, ylabel="share of the most return")
        left.legend(fontsize=8)
        for label, arm in arms.items():
            rewards = np.array(arm["rewards"])
            line = right.plot(rewards.mean(0), label=label)[0]
            band = rewards.min(0), rewards.max(0)
            right.fill_between(range(rewards.shape[1]), *band, alpha=0.15, color=line.get_color())
        right.set(xlabel="updates", ylabel="mean reward during training")
        right.legend(fontsize=6)
    figure.savefig(picture)
    pyplot.close(figure)


def main() -> None:
    """Trains and evaluates all policies. Prints the table and writes results and picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algorithms", nargs="*", default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--updates", type=int, default=150)
    parser.add_argument("--json", default="curricula.json")
    parser.add_argument("--picture", default="curricula.png")
    options = parser.parse_args()
    titles = " | ".join(("", "trained with", *TITLES, "violation [mm]"))
    print(f"|{titles} |\n|{'---|' * 7}")
    results = {x: study(x, ARMS, options.seeds, options.updates) for x in options.algorithms}
    report = {"machine": timing.machine(), "updates": options.updates, "found": results}
    Path(options.json).write_text(json.dumps(report))
    draw(results, options.picture)


if __name__ == "__main__":
    main()
