"""Discs that roll without slip, and a skate under physical and variational equations."""

from __future__ import annotations

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import jaxcon as jc
from jaxcon.analysis.reference import butcher
from jaxcon.protocols import System
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import multipliers, sample, solve


def disc(
    p: dict[str, Any], turn: ArrayLike, axis: np.ndarray, omega: np.ndarray
) -> tuple[BodySystem, jc.State]:
    """Builds a disc that touches the plane z = 0 at the origin. Its axis is y of its body frame.

    Args:
        p: mass m, radius r, inertias I_axial and I_transverse, and gravity g.
        turn: the orientation, a quaternion from body to world, (4,).
        axis: the axis of the disc in the world frame, a unit vector (3,).
        omega: the angular velocity in the world frame, (3,) [rad/s]. The contact point is at rest.
    """
    up = np.array([0.0, 0.0, 1.0])
    arm = up - axis[2] * axis
    center = p["r"] * arm / np.linalg.norm(arm)
    matrix = np.asarray(jc.quaternion.matrix(jnp.asarray(turn)))
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -p["g"]))
    scene.add_body(
        "disc",
        mass=p["m"],
        inertia=(p["I_transverse"], p["I_axial"], p["I_transverse"]),
        position=center,
        quaternion=turn,
        velocity=np.cross(omega, center),
        angular_velocity=matrix.T @ omega,
    )
    scene.add(jc.joints.RollingDisc("roll", jc.WORLD, "disc", radius=p["r"], axis=axis))
    return scene.build()


def rolling_disc() -> list[Check]:
    """Checks a disc that rolls in a steady turn.

    Its turning rate Ω satisfies (I_a + m r²) w_a Ω cos φ − I_t Ω² sin φ cos φ = −m g r sin φ. φ is
    the roll angle, and w_a the angular velocity about the axis of the disc. I_a and I_t are the
    axial and the transverse inertia.

    References:
        Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972).
    """
    case, data = "rolling_disc", references.load("an_rolling_disc")
    p, steady = data["parameters"], data["steady"]
    roll, times = steady["roll"], np.array([0.25, 0.5, 1.0])
    axis, turn = np.array([0.0, np.cos(roll), np.sin(roll)]), (np.cos(roll / 2), np.sin(roll / 2))
    checks = []
    for reference, name in zip(steady["solutions"], ("fast", "slow"), strict=True):
        rate = reference["Omega"]
        omega = np.array([0.0, 0.0, rate]) + steady["spin"] * axis
        system, state = disc(p, (*turn, 0.0, 0.0), axis, omega)
        states = sample(system, state, times.tolist(), 2.5e-4)
        start, velocity = np.asarray(state.q[:3]), np.asarray(state.v[:3])
        middle = start + np.cross([0.0, 0.0, 1.0], velocity) / rate
        angle = rate * times
        arm = (start - middle)[0] + 1j * (start - middle)[1]
        around = arm * np.exp(1j * angle)
        circle = np.stack([around.real, around.imag, np.full(3, start[2])], -1) + middle * [1, 1, 0]
        radius = abs(np.hypot(*(start - middle)[:2]) - reference["centre_path_radius"])
        solution = jc.forward_dynamics(system, state, None, jc.Method(jc.RK4()), 1e-3)
        force = reference["contact_force_on_disc"]
        expected = [force[key] for key in ("along_heading", "lateral", "vertical")]
        contact = jc.wrench(solution, "roll", system=system)[:3]
        checks += [
            Check(case, f"{name} turn: center to 1 s [m]", error(states.q[:, :3], circle), 1e-8),
            Check(case, f"{name} turn: radius of the path [m]", float(radius), 1e-12),
            Check(case, f"{name} turn: force of the contact [N]", error(contact, expected), 1e-8),
        ]
    return checks


def rolling_coin() -> list[Check]:
    """Checks a coin that spins at 5 turns per second, one degree off the vertical.

    References:
        Rill, Schaeffer, Grundlagen und Methodik der Mehrkörpersimulation (2010), p. 59; EXUDYN,
        rollingCoinTest, whose step error in x is 8.5e-7 m.
    """
    case, data = "rolling_coin", references.load("exudyn_rolling_coin")
    p, rows = data["parameters"], data["corrected_reference"]
    tilt = np.deg2rad(p["tilt0_deg"])
    axis = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    # the rotation of y into the axis: first by −90° about z, then by the tilt about y
    quarter = jc.quaternion.from_axis_angle((0.0, 0.0, 1.0), -np.pi / 2)
    lean = jc.quaternion.from_axis_angle((0.0, 1.0, 0.0), tilt)
    system, state = disc(p, jc.quaternion.multiply(lean, quarter), axis, np.array(p["omega0"]))
    states = sample(system, state, [r["t"] for r in rows], 1e-4)
    axes = np.asarray(jax.vmap(lambda q: jc.quaternion.matrix(q)[:, 1])(states.q[:, 3:]))
    arm = np.array([0.0, 0.0, 1.0]) - axes[:, 2:] * axes
    center = np.asarray(states.q[:, :3])
    contact = center - p["r"] * arm / np.linalg.norm(arm, axis=1, keepdims=True)
    deviation = abs(contact[-1, 0] - data["exudyn_value"]["contact_x_at_0p5"])
    return [
        Check(case, "center to 0.5 s [m]", error(center, column(rows, "centre")), 1e-8),
        Check(case, "contact [m]", error(contact[:, :2], column(rows, "contact_xy")), 1e-8),
        Check(case, "contact x at 0.5 s against EXUDYN [m]", float(deviation), 1e-6),
    ]


def skate(p: dict[str, Any]) -> tuple[BodySystem, jc.State]:
    """Builds a spinning body on an incline. Its blade is at the center of mass; x is downhill."""
    scene = jc.Scene(dim=2, gravity=(p["g"] * np.sin(np.pi / 6), 0.0))
    scene.add_body("skate", mass=p["m"], inertia=p["J"], angular_velocity=p["omega"])
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    return scene.build()


def knife_edge_incline() -> list[Check]:
    """Checks a spinning skate on an incline, which does not slide down.

    Its path is x = c sin² ωt, y = c (ωt − ½ sin 2ωt), with c = g sin α/(2ω²), spin ω and slope α.

    References:
        Bloch, Nonholonomic Mechanics and Control (2003), section 1.6.
    """
    case, data = "knife_edge_incline", references.load("an_knife_edge_incline")
    p, rows = data["parameters"], data["rows"]
    system, state = skate(p)
    states = sample(system, state, [r["t"] for r in rows], 1e-3)
    x, y, angle = np.asarray(states.q).T
    speed = np.hypot(*np.asarray(states.v[:, :2]).T)
    force = np.abs(multipliers(system, states, "blade")[:, 0])
    results = {
        "x to 5 s [m]": (x, "x"),
        "y [m]": (y, "y"),
        "φ [rad]": (angle, "phi"),
        "speed [m/s]": (speed, "speed"),
        "side force [N]": (force, "side_force"),
    }
    return [Check(case, k, error(x, column(rows, key)), 1e-8) for k, (x, key) in results.items()]


def vakonomic_knife_edge() -> list[Check]:
    """Checks conserved quantities of a skate on an incline under the variational equations.

    Unlike under the physical equations, the skate slides down. Three quantities are constant:
    m ẏ − μ cos φ, m ẋ + μ sin φ − m g t sin α, and the energy. Here φ is the heading, α the slope,
    and μ the multiplier of the blade, initially 0.1. The spin obeys J φ̈ = μ (ẋ cos φ + ẏ sin φ).
    The slip ψ = ẋ sin φ − ẏ cos φ is zero. `KnifeEdge` has the opposite sign of ψ, so the code has
    −μ.

    References:
        Bloch, Baillieul, Crouch, Marsden, Nonholonomic Mechanics and Control (2003), section 1.6.
    """
    case, data = "vakonomic_knife_edge", references.load("an_knife_edge_incline")
    p, pull = data["parameters"], data["parameters"]["g"] * np.sin(np.pi / 6)
    variational, state = jc.systems.vakonomic(*skate(p), {"blade": -0.1})
    system = cast(System, variational)  # `variational` delegates most methods to the skate
    method = jc.Method(butcher())  # order six, because the spin exceeds 18 rad/s
    states = sample(system, state, [0.5, 1.0, 2.0, 5.0], 2e-4, method)
    t, (x, _, angle) = np.asarray(states.time), np.asarray(states.q).T
    vx, vy, spin, μ = np.asarray(states.v).T * [[1], [1], [1], [-1]]
    sine, cosine = np.sin(angle), np.cos(angle)
    energy = p["m"] * (vx**2 + vy**2) / 2 + p["J"] * spin**2 / 2 - p["m"] * pull * x
    torque = p["J"] * np.asarray(solve(system, states).acceleration)[:, 2]
    zero = np.zeros(4)
    across, along = p["m"] * vy - μ * cosine, p["m"] * (vx - pull * t) + μ * sine
    checks = {
        "m ẏ − μ cos φ to 5 s": error(across, zero - 0.1),
        "m ẋ + μ sin φ − m g t sin α": error(along, zero),
        "energy [J]": error(energy, zero + p["J"] * p["omega"] ** 2 / 2),
        "J φ̈ − μ (ẋ cos φ + ẏ sin φ)": error(torque, μ * (vx * cosine + vy * sine)),
        "slip ψ [m/s]": error(vx * sine - vy * cosine, zero),
    }
    return [Check(case, name, value, 1e-9) for name, value in checks.items()]
