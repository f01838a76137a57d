"""Gymnasium's legged robots dropped on the floor without control, compared with MuJoCo.

    python -m benchmarks.legged [--models hopper ant …] [--bounded InteriorPoint GaussSeidel]
        [--dtypes float32 float64] [--batches 1 64] [--ignore self_contact …] [--rates]

Each robot falls for two seconds at 2 ms. It starts from the reference pose with every hinge turned
by a small random angle, within its range, so that it does not balance. MuJoCo's collision detection
measures how far geoms penetrate the floor and each other. Falls are chaotic: final heights are
comparable with MuJoCo's own simulation, final postures are not.

With `--rates`, a batch of falls also runs in MuJoCo on all cores, and in MJX in its own processes.
Both use Newton's method and the Euler integrator. One fall in MJX measures its penetrations. Joints
can drift only in jaxcon: MuJoCo and MJX use reduced coordinates.
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
from jaxcon.contact.rows import count_bounds

MODELS = ("hopper", "half_cheetah", "walker2d", "ant", "humanoid")
BOUNDED = {
    "Newton": jc.solvers.Newton(),
    "InteriorPoint": jc.solvers.InteriorPoint(),
    "GaussSeidel": jc.solvers.GaussSeidel(30),
    "ActiveSet": jc.solvers.ActiveSet(jc.solvers.GaussSeidel(30), contacts=8, stops=8),
    "NearestInteriorPoint": jc.solvers.ActiveSet(jc.solvers.InteriorPoint(), contacts=8, stops=8),
}
STEPS, EVERY = 1000, 10
TURNED = 0.05
"""Largest random rotation of the joints at the start [rad]."""
WITHIN = 0.01
"""Smallest initial distance from a joint limit [rad]."""
PLANE, HINGE = 0, 3
"""Values of planes and hinges in MuJoCo's enumerations of geom and joint types."""


class Depth(NamedTuple):
    """The largest penetrations of geoms, and the largest violation of a joint limit.

    Attributes:
        floor: penetration of the floor [m], beyond the margin at which MuJoCo's contacts act.
        limbs: penetration of other geoms [m], beyond the same margin.
        joints: angle beyond a joint limit [rad].
    """

    floor: float
    limbs: float
    joints: float


class Drop(NamedTuple):
    """Result of a falling robot.

    Attributes:
        rows: number of inequality rows.
        compile: compile time of the rollout, including tracing, by batch size [s].
        rates: world-steps per second by batch size.
        healthy: True if no step failed.
        depth: largest penetrations along the path.
        drift: largest |φ| of the joints along the path [m, rad].
        height: final height of the torso [m].
        speed: largest final entry of qvel.
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
    """Loads Gymnasium's model of this name, with the step size of the benchmarks."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    model.opt.timestep = DT
    return model


def start(model: Any, seed: int = 0) -> np.ndarray:
    """Draws a random initial qpos, (nq,)."""
    random, qpos = np.random.default_rng(seed), model.qpos0.copy()
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] == HINGE:
            qpos[q] += random.uniform(-TURNED, TURNED)
        if model.jnt_limited[j]:
            inward = WITHIN + model.jnt_margin[j]
            qpos[q] = np.clip(qpos[q], *(model.jnt_range[j] + np.array([inward, -inward])))
    return qpos


def depth(model: Any, path: np.ndarray) -> Depth:
    """Returns the largest penetrations along a path of qpos, (steps, nq).

    MuJoCo's collision detection measures them.
    """
    import mujoco

    data, floor, limbs, joints = mujoco.MjData(model), 0.0, 0.0, 0.0
    limited = model.jnt_limited.astype(bool) & (model.jnt_type == HINGE)
    lower, upper = model.jnt_range[limited].T
    for data.qpos[:] in path:
        mujoco.mj_forward(model, data)
        for c in data.contact:
            penetration, on_floor = c.includemargin - c.dist, model.geom_type[c.geom[0]] == PLANE
            floor, limbs = (
                max(floor, penetration * on_floor),
                max(limbs, penetration * (not on_floor)),
            )
        θ = data.qpos[model.jnt_qposadr[limited]]
        joints = max(joints, np.max(lower - θ, initial=0), np.max(θ - upper, initial=0))
    return Depth(float(floor), float(limbs), float(joints))


def torso(model: Any, qpos: np.ndarray) -> float:
    """Returns the height of the first body, the torso [m]."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return float(data.xpos[1, 2])


def dropped(robot: jc.io.MujocoModel, model: Any, bounded: Any, batches: list[int]) -> Drop:
    """Drops one robot, and batches of robots with different initial angles."""
    system, method = robot.system, jc.Method(solver=jc.solvers.Sparse(), contact_solver=bounded)

    def idle(state: jc.State) -> jax.Array:
        return jnp.zeros(system.layout.n_u, state.q.dtype)

    def run(state: jc.State) -> Any:
        return jc.rollout(system, method, state, idle, DT, STEPS, every=EVERY)

    def last(state: jc.State) -> jc.State:
        return jc.rollout(system, method, state, idle, DT, STEPS, every=STEPS)[0]

    first = begun(robot, method, start(model))
    (final, states), seconds, rate = timed(run, first, STEPS)
    times, rates = {1: seconds}, {1: rate}
    for batch in (b for b in batches if b > 1):
        poses = jnp.asarray([start(model, seed) for seed in range(batch)], first.q.dtype)
        worlds = jax.vmap(lambda qpos: begun(robot, method, qpos))(poses)
        worlds = timing.over_devices(worlds, batch)
        ends, times[batch], rates[batch] = timed(jax.vmap(last), worlds, STEPS * batch)
        healthy = np.asarray(ends.status) == 0
        assert healthy.all(), f"{(~healthy).sum()} of {batch} worlds fail"
    path = np.asarray(jax.jit(jax.vmap(robot.qpos))(states), np.float64)
    rows, qvel = count_bounds(system, first.q, first.v), np.asarray(robot.qvel(final))
    drift = jax.jit(jax.vmap(lambda state: jnp.abs(jc.violation(system, state).position)))(states)
    largest_drift = float(np.max(drift, initial=0))
    result = depth(model, path), largest_drift, torso(model, path[-1]), float(np.abs(qvel).max())
    return Drop(rows, times, rates, int(final.status) == 0, *result)


def timed(run: Any, state: jc.State, work: int) -> tuple[Any, float, float]:
    """Compiles and runs a function once.

    Returns:
        Its result, the compile time [s], and steps per second.
    """
    compiled, seconds = timing.compile_seconds(run, state)
    started = time.perf_counter()
    result = jax.block_until_ready(compiled(state))
    return result, seconds, work / (time.perf_counter() - started)


def begun(robot: jc.io.MujocoModel, method: jc.Method, qpos: Any) -> jc.State:
    """Returns a state at rest with the given qpos."""
    state = robot.state(qpos, jnp.zeros(robot.tree.size, robot.start.q.dtype))
    turns = state.turns if robot.system.counted else None
    return jc.init(robot.system, method, state.q, state.v, turns=turns)


class Peer(NamedTuple):
    """The result of a fall in MuJoCo or MJX.

    Attributes:
        height: final height of the torso [m].
        speed: largest final entry of qvel.
        depth: largest penetrations along the path.
    """

    height: float
    speed: float
    depth: Depth

    @classmethod
    def of(cls, model: Any, path: list[Any], qvel: Any) -> Peer:
        """Evaluates a path of qpos and the final qvel."""
        speed = float(np.abs(qvel).max())
        return cls(torso(model, path[-1]), speed, depth(model, np.array(path, np.float64)))

    def line(self, name: str, who: str, dtype: str) -> str:
        """Formats the result as a table row."""
        end = f"{self.height:.3f} m | {self.speed:.1e} |"
        return f"| {name} | {who} | {dtype} | | | | {deep(self.depth)} | | {end}"


def simulated(model: Any) -> Peer:
    """Simulates the fall in MuJoCo and returns its result."""
    import mujoco

    data, path = mujoco.MjData(model), []
    data.qpos[:] = start(model)
    for _ in range(STEPS // EVERY):
        mujoco.mj_step(model, data, EVERY)
        path.append(data.qpos.copy())
    return Peer.of(model, path, data.qvel)


def simulated_by_mjx(name: str) -> Peer:
    """Simulates the fall in MJX, with the settings used for the rates."""
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
    """Returns the model with MuJoCo's fastest settings."""
    import mujoco

    model = load(name)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


def mujoco_rate(name: str, batch: int) -> timing.Rate:
    """Measures world-steps per second of MuJoCo in C for a batch of falls."""
    import mujoco

    model, spec = falling(name), mujoco.mjtState.mjSTATE_FULLPHYSICS
    data, states = mujoco.MjData(model), np.zeros((batch, mujoco.mj_stateSize(model, spec)))
    for seed, state in enumerate(states):
        data.qpos[:] = start(model, seed)
        mujoco.mj_getState(model, data, state, spec)
    return peers.rate_of(model, states, STEPS, repeats=3)


def mjx_here(name: str, batch: int) -> dict[str, Any]:
    """Measures MJX in this process: world-steps per second, and compile time of a step [s]."""
    from mujoco import mjx

    model = falling(name)
    single, device_model = mjx.make_data(model), mjx.put_model(model)
    poses = jnp.asarray([start(model, seed) for seed in range(batch)], single.qpos.dtype)
    worlds = jax.vmap(lambda qpos: single.replace(qpos=qpos))(poses)
    return peers.mjx_rate(device_model, worlds, batch, STEPS, repeats=1)


HEAD = """
| model | solver | dtype | rows | compile | steps/s | floor, limbs, limits | drift | height | qvel |
|---|---|---|---|---|---|---|---|---|---|"""


def line(name: str, solver: str, dtype: str, drop: Drop) -> str:
    """Formats the result of a drop in jaxcon as a table row."""
    times = ", ".join(f"{x:.0f} s" for x in drop.compile.values())
    rates = ", ".join(f"{rate:.3g} ({batch})" for batch, rate in drop.rates.items())
    height = f"{drop.height:.3f} m" if drop.healthy else "a step failed"
    cells = (
        name,
        solver,
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
    """Formats penetrations and limit violations."""
    return f"{1e3 * depth.floor:.2g} mm, {1e3 * depth.limbs:.2g} mm, {depth.joints:.2g} rad"


def main() -> None:
    """Prints the table of drops, or with `--mjx` and `--mjx-fall` a result of MJX."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--bounded", nargs="*", default=list(BOUNDED))
    parser.add_argument("--dtypes", nargs="*", default=["float32", "float64"])
    parser.add_argument("--batches", nargs="*", type=int, default=[1, 64])
    parser.add_argument("--ignore", nargs="*", default=[])
    parser.add_argument("--rates", action="store_true", help="also run batches in MuJoCo and MJX")
    parser.add_argument("--mjx-seconds", type=float, default=400.0, help="time limit of MJX [s]")
    parser.add_argument("--mjx", metavar="MODEL", help="rate of MJX in this process, as JSON")
    parser.add_argument("--mjx-fall", metavar="MODEL", help="one fall in MJX, as a table row")
    parser.add_argument("--batch", type=int, default=256, help="batch size of --mjx")
    options = parser.parse_args()
    if options.mjx:
        timing.use_all_cores()
        print(json.dumps(mjx_here(options.mjx, options.batch)))
        return
    if options.mjx_fall:
        print(simulated_by_mjx(options.mjx_fall).line(options.mjx_fall, "MJX", "float32"))
        return
    timing.use_all_cores()
    jax.config.update("jax_enable_x64", True)
    print(HEAD)
    for name in options.models:
        model = load(name)
        for dtype in options.dtypes:
            robot = jc.from_mjcf(model, tuple(options.ignore), dtype=jnp.dtype(dtype))
            for solver in options.bounded:
                drop = dropped(robot, model, BOUNDED[solver], options.batches)
                print(line(name, solver, dtype, drop), flush=True)
        print(simulated(model).line(name, "MuJoCo", "float64"), flush=True)
        if options.rates:
            batches = tuple(b for b in options.batches if b > 1)
            print(f"MuJoCo in C, all cores: {mujoco_rate(name, max(batches))} steps/s")
            rate = peers.mjx(name, batches, options.mjx_seconds, "benchmarks.legged")
            print(
                f"MJX: {rate} steps/s; {rate.notes}; penetrations by `--mjx-fall {name}`",
                flush=True,
            )


if __name__ == "__main__":
    main()
