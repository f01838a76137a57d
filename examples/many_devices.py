"""Linkages over all devices, and over processes: rolled out, differentiated, and tuned.

    python examples/many_devices.py

A spring and a damper at the crank are to bring four-bars, whose lengths are scattered by a few per
cent, to rest at an angle, on the average. The batch lies over all devices; on a CPU it is made of
several. Over two processes on one machine the numbers are the same to rounding:

    python examples/many_devices.py --coordinator localhost:12345 --processes 2 --process 0 &
    python examples/many_devices.py --coordinator localhost:12345 --processes 2 --process 1

and so over hosts, with the address of the first. `--save FILE` writes them.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather

import jaxcon as jc
from jaxcon import scenes

DT, STEPS = 2e-3, 250
START, GOAL = 0.5, 1.0  # angles of the crank [rad]
GUESS = {"stiffness": 10.0, "damping": 0.3}  # [N m/rad], [N m s/rad]
METHOD = jc.Method(solver=jc.solvers.Schur())


def scattered(worlds: int) -> np.ndarray:
    """Lengths of ground, crank, coupler and rocker of each linkage, (worlds, 4) [m]."""
    scatter = np.random.default_rng(0).uniform(0.97, 1.03, (worlds, 4))
    return scatter * scenes.CRANK_ROCKER


def settle(p: dict, lengths: jax.Array) -> tuple[jc.State, jax.Array]:
    """One linkage after half a second, and how far its crank is off: (angle, rate / 10), (2,)."""
    k, c = p["stiffness"], p["damping"]
    spring = jc.forces.JointSpring("spring", "ground_crank", k, c, rest=GOAL - START)
    system, state = scenes.four_bar(lengths, angle=START, rate=0.0, elements=[spring])
    dt = jnp.asarray(DT, state.q.dtype)
    final, _ = jc.rollout(system, METHOD, state, None, dt, STEPS, record=lambda s, i: None)
    angle = jc.orientation(system, final, "crank")
    return final, jnp.stack([angle - GOAL, jc.angular_velocity(system, final, "crank") / 10])


def loss(p: dict, lengths: jax.Array) -> jax.Array:
    """The mean over linkages of the square of what they are off; each device has its own."""
    final, off = jc.devices.over_devices(jax.vmap(settle, in_axes=(None, 0)))(p, lengths)
    return jc.learning.losses.unless_failed(jnp.mean(jnp.sum(off**2, axis=1)), final)


def tune(lengths: np.ndarray, steps: int) -> jc.learning.Tuned:
    """Adam on the logarithms; the first process shows how far it is."""
    shown = None if jax.process_index() == 0 else False
    own = {"positive": True, "steps": steps, "progress": shown}
    return jc.tune(lambda p: loss(p, jnp.asarray(lengths)), GUESS, **own)


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=240)
    parser.add_argument("--steps", type=int, default=30, help="of the search")
    parser.add_argument("--devices", type=int, default=2, help="of a process, on a CPU")
    parser.add_argument("--coordinator", help="host:port of the first of several processes")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--process", type=int, default=0, help="which of them this is")
    parser.add_argument("--save", metavar="FILE", help="where the numbers go, as .npz")
    return parser.parse_args()


def main() -> None:
    """Joins the other processes, rolls out, differentiates, tunes, and says what was found."""
    given = arguments()
    jax.config.update("jax_num_cpu_devices", given.devices)
    if given.coordinator:
        jax.distributed.initialize(given.coordinator, given.processes, given.process)
    lengths = scattered(given.worlds)
    batch = jc.shard(jnp.asarray(lengths))
    final, _ = jax.jit(jax.vmap(settle, in_axes=(None, 0)))(GUESS, batch)
    value, slope = jax.jit(jax.value_and_grad(loss))(GUESS, batch)
    found = tune(lengths, given.steps)
    q, status = process_allgather((final.q, final.status), tiled=True)  # to every process
    jc.raise_for_status(status)
    if jax.process_index() > 0:
        return
    print(f"{given.worlds} linkages on {jax.device_count()} devices, processes: {given.processes}")
    print(f"loss {float(value):.6g}, its gradient { ({k: float(x) for k, x in slope.items()}) }")
    print(found)
    if given.save:
        numbers = {f"d_{name}": x for name, x in slope.items()} | found.params
        np.savez(given.save, q=q, loss=value, history=found.history, **numbers)


if __name__ == "__main__":
    main()
