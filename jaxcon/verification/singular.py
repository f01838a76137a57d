"""Linkages that pass through singular configurations, where their constraint rows are dependent."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification import references
from jaxcon.verification.case import Check, error
from jaxcon.verification.references import column
from jaxcon.verification.sampling import sample

G = 9.81
METHOD = jc.Method(jc.RK4(), jc.Baumgarte.critical(20.0), jc.solvers.RankSafe())


def bars(loops: int) -> tuple[BodySystem, jc.State]:
    """Builds a row of N = `loops` parallelograms: N + 1 rods on the ground and N couplers.

    The linkage has one degree of freedom. Twice per turn, all rods are in one line. The rows of
    each loop are then dependent, and the linkage could switch to another branch of its motion.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    solid: dict[str, Any] = {"mass": 1.0, "inertia": 1 / 12}
    for i in range(loops + 1):
        place, speed = (float(i), 0.5), (0.5, 0.0)
        scene.add_body(
            f"rod{i}",
            **solid,
            position=place,
            angle=np.pi / 2,
            velocity=speed,
            angular_velocity=-1.0,
        )
        scene.add(jc.Revolute(f"pivot{i}", jc.WORLD, f"rod{i}", point=(float(i), 0.0)))
    for i in range(loops):
        scene.add_body(f"bar{i}", **solid, position=(i + 0.5, 1.0), velocity=(1.0, 0.0))
        scene.add(jc.Revolute(f"left{i}", f"rod{i}", f"bar{i}", point=(float(i), 1.0)))
        scene.add(jc.Revolute(f"right{i}", f"bar{i}", f"rod{i + 1}", point=(i + 1.0, 1.0)))
    return scene.build()


def first_joint(system: BodySystem, state: jc.State) -> tuple[jax.Array, jax.Array]:
    """Returns position [m] and velocity [m/s] of the top of the first rod."""
    top = (0.5, 0.0)
    return jc.position(system, state, "rod0", top), jc.velocity(system, state, "rod0", top)


def n_four_bar(loops: int, step: float, bound: float) -> list[Check]:
    """Checks that the linkage stays on the branch of parallelograms.

    The motion of the top of its first rod is compared with the reference.

    References:
        IFToMM library of computational benchmark problems, A02; by elliptic functions.
    """
    case, rows = f"n_four_bar_{loops}", references.load("iftomm_A02_nfourbar")
    rows = rows[f"reference_B0_N{loops}"]
    system, state = bars(loops)
    states = sample(system, state, [float(row["t"]) for row in rows], step, METHOD)
    x, v = jax.jit(jax.vmap(lambda s: first_joint(system, s)))(states)
    place, speed = (np.stack([column(rows, k) for k in keys], -1) for keys in ("xy", ("vx", "vy")))
    return [
        Check(case, "position of B0 [m]", error(x, place), bound),
        Check(case, "velocity of B0 [m/s]", error(v, speed), 10 * bound),
    ]


def n_four_bar_2() -> list[Check]:
    """Checks two loops for ten seconds; the rods are in one line fourteen times."""
    return n_four_bar(2, 5e-4, 1e-5)


def n_four_bar_40() -> list[Check]:
    """Checks forty loops for twenty seconds."""
    return n_four_bar(40, 1e-3, 1e-3)
