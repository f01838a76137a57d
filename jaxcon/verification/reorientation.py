"""Turning without angular momentum: inner motion leaves a body turned, as a falling cat does."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

import jaxcon as jc
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.sampling import RK4

CASE = "zero_momentum_reorientation"
STEPS = 8000


def smooth(t: Any) -> Any:
    """From 0 at t = 0 to 1 at t = 1, at rest at both."""
    return t**3 * (10 - 15 * t + 6 * t**2)


def turn(t: Any, size: Any) -> Any:
    """The angle of the one hinge [rad]."""
    return size * smooth(t)


def at_arms(body: Any, right: Any, left: Any, t: Any, params: Any) -> jax.Array:
    """The tips of two massless arms, opposite each other: (0.4 + 0.6 cos ψ, 0.6 sin ψ) and back."""
    ψ = params * smooth(t)
    tip = jnp.stack([0.4 + 0.6 * jnp.cos(ψ), 0.6 * jnp.sin(ψ)])
    arms = (body.local_point(right.position) - tip, body.local_point(left.position) + tip)
    return jnp.concatenate(arms)


def two_bodies(prescribed: bool) -> tuple[Any, jc.State]:
    """Hinged at both centres of mass."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("first", mass=1.0, inertia=0.8)
    scene.add_body("second", mass=1.0, inertia=0.3)
    scene.add(jc.Revolute("hinge", "first", "second", point=(0.0, 0.0)))
    scene.add(jc.Drive("drive", "hinge", turn, params=1.0))
    if prescribed:
        scene.add(jc.AngularMomentum("no_turning"))
    return scene.build()


def three_links(angle: float) -> tuple[Any, jc.State]:
    """A body and the tips of its two massless arms, which turn by an angle."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("body", mass=1.0, inertia=1.0)
    scene.add_particle("right", mass=0.5, position=(1.0, 0.0))
    scene.add_particle("left", mass=0.5, position=(-1.0, 0.0))
    bodies = ("body", "right", "left")
    scene.add(jc.Holonomic(at_arms, bodies, name="arms", params=angle))
    scene.add(jc.AngularMomentum("no_turning", bodies))
    return scene.build()


def run(world: tuple[Any, jc.State]) -> tuple[jc.State, float]:
    """The state after a second, and the largest |L| on the way."""
    system, state = world

    @jax.jit
    def rollout(s: jc.State) -> Any:
        final, path = jc.rollout(system, RK4, s, None, 1 / STEPS, STEPS)
        return final, jnp.max(jnp.abs(jax.vmap(lambda s: jc.angular_momentum(system, s))(path)))

    final, momentum = rollout(state)
    jc.raise_for_status(final)
    return final, float(momentum)


def zero_momentum_reorientation() -> list[Check]:
    """Two bodies on a hinge, and a body with two arms, driven from rest; final angles [rad].

    References:
        Kane and Scher, A dynamical explanation of the falling cat phenomenon (1969); Montgomery,
        Gauge theory of the falling cat (1993).
    """
    data = references.load("an_zero_momentum_reorientation")
    checks = []
    for prescribed in (False, True):
        world = two_bodies(prescribed)
        final, momentum = run(world)
        found = [jc.orientation(world[0], final, name) for name in ("first", "second")]
        expected = [data["planar_two_body"][key] for key in ("dtheta1", "dtheta2")]
        label = "L = 0 as a constraint" if prescribed else "by itself"
        checks.append(Check(CASE, f"two bodies, {label}", error(found, expected), 1e-8))
        checks.append(Check(CASE, f"two bodies, {label}, L [kg m²/s]", momentum, 1e-12))
    links = data["planar_three_link"]
    turns = {"pi_over_2": jnp.pi / 2, "turn": 2 * jnp.pi}
    keys = {"pi_over_2": "dtheta_for_psi_0_to_pi_over_2", "turn": "dtheta_full_turn"}
    for name, angle in turns.items():
        world = three_links(float(angle))
        final, momentum = run(world)
        off = error(jc.orientation(world[0], final, "body"), links[keys[name]])
        checks.append(Check(CASE, f"three links, ψ to {angle:.4f}", off, 1e-8))
        checks.append(Check(CASE, "three links, L [kg m²/s]", momentum, 1e-12))
    return checks
