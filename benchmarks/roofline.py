"""Operations of one step counted from its jaxpr, and the elementwise peak of the machine.

    python -m benchmarks.roofline [--scenes chain-10 …]

What counts as an operation is said in `jaxcon.core.operations`. The peak is what XLA reaches on
fused multiply-adds of an array that lies in the cache, two operations each, spread over all devices
as the worlds are whose rates it is compared with.
"""

from __future__ import annotations

import argparse
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.targets import SCENES
from jaxcon.analysis import work as analysis


@dataclass(frozen=True)
class Work:
    """What one step of one world takes.

    Attributes:
        operations: arithmetic, of floating-point numbers.
        state: size of the state [B].
    """

    operations: float
    state: int


def work(name: str, method: jc.Method, dtype: Any) -> Work:
    """Of a step of a mechanism."""
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        system, state = mechanisms.find(name).build(dtype)
        operations = analysis.work(system, method, state).operations
    return Work(operations, sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)))


@functools.cache
def peak(dtype: str = "float32") -> float:
    """Operations a second of fused multiply-adds in the cache, the best of several shapes."""
    with jax.enable_x64(dtype == "float64"):
        sizes = [(1 << bits, depth) for bits in (10, 12, 14, 18) for depth in (8, 32)]
        return max(multiply_adds(size, depth, dtype) for size, depth in sizes)


def multiply_adds(size: int, depth: int, dtype: str) -> float:
    """Operations a second of x ← a x + b, `depth` of them to each pass over an array.

    Args:
        size: of the part of the array on each device.
        depth: multiply-adds of each number in a pass.
        dtype: of the array.
    """
    passes = max(1, (1 << 27) // (size * depth))
    start, run = over_all(size, dtype), sweeps(depth, passes)
    run(start).block_until_ready()
    return timing.rate(lambda: run(start), 2.0 * start.size * depth * passes, repeats=3).most


def sweeps(depth: int, passes: int) -> Any:
    """The compiled function that does so many to each number in each of its passes."""

    def sweep(x: jax.Array, _: Any) -> tuple[jax.Array, None]:
        for _ in range(depth):
            x = x * 0.999 + 0.001
        return x, None

    return jax.jit(lambda x: jax.lax.scan(sweep, x, None, passes)[0])


def over_all(size: int, dtype: str) -> jax.Array:
    """Numbers, so many on each device."""
    whole = size * jax.device_count()
    return timing.over_devices(jnp.linspace(0.5, 1.5, whole, dtype=dtype), whole)


def main() -> None:
    """Prints the operations and bytes of each scene, and the peak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    scenes, method = parser.parse_args().scenes, jc.Method(solver=jc.Sparse())
    timing.use_all_cores()
    devices = f"{jax.device_count()} devices, {timing.cores()} cores"
    print(f"peak {peak() / 1e9:.1f} G float32 operations a second, {devices}")
    for name in scenes:
        found = work(name, method, np.float32)
        print(f"{name:18s} {found.operations:9.0f} operations a step, {found.state:6d} B of state")


if __name__ == "__main__":
    main()
