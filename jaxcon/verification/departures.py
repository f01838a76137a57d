"""Bodies that leave what they slide on: the moment at which a force of contact vanishes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.verification.case import Check, relative
from jaxcon.verification.closed_forms import BOUND, G, constants
from jaxcon.verification.sampling import RK4, run, solve


def wall_and_floor(rod: jc.Pose, t: Any, half: Any) -> jax.Array:
    """x of the upper end and y of the lower end of a rod vanish; λ are the forces there."""
    end = rod.direction(half)
    return jnp.stack([rod.position[0] - end[0], rod.position[1] + end[1]])


def ladder() -> list[Check]:
    """A ladder slides down a smooth wall until the wall's force vanishes: sin θ = ⅔ sin θ₀."""
    data, half, tilt = constants("ladder"), 1.0, np.pi / 3
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    # the rod's axis points from the middle to the lower end, away from the wall
    start = {"position": (half * np.cos(tilt), half * np.sin(tilt)), "angle": -tilt}
    scene.add_body("rod", mass=1.0, inertia=half**2 / 3, **start)
    constraint = jc.Holonomic(wall_and_floor, ("rod",), "ends", jnp.array([half, 0.0]))
    scene.add(constraint)
    state = leave(*scene.build(), (0.1, 1.0))
    sine = data["leaves_wall_sin_theta"]
    return [
        Check("ladder", "sin θ where it leaves", relative(-np.sin(state.q[2]), sine), BOUND),
        Check("ladder", "ω there", relative(state.v[2], data["angular_speed_then"]), BOUND),
    ]


def sphere_departure() -> list[Check]:
    """A point mass sliding from the top of a smooth sphere leaves it where cos θ = ⅔.

    Since the top is an equilibrium, the motion starts a little below, with the speed gained there.
    """
    data, angle, radius = constants("sphere_departure"), 0.3, 0.8
    speed = np.sqrt(2 * G * radius * (1 - np.cos(angle)))
    along = np.array([np.cos(angle), -np.sin(angle)])
    start = radius * np.array([np.sin(angle), np.cos(angle)])
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("mass", mass=0.7, position=start, velocity=speed * along)
    scene.add(jc.Distance("sphere", jc.WORLD, "mass", length=radius))
    state = leave(*scene.build(), (0.05, 0.4))
    cosine = state.q[1] / radius
    expected = data["departure_cos_theta"]
    return [Check("sphere_departure", "cos θ", relative(cosine, expected), BOUND)]


def leave(system: Any, state: jc.State, bracket: tuple[float, float]) -> jc.State:
    """The state at the time in the bracket [s] at which the first multiplier changes sign."""
    steps = 2000

    def after(t: float) -> jc.State:
        return jax.tree.map(lambda x: x[1:], run(system, RK4, state, t / steps, steps, 1))

    def push(t: float) -> float:
        return float(solve(system, after(t)).multipliers[0, 0])

    return jax.tree.map(lambda x: x[0], after(crossing(push, *bracket)))


def crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """The zero of a function that is positive at `low` and negative at `high`.

    Raises:
        ValueError: the signs are others.
    """
    if not function(low) > 0 > function(high):
        raise ValueError("crossing: the function must fall from positive to negative.")
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) > 0 else (low, middle)
    return (low + high) / 2
