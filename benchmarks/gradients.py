"""Cost of value and gradient of a rollout, compared with the rollout and with MJX.

    python -m benchmarks.gradients [--scenes chain-10 four-bar] [--steps 1000] [--seconds 240]

A batch runs under plain `vmap` on one device in float32. The loss is Σ q² at the end,
differentiated with respect to the initial velocities. Peak memory is the memory that XLA plans.

The error of a gradient is measured over fewer steps, by central differences along the velocities.
Over a thousand steps, the gradient of a chain exceeds the accuracy of float32. Each row runs in its
own process, which compiles the rollout and then its gradient. MJX checkpoints each step, which is
its fastest setting.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import mechanisms, timing
from benchmarks.mjcf import DT
from benchmarks.peers import FLAGS, mjx_start, mjx_step, speeds

SHORT = 100
"""Number of steps for MJX and for the comparison with finite differences."""
STEP = 3e-2
"""Relative step of the finite differences."""
LENGTHS = (100, 1000, 10000)
MJX = "MJX"
ADJOINTS = {"every step": jc.adjoints.EveryStep(), "checkpoints": jc.adjoints.Checkpoints()}


@dataclass(frozen=True)
class Cost:
    """Cost of a rollout, and of its value and gradient.

    Attributes:
        forward: world-steps per second of the rollout.
        gradient: world-steps per second of value and gradient.
        ratio: cost of value and gradient over that of a rollout, median of alternating repeats.
        forward_compile: compile time of the rollout [s].
        gradient_compile: compile time of value and gradient [s].
        finite: True if every gradient is finite.
        error: relative error of the derivative along the velocities, over fewer steps.
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
"""(initial velocity, steps) → Σ q² at the end, for one world."""


def measure(loss: Loss, worlds: jax.Array, steps: int, short: int) -> Cost:
    """Measures the cost of differentiating a loss by velocities, (worlds, n_v)."""
    batch = jax.vmap(functools.partial(loss, steps=steps))
    loss_and_gradient = jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps)))
    (forward, forward_compile), (gradient, gradient_compile) = (
        timing.compile_seconds(f, worlds) for f in (batch, loss_and_gradient)
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
    """Returns the largest error of derivatives along the velocities.

    It is relative to the largest derivative over all worlds.
    """
    loss_and_gradient = jax.jit(jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps))))

    def loss_at(s: float) -> np.ndarray:
        return np.asarray(loss_and_gradient((1 + s * STEP) * worlds)[0], np.float64)

    differences = (8 * (loss_at(1) - loss_at(-1)) - (loss_at(2) - loss_at(-2))) / (12 * STEP)
    derivatives = np.sum(np.asarray(loss_and_gradient(worlds)[1] * worlds, np.float64), axis=1)
    return float(np.max(np.abs(derivatives - differences)) / np.max(np.abs(differences)))


def ours(name: str, adjoint: jc.extend.Adjoint, batch: int) -> tuple[Loss, jax.Array]:
    """Returns the loss of a mechanism in jaxcon, and initial velocities of a batch."""
    system, state = mechanisms.find(name).build(jnp.float32)
    method = jc.Method(solver=jc.solvers.Sparse())

    def loss(v: jax.Array, steps: int) -> jax.Array:
        start, dt = dataclasses.replace(state, v=v), jnp.asarray(DT, jnp.float32)
        run = functools.partial(jc.rollout, record=lambda s, i: None, adjoint=adjoint)
        return jnp.sum(run(system, method, start, None, dt, steps)[0].q ** 2)

    velocity = state.v if jnp.any(state.v) else jnp.ones_like(state.v)
    return loss, jnp.asarray(speeds(batch), jnp.float32)[:, None] * velocity


def mjx(name: str, batch: int) -> tuple[Loss, jax.Array]:
    """Returns the loss of a mechanism in MJX, and initial velocities of a batch."""
    mechanism = mechanisms.find(name)
    model, data = mjx_start(mechanism, batch)
    first = jax.tree.map(lambda x: x[0], data)
    step = jax.checkpoint(functools.partial(mjx_step(), model))

    def loss(v: jax.Array, steps: int) -> jax.Array:
        start = first.replace(qvel=v)
        return jnp.sum(jax.lax.scan(lambda d, _: (step(d), None), start, None, steps)[0].qpos ** 2)

    velocity = data.qvel[0] if jnp.any(data.qvel) else jnp.ones_like(data.qvel[0])
    return loss, jnp.asarray(speeds(batch), velocity.dtype)[:, None] * velocity


def planned(name: str, adjoint: jc.extend.Adjoint, batch: int, steps: int) -> int:
    """Returns the temporary memory that XLA plans for the gradient [B]."""
    loss, worlds = ours(name, adjoint, batch)
    loss_and_gradient = jax.vmap(jax.value_and_grad(functools.partial(loss, steps=steps)))
    plan = jax.jit(loss_and_gradient).lower(worlds).compile().memory_analysis()
    return plan.temp_size_in_bytes  # type: ignore[union-attr]


def alone(name: str, variant: str, batch: int, steps: int) -> Cost:
    """Measures one row in this process: an adjoint of jaxcon, or MJX."""
    if variant == MJX:
        return measure(*mjx(name, batch), SHORT, SHORT)
    return measure(*ours(name, ADJOINTS[variant], batch), steps, SHORT)


def row(name: str, variant: str, options: argparse.Namespace, flags: str = "") -> str:
    """Measures one row in its own process and formats it, or the reason why there is no result."""
    numbers = ["--batch", str(options.batch), "--steps", str(options.steps)]
    command = ["benchmarks.gradients", "--alone", name, variant, *numbers]
    message = "does not compile and run in"
    result = timing.in_process(command, timing.with_flags(flags), options.seconds, message)
    cost = result if isinstance(result, str) else Cost(**result)
    return f"| {name} | {variant} {flags} | {cost} |"


def arguments() -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["chain-10", "four-bar"])
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=240.0, help="time limit of a row [s]")
    parser.add_argument("--alone", metavar=("SCENE", "WAY"), nargs=2, help="one row as JSON")
    return parser.parse_args()


def main() -> None:
    """Prints the tables of cost and of memory."""
    options = arguments()
    if options.alone:
        cost = alone(*options.alone, options.batch, options.steps)
        print(json.dumps(dataclasses.asdict(cost)))
        return
    print(timing.machine())
    head = (
        "forward | value and gradient | ratio | compile forward | compile gradient | finite | error"
    )
    print(f"| scene | | {head} |")
    for name in options.scenes:
        for variant in ADJOINTS:
            print(row(name, variant, options), flush=True)
        for flags in FLAGS:
            print(row(name, MJX, options, flags), flush=True)
    print("| scene | | steps | memory |")
    for name in options.scenes:
        for adjoint, steps in ((a, n) for a in ADJOINTS for n in LENGTHS):
            size = planned(name, ADJOINTS[adjoint], options.batch, steps)
            print(f"| {name} | {adjoint} | {steps} | {size / 1e6:.4g} MB |", flush=True)


if __name__ == "__main__":
    main()
