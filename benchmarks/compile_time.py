"""How long one step and a rollout take to trace and compile, beside MJX's step.

    python -m benchmarks.compile_time [--scenes chain-10 chain-100 …] [--peers] [--one-device]
        [--json FILE]

In float32, each program alone in a process of its own with a limit of time, without JAX's cache on
the disk, of the same batch over the same devices: one a core as for the rates, or one in all. MJX's
is the faster of both settings of XLA; where none ends within the limit, that of fewer worlds stands
for it and says so.
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
"""Measured after the scenes of the comparison; `chain-1000` is welcome too."""
BATCHES = (256, 64)
"""Worlds of the programs, and of MJX's where its first does not compile."""
PROGRAMS = ("step", "rollout", "mjx")


def seconds_here(name: str, program: str, batch: int, solver: str) -> float:
    """Of one program of a scene, in this process, over the devices that it has."""
    if program == "mjx":
        model, data = peers.mjx_start(mechanisms.find(name), batch)
        step = peers.mjx_step()
        return compiled(lambda d: step(model, d), data, batch)
    method = method_of(name, solver)
    system, state = mechanisms.find(name).build(np.float32)

    def one(s: jc.State) -> jc.State:
        return jc.step(system, method, s, None, DT)[0]

    def rollout(s: jc.State) -> jc.State:
        return jc.rollout(system, method, s, None, DT, 100, record=lambda s, i: None)[0]

    return compiled(rollout if program == "rollout" else one, worlds(state, batch), batch)


def compiled(function: Any, starts: Any, batch: int) -> float:
    """Of a function of one world under `vmap`."""
    return timing.compile_seconds(jax.vmap(function), timing.over_devices(starts, batch))[1]


def seconds(
    name: str, program: str, batch: int, options: argparse.Namespace, flags: str = ""
) -> float | str:
    """The same in a fresh process, or why there is no time."""
    arguments = ["benchmarks.compile_time", "--here", name, "--program", program]
    arguments += ["--batch", str(batch), "--solver", options.solver]
    arguments += ["--one-device"] if options.one_device else []
    environment = timing.with_flags(flags)
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    found = timing.in_process(arguments, environment, options.limit, "over")
    return found if isinstance(found, str) else found["seconds"]


def mjx_seconds(name: str, options: argparse.Namespace) -> tuple[float | str, int]:
    """Of MJX's step, and of how many worlds; or why there is no time."""
    found: list[float | str] = []
    for batch in BATCHES:
        found = [seconds(name, "mjx", batch, options, flags) for flags in peers.FLAGS]
        times = [time for time in found if not isinstance(time, str)]
        if times:
            return min(times), batch
    return found[-1], BATCHES[-1]


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One row."""
    row: dict[str, Any] = {"scene": name}
    for program in PROGRAMS[:2]:
        row[program] = seconds(name, program, BATCHES[0], options)
    row["mjx"], row["mjx_worlds"] = mjx_seconds(name, options) if options.peers else ("-", 0)
    return row


def shown(value: float | str) -> str:
    """A time, or why there is none."""
    return value if isinstance(value, str) else f"{value:.1f} s"


def line(row: dict[str, Any]) -> str:
    """A row as the table shows it."""
    cells = [shown(row[program]) for program in PROGRAMS]
    if row["mjx_worlds"] == BATCHES[-1] and not isinstance(row["mjx"], str):
        cells[-1] += f" of {BATCHES[-1]} worlds"
    return f"| {row['scene']} | " + " | ".join(cells) + " |"


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=[*SCENES, *LONGER])
    parser.add_argument("--solver", default="Sparse")
    parser.add_argument("--limit", type=float, default=100.0, help="of a process [s]")
    parser.add_argument("--peers", action="store_true", help="compile MJX too")
    parser.add_argument("--one-device", action="store_true", help="instead of one a core")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", metavar="SCENE", help="one program in this process, as JSON")
    parser.add_argument("--program", choices=PROGRAMS, default="step")
    parser.add_argument("--batch", type=int, default=BATCHES[0])
    return parser.parse_args()


def main() -> None:
    """Prints the table and writes the file."""
    options = arguments()
    if options.here:
        if not options.one_device:
            timing.use_all_cores()
        given = options.here, options.program, options.batch, options.solver
        print(json.dumps({"seconds": seconds_here(*given)}))
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
