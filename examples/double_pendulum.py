"""A double pendulum: energy that stays, and neighbours that part.

    python examples/double_pendulum.py

Two rods on two hinges: 6 velocities, 4 rows, 2 degrees of freedom. A thousand of them start with
rates within a milliradian a second of each other; they are one batch.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc

STEPS, DT = 6000, 1e-3


def build() -> tuple:
    """Two rods of 1 m and 1 kg, held out level."""
    scene = jc.Scene(dim=2)
    for i, name in enumerate(("upper", "lower")):
        scene.add_body(name, mass=1.0, inertia=1 / 12, position=(0.5 + i, 0.0))
    scene.add(jc.Revolute("shoulder", jc.WORLD, "upper", point=(0.0, 0.0)))
    scene.add(jc.Revolute("elbow", "upper", "lower", point=(1.0, 0.0)))
    return scene.build()


def main(picture: str = "double_pendulum.png", worlds: int = 1000) -> None:
    """Swings them for six seconds by RK4 and draws where the tips are, and how they part."""
    system, state = build()
    print(jc.report(system, state))

    def swing(turn: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The tip and the energy along a motion that starts at a small rate."""
        start = jc.State(state.q, state.v.at[system.layout.v("lower")[2]].set(turn), *rest)
        rod = (0.5, 0.0)

        def record(s: jc.State, _: jc.extend.StepInfo) -> tuple[jax.Array, jax.Array]:
            return jc.position(system, s, "lower", rod), jc.energy(system, s).total

        method = jc.Method(jc.RK4())
        return jc.rollout(system, method, start, None, DT, STEPS, record=record, every=20)[1]

    rest = (state.time, state.status)
    rates = jnp.linspace(-1e-3, 1e-3, worlds)
    tips, energy = jax.jit(jax.vmap(swing))(rates)
    scale = 4 * 9.81  # from hanging to upright
    print(f"energy changes by {float(jnp.max(jnp.abs(energy)) / scale):.1e} of its range")
    apart = jnp.linalg.norm(jnp.std(tips, axis=0), axis=-1)
    for second in (1, 3, 6):
        print(f"after {second} s the tips are {float(apart[50 * second - 1]):.1e} m apart")

    from jaxcon import view

    figure, (left, right) = view.pyplot().subplots(1, 2, figsize=(10, 4))
    left.plot(*np.asarray(tips[:: max(worlds // 8, 1), :, :]).T, lw=0.5)
    left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="paths of some tips")
    right.semilogy(DT * 20 * np.arange(1, len(apart) + 1), apart)
    right.set(xlabel="time [s]", ylabel="standard deviation of the tips [m]")
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
