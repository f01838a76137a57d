"""Pendulums of point masses, with distance constraints in Cartesian coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import sample, solve


def hanging_chain(
    masses: Sequence[float],
    lengths: Sequence[float],
    angles: Sequence[float],
    rates: Sequence[float],
    g: float,
) -> tuple[BodySystem, jc.State]:
    """Builds a planar chain of point masses, each on a rod from the one above.

    Angles are measured from the downward vertical [rad].
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -g))
    above, position, velocity = jc.WORLD, np.zeros(2), np.zeros(2)
    for i, (m, length, angle, rate) in enumerate(zip(masses, lengths, angles, rates, strict=True)):
        along = length * np.array([np.sin(angle), -np.cos(angle)])
        position, velocity = position + along, velocity + rate * np.array([-along[1], along[0]])
        scene.add_particle(f"bob{i}", mass=m, position=position, velocity=velocity)
        scene.add(jc.Distance(f"rod{i}", above, f"bob{i}", length=length))
        above = f"bob{i}"
    return scene.build()


def chain_positions(states: jc.State, bobs: int) -> np.ndarray:
    """Returns the positions of the point masses, (times, bobs, 2) [m]."""
    return np.swapaxes(np.asarray(states.q).reshape(-1, 2, bobs), 1, 2)


def chain_rates(states: jc.State, bobs: int) -> np.ndarray:
    """Returns the angular velocity of each rod, (times, bobs) [rad/s].

    It is ω = r × ṙ / |r|², where r is the vector along the rod.
    """
    x, v = (np.asarray(y).reshape(-1, 2, bobs) for y in (states.q, states.v))
    r, rate = (np.diff(y, axis=2, prepend=0) for y in (x, v))
    return (r[:, 0] * rate[:, 1] - r[:, 1] * rate[:, 0]) / np.sum(r * r, axis=1)


def simple_pendulum() -> list[Check]:
    """Checks a pendulum released from the horizontal: θ̈ = −(g/L) sin θ.

    The tension is T = m(L θ̇² + g cos θ) = −λ. Reference rows at 1000 s and 2000 s are omitted:
    they would take millions of steps.

    References:
        IFToMM benchmark library, problem A01; solution in Jacobi's elliptic functions.
    """
    case, data = "simple_pendulum", references.load("iftomm_A01_pendulum")
    g, rows = data["parameters"]["g"], [r for r in data["reference"] if r["t"] <= 100]
    system, state = hanging_chain([1.0], [1.0], [np.pi / 2], [0.0], g)
    states = sample(system, state, [r["t"] for r in rows], 2.5e-4)
    x, v = (np.stack([column(rows, k) for k in keys], -1) for keys in (("x", "y"), ("vx", "vy")))
    tension = np.sum(v * v, -1) - g * x[:, 1]
    period = data["period_s"]
    swing = sample(system, state, (period / 4, period), period / 8000)
    tensions = -solve(system, states).multipliers[:, 0]
    quarter = -solve(system, swing).multipliers[0, 0]
    return [
        Check(case, "position to 10 s [m]", error(states.q[:-1], x[:-1]), 1e-8),
        Check(case, "velocity to 10 s [m/s]", error(states.v[:-1], v[:-1]), 1e-8),
        Check(case, "position at 100 s [m]", error(states.q[-1], x[-1]), 1e-8),
        Check(case, "velocity at 100 s [m/s]", error(states.v[-1], v[-1]), 1e-8),
        Check(case, "tension T = −λ at all times [N]", error(tensions, tension), 1e-8),
        Check(case, "back after one period [m]", error(swing.q[1], state.q), 1e-8),
        Check(case, "largest speed", error(-swing.v[0, 0], data["max_speed"]), 1e-8),
        Check(case, "largest tension", error(quarter, data["max_multiplier_tension_N"]), 1e-8),
    ]


def double_pendulum() -> list[Check]:
    """Checks two point masses released from the horizontal, with zero total energy.

    References:
        Extrapolation in 80-bit arithmetic; each row states its accuracy.
    """
    case, data = "double_pendulum", references.load("an_double_pendulum")
    system, state = hanging_chain([1, 1], [1, 1], [np.pi / 2] * 2, [0, 0], data["parameters"]["g"])
    rows = data["rows"]
    states = sample(system, state, [r["t"] for r in rows], 2.5e-4)
    expected = np.stack([column(rows, "p1"), column(rows, "p2")], axis=1)
    rates = column(rows, "omega")
    energy = [
        jc.energy(system, jc.State(q, v, t, state.status)).total
        for q, v, t in zip(states.q, states.v, states.time, strict=True)
    ]
    return [
        Check(case, "positions to 10 s [m]", error(chain_positions(states, 2), expected), 1e-8),
        Check(case, "rates to 10 s [rad/s]", error(chain_rates(states, 2), rates), 1e-8),
        Check(case, "energy to 10 s [J]", error(energy, [data["energy"]] * len(rows)), 1e-8),
    ]


def chain_pendulum() -> list[Check]:
    """Checks chains of two and of five point masses.

    References:
        Finzi, Wang, Wilson, Simplifying Hamiltonian and Lagrangian neural networks via explicit
        constraints (2020): parameters; trajectories by extrapolation in 80-bit arithmetic.
    """
    checks = []
    for data in references.load("chnn_chain_pendulum")["cases"]:
        n, rows = data["n"], data["rows"]
        masses, lengths = data["masses_top_to_bottom"], data["lengths_top_to_bottom"]
        system, state = hanging_chain(masses, lengths, data["theta0"], data["omega0"], 9.81)
        states = sample(system, state, [r["t"] for r in rows], 5e-4)
        errors = {
            "positions to 3 s [m]": error(chain_positions(states, n), column(rows, "xy")),
            "rates to 3 s [rad/s]": error(chain_rates(states, n), column(rows, "omega")),
        }
        checks += [Check("chain_pendulum", f"{n} links: {k}", e, 1e-8) for k, e in errors.items()]
    return checks


def spherical_pendulum() -> list[Check]:
    """Checks a spherical pendulum, whose bob oscillates between two heights.

    It has one distance constraint. Energy and the vertical angular momentum L_z are conserved.

    References:
        Extrapolation in 80-bit arithmetic.
    """
    case, data = "spherical_pendulum", references.load("an_spherical_pendulum")
    p = data["parameters"]
    sine, cosine = np.sin(p["theta0"]), np.cos(p["theta0"])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -p["g"]))
    velocity = (0.0, sine * p["phidot0"], 0.0)
    scene.add_particle("bob", mass=p["m"], position=(sine, 0.0, -cosine), velocity=velocity)
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    states = sample(system, state, [r["t"] for r in data["rows"]], 2.5e-4)
    q, v = np.asarray(states.q), np.asarray(states.v)
    momentum = q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]
    energy = np.sum(v * v, -1) / 2 + p["g"] * q[:, 2]
    return [
        Check(case, "position to 10 s [m]", error(q, column(data["rows"], "xyz")), 1e-9),
        Check(case, "L_z", error(momentum, np.full(len(q), data["Lz"])), 1e-9),
        Check(case, "energy", error(energy, np.full(len(q), data["energy"])), 1e-9),
    ]
