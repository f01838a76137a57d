"""Actions per second of Gymnasium's vector interface, compared with the bare jit(vmap(step)).

    python -m benchmarks.environments [--tasks CartPole …] [--copies 4096] [--steps 100]
        [--repeats 5] [--peers] [--peer-seconds 100]

The policy, tanh of a random linear map, runs on the device in both programs. The interface resets
finished copies with fresh keys, flags diverged copies and checks shapes. The bare step does none of
this and continues after the end of an episode.

Repeats alternate, so that both programs see the same load of the machine. The bare steps start from
the current states of the interface. An action is held for several simulation steps; the last column
gives their number. With `--peers`, jaxcon is compared with Gymnasium and Brax instead; see
`benchmarks/environment_peers.py`.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import environment_peers, timing
from jaxcon import environments


class Row(NamedTuple):
    """Rates of one task, in actions per second of all copies together.

    Attributes:
        interface: median rate of the interface [1/s].
        bare: median rate of the bare step [1/s].
        share: median over the repeats of interface / bare.
        resets: episodes that ended in the interface in one repeat.
        skip: simulation steps per action.
    """

    interface: float
    bare: float
    share: float
    resets: int
    skip: int


def measure(task: str, copies: int, steps: int, repeats: int) -> Row:
    """Measures the rates of the interface and of the bare step on one task."""
    envs: Any = gymnasium.make_vec(
        f"jaxcon/{task}-v0", num_envs=copies, vectorization_mode="vector_entry_point"
    ).unwrapped
    observations, _ = envs.reset(seed=0)
    weights = jax.random.normal(
        jax.random.key(0), (observations.shape[1], envs.action_space.shape[1])
    )
    policy = jax.jit(lambda x: jnp.tanh(x @ weights.astype(x.dtype)))
    bare_step = jax.jit(lambda env, episode, actions: jax.vmap(env.step)(episode, actions))

    def interface(count: bool = False) -> Any:
        nonlocal observations
        ended = 0
        for _ in range(steps):
            observations, _, terminated, truncated, _ = envs.step(policy(observations))
            if count:
                ended += int(jnp.sum(terminated | truncated))
        return ended if count else observations

    def bare() -> Any:
        episode, x = envs.copies.episode, observations
        for _ in range(steps):
            episode, outcome = bare_step(envs.environment, episode, policy(x))
            x = outcome.observation
        return x

    jax.block_until_ready((interface(), bare()))  # compile first
    ended = interface(count=True)  # apart from the timing: counting adds three device operations
    rates = timing.in_turn((interface, bare), copies * steps, repeats)
    interface_rate, bare_rate = (float(x) for x in np.median(rates, axis=0))
    share = float(np.median(rates[:, 0] / rates[:, 1]))
    return Row(interface_rate, bare_rate, share, ended, envs.environment.skip)


def main() -> None:
    """Prints the table of rates by task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", default=list(environments.TASKS))
    parser.add_argument("--copies", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--peers", action="store_true", help="compare with Gymnasium and Brax")
    parser.add_argument("--peer-seconds", type=float, default=100.0, help="time limit of each")
    options = parser.parse_args()
    print(timing.machine())
    if options.peers:
        environment_peers.table(options.copies, options.peer_seconds)
        return
    print(f"| {options.copies} copies | interface [1/s] | bare [1/s] | share | resets | steps |")
    print("|---|---|---|---|---|---|")
    for task in options.tasks:
        row = measure(task, options.copies, options.steps, options.repeats)
        rates = f"{row.interface:.3g} | {row.bare:.3g} | {row.share:.0%}"
        print(f"| {task} | {rates} | {row.resets} | {row.skip} |", flush=True)


if __name__ == "__main__":
    main()
