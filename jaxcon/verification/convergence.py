"""How fast the error falls with the step: orders of convergence of constrained scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.analysis.reference import butcher
from jaxcon.verification.case import Check

CONSTANT = jc.Baumgarte.critical(rate=5.0)
DURATION = 1.0


METHODS: dict[str, tuple[Callable[[], Any], int, tuple[int, ...]]] = {
    "SemiImplicitEuler": (jc.SemiImplicitEuler, 1, (1000, 2000, 4000, 8000)),
    "Heun": (jc.Heun, 2, (400, 800, 1600, 3200)),
    "RK4": (jc.RK4, 4, (200, 400, 800, 1600)),
}
"""Integrator, its order, and numbers of steps in one second."""


def two_rods() -> tuple[Any, jc.State]:
    """A double pendulum of rods in the plane, from the horizontal: 6 velocities, 4 rows."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    for i in range(2):
        scene.add_body(f"rod{i}", mass=1.0, inertia=1 / 12, position=(0.5 + i, 0.0))
    scene.add(jc.Revolute("pin", jc.WORLD, "rod0", point=(0.0, 0.0)))
    scene.add(jc.Revolute("knee", "rod0", "rod1", point=(1.0, 0.0)))
    return scene.build()


def tumbling_block() -> tuple[Any, jc.State]:
    """A block with three different moments on a ball joint at a corner, spinning."""
    omega, corner = np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.3, 0.4])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.81))
    scene.add_body(
        "block",
        mass=2.0,
        inertia=(0.3, 0.2, 0.15),
        position=corner,
        velocity=np.cross(omega, corner),
        angular_velocity=omega,
    )
    scene.add(jc.Spherical("corner", jc.WORLD, "block", point=(0.0, 0.0, 0.0)))
    return scene.build()


@jax.jit
def end(system: Any, method: jc.Method, state: jc.State, steps: Any) -> jax.Array:
    """(q, v) after one second in so many steps; their number is traced, so that all share it."""

    def one(_: Any, state: jc.State) -> jc.State:
        return jc.step(system, method, state, None, DURATION / steps)[0]

    final = jax.lax.fori_loop(0, steps, one, state)
    return jnp.concatenate([final.q, final.v])


def errors(
    system: Any, state: jc.State, method: jc.Method, counts: tuple[int, ...], exact: Any
) -> np.ndarray:
    """max |(q, v) − exact| for each number of steps."""
    ends = [end(system, method, state, steps) for steps in counts]
    return np.array([np.max(np.abs(x - exact)) for x in ends])


def slope(counts: tuple[int, ...], found: np.ndarray) -> float:
    """The order: minus the slope of log error over log steps, by least squares."""
    return float(-np.polyfit(np.log(counts), np.log(found), 1)[0])


def orders(case: str, build: Callable[[], tuple[Any, jc.State]]) -> list[Check]:
    """Orders with constant feedback gains, and as a figure those with default gains.

    The reference solution is by a method of order six in 2000 steps: half as many change it by less
    than 1e-13, far below the smallest error in a fit.
    """
    system, state = build()
    reference = jc.Method(integrator=butcher(), stabilizer=CONSTANT)
    exact = end(system, reference, state, 2000)
    checks = []
    for name, (integrator, order, counts) in METHODS.items():
        constant, default = (
            errors(system, state, method, counts, exact)
            for method in (
                jc.Method(integrator=integrator(), stabilizer=CONSTANT),
                jc.Method(integrator=integrator()),
            )
        )
        off = abs(slope(counts, constant) - order)
        checks.append(Check(case, f"{name}: distance from order {order}", off, 0.2))
        if name == "RK4":
            checks.append(Check(case, "RK4: smallest error of the fit", constant[-1], 1e-9))
        figure = f"{name}: order with default gains (reported)"
        checks.append(Check(case, figure, slope(counts, default), np.inf))
    return checks


def order_in_plane() -> list[Check]:
    """Orders 1, 2 and 4 on a double pendulum of rods."""
    return orders("order_in_plane", two_rods)


def order_in_space() -> list[Check]:
    """Orders 1, 2 and 4 on a block that tumbles about a corner."""
    return orders("order_in_space", tumbling_block)
