"""A Stewart platform: thirteen bodies, six loops, six degrees of freedom.

Each leg has a lower part on a universal joint to the ground and an upper part that slides in it. A
spring-damper acts along the slider, and a ball joint connects the upper part to the platform. The
platform starts displaced, tilted and moving, and the springs have different rest lengths, so that
no symmetry is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mjcf

HEIGHT = 1.0
PLATFORM = {"mass": 5.0, "inertia": (0.3, 0.3, 0.5)}
LOWER = {"mass": 1.0, "inertia": (0.03, 0.03, 0.002)}
UPPER = {"mass": 0.5, "inertia": (0.015, 0.015, 0.001)}
STIFFNESS, DAMPING = 2000.0, 20.0
CENTER = np.array([0.05, -0.03, HEIGHT])
TILT = np.array([1.0, 0.06, 0.07, 0.04])
"""Quaternion of the platform, wxyz, not normalized."""
VELOCITY, SPIN = np.array([0.2, 0.1, 0.3]), np.array([0.4, -0.2, 0.5])
"""Initial velocities of the platform: world frame [m/s], body frame [rad/s]."""
LEGS = range(6)
BODIES = ("platform", *(f"{part}{i}" for i in LEGS for part in ("lower", "upper")))


@dataclass(frozen=True)
class Leg:
    """A leg at assembly.

    The x and y axes of its frame are the axes of the universal joint. The z axis is along the leg.

    Attributes:
        base: lower end, (3,) [m].
        tip: upper end, (3,) [m].
        tip_velocity: velocity of the upper end, (3,) [m/s].
        rest: rest length of the spring, relative to the length at assembly [m].
    """

    base: np.ndarray
    tip: np.ndarray
    tip_velocity: np.ndarray
    rest: float

    @property
    def length(self) -> float:
        """The length of the leg [m]."""
        return float(np.linalg.norm(self.tip - self.base))

    @property
    def frame(self) -> np.ndarray:
        """The rotation matrix of the leg's frame, (3, 3).

        Its columns are the two axes of the universal joint and the axis of the leg.
        """
        axis = (self.tip - self.base) / self.length
        first = np.cross(axis, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(axis, first), axis], -1)

    @property
    def rates(self) -> np.ndarray:
        """The rates of the two rotations [rad/s] and of the slider [m/s], (3,)."""
        x, y, z = self.tip_velocity @ self.frame
        return np.array([-y / self.length, x / self.length, z])

    @property
    def spin(self) -> np.ndarray:
        """The angular velocity of both parts in their frame, (3,) [rad/s]."""
        return np.array([*self.rates[:2], 0.0])

    def place(self, share: float) -> np.ndarray:
        """Returns the point at a share of the leg's length, (3,) [m]."""
        return self.base + share * (self.tip - self.base)

    def velocity(self, share: float) -> np.ndarray:
        """Returns the velocity of the point at a share of the length, (3,) [m/s].

        It is the velocity by rotation alone, without that of the slider.
        """
        return share * np.cross(self.frame @ self.spin, self.tip - self.base)


def legs() -> tuple[Leg, ...]:
    """Returns the six legs at assembly.

    Feet are in pairs on a circle of 0.8 m. Heads are in pairs on a circle of 0.4 m, rotated by 60°.
    """
    built, rotation = [], matrix(TILT)
    for i in LEGS:
        pair, side = (i // 2) * 2 * np.pi / 3, 1 - 2 * (i % 2)
        foot, head = pair + 0.25 * side, pair + (np.pi / 3 - 0.25) * side
        base = 0.8 * np.array([np.cos(foot), np.sin(foot), 0.0])
        local = 0.4 * np.array([np.cos(head), np.sin(head), -0.1])
        speed = VELOCITY + rotation @ np.cross(SPIN, local)
        built.append(Leg(base, CENTER + rotation @ local, speed, 0.02 + 0.005 * i))
    return tuple(built)


def rates() -> tuple[float, ...]:
    """Returns MuJoCo's initial velocities.

    They are those of the platform, then two rotations and a slide per leg.
    """
    joints = np.concatenate([leg.rates for leg in legs()])
    return tuple(float(x) for x in (*VELOCITY, *SPIN, *joints))


def scene(dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds the platform in jaxcon. Every joint is a constraint between two bodies."""
    scene = jc.Scene(dim=3, dtype=dtype)
    scene.add_body(
        "platform",
        **PLATFORM,
        position=CENTER,
        quaternion=unit_tilt(),
        velocity=VELOCITY,
        angular_velocity=SPIN,
    )
    for i, leg in enumerate(legs()):
        add_leg(scene, i, leg)
    return scene.build()


def add_leg(scene: jc.Scene, i: int, leg: Leg) -> None:
    """Adds a leg to the scene: two bodies, three joints and a spring."""
    lower, upper = f"lower{i}", f"upper{i}"
    first, second, axis = leg.frame.T
    orientation = {"quaternion": quaternion(leg.frame), "angular_velocity": leg.spin}
    sliding = leg.velocity(0.75) + leg.rates[2] * axis
    scene.add_body(
        lower, **LOWER, position=leg.place(0.25), velocity=leg.velocity(0.25), **orientation
    )
    scene.add_body(upper, **UPPER, position=leg.place(0.75), velocity=sliding, **orientation)
    scene.add(
        jc.joints.Universal(f"foot{i}", jc.WORLD, lower, leg.base, axis_a=first, axis_b=second)
    )
    scene.add(jc.Prismatic(f"slider{i}", lower, upper, axis=axis, point=leg.place(0.75)))
    scene.add(jc.Spherical(f"head{i}", upper, "platform", point=leg.tip))
    scene.add(jc.forces.JointSpring(f"spring{i}", f"slider{i}", STIFFNESS, DAMPING, rest=leg.rest))


def to_mjcf() -> str:
    """Returns the MJCF of the platform.

    It has a free body, six trees of two hinges and a slider, and six `connect` equalities.
    """
    bodies = [
        mjcf.body(
            "platform",
            CENTER,
            PLATFORM["mass"],
            PLATFORM["inertia"],
            "<freejoint/>",
            unit_tilt(),
        )
    ]
    equalities = []
    for i, leg in enumerate(legs()):
        bodies.append(leg_mjcf(i, leg))
        anchor = (0.0, 0.0, 0.25 * leg.length)
        equalities.append(mjcf.connect(f"upper{i}", "platform", anchor))
    return mjcf.model("".join(bodies), equalities)


def leg_mjcf(i: int, leg: Leg) -> str:
    """Returns the MJCF of a leg: two nested bodies with joints in the frame of the leg."""
    spring = {"stiffness": STIFFNESS, "damping": DAMPING, "springref": leg.rest}
    slider = mjcf.joint("slide", axis=(0, 0, 1), **spring)
    up = (0.0, 0.0, 0.5 * leg.length)
    upper = mjcf.body(f"upper{i}", up, UPPER["mass"], UPPER["inertia"], slider)
    foot = (0.0, 0.0, -0.25 * leg.length)
    cross = [mjcf.joint("hinge", axis=axis, pos=foot) for axis in ((1, 0, 0), (0, 1, 0))]
    inside = "".join(cross) + upper
    turn = quaternion(leg.frame)
    return mjcf.body(f"lower{i}", leg.place(0.25), LOWER["mass"], LOWER["inertia"], inside, turn)


def unit_tilt() -> np.ndarray:
    """Returns the unit quaternion of the platform, wxyz, (4,)."""
    return TILT / np.linalg.norm(TILT)


def matrix(q: np.ndarray) -> np.ndarray:
    """Returns the rotation matrix of a quaternion, which need not be normalized."""
    w, (x, y, z) = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


def quaternion(r: np.ndarray) -> np.ndarray:
    """Returns the unit quaternion of a rotation matrix r, (4,).

    It is the eigenvector of Bar-Itzhack's matrix for the largest eigenvalue.
    """
    symmetric = r + r.T - np.trace(r) * np.eye(3)
    k = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    form = np.block([[np.trace(r) * np.eye(1), k[None]], [k[:, None], symmetric]])
    return np.linalg.eigh(form)[1][:, -1]
