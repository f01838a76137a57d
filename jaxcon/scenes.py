"""Ready-made mechanisms, built with the public interface alone.

Their numbers may be traced: `jax.vmap` over lengths and masses builds a batch of systems.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.joints import Revolute
from jaxcon.core.typing import Array
from jaxcon.dynamics.scene import Scene
from jaxcon.model.layout import WORLD
from jaxcon.model.state import State
from jaxcon.model.system import BodySystem

CRANK_ROCKER = (1.0, 0.3, 0.9, 0.7)
"""Ground, crank, coupler, rocker [m]; 0.3 + 1.0 < 0.9 + 0.7, so the crank turns over (Grashof)."""


def four_bar(
    lengths: Any = CRANK_ROCKER, masses: Any = (0.3, 0.9, 0.7), angle: Any = 0.5, rate: Any = 10.0
) -> tuple[BodySystem, State]:
    """A planar four-bar linkage under gravity: three uniform rods, four hinges, a closed loop.

    Args:
        lengths: of ground, crank, coupler and rocker, (4,) [m].
        masses: of crank, coupler and rocker, (3,) [kg].
        angle: of the crank at the start, () [rad].
        rate: of the crank at the start, () [rad/s]; the other rods move consistently.

    Returns:
        The system, and the state at the start.
    """
    lengths, masses = jnp.asarray(lengths), jnp.asarray(masses)
    angle = jnp.asarray(angle, lengths.dtype)
    rate = jnp.asarray(rate, lengths.dtype)
    poses, motion = jax.jvp(lambda x: four_bar_poses(lengths, x), (angle,), (rate,))
    scene = Scene(dim=2, dtype=lengths.dtype)
    for i, name in enumerate(("crank", "coupler", "rocker")):
        scene.add_body(
            name,
            mass=masses[i],
            inertia=masses[i] * lengths[i + 1] ** 2 / 12,
            position=poses[i, :2],
            angle=poses[i, 2],
            velocity=motion[i, :2],
            angular_velocity=motion[i, 2],
        )
    a, b, c, d = four_bar_points(lengths, angle)
    scene.add(Revolute("ground_crank", WORLD, "crank", point=a))
    scene.add(Revolute("crank_coupler", "crank", "coupler", point=b))
    scene.add(Revolute("coupler_rocker", "coupler", "rocker", point=c))
    scene.add(Revolute("rocker_ground", "rocker", WORLD, point=d))
    return scene.build()


def four_bar_points(lengths: Array, angle: Array) -> tuple[Array, Array, Array, Array]:
    """The four hinges (2,) [m]; the third where two circles meet, on the upper branch."""
    ground, crank, coupler, rocker = lengths
    a = jnp.zeros(2, lengths.dtype)
    b = crank * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    d = jnp.stack([ground, jnp.zeros_like(ground)])
    span = jnp.sqrt(jnp.sum((d - b) ** 2))
    along = (d - b) / span
    foot = (coupler**2 - rocker**2 + span**2) / (2 * span)
    height = jnp.sqrt(coupler**2 - foot**2)
    c = b + foot * along + height * jnp.stack([-along[1], along[0]])
    return a, b, c, d


def four_bar_poses(lengths: Array, angle: Array) -> Array:
    """Centre (2,) [m] and angle [rad] of crank, coupler and rocker, (3, 3)."""
    a, b, c, d = four_bar_points(lengths, angle)
    ends = ((a, b), (b, c), (d, c))
    return jnp.stack(
        [jnp.append((p + r) / 2, jnp.arctan2(r[1] - p[1], r[0] - p[0])) for p, r in ends]
    )
