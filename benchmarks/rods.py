"""Linkages of rods: one description gives scenes in jaxcon, in plane or space, and in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mjcf

SLENDER = 0.02
"""Ratio of a rod's axial to its transverse moment of inertia, in space."""
POINT = 1e-12
"""Moment of inertia of a point mass in MuJoCo, which requires a positive value [kg m²]."""


@dataclass(frozen=True)
class Rod:
    """A planar rod, hinged at its start to its parent.

    Attributes:
        name: unique name.
        parent: name of an earlier rod, or `WORLD`.
        start: start point at assembly, (2,) [m].
        end: end point at assembly, (2,) [m].
        mass: mass [kg].
        rate: initial angular velocity relative to the parent [rad/s].
        at_end: True for a point mass at the end, False for a uniform rod.
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
        """The length of the rod [m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    @property
    def center(self) -> np.ndarray:
        """The center of mass at assembly, (2,) [m]."""
        return np.array(self.end) if self.at_end else np.add(self.start, self.end) / 2

    @property
    def moment(self) -> float:
        """The moment of inertia about the center of mass, normal to the plane [kg m²]."""
        return POINT if self.at_end else self.mass * self.length**2 / 12


@dataclass(frozen=True)
class Solid(Rod):
    """A rod with a given center of mass and moment of inertia.

    Attributes:
        heavy_at: center of mass at assembly, (2,) [m].
        turns_with: moment of inertia about the center of mass, normal to the plane [kg m²].
    """

    heavy_at: Any = (0.0, 0.0)
    turns_with: float = 0.0

    @property
    def center(self) -> np.ndarray:
        """The center of mass at assembly, (2,) [m]."""
        return np.array(self.heavy_at)

    @property
    def moment(self) -> float:
        """The moment of inertia about the center of mass, normal to the plane [kg m²]."""
        return self.turns_with


@dataclass(frozen=True)
class Linkage:
    """Rods that form trees, and hinges that close loops between them.

    Attributes:
        rods: the rods, each after its parent.
        loops: the closing hinges: (name of a rod, name of a rod, point at assembly (2,) [m]).
    """

    rods: tuple[Rod, ...]
    loops: tuple[tuple[str, str, Any], ...] = ()

    def motion(self) -> dict[str, tuple[np.ndarray, float]]:
        """Returns initial velocities of each rod by name.

        They are the velocity of the center of mass (2,) [m/s] and the angular velocity [rad/s].
        """
        by_name = {rod.name: rod for rod in self.rods}
        motions: dict[str, tuple[np.ndarray, float]] = {}
        for rod in self.rods:
            pivot, spin = np.zeros(2), rod.rate
            if rod.parent != jc.WORLD:
                velocity, rate = motions[rod.parent]
                pivot = velocity + rate * across(rod.start - by_name[rod.parent].center)
                spin += rate
            motions[rod.name] = pivot + spin * across(rod.center - rod.start), spin
        return motions


def across(arm: np.ndarray) -> np.ndarray:
    """Returns a planar vector rotated by 90° counterclockwise."""
    return np.array([-arm[1], arm[0]])


def collinear(n: int, length: float, mass: float = 1.0, at_end: bool = False) -> Linkage:
    """Returns a horizontal chain of n rods from the origin.

    The initial rates of the hinges alternate in sign.
    """
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


def planar_scene(linkage: Linkage, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds rigid bodies in the plane, with a hinge for each rod and loop."""
    return hinged(jc.Scene(dim=2, dtype=dtype), linkage).build()


def hinged(scene: jc.Scene, linkage: Linkage) -> jc.Scene:
    """Adds bodies, and hinges named `{rod}_hinge` and `{rod}_{rod}`, to a planar scene."""
    motion = linkage.motion()
    for rod in linkage.rods:
        velocity, rate = motion[rod.name]
        scene.add_body(
            rod.name,
            mass=rod.mass,
            inertia=rod.moment,
            position=rod.center,
            velocity=velocity,
            angular_velocity=rate,
        )
    for rod in linkage.rods:
        scene.add(jc.Revolute(f"{rod.name}_hinge", rod.parent, rod.name, point=rod.start))
    for first, second, point in linkage.loops:
        scene.add(jc.Revolute(f"{first}_{second}", first, second, point=point))
    return scene


def spatial_scene(linkage: Linkage, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds rigid bodies in space with hinges about −y.

    Rods must be along x, so that the frames of the bodies are principal.
    """
    scene, motion = jc.Scene(dim=3, dtype=dtype), linkage.motion()
    for rod in linkage.rods:
        velocity, rate = motion[rod.name]
        scene.add_body(
            rod.name,
            mass=rod.mass,
            inertia=np.array([SLENDER, 1.0, 1.0]) * rod.moment,
            position=mjcf.in_space(rod.center),
            velocity=mjcf.in_space(velocity),
            angular_velocity=(0.0, -rate, 0.0),
        )
    for rod in linkage.rods:
        point = mjcf.in_space(rod.start)
        hinge = f"{rod.name}_hinge"
        scene.add(jc.Revolute(hinge, rod.parent, rod.name, point=point, axis=mjcf.OUT_OF_PLANE))
    return scene.build()


def particles_scene(linkage: Linkage, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds particles in the plane joined by distance constraints."""
    scene, motion = jc.Scene(dim=2, dtype=dtype), linkage.motion()
    for rod in linkage.rods:
        velocity, _ = motion[rod.name]
        scene.add_particle(rod.name, mass=rod.mass, position=rod.center, velocity=velocity)
    for rod in linkage.rods:
        start = rod.start if rod.parent == jc.WORLD else None
        name = f"{rod.name}_distance"
        scene.add(jc.Distance(name, rod.parent, rod.name, length=rod.length, point_a=start))
    return scene.build()


def to_mjcf(linkage: Linkage, inside: Mapping[str, str] | None = None) -> str:
    """Returns the MJCF of the rods as trees of hinges, with loops closed by `connect`.

    Args:
        linkage: the rods.
        inside: additional MJCF inside a rod or `WORLD`, by name.
    """
    extra = inside or {}
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
            hinge + extra.get(rod.name, "") + children.get(rod.name, ""),
        )
        children[rod.parent] = text + children.get(rod.parent, "")
    equalities = [
        mjcf.connect(first, second, mjcf.in_space(np.subtract(point, by_name[first].center)))
        for first, second, point in linkage.loops
    ]
    return mjcf.model(extra.get(jc.WORLD, "") + children[jc.WORLD], equalities)
