"""Bodies that reorient themselves with zero angular momentum, like a falling cat."""

from __future__ import annotations

import jax
import jax.numpy as jnp

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.sampling import RK4

CASE = "zero_momentum_reorientation"
STEPS = 8000


def smooth(t: jax.Array) -> jax.Array:
    """Returns a smooth step from 0 at t = 0 to 1 at t = 1, with zero rate at both times."""
    return t**3 * (10 - 15 * t + 6 * t**2)


def turn(t: jax.Array, size: float | jax.Array) -> jax.Array:
    """Returns the prescribed hinge angle, which reaches `size` at t = 1 s [rad]."""
    return size * smooth(t)


def at_arms(
    body: jc.extend.Pose,
    right: jc.extend.Pose,
    left: jc.extend.Pose,
    t: jax.Array,
    angle: float | jax.Array,
) -> jax.Array:
    """Returns the residual of two particles at the tips of massless arms of a body, (4,) [m].

    In the frame of the body, the tips are at ±(0.4 + 0.6 cos ψ, 0.6 sin ψ). The arm angle ψ grows
    smoothly from 0 to `angle`.
    """
    ψ = angle * smooth(t)
    tip = jnp.stack([0.4 + 0.6 * jnp.cos(ψ), 0.6 * jnp.sin(ψ)])
    arms = (body.local_point(right.position) - tip, body.local_point(left.position) + tip)
    return jnp.concatenate(arms)


def two_bodies(prescribed: bool) -> tuple[BodySystem, jc.State]:
    """Builds two bodies hinged at their centers of mass, with a prescribed hinge angle.

    Args:
        prescribed: True to add zero angular momentum, L = 0, as a constraint.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("first", mass=1.0, inertia=0.8)
    scene.add_body("second", mass=1.0, inertia=0.3)
    scene.add(jc.Revolute("hinge", "first", "second", point=(0.0, 0.0)))
    scene.add(jc.joints.Drive("drive", "hinge", turn, params=1.0))
    if prescribed:
        scene.add(jc.joints.AngularMomentum("no_turning"))
    return scene.build()


def three_links(angle: float) -> tuple[BodySystem, jc.State]:
    """Builds a body and the tips of its two massless arms, which rotate by an angle [rad]."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("body", mass=1.0, inertia=1.0)
    scene.add_particle("right", mass=0.5, position=(1.0, 0.0))
    scene.add_particle("left", mass=0.5, position=(-1.0, 0.0))
    bodies = ("body", "right", "left")
    scene.add(jc.joints.Holonomic(at_arms, bodies, name="arms", params=angle))
    scene.add(jc.joints.AngularMomentum("no_turning", bodies))
    return scene.build()


def run(world: tuple[BodySystem, jc.State]) -> tuple[jc.State, float]:
    """Returns the state after one second, and the largest angular momentum |L| until then."""
    system, state = world

    @jax.jit
    def rollout(s: jc.State) -> tuple[jc.State, jax.Array]:
        final, path = jc.rollout(system, RK4, s, None, 1 / STEPS, STEPS)
        return final, jnp.max(jnp.abs(jax.vmap(lambda s: jc.angular_momentum(system, s))(path)))

    final, momentum = rollout(state)
    jc.raise_for_status(final)
    return final, float(momentum)


def zero_momentum_reorientation() -> list[Check]:
    """Checks final angles [rad] of two hinged bodies and of a body with two arms.

    Both are driven from rest.

    References:
        Kane and Scher, A dynamical explanation of the falling cat phenomenon (1969); Montgomery,
        Gauge theory of the falling cat (1993).
    """
    data = references.load("an_zero_momentum_reorientation")
    checks = []
    for prescribed in (False, True):
        world = two_bodies(prescribed)
        final, momentum = run(world)
        angles = [jc.orientation(world[0], final, name) for name in ("first", "second")]
        expected = [data["planar_two_body"][key] for key in ("dtheta1", "dtheta2")]
        label = "L = 0 as a constraint" if prescribed else "by itself"
        checks.append(Check(CASE, f"two bodies, {label}", error(angles, expected), 1e-8))
        checks.append(Check(CASE, f"two bodies, {label}, L [kg m²/s]", momentum, 1e-12))
    links = data["planar_three_link"]
    turns = {"pi_over_2": jnp.pi / 2, "turn": 2 * jnp.pi}
    keys = {"pi_over_2": "dtheta_for_psi_0_to_pi_over_2", "turn": "dtheta_full_turn"}
    for name, angle in turns.items():
        world = three_links(float(angle))
        final, momentum = run(world)
        deviation = error(jc.orientation(world[0], final, "body"), links[keys[name]])
        checks.append(Check(CASE, f"three links, ψ to {angle:.4f}", deviation, 1e-8))
        checks.append(Check(CASE, "three links, L [kg m²/s]", momentum, 1e-12))
    return checks
