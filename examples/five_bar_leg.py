"""A five-bar leg: two motors at the hip move a foot, by gradient.

    python examples/five_bar_leg.py

Four links and the hip close a loop; both motors stand on the ground, so the leg is light. The
angles that put the foot where it should be are found by descending the gradient through
`jc.assemble`, which closes the loop differentiably; then servos walk through them.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

HIP, THIGH, SHANK = 0.05, 0.2, 0.3
DT, STEPS = 1e-3, 1000


def build() -> tuple:
    """The leg standing upright below its hip."""
    scene = jc.Scene(dim=2)
    knee_x = HIP + THIGH * np.cos(0.8)
    knee_y = -THIGH * np.sin(0.8)
    foot = (0.0, knee_y - np.sqrt(SHANK**2 - knee_x**2))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        hip, knee = np.array([sign * HIP, 0.0]), np.array([sign * knee_x, knee_y])
        for name, start, end, mass in (("thigh", hip, knee, 0.3), ("shank", knee, foot, 0.2)):
            way = np.subtract(end, start)
            turn, inertia = np.arctan2(way[1], way[0]), mass * (way @ way) / 12
            middle = start + way / 2
            scene.add_body(
                f"{side}_{name}", mass=mass, inertia=inertia, position=middle, angle=turn
            )
        scene.add(jc.Revolute(f"{side}_hip", jc.WORLD, f"{side}_thigh", hip))
        scene.add(jc.Revolute(f"{side}_knee", f"{side}_thigh", f"{side}_shank", knee))
        scene.add(
            jc.forces.PositionServo(f"{side}_servo", f"{side}_hip", stiffness=200.0, damping=4.0)
        )
    scene.add(jc.Revolute("ankle", "left_shank", "right_shank", foot))
    return *scene.build(), np.array(foot)


def main(picture: str = "five_bar_leg.png") -> None:
    """Finds the angles of the hips along a step, walks through them, and draws the foot's way."""
    system, state, foot = build()
    print(jc.report(system, state))
    thighs = [system.layout.q(f"{side}_thigh") for side in ("left", "right")]
    hold = ("left_thigh", "right_thigh")
    tip = jnp.array([SHANK / 2, 0.0])

    def reach(angles: jax.Array) -> jax.Array:
        """Where the foot is when the hips are turned by these angles, (2,) [m]."""
        q = state.q
        for index, angle, sign in zip(thighs, angles, (-1.0, 1.0), strict=True):
            start = q[index[2]] + angle
            way = THIGH / 2 * jnp.stack([jnp.cos(start), jnp.sin(start)])
            hip = jnp.array([sign * HIP, 0.0])
            q = q.at[index].set(jnp.append(hip + way, start))
        return jc.position(system, jc.assemble(system, q, hold=hold).state, "left_shank", tip)

    phase = jnp.linspace(0.0, 2 * jnp.pi, 24, endpoint=False)
    goals = foot + jnp.stack([0.05 * jnp.sin(phase), 0.03 * (1 - jnp.cos(phase))], axis=1)

    def loss(angles: jax.Array) -> jax.Array:
        """The mean square of the distance from the goals, log₁₀ [m]."""
        return jnp.log10(jc.learning.losses.tracking(jax.vmap(reach)(angles), goals)) / 2

    found = jc.tune(loss, jnp.zeros((len(phase), 2)), steps=150)
    angles = found.params
    print(f"the foot is within {10**found.loss:.1e} m of the step's 24 places")

    clock = jnp.linspace(0.0, 2 * jnp.pi, STEPS)
    controls = jax.vmap(
        lambda a: jnp.interp(clock, phase, a, period=2 * jnp.pi), in_axes=1, out_axes=1
    )(angles)

    def record(s: jc.State, _: jc.extend.StepInfo) -> jax.Array:
        return jc.position(system, s, "left_shank", tip)

    final, way = jax.jit(
        lambda s: jc.rollout(system, jc.Method(), s, controls, DT, STEPS, record=record)
    )(state)
    jc.raise_for_status(final)
    print(f"loop open by {float(jc.violation(system, final).worst):.1e} m after {DT * STEPS} s")

    from jaxcon import view

    axes = view.draw(system, state.q)
    axes.plot(*np.asarray(goals).T, "k.", label="wanted")
    axes.plot(*np.asarray(way).T, "k", lw=0.8, label="foot")
    axes.legend(fontsize=7)
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
