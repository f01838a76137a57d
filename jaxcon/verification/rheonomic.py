"""Constraints that depend explicitly on time: C(q, t) = 0."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import multipliers, sample


def turning_plane(bead: jc.extend.Pose, t: jax.Array, rate: jax.Array) -> jax.Array:
    """Returns −x sin Ωt + y cos Ωt, the distance of a bead from a vertical plane, (1,) [m].

    The plane rotates about z at the rate Ω.
    """
    x, y, _ = bead.position
    return (y * jnp.cos(rate * t) - x * jnp.sin(rate * t))[None]


def bead_on_hoop() -> list[Check]:
    """Checks a bead on a hoop that rotates about its vertical diameter.

    Its angle θ obeys θ̈ = Ω² sin θ cos θ − (g/R) sin θ, with the radius R and rate Ω of the hoop.
    Both reactions are multipliers. The λ of the distance is the radial force, positive outward. The
    λ of the plane is the force along the normal of the plane, m(2 Ω R θ̇ cos θ).

    References:
        Extrapolation in 80-bit arithmetic; the Jacobi integral is conserved, the energy is not.
    """
    case, data = "bead_on_hoop", references.load("an_bead_rotating_hoop")
    p, rows = data["parameters"], data["rows"]
    radius, rate, g = p["R"], p["Omega"], p["g"]
    sine, cosine = np.sin(p["theta0"]), np.cos(p["theta0"])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -g))
    start, velocity = (radius * sine, 0.0, -radius * cosine), (0.0, radius * sine * rate, 0.0)
    scene.add_particle("bead", mass=p["m"], position=start, velocity=velocity)
    scene.add(jc.Distance("hoop", jc.WORLD, "bead", length=radius))
    scene.add(jc.joints.Holonomic(turning_plane, ("bead",), "plane", jnp.array(rate)))
    system, state = scene.build()
    states = sample(system, state, [r["t"] for r in rows], 2.5e-4)
    q, v, t = (np.asarray(x) for x in (states.q, states.v, states.time))
    normal = multipliers(system, states, "plane")[:, 0]
    radial = multipliers(system, states, "hoop")[:, 0]
    side = np.stack([np.cos(rate * t), np.sin(rate * t)], -1)
    theta = np.arctan2(np.sum(side * q[:, :2], -1), -q[:, 2])
    swing = np.cos(theta) * np.sum(side * v[:, :2], -1) + np.sin(theta) * v[:, 2]
    results = {
        "position to 5 s [m]": (q, "xyz"),
        "θ [rad]": (theta, "theta"),
        "θ̇ [rad/s]": (swing / radius, "thetadot"),
        "reaction normal to the hoop [N]": (normal, "force_normal_to_hoop_plane"),
        "reaction along the radius [N]": (radial, "radial_force_outward"),
    }
    return [Check(case, k, error(x, column(rows, key)), 1e-9) for k, (x, key) in results.items()]
