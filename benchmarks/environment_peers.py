"""Actions per second of many copies of a task: jaxcon, Gymnasium on MuJoCo, and Brax.

    python -m benchmarks.environments --peers [--peer-seconds 100] [--copies 4096]

Each setting runs in its own process, on all cores. Copies in jaxcon and Brax are sharded over one
device per core. Gymnasium's asynchronous copies run in processes that share memory; its synchronous
copies run on one core. Actions are random within the bounds of each environment. Every finished
copy is reset. In Brax, a reset returns to the copy's first initial state.

An action lasts equally long in all packages unless the table says otherwise. The number of
simulation steps per action is the choice of each package. CartPole is a scene of jaxcon. The other
pendulums come from their packages; each is a cart and a pole on a rail.
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
"""Target duration of a repeat [s]."""
REPEATS = 3


class Case(NamedTuple):
    """One row of the table: a task in one package with one setting.

    Attributes:
        task: name of the task in the table.
        who: the package: "jaxcon", "gymnasium" or "brax".
        name: name of the environment in that package.
        how: setting of the package.
        copies: number of copies; 0 for the number on the command line.
    """

    task: str
    who: str
    name: str
    how: str
    copies: int = 0


def cases() -> list[Case]:
    """Returns all rows of the table: each package with every setting that it recommends."""
    tasks = (
        ("cart and pole", "CartPole", "InvertedPendulum-v5", "inverted_pendulum"),
        ("half-cheetah", "HalfCheetah", "HalfCheetah-v5", "halfcheetah"),
    )
    rows = []
    for task, ours, gymnasium, brax in tasks:
        rows.append(Case(task, "jaxcon", ours, "VectorEnv"))
        rows.append(Case(task, "gymnasium", gymnasium, "sync", 16))
        rows += [Case(task, "gymnasium", gymnasium, "async", n) for n in (timing.cores(), 16)]
        rows += [Case(task, "brax", brax, how) for how in ("generalized", "positional", "mjx")]
    return rows


class Run(NamedTuple):
    """The result of one row.

    Attributes:
        copies: number of copies.
        action: duration of an action in simulated time [s].
        steps: simulation steps per action.
        ready: time from the creation of the copies until their second action can be taken [s].
        rate: actions per second of all copies together.
    """

    copies: int
    action: float
    steps: int
    ready: float
    rate: Rate


class Copies(NamedTuple):
    """Copies of a task in one package.

    Attributes:
        action: duration of an action in simulated time [s].
        steps: simulation steps per action.
        act: takes one random action in every copy.
    """

    action: float
    steps: int
    act: Callable[[], Any]


def ours(name: str, how: str, copies: int) -> Copies:
    """Creates copies of a task in jaxcon's `GymnasiumVectorEnv` on all devices."""
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
        key[0], draw_key = jax.random.split(key[0])
        return envs.step(draw(draw_key))[0]

    environment: Any = envs.environment
    return Copies(float(environment.dt) * environment.skip, environment.skip, act)


def brax(name: str, how: str, copies: int) -> Copies:
    """Creates copies of a Brax environment under Brax's training wrappers, on all devices."""
    import jax
    from brax import envs  # pyright: ignore[reportMissingImports]
    from brax.envs.wrappers import training  # pyright: ignore[reportMissingImports]

    import jaxcon as jc

    env: Any = envs.get_environment(name, backend=how)
    wrapped = training.wrap(env, episode_length=1000)
    keys = jax.random.split(jax.random.PRNGKey(0), copies)  # the wrappers need old-style keys
    state, key = [jc.shard(jax.jit(wrapped.reset)(keys))], [jax.random.key(1)]
    shape, step = (copies, env.action_size), jax.jit(wrapped.step)
    draw = jax.jit(lambda k: jax.random.uniform(k, shape, minval=-1.0, maxval=1.0))

    def act() -> Any:
        key[0], draw_key = jax.random.split(key[0])
        state[0] = step(state[0], jc.shard(draw(draw_key)))
        return state[0].obs

    return Copies(float(env.dt), round(float(env.dt / env.sys.opt.timestep)), act)


def gymnasiums(name: str, how: str, copies: int) -> Copies:
    """Creates copies of a Gymnasium environment."""
    import gymnasium

    single: Any = gymnasium.make(name).unwrapped
    envs = gymnasium.make_vec(name, num_envs=copies, vectorization_mode=how)
    envs.reset(seed=0)
    space, random = single.action_space, np.random.default_rng(0)

    def act() -> Any:
        # One draw for all copies: sampling the space would loop over its numbers.
        actions = random.uniform(space.low, space.high, envs.action_space.shape)
        return envs.step(actions.astype(space.dtype))[0]

    return Copies(float(single.dt), single.frame_skip, act)


MAKE = {"jaxcon": ours, "brax": brax, "gymnasium": gymnasiums}


def measure(case: Case, enough: float = ENOUGH, repeats: int = REPEATS) -> Run:
    """Measures one row in this process."""
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
    """Measures one row in its own process.

    Returns:
        The result, or the reason why there is none.
    """
    arguments = ["benchmarks.environment_peers", *map(str, case)]
    result = timing.in_process(arguments, dict(os.environ), limit, "is not done after")
    if isinstance(result, str):
        return result
    rate = Rate(**result.pop("rate"))
    return Run(**result, rate=rate)


HEAD = """
| task | package | setting | copies | action | steps | ready | actions/s (min to max) | simulated |
|---|---|---|---|---|---|---|---|---|"""


def line(case: Case, run: Run | str) -> str:
    """Formats the result of a case as a table row."""
    head = f"| {case.task} | {case.who} | {case.how} | {case.copies} |"
    if isinstance(run, str):
        return f"{head} | | | {run} | |"
    timings = f"{1e3 * run.action:.3g} ms | {run.steps} | {run.ready:.1f} s"
    return f"{head} {timings} | {run.rate} | {run.action * run.rate.median:.3g} s/s |"


def table(copies: int, limit: float) -> None:
    """Measures and prints all rows."""
    print(HEAD)
    for case in cases():
        sized = case if case.copies else case._replace(copies=copies)
        print(line(sized, in_process(sized, limit)), flush=True)


def main() -> None:
    """Measures the case on the command line and prints it as JSON."""
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
