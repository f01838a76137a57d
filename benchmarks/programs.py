"""Length of the programs of a scene, and the time to compile them.

    python -m benchmarks.programs [SCENES …] [--methods Euler RK4] [--batch N] [--gpu-batch N]

For each scene and method, there is a row for a rollout of a batch and one for its gradient:

    equations      equations of the traced program, those of native functions included
    instructions   instructions of the program that XLA has optimized for this CPU
    compile        time of tracing and compiling, in a fresh process without a disk cache [s]

With `pip install "jax[cuda12]"`, the row of a rollout also has what one step becomes on an H100,
see `gpu_kernels`: kernels, bytes per world, and conditions that the host waits for. No GPU is
needed.

The number of equations depends on the version of JAX, and not on the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import gpu_kernels, mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import worlds
from jaxcon.staging.operations import instructions

SCENES = ("pendulum", "four-bar", "chain-5", "chain-10", "planar-chain-10", "stewart")
SMALL = ("pendulum", "four-bar", "planar-chain-10")
"""Scenes whose counts are compared with the baseline in the tests."""
METHODS = {"Euler": jc.Method(), "RK4": jc.Method(jc.RK4())}
PROGRAMS = ("rollout", "gradient")
BATCH, GPU_BATCH = 256, 16384
STEPS = 100


def program(name: str, method: str, kind: str, batch: int) -> tuple[Callable[..., Any], Any]:
    """Returns a program of a scene and its argument.

    Args:
        name: the scene.
        method: a key of `METHODS`.
        kind: "rollout", "gradient" or "step".
        batch: the number of worlds.
    """
    system, state = mechanisms.find(name).build(np.float32)

    def step(state: jc.State) -> jc.State:
        return jc.step(system, METHODS[method], state, None, DT)[0]

    def rollout(state: jc.State) -> jc.State:
        ignore = lambda state, info: None  # noqa: E731
        return jc.rollout(system, METHODS[method], state, None, DT, STEPS, record=ignore)[0]

    def gradient(state: jc.State) -> jax.Array:
        def loss(q: jax.Array) -> jax.Array:
            return jnp.sum(rollout(dataclasses.replace(state, q=q)).q ** 2)

        return jax.grad(loss)(state.q)

    function = {"step": step, "rollout": rollout, "gradient": gradient}[kind]
    return jax.vmap(function), worlds(state, batch)


def equations(function: Callable[..., Any], *args: Any) -> int:
    """Returns the number of equations of a function after tracing."""
    return instructions(jax.make_jaxpr(function)(*args).jaxpr)


def measured(name: str, method: str, kind: str, batch: int) -> dict[str, Any]:
    """Compiles a program in this process; returns its counts and its compile time [s]."""
    function, states = program(name, method, kind, batch)
    compiled, seconds = timing.compile_seconds(function, states)
    return {
        "equations": equations(function, states),
        "instructions": compiled.as_text().count(" = "),
        "seconds": seconds,
    }


def on_gpu(name: str, method: str, batch: int) -> gpu_kernels.Kernels:
    """Counts the kernels of one step of a batch on an H100."""
    function, states = program(name, method, "step", 1)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct((batch, *x.shape[1:]), x.dtype), states)
    return gpu_kernels.count(function, shapes)


def line(name: str, method: str, kind: str, options: argparse.Namespace) -> str:
    """Measures a program in a fresh process; returns its row of the table."""
    arguments = ["benchmarks.programs", name, "--methods", method, "--here", kind]
    arguments += ["--batch", str(options.batch)]
    environment = timing.with_flags("")
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    found = timing.in_process(arguments, environment, options.limit, "over")
    if isinstance(found, str):
        cells = [found, "", ""]
    else:
        cells = [f"{found['equations']:,}", f"{found['instructions']:,}", f"{found['seconds']:.1f}"]
    cells += ["", "", ""]
    if kind == "rollout" and gpu_kernels.is_available():
        seen = on_gpu(name, method, options.gpu_batch)
        cells[3:] = (
            f"{seen.launched}",
            f"{seen.moved / options.gpu_batch / 1e3:.1f}",
            f"{seen.waits}",
        )
    return f"| {name}, {method}, {kind} | " + " | ".join(cells) + " |"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--methods", nargs="*", default=["Euler"], choices=list(METHODS))
    parser.add_argument("--batch", type=int, default=BATCH)
    parser.add_argument("--gpu-batch", type=int, default=GPU_BATCH)
    parser.add_argument("--limit", type=float, default=300.0, help="time limit of a process [s]")
    parser.add_argument("--here", choices=PROGRAMS, help="measure in this process, print JSON")
    options = parser.parse_args()
    if options.here:
        task = options.scenes[0], options.methods[0], options.here, options.batch
        print(json.dumps(measured(*task)))
        return
    print(timing.machine())
    print("| program | equations | instructions | compile, s | GPU kernels | KB a world | waits |")
    print("|---|---|---|---|---|---|---|")
    for name in options.scenes:
        for method in options.methods:
            for kind in PROGRAMS:
                print(line(name, method, kind, options), flush=True)


if __name__ == "__main__":
    main()
