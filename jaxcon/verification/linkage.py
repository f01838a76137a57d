"""Planar four-bar linkages: geometry, and a model of bodies and revolute joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import jaxcon as jc
from jaxcon.system.body_system import BodySystem

G = 9.81
NAMES = ("crank", "coupler", "rocker")


@dataclass(frozen=True)
class Linkage:
    """A planar four-bar linkage: its geometry, masses and motion.

    Crank, coupler and rocker form a chain from a fixed pivot at the origin to one at (base, 0).

    Attributes:
        lengths: the lengths of crank, coupler and rocker [m].
        masses: the masses of the links [kg].
        inertias: the inertias about the centers of mass, at the middle of each link [kg m²].
        base: the distance between the fixed pivots [m].
        angles: the angles of the links from the x axis [rad]. Crank and coupler point away from the
            pivot of the crank. The rocker points away from its own pivot.
        rates: the angular velocities of the links [rad/s].
    """

    lengths: Sequence[float]
    masses: Sequence[float]
    inertias: Sequence[float]
    base: float
    angles: np.ndarray
    rates: np.ndarray

    @property
    def starts(self) -> np.ndarray:
        """The first end of each link, (3, 2) [m]."""
        crank = self.lengths[0] * np.array([np.cos(self.angles[0]), np.sin(self.angles[0])])
        return np.array([[0.0, 0.0], crank, [self.base, 0.0]])

    @property
    def halves(self) -> np.ndarray:
        """The vector from the first end to the middle of each link, (3, 2) [m]."""
        along = np.stack([np.cos(self.angles), np.sin(self.angles)], -1)
        return along * np.array(self.lengths)[:, None] / 2

    @property
    def velocities(self) -> np.ndarray:
        """The velocities of the centers of mass, (3, 2) [m/s]."""
        swing = np.stack([-self.halves[:, 1], self.halves[:, 0]], -1) * self.rates[:, None]
        return swing + np.array([[0, 0], 2 * swing[0], [0, 0]])


def close(lengths: Sequence[float], base: float, crank: float) -> np.ndarray:
    """Returns the angles of the three links for an angle of the crank, (3,) [rad].

    The end of the coupler is an intersection of two circles: about the end of the crank and about
    the pivot of the rocker. It is the intersection to the left of the line from the first center to
    the second.
    """
    a, b, c = lengths
    start = a * np.array([np.cos(crank), np.sin(crank)])
    gap = np.array([base, 0.0]) - start
    span = np.hypot(*gap)
    inner = np.arccos((b**2 + span**2 - c**2) / (2 * b * span))
    coupler = np.arctan2(gap[1], gap[0]) + inner
    end = start + b * np.array([np.cos(coupler), np.sin(coupler)])
    return np.array([crank, coupler, np.arctan2(end[1], end[0] - base)])


def turn_with(lengths: Sequence[float], angles: np.ndarray, rate: float) -> np.ndarray:
    """Returns the rates of the three links for a rate of the crank, (3,) [rad/s].

    Solves l₁ω₁e₁⊥ + l₂ω₂e₂⊥ = l₃ω₃e₃⊥ for crank, coupler and rocker. Each has length l, rate ω and
    normal e⊥.
    """
    across = np.array(lengths)[:, None] * np.stack([-np.sin(angles), np.cos(angles)], -1)
    others = np.linalg.solve(np.stack([across[1], -across[2]], -1), -rate * across[0])
    return np.array([rate, *others])


def crank_rocker() -> Linkage:
    """Returns a linkage of rods whose crank makes full turns, because 0.3 + 1.0 < 0.9 + 0.7."""
    lengths, masses = (0.3, 0.9, 0.7), (0.5, 1.5, 1.2)
    inertias = [m * x**2 / 12 for m, x in zip(masses, lengths, strict=True)]
    angles = close(lengths, 1.0, 1.1)
    return Linkage(lengths, masses, inertias, 1.0, angles, turn_with(lengths, angles, 6.0))


def hanging_trapezoid(rate: float) -> Linkage:
    """Returns three links of 4 m that hang from pivots 2 m apart.

    The crank is on the right. Its rate is in [rad/s].
    """
    tilt = np.arctan2(np.sqrt(15.0), 1.0)
    angles = np.array([-tilt, np.pi, tilt - np.pi])
    # the reference prints the inertia as 29.466667, but its trajectories have 29.4666… = 442/15
    lengths, masses, inertias = (4.0,) * 3, (20.0,) * 3, (442 / 15,) * 3
    return Linkage(lengths, masses, inertias, -2.0, angles, turn_with(lengths, angles, rate))


def planar(bar: Linkage) -> tuple[BodySystem, jc.State]:
    """Builds the linkage from three bodies in the plane and four revolute joints.

    It has 9 velocities and 8 constraint rows.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    for i, name in enumerate(NAMES):
        scene.add_body(
            name,
            mass=bar.masses[i],
            inertia=bar.inertias[i],
            position=bar.starts[i] + bar.halves[i],
            angle=bar.angles[i],
            velocity=bar.velocities[i],
            angular_velocity=bar.rates[i],
        )
    knee, end = bar.starts[1], bar.starts[1] + 2 * bar.halves[1]
    scene.add(jc.Revolute("pivot", jc.WORLD, "crank", point=bar.starts[0]))
    scene.add(jc.Revolute("knee", "crank", "coupler", point=knee))
    scene.add(jc.Revolute("end", "coupler", "rocker", point=end))
    scene.add(jc.Revolute("anchor", jc.WORLD, "rocker", point=bar.starts[2]))
    return scene.build()
