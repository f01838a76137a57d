"""Derivatives of a pendulum's angle after a thousand steps, and a length found by gradient.

    python examples/pendulum_gradient.py

A scene can be built inside a differentiated function: numbers may be traced, names may not.
"""

import jax
import jax.numpy as jnp

import jaxcon as jc

METHOD = jc.Method(integrator=jc.RK4())


def angle_after(length: jax.Array, gravity: jax.Array) -> jax.Array:
    """The angle [rad] from the vertical after one second, released at 1 rad."""
    scene = jc.Scene(dim=2, gravity=jnp.stack([jnp.zeros_like(gravity), -gravity]))
    start = length * jnp.stack([jnp.sin(1.0), -jnp.cos(1.0)])
    scene.add_particle("bob", mass=1.0, position=start)
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    final, _ = jc.rollout(system, METHOD, state, None, 1e-3, 1000, record=lambda s, i: None)
    x, y = jc.position(system, final, "bob")
    return jnp.arctan2(x, -y)


def find_length(target: float, guess: float = 1.0) -> jax.Array:
    """The length [m] at which the angle after one second is the target [rad]."""

    def loss(length: jax.Array) -> jax.Array:
        return (angle_after(length, jnp.asarray(9.81)) - target) ** 2

    return jc.tune(loss, jnp.asarray(guess), steps=60, positive=True).params


def main() -> None:
    """Prints the derivatives and the length."""
    length, gravity = jnp.asarray(1.0), jnp.asarray(9.81)
    by_length, by_gravity = jax.jit(jax.grad(angle_after, argnums=(0, 1)))(length, gravity)
    print(f"angle after 1 s: {jax.jit(angle_after)(length, gravity):.6f} rad")
    print(f"its derivative by length: {by_length:.6f} rad/m")
    print(f"its derivative by gravity: {by_gravity:.6f} rad/(m/s²)")
    found = find_length(-0.9)
    print(f"at length {found:.4f} m the angle after 1 s is -0.9 rad")


if __name__ == "__main__":
    main()
