"""Accuracy and cost of keeping a state on its constraints (chapters 3.3 to 3.5).

    python -m benchmarks.stabilisation [--scenes pendulum four_bar …] [--steps 100000]

Every pair of a stabilizer and an integrator runs on five conservative mechanisms in both
precisions. The table has the largest violations of positions and velocities, the largest energy
error, and the time of a step of one world. Errors are relative to the mechanism's size, √(g l) and
m g l, with mass m and length l. Incompatible pairs are listed with the reason why they are refused.
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
from jax.typing import DTypeLike

import jaxcon as jc
from jaxcon.scenes import four_bar

G = 9.81
INTEGRATORS = {
    "semi-implicit Euler": jc.SemiImplicitEuler(),
    "Heun": jc.integrators.Heun(),
    "RK4": jc.RK4(),
    "RATTLE": jc.integrators.RATTLE(),
    "generalized-α": jc.integrators.GeneralizedAlpha(),
}
STABILIZERS = {
    "none": jc.stabilizers.Unstabilized(),
    "Baumgarte": jc.Baumgarte(),
    "Baumgarte, 50/s": jc.Baumgarte.critical(50.0),
    "PID": jc.stabilizers.PID(2500.0, 100.0, 1000.0),
    "adaptive": jc.stabilizers.AdaptiveBaumgarte(50.0, 50.0),
    "sliding window": jc.stabilizers.SlidingWindowBaumgarte(50.0),
    "penalty": jc.stabilizers.Penalty(1e8, 1e3),
    "multipliers": jc.stabilizers.AugmentedLagrangian(),
    "projection": jc.Projection(),
    "linearized projection": jc.Projection(iterations=1),
    "projection, every 10th": jc.Projection(every=10),
}


def pendulum() -> Any:
    """Builds a particle on a rod, released from the horizontal."""
    return chain(1)


def double_pendulum() -> Any:
    """Builds two particles on rods, released from the horizontal."""
    return chain(2)


def chain_20() -> Any:
    """Builds twenty links on hinges in the plane, released from the horizontal."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    for i in range(20):
        place = ((i + 0.5) / 20, 0.0)
        scene.add_body(f"link{i}", mass=0.05, inertia=0.05 / 12 / 400, position=place)
        before = f"link{i - 1}" if i else jc.WORLD
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(i / 20, 0.0)))
    return scene.build()


def chain(links: int) -> Any:
    """Builds particles on rods, 1 m in total, released from the horizontal."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    for i in range(links):
        scene.add_particle(f"bob{i}", mass=1.0 / links, position=((i + 1) / links, 0.0))
        scene.add(jc.Distance(f"rod{i}", f"bob{i - 1}" if i else jc.WORLD, f"bob{i}"))
    return scene.build()


def spatial_loop() -> Any:
    """Builds three rods on ball joints between two fixed points, released from a skew position."""
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
"""Step sizes h [s], by default 1 ms.

The end of the chain whips, and the rods of the loop spin about their axes, at 100 rad/s and more.
"""


@dataclass(frozen=True)
class Row:
    """Result of a pair of integrator and stabilizer on one scene.

    If the pair failed or was refused, values are NaN and `remark` gives the reason.

    Attributes:
        scene: name of the scene.
        dtype: precision.
        integrator: name of the integrator.
        stabilizer: name of the stabilizer.
        position: largest |φ|, divided by the size of 1 m.
        velocity: largest |φ̇|, divided by √(g l).
        energy: largest energy error, divided by m g l.
        microseconds: time of a step [µs].
        remark: reason of a failure or refusal, or a warning status.
    """

    scene: str
    dtype: str
    integrator: str
    stabilizer: str
    position: float
    velocity: float
    energy: float
    microseconds: float
    remark: str


def measure(
    scene: str, dtype: DTypeLike, integrator: str, stabilizer: str, steps: int, dt: float
) -> Row:
    """Runs one pair of integrator and stabilizer on a scene."""
    pair = SCENES[scene]()
    system, state = jax.tree.map(lambda x: cast(x, dtype), pair)
    method = jc.Method(INTEGRATORS[integrator], STABILIZERS[stabilizer])
    labels = (scene, np.dtype(dtype).name, integrator, stabilizer)
    failed = (float("nan"),) * 4
    h = jnp.asarray(dt, dtype)

    def segment(state: jc.State, _: None) -> Any:
        def worst(carry: Any, _: None) -> Any:
            state, largest = carry
            state, _ = jc.step(system, method, state, None, h)
            violation = jc.violation(system, state)
            return (
                state,
                jnp.maximum(largest, jnp.stack([violation.worst, violation.worst_rate])),
            ), None

        start = (state, jnp.zeros(2, dtype))
        (state, largest), _ = jax.lax.scan(worst, start, None, every)
        return state, (largest, jc.energy(system, state).total)

    every = max(steps // 1000, 1)
    try:
        start = jc.init(system, method, state.q, state.v)
        run = jax.jit(lambda s: jax.lax.scan(segment, s, None, steps // every))
        compiled = run.lower(start).compile()
    except ValueError as error:
        return Row(*labels, *failed, f"refused: {error}")
    begin = time.perf_counter()
    final, (violation, energy) = jax.block_until_ready(compiled(start))
    seconds = time.perf_counter() - begin
    if jc.Status(int(final.status)) not in (jc.Status.OK, jc.Status.CONFLICT):
        code = jc.Status(int(final.status)).name
        return Row(*labels, *failed, f"{code} at {float(final.time):.3g} s")
    change = np.max(np.abs(np.asarray(energy) - float(jc.energy(system, state).total))) / G
    largest = np.max(np.asarray(violation), axis=0)
    note = "" if int(final.status) == 0 else jc.Status(int(final.status)).name
    speed = float(np.sqrt(G))
    return Row(
        *labels,
        float(largest[0]),
        float(largest[1]) / speed,
        float(change),
        1e6 * seconds / steps,
        note,
    )


def cast(x: Any, dtype: DTypeLike) -> Any:
    """Casts an array of real numbers to another precision. Integers are unchanged."""
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def table(scenes: list[str], dtypes: list[Any], steps: int, dt: float | None) -> Iterator[Row]:
    """Yields the results of all pairs of integrator and stabilizer on some scenes.

    None for `dt` selects the default step size of each scene.
    """
    for scene in scenes:
        for dtype in dtypes:
            for integrator in INTEGRATORS:
                for stabilizer in STABILIZERS:
                    h = STEP.get(scene, 1e-3) if dt is None else dt
                    yield measure(scene, dtype, integrator, stabilizer, steps, h)


def main() -> None:
    """Prints the table of errors and times row by row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--dt", type=float)
    parser.add_argument("--json")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{options.steps} steps, one world")
    print(f"{'scene':16s}{'':9s}{'integrator':21s}{'stabilizer':24s}", end="")
    print(f"{'φ':>9s}{'φ̇':>9s}{'energy':>9s}{'µs':>8s}")
    rows = []
    dtypes = [np.dtype(name) for name in options.dtypes]
    for row in table(options.scenes, dtypes, options.steps, options.dt):
        rows.append(asdict(row))
        names = f"{row.scene:16s}{row.dtype:9s}{row.integrator:21s}{row.stabilizer:24s}"
        figures = "".join(f"{x:9.1e}" for x in (row.position, row.velocity, row.energy))
        print(f"{names}{figures}{row.microseconds:8.2f}  {row.remark[:60]}", flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
