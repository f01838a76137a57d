"""What must come to rest, and what must stay up: a thousand drops, and a heavy column for a minute.

    python -m benchmarks.falls [--walkers 1000] [--seconds 4] [--minute 60] [--dtype float32]
        [--bounded GaussSeidel InteriorPoint]

Gymnasium's walker starts a metre above its reference height, its hinges anywhere in their ranges,
its trunk turned by up to half a turn either way and all joints moving, and falls without control at
2 ms. The column is that of `benchmarks.bounded`: ten guided blocks, the topmost a thousand times
heavier, at 5 ms.
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
"""Of the drop [m]; worlds at a time; step of the column [s]."""
SPEED = 1.0
"""Standard deviation of the velocities of joints at the start [m/s, rad/s]."""


QUANTILES = (0.5, 0.9, 0.99, 1)
"""Of the speeds at the end."""


class Fallen(NamedTuple):
    """What became of the walkers.

    Attributes:
        failed, worlds: how many failed, and of how many.
        speeds: of those that did not, the largest of each, by `QUANTILES` [m/s, rad/s].
        depth: the worst of them.
    """

    failed: int
    worlds: int
    speeds: tuple[float, ...]
    depth: legged.Depth

    def __str__(self) -> str:
        """The cells of a row."""
        shown = ", ".join(f"{speed:.1e}" for speed in self.speeds)
        return f"{self.failed} of {self.worlds} | {shown} | {legged.deep(self.depth)}"


class Stood(NamedTuple):
    """By how much a block of the column has moved [m], and the status of the world."""

    moved: float
    status: int

    def __str__(self) -> str:
        """The cell of a row."""
        return f"{self.moved:.1e} m, status {self.status}"


def poses(model: Any, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """qpos and qvel at the start, (count, …)."""
    random, qpos = np.random.default_rng(seed), np.tile(model.qpos0, (count, 1))
    qpos[:, 1] += HEIGHT
    qpos[:, 2] += random.uniform(-np.pi, np.pi, count)
    for j in np.flatnonzero(model.jnt_limited):
        inward = np.array([1, -1]) * (legged.WITHIN + model.jnt_margin[j])
        qpos[:, model.jnt_qposadr[j]] = random.uniform(*(model.jnt_range[j] + inward), count)
    return qpos, SPEED * random.normal(size=(count, model.nv))


def drop(how: str, dtype: str, count: int, seconds: float) -> Fallen:
    """How many worlds fail, and how fast and how deep those that do not end."""
    model = legged.load("walker2d")
    read = jc.from_mjcf(model, dtype=jnp.dtype(dtype))
    method = jc.Method(solver=jc.Sparse(), bounded=legged.BOUNDED[how])
    qpos, qvel = (jnp.asarray(x, dtype) for x in poses(model, count))

    def idle(state: jc.State) -> jax.Array:
        return jnp.zeros(read.system.layout.n_u, state.q.dtype)

    def fall(place: jax.Array, speed: jax.Array) -> tuple[Any, Any, Any]:
        state = read.state(place, speed)
        turns = state.turns if read.system.counted else None
        state = jc.init(read.system, method, state.q, state.v, turns=turns)
        steps = int(seconds / DT)
        final, _ = jc.rollout(read.system, method, state, idle, DT, steps, every=steps)
        return final.status, read.qpos(final), read.qvel(final)

    run, ends = jax.jit(jax.vmap(fall)), []
    for i in range(0, count, BLOCK):
        ends.append(jax.tree.map(np.asarray, run(qpos[i : i + BLOCK], qvel[i : i + BLOCK])))
    status, place, speed = (np.concatenate(x) for x in zip(*ends, strict=True))
    bad = (status != 0) | ~np.isfinite(place).all(1) | ~np.isfinite(speed).all(1)
    speeds = np.abs(speed[~bad]).max(1)
    quantiles = tuple(float(np.quantile(speeds, x)) for x in QUANTILES)
    return Fallen(int(bad.sum()), count, quantiles, legged.depth(model, place[~bad]))


def stand(how: str, dtype: str, seconds: float) -> Stood:
    """How far a block of the column is from its place at the end [m]."""
    system, state = bounded.column(jnp.dtype(dtype))
    method = jc.Method(bounded=legged.BOUNDED[how])
    start = jc.init(system, method, state.q, state.v)
    steps = int(seconds / SLOW)
    dt = jnp.asarray(SLOW, dtype)
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, dt, steps, every=steps)[0])
    final = run(start)
    moved = float(jnp.max(jnp.abs(final.q - start.q)))
    return Stood(moved, int(final.status))


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walkers", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=4.0, help="of a fall")
    parser.add_argument("--minute", type=float, default=60.0, help="seconds of the column")
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    parser.add_argument("--bounded", nargs="*", default=["GaussSeidel", "InteriorPoint"])
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", "float64" in given.dtypes)
    for dtype in given.dtypes:
        for how in given.bounded if given.minute else ():
            print(f"| column | {dtype} | {how} | {stand(how, dtype, given.minute)} |", flush=True)
    for how in given.bounded if given.walkers else ():
        print(f"| walkers | float32 | {how} |", end=" ", flush=True)
        print(drop(how, "float32", given.walkers, given.seconds), "|", flush=True)


if __name__ == "__main__":
    main()
