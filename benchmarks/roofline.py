"""Operations of one step, counted from its jaxpr, and the elementwise peak of the machine.

    python -m benchmarks.roofline [--scenes chain-10 …]

`jaxcon.staging.operations` defines what counts as an operation. The peak is the rate of XLA on
fused multiply-adds of an array in the cache, two operations each. The array is sharded over all
devices, as the worlds of the throughput benchmarks are.
"""

from __future__ import annotations

import argparse
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.targets import SCENES
from jaxcon.analysis import work as analysis


@dataclass(frozen=True)
class Work:
    """Work and memory of one step of one world.

    Attributes:
        operations: floating-point operations.
        state: size of the state [B].
    """

    operations: float
    state: int


def work(name: str, method: jc.Method, dtype: DTypeLike) -> Work:
    """Counts the operations of a step of a mechanism, and the size of its state."""
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        system, state = mechanisms.find(name).build(dtype)
        operations = analysis.work(system, method, state).operations
    return Work(operations, sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)))


@functools.cache
def peak(dtype: str = "float32") -> float:
    """Measures operations per second of fused multiply-adds in the cache.

    The result is the best of several array shapes.
    """
    with jax.enable_x64(dtype == "float64"):
        sizes = [(1 << bits, depth) for bits in (10, 12, 14, 18) for depth in (8, 32)]
        return max(multiply_adds(size, depth, dtype) for size, depth in sizes)


def multiply_adds(size: int, depth: int, dtype: str) -> float:
    """Measures operations per second of x ← a x + b, applied `depth` times per pass over an array.

    Args:
        size: array size per device.
        depth: multiply-adds of each entry per pass.
        dtype: dtype of the array.
    """
    passes = max(1, (1 << 27) // (size * depth))
    start, run = over_all(size, dtype), sweeps(depth, passes)
    run(start).block_until_ready()
    return timing.rate(lambda: run(start), 2.0 * start.size * depth * passes, repeats=3).most


def sweeps(depth: int, passes: int) -> Any:
    """Returns a compiled function that makes `passes` passes of `depth` multiply-adds."""

    def sweep(x: jax.Array, _: Any) -> tuple[jax.Array, None]:
        for _ in range(depth):
            x = x * 0.999 + 0.001
        return x, None

    return jax.jit(lambda x: jax.lax.scan(sweep, x, None, passes)[0])


def over_all(size: int, dtype: str) -> jax.Array:
    """Returns an array with `size` entries on each device."""
    whole = size * jax.device_count()
    return timing.over_devices(jnp.linspace(0.5, 1.5, whole, dtype=dtype), whole)


def main() -> None:
    """Prints the operations and bytes of each scene, and the peak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    scenes, method = parser.parse_args().scenes, jc.Method(solver=jc.solvers.Sparse())
    timing.use_all_cores()
    devices = f"{jax.device_count()} devices, {timing.cores()} cores"
    print(f"peak {peak() / 1e9:.1f} G float32 operations per second, {devices}")
    for name in scenes:
        cost = work(name, method, np.float32)
        print(f"{name:18s} {cost.operations:9.0f} operations a step, {cost.state:6d} B of state")


if __name__ == "__main__":
    main()
