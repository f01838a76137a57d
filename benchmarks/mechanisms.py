"""The mechanisms of the benchmarks: each in jaxcon and in MuJoCo, with one start for both.

`find("chain-10")` gives a `Mechanism`; a number at the end of a name is a size, so that
`chain-1000` and `rope-7` exist too. Bodies have the same names in both, their frames lie at the
centres of mass, and a point (x, y) of a planar scene is (x, 0, y) in MuJoCo.
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
    """One scene of the benchmarks.

    Attributes:
        name: of the scene.
        bodies: names; their centres of mass are the markers by which runs are compared.
        link: characteristic length [m].
        loops: whether MuJoCo needs soft equality constraints for it; otherwise it is a tree of
            joints there, and nothing is soft.
        build: dtype → system and start in jaxcon.
        mjcf: → text of the same model for MuJoCo.
        rates: MuJoCo's joint velocities at the start, in its order.
        exact: seconds → where the markers then are, from a closed form or a reduced equation;
            None where there is none.
    """

    name: str
    bodies: tuple[str, ...]
    link: float
    loops: bool
    build: Callable[[Any], tuple[Any, jc.State]]
    mjcf: Callable[[], str]
    rates: tuple[float, ...]
    exact: Callable[[float], np.ndarray] | None = None

    def markers(self, system: Any, state: jc.State) -> jax.Array:
        """Where the centres of mass are, (bodies, dim) [m]."""
        return jnp.stack([jc.position(system, state, name) for name in self.bodies])


def lift(points: Any) -> np.ndarray:
    """Points of a plane in the space of MuJoCo: (x, y) → (x, 0, y); others as they are."""
    points = np.asarray(points, np.float64)
    if points.shape[-1] == 3:
        return points
    x, y = points[..., 0], points[..., 1]
    return np.stack([x, 0 * x, y], -1)


def of_rods(
    name: str, rods: Linkage, scene: Callable[[Linkage, Any], Any], exact: Any = None
) -> Mechanism:
    """A mechanism of rods, in the plane or in space."""
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
    """Rods of 1 m and 1 kg on parallel hinges, let go from the horizontal; a scene in space."""
    return of_rods(f"chain-{n}", collinear(n, length=1.0), spatial_scene)


def pendulum() -> Mechanism:
    """The chain of one."""
    return of_rods("pendulum", collinear(1, length=1.0), spatial_scene)


def planar_chain(n: int) -> Mechanism:
    """The same chain as a scene in the plane."""
    return of_rods(f"planar-chain-{n}", collinear(n, length=1.0), planar_scene)


def rope(n: int) -> Mechanism:
    """Particles of 0.1 kg at distances of 0.1 m, let go from the horizontal, in the plane.

    In MuJoCo, which has no particles, a chain of hinges with the masses at the ends of the links:
    the same mechanism in the smallest coordinates there are.
    """
    rods = collinear(n, length=0.1, mass=0.1, at_end=True)
    return of_rods(f"rope-{n}", rods, particles_scene)


def four_bar() -> Mechanism:
    """The crank-rocker of `jaxcon.scenes.four_bar`, its crank turning at 10 rad/s."""
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
    """Cranks of 1 m side by side, joined at their tops by couplers; horizontal, it is singular.

    References:
        IFToMM benchmark A02, N-four-bar mechanism: vertical at the start, the tops at 1 m/s.
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
    """The centre of a crank or coupler of the N-four-bar whose cranks are at an angle, (2,)."""
    arm = np.array([np.cos(angle), np.sin(angle)])
    if name.startswith("crank"):
        return np.array([float(name[5:]), 0.0]) + arm / 2
    return np.array([float(name[7:]) + 0.5, 0.0]) + arm


def crank_angle(n: int, seconds: float, steps: int = 4000) -> float:
    """θ̈ = −g [(n+1)/2 + n] / [(n+1)/3 + n] cos θ from θ = π/2, θ̇ = −1, by RK4 [rad]."""
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
    """Six legs on universal joints, each a spring-loaded slider, carry a platform in space."""
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
    """The mechanism of a name such as `four-bar` or `chain-10`.

    Raises:
        ValueError: there is none.
    """
    if name in SINGLE:
        return SINGLE[name]()
    family, _, size = name.rpartition("-")
    if family in FAMILIES and size.isdigit():
        return FAMILIES[family](int(size))
    known = [*SINGLE, *(f"{family}-<n>" for family in FAMILIES)]
    raise ValueError(f"mechanism '{name}' is unknown; known are {known}.")
