"""A cart swings its pole up: forces over time, found by gradient through the motion.

    python examples/swing_up.py

The pole hangs from a cart on a rail. A force of at most 20 N, held for 50 ms at a time, must bring
it to stand upright and still after two seconds, with the cart where it was.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxcon as jc

DT, STEPS, KNOTS, LIMIT = 1e-2, 200, 40, 20.0
CART, POLE, LENGTH = 1.0, 0.3, 0.6


def build() -> tuple:
    """At rest, the pole hanging; the control is a wrench on the cart."""
    scene = jc.Scene(dim=2)
    middle = (0.0, -LENGTH / 2)
    scene.add_body("cart", mass=CART, inertia=1.0)
    scene.add_body("pole", mass=POLE, inertia=POLE * LENGTH**2 / 12, position=middle)
    scene.add(jc.Prismatic("rail", jc.WORLD, "cart", axis=(1.0, 0.0)))
    scene.add(jc.Revolute("pivot", "cart", "pole", point=(0.0, 0.0)))
    scene.add(jc.forces.ExternalWrench("push", "cart"))
    return scene.build()


system, start = build()


def swing(forces: jax.Array) -> tuple:
    """The final state and the way there, for the forces of the knots (KNOTS,) [N]."""
    control = jnp.zeros((STEPS, 3)).at[:, 0].set(jnp.repeat(forces, STEPS // KNOTS))
    return jc.rollout(system, jc.Method(solver=jc.solvers.Schur()), start, control, DT, STEPS)


def miss(final: jc.State) -> dict:
    """How far the end is from upright and still at the origin [rad, rad/s, m, m/s]."""
    return {
        "angle": 2 * jnp.cos((jc.orientation(system, final, "pole")) / 2),  # 0 half a turn away
        "spin": jc.angular_velocity(system, final, "pole"),
        "place": jc.position(system, final, "cart")[0],
        "speed": jc.velocity(system, final, "cart")[0],
    }


def loss(forces: jax.Array) -> tuple:
    """Σ squares of what the end misses, with rates by a second, and a little effort."""
    final, path = swing(forces)
    terms = {name: x**2 for name, x in miss(final).items()}
    terms["effort"] = jnp.mean((forces / LIMIT) ** 2)
    weights = {"angle": 1.0, "spin": 0.1, "place": 1.0, "speed": 0.1, "effort": 1e-3}
    total, _ = jc.learning.losses.weighted(terms, weights)
    return jc.learning.losses.unless_failed(total, final), path


def find(steps: int = 300) -> jc.learning.Tuned:
    """From a gentle push to and fro."""
    first = 2.0 * jnp.sin(jnp.linspace(0.0, 4 * jnp.pi, KNOTS))
    optimizer = optax.adam(optax.cosine_decay_schedule(1.0, steps))
    return jc.tune(loss, first, steps=steps, bounds=(-LIMIT, LIMIT), optimizer=optimizer)


def main(picture: str = "swing_up.png") -> None:
    """Finds the forces, prints where the pole ends and draws the way there."""
    found = find()
    print(found)
    path = found.aux
    end = miss(jax.tree.map(lambda x: x[-1], path))
    print("at the end it misses " + ", ".join(f"{k} {float(x):+.4f}" for k, x in end.items()))
    print(f"largest force {float(jnp.max(jnp.abs(found.params))):.1f} N")

    from jaxcon import view

    figure, (left, right) = view.pyplot().subplots(1, 2, figsize=(10, 4), layout="constrained")
    for i in range(0, STEPS, 8):
        view.draw(system, path.q[i], left, alpha=0.15 + 0.85 * i / STEPS, color="C0", label=None)
    right.step(np.linspace(0, DT * STEPS, KNOTS), found.params, where="post")
    right.set(xlabel="time [s]", ylabel="force [N]")
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
