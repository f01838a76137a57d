"""A rope that hangs between two points, and is let go at one of them.

    python examples/rope.py

A hundred links that do not stretch, hung where statics wants them; the tension of every link is a
multiplier. Then the right end is free, and the rope swings under the left one.
"""

import sys

import jax
import numpy as np

import jaxcon as jc

LINKS, LENGTH, MASS = 100, 2.0, 0.5
START, END = (0.0, 0.0), (1.2, 0.0)


def build(end: str | None) -> tuple:
    """The rope, its last point held by a body or free."""
    scene = jc.Scene(dim=2)
    points = jc.chains.hanging(START, END, LENGTH, LINKS)
    chain = jc.chains.rope(scene, "rope", points, MASS, end=end, bending=1e-4)
    return *scene.build(), chain


def main(picture: str = "rope.png") -> None:
    """Reads the tension at rest, lets the rope go, and draws it."""
    system, state, chain = build(end=jc.WORLD)
    info = jc.forward_dynamics(
        system, state, None, jc.Method(stabilizer=jc.stabilizers.Unstabilized()), 1e-3
    )
    tension = -np.array([jc.multipliers(info, x)[0] for x in chain.joints])
    print(f"tension: {tension.max():.3f} N at the ends, {tension.min():.3f} N at the bottom")

    system, state, chain = build(end=None)
    run = jax.jit(lambda s: jc.rollout(system, jc.Method(), s, None, 5e-4, 2000, every=200))
    final, path = run(state)
    jc.raise_for_status(final)
    print(
        f"after 1 s: a link is off its length by {jc.violation(system, final).worst:.1e} m at most"
    )
    energies = [float(jc.energy(system, s).total) for s in (state, final)]
    print(f"energy: {energies[0]:.4f} J, then {energies[1]:.4f} J")

    from jaxcon.view import pyplot

    axes = pyplot().subplots()[1]
    for i, q in enumerate([state.q, *path.q]):
        x, y = np.asarray(q).reshape(2, -1)
        axes.plot(np.append(START[0], x), np.append(START[1], y), color=f"C{i}", lw=1.5)
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="a rope let go at its right end, every 0.1 s")
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
