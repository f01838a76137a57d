"""The mechanisms of the benchmarks: each has models in jaxcon and MuJoCo with one initial state.

`find("chain-10")` returns a `Mechanism`. A number at the end of a name is a size, so that
`chain-1000` and `rope-7` exist too. Bodies have the same names in both models, and their frames are
at the centers of mass. A point (x, y) of a planar scene is (x, 0, y) in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from benchmarks import stewart
from benchmarks.rods import (
    Linkage,
    Rod,
    collinear,
    particles_scene,
    planar_scene,
    spatial_scene,
    to_mjcf,
)
from jaxcon.scenes import CRANK_ROCKER
from jaxcon.verification import linkage

GRAVITY = 9.81


@dataclass(frozen=True)
class Mechanism:
    """A scene of the benchmarks.

    Attributes:
        name: name of the scene.
        bodies: names of the markers, bodies whose centers of mass are compared.
        link: characteristic length [m].
        loops: True if MuJoCo needs soft equality constraints, False if it models a tree of joints.
        build: (dtype) → system and initial state in jaxcon.
        mjcf: () → MJCF of the same model.
        rates: MuJoCo's initial joint velocities, in its order.
        exact: (seconds) → marker positions by a closed form or a reduced equation, None if there is
            no such solution.
    """

    name: str
    bodies: tuple[str, ...]
    link: float
    loops: bool
    build: Callable[[Any], tuple[Any, jc.State]]
    mjcf: Callable[[], str]
    rates: tuple[float, ...]
    exact: Callable[[float], np.ndarray] | None = None

    def markers(self, system: jc.extend.System, state: jc.State) -> jax.Array:
        """Returns the positions of the centers of mass, (bodies, dim) [m]."""
        return jnp.stack([jc.position(system, state, name) for name in self.bodies])


def lift(points: Any) -> np.ndarray:
    """Maps planar points to MuJoCo's space, (x, y) → (x, 0, y). Spatial points are unchanged."""
    points = np.asarray(points, np.float64)
    if points.shape[-1] == 3:
        return points
    x, y = points[..., 0], points[..., 1]
    return np.stack([x, 0 * x, y], -1)


def of_rods(
    name: str, rods: Linkage, scene: Callable[[Linkage, Any], Any], exact: Any = None
) -> Mechanism:
    """Returns a mechanism of rods, in the plane or in space."""
    return Mechanism(
        name=name,
        bodies=tuple(rod.name for rod in rods.rods),
        link=min(rod.length for rod in rods.rods),
        loops=bool(rods.loops),
        build=lambda dtype: scene(rods, dtype),
        mjcf=lambda: to_mjcf(rods),
        rates=tuple(rod.rate for rod in rods.rods),
        exact=exact,
    )


def chain(n: int) -> Mechanism:
    """Returns n rods of 1 m and 1 kg on parallel hinges in space, released from the horizontal."""
    return of_rods(f"chain-{n}", collinear(n, length=1.0), spatial_scene)


def pendulum() -> Mechanism:
    """Returns a chain of one rod in space."""
    return of_rods("pendulum", collinear(1, length=1.0), spatial_scene)


def planar_chain(n: int) -> Mechanism:
    """Returns n rods of 1 m and 1 kg on hinges in the plane, released from the horizontal."""
    return of_rods(f"planar-chain-{n}", collinear(n, length=1.0), planar_scene)


def rope(n: int) -> Mechanism:
    """Returns n particles of 0.1 kg, 0.1 m apart in the plane, released from the horizontal.

    MuJoCo has no particles. Its model is a chain of hinges with point masses at the ends of the
    links. This is the same mechanism in minimal coordinates.
    """
    rods = collinear(n, length=0.1, mass=0.1, at_end=True)
    return of_rods(f"rope-{n}", rods, particles_scene)


def four_bar() -> Mechanism:
    """Returns the crank-rocker of `jaxcon.scenes.four_bar`, with its crank at 10 rad/s."""
    base, *lengths = CRANK_ROCKER
    masses = (0.3, 0.9, 0.7)
    angles = linkage.close(lengths, base, 0.5)
    turning = linkage.turn_with(lengths, angles, 10.0)
    bar = linkage.Linkage(lengths, masses, (), base, angles, turning)
    starts, ends = bar.starts, bar.starts + 2 * bar.halves
    parents = (jc.WORLD, "crank", jc.WORLD)
    relative = (turning[0], turning[1] - turning[0], turning[2])
    rods = tuple(
        Rod(name, parents[i], starts[i], ends[i], masses[i], float(relative[i]))
        for i, name in enumerate(linkage.NAMES)
    )
    return of_rods("four-bar", Linkage(rods, (("coupler", "rocker", ends[1]),)), planar_scene)


def n_four_bar(n: int) -> Mechanism:
    """Returns cranks of 1 m side by side, joined at their tops by couplers.

    The mechanism is singular when it is horizontal.

    References:
        IFToMM benchmark A02, N-four-bar mechanism: initially vertical, the tops at 1 m/s.
    """
    rods, loops = [], []
    for i in range(n + 1):
        rods.append(Rod(f"crank{i}", jc.WORLD, (i, 0.0), (i, 1.0), 1.0, -1.0))
        if i < n:
            rods.append(Rod(f"coupler{i}", f"crank{i}", (i, 1.0), (i + 1, 1.0), 1.0, 1.0))
            loops.append((f"coupler{i}", f"crank{i + 1}", (i + 1.0, 1.0)))
    names = [rod.name for rod in rods]

    def exact(seconds: float) -> np.ndarray:
        return np.array([parallelogram(name, crank_angle(n, seconds)) for name in names])

    return of_rods(f"n-four-bar-{n}", Linkage(tuple(rods), tuple(loops)), planar_scene, exact)


def parallelogram(name: str, angle: float) -> np.ndarray:
    """Returns the center of a crank or coupler of the N-four-bar at a crank angle, (2,) [m]."""
    arm = np.array([np.cos(angle), np.sin(angle)])
    if name.startswith("crank"):
        return np.array([float(name[5:]), 0.0]) + arm / 2
    return np.array([float(name[7:]) + 0.5, 0.0]) + arm


def crank_angle(n: int, seconds: float, steps: int = 4000) -> float:
    """Returns the angle θ of the cranks after `seconds`, integrated by RK4 [rad].

    θ̈ = −g [(n+1)/2 + n] / [(n+1)/3 + n] cos θ, from θ = π/2 and θ̇ = −1.
    """
    pull = GRAVITY * ((n + 1) / 2 + n) / ((n + 1) / 3 + n)

    def rate(y: np.ndarray) -> np.ndarray:
        return np.array([y[1], -pull * np.cos(y[0])])

    y, h = np.array([np.pi / 2, -1.0]), seconds / steps
    for _ in range(steps):
        k1 = rate(y)
        k2 = rate(y + h / 2 * k1)
        k3 = rate(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
    return float(y[0])


def stewart_platform() -> Mechanism:
    """Returns a platform in space on six legs with universal joints and spring-loaded sliders."""
    return Mechanism(
        name="stewart",
        bodies=stewart.BODIES,
        link=stewart.HEIGHT,
        loops=True,
        build=stewart.scene,
        mjcf=stewart.to_mjcf,
        rates=stewart.rates(),
    )


SINGLE: dict[str, Callable[[], Mechanism]] = {
    "pendulum": pendulum,
    "four-bar": four_bar,
    "stewart": stewart_platform,
}
FAMILIES: dict[str, Callable[[int], Mechanism]] = {
    "chain": chain,
    "planar-chain": planar_chain,
    "n-four-bar": n_four_bar,
    "rope": rope,
}


def find(name: str) -> Mechanism:
    """Returns the mechanism of a name such as `four-bar` or `chain-10`.

    Raises:
        ValueError: the name is unknown.
    """
    if name in SINGLE:
        return SINGLE[name]()
    family, _, size = name.rpartition("-")
    if family in FAMILIES and size.isdigit():
        return FAMILIES[family](int(size))
    names = [*SINGLE, *(f"{family}-<n>" for family in FAMILIES)]
    raise ValueError(f"mechanism '{name}' is unknown; known are {names}.")
