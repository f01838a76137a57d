"""Drops of a thousand walkers that must come to rest, and a heavy column that must stay up.

    python -m benchmarks.falls [--walkers 1000] [--seconds 4] [--minute 60] [--dtypes float32]
        [--bounded GaussSeidel InteriorPoint]

Gymnasium's walker starts 1 m above its reference height. Its hinge angles are random within their
ranges, its trunk is rotated by up to half a turn either way and all joints move. It falls without
control at a step size of 2 ms. The column is that of `benchmarks.bounded` at 5 ms: ten guided
blocks, with a block of thousandfold mass on top.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import bounded, legged
from benchmarks.mjcf import DT

HEIGHT, BLOCK, SLOW = 1.0, 125, 5e-3
"""Height of the drop [m], walkers per batch, and step size of the column [s]."""
SPEED = 1.0
"""Standard deviation of the initial joint velocities [m/s, rad/s]."""


QUANTILES = (0.5, 0.9, 0.99, 1)
"""Quantiles of the final speeds."""


class Fallen(NamedTuple):
    """Result of the walkers.

    Attributes:
        failed: number of worlds that failed.
        worlds: number of worlds.
        speeds: `QUANTILES` over the healthy worlds of the largest final joint speed [m/s, rad/s].
        depth: the deepest final penetration of the healthy worlds.
    """

    failed: int
    worlds: int
    speeds: tuple[float, ...]
    depth: legged.Depth

    def __str__(self) -> str:
        """Formats the cells of a table row."""
        speeds = ", ".join(f"{speed:.1e}" for speed in self.speeds)
        return f"{self.failed} of {self.worlds} | {speeds} | {legged.deep(self.depth)}"


class Stood(NamedTuple):
    """Result of the column: largest displacement of a block [m], and status of the world."""

    moved: float
    status: int

    def __str__(self) -> str:
        """Formats the cell of a table row."""
        return f"{self.moved:.1e} m, status {self.status}"


def poses(model: Any, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draws random initial qpos and qvel of walkers, (count, …) each."""
    random, qpos = np.random.default_rng(seed), np.tile(model.qpos0, (count, 1))
    qpos[:, 1] += HEIGHT
    qpos[:, 2] += random.uniform(-np.pi, np.pi, count)
    for j in np.flatnonzero(model.jnt_limited):
        inward = np.array([1, -1]) * (legged.WITHIN + model.jnt_margin[j])
        qpos[:, model.jnt_qposadr[j]] = random.uniform(*(model.jnt_range[j] + inward), count)
    return qpos, SPEED * random.normal(size=(count, model.nv))


def drop(how: str, dtype: str, count: int, seconds: float) -> Fallen:
    """Drops walkers and counts failures.

    Final speeds and penetrations are those of the healthy worlds.
    """
    model = legged.load("walker2d")
    walker = jc.from_mjcf(model, dtype=jnp.dtype(dtype))
    method = jc.Method(solver=jc.solvers.Sparse(), contact_solver=legged.BOUNDED[how])
    qpos, qvel = (jnp.asarray(x, dtype) for x in poses(model, count))

    def idle(state: jc.State) -> jax.Array:
        return jnp.zeros(walker.system.layout.n_u, state.q.dtype)

    def fall(place: jax.Array, speed: jax.Array) -> tuple[Any, Any, Any]:
        state = walker.state(place, speed)
        turns = state.turns if walker.system.counted else None
        state = jc.init(walker.system, method, state.q, state.v, turns=turns)
        steps = int(seconds / DT)
        final, _ = jc.rollout(walker.system, method, state, idle, DT, steps, every=steps)
        return final.status, walker.qpos(final), walker.qvel(final)

    run, ends = jax.jit(jax.vmap(fall)), []
    for i in range(0, count, BLOCK):
        ends.append(jax.tree.map(np.asarray, run(qpos[i : i + BLOCK], qvel[i : i + BLOCK])))
    status, place, speed = (np.concatenate(x) for x in zip(*ends, strict=True))
    bad = (status != 0) | ~np.isfinite(place).all(1) | ~np.isfinite(speed).all(1)
    speeds = np.abs(speed[~bad]).max(1)
    quantiles = tuple(float(np.quantile(speeds, x)) for x in QUANTILES)
    return Fallen(int(bad.sum()), count, quantiles, legged.depth(model, place[~bad]))


def stand(how: str, dtype: str, seconds: float) -> Stood:
    """Simulates the column and measures the largest displacement of its blocks [m]."""
    system, state = bounded.column(jnp.dtype(dtype))
    method = jc.Method(contact_solver=legged.BOUNDED[how])
    start = jc.init(system, method, state.q, state.v)
    steps = int(seconds / SLOW)
    dt = jnp.asarray(SLOW, dtype)
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, dt, steps, every=steps)[0])
    final = run(start)
    moved = float(jnp.max(jnp.abs(final.q - start.q)))
    return Stood(moved, int(final.status))


def main() -> None:
    """Prints the tables of the column and of the walkers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walkers", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=4.0, help="duration of a fall [s]")
    parser.add_argument("--minute", type=float, default=60.0, help="duration of the column [s]")
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    parser.add_argument("--bounded", nargs="*", default=["GaussSeidel", "InteriorPoint"])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", "float64" in options.dtypes)
    for dtype in options.dtypes:
        for solver in options.bounded if options.minute else ():
            print(
                f"| column | {dtype} | {solver} | {stand(solver, dtype, options.minute)} |",
                flush=True,
            )
    for solver in options.bounded if options.walkers else ():
        print(f"| walkers | float32 | {solver} |", end=" ", flush=True)
        print(drop(solver, "float32", options.walkers, options.seconds), "|", flush=True)


if __name__ == "__main__":
    main()
