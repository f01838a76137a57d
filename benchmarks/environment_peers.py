"""Actions a second of many copies of the same tasks: ours, Gymnasium's on MuJoCo, and Brax's.

    python -m benchmarks.environments --peers [--peer-seconds 100] [--copies 4096]

Each in a process of its own, on all cores: jaxcon's copies and Brax's lie over one device a core,
Gymnasium's asynchronous copies over processes that share memory, its synchronous ones do not
spread. Actions are random, within the bounds of each; every copy that is done is reset, by Brax to
the start that it first drew. An action of all lasts the same time but where the table says
otherwise; how many steps of the simulation that takes is each one's own choice. CartPole is a
scene of ours, the others' pendulums are files of theirs: a cart and a pole on a rail in each.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks import timing
from benchmarks.timing import Rate

ENOUGH = 1.5
"""How long a repeat takes, about [s]."""
REPEATS = 3


class Case(NamedTuple):
    """One row.

    Attributes:
        task: of all of whom it is.
        who: "jaxcon", "gymnasium" or "brax".
        name: by which they know it.
        how: their setting.
        copies: how many; 0 for as many as asked for.
    """

    task: str
    who: str
    name: str
    how: str
    copies: int = 0


def cases() -> list[Case]:
    """All rows: each peer with every setting that it recommends."""
    tasks = (
        ("cart and pole", "CartPole", "InvertedPendulum-v5", "inverted_pendulum"),
        ("half-cheetah", "HalfCheetah", "HalfCheetah-v5", "halfcheetah"),
    )
    found = []
    for task, ours, gymnasium, brax in tasks:
        found.append(Case(task, "jaxcon", ours, "VectorEnv"))
        found.append(Case(task, "gymnasium", gymnasium, "sync", 16))
        found += [Case(task, "gymnasium", gymnasium, "async", n) for n in (timing.cores(), 16)]
        found += [Case(task, "brax", brax, how) for how in ("generalized", "positional", "mjx")]
    return found


class Run(NamedTuple):
    """What one of them did.

    Attributes:
        copies: how many.
        action: how long it lasts [s].
        steps: of the simulation in it.
        ready: until the second action can be taken, from the first reset on [s].
        rate: actions a second of all copies together.
    """

    copies: int
    action: float
    steps: int
    ready: float
    rate: Rate


class Copies(NamedTuple):
    """Many copies of a task: how long an action lasts [s], its steps, and what takes one of all."""

    action: float
    steps: int
    act: Callable[[], Any]


def ours(name: str, how: str, copies: int) -> Copies:
    """Those of `GymnasiumVectorEnv` on all devices."""
    import jax

    from jaxcon import environments

    options: dict[str, Any] = {"skip": 4} if name == "CartPole" else {}
    envs = environments.GymnasiumVectorEnv(
        name, copies, devices=jax.device_count(), max_episode_steps=1000, **options
    )
    envs.reset(seed=0)
    shape, key = envs.action_space.shape, [jax.random.key(0)]
    draw = jax.jit(lambda k: jax.random.uniform(k, shape, minval=-1.0, maxval=1.0))

    def act() -> Any:
        key[0], own = jax.random.split(key[0])
        return envs.step(draw(own))[0]

    own: Any = envs.environment
    return Copies(float(own.dt) * own.skip, own.skip, act)


def brax(name: str, how: str, copies: int) -> Copies:
    """Those of Brax under the wrappers that its training has, on all devices."""
    import jax
    from brax import envs  # pyright: ignore[reportMissingImports]
    from brax.envs.wrappers import training  # pyright: ignore[reportMissingImports]

    import jaxcon as jc

    env: Any = envs.get_environment(name, backend=how)
    wrapped = training.wrap(env, episode_length=1000)
    keys = jax.random.split(jax.random.PRNGKey(0), copies)  # its wrappers know no others
    now, key = [jc.shard(jax.jit(wrapped.reset)(keys))], [jax.random.key(1)]
    shape, step = (copies, env.action_size), jax.jit(wrapped.step)
    draw = jax.jit(lambda k: jax.random.uniform(k, shape, minval=-1.0, maxval=1.0))

    def act() -> Any:
        key[0], own = jax.random.split(key[0])
        now[0] = step(now[0], jc.shard(draw(own)))
        return now[0].obs

    return Copies(float(env.dt), round(float(env.dt / env.sys.opt.timestep)), act)


def gymnasiums(name: str, how: str, copies: int) -> Copies:
    """Those of Gymnasium."""
    import gymnasium

    one: Any = gymnasium.make(name).unwrapped
    envs = gymnasium.make_vec(name, num_envs=copies, vectorization_mode=how)
    envs.reset(seed=0)
    space, random = one.action_space, np.random.default_rng(0)

    def act() -> Any:
        # drawn at once: the space would draw number by number
        actions = random.uniform(space.low, space.high, envs.action_space.shape)
        return envs.step(actions.astype(space.dtype))[0]

    return Copies(float(one.dt), one.frame_skip, act)


MAKE = {"jaxcon": ours, "brax": brax, "gymnasium": gymnasiums}


def measure(case: Case, enough: float = ENOUGH, repeats: int = REPEATS) -> Run:
    """One row, in this process."""
    wait = (lambda x: x) if case.who == "gymnasium" else _ready
    started = time.perf_counter()
    copies = MAKE[case.who](case.name, case.how, case.copies)
    wait(copies.act())
    ready = time.perf_counter() - started
    started = time.perf_counter()
    wait(copies.act())
    steps = max(2, round(enough / (time.perf_counter() - started)))

    def run() -> None:
        for _ in range(steps - 1):
            copies.act()
        wait(copies.act())

    rate = timing.rate(run, steps * case.copies, repeats)
    return Run(case.copies, copies.action, copies.steps, ready, rate)


def _ready(x: Any) -> Any:
    import jax

    return jax.block_until_ready(x)


def in_process(case: Case, limit: float) -> Run | str:
    """One row in a process of its own, or why there is none."""
    arguments = ["benchmarks.environment_peers", *map(str, case)]
    found = timing.in_process(arguments, dict(os.environ), limit, "is not done after")
    if isinstance(found, str):
        return found
    rate = Rate(**found.pop("rate"))
    return Run(**found, rate=rate)


HEAD = """
| task | of | setting | copies | an action | steps | ready | actions/s (min to max) | simulated |
|---|---|---|---|---|---|---|---|---|"""


def line(case: Case, run: Run | str) -> str:
    """A row of the table."""
    own = f"| {case.task} | {case.who} | {case.how} | {case.copies} |"
    if isinstance(run, str):
        return f"{own} | | | {run} | |"
    took = f"{1e3 * run.action:.3g} ms | {run.steps} | {run.ready:.1f} s"
    return f"{own} {took} | {run.rate} | {run.action * run.rate.median:.3g} s/s |"


def table(copies: int, limit: float) -> None:
    """Prints all rows."""
    print(HEAD)
    for case in cases():
        asked = case if case.copies else case._replace(copies=copies)
        print(line(asked, in_process(asked, limit)), flush=True)


def main() -> None:
    """One row, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    for field in Case._fields:
        parser.add_argument(field, type=int if field == "copies" else str)
    case = Case(**vars(parser.parse_args()))
    if case.who != "gymnasium":
        timing.use_all_cores()
    run = measure(case)
    print(json.dumps(run._asdict() | {"rate": timing.plain(run.rate)}))


if __name__ == "__main__":
    main()
