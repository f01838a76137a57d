"""N four-bars side by side: one freedom, many closed loops, and singular positions twice a turn.

    python examples/n_four_bar.py

N + 1 rods hang on the ground, N more join their ends. Where all of them lie in one line the rows
are dependent, and a solver of equations meets zero over zero; `RankSafe`, the solver of a method
that names none, takes the mechanism through.

References:
    IFToMM Technical Committee for Multibody Dynamics, Library of Computational Benchmark Problems,
    problem A02.
"""

import sys

import jax
import numpy as np

import jaxcon as jc

jax.config.update("jax_enable_x64", True)  # for the energy to ten digits

N, DT, STEPS = 5, 2e-3, 1000


def build(n: int = N) -> tuple:
    """Rods of 1 m and 1 kg, upright ones on the ground, level ones on top, moving at 1 m/s."""
    scene = jc.Scene(dim=2)
    rod = {"mass": 1.0, "inertia": 1 / 12}
    for i in range(n + 1):
        up = {"position": (i, 0.5), "angle": np.pi / 2, "angular_velocity": -1.0}
        scene.add_body(f"post{i}", **rod, velocity=(0.5, 0.0), **up)
        scene.add(jc.Revolute(f"foot{i}", jc.WORLD, f"post{i}", point=(i, 0.0)))
    for i in range(n):
        scene.add_body(f"beam{i}", **rod, position=(i + 0.5, 1.0), velocity=(1.0, 0.0))
        scene.add(jc.Revolute(f"left{i}", f"post{i}", f"beam{i}", point=(i, 1.0)))
        scene.add(jc.Revolute(f"right{i}", f"beam{i}", f"post{i + 1}", point=(i + 1, 1.0)))
    return scene.build()


def main(picture: str = "n_four_bar.png") -> None:
    """Lets it swing round for two seconds and draws it, with the energy that it keeps."""
    system, state = build()
    print(jc.report(system, state))
    method = jc.Method(jc.RK4())

    def record(s: jc.State, _: jc.extend.StepInfo) -> tuple:
        return s.q, jc.energy(system, s).total, jc.violation(system, s).worst

    run = jax.jit(lambda s: jc.rollout(system, method, s, None, DT, STEPS, record=record, every=20))
    final, (path, energy, violation) = run(state)
    jc.raise_for_status(final)
    start = jc.energy(system, state).total
    drift = float(np.max(np.abs(energy - start)) / start)
    print(f"energy changes by {drift:.1e}, worst violation {float(violation.max()):.1e} m")

    from jaxcon import view

    axes = view.draw(system, state.q, color="C0", label=None)
    for q in path[::5]:
        view.draw(system, q, axes, color="C0", alpha=0.25, label=None)
    axes.set_title(f"{N} four-bars, one freedom")
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
