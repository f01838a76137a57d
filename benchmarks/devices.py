"""Throughput against the number of devices that a CPU is made to be.

    python -m benchmarks.devices [--scenes four-bar …] [--devices 1,2,4,8] [--batch 1024]
        [--json FILE]

The same batch lies over 1, 2, 4, … devices, each number in a process of its own, since XLA reads it
when it starts: a rollout, and value and gradient of a mean over all worlds by the gains, which they
share. Float32, semi-implicit Euler with Baumgarte at 2 ms, compilation apart. Devices beyond the
cores can bring nothing. The last columns count what both compiled programs exchange.
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

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import numbers, worlds
from benchmarks.timing import Rate

FORCED = "--xla_force_host_platform_device_count"
EXCHANGES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")
GAIN = 50.0
"""α = β of the feedback [1/s]."""
LIMIT = 600.0
"""On one process [s]."""


@dataclass(frozen=True)
class Scaling:
    """Of one scene on some devices.

    Attributes:
        scene, devices: which.
        rollout, gradient: world-steps a second.
        exchanges: how many of each the compiled rollout and gradient have.
    """

    scene: str
    devices: int
    rollout: Rate
    gradient: Rate
    exchanges: tuple[dict[str, int], dict[str, int]]


def exchanges(program: str) -> dict[str, int]:
    """How many instructions of an HLO text move data between devices, by kind."""
    found = re.findall(rf" ({'|'.join(EXCHANGES)})(?:-start)?\(", program)
    return dict(Counter(found))


World = Callable[[jax.Array, jc.State], jc.State]
"""(gain, start) → the end of one world."""


def world(name: str, steps: int, dtype: Any) -> tuple[World, jc.State]:
    """The rollout of one world by the gain of its feedback, and a start."""
    system, state = mechanisms.find(name).build(dtype)

    def run(gain: jax.Array, s: jc.State) -> jc.State:
        method = jc.Method(stabilizer=jc.Baumgarte(gain, gain), solver=jc.Sparse())
        dt = jnp.asarray(DT, dtype)
        return jc.rollout(system, method, s, None, dt, steps, record=lambda s, i: None)[0]

    return run, state


def mean(run: World, mesh: Any = None) -> Callable[..., Any]:
    """Value and gradient by the gain of the mean of Σ q² at the end over the worlds of a batch."""
    batch = jc.over_devices(jax.vmap(run, in_axes=(None, 0)), mesh)

    def loss(gain: jax.Array, s: jc.State) -> jax.Array:
        return jnp.mean(jnp.sum(batch(gain, s).q ** 2, axis=1))

    return jax.value_and_grad(loss)


def measure(name: str, batch: int, work: int, repeats: int = 5) -> Scaling:
    """One scene on the devices that there are."""
    steps = max(10, work // batch)
    run, state = world(name, steps, jnp.float32)
    given = jnp.float32(GAIN), jc.shard(worlds(state, batch))
    rates, found = [], []
    for function in (jax.vmap(run, in_axes=(None, 0)), mean(run)):
        compiled, _ = timing.compile_seconds(function, *given)
        jax.block_until_ready(compiled(*given))
        rates.append(timing.rate(lambda run=compiled: run(*given), batch * steps, repeats))
        found.append(exchanges(compiled.as_text()))
    return Scaling(name, jax.device_count(), rates[0], rates[1], (found[0], found[1]))


def elsewhere(name: str, devices: int, given: argparse.Namespace) -> Scaling | str:
    """The same in a process that has so many devices, or why there is nothing."""
    options = ["--batch", str(given.batch), "--work", str(given.work)]
    found = timing.in_process(
        ["benchmarks.devices", "--here", name, *options],
        timing.with_flags(f"{FORCED}={devices}") | {"JAX_PLATFORMS": "cpu"},
        LIMIT,
        "does not compile and run in",
    )
    if isinstance(found, str):
        return found
    rates = {what: Rate(**found.pop(what)) for what in ("rollout", "gradient")}
    return Scaling(**found, **rates)


def line(row: Scaling, first: Scaling) -> str:
    """A row of the table, beside the first of its scene."""
    cells: list[Any] = [row.scene, row.devices]
    for what in ("rollout", "gradient"):
        own, other = getattr(row, what), getattr(first, what)
        cells += [own, f"{own.median / other.median:.2f}"]
    said = [", ".join(f"{n} {what}" for what, n in x.items()) or "none" for x in row.exchanges]
    return "| " + " | ".join(map(str, [*cells, *said])) + " |"


HEAD = """
| scene | devices | rollout, steps/s (min to max) | times | and gradient | times | exchanges | |
|---|---|---|---|---|---|---|---|"""


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["four-bar", "planar-chain-10"])
    parser.add_argument("--devices", type=numbers, default=[1, 2, 4, 8])
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--work", type=int, default=200_000, help="world-steps of a repeat")
    parser.add_argument("--here", metavar="SCENE", help="one scene, in this process, as JSON")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def main() -> None:
    """Prints the table and writes the file."""
    given, rows = arguments(), []
    if given.here:
        print(json.dumps(dataclasses.asdict(measure(given.here, given.batch, given.work))))
        return
    print(timing.machine())
    print(HEAD)
    for name in given.scenes:
        first = None
        for devices in given.devices:
            row = elsewhere(name, devices, given)
            rows.append(row)
            if isinstance(row, str):
                print(f"| {name} | {devices} | {row} |", flush=True)
                continue
            first = first or row
            print(line(row, first), flush=True)
    if given.json:
        result = {"machine": timing.machine(), "batch": given.batch, "rows": timing.plain(rows)}
        given.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
