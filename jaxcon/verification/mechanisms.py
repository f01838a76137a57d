"""Mechanisms with a prescribed motion: a universal joint and a driven slider-crank."""

from __future__ import annotations

import jax
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import multipliers, sample, solve


def steady(t: jax.Array, rate: float | jax.Array) -> jax.Array:
    """Returns the prescribed angle Ω t of a drive with constant rate Ω [rad]."""
    return rate * t


def hooke_joint() -> list[Check]:
    """Checks two shafts at β = 30° that a universal joint couples: tan φ = tan θ / cos β.

    θ is the angle of the input shaft and φ the angle of the output shaft. Derivatives are checked
    too. A bearing and a drive hold the input shaft at constant speed. Only the universal joint and
    a constraint on the direction of the output shaft hold that shaft, so no row is redundant.

    References:
        Textbook; ω_out/ω_in = cos β/(1 − sin²β cos²θ), θ from the plane of the shafts.
    """
    case, rows = "hooke_joint", references.load("an_hooke_joint")["rows"]
    bend, rate = np.pi / 6, np.radians(150.0)
    system, state = coupled_shafts(bend, rate)
    times = (column(rows, "theta_in_deg") / 150).tolist()
    states = sample(system, state, times, 1e-3)
    shaft = system.layout.v("output")
    turn = np.asarray(states.q)[:, system.layout.q("output")][:, 3:]
    # a rotation by β about z, then by φ about the body's x axis, has the quaternion
    # (cos β/2 cos φ/2, cos β/2 sin φ/2, sin β/2 sin φ/2, …)
    angle = 2 * np.arctan2(turn[:, 1], turn[:, 0])
    spin = np.asarray(states.v)[:, shaft][:, 3] / rate
    gain = np.asarray(solve(system, states).acceleration)[:, shaft][:, 3] / rate**2
    return [
        Check(case, "angle of the output [rad]", error(angle, column(rows, "phi_out")), 1e-8),
        Check(case, "ratio of the speeds", error(spin, column(rows, "ratio")), 1e-8),
        Check(case, "its derivative by θ", error(gain, column(rows, "dratio_dtheta")), 1e-8),
    ]


def coupled_shafts(bend: float, rate: float) -> tuple[BodySystem, jc.State]:
    """Builds two shafts that a universal joint couples at the origin.

    The input shaft is along x. The output shaft is rotated from it by the angle `bend` about z.
    """
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    x, y, z = np.eye(3)
    along = np.cos(bend) * x + np.sin(bend) * y
    turn = (np.cos(bend / 2), 0.0, 0.0, np.sin(bend / 2))
    inertia = (0.02, 0.1, 0.1)
    scene.add_body("input", mass=1.0, inertia=inertia, position=-0.5 * x, angular_velocity=rate * x)
    spin = rate / np.cos(bend) * x  # in the frame of the output shaft
    scene.add_body(
        "output",
        mass=1.0,
        inertia=inertia,
        position=0.5 * along,
        quaternion=turn,
        angular_velocity=spin,
    )
    scene.add(jc.Revolute("bearing", jc.WORLD, "input", point=-x, axis=x))
    scene.add(jc.joints.Universal("cross", "input", "output", point=0.0 * x, axis_a=y, axis_b=z))
    scene.add(jc.joints.Parallel("guide", jc.WORLD, "output", axis=along))
    scene.add(jc.joints.Drive("motor", "bearing", steady, params=rate))
    return scene.build()


def slider_crank() -> list[Check]:
    """Checks a crank at constant speed, a massless rod and a piston.

    Position of the piston, forces and drive torque are compared. The rod is a `Distance`; its λ is
    the force on the piston along the rod. The λ of the guide is the side force on the piston. The λ
    of the drive is its torque T.

    References:
        Textbook; T ω = m a v.
    """
    case, data = "slider_crank", references.load("an_slider_crank_kinematic")
    p, rows = data["parameters"], data["rows"]
    system, state = driven_crank(p["r"], p["l"], p["m_piston"], p["omega"])
    step = np.radians(5.0) / p["omega"]
    times = (column(rows, "theta_deg") / 5 * step).tolist()
    states = sample(system, state, times, step / 50)
    piston = system.layout.v("piston")[0]
    acceleration = np.asarray(solve(system, states).acceleration)[:, piston]
    results = {
        "position of the piston [m]": (states.q[:, system.layout.q("piston")[0]], "x"),
        "its velocity [m/s]": (states.v[:, piston], "v"),
        "its acceleration [m/s²]": (acceleration, "a"),
        "torque of the drive [N m]": (force(system, states, "motor"), "drive_torque_on_crank"),
        "force of the rod [N]": (
            force(system, states, "rod"),
            "rod_axial_force_on_piston_along_rod",
        ),
        "force of the guide [N]": (force(system, states, "guide"), "side_force_on_piston"),
    }
    return [Check(case, k, error(x, column(rows, key)), 1e-8) for k, (x, key) in results.items()]


def force(system: BodySystem, states: jc.State, name: str) -> np.ndarray:
    """Returns the multiplier λ of a constraint with one row, (states,)."""
    return multipliers(system, states, name)[:, 0]


def driven_crank(
    radius: float, rod: float, mass: float, rate: float
) -> tuple[BodySystem, jc.State]:
    """Builds a planar slider-crank without gravity. Crank and rod are in line at the start."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("crank", mass=1.0, inertia=0.01, angular_velocity=rate)
    scene.add_particle("piston", mass=mass, position=(radius + rod, 0.0))
    scene.add(jc.Revolute("bearing", jc.WORLD, "crank", point=(0.0, 0.0)))
    scene.add(jc.joints.Drive("motor", "bearing", steady, params=rate))
    scene.add(jc.Distance("rod", "crank", "piston", point_a=(radius, 0.0), length=rod))
    scene.add(jc.joints.PointOnLine("guide", jc.WORLD, "piston", axis=(1.0, 0.0)))
    return scene.build()
