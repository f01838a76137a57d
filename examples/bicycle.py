"""A bicycle without a rider's hands is pushed from the side: it falls, or it steers itself upright.

    python examples/bicycle.py

Four bodies, three hinges and two wheels that roll without slip, with the numbers of the benchmark
bicycle. Between 4.29 and 6.02 m/s it is stable: pushed, it steers into its lean and comes back up,
on another heading. Slower, it weaves ever wider.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.scenes import bicycle

STEP, SECONDS, PUSH = 4e-3, 4.0, 60.0  # [s], [s], [N] at the centre of mass for a fifth of a second


def ride(speed: float) -> tuple:
    """The system, and its way [s] by [s] after a push from the left."""
    system, state = bicycle(speed)
    steps = round(SECONDS / STEP)
    side = system.layout.control("push").start + 1
    controls = jnp.zeros((steps, system.layout.n_u)).at[: round(0.2 / STEP), side].set(PUSH)
    method = jc.Method(integrator=jc.RK4())
    run = jax.jit(lambda s, u: jc.rollout(system, method, s, u, STEP, steps, every=10))
    final, path = run(state, controls)
    jc.raise_for_status(final)
    return system, path


def angles(system: jc.Scene, path: jc.State) -> tuple:
    """Lean of the frame and angle of the handlebar [rad]."""

    def one(state: jc.State) -> tuple:
        frame, fork = (jc.orientation(system, state, name) for name in ("frame", "fork"))
        lean = jnp.arcsin(jc.quaternion.matrix(frame)[2, 1])
        turn = jc.quaternion.multiply(jc.quaternion.conjugate(frame), fork)
        return lean, 2 * jnp.arctan2(jnp.sign(turn[3]) * jnp.linalg.norm(turn[1:]), turn[0])

    return jax.vmap(one)(path)


def main(picture: str = "bicycle.png") -> None:
    """Rides at two speeds and draws lean, steering angle and the way of the rear wheel."""
    jax.config.update("jax_enable_x64", True)
    from jaxcon.view import pyplot

    figure, (top, bottom) = pyplot().subplots(2, 1, figsize=(8, 7))
    for color, speed in (("C0", 5.0), ("C3", 3.8)):
        system, path = ride(speed)
        lean, steering = angles(system, path)
        energy = jax.vmap(lambda s, m=system: jc.energy(m, s).total)(path)[10:]
        drift = float(jnp.max(jnp.abs(energy - energy[0])))
        print(f"at {speed} m/s: lean {np.rad2deg(lean[-1]):.2f}° at the end", end=", ")
        print(f"at most {np.rad2deg(jnp.max(jnp.abs(lean))):.1f}°; energy kept to {drift:.1e} J")
        top.plot(path.time, np.rad2deg(lean), color, label=f"lean at {speed} m/s")
        top.plot(path.time, np.rad2deg(steering), color, ls="--", label="handlebar")
        wheel = jax.vmap(lambda s, m=system: jc.position(m, s, "rear_wheel"))(path)
        bottom.plot(wheel[:, 0], wheel[:, 1], color)
    top.set(xlabel="time [s]", ylabel="angle [°]")
    top.legend()
    bottom.set(xlabel="x [m]", ylabel="y, to the right [m]", title="the way of the rear wheel")
    bottom.invert_yaxis()
    figure.tight_layout()
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
