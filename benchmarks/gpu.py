"""Rates on a GPU, beside MJX and MuJoCo Warp, and agreement with the CPU of the same machine.

    python -m benchmarks.gpu [--scenes chain-5 …] [--robots ant …] [--batches 1024,16384]
        [--peers] [--warp] [--json FILE]

A rollout takes 200 steps of 2 ms by `jc.Method()` in float32 and keeps its last state; for robots
it is the method of `from_mjcf` without motors, from random poses above the floor. Compile times
include tracing, in a process that has compiled other scenes before. MJX takes as many steps as
last half a second, MuJoCo Warp 200 steps in a CUDA graph of one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import legged, mechanisms, peers, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import numbers, worlds
from jaxcon.staging import cuda

SCENES = ("pendulum", "four-bar", "planar-chain-10", "chain-5", "chain-10", "stewart")
ROBOTS = ("hopper", "ant")
STEPS, CHECKED, GRADIENT_STEPS = 200, 20, 100
"""Steps of a measured rollout, of one that is compared with the CPU, and of a gradient."""


def scene(name: str, batch: int) -> tuple[Callable[[int], Any], jc.State]:
    """Returns rollouts of a scene by their number of steps, and a batch of states."""
    system, state = mechanisms.find(name).build(np.float32)
    return rollout(system, jc.Method()), worlds(state, batch)


def robot(name: str, batch: int) -> tuple[Callable[[int], Any], jc.State]:
    """Returns rollouts of a robot by their number of steps, and a batch of states."""
    read = jc.from_mjcf(str(legged.ASSETS / f"{name}.xml"), dtype=jnp.float32)
    method, model = read.method(), legged.load(name)
    poses = jnp.asarray([legged.start(model, seed) for seed in range(batch)], jnp.float32)
    with jax.default_device(jax.devices("cpu")[0]):
        states = jax.jit(jax.vmap(lambda q: legged.begun(read, method, q)))(np.asarray(poses))
    states = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), states)
    return rollout(read.system, method, read.system.layout.n_u), states


def rollout(system: Any, method: jc.Method, motors: int = 0) -> Callable[[int], Any]:
    """Returns a function that makes a rollout of a batch, given the number of steps."""

    def of(steps: int) -> Callable[[jc.State], jc.State]:
        control = jnp.zeros((steps, motors), jnp.float32) if motors else None

        def run(state: jc.State) -> jc.State:
            result = jc.rollout(system, method, state, control, DT, steps, record=nothing)
            return result[0]

        return jax.vmap(run)

    return of


def nothing(state: jc.State, info: Any) -> None:
    """Records nothing of a step."""


def moved(states: jc.State, rollout: Callable[..., Any]) -> Callable[[Any], Any]:
    """Returns the value and the gradient of Σ q after a rollout, by the speeds at its start."""

    def total(v: Any) -> Any:
        return jnp.sum(rollout(dataclasses.replace(states, v=v)).q)

    return jax.value_and_grad(total)


def departure(rollouts: Callable[[int], Any], states: jc.State) -> dict[str, float]:
    """Compares a rollout with that on the CPU: the largest differences of q and v, of the largest.

    Args:
        rollouts: rollouts by their number of steps.
        states: a batch of states.
    """
    here = jax.jit(rollouts(CHECKED))(states)
    with jax.default_device(jax.devices("cpu")[0]):
        there = jax.jit(rollouts(CHECKED))(jax.tree.map(np.asarray, states))
    result = {"failed": int(np.sum(np.asarray(here.status) != np.asarray(there.status)))}
    for name in ("q", "v"):
        x, y = (np.asarray(getattr(s, name), np.float64) for s in (here, there))
        result[name] = float(np.abs(x - y).max() / np.abs(y).max())
    return result


def measure(make: Callable[..., Any], name: str, batches: list[int]) -> dict[str, Any]:
    """Measures a scene or a robot: compile times, rates by batch, gradients, agreement."""
    rollouts, states = make(name, 64)
    row: dict[str, Any] = {"name": name, "departure": departure(rollouts, states), "rates": {}}
    for batch in batches:
        rollouts, states = make(name, batch)
        compiled, seconds = timing.compile_seconds(rollouts(STEPS), states)
        row.setdefault("compile", seconds)
        start = time.perf_counter()
        jax.block_until_ready(compiled(states))
        row.setdefault("first run", time.perf_counter() - start)
        rate = timing.rate(lambda run=compiled, s=states: run(s), batch * STEPS)
        row["rates"][batch] = rate.median
        print(name, batch, f"{rate.median / 1e6:.3f} M/s", f"{seconds:.1f} s", flush=True)
    return row


def gradient(make: Callable[..., Any], name: str, batch: int) -> dict[str, Any]:
    """Measures the value and the gradient of a rollout: compile time and rate."""
    rollouts, states = make(name, batch)
    function = moved(states, rollouts(GRADIENT_STEPS))
    compiled, seconds = timing.compile_seconds(function, states.v)
    value = jax.block_until_ready(compiled(states.v))
    rate = timing.rate(lambda: compiled(states.v), batch * GRADIENT_STEPS)
    finite = bool(np.isfinite(np.asarray(value[1])).all())
    print(name, "gradient", batch, f"{rate.median / 1e6:.3f} M/s", f"{seconds:.1f} s", flush=True)
    return {"compile": seconds, "rate": rate.median, "batch": batch, "finite": finite}


def of_mjx(name: str, batch: int) -> dict[str, Any]:
    """Measures MJX on a scene or a robot."""
    if name in ROBOTS:
        found = legged.mjx_here(name, batch)
    else:
        found = peers.mjx_here(name, batch, repeats=3)
    print(name, "MJX", batch, found, flush=True)
    return found


def of_warp(name: str, batch: int) -> dict[str, Any]:
    """Measures MuJoCo Warp on a scene or a robot, with a step as a CUDA graph."""
    import mujoco
    import mujoco_warp
    import warp

    if name in ROBOTS:
        model = legged.falling(name)
        data = mujoco.MjData(model)
        poses = np.array([legged.start(model, seed) for seed in range(batch)])
        speeds = np.zeros((batch, model.nv))
    else:
        model, data = peers.model_of(mechanisms.find(name))
        poses = np.repeat(np.asarray(data.qpos)[None], batch, 0)
        speeds = np.asarray(data.qvel)[None] * peers.speeds(batch)[:, None]
    mujoco.mj_forward(model, data)
    start = time.perf_counter()
    there = mujoco_warp.put_model(model)
    state = mujoco_warp.put_data(model, data, nworld=batch, nconmax=64, njmax=256)

    def reset() -> None:
        state.qpos.assign(poses.astype(np.float32))
        state.qvel.assign(speeds.astype(np.float32))

    reset()
    mujoco_warp.step(there, state)
    warp.synchronize()
    seconds = time.perf_counter() - start
    with warp.ScopedCapture() as capture:
        mujoco_warp.step(there, state)

    def run() -> None:
        for _ in range(STEPS):
            warp.capture_launch(capture.graph)
        warp.synchronize()

    reset()
    run()
    reset()
    rate = timing.rate(run, batch * STEPS, 5, 0.0)
    finite = bool(np.isfinite(state.qpos.numpy()).all())
    print(
        name, "Warp", batch, f"{rate.median / 1e6:.3f} M/s", f"{seconds:.1f} s", finite, flush=True
    )
    return {"rate": rate.median, "compile": seconds, "batch": batch, "finite": finite}


def written(name: str, batch: int = 64) -> tuple[int, int]:
    """Counts the kernels of a step of a scene, and their instructions; this needs no GPU."""
    rollouts, states = scene(name, batch)
    traced = jax.jit(rollouts(1)).trace(states)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    return text.count(cuda.TARGET), text.count("\\0A")


def attempt(function: Callable[..., Any], *args: Any) -> Any:
    """Returns the result of a function, or the message of its error: other rows go on."""
    try:
        return function(*args)
    except Exception as error:
        print("failed:", args[-2:], f"{type(error).__name__}: {error}"[:300], flush=True)
        return f"{type(error).__name__}: {error}"[:300]


def main() -> None:
    """Prints each result as it is measured, and writes the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--batches", type=numbers, default=[1024, 16384])
    parser.add_argument("--gradients", nargs="*", default=["chain-5"])
    parser.add_argument("--peers", action="store_true", help="run MJX too")
    parser.add_argument("--warp", action="store_true", help="run MuJoCo Warp too")
    parser.add_argument("--only-peers", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: dict[str, Any] = {"machine": timing.machine(), "rows": []}
    print(found["machine"], flush=True)
    for names, make in ((options.scenes, scene), (options.robots, robot)):
        for name in names:
            row: Any = {"name": name}
            if not options.only_peers:
                row = attempt(measure, make, name, options.batches)
                row = row if isinstance(row, dict) else {"name": name, "error": row}
                print(row, flush=True)
            if name in options.gradients:
                row["gradient"] = attempt(gradient, make, name, options.batches[-1])
            if options.peers:
                row["MJX"] = attempt(of_mjx, name, options.batches[-1])
            if options.warp:
                row["Warp"] = {n: attempt(of_warp, name, n) for n in options.batches}
            found["rows"].append(row)
            if options.json:
                options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
