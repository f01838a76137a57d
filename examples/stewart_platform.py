"""A Stewart platform on six servos: thirteen bodies, five independent closed loops, six freedoms.

    python examples/stewart_platform.py

Each leg is a cylinder on a cross joint, a piston that slides in it, and a ball under the platform.
The servos get the lengths that the legs would have if the platform were where it should be.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

HOME, PERIOD, DT, STEPS = np.array([0.0, 0.0, 1.0]), 2.0, 2e-3, 2000


def ring(radius: float, spread: float, phase: float) -> np.ndarray:
    """Six points in three pairs on a circle, (6, 3) [m]."""
    pair, side = np.arange(6) // 2, np.arange(6) % 2 * 2 - 1
    angle = phase + pair * 2 * np.pi / 3 + side * spread
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


FEET, HEADS = ring(0.8, 0.25, 0.0), ring(0.4, np.pi / 3 - 0.25, 0.0)


def upright_to(direction: np.ndarray) -> jax.Array:
    """The turn that takes z to a direction, wxyz."""
    across = np.cross([0.0, 0.0, 1.0], direction)
    angle = np.arctan2(np.linalg.norm(across), direction[2])
    return jc.quaternion.from_axis_angle(across, angle)


def build() -> tuple:
    """The platform at home, 20 kg, on legs of two times 2 kg."""
    scene = jc.Scene()
    scene.add_body("platform", mass=20.0, inertia=(0.8, 0.8, 1.6), position=HOME)
    part = jc.inertia.cylinder(2.0, 0.03, 0.5)
    for i, (foot, head) in enumerate(zip(FEET, HEADS + HOME, strict=True)):
        along = (head - foot) / np.linalg.norm(head - foot)
        turn = upright_to(along)
        first = np.cross(along, [0.0, 0.0, 1.0])
        scene.add_body(f"cylinder{i}", inertia=part, position=foot + 0.3 * along, quaternion=turn)
        scene.add_body(f"piston{i}", inertia=part, position=head - 0.3 * along, quaternion=turn)
        crossed = {"axis_a": first, "axis_b": np.cross(along, first)}
        scene.add(jc.joints.Universal(f"foot{i}", jc.WORLD, f"cylinder{i}", foot, **crossed))
        scene.add(jc.Prismatic(f"leg{i}", f"cylinder{i}", f"piston{i}", axis=along))
        scene.add(jc.Spherical(f"head{i}", f"piston{i}", "platform", head))
        scene.add(jc.forces.PositionServo(f"servo{i}", f"leg{i}", stiffness=2e5, damping=4e3))
    return scene.build()


def wanted(t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where the platform should be: a circle of 0.1 m, reached in the first period, and leaning."""
    phase, grown = 2 * jnp.pi * t / PERIOD, jnp.minimum(t / PERIOD, 1.0)
    circle = jnp.stack([jnp.cos(phase), jnp.sin(phase), 0.0 * phase])
    lean = jc.quaternion.from_axis_angle(circle, 0.15 * grown)
    return HOME.astype(circle.dtype) + 0.1 * grown * circle, lean


def lengths(t: jax.Array) -> jax.Array:
    """What the legs are to be longer than at home, (6,) [m]."""
    position, turn = wanted(t)
    heads = position + jax.vmap(lambda x: jc.quaternion.rotate(turn, x))(jnp.asarray(HEADS))
    home = np.linalg.norm(HEADS + HOME - FEET, axis=1)
    return jnp.linalg.norm(heads - jnp.asarray(FEET), axis=1) - jnp.asarray(home)


def main(picture: str = "stewart_platform.png") -> None:
    """Follows the circle for two periods and draws the way, and how far off it is."""
    system, state = build()
    report = jc.report(system, state)
    print(f"{report.velocities} velocities, {report.degrees_of_freedom} degrees of freedom")
    times = DT * jnp.arange(STEPS)
    controls = jax.vmap(lengths)(times)

    def record(s: jc.State, _: jc.extend.StepInfo) -> tuple[jax.Array, jax.Array]:
        return jc.position(system, s, "platform"), jc.violation(system, s).worst

    final, (path, violation) = jax.jit(
        lambda s: jc.rollout(system, jc.Method(), s, controls, DT, STEPS, record=record)
    )(state)
    jc.raise_for_status(final)
    goal = jax.vmap(lambda t: wanted(t)[0])(times + DT)
    error = jnp.linalg.norm(path - goal, axis=1)
    print(f"off its way by {float(error.max()):.1e} m, loops open by {float(violation.max()):.1e}")

    from jaxcon import view

    figure, (left, right) = view.pyplot().subplots(1, 2, figsize=(10, 4))
    view.draw(system, state.q, left, label=None)
    view.draw(system, final.q, left, alpha=0.3, label=None)
    right.plot(path[:, 0], path[:, 1], label="platform")
    right.plot(goal[:, 0], goal[:, 1], "k:", label="wanted")
    right.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    right.legend()
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
