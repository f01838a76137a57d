"""Gymnasium's legged robots dropped on the floor without control, beside MuJoCo.

    python -m benchmarks.legged [--models hopper ant …] [--bounded InteriorPoint GaussSeidel]
        [--dtypes float32 float64] [--batches 1 64] [--ignore self_contact …] [--rates]

Two seconds at 2 ms from the reference pose, every hinge turned a little, so that nothing balances,
and put into its range. MuJoCo's collision detection says how deep geoms are in the floor
and in each other at any time; MuJoCo's own simulation, with its soft contacts and its integrator,
ends where it ends. How they fall is chaotic: heights compare, postures need not. With `--rates`
MuJoCo runs a batch of the same falls on all cores, and MJX in processes of its own, both with
Newton's method and Euler's, and one fall of MJX tells how deep its contacts are. Joints drift here
alone: in the coordinates of both peers there is nothing that could.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import peers, timing
from benchmarks.mjcf import DT
from benchmarks.mjcf_agreement import ASSETS
from jaxcon.constraints.bounds import count_bounds

MODELS = ("hopper", "half_cheetah", "walker2d", "ant", "humanoid")
BOUNDED = {
    "InteriorPoint": jc.InteriorPoint(),
    "GaussSeidel": jc.GaussSeidel(30),
    "Nearest": jc.Nearest(jc.GaussSeidel(30), contacts=8, stops=8),
    "NearestInteriorPoint": jc.Nearest(jc.InteriorPoint(), contacts=8, stops=8),
}
STEPS, EVERY = 1000, 10
TURNED = 0.05
"""By how much joints are turned at the start, at most [rad]."""
WITHIN = 0.01
"""How far they then are from their stops, at least [rad]."""
PLANE, HINGE = 0, 3
"""Of MuJoCo's enumerations."""


class Depth(NamedTuple):
    """The worst of a path: into the floor, into each other, and beyond a range, all ≥ 0.

    Attributes:
        floor, limbs: [m], beyond the margin at which MuJoCo's contacts begin to push.
        joints: [rad].
    """

    floor: float
    limbs: float
    joints: float


class Drop(NamedTuple):
    """What became of a robot.

    Attributes:
        rows: with bounded multipliers.
        compile: of the rollout, tracing included, by batch [s].
        rates: world-steps a second by batch.
        healthy: whether no step failed.
        depth: along the path.
        drift: the largest |φ| of the joints along the path [m, rad].
        height: of the torso at the end [m].
        speed: the largest entry of qvel at the end.
    """

    rows: int
    compile: dict[int, float]
    rates: dict[int, float]
    healthy: bool
    depth: Depth
    drift: float
    height: float
    speed: float


def load(name: str) -> Any:
    """Gymnasium's model of this name, at our step."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.timestep = DT
    return model


def start(model: Any, seed: int = 0) -> np.ndarray:
    """qpos at the start, (nq,)."""
    random, qpos = np.random.default_rng(seed), model.qpos0.copy()
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] == HINGE:
            qpos[q] += random.uniform(-TURNED, TURNED)
        if model.jnt_limited[j]:
            inward = WITHIN + model.jnt_margin[j]
            qpos[q] = np.clip(qpos[q], *(model.jnt_range[j] + np.array([inward, -inward])))
    return qpos


def depth(model: Any, path: np.ndarray) -> Depth:
    """What MuJoCo's collision detection finds along a path of qpos (steps, nq)."""
    import mujoco

    data, floor, limbs, joints = mujoco.MjData(model), 0.0, 0.0, 0.0
    limited = model.jnt_limited.astype(bool) & (model.jnt_type == HINGE)
    lower, upper = model.jnt_range[limited].T
    for data.qpos[:] in path:
        mujoco.mj_forward(model, data)
        for c in data.contact:
            deep, flat = c.includemargin - c.dist, model.geom_type[c.geom[0]] == PLANE
            floor, limbs = max(floor, deep * flat), max(limbs, deep * (not flat))
        θ = data.qpos[model.jnt_qposadr[limited]]
        joints = max(joints, np.max(lower - θ, initial=0), np.max(θ - upper, initial=0))
    return Depth(float(floor), float(limbs), float(joints))


def torso(model: Any, qpos: np.ndarray) -> float:
    """The height of the first body [m]."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return float(data.xpos[1, 2])


def dropped(read: jc.MujocoModel, model: Any, bounded: Any, batches: list[int]) -> Drop:
    """The robot falls, and in a batch several do that are turned differently."""
    system, method = read.system, jc.Method(solver=jc.Sparse(), bounded=bounded)

    def idle(state: jc.State) -> jax.Array:
        return jnp.zeros(system.layout.n_u, state.q.dtype)

    def run(state: jc.State) -> Any:
        return jc.rollout(system, method, state, idle, DT, STEPS, every=EVERY)

    def last(state: jc.State) -> jc.State:
        return jc.rollout(system, method, state, idle, DT, STEPS, every=STEPS)[0]

    first = begun(read, method, start(model))
    (final, states), *measured = timed(run, first, STEPS)
    times, rates = {1: measured[0]}, {1: measured[1]}
    for batch in (b for b in batches if b > 1):
        poses = jnp.asarray([start(model, seed) for seed in range(batch)], first.q.dtype)
        worlds = jax.vmap(lambda qpos: begun(read, method, qpos))(poses)
        worlds = timing.over_devices(worlds, batch)
        ends, times[batch], rates[batch] = timed(jax.vmap(last), worlds, STEPS * batch)
        healthy = np.asarray(ends.status) == 0
        assert healthy.all(), f"{(~healthy).sum()} of {batch} worlds fail"
    path = np.asarray(jax.jit(jax.vmap(read.qpos))(states), np.float64)
    rows, qvel = count_bounds(system, first.q, first.v), np.asarray(read.qvel(final))
    drift = jax.jit(jax.vmap(lambda state: jnp.abs(jc.violation(system, state).position)))(states)
    lost = float(np.max(drift, initial=0))
    found = depth(model, path), lost, torso(model, path[-1]), float(np.abs(qvel).max())
    return Drop(rows, times, rates, int(final.status) == 0, *found)


def timed(run: Any, state: jc.State, work: int) -> tuple[Any, float, float]:
    """What a run returns, how long it compiles [s], and its steps a second, run once."""
    compiled, seconds = timing.compile_seconds(run, state)
    started = time.perf_counter()
    result = jax.block_until_ready(compiled(state))
    return result, seconds, work / (time.perf_counter() - started)


def begun(read: jc.MujocoModel, method: jc.Method, qpos: Any) -> jc.State:
    """At rest in a pose."""
    state = read.state(qpos, jnp.zeros(read.tree.size, read.start.q.dtype))
    turns = state.turns if read.system.counted else None
    return jc.init(read.system, method, state.q, state.v, turns=turns)


class Peer(NamedTuple):
    """A peer's end of the same fall: height of the torso [m], the largest of qvel, and depth."""

    height: float
    speed: float
    depth: Depth

    @classmethod
    def of(cls, model: Any, path: list[Any], qvel: Any) -> Peer:
        """That of a path of qpos."""
        speed = float(np.abs(qvel).max())
        return cls(torso(model, path[-1]), speed, depth(model, np.array(path, np.float64)))

    def line(self, name: str, who: str, dtype: str) -> str:
        """A row of the table."""
        end = f"{self.height:.3f} m | {self.speed:.1e} |"
        return f"| {name} | {who} | {dtype} | | | | {deep(self.depth)} | | {end}"


def simulated(model: Any) -> Peer:
    """The same fall in MuJoCo."""
    import mujoco

    data, path = mujoco.MjData(model), []
    data.qpos[:] = start(model)
    for _ in range(STEPS // EVERY):
        mujoco.mj_step(model, data, EVERY)
        path.append(data.qpos.copy())
    return Peer.of(model, path, data.qvel)


def simulated_by_mjx(name: str) -> Peer:
    """The same fall in MJX, as it is timed."""
    from mujoco import mjx

    model, path = falling(name), []
    put, step = mjx.put_model(model), jax.jit(peers.mjx_step())
    data = mjx.make_data(model)
    data = data.replace(qpos=jnp.asarray(start(model), data.qpos.dtype))
    for count in range(1, STEPS + 1):
        data = step(put, data)
        if count % EVERY == 0:
            path.append(np.asarray(data.qpos))
    return Peer.of(model, path, data.qvel)


def falling(name: str) -> Any:
    """The model as MuJoCo is fast with it."""
    import mujoco

    model = load(name)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


def mujoco_rate(name: str, batch: int) -> timing.Rate:
    """World-steps a second of MuJoCo in C over the same falls."""
    import mujoco

    model, spec = falling(name), mujoco.mjtState.mjSTATE_FULLPHYSICS
    data, states = mujoco.MjData(model), np.zeros((batch, mujoco.mj_stateSize(model, spec)))
    for seed, state in enumerate(states):
        data.qpos[:] = start(model, seed)
        mujoco.mj_getState(model, data, state, spec)
    return peers.rate_of(model, states, STEPS, repeats=3)


def mjx_here(name: str, batch: int) -> dict[str, Any]:
    """That of MJX in this process, and how long a step compiles [s]."""
    from mujoco import mjx

    model = falling(name)
    one, put = mjx.make_data(model), mjx.put_model(model)
    poses = jnp.asarray([start(model, seed) for seed in range(batch)], one.qpos.dtype)
    worlds = jax.vmap(lambda qpos: one.replace(qpos=qpos))(poses)
    return peers.mjx_rate(put, worlds, batch, STEPS, repeats=1)


HEAD = """
| model | bounded | dtype | rows | compile | steps/s | floor, limbs, stops | drift | height | qvel |
|---|---|---|---|---|---|---|---|---|---|"""


def line(name: str, how: str, dtype: str, drop: Drop) -> str:
    """A row of the table."""
    times = ", ".join(f"{x:.0f} s" for x in drop.compile.values())
    rates = ", ".join(f"{rate:.3g} ({batch})" for batch, rate in drop.rates.items())
    height = f"{drop.height:.3f} m" if drop.healthy else "a step failed"
    cells = (
        name,
        how,
        dtype,
        drop.rows,
        times,
        rates,
        deep(drop.depth),
        f"{drop.drift:.1e}",
        height,
    )
    return "| " + " | ".join(map(str, cells)) + f" | {drop.speed:.1e} |"


def deep(depth: Depth) -> str:
    """Depths as a table shows them."""
    return f"{1e3 * depth.floor:.2g} mm, {1e3 * depth.limbs:.2g} mm, {depth.joints:.2g} rad"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--bounded", nargs="*", default=list(BOUNDED))
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    parser.add_argument("--batches", nargs="*", type=int, default=[1, 64])
    parser.add_argument("--ignore", nargs="*", default=[])
    parser.add_argument("--rates", action="store_true", help="run batches of MuJoCo and MJX too")
    parser.add_argument("--mjx-seconds", type=float, default=400.0, help="limit of a batch of MJX")
    parser.add_argument("--mjx", metavar="MODEL", help="MJX alone, here, as JSON")
    parser.add_argument("--mjx-fall", metavar="MODEL", help="a fall of MJX, here, as a row")
    parser.add_argument("--batch", type=int, default=256, help="worlds of MJX alone")
    asked = parser.parse_args()
    if asked.mjx:
        timing.use_all_cores()
        print(json.dumps(mjx_here(asked.mjx, asked.batch)))
        return
    if asked.mjx_fall:
        print(simulated_by_mjx(asked.mjx_fall).line(asked.mjx_fall, "MJX", "float32"))
        return
    timing.use_all_cores()
    jax.config.update("jax_enable_x64", True)
    print(HEAD)
    for name in asked.models:
        model = load(name)
        for dtype in asked.dtypes:
            read = jc.from_mjcf(model, tuple(asked.ignore), dtype=jnp.dtype(dtype))
            for how in asked.bounded:
                drop = dropped(read, model, BOUNDED[how], asked.batches)
                print(line(name, how, dtype, drop), flush=True)
        print(simulated(model).line(name, "MuJoCo", "float64"), flush=True)
        if asked.rates:
            batches = tuple(b for b in asked.batches if b > 1)
            print(f"MuJoCo in C, all cores: {mujoco_rate(name, max(batches))} steps/s")
            other = peers.mjx(name, batches, asked.mjx_seconds, "benchmarks.legged")
            print(
                f"MJX: {other} steps/s; {other.notes}; its depths by `--mjx-fall {name}`",
                flush=True,
            )


if __name__ == "__main__":
    main()
