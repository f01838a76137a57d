"""A four-bar linkage of your own: build it, check it, run it, look at it.

    python examples/four_bar.py

Three rods in the plane, four hinges, one closed loop: 9 velocities, 8 constraint rows, 1 degree of
freedom. Points are given in the world frame, where the linkage now stands.
"""

import math
import sys

import jax
import numpy as np

import jaxcon as jc

# The four hinges, where the linkage stands at the start [m].
A, B, C, D = (0.0, 0.0), (0.2, 0.3), (1.0, 0.8), (1.2, 0.0)


def rod(scene: jc.Scene, name: str, start: tuple, end: tuple, mass: float) -> None:
    """Adds a uniform rod between two points: inertia m l² / 12 about its middle."""
    middle = tuple((s + e) / 2 for s, e in zip(start, end, strict=True))
    angle = math.atan2(end[1] - start[1], end[0] - start[0])
    inertia = mass * math.dist(start, end) ** 2 / 12
    scene.add_body(name, mass=mass, inertia=inertia, position=middle, angle=angle)


def build() -> tuple:
    """The linkage, with a spring that pulls the crank and a damper in the last hinge."""
    scene = jc.Scene(dim=2)
    rod(scene, "crank", A, B, mass=0.5)
    rod(scene, "coupler", B, C, mass=1.0)
    rod(scene, "rocker", D, C, mass=1.0)
    scene.add(jc.Revolute("a", jc.WORLD, "crank", point=A))
    scene.add(jc.Revolute("b", "crank", "coupler", point=B))
    scene.add(jc.Revolute("c", "coupler", "rocker", point=C))
    scene.add(jc.Revolute("d", "rocker", jc.WORLD, point=D))
    scene.add(jc.Spring("spring", jc.WORLD, "crank", stiffness=40.0, point_a=(-0.5, 0), point_b=B))
    scene.add(jc.forces.JointDamper("friction", "d", damping=0.05))
    return scene.build()


def main(picture: str = "four_bar.png") -> None:
    """Runs two seconds at one millisecond and draws the motion."""
    system, state = build()
    print(jc.report(system, state))

    run = jax.jit(lambda s: jc.rollout(system, jc.Method(), s, None, 1e-3, 2000, every=50))
    final, trajectory = run(state)
    jc.raise_for_status(final)
    print(f"\nafter 2 s: violation {jc.violation(system, final).worst:.1e} m")

    # What the last hinge holds: force (2,) and torque on the ground, from the multipliers.
    no_feedback = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
    solution = jc.forward_dynamics(system, final, None, no_feedback, 1e-3)
    print("force of the rocker on the ground [N]:", jc.wrench(solution, "d")[:2])
    path = jax.vmap(lambda s: jc.position(system, s, "coupler"))(trajectory)
    print("the middle of the coupler, first and last [m]:", np.asarray(path[0]), path[-1])

    from jaxcon import view

    axes = view.draw(system, state.q)
    for q in trajectory.q[::4]:
        view.draw(system, q, axes, alpha=0.2, label=None)
    axes.legend()
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
