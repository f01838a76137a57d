"""Whether models read by `from_mjcf` move as MuJoCo moves them.

    python -m benchmarks.mjcf_agreement [--models ant hopper …] [--loops …]

Gymnasium's own models, contacts and limits switched off in both: accelerations at random states and
controls, relative to the largest of each state, and the worst difference of qpos along trajectories
by RK4 at 0.1 ms. Closed loops (`benchmarks.loops`), which MuJoCo closes softly: the difference of
accelerations at several impedances d, which vanishes as 1 − d, and by how far the loops stand open
after a second.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import loops

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
MODELS = (
    "ant",
    "half_cheetah",
    "hopper",
    "humanoid",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "point",
    "pusher",
    "reacher",
    "walker2d",
)
ACCELERATION, TRAJECTORY = 1e-8, 1e-6
"""Bounds: relative, and of qpos [m], [rad]."""
EXACT = jc.Method(jc.RK4(), jc.Unstabilized(), jc.Dense())
SPARSE = jc.Method(jc.RK4(), jc.Unstabilized(), jc.Sparse())
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Options of XLA: these programs run once, and compile longer than they run."""
IMPEDANCES = (0.99, 0.999, 0.9999)


class States(NamedTuple):
    """qpos, qvel and ctrl by rows."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray


def quick(function: Any) -> Any:
    """Compiled quickly."""
    return jax.jit(function, compiler_options=QUICK)


def load(name: str) -> Any:
    """Gymnasium's model of this name, without contacts and limits."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= int(flags.mjDSBL_CONTACT) | int(flags.mjDSBL_LIMIT)
    return model


def random_states(model: Any, count: int, seed: int = 0) -> States:
    """Joints anywhere in their ranges, or within a radian or metre of the reference where none."""
    random = np.random.default_rng(seed)
    qpos = model.qpos0 + random.uniform(-1, 1, (count, model.nq))
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] < 2:  # free and ball
            first = q + 3 * (model.jnt_type[j] == 0)
            turn = random.normal(size=(count, 4))
            qpos[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        elif model.jnt_range[j].any():
            qpos[:, q] = random.uniform(*model.jnt_range[j], count)
    most = np.abs(model.actuator_ctrlrange).max(axis=1, initial=0)
    ctrl = 1.2 * most * random.uniform(-1, 1, (count, model.nu))  # some are out of their range
    return States(qpos, random.normal(size=(count, model.nv)), ctrl)


def mujoco_accelerations(model: Any, states: States) -> np.ndarray:
    """qacc of MuJoCo by states."""
    import mujoco

    data, found = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(*states, strict=True):
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found)


def accelerations(read: jc.MujocoModel, states: States, method: jc.Method) -> np.ndarray:
    """qacc of jaxcon by states."""

    def accelerate(qpos: Any, qvel: Any, ctrl: Any) -> Any:
        state = read.state(qpos, qvel)
        solution = jc.forward_dynamics(read.system, state, ctrl, method, 1e-3)
        return read.qacc(state, solution.acceleration)

    return np.asarray(quick(jax.vmap(accelerate))(*map(jnp.asarray, states)))


def relative(got: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """The largest difference over the largest entry, by rows."""
    return np.abs(got - expected).max(axis=1) / np.abs(expected).max(axis=1)


def acceleration_error(model: Any, count: int = 100) -> float:
    """The worst relative difference of qacc."""
    states, read = random_states(model, count), jc.from_mjcf(model)
    return relative(accelerations(read, states, EXACT), mujoco_accelerations(model, states)).max()


def trajectory_error(model: Any, dt: float = 1e-4, seconds: float = 0.2, every: int = 100) -> float:
    """The worst difference of qpos between RK4 in both, from a random state under one control.

    It is the first state from which three hinges of one body stay out of their gimbal lock: there
    an orientation has no three angles, and limits, which are switched off, would keep them away.
    """
    import mujoco

    steps = round(seconds / dt)
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_RK4
    starts = zip(*random_states(model, 100), strict=True)
    start = next(s for s in map(States._make, starts) if stays_clear(model, s, steps, every))
    read = jc.from_mjcf(model, count_turns=True)
    control = jnp.broadcast_to(jnp.asarray(start.ctrl), (steps, model.nu))
    run = jax.jit(lambda s: jc.rollout(read.system, SPARSE, s, control, dt, steps, every=every)[1])
    path = run(read.state(start.qpos, start.qvel))
    jc.raise_for_status(jax.tree.map(lambda x: x[-1], path))
    got = quick(jax.vmap(read.qpos))(path)
    data, worst = started(model, start), 0.0
    for row in np.asarray(got):
        mujoco.mj_step(model, data, every)
        worst = max(worst, float(np.abs(same_signs(model, row, data.qpos) - data.qpos).max()))
    return worst


def started(model: Any, start: States) -> Any:
    """MuJoCo's own state."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start
    return data


def stays_clear(model: Any, start: States, steps: int, every: int, least: float = 0.05) -> bool:
    """Whether the axes of three hinges on one body span space all the way in MuJoCo."""
    import mujoco

    hinges = mujoco.mjtJoint.mjJNT_HINGE
    firsts = model.body_jntadr[model.body_jntnum == 3]
    threes = [np.arange(j, j + 3) for j in firsts if (model.jnt_type[j : j + 3] == hinges).all()]
    data = started(model, start)
    mujoco.mj_forward(model, data)
    signs = [np.sign(np.linalg.det(data.xaxis[three])) for three in threes]
    for _ in range(steps // every):
        mujoco.mj_step(model, data, every)
        spans = [s * np.linalg.det(data.xaxis[t]) for s, t in zip(signs, threes, strict=True)]
        if min(spans, default=1.0) < least:
            return False
    return True


def same_signs(model: Any, qpos: np.ndarray, like: np.ndarray) -> np.ndarray:
    """qpos with each quaternion of the two signs that is nearer."""
    result = qpos.copy()
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] < 2:
            part = slice(q + 3 * (model.jnt_type[j] == 0), q + 3 * (model.jnt_type[j] == 0) + 4)
            result[part] *= np.sign(result[part] @ like[part])
    return result


class Loop(NamedTuple):
    """What is found of a closed loop.

    Attributes:
        errors: of qacc, relative, by impedance.
        limit: of qacc, continued linearly to 1 − d = 0.
        closure: how far the loop stands open after a second [m].
        peer: the same of MuJoCo, closed as stiffly as its step allows.
    """

    errors: tuple[float, ...]
    limit: float
    closure: float
    peer: float


def loop_agreement(name: str, dt: float = 2e-3) -> Loop:
    """A closed loop in both, in the midst of a motion that begins at rest."""
    import mujoco

    text = loops.LOOPS[name]()
    model = mujoco.MjModel.from_xml_string(text)
    read = jc.from_mjcf(model)
    solver = jc.Schur(tikhonov=loops.TIKHONOV) if name in loops.REDUNDANT else jc.Schur()
    steps = round(1 / dt)
    control = jnp.asarray(loops.CONTROL[name])
    path = rolled(read, jc.Method(solver=solver), control, dt, steps)
    middle = jax.tree.map(lambda x: x[steps // 2], path)
    states = closed(model, read.qpos(middle), read.qvel(middle), control)
    got = accelerations(read, states, jc.Method(stabilizer=jc.Unstabilized(), solver=solver))
    found = [mujoco_accelerations(stiffened(model, d, dt), states) for d in IMPEDANCES]
    (_, a), (_, b) = pairs = list(zip(IMPEDANCES, found, strict=True))[-2:]
    ratio = (1 - pairs[1][0]) / (1 - pairs[0][0])
    return Loop(
        tuple(float(relative(x, got)[0]) for x in found),
        float(relative((b - ratio * a) / (1 - ratio), got)[0]),
        closure(model, np.asarray(read.qpos(jax.tree.map(lambda x: x[-1], path)))),
        closure(model, simulated(stiffened(model, 0.9999, dt), np.asarray(control), dt, steps)),
    )


def closed(model: Any, qpos: Any, qvel: Any, control: Any) -> States:
    """The nearest state whose loops are closed exactly: MuJoCo pulls at open ones."""
    import copy

    import mujoco

    dense = copy.copy(model)
    dense.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(dense)
    data.qpos[:], data.qvel[:] = qpos, qvel
    for _ in range(5):
        mujoco.mj_forward(dense, data)
        back = np.linalg.pinv(data.efc_J.reshape(-1, dense.nv), rcond=1e-9)
        mujoco.mj_integratePos(dense, data.qpos, -back @ data.efc_pos, 1.0)
    mujoco.mj_forward(dense, data)
    jacobian = data.efc_J.reshape(-1, dense.nv)
    data.qvel -= np.linalg.pinv(jacobian, rcond=1e-9) @ jacobian @ data.qvel
    return States(*(np.array(x)[None] for x in (data.qpos, data.qvel, control)))


def rolled(read: jc.MujocoModel, method: jc.Method, control: Any, dt: float, steps: int) -> Any:
    """A trajectory from rest."""
    controls = jnp.broadcast_to(control, (steps, control.shape[0]))
    run = quick(lambda s: jc.rollout(read.system, method, s, controls, dt, steps))
    final, path = run(read.start)
    jc.raise_for_status(final)
    return path


def stiffened(model: Any, impedance: float, dt: float) -> Any:
    """The model with equalities of this impedance, as fast as the step allows."""
    import copy

    stiff = copy.copy(model)
    stiff.opt.timestep = dt
    stiff.eq_solref[:] = (2 * dt, 1.0)
    stiff.eq_solimp[:] = (impedance, impedance, 0.001, 0.5, 2.0)
    return stiff


def simulated(model: Any, control: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """qpos after MuJoCo's own steps from rest."""
    import mujoco

    data = mujoco.MjData(model)
    data.ctrl[:] = control
    mujoco.mj_step(model, data, steps)
    return data.qpos.copy()


def closure(model: Any, qpos: np.ndarray) -> float:
    """The largest gap of an equality as MuJoCo measures it [m]."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rows = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return float(np.abs(data.efc_pos[rows]).max())


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--loops", nargs="*", default=list(loops.LOOPS))
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'model':26s} {'qacc':>8s} {'qpos':>8s}")
    for name in asked.models:
        a, path = acceleration_error(load(name)), trajectory_error(load(name))
        good = a <= ACCELERATION and path <= TRAJECTORY
        print(f"{name:26s} {a:8.1e} {path:8.1e}  {'same' if good else 'NOT THE SAME'}", flush=True)
    heads = " ".join(f"{f'd={d}':>9s}" for d in IMPEDANCES)
    print(f"{'loop':26s} {heads} {'limit':>9s} {'open':>9s} {'MuJoCo':>9s}")
    for name in asked.loops:
        found = loop_agreement(name)
        numbers = (*found.errors, *found[1:])
        print(f"{name:26s} " + " ".join(f"{x:9.1e}" for x in numbers), flush=True)


if __name__ == "__main__":
    main()
