"""Cost of a step against size for every solver: time, operations, compilation, and exponents.

    python -m benchmarks.size [--families rope chain …] [--solvers Sparse Dense …] [--batch 16]
        [--seconds 450] [--json FILE] [--picture FILE]

Semi-implicit Euler with Baumgarte in float32, one device. Each solver goes through the sizes of a
family (`benchmarks.structures`) in a process of its own until its share of the time is spent; what
it did not reach, and why, is said. Time is that of a step of one world in a batch, the median of
three. The exponent is that of n from the last three sizes from ten on. `auto` is what
`jc.Method.auto` takes. `--batch 0` counts operations and compiles nothing.
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
from jaxcon.simulation.choice import choose, words
from jaxcon.solvers import effort

SOLVERS: dict[str, Any] = {
    "Sparse": jc.Sparse(),
    "RankSafe": jc.RankSafe(),
    "Schur": jc.Schur(),
    "Dense": jc.Dense(),
    "ConjugateGradients": jc.ConjugateGradients(),
    "Priority": jc.Priority({}),
}
DENSE = ("Schur", "Dense", "Priority")
DIRECT = ("Sparse", "Schur", "Dense")
AUTO = "auto"
HELD = 3e9
"""What the matrices of a batch may take [B], with room for the copies of a factorization."""
LEAST = 10
"""Sizes from which on exponents are fitted."""
SLOW = 10.0
"""Compilations from which on operations are not counted as well [s]."""
LONG = 0.03
"""What one repeat takes, about [s]."""


def case(family: str, name: str, n: int, batch: int) -> dict[str, Any]:
    """One solver on one size, in this process; operations alone where the batch is none."""
    system, state = FAMILIES[family].build(n, np.float32)
    rows = jax.eval_shape(lambda s: jc.violation(system, s), state).position.shape[0]
    found: dict[str, Any] = {"n": n, "velocities": len(state.v), "rows": rows}
    if name == AUTO:
        begin = time.perf_counter()
        choice = choose(system, state, max(batch, 1))
        return found | {"takes": words(choice.solver), "chosen": time.perf_counter() - begin}
    if name in DENSE:
        numbers = effort.saddle(len(state.v), rows).numbers
        held = 3 * numbers * max(batch, 1) * state.q.dtype.itemsize
        if held > HELD:
            return found | {"stopped": f"its matrices would take {held / 1e9:.0f} GB"}
    method = jc.Method(solver=SOLVERS[name])
    if batch:
        found |= timed(system, method, state, batch)
    if found.get("compile", 0) < SLOW:  # counting traces once more
        counted = work(system, method, state)
        found |= {"operations": counted.usual, "instructions": counted.instructions}
    return found


def timed(system: Any, method: jc.Method, state: jc.State, batch: int) -> dict[str, Any]:
    """Compilation and a step of one world in a batch [s], and how many worlds failed."""
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), state)
    step = jax.vmap(lambda s: jc.step(system, method, s, None, DT)[0])
    compiled, spent = timing.compile_seconds(step, worlds)
    end = compiled(worlds)
    failed = int(np.sum(np.asarray(end.status) != 0))
    return {"compile": spent, "step": seconds(lambda: compiled(worlds)) / batch, "failed": failed}


def seconds(run: Any) -> float:
    """The median of three repeats, each as many calls as take long enough [s]."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    calls = max(1, int(LONG / (time.perf_counter() - begin)))
    spent = []
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready([run() for _ in range(calls)][-1])
        spent.append((time.perf_counter() - begin) / calls)
    return float(np.median(spent))


def series(
    family: str, name: str, batch: int, limit: float, sizes: tuple[int, ...] = ()
) -> Iterator[dict[str, Any]]:
    """A solver through the sizes of a family, until the next would be over the limit [s]."""
    begin, before = time.perf_counter(), None
    sizes = sizes or FAMILIES[family].sizes
    for n, larger in zip(sizes, (*sizes[1:], None), strict=True):
        start = time.perf_counter()
        found = case(family, name, n, batch)
        yield found
        if "stopped" in found or larger is None:
            return
        spent, total = time.perf_counter() - start, time.perf_counter() - begin
        grows = 0.0 if before is None else math.log(spent / before[1]) / math.log(n / before[0])
        foreseen = spent * (larger / n) ** max(grows, 0.0)
        if total + foreseen > limit:
            yield {"n": larger, "stopped": f"it would take some {foreseen:.0f} s"}
            return
        before = n, spent


def in_process(family: str, name: str, batch: int, limit: float) -> list[dict[str, Any]]:
    """The same in a process that is ended at the limit; the last row says so."""
    command = [sys.executable, "-m", "benchmarks.size", "--here", family, name]
    command += ["--batch", str(batch), "--limit", str(limit)]
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
        stopped = None
        try:
            done = subprocess.run(
                command, stdout=out, stderr=errors, timeout=limit, cwd=timing.ROOT
            )
            errors.seek(0)
            if done.returncode:
                stopped = f"fails: {(errors.read().strip().splitlines() or ['?'])[-1]}"
        except subprocess.TimeoutExpired:
            stopped = f"over {limit:.0f} s"
        out.seek(0)
        lines = out.read().splitlines()
    found = [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
    if stopped:
        reached = {row["n"] for row in found}
        later = [n for n in FAMILIES[family].sizes if n not in reached]  # none if it only ends late
        found += [{"n": later[0], "stopped": stopped}] if later else []
    return found


def exponent(rows: list[dict[str, Any]], what: str) -> float | None:
    """p of what ~ n^p, from the last three sizes from ten on; None from fewer than two."""
    known = [(row["n"], row[what]) for row in rows if row.get(what) and row["n"] >= LEAST][-3:]
    if len(known) < 2:
        return None
    n, y = np.log(np.array(known, float)).T
    return float(np.polyfit(n, y, 1)[0])


def table(family: str, found: dict[str, list[dict[str, Any]]]) -> str:
    """A family by size and solver: time of a step and of its compilation, or its operations."""
    names = [name for name in found if name != AUTO]
    lines = [f"**{family}**: {FAMILIES[family].says}", ""]
    lines += [f"| n | rows | {' | '.join(names)} | auto |", "|---" * (len(names) + 3) + "|"]
    for n in sorted({row["n"] for rows in found.values() for row in rows}):
        at = {name: next((r for r in found[name] if r["n"] == n), {}) for name in found}
        count_of = next((r["rows"] for r in at.values() if "rows" in r), "")
        cells = " | ".join(shown(at[name]) for name in names)
        lines.append(f"| {n} | {count_of} | {cells} | {at.get(AUTO, {}).get('takes', '')} |")
    for what, said in (("step", "time"), ("operations", "operations"), ("compile", "compilation")):
        powers = [exponent(found[name], what) for name in names]
        cells = " | ".join("" if p is None else f"{p:.2f}" for p in powers)
        lines += [f"| exponent of {said} | | {cells} | |"] if any(powers) else []
    return "\n".join([*lines, ""])


def shown(row: dict[str, Any]) -> str:
    """A time and that of its compilation, or why there is none."""
    if "stopped" in row:
        return row["stopped"]
    if "step" not in row:
        return f"{row['operations']:.3g}" if "operations" in row else ""
    bad = ", refused" if row["failed"] else ""
    return f"{1e6 * row['step']:.3g} µs ({row['compile']:.1f} s{bad})"


def picture(found: dict[str, Any], file: str, what: str = "step") -> None:
    """Time of a step, or its operations, against n, one plot a family, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scale, unit = (1e6, "µs a step") if what == "step" else (1.0, "operations a step")
    across = math.ceil(len(found) / 2)
    figure, places = plt.subplots(2, across, figsize=(4 * across, 7), squeeze=False)
    for axes, (family, solvers) in zip(places.flat, found.items(), strict=False):
        for name, rows in solvers.items():
            known = [(r["n"], scale * r[what]) for r in rows if what in r]
            if known:
                axes.loglog(*zip(*known, strict=True), marker="o", label=name)
        axes.set(title=f"{family}: {FAMILIES[family].says}", xlabel="n", ylabel=unit)
        axes.title.set_fontsize(9)
        axes.grid(alpha=0.3)
    places.flat[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Every family and solver; what a solver does not use of its share is there for the others."""
    names = [AUTO, *options.solvers]
    left, end = len(options.families) * len(names), time.perf_counter() + options.seconds
    found: dict[str, Any] = {}
    for family in options.families:
        own = found[family] = {}
        for name in names:
            rest = end - time.perf_counter()
            limit = max(1.0, min(rest, 3 * rest / left))
            if options.batch:
                own[name] = in_process(family, name, options.batch, limit)
            else:
                own[name] = list(series(family, name, 0, limit))
            left -= 1
        print(table(family, own), flush=True)
    return found


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES), choices=list(FAMILIES))
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=list(SOLVERS))
    parser.add_argument("--batch", type=int, default=16, help="0 to count operations alone")
    parser.add_argument("--seconds", type=float, default=450.0, help="that all may take, about")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", metavar="FILE")
    parser.add_argument("--here", nargs=2, metavar=("FAMILY", "SOLVER"), help="in this process")
    parser.add_argument("--limit", type=float, default=60.0, help="of that process [s]")
    return parser.parse_args(given)


def main() -> None:
    """Prints the tables, and writes the file and the picture."""
    options = arguments()
    if options.here:
        family, name = options.here
        for row in series(family, name, options.batch, options.limit):
            print(json.dumps(timing.plain(row)), flush=True)
        return
    print(timing.machine())
    found = measure(options)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "families": found}
        options.json.write_text(json.dumps(timing.plain(result), indent=1) + "\n")
    if options.picture:
        picture(found, options.picture, "step" if options.batch else "operations")


if __name__ == "__main__":
    main()
