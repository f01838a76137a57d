"""A planar four-bar linkage, modeled in three ways, and a four-bar linkage from Drake."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.system.generalized import GeneralizedCoordinates
from jaxcon.verification import references
from jaxcon.verification.case import Check, error, turned
from jaxcon.verification.linkage import NAMES, G, Linkage, crank_rocker, hanging_trapezoid, planar
from jaxcon.verification.references import column
from jaxcon.verification.sampling import RK4, sample


def upright(rocker: jc.extend.Pose, t: jax.Array, params: None) -> jax.Array:
    """Returns z · b, which is zero while the rocker does not spin about its own axis, (1,).

    b is the direction across the rocker within the plane of the linkage, and z the normal of the
    plane.
    """
    across = jnp.array([0.0, 1.0, 0.0], rocker.position.dtype)
    return jc.quaternion.rotate(rocker.orientation, across)[2:]


def spatial(bar: Linkage) -> tuple[BodySystem, jc.State]:
    """Builds the linkage from three bodies in space.

    It has 18 velocities and 5 + 5 + 3 + 3 + 1 independent constraint rows. With four revolute
    joints, three rows would be redundant. Two revolute joints therefore hold crank and coupler in
    the plane. The rocker has ball joints at both ends, and a fifth constraint prevents its spin.
    """
    scene = jc.Scene(dim=3, gravity=(0.0, -G, 0.0))
    for i, name in enumerate(NAMES):
        half = bar.angles[i] / 2
        scene.add_body(
            name,
            mass=bar.masses[i],
            inertia=np.array([0.1, 1.0, 1.0]) * bar.inertias[i],
            position=(*(bar.starts[i] + bar.halves[i]), 0.0),
            quaternion=(np.cos(half), 0.0, 0.0, np.sin(half)),
            velocity=(*bar.velocities[i], 0.0),
            angular_velocity=(0.0, 0.0, bar.rates[i]),
        )
    knee, end = bar.starts[1], bar.starts[1] + 2 * bar.halves[1]
    z = (0.0, 0.0, 1.0)
    scene.add(jc.Revolute("pivot", jc.WORLD, "crank", point=(0.0, 0.0, 0.0), axis=z))
    scene.add(jc.Revolute("knee", "crank", "coupler", point=(*knee, 0.0), axis=z))
    scene.add(jc.Spherical("end", "coupler", "rocker", point=(*end, 0.0)))
    scene.add(jc.Spherical("anchor", jc.WORLD, "rocker", point=(bar.base, 0.0, 0.0)))
    scene.add(jc.joints.Holonomic(upright, bodies=("rocker",), name="no spin"))
    return scene.build()


def middles(q: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the centers of mass of the three links, (3, 2) [m], at their angles q [rad]."""
    along = p["lengths"][:, None] * jnp.stack([jnp.cos(q), jnp.sin(q)], -1)
    anchor = jnp.stack([p["base"], jnp.zeros_like(p["base"])])
    return jnp.stack([along[0] / 2, along[0] + along[1] / 2, anchor + along[2] / 2])


def mass(q: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the mass matrix M = Σ mᵢ JᵢᵀJᵢ + diag(I), (3, 3) [kg m²].

    mᵢ are the masses of the links, Jᵢ the Jacobians of their centers of mass, and I their inertias.
    """
    slopes = jax.jacfwd(middles)(q, p)
    weighted = p["masses"][:, None, None] * slopes
    return jnp.tensordot(weighted, slopes, axes=((0, 1), (0, 1))) + jnp.diag(p["inertias"])


def potential(q: jax.Array, t: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the potential energy Σ mᵢ g yᵢ, () [J], of links with masses mᵢ at heights yᵢ."""
    return G * jnp.dot(p["masses"], middles(q, p)[:, 1])


def force(q: jax.Array, v: jax.Array, t: jax.Array, control: None, p: dict[str, Any]) -> jax.Array:
    """Returns the terms of Lagrange's equations without q̈: ∂(T − V)/∂q − Ṁ q̇, (3,) [N m].

    T is the kinetic energy, V the potential energy and M the mass matrix.
    """
    _, slope = jax.jvp(lambda q: mass(q, p) @ v, (q,), (v,))
    kinetic = jax.grad(lambda q: v @ mass(q, p) @ v / 2)(q)
    return kinetic - jax.grad(potential)(q, t, p) - slope


def loop(q: jax.Array, t: jax.Array, p: dict[str, Any]) -> jax.Array:
    """Returns the loop residual: the end of the coupler minus the end of the rocker, (2,) [m]."""
    x, y = p["lengths"] * jnp.cos(q), p["lengths"] * jnp.sin(q)
    return jnp.stack([x[0] + x[1] - x[2] - p["base"], y[0] + y[1] - y[2]])


def angular(bar: Linkage) -> tuple[GeneralizedCoordinates, jc.State]:
    """Builds the linkage from three angles and a loop closure: 3 velocities, 2 constraint rows."""
    params = {
        "lengths": jnp.asarray(bar.lengths),
        "masses": jnp.asarray(bar.masses),
        "inertias": jnp.asarray(bar.inertias),
        "base": jnp.asarray(bar.base),
    }
    system = jc.GeneralizedSystem(
        mass=mass,
        force=force,
        constraints=(jc.joints.Holonomic(loop),),
        params=params,
        potential=potential,
    )
    return system, jc.init(system, RK4, jnp.asarray(bar.angles), jnp.asarray(bar.rates))


def four_bar() -> list[Check]:
    """Compares three models of one linkage: bodies in the plane, bodies in space, and angles."""
    case, bar = "four_bar", crank_rocker()
    times, dt = np.linspace(0.1, 1.0, 10).tolist(), 5e-4
    checks, paths = [], []
    for name, build in (("plane", planar), ("space", spatial), ("angles", angular)):
        system, state = build(bar)
        report = jc.report(system, state)
        missing = abs(report.degrees_of_freedom - 1) + len(report.redundant)
        checks.append(Check(case, f"{name}: one freedom, no row redundant", missing, 0.0))
        paths.append(sample(system, state, times, dt))
    plane, space, angles = (np.asarray(states.q) for states in paths)
    params: Any = system.params  # of the last system in the loop, the model in angles
    middle = jax.vmap(middles, (0, None))(jnp.asarray(angles), params).swapaxes(1, 2)
    flat = plane.reshape(-1, 3, 3)  # x, y, θ of three bodies
    solid = space.reshape(-1, 7, 3)
    turn = 2 * np.arctan2(solid[:, 6], solid[:, 3])
    return [
        *checks,
        Check(case, "centers of mass, angles − plane [m]", error(middle, flat[:, :2]), 1e-9),
        Check(case, "centers of mass, space − plane [m]", error(solid[:, :2], flat[:, :2]), 1e-9),
        Check(case, "angles, angles − plane [rad]", error(angles, flat[:, 2]), 1e-9),
        Check(case, "angles, space − plane [rad]", turned(turn, flat[:, 2]), 1e-9),
        Check(case, "out of the plane [m]", error(solid[:, 2], np.zeros((10, 3))), 1e-9),
    ]


def trapezoid() -> list[Check]:
    """Checks a hanging isosceles trapezoid of three equal links, in equilibrium and swinging.

    Angles of the reference are about +y, which is clockwise in the xz plane. They are therefore
    negated. The error of the reference is 3e-10, and its values have ten decimals.

    References:
        RobotLocomotion/drake, examples/multibody/four_bar: geometry and inertia.
    """
    case, rows = "trapezoid", references.load("drake_four_bar")["reference"]
    at_rest, swung = (hanging_trapezoid(rate) for rate in (0.0, -rows[0]["qA_rate"]))
    still = jc.forward_dynamics(*planar(at_rest), None, RK4, 1e-3).acceleration
    states = sample(*planar(swung), [r["t"] for r in rows], 5e-4)
    q, v = (np.asarray(x).reshape(-1, 3, 3) for x in (states.q, states.v))
    keys = ("qA", "coupler_abs", "qC")
    angles = -np.stack([column(rows, key) for key in keys], -1)
    center = column(rows, "coupler_com")[:, [0, 2]]
    return [
        Check(case, "acceleration in equilibrium", error(still, np.zeros(9)), 1e-12),
        Check(case, "angles to 5 s [rad]", turned(q[:, 2], angles), 3e-10),
        Check(
            case, "rate of the crank [rad/s]", error(-v[:, 2, 0], column(rows, "qA_rate")), 3e-10
        ),
        Check(case, "middle of the coupler [m]", error(q[:, :2, 1], center), 3e-10),
    ]
