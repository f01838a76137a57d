"""Bodies that leave a surface: the time at which the contact force vanishes."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem
from jaxcon.verification.case import Check, relative
from jaxcon.verification.closed_forms import BOUND, G, constants
from jaxcon.verification.sampling import RK4, run, solve


def wall_and_floor(rod: jc.extend.Pose, t: jax.Array, half: jax.Array) -> jax.Array:
    """Returns x of the upper end and y of the lower end of a rod, in the world frame, (2,) [m].

    Both are zero while the rod touches wall and floor. The multipliers λ are the contact forces.
    """
    end = rod.direction(half)
    return jnp.stack([rod.position[0] - end[0], rod.position[1] + end[1]])


def ladder() -> list[Check]:
    """Checks that a ladder sliding down a smooth wall leaves the wall at sin θ = ⅔ sin θ₀.

    θ is the angle of the ladder from the floor, and θ₀ its initial value.
    """
    data, half, tilt = constants("ladder"), 1.0, np.pi / 3
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    # the axis of the rod points from its middle to its lower end, away from the wall
    start = {"position": (half * np.cos(tilt), half * np.sin(tilt)), "angle": -tilt}
    scene.add_body("rod", mass=1.0, inertia=half**2 / 3, **start)
    constraint = jc.joints.Holonomic(wall_and_floor, ("rod",), "ends", jnp.array([half, 0.0]))
    scene.add(constraint)
    state = leave(*scene.build(), (0.1, 1.0))
    sine = data["leaves_wall_sin_theta"]
    return [
        Check("ladder", "sin θ where it leaves", relative(-np.sin(state.q[2]), sine), BOUND),
        Check("ladder", "ω there", relative(state.v[2], data["angular_speed_then"]), BOUND),
    ]


def sphere_departure() -> list[Check]:
    """Checks that a point mass sliding down a smooth sphere leaves the sphere at cos θ = ⅔.

    θ is the angle from the top, which is an equilibrium. The motion therefore starts at 0.3 rad,
    with the velocity gained on the way there.
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


def leave(system: BodySystem, state: jc.State, bracket: tuple[float, float]) -> jc.State:
    """Returns the state at which the first multiplier changes sign.

    Args:
        system: the mechanism.
        state: the initial state.
        bracket: a time before and a time after the change of sign [s].
    """
    steps = 2000

    def after(t: float) -> jc.State:
        return jax.tree.map(lambda x: x[1:], run(system, RK4, state, t / steps, steps, 1))

    def push(t: float) -> float:
        return float(solve(system, after(t)).multipliers[0, 0])

    return jax.tree.map(lambda x: x[0], after(crossing(push, *bracket)))


def crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """Returns the zero of a decreasing function between `low` and `high`, by bisection.

    Raises:
        ValueError: the function is not positive at `low`, or not negative at `high`.
    """
    if not function(low) > 0 > function(high):
        raise ValueError("crossing: the function must fall from positive to negative.")
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) > 0 else (low, middle)
    return (low + high) / 2
