"""Throughput of jaxcon under jit(vmap(rollout)), compared with MuJoCo in C and MJX.

    python -m benchmarks.throughput [--scenes chain-10 …] [--batches 1,256,1024] [--peers]
        [--dtypes float32,float64] [--solver Sparse] [--json FILE]

Runs use semi-implicit Euler with Baumgarte at 2 ms, record nothing and exclude compilation. The
batch is sharded over one device per core, as for MJX; MuJoCo has one thread per core. Each row also
shows constraint violation and error of a run of one second. A rate is compared with MuJoCo and MJX
only if both are small enough (`benchmarks.accuracy`). The best batch size represents a scene. The
last table relates the rates to the operations of a step (`benchmarks.roofline`).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import accuracy, mechanisms, peers, roofline, tables, targets, timing
from benchmarks.mjcf import DT
from benchmarks.tables import Row
from benchmarks.timing import Rate

WORK = 200_000
"""Approximate number of world-steps in one call, which takes 10 to 1000 steps of all worlds."""


def run_batch(
    name: str, method: jc.Method, dtype: DTypeLike, batch: int, work: int = WORK, repeats: int = 5
) -> tuple[Rate, float]:
    """Measures the rate at one batch size, and the compile time of the rollout [s]."""
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        system, state = mechanisms.find(name).build(dtype)
        steps = int(np.clip(work // batch, 10, 1000))

        def run(s: jc.State) -> jc.State:
            return jc.rollout(system, method, s, None, DT, steps, record=lambda s, i: None)[0]

        states = timing.over_devices(worlds(state, batch), batch)
        compiled, seconds = timing.compile_seconds(jax.vmap(run), states)
        jax.block_until_ready(compiled(states))
        return timing.rate(lambda: compiled(states), batch * steps, repeats), seconds


def method_of(name: str, solver: str) -> jc.Method:
    """Returns semi-implicit Euler with Baumgarte, regularized if the scene needs it."""
    share = targets.TIKHONOV.get(name)
    options = {} if share is None else {"tikhonov": share}
    return jc.Method(solver=getattr(jc.solvers, solver)(**options))


def worlds(state: jc.State, batch: int) -> jc.State:
    """Returns a batch of states with the initial speeds that MuJoCo and MJX use."""
    speeds = jax.numpy.asarray(peers.speeds(batch), state.v.dtype)

    def scaled(speed: jax.Array) -> jc.State:
        return dataclasses.replace(state, v=speed * state.v)

    return jax.vmap(scaled)(speeds)


def measure(name: str, dtype: str, options: argparse.Namespace) -> Row:
    """Measures one scene in one precision, with the options of the command line."""
    method = method_of(name, options.solver)
    rates, compile_times = {}, {}
    for batch in options.batches:
        result = run_batch(name, method, dtype, batch, options.work, options.repeats)
        rates[batch], compile_times[batch] = result
    return Row(
        name,
        dtype,
        rates,
        compile_times,
        accuracy.measure(name, method, dtype),
        roofline.work(name, method, dtype),
        peers.mujoco_rate(name, repeats=options.repeats) if options.peers else None,
        peers.mjx(name, limit=options.mjx_seconds) if options.peers else None,
        peers.mujoco_rate(name, 1, 0.2, options.repeats, threads=1) if options.peers else None,
    )


def as_json(rows: list[Row], solver: str) -> dict[str, Any]:
    """Returns the results of all scenes, with derived ratios and verdicts, as JSON data."""
    results = []
    for row in rows:
        derived = {"over_c": row.over_c, "over_mjx": row.over_mjx, "share_of_peak": row.share}
        derived["behind_alone"] = row.behind_alone
        derived |= {"counts": row.accuracy.counts, "verdict": tables.verdict(row)}
        results.append(timing.plain(row) | derived)
    peaks = {dtype: roofline.peak(dtype) for dtype in {row.dtype for row in rows}}
    return {"machine": timing.machine(), "solver": solver, "peak": peaks, "rows": results}


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(targets.SCENES))
    parser.add_argument("--batches", type=numbers, default=[1, 256, 1024, 4096])
    parser.add_argument("--dtypes", type=lambda text: text.split(","), default=["float32"])
    parser.add_argument("--solver", default="Sparse", choices=["Sparse", "Schur"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--work", type=int, default=WORK, help="world-steps per call")
    parser.add_argument("--peers", action="store_true", help="run MuJoCo and MJX too")
    parser.add_argument("--mjx-seconds", type=float, default=240.0, help="time limit of MJX [s]")
    parser.add_argument("--json", type=Path)
    return parser.parse_args(given)


def numbers(text: str) -> list[int]:
    """Splits a comma-separated list of integers."""
    return [int(x) for x in text.split(",")]


def main() -> None:
    """Prints the tables of rates, comparison and operations, and writes the file of `--json`."""
    options, rows = arguments(), []
    timing.use_all_cores()
    print(timing.machine())
    print(tables.HEAD)
    for name in options.scenes:
        for dtype in options.dtypes:
            rows.append(measure(name, dtype, options))
            print("\n".join(tables.lines(rows[-1])), flush=True)
    print("\n".join([tables.AGAINST, *map(tables.against, rows)]))
    print("\n".join([tables.ROOFLINE, *map(tables.roof, rows)]))
    if options.json:
        options.json.write_text(json.dumps(as_json(rows, options.solver), indent=1) + "\n")


if __name__ == "__main__":
    main()
