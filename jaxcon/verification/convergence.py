"""Orders of convergence of integrators on constrained scenes."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.analysis.reference import butcher
from jaxcon.protocols import Integrator
from jaxcon.system.body_system import BodySystem
from jaxcon.verification.case import Check

CONSTANT = jc.Baumgarte.critical(rate=5.0)
DURATION = 1.0


METHODS: dict[str, tuple[Callable[[], Integrator], int, tuple[int, ...]]] = {
    "SemiImplicitEuler": (jc.SemiImplicitEuler, 1, (1000, 2000, 4000, 8000)),
    "Heun": (jc.integrators.Heun, 2, (400, 800, 1600, 3200)),
    "RK4": (jc.RK4, 4, (200, 400, 800, 1600)),
}
"""For each integrator: its class, its order, and the numbers of steps per second of its runs."""


def two_rods() -> tuple[BodySystem, jc.State]:
    """Builds a planar double pendulum of rods, released from the horizontal.

    It has 6 velocities and 4 constraint rows.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81))
    for i in range(2):
        scene.add_body(f"rod{i}", mass=1.0, inertia=1 / 12, position=(0.5 + i, 0.0))
    scene.add(jc.Revolute("pin", jc.WORLD, "rod0", point=(0.0, 0.0)))
    scene.add(jc.Revolute("knee", "rod0", "rod1", point=(1.0, 0.0)))
    return scene.build()


def tumbling_block() -> tuple[BodySystem, jc.State]:
    """Builds a spinning block that hangs on a ball joint at one corner.

    Its three moments of inertia are distinct.
    """
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
def end(
    system: BodySystem, method: jc.Method, state: jc.State, steps: int | jax.Array
) -> jax.Array:
    """Returns (q, v) after one second.

    The number of steps is traced, so all step sizes share one compiled program.
    """

    def advance(_: int, state: jc.State) -> jc.State:
        return jc.step(system, method, state, None, DURATION / steps)[0]

    final = jax.lax.fori_loop(0, steps, advance, state)
    return jnp.concatenate([final.q, final.v])


def errors(
    system: BodySystem,
    state: jc.State,
    method: jc.Method,
    counts: tuple[int, ...],
    exact: jax.Array,
) -> np.ndarray:
    """Returns max |(q, v) − exact| after one second for each number of steps in `counts`."""
    ends = [end(system, method, state, steps) for steps in counts]
    return np.array([np.max(np.abs(x - exact)) for x in ends])


def slope(counts: tuple[int, ...], errors: np.ndarray) -> float:
    """Returns the order of convergence from errors at several numbers of steps.

    It is minus the slope of a least-squares line through log error over log steps.
    """
    return float(-np.polyfit(np.log(counts), np.log(errors), 1)[0])


def orders(case: str, build: Callable[[], tuple[BodySystem, jc.State]]) -> list[Check]:
    """Checks the orders of convergence with constant feedback gains.

    Orders with default gains are only reported. The reference solution is computed by a method of
    order six with 2000 steps. With 1000 steps it changes by less than 1e-13, far below the smallest
    error in a fit.
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
        distance = abs(slope(counts, constant) - order)
        checks.append(Check(case, f"{name}: distance from order {order}", distance, 0.2))
        if name == "RK4":
            checks.append(Check(case, "RK4: smallest error of the fit", constant[-1], 1e-9))
        figure = f"{name}: order with default gains (reported)"
        checks.append(Check(case, figure, slope(counts, default), np.inf))
    return checks


def order_in_plane() -> list[Check]:
    """Checks orders 1, 2 and 4 on a planar double pendulum of rods."""
    return orders("order_in_plane", two_rods)


def order_in_space() -> list[Check]:
    """Checks orders 1, 2 and 4 on a block that tumbles about a corner."""
    return orders("order_in_space", tumbling_block)
