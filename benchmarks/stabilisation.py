"""What keeps a state on its constraints, and at which price (chapter 3.3 to 3.5).

    python -m benchmarks.stabilisation [--scenes pendulum four_bar …] [--steps 100000]

Every pair of a stabiliser and an integrator on five mechanisms that lose no energy, in both
precisions: the worst violation of positions and velocities and the worst change of energy over the
run, relative to the mechanism's size, its speed √(g l) and m g l, and the time of a step of one
world. Pairs that do not belong together are listed with the reason that they give.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.scenes import four_bar

G = 9.81
INTEGRATORS = {
    "semi-implicit Euler": jc.SemiImplicitEuler(),
    "Heun": jc.Heun(),
    "RK4": jc.RK4(),
    "RATTLE": jc.RATTLE(),
    "generalized-α": jc.GeneralizedAlpha(),
}
STABILIZERS = {
    "none": jc.Unstabilized(),
    "Baumgarte": jc.Baumgarte(),
    "Baumgarte, 50/s": jc.Baumgarte.critical(50.0),
    "PID": jc.PID(2500.0, 100.0, 1000.0),
    "adaptive": jc.AdaptiveBaumgarte(50.0, 50.0),
    "sliding window": jc.SlidingWindowBaumgarte(50.0),
    "penalty": jc.Penalty(1e8, 1e3),
    "multipliers": jc.AugmentedLagrangian(),
    "projection": jc.Projection(),
    "linearized projection": jc.Projection(iterations=1),
    "projection, every 10th": jc.Projection(every=10),
}


def pendulum() -> Any:
    """A particle on a rod, released level."""
    return chain(1)


def double_pendulum() -> Any:
    """Two particles on rods."""
    return chain(2)


def chain_20() -> Any:
    """Twenty links on hinges in the plane, released level."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    for i in range(20):
        place = ((i + 0.5) / 20, 0.0)
        scene.add_body(f"link{i}", mass=0.05, inertia=0.05 / 12 / 400, position=place)
        before = f"link{i - 1}" if i else jc.WORLD
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(i / 20, 0.0)))
    return scene.build()


def chain(links: int) -> Any:
    """Particles on rods, one metre together, released level."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    for i in range(links):
        scene.add_particle(f"bob{i}", mass=1.0 / links, position=((i + 1) / links, 0.0))
        scene.add(jc.Distance(f"rod{i}", f"bob{i - 1}" if i else jc.WORLD, f"bob{i}"))
    return scene.build()


def spatial_loop() -> Any:
    """Three rods on ball joints between two fixed points, released where they hang askew."""
    points = np.array([[0.0, 0.0, 0.0], [0.2, 0.3, -0.1], [0.6, 0.2, 0.1], [0.9, 0.0, 0.0]])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    names = [jc.WORLD, "first", "second", "third", jc.WORLD]
    for name, a, b in zip(names[1:4], points[:-1], points[1:], strict=True):
        solid = jc.inertia.box(0.33, (0.3, 0.05, 0.04))
        scene.add_body(name, inertia=solid, position=(a + b) / 2)
    for i, point in enumerate(points):
        scene.add(jc.Spherical(f"ball{i}", names[i], names[i + 1], point=point))
    return scene.build()


SCENES: dict[str, Callable[[], Any]] = {
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "four_bar": four_bar,
    "spatial_loop": spatial_loop,
    "chain_20": chain_20,
}
STEP = {"chain_20": 2.5e-4, "spatial_loop": 2.5e-4}
"""h of a scene [s], 1 ms unless given: the end of the chain whips around, and the rods of the loop
spin about themselves, at a hundred rad/s and more."""


@dataclass(frozen=True)
class Row:
    """One pair on one scene; NaN where it failed or was refused, and then the reason."""

    scene: str
    dtype: str
    integrator: str
    stabilizer: str
    position: float
    velocity: float
    energy: float
    microseconds: float
    remark: str


def measure(scene: str, dtype: Any, integrator: str, stabilizer: str, steps: int, dt: float) -> Row:
    """Runs one pair."""
    built = SCENES[scene]()
    system, state = jax.tree.map(lambda x: cast(x, dtype), built)
    method = jc.Method(INTEGRATORS[integrator], STABILIZERS[stabilizer])
    known = (scene, np.dtype(dtype).name, integrator, stabilizer)
    failed = (float("nan"),) * 4
    h = jnp.asarray(dt, dtype)

    def leap(state: jc.State, _: None) -> Any:
        def worst(seen: Any, _: None) -> Any:
            state, most = seen
            state, _ = jc.step(system, method, state, None, h)
            off = jc.violation(system, state)
            return (state, jnp.maximum(most, jnp.stack([off.worst, off.worst_rate]))), None

        start = (state, jnp.zeros(2, dtype))
        (state, most), _ = jax.lax.scan(worst, start, None, every)
        return state, (most, jc.energy(system, state).total)

    every = max(steps // 1000, 1)
    try:
        start = jc.init(system, method, state.q, state.v)
        run = jax.jit(lambda s: jax.lax.scan(leap, s, None, steps // every))
        compiled = run.lower(start).compile()
    except ValueError as error:
        return Row(*known, *failed, f"refused: {error}")
    began = time.perf_counter()
    final, (off, energy) = jax.block_until_ready(compiled(start))
    seconds = time.perf_counter() - began
    if jc.Status(int(final.status)) not in (jc.Status.OK, jc.Status.CONFLICT):
        code = jc.Status(int(final.status)).name
        return Row(*known, *failed, f"{code} at {float(final.time):.3g} s")
    change = np.max(np.abs(np.asarray(energy) - float(jc.energy(system, state).total))) / G
    most = np.max(np.asarray(off), axis=0)
    note = "" if int(final.status) == 0 else jc.Status(int(final.status)).name
    speed = float(np.sqrt(G))
    return Row(
        *known, float(most[0]), float(most[1]) / speed, float(change), 1e6 * seconds / steps, note
    )


def cast(x: Any, dtype: Any) -> Any:
    """An array of numbers in another precision; one of integers as it is."""
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def table(scenes: list[str], dtypes: list[Any], steps: int, dt: float | None) -> Iterator[Row]:
    """All pairs on some scenes, at a step of their own unless one is given."""
    for scene in scenes:
        for dtype in dtypes:
            for integrator in INTEGRATORS:
                for stabilizer in STABILIZERS:
                    h = STEP.get(scene, 1e-3) if dt is None else dt
                    yield measure(scene, dtype, integrator, stabilizer, steps, h)


def main() -> None:
    """Prints the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--dt", type=float)
    parser.add_argument("--json")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{asked.steps} steps, one world")
    print(f"{'scene':16s}{'':9s}{'integrator':21s}{'stabilizer':24s}", end="")
    print(f"{'φ':>9s}{'φ̇':>9s}{'energy':>9s}{'µs':>8s}")
    rows = []
    dtypes = [np.dtype(name) for name in asked.dtypes]
    for row in table(asked.scenes, dtypes, asked.steps, asked.dt):
        rows.append(asdict(row))
        names = f"{row.scene:16s}{row.dtype:9s}{row.integrator:21s}{row.stabilizer:24s}"
        figures = "".join(f"{x:9.1e}" for x in (row.position, row.velocity, row.energy))
        print(f"{names}{figures}{row.microseconds:8.2f}  {row.remark[:60]}", flush=True)
    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
