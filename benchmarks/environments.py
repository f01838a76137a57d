"""Actions a second of Gymnasium's vector interface, beside the bare jit(vmap(step)).

    python -m benchmarks.environments [--tasks CartPole …] [--copies 4096] [--steps 100]
        [--repeats 5] [--peers] [--peer-seconds 100]

A policy on the device, tanh of a random linear map, acts in both. The interface resets copies that
are done with fresh keys, flags those that diverge and checks shapes; bare steps do none of it, and
go on where an episode is over. Repeats alternate, so that both meet the same machine, and bare
steps begin where the interface has come to, so that both meet the same states. An action is held
for several steps of the simulation, which the last column counts. With `--peers`, instead, copies
of ours beside those of Gymnasium and Brax: see `benchmarks/environment_peers.py`.
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
    """Of one task: actions a second of all copies together, median of the repeats.

    Attributes:
        interface, bare: [1/s].
        share: interface over bare, median of the repeats.
        resets: episodes that the interface began in so many steps.
        skip: steps of the simulation an action is held for.
    """

    interface: float
    bare: float
    share: float
    resets: int
    skip: int


def measure(task: str, copies: int, steps: int, repeats: int) -> Row:
    """Both rates of one task."""
    envs: Any = gymnasium.make_vec(
        f"jaxcon/{task}-v0", num_envs=copies, vectorization_mode="vector_entry_point"
    ).unwrapped
    seen, _ = envs.reset(seed=0)
    weights = jax.random.normal(jax.random.key(0), (seen.shape[1], envs.action_space.shape[1]))
    policy = jax.jit(lambda x: jnp.tanh(x @ weights.astype(x.dtype)))
    bare_step = jax.jit(lambda env, episode, actions: jax.vmap(env.step)(episode, actions))

    def interface(count: bool = False) -> Any:
        nonlocal seen
        ended = 0
        for _ in range(steps):
            seen, _, terminated, truncated, _ = envs.step(policy(seen))
            if count:
                ended += int(jnp.sum(terminated | truncated))
        return ended if count else seen

    def bare() -> Any:
        episode, x = envs.copies.episode, seen
        for _ in range(steps):
            episode, outcome = bare_step(envs.environment, episode, policy(x))
            x = outcome.observation
        return x

    jax.block_until_ready((interface(), bare()))  # compiled
    ended = interface(count=True)  # apart: three more operations on the device would be timed
    rates = timing.in_turn((interface, bare), copies * steps, repeats)
    reached, possible = (float(x) for x in np.median(rates, axis=0))
    share = float(np.median(rates[:, 0] / rates[:, 1]))
    return Row(reached, possible, share, ended, envs.environment.skip)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", default=list(environments.TASKS))
    parser.add_argument("--copies", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--peers", action="store_true", help="others beside ours")
    parser.add_argument("--peer-seconds", type=float, default=100.0, help="limit of each of them")
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
