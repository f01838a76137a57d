"""Linkages of rods: one description, built in jaxcon in the plane or in space, and in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxcon as jc
from benchmarks import mjcf

SLENDER = 0.02
"""Moment of a rod about its own axis over that about a transverse one, in space."""
POINT = 1e-12
"""Moment that stands for none in MuJoCo, which wants one [kg m²]."""


@dataclass(frozen=True)
class Rod:
    """A rod of the plane, hinged at its start to its parent.

    Attributes:
        name, parent: unique; the parent is an earlier rod or `WORLD`.
        start, end: at assembly, (2,) [m].
        mass: [kg].
        rate: of its hinge at the start, seen from its parent [rad/s].
        at_end: whether the mass is a point at the end, not spread uniformly.
    """

    name: str
    parent: str
    start: Any
    end: Any
    mass: float
    rate: float
    at_end: bool = False

    @property
    def length(self) -> float:
        """[m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    @property
    def center(self) -> np.ndarray:
        """Of mass, (2,) [m]."""
        return np.array(self.end) if self.at_end else np.add(self.start, self.end) / 2

    @property
    def moment(self) -> float:
        """Of inertia about the centre of mass, across the rod [kg m²]."""
        return POINT if self.at_end else self.mass * self.length**2 / 12


@dataclass(frozen=True)
class Solid(Rod):
    """A rod with a centre of mass and a moment of its own.

    Attributes:
        heavy_at: (2,) [m].
        turns_with: about the centre of mass, across the plane [kg m²].
    """

    heavy_at: Any = (0.0, 0.0)
    turns_with: float = 0.0

    @property
    def center(self) -> np.ndarray:
        """Of mass, (2,) [m]."""
        return np.array(self.heavy_at)

    @property
    def moment(self) -> float:
        """Of inertia about the centre of mass [kg m²]."""
        return self.turns_with


@dataclass(frozen=True)
class Linkage:
    """Rods, each after its parent, and the hinges that close loops: (rod, rod, point (2,))."""

    rods: tuple[Rod, ...]
    loops: tuple[tuple[str, str, Any], ...] = ()

    def motion(self) -> dict[str, tuple[np.ndarray, float]]:
        """Velocity of the centre of mass (2,) [m/s] and rate [rad/s] of each rod."""
        by_name = {rod.name: rod for rod in self.rods}
        found: dict[str, tuple[np.ndarray, float]] = {}
        for rod in self.rods:
            pivot, turning = np.zeros(2), rod.rate
            if rod.parent != jc.WORLD:
                speed, rate = found[rod.parent]
                pivot = speed + rate * across(rod.start - by_name[rod.parent].center)
                turning += rate
            found[rod.name] = pivot + turning * across(rod.center - rod.start), turning
        return found


def across(arm: np.ndarray) -> np.ndarray:
    """A vector of the plane turned by a right angle."""
    return np.array([-arm[1], arm[0]])


def collinear(n: int, length: float, mass: float = 1.0, at_end: bool = False) -> Linkage:
    """A horizontal chain from the origin, every other hinge turning against the one before."""
    parents = [jc.WORLD, *(f"link{i}" for i in range(n - 1))]
    return Linkage(
        tuple(
            Rod(
                f"link{i}",
                parents[i],
                (i * length, 0.0),
                ((i + 1) * length, 0.0),
                mass,
                0.3 * (-1) ** i,
                at_end,
            )
            for i in range(n)
        )
    )


def planar_scene(linkage: Linkage, dtype: Any) -> tuple[Any, jc.State]:
    """Rigid bodies in the plane and a hinge for each rod and loop."""
    return hinged(jc.Scene(dim=2, dtype=dtype), linkage).build()


def hinged(scene: jc.Scene, linkage: Linkage) -> jc.Scene:
    """A scene of the plane with the bodies and hinges in it: `{rod}_hinge`, `{rod}_{rod}`."""
    motion = linkage.motion()
    for rod in linkage.rods:
        speed, turning = motion[rod.name]
        scene.add_body(
            rod.name,
            mass=rod.mass,
            inertia=rod.moment,
            position=rod.center,
            velocity=speed,
            angular_velocity=turning,
        )
    for rod in linkage.rods:
        scene.add(jc.Revolute(f"{rod.name}_hinge", rod.parent, rod.name, point=rod.start))
    for first, second, point in linkage.loops:
        scene.add(jc.Revolute(f"{first}_{second}", first, second, point=point))
    return scene


def spatial_scene(linkage: Linkage, dtype: Any) -> tuple[Any, jc.State]:
    """Rigid bodies in space and hinges about −y; for rods along x, whose frames are principal."""
    scene, motion = jc.Scene(dim=3, dtype=dtype), linkage.motion()
    for rod in linkage.rods:
        speed, turning = motion[rod.name]
        scene.add_body(
            rod.name,
            mass=rod.mass,
            inertia=np.array([SLENDER, 1.0, 1.0]) * rod.moment,
            position=mjcf.in_space(rod.center),
            velocity=mjcf.in_space(speed),
            angular_velocity=(0.0, -turning, 0.0),
        )
    for rod in linkage.rods:
        point = mjcf.in_space(rod.start)
        hinge = f"{rod.name}_hinge"
        scene.add(jc.Revolute(hinge, rod.parent, rod.name, point=point, axis=mjcf.OUT_OF_PLANE))
    return scene.build()


def particles_scene(linkage: Linkage, dtype: Any) -> tuple[Any, jc.State]:
    """Particles in the plane at distances of each other."""
    scene, motion = jc.Scene(dim=2, dtype=dtype), linkage.motion()
    for rod in linkage.rods:
        speed, _ = motion[rod.name]
        scene.add_particle(rod.name, mass=rod.mass, position=rod.center, velocity=speed)
    for rod in linkage.rods:
        start = rod.start if rod.parent == jc.WORLD else None
        name = f"{rod.name}_distance"
        scene.add(jc.Distance(name, rod.parent, rod.name, length=rod.length, point_a=start))
    return scene.build()


def to_mjcf(linkage: Linkage, inside: Mapping[str, str] | None = None) -> str:
    """The rods as trees of hinges in MuJoCo, loops closed by `connect`.

    Args:
        linkage: the rods.
        inside: more text for the inside of a rod, or of `WORLD`, by name.
    """
    more = inside or {}
    by_name = {rod.name: rod for rod in linkage.rods}
    children: dict[str, str] = {}
    for rod in reversed(linkage.rods):
        origin = by_name[rod.parent].center if rod.parent in by_name else np.zeros(2)
        hinge = mjcf.joint(
            "hinge", axis=mjcf.OUT_OF_PLANE, pos=mjcf.in_space(rod.start - rod.center)
        )
        text = mjcf.body(
            rod.name,
            mjcf.in_space(rod.center - origin),
            rod.mass,
            np.array([1.0 if rod.at_end else SLENDER, 1.0, 1.0]) * rod.moment,
            hinge + more.get(rod.name, "") + children.get(rod.name, ""),
        )
        children[rod.parent] = text + children.get(rod.parent, "")
    equalities = [
        mjcf.connect(first, second, mjcf.in_space(np.subtract(point, by_name[first].center)))
        for first, second, point in linkage.loops
    ]
    return mjcf.model(more.get(jc.WORLD, "") + children[jc.WORLD], equalities)
