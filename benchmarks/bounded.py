"""What bounded rows cost, and how well their laws are met, by solver and number of iterations.

    python -m benchmarks.bounded [--worlds 256] [--scenes box chain column]
    python -m benchmarks.bounded --laws 100000 [--scenes box chain]

Random states of three scenes: a box thrown into a slope (four corners, twelve rows of rank six), a
chain of four swinging into its stops, half of its joints at one, and rubbing in all of them, and a
column of ten blocks with a mass ratio of a thousand. One step each, batched on one device; what is
missed is relative to the largest velocity of a world.

With `--laws` each law is judged by itself, by what a step did: see `benchmarks.laws`.
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

import jaxcon as jc
from benchmarks import timing

STEP = 2e-3
SOLVERS = {
    **{f"GaussSeidel({n})": jc.GaussSeidel(sweeps=n) for n in (5, 15, 50, 150)},
    **{f"InteriorPoint({n})": jc.InteriorPoint(iterations=n) for n in (5, 10, 15, 30)},
}


def box(dtype: Any) -> Any:
    """A box of 2 kg on the corners of its lower face, on a slope of 0.4 rad with μ = 0.5."""
    scene = jc.Scene(gravity=(9.81 * np.sin(0.4), 0, -9.81 * np.cos(0.4)), dtype=dtype)
    scene.add_body("box", inertia=jc.inertia.box(2.0, (0.4, 0.3, 0.1)), position=(0, 0, 0.05))
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        corner = (0.2 * x, 0.15 * y, 0.0)
        scene.add(jc.PlaneContact(f"{k}", jc.WORLD, "box", center=corner, friction=0.5))
    return scene.build()


def chain(dtype: Any) -> Any:
    """Four links in the plane, each with stops 0.5 rad from the last one, and dry friction."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(4):
        before = jc.WORLD if i == 0 else f"{i - 1}"
        scene.add_body(f"{i}", mass=1.0, inertia=0.08, position=(0.5 + i, 0.0))
        scene.add(jc.Revolute(f"hinge {i}", before, f"{i}", point=(float(i), 0.0)))
        scene.add(jc.Limit(f"stop {i}", f"hinge {i}", -0.5, 0.5))
        scene.add(jc.JointFriction(f"rub {i}", f"hinge {i}", 0.5))
    return scene.build()


def column(dtype: Any) -> Any:
    """Ten guided blocks of 1 kg, the topmost of 1,000 kg."""
    scene = jc.Scene(dim=2, dtype=dtype)
    for i in range(10):
        mass = 1000.0 if i == 9 else 1.0
        scene.add_body(f"{i}", mass=mass, inertia=mass, position=(0.0, 0.05 + 0.1 * i))
        scene.add(jc.Prismatic(f"guide {i}", jc.WORLD, f"{i}", axis=(0.0, 1.0)))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "0", center=(0.0, 0.0)))
    for i in range(9):
        touch = {"radius_a": 0.05, "radius_b": 0.05}
        scene.add(jc.CapsuleContact(f"{i}:{i + 1}", f"{i}", f"{i + 1}", **touch))
    return scene.build()


def thrown(key: jax.Array, system: Any, state: Any, spread: float = 0.0) -> Any:
    """So far from a state [m, rad], moving anyhow."""
    shape, dtype = state.v.shape, state.v.dtype
    place, speed = (jax.random.normal(k, shape, dtype) for k in jax.random.split(key))
    return dataclasses.replace(state, q=system.retract(state.q, spread * place), v=speed)


def swung(key: jax.Array, _: Any, state: Any) -> Any:
    """The chain as its hinges let it: each by half a chance at a stop, with a rate of 3 rad/s."""
    inside, near, rate = jax.random.normal(key, (3, 4), state.v.dtype)
    anywhere, side = 0.5 * jnp.tanh(inside), jnp.sign(inside)
    chance = jax.random.bernoulli(jax.random.fold_in(key, 1), shape=(4,))
    angles = jnp.where(chance, 0.5 * side + 3e-3 * near, anywhere)

    def placed(angles: jax.Array) -> jax.Array:
        turned = jnp.cumsum(angles)
        along = jnp.stack([jnp.cos(turned), jnp.sin(turned)])
        centers = jnp.cumsum(along, axis=1) - along / 2
        return jnp.concatenate([*centers, turned])

    q, v = jax.jvp(placed, (angles,), (3 * rate,))
    return dataclasses.replace(state, q=q, v=v)


SCENES: dict[str, tuple[Callable[[Any], Any], Callable[..., Any]]] = {
    "box": (box, functools.partial(thrown, spread=3e-3)),
    "chain": (chain, swung),
    "column": (column, thrown),
}
"""Each with what draws a random state by a key, from the system and its first state."""


def measure(name: str, dtype: Any, solver: Any, worlds: int) -> tuple[np.ndarray, float, float]:
    """What is missed, by world, the time of a step of one world [s], and that of compilation."""
    build, drawn = SCENES[name]
    system, state = build(dtype)
    method = jc.Method(bounded=solver)
    state = jc.init(system, method, state.q, state.v)

    def one(key: jax.Array) -> Any:
        start = drawn(key, system, state)
        new, info = jc.step(system, method, start, None, jnp.asarray(STEP, dtype))
        return info.reactions.residual / jnp.max(jnp.abs(start.v)), new.v

    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    step, compiling = timing.compile_seconds(jax.vmap(one), keys)
    missed = np.asarray(step(keys)[0])
    return missed, 1 / timing.rate(lambda: step(keys), worlds, 5).median, compiling


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--laws", type=int, nargs="?", const=1000, help="number of states")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", "float64" in given.dtypes)
    print(timing.machine())
    if given.laws:
        from benchmarks import laws

        laws.table(given.scenes, given.dtypes, given.laws)
        return
    print("| scene | | | missed, median | 99 % | worst | µs a step and world | compile |")
    for name in given.scenes:
        for dtype in given.dtypes:
            for label, solver in SOLVERS.items():
                missed, cost, compiling = measure(name, jnp.dtype(dtype), solver, given.worlds)
                figures = (np.median(missed), np.quantile(missed, 0.99), missed.max())
                shown = " | ".join(f"{x:.0e}" for x in figures)
                row = f"| {name} | {dtype} | {label} | {shown} | {1e6 * cost:.3g}"
                print(f"{row} | {compiling:.1f} s |", flush=True)


if __name__ == "__main__":
    main()
