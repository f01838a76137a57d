"""Andrews' squeezing mechanism: seven angles, three closed loops, and a motion of 0.03 s."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.generalized import GeneralizedCoordinates
from jaxcon.verification import references
from jaxcon.verification.case import Check, relative, scaled
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, sample, solve


def mass(q: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the mass matrix M(q), (7, 7) [kg m²], at the angles q = (β, Θ, γ, Φ, δ, Ω, ε)."""
    cos, sin = jnp.cos(q), jnp.sin(q)
    e, f = p["e"] - p["ea"], p["zf"] - p["fa"]
    m45 = p["m4"] * (e**2 + p["zt"] * e * sin[3]) + p["i4"]
    m67 = p["m6"] * (f**2 - p["u"] * f * sin[5]) + p["i6"]
    m12 = p["m2"] * (p["da"] ** 2 - p["da"] * p["rr"] * cos[1]) + p["i2"]
    crank = p["rr"] ** 2 - 2 * p["da"] * p["rr"] * cos[1] + p["da"] ** 2
    upper = p["zt"] ** 2 + 2 * p["zt"] * e * sin[3] + e**2
    lower = f**2 - 2 * p["u"] * f * sin[5] + p["u"] ** 2
    diagonal = [
        p["m1"] * p["ra"] ** 2 + p["m2"] * crank + p["i1"] + p["i2"],
        p["m2"] * p["da"] ** 2 + p["i2"],
        p["m3"] * (p["sa"] ** 2 + p["sb"] ** 2) + p["i3"],
        p["m4"] * e**2 + p["i4"],
        p["m4"] * upper + p["m5"] * (p["ta"] ** 2 + p["tb"] ** 2) + p["i4"] + p["i5"],
        p["m6"] * f**2 + p["i6"],
        p["m6"] * lower + p["m7"] * (p["ua"] ** 2 + p["ub"] ** 2) + p["i6"] + p["i7"],
    ]
    m = jnp.diag(jnp.stack(diagonal))
    for i, j, value in ((0, 1, m12), (3, 4, m45), (5, 6, m67)):
        m = m.at[i, j].set(value).at[j, i].set(value)
    return m


def force(q: jax.Array, v: jax.Array, t: jax.Array, control: None, p: dict[str, Any]) -> jax.Array:
    """Returns the generalized force f(q, q̇), (7,) [N m].

    It is the sum of the drive torque, the spring force and the terms quadratic in q̇.
    """
    cos, sin = jnp.cos(q), jnp.sin(q)
    pull, g = spring(q, p), 2
    on_knee = p["m4"] * p["zt"] * (p["e"] - p["ea"]) * cos[3]
    on_foot = p["m6"] * p["u"] * (p["zf"] - p["fa"]) * cos[5]
    on_crank = p["m2"] * p["da"] * p["rr"] * sin[1]
    return jnp.stack(
        [
            p["mom"] - on_crank * v[1] * (v[1] + 2 * v[0]),
            on_crank * v[0] ** 2,
            pull[0] * (p["sc"] * cos[g] - p["sd"] * sin[g])
            + pull[1] * (p["sd"] * cos[g] + p["sc"] * sin[g]),
            on_knee * v[4] ** 2,
            -on_knee * v[3] * (v[3] + 2 * v[4]),
            -on_foot * v[6] ** 2,
            on_foot * v[5] * (v[5] + 2 * v[6]),
        ]
    )


def spring(q: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the spring force −c₀ (L − l₀) d/L on the triangle with angle γ, (2,) [N].

    Here d is the vector along the spring, L its length, l₀ the rest length and c₀ the stiffness.
    """
    cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
    d = jnp.stack(
        [
            p["sd"] * cos + p["sc"] * sin + p["xb"] - p["xc"],
            p["sd"] * sin - p["sc"] * cos + p["yb"] - p["yc"],
        ]
    )
    length = jnp.sqrt(jnp.sum(d * d))
    return -p["c0"] * (length - p["l0"]) / length * d


def loops(q: jax.Array, t: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the residuals of three loop closures, (6,) [m].

    The end of the crank chain, with the angles β and Θ, must coincide with the ends of
    three other chains. Their angles are γ, then Φ and δ, then Ω and ε.
    """
    beta, theta, gamma, phi, delta, omega, epsilon = q
    x = p["rr"] * jnp.cos(beta) - p["d"] * jnp.cos(beta + theta)
    y = p["rr"] * jnp.sin(beta) - p["d"] * jnp.sin(beta + theta)
    up, down = phi + delta, omega + epsilon
    return jnp.stack(
        [
            x - p["ss"] * jnp.sin(gamma) - p["xb"],
            y + p["ss"] * jnp.cos(gamma) - p["yb"],
            x - p["e"] * jnp.sin(up) - p["zt"] * jnp.cos(delta) - p["xa"],
            y + p["e"] * jnp.cos(up) - p["zt"] * jnp.sin(delta) - p["ya"],
            x - p["zf"] * jnp.cos(down) - p["u"] * jnp.sin(epsilon) - p["xa"],
            y - p["zf"] * jnp.sin(down) + p["u"] * jnp.cos(epsilon) - p["ya"],
        ]
    )


def andrews(method: jc.Method = RK4) -> tuple[GeneralizedCoordinates, jc.State]:
    """Builds Andrews' mechanism at rest. Its parameters are leaves of the system, in SI units.

    Args:
        method: the method that will simulate the system.

    Returns:
        The system and its initial state.

    References:
        Mazzia, Magherini, Test Set for Initial Value Problem Solvers (2008), problem Andrews.
    """
    data = references.load("ivp_andrews")
    params = {name: jnp.asarray(value) for name, value in data["parameters"].items()}
    closed = jc.joints.Holonomic(loops, name="loops")
    system = jc.GeneralizedSystem(mass=mass, force=force, constraints=(closed,), params=params)
    q, v = (jnp.array(data["initial"][key], float) for key in ("q", "v"))
    return system, jc.init(system, method, q, v)


def andrews_squeezer() -> list[Check]:
    """Checks the motion of Andrews' mechanism, M(q) a = f(q, q̇) + Jᵀλ, up to t = 0.03 s.

    The multipliers of the reference have the opposite sign. The bound on q is eleven digits, as the
    reference demands. At 0.03 s, some rates are thousands of times smaller than the rate of the
    crank, and inherit its error through the loops. a and λ depend only on q and q̇. The bounds on
    q̇, a and λ are therefore nine digits. At earlier times, their errors are relative to the largest
    component of the row. The published final state has 9.6 correct digits in q.
    """
    case, data = "andrews_squeezer", references.load("ivp_andrews")
    rows, published = data["corrected_reference"]["rows"], data["published_reference_t0p03"]
    system, state = andrews()
    states = sample(system, state, [r["t"] for r in rows], 1.25e-6)
    solutions = solve(system, states)
    a, multipliers = np.asarray(solutions.acceleration), -np.asarray(solutions.multipliers)
    start = jc.forward_dynamics(system, state, None, RK4, 1e-6)
    initial, end = data["initial"], published["values"]
    q, v, n = states.q, states.v, len(rows) - 1
    vdot12, lam12 = start.acceleration[:2], -start.multipliers[:2]
    return [
        Check(case, "q at 0.03 s, relative", relative(q[n], rows[n]["q"]), 1e-11),
        Check(case, "q̇ at 0.03 s, relative", relative(v[n], rows[n]["v"]), 1e-9),
        Check(case, "a at 0.03 s, relative", relative(a[n], rows[n]["vdot"]), 1e-9),
        Check(case, "λ at 0.03 s, relative", relative(multipliers[n], rows[n]["lam"]), 1e-9),
        Check(case, "q on the way, relative", relative(q, column(rows, "q")), 1e-11),
        Check(case, "q̇ on the way", scaled(v, column(rows, "v")), 1e-9),
        Check(case, "a on the way", scaled(a, column(rows, "vdot")), 1e-9),
        Check(case, "λ on the way", scaled(multipliers, column(rows, "lam")), 1e-9),
        Check(case, "q at 0.03 s, as published", relative(q[n], end[:7]), 1e-9),
        Check(case, "a at the start", relative(vdot12, initial["vdot12"]), 1e-9),
        Check(case, "λ at the start", relative(lam12, initial["lam12"]), 1e-9),
    ]
