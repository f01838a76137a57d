"""Exact derivatives of a simulated pendulum with respect to parameters of its scene."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.core.typing import Scalar
from jaxcon.verification import references
from jaxcon.verification.case import Check, relative
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, run

EVERY, COUNT = 500, 10


def swing(parameters: jax.Array, dt: Scalar) -> jax.Array:
    """Returns the angle θ and rate θ̇ of a pendulum every 500 steps, (2, 10) [rad], [rad/s].

    The scene is built from the parameters: initial angle θ₀, length l and gravity g. The length
    enters both the initial position l (sin θ₀, −cos θ₀) and the constraint.
    """
    angle, length, g = parameters
    start = length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    scene = jc.Scene(dim=2, gravity=jnp.stack([jnp.zeros_like(g), -g]))
    scene.add_particle("bob", mass=1.0, position=start)
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=length))
    system, state = scene.build()
    states = run(system, RK4, state, dt, EVERY, COUNT)
    (x, y), (vx, vy) = states.q[1:].T, states.v[1:].T
    return jnp.stack([jnp.arctan2(x, -y), (x * vy - y * vx) / (x * x + y * y)])


@jax.jit
def by_grad(parameters: jax.Array, dt: Scalar) -> jax.Array:
    """Returns ∂(θ, θ̇)/∂(θ₀, l, g) of `swing` at ten times, (2, 10, 3).

    `jax.grad` differentiates each component.
    """
    weights = jnp.eye(2 * COUNT).reshape(-1, 2, COUNT)
    slope = jax.grad(lambda p, w: jnp.sum(w * swing(p, dt)))
    return jax.vmap(slope, (None, 0))(parameters, weights).reshape(2, COUNT, 3)


@jax.jit
def by_jvp(parameters: jax.Array, dt: Scalar) -> tuple[jax.Array, jax.Array]:
    """Returns (θ, θ̇) of `swing`, (2, 10), and their derivatives ∂(θ, θ̇)/∂(θ₀, l, g), (2, 10, 3).

    `jax.jvp` differentiates along each parameter.
    """

    def along(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(lambda p: swing(p, dt), (parameters,), (direction,))

    values, slopes = jax.vmap(along)(jnp.eye(3))
    return values[0], jnp.moveaxis(slopes, 0, -1)


def pendulum_gradients() -> list[Check]:
    """Checks derivatives of a pendulum's motion through 5000 steps.

    They are with respect to the initial angle, the length and gravity. At the end of a period T,
    θ̇ = 0. The derivative of T with respect to a parameter p is therefore −(∂θ̇/∂p)/θ̈ there.

    References:
        Jacobi's elliptic functions and their derivatives, in 40 digits.
    """
    case, data = "pendulum_gradients", references.load("grad_pendulum")
    p, rows = data["parameters"], data["rows"]
    parameters = jnp.array([p["theta0"], p["L"], p["g"]])
    times = column(rows, "t")
    index = np.rint(times / 0.5).astype(int) - 1
    values, forward = (np.asarray(x)[:, index] for x in by_jvp(parameters, 0.5 / EVERY))
    reverse = np.asarray(by_grad(parameters, 0.5 / EVERY))[:, index]
    state = np.stack([column(rows, key) for key in ("theta", "thetadot")])
    keys = ("dtheta_d_theta0_L_g", "dthetadot_d_theta0_L_g")
    expected = np.stack([column(rows, key) for key in keys])
    _, round_trip = by_jvp(parameters, data["period"] / (EVERY * COUNT))
    restoring = -p["g"] / p["L"] * np.sin(p["theta0"])
    period = -np.asarray(round_trip)[1, -1] / restoring
    return [
        Check(case, "θ and θ̇ to 5 s", relative(values, state), 1e-8),
        Check(case, "derivatives by jax.grad", relative(reverse, expected), 1e-8),
        Check(case, "derivatives by jax.jvp", relative(forward, expected), 1e-8),
        Check(case, "derivatives of T", relative(period, data["dperiod_d_theta0_L_g"]), 1e-8),
    ]
