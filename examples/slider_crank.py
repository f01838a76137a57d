"""A slider-crank driven at constant speed: the torque that the drive must give.

    python examples/slider_crank.py

Three bodies, three hinges, a slider and a prescribed motion leave no freedom: the motion is known,
and what the equations answer is λ, the torque at the crank and the force in the guide.
"""

import math
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

CRANK, ROD, SPEED = 0.1, 0.35, 100.0


def turning(t: jax.Array, p: dict) -> jax.Array:
    """The angle of the crank, from where it was assembled [rad]."""
    return p["speed"] * t


def build() -> tuple:
    """The engine with its crank upright, all bodies moving as the crank turns."""
    far = math.sqrt(ROD**2 - CRANK**2)
    pin, piston = (0.0, CRANK), (far, 0.0)
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("crank", mass=1.0, inertia=0.002, position=(0.0, 0.0))
    middle = (far / 2, CRANK / 2)
    rod = {"mass": 0.6, "inertia": 0.6 * ROD**2 / 12}
    scene.add_body("rod", **rod, position=middle, angle=math.atan2(-CRANK, far))
    scene.add_body("piston", mass=0.5, inertia=0.001, position=piston)
    scene.add(jc.Revolute("bearing", jc.WORLD, "crank", point=(0.0, 0.0)))
    scene.add(jc.Revolute("crank_pin", "crank", "rod", point=pin))
    scene.add(jc.Revolute("wrist_pin", "rod", "piston", point=piston))
    scene.add(jc.Prismatic("guide", jc.WORLD, "piston", axis=(1.0, 0.0)))
    scene.add(jc.joints.Drive("motor", "bearing", turning, params={"speed": SPEED}))
    system, state = scene.build()
    return system, jc.assemble(system, state).check()  # gives every body the speed of the drive


def main(picture: str = "slider_crank.png") -> None:
    """Turns the crank twice and draws torque and guide force over its angle."""
    system, state = build()
    print(jc.report(system, state))
    turn = 2 * math.pi / SPEED
    method, dt = jc.Method(jc.RK4()), turn / 500

    def record(s: jc.State, _: jc.extend.StepInfo) -> tuple[jax.Array, jax.Array, jax.Array]:
        solution = jc.forward_dynamics(system, s, None, method, dt)
        torque = jc.wrench(solution, "motor")[2]
        side = jc.wrench(solution, "guide")[1]
        return SPEED * s.time, torque, side

    final, (angle, torque, side) = jax.jit(
        lambda s: jc.rollout(system, method, s, None, dt, 1000, record=record)
    )(state)
    jc.raise_for_status(final)
    print(f"torque from {float(torque.min()):.1f} to {float(torque.max()):.1f} N m")
    # without friction the work of a whole turn is what the kinetic energy gains: nothing
    work = float(jnp.mean(torque) * SPEED * turn)
    print(f"mean work of a turn {work:.1e} J, of {float(jnp.max(jnp.abs(torque))):.0f} N m at most")

    from jaxcon import view

    figure, axes = view.pyplot().subplots()
    axes.plot(np.degrees(angle), torque, label="torque of the drive [N m]")
    axes.plot(np.degrees(angle), side / 10, label="force of the guide [10 N]")
    axes.set(xlabel="angle of the crank, from upright [deg]")
    axes.legend()
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
