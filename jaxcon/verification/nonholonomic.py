"""Nonholonomic constraints A(q, t) v + b(q, t) = 0, which no equation in positions can express."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, multipliers, run, sample


def blade(body: jc.extend.Motion, t: jax.Array, offset: jax.Array) -> jax.Array:
    """Returns the residual n · ẋ, the sideways velocity of a blade, (1,) [m/s].

    The blade is at (−offset, 0) of the body, and n is its normal.
    """
    behind = jnp.stack([-offset, jnp.zeros_like(offset)])
    sideways = body.direction(jnp.array([0.0, 1.0], behind.dtype))
    return jnp.dot(sideways, body.point_velocity(behind))[None]


def sleigh(p: dict[str, Any]) -> tuple[BodySystem, jc.State]:
    """Builds a planar body on a blade at a distance a behind its center of mass."""
    a, along = p["a"], np.array([np.cos(p["theta0"]), np.sin(p["theta0"])])
    across = np.array([-along[1], along[0]])
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body(
        "sleigh",
        mass=p["m"],
        inertia=p["I_com"],
        position=p["blade0"] + a * along,
        angle=p["theta0"],
        velocity=p["u0"] * along + a * p["omega0"] * across,
        angular_velocity=p["omega0"],
    )
    scene.add(jc.joints.VelocityLevel(blade, bodies=("sleigh",), name="blade", params=jnp.array(a)))
    return scene.build()


def chaplygin_sleigh() -> list[Check]:
    """Checks a sleigh on a blade at a distance a behind its center of mass.

    Its forward speed u and angular velocity ω satisfy u̇ = a ω² and (I + m a²) ω̇ = −m a u ω.

    References:
        Bloch, Nonholonomic Mechanics and Control (2003).
    """
    case, data = "chaplygin_sleigh", references.load("an_chaplygin_sleigh")
    p, rows = data["parameters"], data["rows"]
    system, state = sleigh(p)
    states = sample(system, state, [r["t"] for r in rows], 1e-3)
    q, v = np.asarray(states.q), np.asarray(states.v)
    along = np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], -1)
    energy = v**2 @ [p["m"], p["m"], p["I_com"]] / 2
    force = multipliers(system, states, "blade")[:, 0]
    results = {
        "center of mass to 5 s [m]": (q[:, :2], "com"),
        "blade [m]": (q[:, :2] - p["a"] * along, "blade"),
        "θ [rad]": (q[:, 2], "theta"),
        "forward speed u [m/s]": (np.sum(along * v[:, :2], -1), "u"),
        "ω [rad/s]": (v[:, 2], "omega"),
        "sideways force on the blade [N]": (force, "lateral_force_on_body"),
    }
    checks = [Check(case, k, error(x, column(rows, key)), 1e-8) for k, (x, key) in results.items()]
    conserved = [data["constants"]["energy"]] * len(rows)
    return [*checks, Check(case, "energy [J]", error(energy, conserved), 1e-8)]


def rolling(ball: jc.extend.Motion, t: jax.Array, params: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Returns the slip of a ball on the plane z = 0, which rotates at a rate Ω, (2,) [m/s].

    Without slip, ẋ − r ω_y = −Ω y and ẏ + r ω_x = Ω x, with radius r and angular velocity ω.
    """
    radius, rate = params
    omega = jc.quaternion.rotate(ball.orientation, ball.angular_velocity)
    x, v = ball.position, ball.velocity
    slip = [v[0] - radius * omega[1] + rate * x[1], v[1] + radius * omega[0] - rate * x[0]]
    return jnp.stack(slip)


def height(ball: jc.extend.Pose, t: jax.Array, radius: jax.Array) -> jax.Array:
    """Returns z − r, the gap between a ball of radius r and the plane z = 0, (1,) [m]."""
    return (ball.position[2] - radius)[None]


def rolling_ball(
    mass: float,
    radius: float,
    rate: float,
    gravity: Sequence[float],
    **motion: Any,
) -> tuple[BodySystem, jc.State]:
    """Builds a homogeneous ball on the plane z = 0, which rotates about z at a rate [rad/s]."""
    scene = jc.Scene(dim=3, gravity=gravity)
    scene.add_body("ball", inertia=jc.inertia.sphere(mass, radius), **motion)
    params = (jnp.array(radius), jnp.array(rate))
    scene.add(jc.joints.Holonomic(height, ("ball",), "height", params[0]))
    scene.add(jc.joints.VelocityLevel(rolling, ("ball",), "rolling", params))
    return scene.build()


def ball_on_turntable() -> list[Check]:
    """Checks a ball that rolls on a turntable and moves in circles: v̇ = (2/7) Ω z × v.

    v is the velocity of the ball and Ω the rate of the turntable about z.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972).
    """
    case, data = "ball_on_turntable", references.load("an_ball_turntable")
    p, rows = data["parameters"], data["rows"]
    system, state = rolling_ball(
        p["m"],
        p["r"],
        p["table_rate"],
        (0.0, 0.0, -9.81),
        position=(p["x0"], p["y0"], p["r"]),
        velocity=(p["vx0"], p["vy0"], 0.0),
        angular_velocity=p["initial_w"],
    )
    states = sample(system, state, [r["t"] for r in rows], 2.5e-3)
    x = np.stack([column(rows, k) for k in ("x", "y")], -1)
    v = np.stack([column(rows, k) for k in ("vx", "vy")], -1)
    return [
        Check(case, "position to 10 s [m]", error(states.q[:, :2], x), 1e-8),
        Check(case, "velocity to 10 s [m/s]", error(states.v[:, :2], v), 1e-8),
    ]


def skate(particle: jc.extend.Motion, t: jax.Array, params: None) -> jax.Array:
    """Returns the residual ż − y ẋ of a nonholonomic constraint on a particle, (1,)."""
    return (particle.velocity[2] - particle.position[1] * particle.velocity[0])[None]


def nonholonomic_particle() -> list[Check]:
    """Checks a particle without forces under the constraint ż = y ẋ.

    Its motion obeys ẍ = −y λ and z̈ = λ. Derivatives of the flow are checked too.

    References:
        Rosenberg, Analytical Dynamics of Discrete Systems (1977).
    """
    case, data = "nonholonomic_particle", references.load("an_nonholonomic_particle")
    p, rows = data["parameters"], data["rows"]
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_particle("particle", mass=p["mass"])
    scene.add(jc.joints.VelocityLevel(skate, bodies=("particle",), name="skate"))
    system, start = scene.build()

    def release(free: jax.Array) -> jc.State:
        x, y, z, vx, vy = free
        return dataclasses.replace(start, q=jnp.stack([x, y, z]), v=jnp.stack([vx, vy, y * vx]))

    def flow(free: jax.Array) -> jax.Array:
        return run(system, RK4, release(free), 5e-3, 100, 10).q[np.array([1, 2, 4, 10])]

    free = jnp.array([*p["q0"], p["xdot0"], p["ydot0"]])
    states = sample(system, release(free), [r["t"] for r in rows], 1.25e-3)
    force = multipliers(system, states, "skate")[:, 0]
    jacobian = column(rows, "dq_d_x0_y0_z0_vx0_vy0")
    forward, reverse = jax.jit(jax.jacfwd(flow))(free), jax.jit(jax.jacrev(flow))(free)
    return [
        Check(case, "position to 5 s [m]", error(states.q, column(rows, "q")), 1e-10),
        Check(case, "velocity to 5 s [m/s]", error(states.v, column(rows, "v")), 1e-10),
        Check(case, "force λ to 5 s", error(force, column(rows, "constraint_force_z")), 1e-10),
        Check(case, "∂q(t)/∂(x₀, y₀, z₀, ẋ₀, ẏ₀) by jacfwd", error(forward, jacobian), 1e-9),
        Check(case, "∂q(t)/∂(x₀, y₀, z₀, ẋ₀, ẏ₀) by jacrev", error(reverse, jacobian), 1e-9),
    ]
