"""Drops of thousands of robots that must come to rest, and a heavy column that must stay up.

    python -m benchmarks.falls [--models walker2d ant] [--worlds 4096] [--seconds 4] [--minute 60]
        [--dtypes float32 float64] [--bounded default GaussSeidel InteriorPoint]

Gymnasium's robots start with their hinge angles random within their ranges and in any orientation.
Poses whose limbs overlap are drawn again. The lowest point is 0.1 m to 1 m above the floor, and all
joints move. The robots fall without control at a step size of 2 ms. The column is that of
`benchmarks.bounded` at 5 ms: ten guided blocks, with a block of thousandfold mass on top.
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

HEIGHTS, SLOW = (0.1, 1.0), 5e-3
"""Range of the height of the lowest point at the start [m], and step size of the column [s]."""
SPEED = 1.0
"""Standard deviation of the initial joint velocities [m/s, rad/s]."""
FREE, SLIDE = 0, 2
"""Values of free joints and slides in MuJoCo's enumeration of joint types."""


QUANTILES = (0.5, 0.9, 0.99, 1)
"""Quantiles of the final speeds."""


class Fallen(NamedTuple):
    """Result of a batch of robots.

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
    """Draws random initial qpos and qvel of robots, (count, …) each."""
    import mujoco

    random, data = np.random.default_rng(seed), mujoco.MjData(model)
    drawn: list[np.ndarray] = []
    while len(drawn) < count:
        data.qpos[:] = model.qpos0
        height = 0
        for j, q in enumerate(model.jnt_qposadr):
            if model.jnt_type[j] == FREE:
                turn = random.normal(size=4)
                data.qpos[q + 3 : q + 7] = turn / np.linalg.norm(turn)
                height = q + 2
            elif model.jnt_type[j] == SLIDE:
                height = q if model.jnt_axis[j][2] else height
            elif model.jnt_limited[j]:
                inward = np.array([1, -1]) * (legged.WITHIN + model.jnt_margin[j])
                data.qpos[q] = random.uniform(*(model.jnt_range[j] + inward))
            else:
                data.qpos[q] = random.uniform(-np.pi, np.pi)
        data.qpos[height] += 10  # no contact but of limbs
        mujoco.mj_forward(model, data)
        if all(c.dist > 0 for c in data.contact):
            data.qpos[height] += random.uniform(*HEIGHTS) - lowest(model, data)
            drawn.append(data.qpos.copy())
    return np.stack(drawn), SPEED * random.normal(size=(count, model.nv))


def lowest(model: Any, data: Any) -> float:
    """Returns the height of the lowest point of all spheres and capsules [m]."""
    limbs = model.geom_type != legged.PLANE
    reach = model.geom_size[limbs, 0] + np.abs(data.geom_xmat[limbs, 8]) * model.geom_size[limbs, 1]
    return float(np.min(data.geom_xpos[limbs, 2] - reach))


def drop(name: str, how: str, dtype: str, count: int, seconds: float) -> Fallen:
    """Drops robots and counts failures.

    Final speeds and penetrations are those of the healthy worlds.

    Args:
        name: the model.
        how: a contact solver of `legged.BOUNDED`; or "default", the method of the model.
        dtype: float32 or float64.
        count: the number of robots.
        seconds: the duration of a fall [s].
    """
    model = legged.load(name)
    robot = jc.from_mjcf(model, dtype=jnp.dtype(dtype))
    method = robot.method()
    if how != "default":
        method = jc.Method(solver=jc.solvers.Sparse(), contact_solver=legged.BOUNDED[how])
    steps = int(seconds / DT)

    def fall(place: jax.Array, speed: jax.Array) -> tuple[Any, Any, Any]:
        state = robot.state(place, speed)
        turns = state.turns if robot.system.counted else None
        state = jc.init(robot.system, method, state.q, state.v, turns=turns)
        controls = jnp.zeros((steps, robot.system.layout.n_u), state.q.dtype)
        final, _ = jc.rollout(robot.system, method, state, controls, DT, steps, every=steps)
        return final.status, robot.qpos(final), robot.qvel(final)

    starts = [jnp.asarray(x, dtype) for x in poses(model, count)]
    ends = jax.jit(jax.vmap(fall))(*starts)
    status, place, speed = (np.asarray(x, np.float64) for x in ends)
    bad = (status != 0) | ~np.isfinite(place).all(1) | ~np.isfinite(speed).all(1)
    speeds = np.abs(speed[~bad]).max(1)
    quantiles = tuple(float(np.quantile(speeds, x)) for x in QUANTILES)
    return Fallen(int(bad.sum()), count, quantiles, legged.depth(model, place[~bad]))


def stand(how: str, dtype: str, seconds: float) -> Stood:
    """Simulates the column and measures the largest displacement of its blocks [m]."""
    system, state = bounded.column(jnp.dtype(dtype))
    method = jc.Method()
    if how != "default":
        method = jc.Method(contact_solver=legged.BOUNDED[how])
    start = jc.init(system, method, state.q, state.v)
    steps = int(seconds / SLOW)
    dt = jnp.asarray(SLOW, dtype)
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, dt, steps, every=steps)[0])
    final = run(start)
    moved = float(jnp.max(jnp.abs(final.q - start.q)))
    return Stood(moved, int(final.status))


def main() -> None:
    """Prints the tables of the column and of the robots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="*", default=["walker2d", "ant"])
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--seconds", type=float, default=4.0, help="duration of a fall [s]")
    parser.add_argument("--minute", type=float, default=60.0, help="duration of the column [s]")
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    parser.add_argument("--bounded", nargs="*", default=["default", "GaussSeidel", "InteriorPoint"])
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", "float64" in options.dtypes)
    for dtype in options.dtypes:
        for solver in options.bounded:
            if options.minute:
                stood = stand(solver, dtype, options.minute)
                print(f"| column | {dtype} | {solver} | {stood} |", flush=True)
            for name in options.models if options.worlds else ():
                fallen = drop(name, solver, dtype, options.worlds, options.seconds)
                print(f"| {name} | {dtype} | {solver} | {fallen} |", flush=True)


if __name__ == "__main__":
    main()
