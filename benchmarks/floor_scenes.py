"""Rates of two scenes on a floor, beside MuJoCo in C: free boxes, and a leg with a closed loop.

    python -m benchmarks.floor_scenes [--scenes boxes leg] [--batches 64 128 1024]

Ten boxes of eight corners each fall and come to rest. The leg stands on a foot that is a sphere:
its thigh, its shank and a rod are a four-bar linkage, and its hip is free to move in a plane. Both
simulators read the same MJCF. MuJoCo has a thread a core, Newton's method and the Euler integrator;
jaxcon has a device a core and `model.method()`. Every world starts from another pose.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import peers, timing
from benchmarks.legged import begun

DT, STEPS, BOXES = 0.002, 500, 10

FLOOR = """<mujoco><option timestep="0.002" integrator="Euler" solver="Newton"/><worldbody>
<geom type="plane" size="10 10 1" contype="2" conaffinity="1"/>"""

BOX = """<body pos="{x} 0 0.4"><freejoint/>
<geom type="box" size="0.1 0.08 0.05" mass="1" contype="1" conaffinity="2"/></body>"""

LEG = """<body name="base" pos="0 0 0.62"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="-0.1 0 0 0.2 0 0" size="0.04" mass="4" contype="0" conaffinity="0"/>
<body><joint name="hip" axis="0 1 0" damping="0.5"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
<body name="shank" pos="0 0 -0.3"><joint name="knee" axis="0 1 0"/>
<geom type="capsule" fromto="0.1 0 0 0 0 -0.3" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
<geom type="sphere" pos="0 0 -0.3" size="0.03" mass="0.1" contype="1" conaffinity="2"/>
</body></body>
<body name="rod" pos="0.1 0 0"><joint name="rear" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
</body></body>"""

LOOP = '<equality><connect body1="rod" body2="shank" anchor="0 0 -0.3"/></equality>'


def boxes() -> str:
    """Returns the model of the boxes."""
    bodies = "".join(BOX.format(x=0.5 * k) for k in range(BOXES))
    return f"{FLOOR}{bodies}</worldbody></mujoco>"


def leg() -> str:
    """Returns the model of the leg."""
    return f"{FLOOR}{LEG}</worldbody>{LOOP}</mujoco>"


def box_pose(model: Any, seed: int) -> np.ndarray:
    """Returns qpos with all boxes turned at random."""
    random, pose = np.random.default_rng(seed), model.qpos0.copy()
    for k in range(BOXES):
        turn = random.standard_normal(4)
        pose[7 * k + 3 : 7 * k + 7] = turn / np.linalg.norm(turn)
    return pose


def leg_pose(model: Any, seed: int) -> np.ndarray:
    """Returns qpos with a random angle of the thigh; the rod and the shank close the loop."""
    angle, pose = np.random.default_rng(seed).uniform(-0.4, 0.4), model.qpos0.copy()
    pose[3:] = angle, -angle, angle
    return pose


Pose = Callable[[Any, int], np.ndarray]

SCENES: dict[str, tuple[Callable[[], str], Pose]] = {
    "boxes": (boxes, box_pose),
    "leg": (leg, leg_pose),
}


def rate_here(name: str, batch: int) -> tuple[timing.Rate, float, int]:
    """Measures jaxcon: world-steps per second, compile time [s], and the worlds that failed."""
    model, pose = loaded(name)
    robot = jc.from_mjcf(model, dtype=jnp.dtype("float32"))
    method, system = robot.method(), robot.system
    poses = jnp.asarray([pose(model, seed) for seed in range(batch)], jnp.float32)
    states = jc.shard(jax.vmap(lambda q: begun(robot, method, q))(poses))

    def fall(state: jc.State) -> jc.State:
        return jc.rollout(system, method, state, None, DT, STEPS, record=lambda s, i: None)[0]

    run, seconds = timing.compile_seconds(jax.vmap(fall), states)
    failed = int(jnp.sum(run(states).status != 0))
    return timing.rate(lambda: run(states), batch * STEPS, repeats=3), seconds, failed


def rate_of_mujoco(name: str, batch: int) -> timing.Rate:
    """Measures world-steps per second of MuJoCo in C."""
    mujoco: Any = importlib.import_module("mujoco")

    model, pose = loaded(name)
    data, spec = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((batch, mujoco.mj_stateSize(model, spec)))
    for seed, state in enumerate(states):
        data.qpos[:] = pose(model, seed)
        mujoco.mj_getState(model, data, state, spec)
    return peers.rate_of(model, states, STEPS, repeats=3)


def loaded(name: str) -> tuple[Any, Pose]:
    """Returns a compiled model and its poses."""
    mujoco: Any = importlib.import_module("mujoco")

    text, pose = SCENES[name]
    return mujoco.MjModel.from_xml_string(text()), pose


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        "benchmarks.floor_scenes",
        None,
        __doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--batches", nargs="*", type=int, default=[64, 128, 1024])
    args = parser.parse_args()
    timing.use_all_cores()
    print("| scene | worlds | jaxcon | failed | compile | MuJoCo C |\n|---|---|---|---|---|---|")
    for name in args.scenes:
        for batch in args.batches:
            rate, seconds, failed = rate_here(name, batch)
            peer = rate_of_mujoco(name, batch)
            print(
                f"| {name} | {batch} | {rate} | {failed} | {seconds:.1f} s | {peer} |", flush=True
            )


if __name__ == "__main__":
    main()
