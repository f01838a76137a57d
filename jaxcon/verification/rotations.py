"""Rotating bodies in space: free bodies, and bodies that rotate about a fixed point."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, up_to_sign
from jaxcon.verification.references import column
from jaxcon.verification.sampling import multipliers, sample


def tumbling_body() -> list[Check]:
    """Checks a free body that spins near its intermediate axis and flips over repeatedly.

    It obeys I ω̇ = −ω × Iω. The quaternions of the reference have 12 digits.

    References:
        Landau, Lifshitz, Mechanics, section 37: ω in Jacobi's elliptic functions.
    """
    case, data = "tumbling_body", references.load("an_dzhanibekov")
    p, rows = data["parameters"], data["reference"]
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    spin = p["omega0_body"]
    scene.add_body(
        "body", mass=p["mass"], inertia=p["I"], quaternion=p["q0"], angular_velocity=spin
    )
    system, state = scene.build()
    states = sample(system, state, [r["t"] for r in rows], 2e-3)
    turn, omega = states.q[:, 3:], np.asarray(states.v[:, 3:])
    momentum = jc.quaternion.rotate(turn.T, jnp.array((omega * p["I"]).T)).T
    kinetic = omega**2 @ np.array(p["I"]) / 2
    n = len(rows)
    return [
        Check(case, "ω to 30 s [rad/s]", error(omega, column(rows, "omega_body")), 1e-8),
        Check(case, "orientation to 30 s", up_to_sign(turn, column(rows, "q")), 1e-8),
        Check(case, "angular momentum", error(momentum, [data["L_world"]] * n), 1e-8),
        Check(case, "kinetic energy [J]", error(kinetic, [data["energy_T"]] * n), 1e-8),
    ]


def symmetric_body() -> list[Check]:
    """Checks a free axisymmetric body: its rotation is a product of two uniform rotations.

    References:
        Kane, Likins, Levinson, Spacecraft Dynamics (1983), section 1.13.
    """
    case, data = "symmetric_body", references.load("an_free_symmetric_body")
    p, rows = data["parameters"], data["rows"]
    scene = jc.Scene(dim=3, gravity=p["g"])
    scene.add_body(
        "body",
        mass=p["m"],
        inertia=(p["I"], p["I"], p["J"]),
        position=p["p0"],
        quaternion=p["q0"],
        velocity=p["v0_world"],
        angular_velocity=p["omega0_body"],
    )
    system, state = scene.build()
    states = sample(system, state, [r["t"] for r in rows], 5e-4)
    return [
        Check(case, "position to 5 s [m]", error(states.q[:, :3], column(rows, "p")), 1e-8),
        Check(case, "orientation to 5 s", up_to_sign(states.q[:, 3:], column(rows, "q")), 1e-8),
        Check(case, "ω to 5 s [rad/s]", error(states.v[:, 3:], column(rows, "omega_body")), 1e-8),
    ]


def top(p: dict[str, Any], center: np.ndarray, **motion: Any) -> tuple[BodySystem, jc.State]:
    """Builds a body on a ball joint at the origin, with its center of mass at `center` [m]."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.81))
    scene.add_body("top", mass=p["m"], position=center, **motion)
    scene.add(jc.Spherical("pivot", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    return scene.build()


def steady_top() -> list[Check]:
    """Checks the two rates at which a symmetric top precesses without nutation.

    The rate Ω satisfies I₁ cos θ Ω² − I₃ ω₃ Ω + m g l = 0. θ is the tilt, and ω₃ the angular
    velocity about the symmetry axis. I₁ and I₃ are the transverse and the axial inertia.

    References:
        Goldstein, Classical Mechanics (3rd ed.), section 5.7.
    """
    data = references.load("an_symmetric_top_steady")
    p = data["parameters"]
    tilt, times = np.pi / 6, np.array([0.25, 0.5, 0.75, 1.0])
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    half = tilt / 2
    turn, body_up = (np.cos(half), 0.0, np.sin(half), 0.0), np.array([-axis[0], 0.0, axis[2]])
    checks = []
    for name in ("slow", "fast"):
        rate = data[f"Omega_{name}"]
        # ω = Ω z + (ω₃ − Ω cos θ) e₃ in body axes
        omega = rate * body_up + np.array([0.0, 0.0, p["w3"] - rate * np.cos(tilt)])
        velocity = (0.0, rate * p["l"] * axis[0], 0.0)
        system, state = top(
            p,
            p["l"] * axis,
            inertia=p["I_com"],
            quaternion=turn,
            velocity=velocity,
            angular_velocity=omega,
        )
        states = sample(system, state, times.tolist(), 1e-4)
        circle = [np.sin(tilt) * f(rate * times) for f in (np.cos, np.sin)]
        expected = p["l"] * np.stack([*circle, np.full(4, np.cos(tilt))], -1)
        deviation = error(states.q[:, :3], expected)
        checks.append(Check("steady_top", f"{name}: center of mass to 1 s [m]", deviation, 1e-8))
    return checks


def heavy_top() -> list[Check]:
    """Checks a fast top, 150 rad/s about its axis: a benchmark for integrators on Lie groups.

    References:
        Brüls, Cardona, On the use of Lie group time integrators in multibody dynamics (2010);
        the trajectory by a method of order eight, at two tolerances that agree to 1e-9.
    """
    case, data = "heavy_top", references.load("an_heavy_top")
    p, rows = data["parameters"], data["reference"]
    omega = np.array(p["omega0_body"])
    arm = p["com_body_from_pivot"]
    system, state = top(
        p,
        arm,
        inertia=p["J_com"],
        velocity=np.cross(omega, arm),
        angular_velocity=omega,
    )
    states = sample(system, state, [r["t"] for r in rows], 2.5e-5)
    force = multipliers(system, states, "pivot")  # on the top, world frame
    forces = column(rows, "joint_force_on_body")
    return [
        Check(case, "center of mass to 2 s [m]", error(states.q[:, :3], column(rows, "com")), 1e-8),
        Check(case, "orientation", up_to_sign(states.q[:, 3:], column(rows, "quat")), 1e-8),
        Check(case, "ω [rad/s]", error(states.v[:, 3:], column(rows, "omega_body")), 1e-8),
        Check(case, "force of the joint [N]", error(force, forces), 1e-6),
    ]
