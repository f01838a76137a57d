"""Operations of one step counted from its jaxpr, and the elementwise peak of the machine.

    python -m benchmarks.roofline [--scenes chain-10 …]

Each arithmetic operation on a floating-point number counts as one, whether it is an addition, a
division or a sine; data movement, comparisons and integers count as none. What XLA finds to be
computed twice is counted twice. The peak is what XLA
reaches on fused multiply-adds of an array that lies in the cache, two operations each.
"""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.targets import SCENES

COUNTED = """add sub mul div neg max min sqrt rsqrt cbrt square pow exp exp2 log tanh
             sin cos tan asin acos atan atan2 sinh cosh"""
ELEMENTWISE = frozenset(COUNTED.split())
REDUCTIONS = frozenset({"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "cumsum"})
WORLDS = 128
"""In the batch whose step is counted: what worlds share is then shared among so many."""


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
        worlds = jax.tree.map(lambda x: jax.ShapeDtypeStruct((WORLDS, *x.shape), x.dtype), state)
        step = jax.vmap(lambda s: jc.step(system, method, s, None, DT)[0])
        operations = count(jax.make_jaxpr(step)(worlds).jaxpr) / WORLDS
    return Work(operations, sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)))


def count(jaxpr: Any) -> float:
    """Arithmetic operations of a jaxpr, those of inner ones included."""
    return float(sum(operations(equation) for equation in jaxpr.eqns))


def operations(equation: Any) -> float:
    """Of one equation; a loop of unknown length counts as one round."""
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return params["length"] * count(params["jaxpr"].jaxpr)
    if name == "cond":
        return max(count(branch.jaxpr) for branch in params["branches"])
    if name == "custom_linear_solve":  # runs its solver; the matrix is only for derivatives
        return count(params["jaxprs"].solve.jaxpr)
    if name == "native":
        shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
        return count(jax.make_jaxpr(params["fun"])(*shapes).jaxpr)
    inner = list(jaxprs(params))
    return sum(count(x) for x in inner) if inner else arithmetic(equation)


def jaxprs(params: dict[str, Any]) -> Iterator[Any]:
    """Those among the parameters of an equation that it evaluates."""
    for value in params.values():
        closed = getattr(value, "jaxpr", value)
        if hasattr(closed, "eqns"):
            yield closed


def arithmetic(equation: Any) -> float:
    """Of one instruction, by its size."""
    if not equation.outvars:
        return 0.0
    name, result = equation.primitive.name, equation.outvars[0].aval
    if not jnp.issubdtype(getattr(result, "dtype", jnp.int32), jnp.floating):
        return 0.0
    if name == "integer_pow":
        return result.size * math.ceil(math.log2(max(2, abs(equation.params["y"]))))
    if name == "dot_general":
        left = equation.invars[0].aval.shape
        (contracted, _), _ = equation.params["dimension_numbers"]
        return 2.0 * result.size * math.prod(left[i] for i in contracted)
    if name in REDUCTIONS:
        return equation.invars[0].aval.size
    if name == "cholesky":
        return result.size * result.shape[-1] / 3
    if name == "lu":
        return 2 * result.size * result.shape[-1] / 3
    if name == "triangular_solve":
        return result.size * equation.invars[0].aval.shape[-1]
    return result.size if name in ELEMENTWISE else 0.0


@functools.cache
def peak(dtype: str = "float32") -> float:
    """Operations a second of fused multiply-adds in the cache, the best of several shapes."""
    with jax.enable_x64(dtype == "float64"):
        sizes = [(1 << bits, depth) for bits in (10, 12, 14, 18) for depth in (8, 32)]
        return max(multiply_adds(size, depth, dtype) for size, depth in sizes)


def multiply_adds(size: int, depth: int, dtype: str) -> float:
    """Operations a second of x ← a x + b, `depth` of them to each pass over an array."""
    passes = max(1, (1 << 27) // (size * depth))

    def sweep(x: jax.Array, _: Any) -> tuple[jax.Array, None]:
        for _ in range(depth):
            x = x * 0.999 + 0.001
        return x, None

    start = jnp.linspace(0.5, 1.5, size, dtype=dtype)
    run: Callable[..., Any] = jax.jit(lambda x: jax.lax.scan(sweep, x, None, passes)[0])
    run(start).block_until_ready()
    return timing.rate(lambda: run(start), 2.0 * size * depth * passes, repeats=3).most


def main() -> None:
    """Prints the operations and bytes of each scene, and the peak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    method = jc.Method(solver=jc.Sparse())
    print(f"peak {peak() / 1e9:.1f} G float32 operations a second, {timing.cores()} cores")
    for name in parser.parse_args().scenes:
        found = work(name, method, np.float32)
        print(f"{name:18s} {found.operations:9.0f} operations a step, {found.state:6d} B of state")


if __name__ == "__main__":
    main()
