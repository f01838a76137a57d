"""A Stewart platform: thirteen bodies, six loops, six degrees of freedom.

Each leg is a lower part on a universal joint to the ground and an upper part that slides in it,
held by a spring-damper and joined to the platform by a ball. The platform starts displaced, tilted
and moving, and the springs have different rest lengths, so that no symmetry is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxcon as jc
from benchmarks import mjcf

HEIGHT = 1.0
PLATFORM = {"mass": 5.0, "inertia": (0.3, 0.3, 0.5)}
LOWER = {"mass": 1.0, "inertia": (0.03, 0.03, 0.002)}
UPPER = {"mass": 0.5, "inertia": (0.015, 0.015, 0.001)}
STIFFNESS, DAMPING = 2000.0, 20.0
CENTER = np.array([0.05, -0.03, HEIGHT])
TILT = np.array([1.0, 0.06, 0.07, 0.04])
"""Quaternion of the platform, wxyz, not yet of unit length."""
VELOCITY, SPIN = np.array([0.2, 0.1, 0.3]), np.array([0.4, -0.2, 0.5])
"""Of the platform at the start: world frame [m/s], body frame [rad/s]."""
LEGS = range(6)
BODIES = ("platform", *(f"{part}{i}" for i in LEGS for part in ("lower", "upper")))


@dataclass(frozen=True)
class Leg:
    """A leg at assembly; its frame has the axes of the universal joint as x and y, itself as z.

    Attributes:
        base, tip: its ends, (3,) [m].
        tip_velocity: (3,) [m/s].
        rest: of its spring, from the length at assembly [m].
    """

    base: np.ndarray
    tip: np.ndarray
    tip_velocity: np.ndarray
    rest: float

    @property
    def length(self) -> float:
        """[m]."""
        return float(np.linalg.norm(self.tip - self.base))

    @property
    def frame(self) -> np.ndarray:
        """Rotation matrix: columns are the two axes of the universal joint and the leg."""
        along = (self.tip - self.base) / self.length
        first = np.cross(along, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(along, first), along], -1)

    @property
    def rates(self) -> np.ndarray:
        """Of the two turns [rad/s] and of the slider [m/s]."""
        x, y, z = self.tip_velocity @ self.frame
        return np.array([-y / self.length, x / self.length, z])

    @property
    def spin(self) -> np.ndarray:
        """Angular velocity of both parts in their frame, (3,) [rad/s]."""
        return np.array([*self.rates[:2], 0.0])

    def place(self, share: float) -> np.ndarray:
        """The point at a share of the leg's length, (3,) [m]."""
        return self.base + share * (self.tip - self.base)

    def velocity(self, share: float) -> np.ndarray:
        """Of that point as part of the turning leg, without sliding, (3,) [m/s]."""
        return share * np.cross(self.frame @ self.spin, self.tip - self.base)


def legs() -> tuple[Leg, ...]:
    """Feet in pairs on a circle of 0.8 m, heads in pairs on one of 0.4 m, turned by 60°."""
    found, turn = [], matrix(TILT)
    for i in LEGS:
        pair, side = (i // 2) * 2 * np.pi / 3, 1 - 2 * (i % 2)
        foot, head = pair + 0.25 * side, pair + (np.pi / 3 - 0.25) * side
        base = 0.8 * np.array([np.cos(foot), np.sin(foot), 0.0])
        local = 0.4 * np.array([np.cos(head), np.sin(head), -0.1])
        speed = VELOCITY + turn @ np.cross(SPIN, local)
        found.append(Leg(base, CENTER + turn @ local, speed, 0.02 + 0.005 * i))
    return tuple(found)


def rates() -> tuple[float, ...]:
    """MuJoCo's velocities: of the platform, then two turns and a slide of each leg."""
    joints = np.concatenate([leg.rates for leg in legs()])
    return tuple(float(x) for x in (*VELOCITY, *SPIN, *joints))


def scene(dtype: Any) -> tuple[Any, jc.State]:
    """The platform in jaxcon: every joint closes on two bodies, and none is special."""
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
    """Two bodies, three joints and a spring."""
    lower, upper = f"lower{i}", f"upper{i}"
    first, second, along = leg.frame.T
    turn = {"quaternion": quaternion(leg.frame), "angular_velocity": leg.spin}
    sliding = leg.velocity(0.75) + leg.rates[2] * along
    scene.add_body(lower, **LOWER, position=leg.place(0.25), velocity=leg.velocity(0.25), **turn)
    scene.add_body(upper, **UPPER, position=leg.place(0.75), velocity=sliding, **turn)
    scene.add(jc.Universal(f"foot{i}", jc.WORLD, lower, leg.base, axis_a=first, axis_b=second))
    scene.add(jc.Prismatic(f"slider{i}", lower, upper, axis=along, point=leg.place(0.75)))
    scene.add(jc.Spherical(f"head{i}", upper, "platform", point=leg.tip))
    scene.add(jc.JointSpring(f"spring{i}", f"slider{i}", STIFFNESS, DAMPING, rest=leg.rest))


def to_mjcf() -> str:
    """In MuJoCo: a free platform, six trees of two hinges and a slider, six `connect`."""
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
    """Two bodies in each other; joints are given in the frame of the leg."""
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
    """The platform's quaternion, wxyz, (4,)."""
    return TILT / np.linalg.norm(TILT)


def matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix of a quaternion of any length."""
    w, (x, y, z) = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


def quaternion(r: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix: the eigenvector of Bar-Itzhack's form, (4,)."""
    symmetric = r + r.T - np.trace(r) * np.eye(3)
    k = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    form = np.block([[np.trace(r) * np.eye(1), k[None]], [k[:, None], symmetric]])
    return np.linalg.eigh(form)[1][:, -1]
