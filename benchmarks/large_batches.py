"""Rates of large batches by a plain `jit(vmap(rollout))`, beside chunks and shards by hand.

    python -m benchmarks.large_batches [--scenes four-bar …] [--batches 1024,16384] [--gradients]

Each core is a device (`jc.use_all_cores`), and the batch lies over all of them (`jc.shard`). The
plain program leaves chunks to the library. The program by hand maps a rollout over chunks with
`jax.lax.map`, on each device by itself (`jc.devices.over_devices`), with the best of several chunk
sizes. A gradient is that of the sum of squares of the last positions, by the initial velocities.

All runs are in float32, by `jc.Method()` at 2 ms, and keep no trajectory. Rates are medians and
exclude compilation.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import devices, mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.throughput import worlds

SCENES = "pendulum", "four-bar", "planar-chain-10", "chain-5", "chain-10"
SIZES = 32, 64, 128, 256, 512
"""Sizes of chunks by hand, for each device."""
WORK = 800_000
"""World-steps of a run."""


@dataclass(frozen=True)
class Compared:
    """Rates of a scene and a batch.

    Attributes:
        scene: name of the scene.
        batch: number of worlds.
        plain: rate of the plain program [M steps/s].
        by_hand: chunk size by hand → rate [M steps/s].
        seconds: compile time of the plain program [s].
        exchanges: operations across devices in the plain program.
    """

    scene: str
    batch: int
    plain: float
    by_hand: dict[int, float]
    seconds: float
    exchanges: dict[str, int]

    @property
    def ratio(self) -> float:
        """The rate of the plain program over the best rate by hand."""
        return self.plain / max(self.by_hand.values())


def compare(
    scene: str, batch: int, gradients: bool = False, sizes: tuple[int, ...] = SIZES
) -> Compared:
    """Measures a scene with the devices of this process."""
    system, state = mechanisms.find(scene).build(np.float32)
    steps = int(np.clip(WORK // batch, 10, 400))
    states = jc.shard(worlds(state, batch))

    def end(state: jc.State) -> jc.State:
        return jc.rollout(
            system, jc.Method(), state, None, DT, steps, record=lambda state, info: None
        )[0]

    def slope(state: jc.State) -> jax.Array:
        def size(v: jax.Array) -> jax.Array:
            return jnp.sum(end(dataclasses.replace(state, v=v)).q ** 2)

        return jax.grad(size)(state.v)

    run: Callable[..., Any] = jax.vmap(slope if gradients else end)

    def in_chunks(size: int) -> Callable[..., Any]:
        def parts(_: Any, part: Any) -> Any:
            chunk = min(size, part.time.shape[0])
            cut = jax.tree.map(lambda x: x.reshape(-1, chunk, *x.shape[1:]), part)
            after = jax.lax.map(run, cut)
            return jax.tree.map(lambda y: y.reshape(-1, *y.shape[2:]), after)

        return jc.devices.over_devices(parts)

    def rate(compiled: Callable[..., Any], *args: Any) -> float:
        return timing.rate(lambda: compiled(*args), batch * steps / 1e6).median

    compiled, seconds = timing.compile_seconds(run, states)
    exchanges = devices.exchanges(compiled.as_text())
    plain = rate(compiled, states)
    fitting = [size for size in sizes if size <= batch // jax.device_count()]
    by_hand = {size: rate(jax.jit(in_chunks(size)), (), states) for size in fitting}
    return Compared(scene, batch, plain, by_hand, seconds, exchanges)


def study(scenes: tuple[str, ...], batches: tuple[int, ...], gradients: bool) -> Iterator[Compared]:
    """Compares scenes and batches."""
    for scene in scenes:
        for batch in batches:
            yield compare(scene, batch, gradients)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        "benchmarks.large_batches",
        None,
        __doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--batches", default="1024,16384")
    parser.add_argument("--gradients", action="store_true")
    options = parser.parse_args()
    count = jc.use_all_cores()
    print(f"{count} devices; rates in M steps/s")
    print("| scene | worlds | plain | by hand, chunk | plain / by hand | compile, s | exchanges |")
    print("|---|---|---|---|---|---|---|")
    batches = tuple(map(int, options.batches.split(",")))
    for x in study(tuple(options.scenes), batches, options.gradients):
        size, best = max(x.by_hand.items(), key=lambda item: item[1])
        print(
            f"| {x.scene} | {x.batch:,} | {x.plain:.3g} | {best:.3g}, {size} | {x.ratio:.2f} |"
            f" {x.seconds:.1f} | {sum(x.exchanges.values())} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
