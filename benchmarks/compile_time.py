"""How long one step and a rollout take to trace and compile, beside MJX's step.

    python -m benchmarks.compile_time [--scenes chain-10 chain-100 …] [--peers] [--json FILE]

In a batch of worlds in float32, each scene in a process of its own with a limit of time, without
JAX's cache on the disk.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, peers, timing
from benchmarks.mjcf import DT
from benchmarks.targets import SCENES
from benchmarks.throughput import worlds

LONGER = ("chain-100",)
"""Measured after the scenes of the comparison; `chain-1000` is welcome too."""


def seconds_here(name: str, solver: str, batch: int = 256) -> dict[str, float]:
    """Of a step, and of a rollout of a hundred, compiled in this process."""
    method = jc.Method(solver=getattr(jc, solver)())
    system, state = mechanisms.find(name).build(np.float32)
    states = worlds(state, batch)

    def step(s: jc.State) -> jc.State:
        return jc.step(system, method, s, None, DT)[0]

    def rollout(s: jc.State) -> jc.State:
        return jc.rollout(system, method, s, None, DT, 100, record=lambda s, i: None)[0]

    times = {}
    for what, function in (("step", step), ("rollout", rollout)):
        times[what] = timing.compile_seconds(jax.vmap(function), states)[1]
    return times


def seconds(name: str, solver: str, limit: float) -> dict[str, float] | str:
    """The same in a fresh process, or why there is no time."""
    arguments = ["benchmarks.compile_time", "--here", name, "--solver", solver]
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    return timing.in_process(arguments, environment, limit, "over")


def mjx_seconds(name: str, limit: float) -> float | str:
    """MJX's step under the setting of XLA that compiles faster, or why there is no time."""
    found = [peers.mjx_process(name, 256, flags, limit) for flags in peers.FLAGS]
    times = [run.compile for run in found if not isinstance(run, str)]
    return min(times) if times else "; ".join(run for run in found if isinstance(run, str))


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One row."""
    ours = seconds(name, options.solver, options.limit)
    times = ours if isinstance(ours, dict) else {"step": ours, "rollout": ours}
    other = mjx_seconds(name, options.limit) if options.peers else "-"
    return {"scene": name, **times, "mjx": other}


def shown(value: float | str) -> str:
    """A time, or why there is none."""
    return value if isinstance(value, str) else f"{value:.1f} s"


def main() -> None:
    """Prints the table and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=[*SCENES, *LONGER])
    parser.add_argument("--solver", default="Sparse")
    parser.add_argument("--limit", type=float, default=300.0, help="of a process [s]")
    parser.add_argument("--peers", action="store_true", help="compile MJX too")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", metavar="SCENE", help="one scene in this process, as JSON")
    options = parser.parse_args()
    if options.here:
        print(json.dumps(seconds_here(options.here, options.solver)))
        return
    print(timing.machine())
    print("| scene | step | rollout | MJX's step |\n|---|---|---|---|")
    rows = []
    for name in options.scenes:
        rows.append(measure(name, options))
        times = " | ".join(shown(rows[-1][what]) for what in ("step", "rollout", "mjx"))
        print(f"| {name} | {times} |", flush=True)
    if options.json:
        result = {"machine": timing.machine(), "solver": options.solver, "rows": rows}
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
