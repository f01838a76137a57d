"""What chapter 3.6.2 and 3.6.3 claims of soft, noisy and relaxed constraints, by experiment.

    python -m benchmarks.curricula [--algorithms ppo apg] [--seeds 0 1 2 3 4] [--updates 150]
        [--json curricula.json] [--picture curricula.png]

The crank of a four-bar follows its reference (`FourBarTracking`). A policy is trained where the
hinges are springs of stiffness k with damping 2√(k m), m = 0.3 kg; where their anchors are off by
noise of σ, drawn for each copy and episode; where k rises with training; and where they are hard.
Every policy is then tried on the same 128 episodes without noise in the actions: on the hinges
that it was trained on in the end, on hard ones, also when a third of training was over, and on
hard ones with anchors off by 10 mm (σ). The return is the share of the most there is, and the
violation the mean over all actions of the largest |φ|.
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
"""Hinges whose anchors are noisy, which amounts to noise on the lengths of all moving bars."""
OFF = 0.01
"""σ of the anchors in the third trial [m]."""
EPISODES = 128
ALGORITHMS = {
    "apg": (learn_apg.APG, learn_apg.Setting(1.0, 0, window=32, rate=2e-3)),
    "ppo": (learn_ppo.PPO, learn_ppo.Setting(1.0, 0, copies=128)),
}
STIFF = 1e5
"""The stiffness to which relaxed hinges come [N/m]."""


class Arm(NamedTuple):
    """One way to train.

    Attributes:
        stiffness: k [N/m] by the share of training that is over and the mean reward of late; None
            where hinges are hard.
        noise: σ of the anchors [m] by the share of training that is over.
    """

    stiffness: Callable[[float, float], Any]
    noise: Callable[[float], Any] = lambda share: 0.0


TITLES = "own hinges", "hard, a third of the way", "hard hinges", "hinges 10 mm off"


class Hinges(NamedTuple):
    """Their stiffness k [N/m], None where they are hard, and σ of their anchors [m]."""

    k: Any
    σ: Any

    def draw(self, environment: Any, key: jax.Array) -> Any:
        """Those of a copy, for an episode."""
        if self.k is not None:
            damping = 2 * jnp.sqrt(self.k * MASS)
            environment = environments.with_stiffness(environment, self.k, damping)
        off = {name: {"anchor_b": self.σ} for name in ANCHORS}
        return environments.jitter(environment, key, off)


class Trial(NamedTuple):
    """What a policy earns by `TITLES`, and the violation of its own hinges [m]."""

    own: float
    early: float
    hard: float
    off: float
    violation: float


def constant(k: float | None) -> Arm:
    """The same stiffness throughout."""
    return Arm(lambda share, reward: k)


def ramp(share: float, reward: float) -> Any:
    """A tenth for 30 % of training, then up to all of it at 70 %."""
    return STIFF * environments.warm_up(share, 0.3, 0.7)


def from_soft(share: float, reward: float) -> Any:
    """A thousandth for 30 % of training, then up to all of it at 70 %, by the logarithm."""
    return STIFF * 10 ** (-3 * (1 - environments.warm_up(share, 0.3, 0.7, 0.0)))


def by_reward(share: float, reward: float) -> Any:
    """From a hundredth to all by the mean reward of late."""
    return environments.by_performance(reward, 0.01 * STIFF, STIFF, 0.5, 0.1)


def noisy(σ: float, fades: bool) -> Arm:
    """Hard hinges, noise on their anchors, which stays or fades by τ = a quarter of training."""
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
    """A learner among such hinges."""
    return algorithm.begin(environment, setting, key, hinges.draw)


@functools.partial(jax.jit, static_argnums=(0, 2))
def update(algorithm: Any, environment: Any, setting: Any, learner: Any, hinges: Hinges) -> tuple:
    """One update; episodes that begin in it have such hinges."""
    return algorithm.update(environment, setting, learner, hinges.draw)


@functools.partial(jax.jit, static_argnums=0)
def tried(algorithm: Any, environment: Any, learner: Any, hinges: Hinges) -> tuple:
    """Mean reward and mean violation of whole episodes on such hinges."""

    def one(number: jax.Array) -> tuple:
        own, key = jax.random.split(jax.random.fold_in(jax.random.key(2), number))
        world = hinges.draw(environment, own)

        def act(episode: Any, _: Any) -> tuple:
            action = algorithm.policy(learner, world.observe(episode))
            episode, outcome = world.step(episode, action)
            return episode, (outcome.reward, outcome.info["violation"])

        return jax.lax.scan(act, world.reset(key), None, world.horizon)[1]

    rewards, violations = jax.vmap(one)(jnp.arange(EPISODES))
    return jnp.mean(rewards), jnp.mean(violations)


def train(name: str, arm: Arm, updates: int, seed: int) -> tuple[Trial, list[float]]:
    """One seed of one way to train; also the mean reward of every update."""
    algorithm, setting = ALGORITHMS[name]
    environment, setting = environments.make(TASK), setting._replace(updates=updates)
    late, rewards = 0.0, []
    hinges = at(arm, 0.0, late)
    learner = begin(algorithm, environment, setting, jax.random.key(seed), hinges)
    zero, early = jnp.zeros(()), 0.0
    for i in range(updates):
        if i == updates // 3:
            early = tried(algorithm, environment, learner, Hinges(None, zero))[0]
        hinges = at(arm, i / updates, late)
        learner, reward = update(algorithm, environment, setting, learner, hinges)
        rewards.append(float(reward))
        late += (rewards[-1] - late) / min(i + 1, 20)
    trial = functools.partial(tried, algorithm, environment, learner)
    own, violation = trial(at(arm, 1.0, late)._replace(σ=zero))
    hard, off = (trial(Hinges(None, σ))[0] for σ in (zero, zero + OFF))
    return Trial(*map(float, (own, early, hard, off, violation))), rewards


def at(arm: Arm, share: float, late: float) -> Hinges:
    """The hinges of now, as arrays, so that no number makes a new program."""
    k, σ = arm.stiffness(share, late), arm.noise(share)
    return Hinges(k if k is None else jnp.asarray(k, float), jnp.asarray(σ, float))


def study(name: str, arms: dict[str, Arm], seeds: list[int], updates: int) -> dict[str, Any]:
    """All trials and rewards, by arm; each is printed as a row: mean and extremes of the seeds."""
    found = {}
    for label, arm in arms.items():
        pairs = [train(name, arm, updates, seed) for seed in seeds]
        trials = np.array([trial for trial, _ in pairs])
        cells = [f"{x.mean():.3f} ({x.min():.3f} to {x.max():.3f})" for x in trials.T[:4]]
        sag = f"{1e3 * trials[:, 4].mean():.2g}"
        print(f"| {name} | {label} | {' | '.join(cells)} | {sag} |", flush=True)
        found[label] = {"trials": trials.tolist(), "rewards": [rewards for _, rewards in pairs]}
    return found


def draw(found: dict[str, Any], picture: str) -> None:
    """Trials of all arms with the extremes of the seeds, and the way there, for each algorithm."""
    from jaxcon import view

    pyplot = view.pyplot()
    size = {"figsize": (12, 4 * len(found)), "squeeze": False, "layout": "constrained"}
    figure, panels = pyplot.subplots(len(found), 2, **size)
    for (name, arms), (left, right) in zip(found.items(), panels, strict=True):
        trials = np.array([arm["trials"] for arm in arms.values()])
        places = np.arange(len(arms))
        for i, title in enumerate(TITLES):
            mean, least, most = (f(trials[:, :, i], axis=1) for f in (np.mean, np.min, np.max))
            left.errorbar(
                places + 0.2 * (i - 1.5), mean, (mean - least, most - mean), fmt="o", label=title
            )
        left.set_xticks(places, list(arms), rotation=30, ha="right", fontsize=8)
        left.set(title=name, ylabel="share of the most return")
        left.legend(fontsize=8)
        for label, arm in arms.items():
            rewards = np.array(arm["rewards"])
            line = right.plot(rewards.mean(0), label=label)[0]
            band = rewards.min(0), rewards.max(0)
            right.fill_between(range(rewards.shape[1]), *band, alpha=0.15, color=line.get_color())
        right.set(xlabel="updates", ylabel="mean reward on the way")
        right.legend(fontsize=6)
    figure.savefig(picture)
    pyplot.close(figure)


def main() -> None:
    """Prints the table, writes numbers and picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algorithms", nargs="*", default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--updates", type=int, default=150)
    parser.add_argument("--json", default="curricula.json")
    parser.add_argument("--picture", default="curricula.png")
    given = parser.parse_args()
    titles = " | ".join(("", "trained with", *TITLES, "violation [mm]"))
    print(f"|{titles} |\n|{'---|' * 7}")
    found = {x: study(x, ARMS, given.seeds, given.updates) for x in given.algorithms}
    kept = {"machine": timing.machine(), "updates": given.updates, "found": found}
    Path(given.json).write_text(json.dumps(kept))
    draw(found, given.picture)


if __name__ == "__main__":
    main()
