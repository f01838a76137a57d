"""Ready-made mechanisms, built with the public interface alone.

Their numbers may be traced: `jax.vmap` over lengths and masses builds a batch of systems.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.joints import Revolute
from jaxcon.constraints.rolling import RollingDisc
from jaxcon.core.typing import Array
from jaxcon.dynamics.scene import Scene
from jaxcon.model.forces import ExternalWrench
from jaxcon.model.layout import WORLD
from jaxcon.model.state import State
from jaxcon.model.system import BodySystem

CRANK_ROCKER = (1.0, 0.3, 0.9, 0.7)
"""Ground, crank, coupler, rocker [m]; 0.3 + 1.0 < 0.9 + 0.7, so the crank turns over (Grashof)."""


def four_bar(
    lengths: Any = CRANK_ROCKER,
    masses: Any = (0.3, 0.9, 0.7),
    angle: Any = 0.5,
    rate: Any = 10.0,
    elements: Iterable[Any] = (),
) -> tuple[BodySystem, State]:
    """A planar four-bar linkage under gravity: three uniform rods, four hinges, a closed loop.

    Args:
        lengths: of ground, crank, coupler and rocker, (4,) [m].
        masses: of crank, coupler and rocker, (3,) [kg].
        angle: of the crank at the start, () [rad].
        rate: of the crank at the start, () [rad/s]; the other rods move consistently.
        elements: added to the scene last, such as a motor at the hinge "ground_crank".

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
    for element in elements:
        scene.add(element)
    return scene.build()


def four_bar_points(lengths: Array, angle: Array) -> tuple[Array, Array, Array, Array]:
    """The four hinges (2,) [m]; the third where two circles meet, on the upper branch.

    Args:
        lengths: of ground, crank, coupler and rocker, (4,) [m].
        angle: of the crank, () [rad].
    """
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
    """Centre (2,) [m] and angle [rad] of crank, coupler and rocker, (3, 3).

    Args:
        lengths: of ground, crank, coupler and rocker, (4,) [m].
        angle: of the crank, () [rad].
    """
    a, b, c, d = four_bar_points(lengths, angle)
    ends = ((a, b), (b, c), (d, c))
    return jnp.stack(
        [jnp.append((p + r) / 2, jnp.arctan2(r[1] - p[1], r[0] - p[0])) for p, r in ends]
    )


BICYCLE = {
    "wheelbase": 1.02,
    "trail": 0.08,
    "tilt": math.pi / 10,
    "rear_wheel": {"radius": 0.3, "mass": 2.0, "inertia": (0.0603, 0.12, 0.0603)},
    "front_wheel": {"radius": 0.35, "mass": 3.0, "inertia": (0.1405, 0.28, 0.1405)},
    "frame": {
        "mass": 85.0,
        "center": (0.3, 0.0, -0.9),
        "inertia": ((9.2, 0.0, 2.4), (0.0, 11.0, 0.0), (2.4, 0.0, 2.8)),
    },
    "fork": {
        "mass": 4.0,
        "center": (0.9, 0.0, -0.7),
        "inertia": ((0.05892, 0.0, -0.00756), (0.0, 0.06, 0.0), (-0.00756, 0.0, 0.00708)),
    },
}
"""The benchmark bicycle, its rider part of the frame [m, kg, kg m²]; x forward, y right, z down.

References:
    Meijaard, Papadopoulos, Ruina, Schwab, Linearized dynamics equations for the balance and steer
    of a bicycle, Proc. R. Soc. A 463 (2007).
"""


def bicycle(speed: Any = 0.0, p: Any = BICYCLE, gravity: float = 9.81) -> Any:
    """An upright bicycle of four bodies on knife-edge wheels: 24 velocities, 21 rows, 3 freedoms.

    The joints are "rear_axle", "front_axle", "steering", "rear_contact" and "front_contact"; the
    control channel "push" is a wrench on the frame.

    Args:
        speed: forward, () [m/s].
        p: as `BICYCLE`: the point where the steering axis meets the ground lies `trail` ahead of
            the front contact, and the axis leans back by `tilt`.
        gravity: () [m/s²], along z, which points down.

    Returns:
        The system, and the state at the start, rolling straight along x.
    """
    scene, along = Scene(gravity=(0.0, 0.0, gravity)), (speed, 0.0, 0.0)
    steer = (math.sin(p["tilt"]), 0.0, math.cos(p["tilt"]))
    places = {"rear": ("frame", 0.0), "front": ("fork", p["wheelbase"])}
    for name in ("frame", "fork"):
        part = p[name]
        solid = {"mass": part["mass"], "inertia": np.array(part["inertia"])}
        scene.add_body(name, position=part["center"], velocity=along, **solid)
    for end, (_, x) in places.items():
        wheel = p[f"{end}_wheel"]
        scene.add_body(
            f"{end}_wheel",
            mass=wheel["mass"],
            inertia=wheel["inertia"],
            position=(x, 0.0, -wheel["radius"]),
            velocity=along,
            angular_velocity=(0.0, -speed / wheel["radius"], 0.0),
        )
    foot = (p["wheelbase"] + p["trail"], 0.0, 0.0)
    scene.add(Revolute("steering", "frame", "fork", point=foot, axis=steer))
    for end, (holder, x) in places.items():
        radius, axle = p[f"{end}_wheel"]["radius"], (0.0, 1.0, 0.0)
        hub, wheel = (x, 0.0, -radius), f"{end}_wheel"
        scene.add(Revolute(f"{end}_axle", holder, wheel, point=hub, axis=axle))
        up = (0.0, 0.0, -1.0)
        scene.add(RollingDisc(f"{end}_contact", WORLD, wheel, radius=radius, axis=axle, normal=up))
    scene.add(ExternalWrench("push", "frame"))
    return scene.build()
