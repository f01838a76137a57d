"""Checks that models read by `from_mjcf` move as in MuJoCo.

    python -m benchmarks.mjcf_agreement [--models ant hopper …] [--loops …]

Gymnasium's models run without contacts and joint limits in both simulators. Accelerations are
compared at random states and controls, relative to the largest entry of each state. Trajectories by
RK4 at 0.1 ms are compared by the largest difference of qpos.

MuJoCo closes the loops of `benchmarks.loops` softly. The difference of accelerations at several
impedances d vanishes as 1 − d. The gap of the loops is measured after a second.
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
    "swimmer",
    "walker2d",
)
ACCELERATION, TRAJECTORY = 1e-8, 1e-6
"""Bounds on the relative error of accelerations and on the error of qpos [m, rad]."""
EXACT = jc.Method(jc.RK4(), jc.stabilizers.Unstabilized(), jc.solvers.Dense())
SPARSE = jc.Method(jc.RK4(), jc.stabilizers.Unstabilized(), jc.solvers.Sparse())
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""XLA options for fast compilation: these programs run once, and take longer to compile."""
IMPEDANCES = (0.99, 0.999, 0.9999)


class States(NamedTuple):
    """States of a model with their controls: qpos, qvel and ctrl, one row per state."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray


def quick(function: Any) -> Any:
    """Compiles a function with the options `QUICK`."""
    return jax.jit(function, compiler_options=QUICK)


def load(name: str) -> Any:
    """Loads Gymnasium's model of this name, without contacts and joint limits."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= int(flags.mjDSBL_CONTACT) | int(flags.mjDSBL_LIMIT)
    return model


def random_states(model: Any, count: int, seed: int = 0) -> States:
    """Draws random states.

    Joint positions are within their ranges. Without a range, they are within 1 rad or 1 m of the
    reference.
    """
    random = np.random.default_rng(seed)
    qpos = model.qpos0 + random.uniform(-1, 1, (count, model.nq))
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] < 2:  # free and ball
            first = q + 3 * (model.jnt_type[j] == 0)
            quaternions = random.normal(size=(count, 4))
            qpos[:, first : first + 4] = quaternions / np.linalg.norm(
                quaternions, axis=1, keepdims=True
            )
        elif model.jnt_range[j].any():
            qpos[:, q] = random.uniform(*model.jnt_range[j], count)
    largest = np.abs(model.actuator_ctrlrange).max(axis=1, initial=0)
    ctrl = 1.2 * largest * random.uniform(-1, 1, (count, model.nu))  # 1.2: some are out of range
    return States(qpos, random.normal(size=(count, model.nv)), ctrl)


def mujoco_accelerations(model: Any, states: States) -> np.ndarray:
    """Returns MuJoCo's qacc, one row per state."""
    import mujoco

    data, accelerations = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.ctrl[:] in zip(*states, strict=True):
        mujoco.mj_forward(model, data)
        accelerations.append(data.qacc.copy())
    return np.array(accelerations)


def accelerations(imported: jc.io.MujocoModel, states: States, method: jc.Method) -> np.ndarray:
    """Returns jaxcon's qacc, one row per state."""

    def accelerate(qpos: Any, qvel: Any, ctrl: Any) -> Any:
        state = imported.state(qpos, qvel)
        solution = jc.forward_dynamics(imported.system, state, ctrl, method, 1e-3)
        return imported.qacc(state, solution.acceleration)

    return np.asarray(quick(jax.vmap(accelerate))(*map(jnp.asarray, states)))


def relative(actual: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Returns the largest difference in each row over the largest expected entry of the row."""
    return np.abs(actual - expected).max(axis=1) / np.abs(expected).max(axis=1)


def acceleration_error(model: Any, count: int = 100) -> float:
    """Returns the largest relative difference of qacc between jaxcon and MuJoCo."""
    states, imported = random_states(model, count), jc.from_mjcf(model)
    return relative(
        accelerations(imported, states, EXACT), mujoco_accelerations(model, states)
    ).max()


def trajectory_error(model: Any, dt: float = 1e-4, seconds: float = 0.2, every: int = 100) -> float:
    """Returns the largest difference of qpos between jaxcon and MuJoCo, both by RK4.

    The trajectory starts from a random state with constant control. It is the first one that stays
    away from the gimbal lock of three hinges on one body. In gimbal lock three angles do not
    determine an orientation. Joint limits would prevent it, but they are switched off.
    """
    import mujoco

    steps = round(seconds / dt)
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_RK4
    starts = zip(*random_states(model, 100), strict=True)
    start = next(s for s in map(States._make, starts) if stays_clear(model, s, steps, every))
    imported = jc.from_mjcf(model, count_turns=True)
    control = jnp.broadcast_to(jnp.asarray(start.ctrl), (steps, model.nu))
    run = jax.jit(
        lambda s: jc.rollout(imported.system, SPARSE, s, control, dt, steps, every=every)[1]
    )
    path = run(imported.state(start.qpos, start.qvel))
    jc.raise_for_status(jax.tree.map(lambda x: x[-1], path))
    positions = quick(jax.vmap(imported.qpos))(path)
    data, worst = started(model, start), 0.0
    for row in np.asarray(positions):
        mujoco.mj_step(model, data, every)
        worst = max(worst, float(np.abs(same_signs(model, row, data.qpos) - data.qpos).max()))
    return worst


def started(model: Any, start: States) -> Any:
    """Returns new MuJoCo data of a model, set to a state and its controls."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start
    return data


def stays_clear(model: Any, start: States, steps: int, every: int, threshold: float = 0.05) -> bool:
    """Returns True if three hinges on one body stay linearly independent along a run in MuJoCo."""
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
        if min(spans, default=1.0) < threshold:
            return False
    return True


def same_signs(model: Any, qpos: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Returns qpos with the sign of each quaternion chosen closest to `reference`."""
    result = qpos.copy()
    for j, q in enumerate(model.jnt_qposadr):
        if model.jnt_type[j] < 2:
            part = slice(q + 3 * (model.jnt_type[j] == 0), q + 3 * (model.jnt_type[j] == 0) + 4)
            result[part] *= np.sign(result[part] @ reference[part])
    return result


class Loop(NamedTuple):
    """Agreement of a closed loop between jaxcon and MuJoCo.

    Attributes:
        errors: relative errors of qacc, by impedance.
        limit: relative error of qacc, extrapolated linearly to impedance d = 1.
        closure: gap of the loop after a second in jaxcon [m].
        peer: gap in MuJoCo with the stiffest closure at this step size [m].
    """

    errors: tuple[float, ...]
    limit: float
    closure: float
    peer: float


def loop_agreement(name: str, dt: float = 2e-3) -> Loop:
    """Compares a closed loop in jaxcon and MuJoCo, halfway through a motion from rest."""
    import mujoco

    text = loops.LOOPS[name]()
    model = mujoco.MjModel.from_xml_string(text)
    imported = jc.from_mjcf(model)
    solver = (
        jc.solvers.Schur(tikhonov=loops.TIKHONOV) if name in loops.REDUNDANT else jc.solvers.Schur()
    )
    steps = round(1 / dt)
    control = jnp.asarray(loops.CONTROL[name])
    path = rolled(imported, jc.Method(solver=solver), control, dt, steps)
    middle = jax.tree.map(lambda x: x[steps // 2], path)
    states = closed(model, imported.qpos(middle), imported.qvel(middle), control)
    expected = accelerations(
        imported, states, jc.Method(stabilizer=jc.stabilizers.Unstabilized(), solver=solver)
    )
    soft = [mujoco_accelerations(stiffened(model, d, dt), states) for d in IMPEDANCES]
    (_, a), (_, b) = pairs = list(zip(IMPEDANCES, soft, strict=True))[-2:]
    ratio = (1 - pairs[1][0]) / (1 - pairs[0][0])
    return Loop(
        tuple(float(relative(x, expected)[0]) for x in soft),
        float(relative((b - ratio * a) / (1 - ratio), expected)[0]),
        closure(model, np.asarray(imported.qpos(jax.tree.map(lambda x: x[-1], path)))),
        closure(model, simulated(stiffened(model, 0.9999, dt), np.asarray(control), dt, steps)),
    )


def closed(model: Any, qpos: Any, qvel: Any, control: Any) -> States:
    """Returns the nearest state with exactly closed loops.

    MuJoCo pulls at open loops, which would change its accelerations.
    """
    import copy

    import mujoco

    dense = copy.copy(model)
    dense.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(dense)
    data.qpos[:], data.qvel[:] = qpos, qvel
    for _ in range(5):
        mujoco.mj_forward(dense, data)
        inverse = np.linalg.pinv(data.efc_J.reshape(-1, dense.nv), rcond=1e-9)
        mujoco.mj_integratePos(dense, data.qpos, -inverse @ data.efc_pos, 1.0)
    mujoco.mj_forward(dense, data)
    jacobian = data.efc_J.reshape(-1, dense.nv)
    data.qvel -= np.linalg.pinv(jacobian, rcond=1e-9) @ jacobian @ data.qvel
    return States(*(np.array(x)[None] for x in (data.qpos, data.qvel, control)))


def rolled(
    imported: jc.io.MujocoModel, method: jc.Method, control: Any, dt: float, steps: int
) -> Any:
    """Simulates a model from rest and returns the trajectory."""
    controls = jnp.broadcast_to(control, (steps, control.shape[0]))
    run = quick(lambda s: jc.rollout(imported.system, method, s, controls, dt, steps))
    final, path = run(imported.start)
    jc.raise_for_status(final)
    return path


def stiffened(model: Any, impedance: float, dt: float) -> Any:
    """Returns the model with stiff equalities of a given impedance.

    Their time constant is two steps, the smallest stable value.
    """
    import copy

    stiff = copy.copy(model)
    stiff.opt.timestep = dt
    stiff.eq_solref[:] = (2 * dt, 1.0)
    stiff.eq_solimp[:] = (impedance, impedance, 0.001, 0.5, 2.0)
    return stiff


def simulated(model: Any, control: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """Returns qpos after a number of MuJoCo's steps from rest."""
    import mujoco

    data = mujoco.MjData(model)
    data.ctrl[:] = control
    mujoco.mj_step(model, data, steps)
    return data.qpos.copy()


def closure(model: Any, qpos: np.ndarray) -> float:
    """Returns the largest gap of an equality as MuJoCo measures it [m]."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rows = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return float(np.abs(data.efc_pos[rows]).max())


def main() -> None:
    """Prints the tables of models and of loops."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--loops", nargs="*", default=list(loops.LOOPS))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'model':26s} {'qacc':>8s} {'qpos':>8s}")
    for name in options.models:
        a, path = acceleration_error(load(name)), trajectory_error(load(name))
        same = a <= ACCELERATION and path <= TRAJECTORY
        print(f"{name:26s} {a:8.1e} {path:8.1e}  {'same' if same else 'NOT THE SAME'}", flush=True)
    heads = " ".join(f"{f'd={d}':>9s}" for d in IMPEDANCES)
    print(f"{'loop':26s} {heads} {'limit':>9s} {'open':>9s} {'MuJoCo':>9s}")
    for name in options.loops:
        agreement = loop_agreement(name)
        numbers = (*agreement.errors, *agreement[1:])
        print(f"{name:26s} " + " ".join(f"{x:9.1e}" for x in numbers), flush=True)


if __name__ == "__main__":
    main()
