"""World-steps a second of jaxcon under jit(vmap(rollout)), beside MuJoCo in C and MJX.

    python -m benchmarks.throughput [--scenes chain-10 …] [--batches 1,256,1024] [--peers]
        [--dtypes float32,float64] [--solver Sparse] [--json FILE]

Semi-implicit Euler with Baumgarte at 2 ms, nothing recorded, compilation apart; the batch lies over
one device a core, as that of MJX does, and MuJoCo has a thread a core. Each row also says
how well a run of one second holds its constraints and how far off it ends; a rate is judged against
the peers only where that is good enough (`benchmarks.accuracy`), and the best batch stands for a
scene. The last table relates the rates to the operations of a step (`benchmarks.roofline`).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxcon as jc
from benchmarks import accuracy, mechanisms, peers, roofline, tables, targets, timing
from benchmarks.mjcf import DT
from benchmarks.tables import Row
from benchmarks.timing import Rate

WORK = 200_000
"""World-steps of one call, about; at least ten steps of all worlds, at most a thousand."""


def run_batch(
    name: str, method: jc.Method, dtype: Any, batch: int, work: int = WORK, repeats: int = 5
) -> tuple[Rate, float]:
    """The rate of one batch, and how long the rollout took to compile [s]."""
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
    """Semi-implicit Euler with Baumgarte, regularised where the scene needs it."""
    share = targets.TIKHONOV.get(name)
    return jc.Method(solver=getattr(jc, solver)(**({} if share is None else {"tikhonov": share})))


def worlds(state: jc.State, batch: int) -> jc.State:
    """A batch of starts that differ as those of the peers do."""
    speeds = jax.numpy.asarray(peers.speeds(batch), state.v.dtype)

    def one(speed: jax.Array) -> jc.State:
        return dataclasses.replace(state, v=speed * state.v)

    return jax.vmap(one)(speeds)


def measure(name: str, dtype: str, options: argparse.Namespace) -> Row:
    """One scene at one precision, with what the options ask for."""
    method = method_of(name, options.solver)
    rates, compiling = {}, {}
    for batch in options.batches:
        found = run_batch(name, method, dtype, batch, options.work, options.repeats)
        rates[batch], compiling[batch] = found
    return Row(
        name,
        dtype,
        rates,
        compiling,
        accuracy.measure(name, method, dtype),
        roofline.work(name, method, dtype),
        peers.mujoco_rate(name, repeats=options.repeats) if options.peers else None,
        peers.mjx(name, limit=options.mjx_seconds) if options.peers else None,
        peers.mujoco_rate(name, 1, 0.2, options.repeats, threads=1) if options.peers else None,
    )


def as_json(rows: list[Row], solver: str) -> dict[str, Any]:
    """Everything that was measured."""
    found = []
    for row in rows:
        derived = {"over_c": row.over_c, "over_mjx": row.over_mjx, "share_of_peak": row.share}
        derived["behind_alone"] = row.behind_alone
        derived |= {"counts": row.accuracy.counts, "verdict": tables.verdict(row)}
        found.append(timing.plain(row) | derived)
    peaks = {dtype: roofline.peak(dtype) for dtype in {row.dtype for row in rows}}
    return {"machine": timing.machine(), "solver": solver, "peak": peaks, "rows": found}


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(targets.SCENES))
    parser.add_argument("--batches", type=numbers, default=[1, 256, 1024, 4096])
    parser.add_argument("--dtypes", type=lambda text: text.split(","), default=["float32"])
    parser.add_argument("--solver", default="Sparse", choices=["Sparse", "Schur"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--work", type=int, default=WORK, help="world-steps of a call")
    parser.add_argument("--peers", action="store_true", help="run MuJoCo and MJX too")
    parser.add_argument("--mjx-seconds", type=float, default=240.0, help="limit of a batch of MJX")
    parser.add_argument("--json", type=Path)
    return parser.parse_args(given)


def numbers(text: str) -> list[int]:
    """Of a list with commas."""
    return [int(x) for x in text.split(",")]


def main() -> None:
    """Prints the tables and writes the file."""
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
