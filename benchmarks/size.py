"""Cost of a step against size for every solver: time, operations, compilation, and exponents.

    python -m benchmarks.size [--families rope chain …] [--solvers Sparse Dense …] [--batch 16]
        [--seconds 450] [--json FILE] [--picture FILE]

All runs use semi-implicit Euler with Baumgarte in float32 on one device. Each solver runs through
the sizes n of a family (`benchmarks.structures`) in its own process until its share of the time is
spent. The table gives the reason for missing sizes.

Time is that of a step of one world in a batch, the median of three repeats. Cost grows like a power
of n. The exponent is fitted to the last three sizes n ≥ 10. `auto` is the choice of
`jc.Method.auto`. `--batch 0` counts operations without compiling.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import timing
from benchmarks.mjcf import DT
from benchmarks.structures import FAMILIES
from jaxcon.analysis.work import work
from jaxcon.linear import effort
from jaxcon.methods.choice import choose, words

SOLVERS: dict[str, Any] = {
    "Sparse": jc.solvers.Sparse(),
    "RankSafe": jc.solvers.RankSafe(),
    "Schur": jc.solvers.Schur(),
    "Dense": jc.solvers.Dense(),
    "ConjugateGradients": jc.solvers.ConjugateGradients(),
    "Priority": jc.solvers.Priority({}),
}
DENSE = ("Schur", "Dense", "Priority")
DIRECT = ("Sparse", "Schur", "Dense")
AUTO = "auto"
HELD = 3e9
"""Memory limit for the matrices of a batch [B], including the copies of a factorization."""
LEAST = 10
"""Smallest size for the fit of exponents."""
SLOW = 10.0
"""Compile time above which operations are not counted, since counting traces again [s]."""
LONG = 0.03
"""Approximate duration of a repeat [s]."""


def case(family: str, name: str, n: int, batch: int) -> dict[str, Any]:
    """Measures one solver at one size in this process. A batch of 0 only counts operations."""
    system, state = FAMILIES[family].build(n, np.float32)
    rows = jax.eval_shape(lambda s: jc.violation(system, s), state).position.shape[0]
    row: dict[str, Any] = {"n": n, "velocities": len(state.v), "rows": rows}
    if name == AUTO:
        begin = time.perf_counter()
        choice = choose(system, state, max(batch, 1))
        return row | {"takes": words(choice.solver), "chosen": time.perf_counter() - begin}
    if name in DENSE:
        numbers = effort.saddle(len(state.v), rows).numbers
        needed = 3 * numbers * max(batch, 1) * state.q.dtype.itemsize
        if needed > HELD:
            return row | {"stopped": f"its matrices would take {needed / 1e9:.0f} GB"}
    method = jc.Method(solver=SOLVERS[name])
    if batch:
        row |= timed(system, method, state, batch)
    if row.get("compile", 0) < SLOW:  # counting traces the program again
        counted = work(system, method, state)
        row |= {"operations": counted.usual, "instructions": counted.instructions}
    return row


def timed(
    system: jc.extend.System, method: jc.Method, state: jc.State, batch: int
) -> dict[str, Any]:
    """Measures compile time [s] and time of a step per world in a batch [s].

    Failed worlds are counted too.
    """
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), state)
    step = jax.vmap(lambda s: jc.step(system, method, s, None, DT)[0])
    compiled, compile_time = timing.compile_seconds(step, worlds)
    end = compiled(worlds)
    failed = int(np.sum(np.asarray(end.status) != 0))
    return {
        "compile": compile_time,
        "step": seconds(lambda: compiled(worlds)) / batch,
        "failed": failed,
    }


def seconds(run: Any) -> float:
    """Returns the median time of three repeats, each with enough calls to last `LONG` [s]."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    calls = max(1, int(LONG / (time.perf_counter() - begin)))
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready([run() for _ in range(calls)][-1])
        times.append((time.perf_counter() - begin) / calls)
    return float(np.median(times))


def series(
    family: str, name: str, batch: int, limit: float, sizes: tuple[int, ...] = ()
) -> Iterator[dict[str, Any]]:
    """Runs a solver through the sizes of a family until the next would exceed the limit.

    The limit is a total time [s].
    """
    begin, previous = time.perf_counter(), None
    sizes = sizes or FAMILIES[family].sizes
    for n, larger in zip(sizes, (*sizes[1:], None), strict=True):
        start = time.perf_counter()
        row = case(family, name, n, batch)
        yield row
        if "stopped" in row or larger is None:
            return
        elapsed, total = time.perf_counter() - start, time.perf_counter() - begin
        power = (
            0.0 if previous is None else math.log(elapsed / previous[1]) / math.log(n / previous[0])
        )
        predicted = elapsed * (larger / n) ** max(power, 0.0)
        if total + predicted > limit:
            yield {"n": larger, "stopped": f"it would take some {predicted:.0f} s"}
            return
        previous = n, elapsed


def in_process(family: str, name: str, batch: int, limit: float) -> list[dict[str, Any]]:
    """Runs a series in a process that is stopped at the limit [s]. The last row then says so."""
    command = [sys.executable, "-m", "benchmarks.size", "--here", family, name]
    command += ["--batch", str(batch), "--limit", str(limit)]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
        stopped = None
        try:
            process = subprocess.run(
                command, stdout=out, stderr=errors, timeout=limit, cwd=timing.ROOT
            )
            errors.seek(0)
            if process.returncode:
                stopped = f"fails: {(errors.read().strip().splitlines() or ['?'])[-1]}"
        except subprocess.TimeoutExpired:
            stopped = f"over {limit:.0f} s"
        out.seek(0)
        lines = out.read().splitlines()
    rows = [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
    if stopped:
        reached = {row["n"] for row in rows}
        remaining = [n for n in FAMILIES[family].sizes if n not in reached]  # empty: all rows done
        rows += [{"n": remaining[0], "stopped": stopped}] if remaining else []
    return rows


def exponent(rows: list[dict[str, Any]], what: str) -> float | None:
    """Returns the exponent p of the growth ~ n^p of a column `what` of the rows.

    It is fitted to the last three sizes n ≥ `LEAST`, and None for fewer than two.
    """
    pairs = [(row["n"], row[what]) for row in rows if row.get(what) and row["n"] >= LEAST][-3:]
    if len(pairs) < 2:
        return None
    n, y = np.log(np.array(pairs, float)).T
    return float(np.polyfit(n, y, 1)[0])


def table(family: str, results: dict[str, list[dict[str, Any]]]) -> str:
    """Formats the results of a family by size and solver.

    A cell has time and compile time, or operations. The last rows have the exponents.
    """
    names = [name for name in results if name != AUTO]
    lines = [f"**{family}**: {FAMILIES[family].says}", ""]
    lines += [f"| n | rows | {' | '.join(names)} | auto |", "|---" * (len(names) + 3) + "|"]
    for n in sorted({row["n"] for rows in results.values() for row in rows}):
        row_of = {name: next((r for r in results[name] if r["n"] == n), {}) for name in results}
        count_of = next((r["rows"] for r in row_of.values() if "rows" in r), "")
        cells = " | ".join(shown(row_of[name]) for name in names)
        lines.append(f"| {n} | {count_of} | {cells} | {row_of.get(AUTO, {}).get('takes', '')} |")
    for what, label in (("step", "time"), ("operations", "operations"), ("compile", "compilation")):
        powers = [exponent(results[name], what) for name in names]
        cells = " | ".join("" if p is None else f"{p:.2f}" for p in powers)
        lines += [f"| exponent of {label} | | {cells} | |"] if any(powers) else []
    return "\n".join([*lines, ""])


def shown(row: dict[str, Any]) -> str:
    """Formats a time with its compile time, or the reason why there is none."""
    if "stopped" in row:
        return row["stopped"]
    if "step" not in row:
        return f"{row['operations']:.3g}" if "operations" in row else ""
    bad = ", refused" if row["failed"] else ""
    return f"{1e6 * row['step']:.3g} µs ({row['compile']:.1f} s{bad})"


def picture(results: dict[str, Any], file: str, what: str = "step") -> None:
    """Plots time or operations of a step against n, one log-log plot per family."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scale, unit = (1e6, "µs a step") if what == "step" else (1.0, "operations a step")
    columns = math.ceil(len(results) / 2)
    figure, panels = plt.subplots(2, columns, figsize=(4 * columns, 7), squeeze=False)
    for axes, (family, solvers) in zip(panels.flat, results.items(), strict=False):
        for name, rows in solvers.items():
            pairs = [(r["n"], scale * r[what]) for r in rows if what in r]
            if pairs:
                axes.loglog(*zip(*pairs, strict=True), marker="o", label=name)
        axes.set(title=f"{family}: {FAMILIES[family].says}", xlabel="n", ylabel=unit)
        axes.title.set_fontsize(9)
        axes.grid(alpha=0.3)
    panels.flat[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Measures every family and solver. Time that a solver leaves unused goes to later solvers."""
    names = [AUTO, *options.solvers]
    tasks, end = len(options.families) * len(names), time.perf_counter() + options.seconds
    results: dict[str, Any] = {}
    for family in options.families:
        solvers = results[family] = {}
        for name in names:
            remaining = end - time.perf_counter()
            limit = max(1.0, min(remaining, 3 * remaining / tasks))
            if options.batch:
                solvers[name] = in_process(family, name, options.batch, limit)
            else:
                solvers[name] = list(series(family, name, 0, limit))
            tasks -= 1
        print(table(family, solvers), flush=True)
    return results


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES), choices=list(FAMILIES))
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=list(SOLVERS))
    parser.add_argument("--batch", type=int, default=16, help="0 counts operations only")
    parser.add_argument("--seconds", type=float, default=450.0, help="approximate total time [s]")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", metavar="FILE")
    parser.add_argument("--here", nargs=2, metavar=("FAMILY", "SOLVER"), help="run in this process")
    parser.add_argument("--limit", type=float, default=60.0, help="time limit of --here [s]")
    return parser.parse_args(given)


def main() -> None:
    """Prints a table per family, and writes the results and the picture."""
    options = arguments()
    if options.here:
        family, name = options.here
        for row in series(family, name, options.batch, options.limit):
            print(json.dumps(timing.plain(row)), flush=True)
        return
    print(timing.machine())
    results = measure(options)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "families": results}
        options.json.write_text(json.dumps(timing.plain(result), indent=1) + "\n")
    if options.picture:
        picture(results, options.picture, "step" if options.batch else "operations")


if __name__ == "__main__":
    main()
