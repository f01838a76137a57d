"""Fekete points: twenty particles on a sphere repel each other and come to rest."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, relative

COUNT = 20


def repulsion(
    q: jax.Array, v: jax.Array, t: jax.Array, control: None, damping: jax.Array
) -> jax.Array:
    """Returns the force on each particle, Σⱼ (pᵢ − pⱼ)/‖pᵢ − pⱼ‖² − α ṗᵢ, (60,).

    pᵢ are the positions of the particles and α is the damping.
    """
    points = q.reshape(COUNT, 3)
    apart = points[:, None] - points[None]
    square = jnp.sum(apart * apart, axis=-1) + jnp.eye(COUNT, dtype=q.dtype)
    return jnp.sum(apart / square[..., None], axis=1).ravel() - damping * v


def on_sphere(q: jax.Array, t: jax.Array, damping: jax.Array) -> jax.Array:
    """Returns the residuals ‖pᵢ‖² − 1 of particles at positions pᵢ on the unit sphere, (20,)."""
    return jnp.sum(q.reshape(COUNT, 3) ** 2, axis=1) - 1


def fekete(dt: float = 0.025) -> list[Check]:
    """Checks p̈ = f(p, ṗ) + 2 λ p to t = 1000, with RK4 and projection.

    p are positions, f the repulsion with damping, and λ the multipliers of the sphere. Positions
    must agree to eight digits.

    References:
        Mazzia, Magherini, Test Set for Initial Value Problem Solvers (2008), problem Fekete.
    """
    data = references.load("ivp_fekete")
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones_like(q),
        force=repulsion,
        constraints=(jc.joints.Holonomic(on_sphere, name="sphere"),),
        params=jnp.asarray(0.5),
    )
    method = jc.Method(jc.RK4(), jc.Projection(iterations=4), jc.solvers.Schur())
    start = np.ravel(data["initial"]["p"])
    state = jc.init(system, method, start, np.zeros_like(start))

    def step(_: int, state: jc.State) -> jc.State:
        return jc.step(system, method, state, None, dt)[0]

    end = jax.jit(lambda s: jax.lax.fori_loop(0, round(1000 / dt), step, s))(state)
    λ = jc.forward_dynamics(system, end, None, method, dt).multipliers
    reference = np.ravel(data["reference_t1000"]["p"])
    return [
        Check("fekete", "positions at t = 1000", error(end.q, reference), 1e-8),
        Check("fekete", "speeds at t = 1000", error(end.v, 0 * reference), 1e-12),
        Check("fekete", "λ of rest, −(N − 1)/4", relative(λ, np.full(COUNT, -4.75)), 1e-12),
        Check("fekete", "|φ| after 40 000 steps", float(jc.violation(system, end).worst), 1e-14),
    ]
