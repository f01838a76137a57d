"""What a gradient costs: value and gradient of a rollout beside the rollout, and beside MJX.

    python -m benchmarks.gradients [--scenes chain-10 four-bar] [--steps 1000] [--seconds 240]

A batch under plain `vmap` on one device, float32, the gradient of Σ q² at the end by the velocities
of the start. Peak memory is what XLA plans. Whether a gradient is right is judged over fewer steps,
by central differences along the velocities: over a thousand, that of a chain is beyond float32.
Each row is a process of its own, which compiles the rollout and then its gradient. Each step of MJX
is a checkpoint, which is its fastest.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.peers import FLAGS, mjx_start, mjx_step, speeds

SHORT = 100
"""Steps of MJX, and of the comparison with differences."""
STEP = 3e-2
"""Of the differences, relative."""
LENGTHS = (100, 1000, 10000)
MJX = "MJX"
ADJOINTS = {"every step": jc.EveryStep(), "checkpoints": jc.Checkpoints()}


@dataclass(frozen=True)
class Cost:
    """Of the rollout and of its value and gradient.

    Attributes:
        forward, gradient: world-steps a second.
        ratio: how many rollouts one value and gradient costs, the median of repeats in turn.
        forward_compile, gradient_compile: [s].
        finite: whether every gradient is.
        error: of the sum of gradients along the velocities, against differences over fewer steps.
    """

    forward: float
    gradient: float
    ratio: float
    forward_compile: float
    gradient_compile: float
    finite: bool
    error: float

    def __str__(self) -> str:
        return (
            f"{self.forward / 1e6:.3g} M | {self.gradient / 1e6:.3g} M | {self.ratio:.2g}"
            f" | {self.forward_compile:.1f} s | {self.gradient_compile:.1f} s"
            f" | {'yes' if self.finite else 'NO'} | {self.error:.1e}"
        )


Loss = Callable[[jax.Array, int], jax.Array]
"""(velocity of the start, steps) → Σ q² at the end, of one world."""


def measure(loss: Loss, worlds: jax.Array, steps: int, short: int) -> Cost:
    """The cost of the gradient of a loss by velocities, (worlds, n_v)."""
    batch = jax.vmap(functools.partial(loss, steps=steps))
    both = jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps)))
    (forward, forward_compile), (gradient, gradient_compile) = (
        timing.compile_seconds(f, worlds) for f in (batch, both)
    )
    slope = gradient(worlds)[1]
    jax.block_until_ready(forward(worlds))
    work = steps * len(worlds)
    rates = timing.in_turn([lambda: forward(worlds), lambda: gradient(worlds)], work)
    return Cost(
        *np.median(rates, axis=0).tolist(),
        float(np.median(rates[:, 0] / rates[:, 1])),
        forward_compile,
        gradient_compile,
        bool(jnp.all(jnp.isfinite(slope))),
        error(loss, worlds, short),
    )


def error(loss: Loss, worlds: jax.Array, steps: int) -> float:
    """Of the derivatives along the velocities, relative to the largest of all worlds."""
    both = jax.jit(jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps))))

    def at(s: float) -> np.ndarray:
        return np.asarray(both((1 + s * STEP) * worlds)[0], np.float64)

    by_difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * STEP)
    along = np.sum(np.asarray(both(worlds)[1] * worlds, np.float64), axis=1)
    return float(np.max(np.abs(along - by_difference)) / np.max(np.abs(by_difference)))


def ours(name: str, adjoint: Any, batch: int) -> tuple[Loss, jax.Array]:
    """The loss of a mechanism, and the velocities of a batch."""
    system, state = mechanisms.find(name).build(jnp.float32)
    method = jc.Method(solver=jc.Sparse())

    def loss(v: jax.Array, steps: int) -> jax.Array:
        start, dt = dataclasses.replace(state, v=v), jnp.asarray(DT, jnp.float32)
        run = functools.partial(jc.rollout, record=lambda s, i: None, adjoint=adjoint)
        return jnp.sum(run(system, method, start, None, dt, steps)[0].q ** 2)

    moving = state.v if jnp.any(state.v) else jnp.ones_like(state.v)
    return loss, jnp.asarray(speeds(batch), jnp.float32)[:, None] * moving


def mjx(name: str, batch: int) -> tuple[Loss, jax.Array]:
    """The same of MJX."""
    mechanism = mechanisms.find(name)
    model, data = mjx_start(mechanism, batch)
    one = jax.tree.map(lambda x: x[0], data)
    step = jax.checkpoint(functools.partial(mjx_step(), model))

    def loss(v: jax.Array, steps: int) -> jax.Array:
        start = one.replace(qvel=v)
        return jnp.sum(jax.lax.scan(lambda d, _: (step(d), None), start, None, steps)[0].qpos ** 2)

    moving = data.qvel[0] if jnp.any(data.qvel) else jnp.ones_like(data.qvel[0])
    return loss, jnp.asarray(speeds(batch), moving.dtype)[:, None] * moving


def planned(name: str, adjoint: Any, batch: int, steps: int) -> int:
    """Temporary memory of the gradient [B]."""
    loss, worlds = ours(name, adjoint, batch)
    both = jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps)))
    plan = jax.jit(both).lower(worlds).compile().memory_analysis()
    return plan.temp_size_in_bytes  # type: ignore[union-attr]


def alone(name: str, way: str, batch: int, steps: int) -> Cost:
    """The cost of a row, here: of ours by an adjoint, or of MJX."""
    if way == MJX:
        return measure(*mjx(name, batch), SHORT, SHORT)
    return measure(*ours(name, ADJOINTS[way], batch), steps, SHORT)


def row(name: str, way: str, given: argparse.Namespace, flags: str = "") -> str:
    """A row of the table, from a process of its own, or why there is none."""
    numbers = ["--batch", str(given.batch), "--steps", str(given.steps)]
    call = ["benchmarks.gradients", "--alone", name, way, *numbers]
    late = "does not compile and run in"
    found = timing.in_process(call, timing.with_flags(flags), given.seconds, late)
    shown = found if isinstance(found, str) else Cost(**found)
    return f"| {name} | {way} {flags} | {shown} |"


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["chain-10", "four-bar"])
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=240.0, help="at most, of each row")
    parser.add_argument("--alone", metavar=("SCENE", "WAY"), nargs=2, help="one row, here, as JSON")
    return parser.parse_args()


def main() -> None:
    """Prints the tables."""
    given = arguments()
    if given.alone:
        cost = alone(*given.alone, given.batch, given.steps)
        print(json.dumps(dataclasses.asdict(cost)))
        return
    print(timing.machine())
    head = "forward | value and gradient | times | compile | with gradient | finite | error"
    print(f"| scene | | {head} |")
    for name in given.scenes:
        for way in ADJOINTS:
            print(row(name, way, given), flush=True)
        for flags in FLAGS:
            print(row(name, MJX, given, flags), flush=True)
    print("| scene | | steps | memory |")
    for name in given.scenes:
        for adjoint, steps in ((a, n) for a in ADJOINTS for n in LENGTHS):
            size = planned(name, ADJOINTS[adjoint], given.batch, steps)
            print(f"| {name} | {adjoint} | {steps} | {size / 1e6:.4g} MB |", flush=True)


if __name__ == "__main__":
    main()
