"""Stiffness and damping of a suspension, so that a car settles as it should.

    python examples/suspension.py

A chassis on a rail stands on a trailing arm whose wheel may slide along the ground: a closed loop.
Lifted by 5 cm and let go, it should come down like a critically damped oscillator of 8 rad/s. The
spring and damper at the hinge are found by gradient through the motion.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxcon as jc

DT, STEPS, EVERY = 4e-3, 250, 5
CAR, ARM, LENGTH = 300.0, 10.0, 0.5  # [kg], [kg], [m]
REST, LIFT, RATE = 0.3, 0.05, 8.0  # heights [m], [1/s]
TIMES = DT * np.arange(EVERY, STEPS + 1, EVERY)
WANTED = REST + LIFT * (1 + RATE * TIMES) * np.exp(-RATE * TIMES)
GUESS = {"stiffness": 1000.0, "damping": 100.0}


def build(p: dict) -> tuple:
    """The lifted car; its spring is preloaded so that it stands at the height of rest."""
    scene = jc.Scene(dim=2)
    height = REST + LIFT
    angle, level = np.arcsin(height / LENGTH), np.arcsin(REST / LENGTH)
    hinge, wheel = (0.0, height), (LENGTH * np.cos(angle), 0.0)
    middle = np.add(hinge, wheel) / 2
    scene.add_body("chassis", mass=CAR, inertia=100.0, position=hinge)
    scene.add_body("arm", mass=ARM, inertia=ARM * LENGTH**2 / 12, position=middle, angle=-angle)
    scene.add(jc.Prismatic("rail", jc.WORLD, "chassis", axis=(0.0, 1.0)))
    scene.add(jc.Revolute("hinge", "chassis", "arm", point=hinge))
    scene.add(jc.joints.PointOnLine("ground", jc.WORLD, "arm", axis=(1.0, 0.0), point=wheel))
    load = (CAR + ARM / 2) * 9.81 * LENGTH * np.cos(level)  # [N m]
    rest = angle - level - load / p["stiffness"]
    scene.add(jc.forces.JointSpring("spring", "hinge", p["stiffness"], p["damping"], rest=rest))
    return scene.build()


def settle(p: dict) -> jax.Array:
    """The height of the chassis over time, (STEPS / EVERY,) [m]."""
    system, state = build(p)

    def record(s: jc.State, _: jc.extend.StepInfo) -> jax.Array:
        return jc.position(system, s, "chassis")[1]

    method = jc.Method(solver=jc.solvers.Schur())
    final, height = jc.rollout(system, method, state, None, DT, STEPS, record=record, every=EVERY)
    return jc.learning.losses.unless_failed(height, final)


def loss(p: dict) -> jax.Array:
    """log₁₀ of the root mean square of the error of the height [m]."""
    return jnp.log10(jc.learning.losses.tracking(settle(p), WANTED)) / 2


def fit(steps: int = 80) -> jc.learning.Tuned:
    """Adam on the logarithms of stiffness and damping."""
    optimizer = optax.adam(optax.cosine_decay_schedule(0.2, steps))
    return jc.tune(loss, GUESS, positive=True, steps=steps, optimizer=optimizer)


def main(picture: str = "suspension.png") -> None:
    """Fits, prints and draws."""
    found = fit()
    print(found)
    stiffness, damping = (float(found.params[name]) for name in ("stiffness", "damping"))
    print(f"stiffness {stiffness:.0f} N m/rad and damping {damping:.0f} N m s/rad")
    print(f"the car settles within {1e3 * 10**found.loss:.2f} mm (rms) of what is wanted")

    from jaxcon import view

    axes = view.pyplot().subplots()[1]
    axes.plot(TIMES, WANTED, "k--", label="wanted")
    for p, label in ((GUESS, "at the start"), (found.params, "fitted")):
        axes.plot(TIMES, jax.jit(settle)(p), label=label)
    axes.set(xlabel="time [s]", ylabel="height [m]")
    axes.legend()
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
