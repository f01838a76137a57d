"""Textbook mechanisms whose accelerations and forces have a one-line closed form.

Ropes stay taut here, so they are equality constraints. A rope that can go slack is an inequality
constraint, and needs an impact law for the moment when it becomes taut.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, relative
from jaxcon.verification.nonholonomic import rolling_ball
from jaxcon.verification.sampling import RK4, rows_of, run, sample, solve

G = 9.81
BOUND = 1e-10
forward = jax.jit(jc.forward_dynamics)


def constants(name: str) -> dict[str, Any]:
    """Returns the reference values of a mechanism by its name."""
    cases = references.load("an_small_closed_forms")["cases"]
    return next(case for case in cases if case["id"] == name)


def rope(left: jc.extend.Pose, right: jc.extend.Pose, t: jax.Array, params: None) -> jax.Array:
    """Returns y₁ + y₂, the residual of a rope over a massless pulley, (1,) [m].

    y₁ and y₂ are the heights of its two weights. The multiplier λ is the tension.
    """
    return (left.position[1] + right.position[1])[None]


def wound(
    weight: jc.extend.Pose, pulley: jc.extend.Pose, t: jax.Array, lever: jax.Array
) -> jax.Array:
    """Returns y + l θ, the residual of a rope that winds onto a pulley, (1,) [m].

    y is the height of the weight on the rope, θ the angle of the pulley and l its lever arm.
    """
    return (weight.position[1] + lever * pulley.orientation)[None]


def atwood() -> list[Check]:
    """Checks Atwood's machine: two weights on a rope over a pulley.

    The acceleration is a = (m₁ − m₂) g / (m₁ + m₂ + I/r²). m₁ and m₂ are the masses of the weights,
    I the inertia of the pulley and r its radius.
    """
    light, heavy = constants("atwood"), constants("atwood_pulley_inertia")
    scene = two_weights()
    scene.add(jc.joints.Holonomic(rope, bodies=("left", "right")))
    fall, tension = solve_one(*scene.build())
    scene, r = two_weights(), 0.2
    scene.add_body("pulley", mass=1.0, inertia=r**2 / 2)
    scene.add(jc.Revolute("axle", jc.WORLD, "pulley", point=(0.0, 0.0)))
    scene.add(jc.joints.Holonomic(wound, ("left", "pulley"), "left rope", jnp.array(r)))
    scene.add(jc.joints.Holonomic(wound, ("right", "pulley"), "right rope", jnp.array(-r)))
    system, state = scene.build()
    slower = solve_one(system, state)[0]
    left = system.layout.v("left")[1]
    return [
        Check("atwood", "acceleration", relative(-fall[2], light["acceleration"]), BOUND),
        Check("atwood", "tension = λ", relative(tension[0], light["tension"]), BOUND),
        Check("atwood", "heavy pulley", relative(-slower[left], heavy["acceleration"]), BOUND),
    ]


def two_weights() -> jc.Scene:
    """Returns a planar scene with weights of 3 kg and 2 kg, at rest at y = 0."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("left", mass=3.0)
    scene.add_particle("right", mass=2.0)
    return scene


def incline() -> list[Check]:
    """Checks a ball that rolls down an incline of angle α.

    Its acceleration is a = (5/7) g sin α. The friction is (2/7) m g sin α.
    """
    data, alpha, mass = constants("rolling_ball_incline"), np.radians(25.0), 1.3
    gravity = (G * np.sin(alpha), 0.0, -G * np.cos(alpha))
    system, state = rolling_ball(mass, 0.2, 0.0, gravity, position=(0.0, 0.0, 0.2))
    a, multipliers = solve_one(system, state)
    friction = abs(multipliers[rows_of(system, state, "rolling")[0]])
    normal = multipliers[rows_of(system, state, "height")[0]]
    weight, share = friction / (mass * G), friction / normal
    return [
        Check("incline", "acceleration", relative(a[0], data["acceleration"]), BOUND),
        Check("incline", "friction/weight", relative(weight, data["friction_over_weight"]), BOUND),
        Check("incline", "friction/normal force", relative(share, data["min_mu"]), BOUND),
    ]


def conical_pendulum() -> list[Check]:
    """Checks a conical pendulum, whose bob circles at constant height.

    Its rate Ω satisfies Ω² = g / (l cos θ), with length l and tilt θ. The tension is m Ω² l.
    """
    data, length, tilt, mass = constants("conical_pendulum"), 1.2, 0.4, 2.0
    radius, height = length * np.sin(tilt), -length * np.cos(tilt)
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    velocity = (0.0, radius * data["rate"], 0.0)
    scene.add_particle("bob", mass=mass, position=(radius, 0.0, height), velocity=velocity)
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    states = sample(system, state, (0.5, 1.0, 1.5), 5e-4)
    q, angle = np.asarray(states.q), data["rate"] * np.asarray(states.time)
    circle = np.stack([np.cos(angle), np.sin(angle), np.full(3, height / radius)], -1) * radius
    tension = -np.asarray(solve(system, states).multipliers[:, 0]) / mass
    expected = np.full(3, data["tension_over_m"])
    return [
        Check("conical_pendulum", "position to 1.5 s", relative(q, circle), BOUND),
        Check("conical_pendulum", "tension/m = −λ/m", relative(tension, expected), BOUND),
    ]


def physical_pendulum() -> list[Check]:
    """Checks a rod of length l that swings about its end from the horizontal to the bottom.

    At the horizontal, θ̈ = 3g/(2l) and the pin force is m g/4. At the bottom, ω² = 3g/l and the pin
    force is 5/2 m g. A quarter period takes K(sin 45°)/√(3g/(2l)), with the elliptic integral K.
    """
    data, length = constants("physical_pendulum_pin_force"), 1.0
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_body("rod", mass=1.0, inertia=length**2 / 12, position=(length / 2, 0.0))
    scene.add(jc.Revolute("pin", jc.WORLD, "rod", point=(0.0, 0.0)))
    system, state = scene.build()
    steps = 1000
    quarter = quarter_turn() / np.sqrt(1.5 * G / length)
    bottom = jax.tree.map(lambda x: x[1], run(system, RK4, state, quarter / steps, steps, 1))
    at_rest, moving = (forward(system, s, None, RK4, 1e-3) for s in (state, bottom))
    up = jc.wrench(at_rest, "pin", system=system)[1]
    up_below = jc.wrench(moving, "pin", system=system)[1]
    results = {
        "initial_angular_acceleration": -at_rest.acceleration[2],
        "initial_pin_force_up": up,
        "bottom_angular_speed": -bottom.v[2],
        "bottom_pin_force_up": up_below,
    }
    return [
        Check("physical_pendulum", key.replace("_", " "), relative(x, data[key]), BOUND)
        for key, x in results.items()
    ]


def quarter_turn() -> float:
    """Returns the elliptic integral K(k) for k² = ½ as π / (2 agm(1, √½)).

    agm is the arithmetic-geometric mean.
    """
    a, b = 1.0, np.sqrt(0.5)
    for _ in range(6):
        a, b = (a + b) / 2, np.sqrt(a * b)
    return np.pi / (2 * a)


def solve_one(system: BodySystem, state: jc.State) -> tuple[np.ndarray, np.ndarray]:
    """Returns the accelerations (n_v,) and the multipliers (rows,) at one state."""
    solution = forward(system, state, None, RK4, 1e-3)
    return np.asarray(solution.acceleration), np.asarray(solution.multipliers)
