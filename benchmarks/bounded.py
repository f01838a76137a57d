"""Cost and residuals of contact solvers, by solver and number of iterations.

    python -m benchmarks.bounded [--worlds 256] [--scenes box chain column]
    python -m benchmarks.bounded --laws 100000 [--scenes box chain] [--regularization 0.0253]

Each run takes one step from random states of a scene. The states are a batch on one device. There
are three scenes:

- a box thrown into a slope: four corners, twelve contact rows of rank six,
- a chain of four links with dry friction in all joints, about half of them at a joint limit,
- a column of ten blocks with a mass ratio of a thousand.

Residuals are divided by the largest velocity of a world. With `--laws`, each contact law is checked
separately against the result of a step; see `benchmarks.laws`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import timing

STEP = 2e-3  # [s]
SOLVERS = {
    "Newton": jc.solvers.Newton(),
    **{f"GaussSeidel({n})": jc.solvers.GaussSeidel(sweeps=n) for n in (5, 15, 50, 150)},
    **{f"InteriorPoint({n})": jc.solvers.InteriorPoint(iterations=n) for n in (5, 10, 15, 30)},
}


def box(dtype: DTypeLike) -> Any:
    """Builds a box of 2 kg with contacts at four corners, on a slope of 0.4 rad with μ = 0.5."""
    scene = jc.Scene(gravity=(9.81 * np.sin(0.4), 0, -9.81 * np.cos(0.4)), dtype=dtype)
    scene.add_body("box", inertia=jc.inertia.box(2.0, (0.4, 0.3, 0.1)), position=(0, 0, 0.05))
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        corner = (0.2 * x, 0.15 * y, 0.0)
        scene.add(jc.PlaneContact(f"{k}", jc.WORLD, "box", center=corner, friction=0.5))
    return scene.build()


def chain(dtype: DTypeLike) -> Any:
    """Builds four links in the plane, with joint limits of ±0.5 rad and dry friction."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(4):
        before = jc.WORLD if i == 0 else f"{i - 1}"
        scene.add_body(f"{i}", mass=1.0, inertia=0.08, position=(0.5 + i, 0.0))
        scene.add(jc.Revolute(f"hinge {i}", before, f"{i}", point=(float(i), 0.0)))
        scene.add(jc.Limit(f"stop {i}", f"hinge {i}", -0.5, 0.5))
        scene.add(jc.contacts.JointFriction(f"rub {i}", f"hinge {i}", 0.5))
    return scene.build()


def column(dtype: DTypeLike) -> Any:
    """Builds ten blocks on a vertical guide: nine of 1 kg, and one of 1,000 kg on top."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(10):
        mass = 1000.0 if i == 9 else 1.0
        scene.add_body(f"{i}", mass=mass, inertia=mass, position=(0.0, 0.05 + 0.1 * i))
        scene.add(jc.Prismatic(f"guide {i}", jc.WORLD, f"{i}", axis=(0.0, 1.0)))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "0", center=(0.0, 0.0)))
    for i in range(9):
        touch = {"radius_a": 0.05, "radius_b": 0.05}
        scene.add(jc.contacts.CapsuleContact(f"{i}:{i + 1}", f"{i}", f"{i + 1}", **touch))
    return scene.build()


def thrown(key: jax.Array, system: jc.extend.System, state: jc.State, spread: float = 0.0) -> Any:
    """Draws random velocities, and positions within about `spread` [m, rad] of the state."""
    shape, dtype = state.v.shape, state.v.dtype
    place, speed = (jax.random.normal(k, shape, dtype) for k in jax.random.split(key))
    return dataclasses.replace(state, q=system.retract(state.q, spread * place), v=speed)


def swung(key: jax.Array, _: Any, state: jc.State) -> Any:
    """Draws angles and rates of the chain's hinges. Half of them, on average, are at a limit."""
    inside, near, rate = jax.random.normal(key, (3, 4), state.v.dtype)
    free, side = 0.5 * jnp.tanh(inside), jnp.sign(inside)
    at_limit = jax.random.bernoulli(jax.random.fold_in(key, 1), shape=(4,))
    angles = jnp.where(at_limit, 0.5 * side + 3e-3 * near, free)

    def placed(angles: jax.Array) -> jax.Array:
        headings = jnp.cumsum(angles)
        links = jnp.stack([jnp.cos(headings), jnp.sin(headings)])
        centers = jnp.cumsum(links, axis=1) - links / 2
        return jnp.concatenate([*centers, headings])

    q, v = jax.jvp(placed, (angles,), (3 * rate,))
    return dataclasses.replace(state, q=q, v=v)


SCENES: dict[str, tuple[Callable[[Any], Any], Callable[..., Any]]] = {
    "box": (box, functools.partial(thrown, spread=3e-3)),
    "chain": (chain, swung),
    "column": (column, thrown),
}
"""For each scene: its builder, and a function (key, system, state) → random state."""


def measure(
    name: str, dtype: DTypeLike, solver: Any, worlds: int
) -> tuple[np.ndarray, float, float]:
    """Measures one contact solver on random states of one scene.

    Returns:
        The relative residual of each world (worlds,), the time of a step per world [s], and the
        compile time [s].
    """
    build, draw = SCENES[name]
    system, state = build(dtype)
    method = jc.Method(contact_solver=solver)
    state = jc.init(system, method, state.q, state.v)

    def step_world(key: jax.Array) -> Any:
        start = draw(key, system, state)
        new, info = jc.step(system, method, start, None, jnp.asarray(STEP, dtype))
        return info.reactions.residual / jnp.max(jnp.abs(start.v)), new.v

    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    step, compile_time = timing.compile_seconds(jax.vmap(step_world), keys)
    residuals = np.asarray(step(keys)[0])
    return residuals, 1 / timing.rate(lambda: step(keys), worlds, 5).median, compile_time


def main() -> None:
    """Prints the table of residuals and costs, or with `--laws` the table of contact laws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--laws", type=int, nargs="?", const=1000, help="number of random states")
    parser.add_argument("--regularization", type=float, help="of the laws of `--laws`")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", "float64" in options.dtypes)
    print(timing.machine())
    if options.laws:
        from benchmarks import laws

        given = options.scenes, options.dtypes, options.laws
        if options.regularization is None:
            laws.table(*given)
        else:
            laws.regularized_table(*given, options.regularization)
        return
    print("| scene | | | residual, median | 99 % | worst | µs a step and world | compile |")
    for name in options.scenes:
        for dtype in options.dtypes:
            for label, solver in SOLVERS.items():
                residuals, cost, compile_time = measure(
                    name, jnp.dtype(dtype), solver, options.worlds
                )
                figures = (np.median(residuals), np.quantile(residuals, 0.99), residuals.max())
                numbers = " | ".join(f"{x:.0e}" for x in figures)
                row = f"| {name} | {dtype} | {label} | {numbers} | {1e6 * cost:.3g}"
                print(f"{row} | {compile_time:.1f} s |", flush=True)


if __name__ == "__main__":
    main()
