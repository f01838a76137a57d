"""Time to trace and compile one step and a rollout, compared with MJX's step.

    python -m benchmarks.compile_time [--scenes chain-10 chain-100 …] [--peers] [--one-device]
        [--json FILE]

All programs are in float32 and take the same batch. Each is compiled in its own process, with a
time limit and without JAX's disk cache. By default there is one device per core, as in the
throughput benchmarks. For MJX, the faster of two XLA settings counts. If neither finishes within
the limit, a smaller batch is used and the table says so.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, peers, timing
from benchmarks.mjcf import DT
from benchmarks.targets import SCENES
from benchmarks.throughput import method_of, worlds

LONGER = ("chain-100",)
"""Additional scenes, measured after the scenes of the comparison. `chain-1000` works too."""
BATCHES = (256, 64)
"""Batch sizes: for all programs, and for MJX if the first does not compile within the limit."""
PROGRAMS = ("step", "rollout", "mjx")


def seconds_here(name: str, program: str, batch: int, solver: str) -> float:
    """Compiles one program of a scene in this process and returns the compile time [s].

    The program is compiled for all devices of the process.
    """
    if program == "mjx":
        model, data = peers.mjx_start(mechanisms.find(name), batch)
        step = peers.mjx_step()
        return compiled(lambda d: step(model, d), data, batch)
    method = method_of(name, solver)
    system, state = mechanisms.find(name).build(np.float32)

    def step_world(s: jc.State) -> jc.State:
        return jc.step(system, method, s, None, DT)[0]

    def rollout(s: jc.State) -> jc.State:
        return jc.rollout(system, method, s, None, DT, 100, record=lambda s, i: None)[0]

    return compiled(rollout if program == "rollout" else step_world, worlds(state, batch), batch)


def compiled(function: Any, starts: Any, batch: int) -> float:
    """Returns the compile time of a single-world function under `vmap` [s]."""
    return timing.compile_seconds(jax.vmap(function), timing.over_devices(starts, batch))[1]


def seconds(
    name: str, program: str, batch: int, options: argparse.Namespace, flags: str = ""
) -> float | str:
    """Compiles a program in a fresh process.

    Returns:
        The compile time [s], or the reason why there is none.
    """
    arguments = ["benchmarks.compile_time", "--here", name, "--program", program]
    arguments += ["--batch", str(batch), "--solver", options.solver]
    arguments += ["--one-device"] if options.one_device else []
    environment = timing.with_flags(flags)
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    result = timing.in_process(arguments, environment, options.limit, "over")
    return result if isinstance(result, str) else result["seconds"]


def mjx_seconds(name: str, options: argparse.Namespace) -> tuple[float | str, int]:
    """Compiles MJX's step in fresh processes.

    Returns:
        The compile time [s], or the reason why there is none, and the batch size.
    """
    results: list[float | str] = []
    for batch in BATCHES:
        results = [seconds(name, "mjx", batch, options, flags) for flags in peers.FLAGS]
        times = [time for time in results if not isinstance(time, str)]
        if times:
            return min(times), batch
    return results[-1], BATCHES[-1]


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Measures compile times of all programs of a scene."""
    row: dict[str, Any] = {"scene": name}
    for program in PROGRAMS[:2]:
        row[program] = seconds(name, program, BATCHES[0], options)
    row["mjx"], row["mjx_worlds"] = mjx_seconds(name, options) if options.peers else ("-", 0)
    return row


def shown(value: float | str) -> str:
    """Formats a compile time with its unit, or the reason why there is none."""
    return value if isinstance(value, str) else f"{value:.1f} s"


def line(row: dict[str, Any]) -> str:
    """Formats the compile times of one scene as a table row."""
    cells = [shown(row[program]) for program in PROGRAMS]
    if row["mjx_worlds"] == BATCHES[-1] and not isinstance(row["mjx"], str):
        cells[-1] += f" of {BATCHES[-1]} worlds"
    return f"| {row['scene']} | " + " | ".join(cells) + " |"


def arguments() -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=[*SCENES, *LONGER])
    parser.add_argument("--solver", default="Sparse")
    parser.add_argument("--limit", type=float, default=100.0, help="time limit of a process [s]")
    parser.add_argument("--peers", action="store_true", help="compile MJX's step too")
    parser.add_argument("--one-device", action="store_true", help="one device, not one per core")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", metavar="SCENE", help="compile in this process, print JSON")
    parser.add_argument("--program", choices=PROGRAMS, default="step")
    parser.add_argument("--batch", type=int, default=BATCHES[0])
    return parser.parse_args()


def main() -> None:
    """Prints the table of compile times and writes the file of `--json`."""
    options = arguments()
    if options.here:
        if not options.one_device:
            timing.use_all_cores()
        task = options.here, options.program, options.batch, options.solver
        print(json.dumps({"seconds": seconds_here(*task)}))
        return
    devices = "one device" if options.one_device else "one device a core"
    print(timing.machine(), devices)
    print("| scene | step | rollout | MJX's step |\n|---|---|---|---|")
    rows = []
    for name in options.scenes:
        rows.append(measure(name, options))
        print(line(rows[-1]), flush=True)
    if options.json:
        result = {"machine": timing.machine(), "devices": devices, "rows": rows}
        options.json.write_text(json.dumps(result | {"solver": options.solver}, indent=1) + "\n")


if __name__ == "__main__":
    main()
