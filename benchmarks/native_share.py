"""Speed of plain `jit(vmap(rollout))` relative to batch-last steps; it must be at least 0.8.

    python -m benchmarks.native_share [--scenes chain-10 …] [--batch 512] [--dtype float32]
        [--json FILE]

The comparison program runs the same steps without vmap: the batch axis is last throughout, and a
scan calls the step on the whole batch. Both programs run on one device per core and take the same
number of steps. Repeats alternate, so that a change in the machine's speed affects both.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms, targets, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import WORK, method_of, worlds
from benchmarks.timing import Rate
from jaxcon.execution.shell import masked_step
from jaxcon.staging import batch_last

SHARE = 0.8
"""Required rate of plain vmap over that of batch-last steps."""

Run = Callable[[jc.State], jc.State]


@dataclass(frozen=True)
class Share:
    """Rates of one scene.

    Attributes:
        scene: name of the scene.
        plain: world-steps per second by vmap.
        native: world-steps per second of batch-last steps.
        ratios: minimum, median and maximum over the repeats of plain / native.
    """

    scene: str
    plain: Rate
    native: Rate
    ratios: tuple[float, float, float]

    @property
    def verdict(self) -> str:
        """Returns "passes" if plain vmap reaches `SHARE`, otherwise "below"."""
        return "passes" if self.ratios[1] >= SHARE else "below"


def plain(system: jc.extend.System, method: jc.Method, steps: int) -> Run:
    """Returns a rollout of a batch along the first axis, by vmap."""

    def run(state: jc.State) -> jc.State:
        return jc.rollout(system, method, state, None, DT, steps, record=lambda s, i: None)[0]

    return jax.vmap(run)


def by_hand(system: jc.extend.System, method: jc.Method, steps: int) -> Run:
    """Returns a rollout of a batch along the last axis, without vmap.

    Arrays that all worlds share get a last axis of length 1.
    """

    def step_batch(state: jc.State, shared: Any) -> tuple[jc.State, None]:
        system, method, dt = shared
        return batch_last.call(masked_step, system, method, state, None, dt)[0], None

    def run(state: jc.State) -> jc.State:
        dt = jnp.asarray(DT, state.q.dtype)
        shared = jax.tree.map(lambda x: jnp.asarray(x)[..., None], (system, method, dt))
        return jax.lax.scan(lambda s, _: step_batch(s, shared), state, None, steps)[0]

    return run


def turned(states: jc.State, last: bool = True) -> jc.State:
    """Moves the batch axis of states from first to last, or back."""
    source, target = (0, -1) if last else (-1, 0)
    return jax.jit(lambda s: jax.tree.map(lambda x: jnp.moveaxis(x, source, target), s))(states)


def measure(name: str, batch: int, dtype: DTypeLike, work: int = WORK, repeats: int = 9) -> Share:
    """Measures the rates of both programs on one scene."""
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        system, state = mechanisms.find(name).build(dtype)
        method = method_of(name, "Sparse")
        steps = int(np.clip(work // batch, 10, 1000))
        first = timing.over_devices(worlds(state, batch), batch)
        starts = first, turned(first)
        runs = [
            timing.compile_seconds(make(system, method, steps), start)[0]
            for make, start in zip((plain, by_hand), starts, strict=True)
        ]
        calls = [functools.partial(*pair) for pair in zip(runs, starts, strict=True)]
        rates = timing.in_turn(calls, batch * steps, repeats + 1)[1:]  # the first repeat warms up
    ratios = rates[:, 0] / rates[:, 1]
    plain_rate, by_hand_rate, share = map(spread, (*rates.T, ratios))
    return Share(name, Rate(*plain_rate), Rate(*by_hand_rate), (share[1], share[0], share[2]))


def spread(x: np.ndarray) -> tuple[float, float, float]:
    """Returns median, minimum and maximum."""
    return float(np.median(x)), float(np.min(x)), float(np.max(x))


def main() -> None:
    """Prints the table of rates and ratios, and writes the file of `--json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(targets.SCENES))
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--dtype", default="float32")
    parser.add_argument("--work", type=int, default=WORK, help="world-steps per call")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    timing.use_all_cores()
    print(timing.machine())
    print("| scene | jit(vmap(rollout)) | by hand | ratio (min to max) | verdict |")
    print("|---|---|---|---|---|")
    rows = []
    for name in options.scenes:
        row = measure(name, options.batch, options.dtype, options.work, options.repeats)
        rows.append(timing.plain(row) | {"verdict": row.verdict})
        low, median, high = row.ratios
        ratio = f"{median:.2f} ({low:.2f} to {high:.2f})"
        print(f"| {name} | {row.plain} | {row.native} | {ratio} | {row.verdict} |", flush=True)
    if options.json:
        result = {"machine": timing.machine(), "batch": options.batch, "dtype": options.dtype}
        options.json.write_text(json.dumps(result | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
