"""A car parks sideways, though no wheel ever slips: a motion made of Lie brackets.

    python examples/parallel_parking.py

A chassis and a steered front wheel, each on a blade that lets it roll along but not across. The car
drives to and fro once while it steers to and fro twice, u = a sin ωt and δ = β sin 2ωt. By symmetry
it ends where it stood and as it stood, but to the side: along a bracket of brackets of driving and
steering. How hard to steer is found by Newton's method, through the derivative of the simulation.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

WHEELBASE, PERIOD, SPEED, ASIDE = 2.5, 8.0, 1.5, 2.0  # [m], [s], [m/s], [m]
STEPS = 400
OMEGA = 2 * np.pi / PERIOD


def steer(t: jax.Array, p: dict) -> jax.Array:
    """The angle of the front wheel [rad]."""
    return p["angle"] * jnp.sin(2 * OMEGA * t)


def engine(car: jc.extend.Motion, t: jax.Array, p: dict) -> jax.Array:
    """The middle of the rear axle moves forward as fast as the driver wants."""
    forward = car.direction(jnp.array([1.0, 0.0]))
    speed = car.point_velocity(jnp.array([-WHEELBASE / 2, 0.0]))
    return (forward @ speed - p["speed"] * jnp.sin(OMEGA * t))[None]


def build(angle: jax.Array) -> tuple:
    """The car along x, its rear axle at the origin; `angle` is how far it steers [rad]."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    front = (WHEELBASE, 0.0)
    scene.add_body("car", mass=1200.0, inertia=1500.0, position=(WHEELBASE / 2, 0.0))
    turning = 2 * OMEGA * angle
    scene.add_body("wheel", mass=40.0, inertia=2.0, position=front, angular_velocity=turning)
    scene.add(jc.Revolute("steering", "car", "wheel", point=front))
    scene.add(jc.joints.KnifeEdge("rear", jc.WORLD, "car", edge=(1.0, 0.0), center=(0.0, 0.0)))
    scene.add(jc.joints.KnifeEdge("front", jc.WORLD, "wheel", edge=(1.0, 0.0)))
    scene.add(jc.joints.Drive("column", "steering", steer, params={"angle": angle}))
    scene.add(jc.joints.VelocityLevel(engine, ("car",), name="engine", params={"speed": SPEED}))
    return scene.build()


def park(angle: jax.Array) -> tuple:
    """How far aside the car ends [m], and its way there."""
    system, state = build(angle)
    method = jc.Method(integrator=jc.RK4())
    final, path = jc.rollout(system, method, state, None, PERIOD / STEPS, STEPS, every=STEPS // 40)
    return jc.position(system, final, "car")[1], path


def main(picture: str = "parallel_parking.png") -> None:
    """Says what the rows allow, finds the steering, and draws the way."""
    system, state = build(jnp.asarray(0.3))
    print(jc.analysis.integrability(system, state, ["steering", "rear", "front"]))

    slope = jax.jit(jax.value_and_grad(park, has_aux=True))
    angle = jnp.asarray(0.3)
    for _ in range(6):
        (aside, path), derivative = slope(angle)
        print(f"steering by {float(angle):.4f} rad it ends {float(aside):.5f} m aside")
        angle = angle - (aside - ASIDE) / derivative
    end = jax.tree.map(lambda x: x[-1], path)
    along = jc.position(system, end, "car")[0] - WHEELBASE / 2
    turned = jc.orientation(system, end, "car")
    print(f"along it moved {abs(float(along)):.1e} m, and it turned {abs(float(turned)):.1e} rad")

    from jaxcon import view

    axes = view.draw(system, state.q, color="black")
    for q in path.q:
        view.draw(system, q, axes, alpha=0.25, color="C0", label=None)
    view.draw(system, end.q, axes, color="C3", label=None)
    axes.set_title("no wheel slips: black, through blue, to red")
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
