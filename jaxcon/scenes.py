"""Ready-made mechanisms, built with the public interface of the library.

Their parameters may be traced, so `jax.vmap` over lengths and masses builds a batch of systems.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.builders.scene import Scene
from jaxcon.constraints.joints import Revolute
from jaxcon.constraints.rolling import RollingDisc
from jaxcon.core.typing import Array, Scalar
from jaxcon.system.body_system import BodySystem
from jaxcon.system.forces import ExternalWrench
from jaxcon.system.layout import WORLD
from jaxcon.system.state import State

CRANK_ROCKER = (1.0, 0.3, 0.9, 0.7)
"""The lengths of ground, crank, coupler and rocker of a crank-rocker four-bar [m].

The crank can make full turns (Grashof's condition): 0.3 + 1.0 < 0.9 + 0.7.
"""


def four_bar(
    lengths: Scalar | Sequence[float] = CRANK_ROCKER,
    masses: Scalar | Sequence[float] = (0.3, 0.9, 0.7),
    angle: Scalar = 0.5,
    rate: Scalar = 10.0,
    elements: Iterable[Any] = (),
) -> tuple[BodySystem, State]:
    """Builds a planar four-bar linkage under gravity: a closed loop of three uniform rods.

    The hinges are "ground_crank", "crank_coupler", "coupler_rocker" and "rocker_ground".

    Args:
        lengths: lengths of ground, crank, coupler and rocker, (4,) [m].
        masses: masses of crank, coupler and rocker, (3,) [kg].
        angle: initial angle of the crank, () [rad].
        rate: initial angular velocity of the crank, () [rad/s]; the other rods move consistently.
        elements: further scene elements, such as a motor at the hinge "ground_crank".

    Returns:
        The system and its initial state.
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
    """Returns the positions of the four hinges, (2,) [m] each, with the rocker upward.

    The hinge between coupler and rocker lies on two circles: around the end of the crank, and
    around the ground hinge of the rocker. Of their two intersections, the upper one is taken.

    Args:
        lengths: lengths of ground, crank, coupler and rocker, (4,) [m].
        angle: angle of the crank, () [rad].
    """
    ground, crank, coupler, rocker = lengths
    a = jnp.zeros(2, lengths.dtype)
    b = crank * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    d = jnp.stack([ground, jnp.zeros_like(ground)])
    span = jnp.sqrt(jnp.sum((d - b) ** 2))
    direction = (d - b) / span
    foot = (coupler**2 - rocker**2 + span**2) / (2 * span)
    height = jnp.sqrt(coupler**2 - foot**2)
    c = b + foot * direction + height * jnp.stack([-direction[1], direction[0]])
    return a, b, c, d


def four_bar_poses(lengths: Array, angle: Array) -> Array:
    """Returns the poses of crank, coupler and rocker, one row each, (3, 3).

    A row has the coordinates x and y of the rod's center [m] and the angle of the rod [rad].

    Args:
        lengths: lengths of ground, crank, coupler and rocker, (4,) [m].
        angle: angle of the crank, () [rad].
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
"""The parameters of the benchmark bicycle, whose frame includes the rider [m, kg, kg m², rad].

The axes point forward (x), right (y) and down (z).

References:
    Meijaard, Papadopoulos, Ruina, Schwab, Linearized dynamics equations for the balance and steer
    of a bicycle, Proc. R. Soc. A 463 (2007).
"""


def bicycle(
    speed: Array | float = 0.0, p: Mapping[str, Any] = BICYCLE, gravity: float = 9.81
) -> tuple[BodySystem, State]:
    """Builds an upright bicycle on knife-edge wheels: 4 bodies, 24 velocities, 21 constraint rows.

    The joints are "rear_axle", "front_axle", "steering", "rear_contact" and "front_contact". The
    control channel "push" is a wrench on the frame.

    Args:
        speed: forward speed, () [m/s].
        p: parameters as in `BICYCLE`. The steering axis leans back by `tilt` [rad], and meets the
            ground at the distance `trail` [m] ahead of the front contact.
        gravity: the gravitational acceleration along z, which points down, () [m/s²].

    Returns:
        The system and its initial state, in which the bicycle rolls straight along x.
    """
    scene, velocity = Scene(gravity=(0.0, 0.0, gravity)), (speed, 0.0, 0.0)
    steer = (math.sin(p["tilt"]), 0.0, math.cos(p["tilt"]))
    holders = {"rear": ("frame", 0.0), "front": ("fork", p["wheelbase"])}
    for name in ("frame", "fork"):
        part = p[name]
        solid = {"mass": part["mass"], "inertia": np.array(part["inertia"])}
        scene.add_body(name, position=part["center"], velocity=velocity, **solid)
    for end, (_, x) in holders.items():
        wheel = p[f"{end}_wheel"]
        scene.add_body(
            f"{end}_wheel",
            mass=wheel["mass"],
            inertia=wheel["inertia"],
            position=(x, 0.0, -wheel["radius"]),
            velocity=velocity,
            angular_velocity=(0.0, -speed / wheel["radius"], 0.0),
        )
    foot = (p["wheelbase"] + p["trail"], 0.0, 0.0)
    scene.add(Revolute("steering", "frame", "fork", point=foot, axis=steer))
    for end, (holder, x) in holders.items():
        radius, axle = p[f"{end}_wheel"]["radius"], (0.0, 1.0, 0.0)
        hub, wheel = (x, 0.0, -radius), f"{end}_wheel"
        scene.add(Revolute(f"{end}_axle", holder, wheel, point=hub, axis=axle))
        up = (0.0, 0.0, -1.0)
        scene.add(RollingDisc(f"{end}_contact", WORLD, wheel, radius=radius, axis=axle, normal=up))
    scene.add(ExternalWrench("push", "frame"))
    return scene.build()
