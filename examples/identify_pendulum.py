"""Masses and lengths of a double pendulum, from what its angles were seen to do.

    python examples/identify_pendulum.py

Two uniform rods swing for two seconds, and their angles are recorded with an error of a degree. The
lengths and the ratio of the masses follow from that, but not the masses: twice as heavy, it would
move alike, and the report says so. A known torque at the shoulder tells them, too.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

DT, STEPS, EVERY = 5e-3, 400, 4
NOISE = np.deg2rad(1.0)
TRUTH = {"length": {"lower": 0.7, "upper": 1.0}, "mass": {"lower": 0.6, "upper": 1.5}}
GUESS = {"length": {"lower": 0.8, "upper": 0.9}, "mass": {"lower": 1.0, "upper": 1.0}}
TIMES = DT * np.arange(STEPS)
TORQUE = 4.0 * np.sin(5.0 * TIMES)


def build(p: dict) -> tuple:
    """The pendulum held out at rest; a torque acts on the upper rod."""
    scene = jc.Scene(dim=2)
    end = jnp.zeros(2)
    for name, angle in (("upper", -0.6), ("lower", -0.2)):
        mass, length = p["mass"][name], p["length"][name]
        way = length * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        inertia = mass * length**2 / 12
        scene.add_body(name, mass=mass, inertia=inertia, position=end + way / 2, angle=angle)
        holder = jc.WORLD if name == "upper" else "upper"
        scene.add(jc.Revolute(f"{name}_hinge", holder, name, point=end))
        end = end + way
    scene.add(jc.forces.ExternalWrench("torque", "upper"))
    return scene.build()


def swing(p: dict, torque: jax.Array) -> jax.Array:
    """Both angles over time, (STEPS / EVERY, 2) [rad]."""
    system, state = build(p)

    def record(s: jc.State, _: jc.extend.StepInfo) -> jax.Array:
        return jnp.stack([jc.orientation(system, s, name) for name in ("upper", "lower")])

    control = jnp.zeros((STEPS, 3)).at[:, 2].set(torque)
    method = jc.Method(solver=jc.solvers.Schur())
    final, angles = jc.rollout(
        system, method, state, control, DT, STEPS, record=record, every=EVERY
    )
    return jc.learning.losses.unless_failed(angles, final)


def free(p: dict) -> jax.Array:
    """Under gravity alone."""
    return swing(p, jnp.zeros(STEPS))


def driven(p: dict) -> jax.Array:
    """With the known torque."""
    return swing(p, TORQUE)


def identify(simulate, seed: int = 0) -> jc.learning.Identified:
    """What a noisy recording of the true pendulum tells."""
    angles = np.asarray(jax.jit(simulate)(TRUTH))
    data = angles + NOISE * np.random.default_rng(seed).normal(size=angles.shape)
    return jc.identify(simulate, GUESS, data, positive=True, noise=NOISE)


def main(picture: str = "identify_pendulum.png") -> None:
    """Prints both reports, and draws the recording with what was fitted to it."""
    for label, simulate in (("gravity alone", free), ("a known torque", driven)):
        found = identify(simulate)
        print(f"{label}: {found}\n")
    lower, upper = (found.params["mass"][name] for name in ("lower", "upper"))
    print(f"masses {float(lower):.3f} and {float(upper):.3f} kg; they are 0.600 and 1.500 kg")

    from jaxcon import view

    axes = view.pyplot().subplots()[1]
    motion = jax.jit(driven)
    angles = np.asarray(motion(TRUTH))
    noisy = angles + NOISE * np.random.default_rng(0).normal(size=angles.shape)
    axes.plot(TIMES[EVERY - 1 :: EVERY], noisy, ".", ms=3)
    for p, style in ((GUESS, ":"), (found.params, "-")):
        axes.set_prop_cycle(None)
        axes.plot(TIMES[EVERY - 1 :: EVERY], motion(p), style, lw=1)
    axes.set(xlabel="time [s]", ylabel="angles [rad]", title="recorded, guessed (dotted), fitted")
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
