"""MuJoCo in C on all cores, and MJX at its best batch, on the mechanisms of the benchmarks.

    python -m benchmarks.peers [--scenes chain-10 …] [--mjx-seconds 240]

MuJoCo runs `mujoco.rollout` with one thread a core and records nothing. MJX runs jit(vmap(step)) in
a scan, in a process of its own, so that a compilation that takes too long can be stopped; of
several batches and settings of XLA the best counts. MJX is told to solve closed loops by one
iteration; MuJoCo in C stops after one by itself. Worlds differ by the speed of their start.
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
"""Settings of XLA that MJX is tried with: on long chains the first is many times faster."""
SPREAD = 0.1
"""Worlds start at between 1 − this and 1 + this times the speed of the mechanism."""


def speeds(batch: int) -> np.ndarray:
    """By which each world multiplies the velocities of the start, (batch,)."""
    return np.linspace(1 - SPREAD, 1 + SPREAD, batch) if batch > 1 else np.ones(1)


def mujoco_rate(
    name: str, batch: int = 1024, seconds: float = 0.5, repeats: int = 5, threads: int = 0
) -> Rate:
    """World-steps a second of MuJoCo in C.

    Args:
        name: of the mechanism.
        batch: worlds.
        seconds: about how long a repeat takes.
        repeats: how many.
        threads: one a core unless given.
    """
    model, start = model_of(mechanisms.find(name))
    states = world_states(model, start, batch)
    begin = time.perf_counter()
    rate_of(model, states, 20, 1, threads)
    steps = max(20, round(20 * seconds / (time.perf_counter() - begin)))
    return rate_of(model, states, steps, repeats, threads)


def rate_of(model: Any, states: np.ndarray, steps: int, repeats: int = 5, threads: int = 0) -> Rate:
    """The same of any model over some steps from states (batch, full physics state)."""
    import mujoco
    from mujoco import rollout

    batch, threads = len(states), threads or timing.cores()
    data = [mujoco.MjData(model) for _ in range(threads)]
    models = [model] * batch
    with rollout.Rollout(nthread=threads) as pool:

        def run() -> None:
            # unchecked, so that no trajectory is allocated or written
            pool.rollout(models, data, states, nstep=steps, skip_checks=True)

        return timing.rate(run, batch * steps, repeats)


def world_states(model: Any, data: Any, batch: int) -> np.ndarray:
    """The start of each world, (batch, full physics state)."""
    import mujoco

    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    states, moving = np.zeros((batch, mujoco.mj_stateSize(model, spec))), data.qvel.copy()
    for state, speed in zip(states, speeds(batch), strict=True):
        data.qvel[:] = speed * moving
        mujoco.mj_getState(model, data, state, spec)
    return states


@dataclass(frozen=True)
class MjxRun:
    """MJX at one batch under one setting of XLA.

    Attributes:
        batch: worlds.
        flags: for XLA.
        rate: world-steps a second.
        compile: of one step, tracing included [s].
    """

    batch: int
    flags: str
    rate: Rate
    compile: float


@dataclass(frozen=True)
class Mjx:
    """What MJX did with a mechanism: its runs, and why others are missing."""

    runs: tuple[MjxRun, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def best(self) -> MjxRun | None:
        """The fastest run."""
        return max(self.runs, key=lambda run: run.rate.median, default=None)

    def __str__(self) -> str:
        """As a table shows it: the best rate, or why there is none."""
        best = self.best
        return f"{best.rate}, batch {best.batch}" if best else "; ".join(self.notes)


def mjx(
    name: str,
    batches: tuple[int, ...] = BATCHES,
    limit: float = 240.0,
    module: str = "benchmarks.peers",
) -> Mjx:
    """World-steps a second of MJX, one process a run, until one takes longer than the limit.

    Args:
        name: of the mechanism.
        batches: worlds.
        limit: for compiling and running one batch [s].
        module: that knows the name.
    """
    runs, notes = [], []
    for flags in FLAGS:
        for batch in batches:
            found = mjx_process(name, batch, flags, limit, module)
            if isinstance(found, str):
                notes.append(found)
                break
            runs.append(found)
    return Mjx(tuple(runs), tuple(notes))


def mjx_process(
    name: str, batch: int, flags: str, limit: float, module: str = "benchmarks.peers"
) -> MjxRun | str:
    """One run in a process of its own, or why there is none."""
    arguments = [module, "--mjx", name, "--batch", str(batch)]
    late = "does not compile and run in"
    found = timing.in_process(arguments, timing.with_flags(flags), limit, late)
    if isinstance(found, str):
        return f"batch {batch}" + (f" with {flags}" if flags else "") + f" {found}"
    return MjxRun(batch, flags, Rate(**found["rate"]), found["compile"])


def mjx_here(name: str, batch: int, repeats: int = 5) -> dict[str, Any]:
    """The same in this process, at one batch: rate, and compile time of one step [s]."""
    model, data = mjx_start(mechanisms.find(name), batch)
    return mjx_rate(model, data, batch, None, repeats)


def mjx_rate(
    model: Any, data: Any, batch: int, steps: int | None, repeats: int = 5
) -> dict[str, Any]:
    """The same of any model of MJX and a batch of its data.

    Args:
        model: of MJX.
        data: its worlds.
        batch: how many.
        steps: of one call; if None, as many as take about a repeat, at most a thousand.
        repeats: how many.
    """
    data = timing.over_devices(data, batch)
    step = jax.vmap(functools.partial(mjx_step(), model))
    compiled, seconds = timing.compile_seconds(step, data)
    if steps is None:
        jax.block_until_ready(compiled(data))
        alone = timing.rate(lambda: compiled(data), 1.0, 1, 0.0).median
        steps = int(np.clip(timing.SECONDS * alone, 10, 1000))

    @jax.jit
    def run(data: Any) -> Any:
        return jax.lax.scan(lambda d, _: (step(d), None), data, None, steps)[0].qpos

    run(data).block_until_ready()
    rate = timing.rate(lambda: run(data), batch * steps, repeats)
    return {"rate": timing.plain(rate), "compile": seconds}


def mjx_start(mechanism: Mechanism, batch: int) -> tuple[Any, Any]:
    """MJX's model, and a batch of its data at the start."""
    from mujoco import mjx

    model, data = model_of(mechanism)
    if mechanism.loops:  # the trajectory is that of more iterations, several times faster
        model.opt.iterations, model.opt.ls_iterations = 1, 4
    moving = np.asarray(data.qvel)[None] * speeds(batch)[:, None]
    one = mjx.put_data(model, data)
    worlds = jax.vmap(lambda v: one.replace(qvel=v))(jax.numpy.asarray(moving, one.qvel.dtype))
    return mjx.put_model(model), worlds


def mjx_step() -> Any:
    """(model, data) → data."""
    from mujoco import mjx

    return mjx.step


def main() -> None:
    """Prints a table, or for one process of MJX its result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--mjx-seconds", type=float, default=240.0)
    parser.add_argument("--mjx", metavar="SCENE", help="MJX alone, here, as JSON")
    parser.add_argument("--batch", type=int, default=256)
    options = parser.parse_args()
    if options.mjx:
        timing.use_all_cores()
        print(json.dumps(mjx_here(options.mjx, options.batch)))
        return
    print(f"world-steps a second, {timing.cores()} cores, {timing.versions()}")
    print("| scene | MuJoCo C | MJX, best batch | MJX compiles |\n|---|---|---|---|")
    for name in options.scenes:
        ours, other = mujoco_rate(name), mjx(name, limit=options.mjx_seconds)
        compiling = ", ".join(f"{run.compile:.1f} s" for run in other.runs)
        print(f"| {name} | {ours} | {other} | {compiling} |", flush=True)


if __name__ == "__main__":
    main()
