"""Rates of MuJoCo in C on all cores, and of MJX at its best batch, on the benchmarks' mechanisms.

    python -m benchmarks.peers [--scenes chain-10 …] [--mjx-seconds 240]

MuJoCo runs `mujoco.rollout` with one thread per core and records nothing. MJX runs jit(vmap(step))
in a scan, in its own process, so that a long compilation can be stopped. The best of several batch
sizes and XLA settings counts. MJX solves closed loops by one solver iteration; MuJoCo in C stops
after one iteration by itself. Worlds differ by their initial speed.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from benchmarks import mechanisms, timing
from benchmarks.equivalence import model_of
from benchmarks.mechanisms import Mechanism
from benchmarks.targets import SCENES
from benchmarks.timing import Rate

BATCHES = (64, 256, 1024)
FLAGS = ("--xla_cpu_use_fusion_emitters=false", "")
"""XLA settings for MJX. On long chains the first is many times faster."""
SPREAD = 0.1
"""Half width of the range of initial speeds, relative to the mechanism's speed."""


def speeds(batch: int) -> np.ndarray:
    """Returns factors on the initial velocities of the worlds, (batch,)."""
    return np.linspace(1 - SPREAD, 1 + SPREAD, batch) if batch > 1 else np.ones(1)


def mujoco_rate(
    name: str, batch: int = 1024, seconds: float = 0.5, repeats: int = 5, threads: int = 0
) -> Rate:
    """Measures world-steps per second of MuJoCo in C on a mechanism.

    Args:
        name: name of the mechanism.
        batch: number of worlds.
        seconds: approximate duration of a repeat [s].
        repeats: number of repeats.
        threads: number of threads; 0 for one thread per core.
    """
    model, start = model_of(mechanisms.find(name))
    states = world_states(model, start, batch)
    begin = time.perf_counter()
    rate_of(model, states, 20, 1, threads)
    steps = max(20, round(20 * seconds / (time.perf_counter() - begin)))
    return rate_of(model, states, steps, repeats, threads)


def rate_of(model: Any, states: np.ndarray, steps: int, repeats: int = 5, threads: int = 0) -> Rate:
    """Measures world-steps per second of a MuJoCo model, from a batch of full physics states."""
    import mujoco
    from mujoco import rollout

    batch, threads = len(states), threads or timing.cores()
    data = [mujoco.MjData(model) for _ in range(threads)]
    models = [model] * batch
    with rollout.Rollout(nthread=threads) as pool:

        def run() -> None:
            # skip_checks avoids allocating and writing a trajectory
            pool.rollout(models, data, states, nstep=steps, skip_checks=True)

        return timing.rate(run, batch * steps, repeats)


def world_states(model: Any, data: Any, batch: int) -> np.ndarray:
    """Returns initial states of all worlds, (batch, full physics state)."""
    import mujoco

    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    states, velocity = np.zeros((batch, mujoco.mj_stateSize(model, spec))), data.qvel.copy()
    for state, speed in zip(states, speeds(batch), strict=True):
        data.qvel[:] = speed * velocity
        mujoco.mj_getState(model, data, state, spec)
    return states


@dataclass(frozen=True)
class MjxRun:
    """Rate of MJX at one batch size with one XLA setting.

    Attributes:
        batch: number of worlds.
        flags: XLA flags.
        rate: world-steps per second.
        compile: compile time of one step, including tracing [s].
    """

    batch: int
    flags: str
    rate: Rate
    compile: float


@dataclass(frozen=True)
class Mjx:
    """All runs of a mechanism in MJX.

    Attributes:
        runs: the runs that finished.
        notes: reasons why runs are missing.
    """

    runs: tuple[MjxRun, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def best(self) -> MjxRun | None:
        """The fastest run, None if there is no run."""
        return max(self.runs, key=lambda run: run.rate.median, default=None)

    def __str__(self) -> str:
        """Formats the best rate, or the reasons why there is none."""
        best = self.best
        return f"{best.rate}, batch {best.batch}" if best else "; ".join(self.notes)


def mjx(
    name: str,
    batches: tuple[int, ...] = BATCHES,
    limit: float = 240.0,
    module: str = "benchmarks.peers",
) -> Mjx:
    """Measures world-steps per second of MJX in one process per run.

    Batch sizes grow until a run exceeds the limit.

    Args:
        name: name of the mechanism.
        batches: numbers of worlds.
        limit: time limit for compiling and running one batch [s].
        module: module whose command line accepts the name.
    """
    runs, notes = [], []
    for flags in FLAGS:
        for batch in batches:
            result = mjx_process(name, batch, flags, limit, module)
            if isinstance(result, str):
                notes.append(result)
                break
            runs.append(result)
    return Mjx(tuple(runs), tuple(notes))


def mjx_process(
    name: str, batch: int, flags: str, limit: float, module: str = "benchmarks.peers"
) -> MjxRun | str:
    """Measures MJX at one batch size in its own process.

    Returns:
        The result, or the reason why there is none.
    """
    arguments = [module, "--mjx", name, "--batch", str(batch)]
    message = "does not compile and run in"
    result = timing.in_process(arguments, timing.with_flags(flags), limit, message)
    if isinstance(result, str):
        return f"batch {batch}" + (f" with {flags}" if flags else "") + f" {result}"
    return MjxRun(batch, flags, Rate(**result["rate"]), result["compile"])


def mjx_here(name: str, batch: int, repeats: int = 5) -> dict[str, Any]:
    """Measures MJX in this process at one batch size: rate, and compile time of one step [s]."""
    model, data = mjx_start(mechanisms.find(name), batch)
    return mjx_rate(model, data, batch, None, repeats)


def mjx_rate(
    model: Any, data: Any, batch: int, steps: int | None, repeats: int = 5
) -> dict[str, Any]:
    """Measures a model of MJX on a batch: rate, and compile time of one step [s].

    Args:
        model: model of MJX.
        data: batch of MJX data.
        batch: number of worlds.
        steps: steps per call. None takes as many steps as last about a repeat, at most a thousand.
        repeats: number of repeats.
    """
    data = timing.over_devices(data, batch)
    step = jax.vmap(functools.partial(mjx_step(), model))
    compiled, seconds = timing.compile_seconds(step, data)
    if steps is None:
        jax.block_until_ready(compiled(data))
        step_rate = timing.rate(lambda: compiled(data), 1.0, 1, 0.0).median
        steps = int(np.clip(timing.SECONDS * step_rate, 10, 1000))

    @jax.jit
    def run(data: Any) -> Any:
        return jax.lax.scan(lambda d, _: (step(d), None), data, None, steps)[0].qpos

    run(data).block_until_ready()
    rate = timing.rate(lambda: run(data), batch * steps, repeats)
    return {"rate": timing.plain(rate), "compile": seconds}


def mjx_start(mechanism: Mechanism, batch: int) -> tuple[Any, Any]:
    """Returns MJX's model of a mechanism, and a batch of its initial data."""
    from mujoco import mjx

    model, data = model_of(mechanism)
    if mechanism.loops:  # one iteration gives the same trajectory several times faster
        model.opt.iterations, model.opt.ls_iterations = 1, 4
    velocities = np.asarray(data.qvel)[None] * speeds(batch)[:, None]
    single = mjx.put_data(model, data)
    worlds = jax.vmap(lambda v: single.replace(qvel=v))(
        jax.numpy.asarray(velocities, single.qvel.dtype)
    )
    return mjx.put_model(model), worlds


def mjx_step() -> Any:
    """Returns MJX's step function, (model, data) → data."""
    from mujoco import mjx

    return mjx.step


def main() -> None:
    """Prints the table, or with `--mjx` the result of one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--mjx-seconds", type=float, default=240.0)
    parser.add_argument("--mjx", metavar="SCENE", help="rate of MJX in this process, as JSON")
    parser.add_argument("--batch", type=int, default=256)
    options = parser.parse_args()
    if options.mjx:
        timing.use_all_cores()
        print(json.dumps(mjx_here(options.mjx, options.batch)))
        return
    print(f"world-steps per second, {timing.cores()} cores, {timing.versions()}")
    print("| scene | MuJoCo C | MJX, best batch | MJX compiles |\n|---|---|---|---|")
    for name in options.scenes:
        ours, theirs = mujoco_rate(name), mjx(name, limit=options.mjx_seconds)
        compile_times = ", ".join(f"{run.compile:.1f} s" for run in theirs.runs)
        print(f"| {name} | {ours} | {theirs} | {compile_times} |", flush=True)


if __name__ == "__main__":
    main()
