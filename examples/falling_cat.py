"""A cat that falls upside down and lands on its feet, at zero angular momentum throughout.

    python examples/falling_cat.py

Two equal halves on a ball joint at the waist. The cat bends its spine by β, lets the bend run once
round it (α from 0 to 2π) without twisting, and stretches again: inner motion only, so that angular
momentum stays zero, and yet it has turned. With moments A along the spine and B across it,

    turn = 2π (1 − A c / (A c² + B s²)),    c = cos β/2,  s = sin β/2,

so the bend that turns it by half a turn is known beforehand.
"""

import math
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon import quaternion

LENGTH, RADIUS, MASS = 0.25, 0.07, 2.0  # of each half [m], [kg]
ALONG = MASS * RADIUS**2 / 2
ACROSS = MASS * (3 * RADIUS**2 + LENGTH**2) / 12
HEIGHT, GRAVITY = 1.6, 9.81
TIME = math.sqrt(2 * HEIGHT / GRAVITY)
STEPS = 4000


def bend_for_half_a_turn() -> float:
    """β for which A c² + B s² = 2 A c [rad]."""
    ratio = ACROSS / ALONG
    cosine = (math.sqrt(1 + ratio * (ratio - 1)) - 1) / (ratio - 1)
    return 2 * math.acos(cosine)


def smooth(x: jax.Array) -> jax.Array:
    """From 0 to 1 in x from 0 to 1, and level outside."""
    x = jnp.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def spine(front: jc.extend.Pose, rear: jc.extend.Pose, t: jax.Array, bend: jax.Array) -> jax.Array:
    """The rear half is turned against the front one by β about an axis that goes round once."""
    t = t / TIME
    β = bend * smooth(t / 0.2) * smooth((1 - t) / 0.2)
    α = 2 * jnp.pi * smooth((t - 0.2) / 0.6)
    axis = jnp.stack([0 * α, jnp.cos(α), jnp.sin(α)])
    wanted = jnp.concatenate([jnp.cos(β / 2)[None], jnp.sin(β / 2) * axis])
    relative = quaternion.multiply(quaternion.conjugate(front.orientation), rear.orientation)
    return 2 * quaternion.multiply(quaternion.conjugate(wanted), relative)[1:]


def build() -> tuple:
    """The cat upside down at rest, its spine along x, its legs along −z of each half."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -GRAVITY))
    for name, side in (("front", 1), ("rear", -1)):
        scene.add_body(
            name,
            mass=MASS,
            inertia=(ALONG, ACROSS, ACROSS),
            position=(side * LENGTH / 2, 0.0, HEIGHT),
            quaternion=(0.0, 1.0, 0.0, 0.0),
        )
    scene.add(jc.Spherical("waist", "front", "rear", point=(0.0, 0.0, HEIGHT)))
    bodies = ("front", "rear")
    scene.add(jc.joints.Holonomic(spine, bodies, name="spine", params=bend_for_half_a_turn()))
    scene.add(jc.joints.AngularMomentum("no_help", bodies))
    return scene.build()


def upright(system, state: jc.State, body: str = "front") -> jax.Array:
    """How far the back of a half points upwards, from −1 to 1."""
    up = jnp.asarray([0.0, 0.0, 1.0], state.q.dtype)
    return quaternion.rotate(jc.orientation(system, state, body), up)[2]


def main(picture: str = "falling_cat.png") -> None:
    """Lets it fall, and draws it on the way."""
    system, state = build()
    method = jc.Method(integrator=jc.RK4())
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, TIME / STEPS, STEPS, every=400))
    final, path = run(state)
    jc.raise_for_status(final)

    momentum = jax.vmap(lambda s: jc.angular_momentum(system, s))(path)
    heights = jax.vmap(lambda s: jc.center_of_mass(system, s)[0][2])(path)
    print(f"spine bent by {math.degrees(bend_for_half_a_turn()):.1f}°, fall of {TIME:.2f} s")
    print("back upwards:", np.round(np.asarray(jax.vmap(lambda s: upright(system, s))(path)), 3))
    print(f"largest angular momentum: {np.abs(momentum).max():.1e} kg m²/s")
    print(f"height: {heights[0]:.3f} m to {heights[-1]:.3f} m")

    draw(system, [state, *(jax.tree.map(lambda x, i=i: x[i], path) for i in range(10))], picture)
    print(f"wrote {picture}")


def draw(system, states: list, picture: str) -> None:
    """The cat at several times side by side, seen from its flank: spine and legs."""
    from jaxcon.view import pyplot

    plt = pyplot()
    axes = plt.figure(figsize=(10, 4)).add_subplot()
    for i, s in enumerate(states):
        for name, side, color in (("front", 1, "C0"), ("rear", -1, "C1")):
            local = np.array([(-side, 0, 0), (side, 0, 0), (side * 0.8, 0, -0.6)]) * LENGTH / 2
            points = np.array([jc.position(system, s, name, p) for p in local])
            axes.plot(points[:2, 0] + 0.6 * i, points[:2, 2], color=color, lw=6)
            axes.plot(points[1:, 0] + 0.6 * i, points[1:, 2], color=color, lw=2)
    axes.axhline(-0.1, color="gray")
    axes.set_aspect("equal")
    axes.set_xlabel("time →")
    axes.set_ylabel("z [m]")
    axes.figure.savefig(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
