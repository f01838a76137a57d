"""Throughput against the number of devices into which a CPU is split.

    python -m benchmarks.devices [--scenes four-bar …] [--devices 1,2,4,8] [--batch 1024]
        [--json FILE]

The same batch is sharded over 1, 2, 4, … devices. Each number of devices runs in its own process,
since XLA reads it at startup. Two programs are timed: a rollout, and a gradient. The gradient is
that of a mean over all worlds with respect to the feedback gains, which all worlds share.

All runs are in float32, by semi-implicit Euler with Baumgarte at 2 ms. Compilation is excluded.
More devices than cores cannot bring a gain. The last columns count the communication instructions
of both compiled programs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import numbers, worlds
from benchmarks.timing import Rate

FORCED = "--xla_force_host_platform_device_count"
EXCHANGES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")
GAIN = 50.0
"""Baumgarte gains α = β [1/s]."""
LIMIT = 600.0
"""Time limit of a process [s]."""


@dataclass(frozen=True)
class Scaling:
    """Rates of one scene on a number of devices.

    Attributes:
        scene: name of the scene.
        devices: number of devices.
        rollout: world-steps per second of the rollout.
        gradient: world-steps per second of value and gradient.
        exchanges: communication instructions by kind, for the rollout and for the gradient.
    """

    scene: str
    devices: int
    rollout: Rate
    gradient: Rate
    exchanges: tuple[dict[str, int], dict[str, int]]


def exchanges(program: str) -> dict[str, int]:
    """Counts the instructions in an HLO text that move data between devices, by kind."""
    kinds = re.findall(rf" ({'|'.join(EXCHANGES)})(?:-start)?\(", program)
    return dict(Counter(kinds))


World = Callable[[jax.Array, jc.State], jc.State]
"""(gain, start) → final state of one world."""


def world(name: str, steps: int, dtype: DTypeLike) -> tuple[World, jc.State]:
    """Returns the rollout of one world as a function of its feedback gain, and an initial state."""
    system, state = mechanisms.find(name).build(dtype)

    def run(gain: jax.Array, s: jc.State) -> jc.State:
        method = jc.Method(stabilizer=jc.Baumgarte(gain, gain), solver=jc.solvers.Sparse())
        dt = jnp.asarray(DT, dtype)
        return jc.rollout(system, method, s, None, dt, steps, record=lambda s, i: None)[0]

    return run, state


def mean(run: World, mesh: Any = None) -> Callable[..., Any]:
    """Returns a function that computes value and gradient of a loss.

    The loss is the batch mean of Σ q² at the end. The gradient is with respect to the feedback
    gain.
    """
    batch = jc.devices.over_devices(jax.vmap(run, in_axes=(None, 0)), mesh)

    def loss(gain: jax.Array, s: jc.State) -> jax.Array:
        return jnp.mean(jnp.sum(batch(gain, s).q ** 2, axis=1))

    return jax.value_and_grad(loss)


def measure(name: str, batch: int, work: int, repeats: int = 5) -> Scaling:
    """Measures one scene on the devices of this process."""
    steps = max(10, work // batch)
    run, state = world(name, steps, jnp.float32)
    inputs = jnp.float32(GAIN), jc.shard(worlds(state, batch))
    rates, counts = [], []
    for function in (jax.vmap(run, in_axes=(None, 0)), mean(run)):
        compiled, _ = timing.compile_seconds(function, *inputs)
        jax.block_until_ready(compiled(*inputs))
        rates.append(timing.rate(lambda run=compiled: run(*inputs), batch * steps, repeats))
        counts.append(exchanges(compiled.as_text()))
    return Scaling(name, jax.device_count(), rates[0], rates[1], (counts[0], counts[1]))


def elsewhere(name: str, devices: int, options: argparse.Namespace) -> Scaling | str:
    """Measures one scene in a process with `devices` devices.

    Returns:
        The rates, or the reason why there are none.
    """
    command = ["--batch", str(options.batch), "--work", str(options.work)]
    result = timing.in_process(
        ["benchmarks.devices", "--here", name, *command],
        timing.with_flags(f"{FORCED}={devices}") | {"JAX_PLATFORMS": "cpu"},
        LIMIT,
        "does not compile and run in",
    )
    if isinstance(result, str):
        return result
    rates = {program: Rate(**result.pop(program)) for program in ("rollout", "gradient")}
    return Scaling(**result, **rates)


def line(row: Scaling, first: Scaling) -> str:
    """Formats the rates on a number of devices as a table row.

    Speedups are relative to `first`, the first row of the scene.
    """
    cells: list[Any] = [row.scene, row.devices]
    for program in ("rollout", "gradient"):
        rate, reference = getattr(row, program), getattr(first, program)
        cells += [rate, f"{rate.median / reference.median:.2f}"]
    counts = [", ".join(f"{n} {kind}" for kind, n in x.items()) or "none" for x in row.exchanges]
    return "| " + " | ".join(map(str, [*cells, *counts])) + " |"


HEAD = """
| scene | devices | rollout, steps/s (min to max) | ratio | with gradient | ratio | exchanges | |
|---|---|---|---|---|---|---|---|"""


def arguments() -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["four-bar", "planar-chain-10"])
    parser.add_argument("--devices", type=numbers, default=[1, 2, 4, 8])
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--work", type=int, default=200_000, help="world-steps per repeat")
    parser.add_argument("--here", metavar="SCENE", help="measure in this process, print JSON")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def main() -> None:
    """Prints the table of rates and writes the file of `--json`."""
    options, rows = arguments(), []
    if options.here:
        print(json.dumps(dataclasses.asdict(measure(options.here, options.batch, options.work))))
        return
    print(timing.machine())
    print(HEAD)
    for name in options.scenes:
        first = None
        for devices in options.devices:
            row = elsewhere(name, devices, options)
            rows.append(row)
            if isinstance(row, str):
                print(f"| {name} | {devices} | {row} |", flush=True)
                continue
            first = first or row
            print(line(row, first), flush=True)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "rows": timing.plain(rows)}
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
