"""Chains that hang between two points: equilibrium shape and tension."""

from __future__ import annotations

import jax
import numpy as np

import jaxcon as jc
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.sampling import RK4

CASE = "hanging_chain"
FINE = 2000
"""The number of links of a chain that approximates a catenary. Its sag is off by O(1/links²)."""


def hanging_chain() -> list[Check]:
    """Checks chains of equal links with equal masses at their joints.

    Shape [m], acceleration [m/s²] and tension [N] in equilibrium are compared.

    References:
        Statics: the horizontal component of the tension is equal in all links.
    """
    data = references.load("an_hanging_chain")
    checks = []
    for case in data["cases"]:
        n, ends = case["N_links"], ((0.0, 0.0), (case["span"], 0.0))
        table = np.column_stack([case["x"], case["y"]])
        shape = jc.chains.hanging(*ends, n * case["link"], n)
        scene = jc.Scene(dim=2, gravity=(0.0, -case["g"]))
        jc.chains.rope(scene, "chain", table, n * case["mass_per_joint"], end=jc.WORLD)
        system, state = scene.build()
        info = jax.jit(lambda s, system=system: jc.forward_dynamics(system, s, None, RK4, 1e-3))(
            state
        )
        rest, tension = np.zeros_like(info.acceleration), case["tension"]
        checks += [
            Check(CASE, f"{n} links: shape", error(shape, table), 1e-12),
            Check(CASE, f"{n} links: acceleration", error(info.acceleration, rest), 1e-8),
            Check(CASE, f"{n} links: T = −λ", error(-info.multipliers, tension), 1e-8),
        ]
    limit = data["continuous_limit"]
    fine = jc.chains.hanging((0.0, 0.0), (limit["span"], 0.0), limit["length"], FINE)
    checks.append(Check(CASE, "sag of a catenary", error(-fine[:, 1].min(), limit["sag"]), 1e-6))
    return checks
