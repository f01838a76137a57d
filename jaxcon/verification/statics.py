"""Constraint forces: wrenches at rest, tension, power, and balance of action and reaction."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.sampling import RK4

forward = jax.jit(jc.forward_dynamics)


def hold(t: jax.Array, params: None) -> jax.Array:
    """Returns the prescribed angle 0: a drive keeps the joint at its initial angle."""
    return jnp.zeros_like(t)


def two_links() -> tuple[BodySystem, jc.State]:
    """Builds two links along world y, with a drive that holds the first link.

    The hinge of the first link has the axis x. In this pose, z of the links points along world y,
    and y of the links points down.
    """
    p = references.load("static_reactions_gazebo")["parameters"]
    turned = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0)  # −π/2 about x
    scene = jc.Scene(dim=3, gravity=p["g"])
    for name, y in (("link1", 0.0), ("link2", 1.5)):
        body = {"mass": p[name]["m"], "inertia": p[name]["I_com"]}
        scene.add_body(name, **body, position=(0.0, y, 0.5), quaternion=turned)
    x, y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    scene.add(jc.Revolute("joint1", jc.WORLD, "link1", point=(0.0, 0.0, 0.5), axis=x))
    scene.add(jc.Revolute("joint2", "link1", "link2", point=(0.0, 1.0, 0.5), axis=y))
    scene.add(jc.joints.Drive("stop", "joint1", hold))
    return scene.build()


def static_reactions() -> list[Check]:
    """Checks the wrenches of two joints at rest, on both bodies that each joint connects.

    A wrench is in the axes of the body on which it acts. In the reference, the wrench of the first
    joint includes the torque of the drive that holds it.

    References:
        Simbody, tests/GazeboReactionForce.cpp, after a test of Gazebo.
    """
    data = references.load("static_reactions_gazebo")["reference"]
    system, state = two_links()
    solution = forward(system, state, None, RK4, 1e-3)
    reaction = {}
    for body in (jc.WORLD, "link1"):
        parts = (jc.wrench(solution, name, body, system=system) for name in ("joint1", "stop"))
        reaction[f"reaction1_on_{'parent' if body == jc.WORLD else 'child'}"] = sum(parts), body
    for body, side in (("link1", "parent"), ("link2", "child")):
        reaction[f"reaction2_on_{side}"] = jc.wrench(solution, "joint2", body, system=system), body
    rest = error(solution.acceleration, np.zeros(12))
    checks = [Check("static_reactions", "acceleration at rest", rest, 1e-9)]
    for name, (wrench, body) in reaction.items():
        side = name.rsplit("_", 1)[1]
        expected = data[f"{name}_in_{side}"]  # torque, then force
        inward = jnp.array([1.0, 0.0, 0.0, 0.0])
        if body != jc.WORLD:
            inward = jc.quaternion.conjugate(jc.orientation(system, state, body))
        actual = [jc.quaternion.rotate(inward, x) for x in (wrench[3:], wrench[:3])]
        figure = f"{name.replace('_', ' ')} [N m, N]"
        checks.append(Check("static_reactions", figure, error(actual, expected), 1e-6))
    return checks


def tension() -> list[Check]:
    """Checks the tension of a pendulum rod, which is minus the λ of `Distance`.

    T = m(l θ̇² + g cos θ) at many angles θ and rates θ̇.
    """
    length, mass, g = 1.3, 0.7, 9.81
    random = np.random.default_rng(3)
    scene = jc.Scene(dim=2, gravity=(0.0, -g))
    scene.add_particle("bob", mass=mass, position=(0.0, -length))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    angle, rate = random.uniform(-3, 3, 50), random.uniform(-5, 5, 50)
    q = length * np.stack([np.sin(angle), -np.cos(angle)], -1)
    v = (length * rate)[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)

    def multiplier(q: jax.Array, v: jax.Array) -> jax.Array:
        moved = dataclasses.replace(state, q=q, v=v)
        return jc.forward_dynamics(system, moved, None, RK4, 1e-3).multipliers[0]

    actual = -np.asarray(jax.jit(jax.vmap(multiplier))(q, v))
    expected = mass * (length * rate**2 + g * np.cos(angle))
    return [Check("tension", "T = −λ [N]", error(actual, expected), 1e-11)]


@functools.cache
def mixed_scene() -> tuple[BodySystem, jc.State]:
    """Builds four bodies and a particle at rest in space, connected by five kinds of joints."""
    scene = jc.Scene(dim=3, gravity=(0.3, -0.2, -9.81))
    for i, name in enumerate("abcd"):
        half = 0.2 * i
        turn = (np.cos(half), 0.6 * np.sin(half), 0.0, 0.8 * np.sin(half))
        moments = (0.2, 0.3 + 0.02 * i, 0.35)
        scene.add_body(
            name, mass=1.0 + i, inertia=moments, position=(0.5 + i, 0.1 * i, 0.0), quaternion=turn
        )
    scene.add_particle("bob", mass=0.5, position=(4.0, 0.3, -1.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "a", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.2)))
    scene.add(jc.Spherical("ball", "a", "b", point=(1.0, 0.1, 0.0)))
    scene.add(jc.Prismatic("slider", "b", "c", axis=(1.0, 0.3, -0.2), point=(2.0, 0.1, 0.1)))
    scene.add(jc.Fixed("weld", "c", "d", point=(3.0, 0.2, 0.0)))
    scene.add(jc.Distance("rod", "d", "bob"))
    return scene.build()


def power() -> list[Check]:
    """Checks the power of constraint forces: vᵀ(M a − f) = λᵀ(J v) for any velocities v.

    J v = φ̇, because no constraint here depends on time. The difference is relative to the sum of
    the absolute values of all terms.
    """
    system, state = mixed_scene()

    @jax.jit
    def defect(v: jax.Array) -> jax.Array:
        moving = dataclasses.replace(state, v=v)
        a, multipliers, _ = jc.forward_dynamics(system, moving, None, RK4, 1e-3)
        q, t = moving.q, moving.time
        left = v * (system.mass(q).apply(a) - system.force(q, v, t))
        right = multipliers * jc.violation(system, moving).velocity
        size = jnp.sum(jnp.abs(left)) + jnp.sum(jnp.abs(right))
        return jnp.abs(jnp.sum(left) - jnp.sum(right)) / size

    velocities = np.random.default_rng(5).normal(size=(20, *state.v.shape))
    worst = max(float(defect(v)) for v in velocities)
    return [Check("power", "vᵀ(M a − f) − λᵀ(J v), relative", worst, 1e-12)]


def balance() -> list[Check]:
    """Checks that a joint's wrenches on its two bodies, about the same anchor, are opposite."""
    system, state = mixed_scene()
    solution = forward(system, state, None, RK4, 1e-3)
    sides = {"ball": ("a", "b"), "slider": ("b", "c"), "weld": ("c", "d")}
    checks = []
    for name, bodies in sides.items():
        on_a, on_b = (jc.wrench(solution, name, body, system=system) for body in bodies)
        gap = error(on_a, -on_b) / float(jnp.max(jnp.abs(on_b)))
        checks.append(Check("balance", f"{name}: wrenches opposite, relative", gap, 1e-12))
    return checks
