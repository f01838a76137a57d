"""Scenes with different constraint graphs, in any size.

`FAMILIES[name].build(n, dtype)` builds a scene of n bodies. In the family "rows", n is the number
of constraints, on a fixed number of bodies.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.typing import DTypeLike

import jaxcon as jc
from benchmarks import mechanisms

LINK = 0.1
"""Distance between neighbors [m]."""
BODIES = 100
"""Number of bodies in the scenes of `rows`."""


@dataclass(frozen=True)
class Family:
    """Scenes whose constraint graphs have one structure.

    Attributes:
        says: description of the structure.
        sizes: sizes to measure.
        build: (size, dtype) → system and state.
    """

    says: str
    sizes: tuple[int, ...]
    build: Callable[[int, Any], tuple[Any, jc.State]]


def of(name: str) -> Callable[[int, Any], tuple[Any, jc.State]]:
    """Returns the builder of a benchmark mechanism as a function of its size."""
    return lambda n, dtype: mechanisms.find(f"{name}-{n}").build(dtype)


def particles(points: Any, dtype: DTypeLike) -> jc.Scene:
    """Returns a scene of particles of 0.1 kg at points (n, dim)."""
    scene = jc.Scene(dim=len(points[0]), dtype=dtype)
    for i, point in enumerate(points):
        scene.add_particle(f"p{i}", mass=0.1, position=point)
    return scene


def posts(n: int, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds independent pendulums side by side."""
    scene = particles([(i * LINK + LINK, 0.0) for i in range(n)], dtype)
    for i in range(n):
        scene.add(jc.Distance(f"rod{i}", jc.WORLD, f"p{i}", point_a=(i * LINK, 0.0)))
    return scene.build()


def hub(n: int, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds particles on rods around one heavy body, on which all constraints act."""
    angles = 2 * np.pi * np.arange(n) / n
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    scene = particles(2 * rays, dtype)
    scene.add_body("hub", mass=10.0, inertia=5.0)
    for i, ray in enumerate(rays):
        scene.add(jc.Distance(f"rod{i}", "hub", f"p{i}", point_a=ray))
    return scene.build()


def net(n: int, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds a square net of about n particles in space, fixed along one side, with many loops."""
    side = max(2, math.isqrt(n))
    places = [(i, j) for i in range(side) for j in range(side)]
    scene = particles([(i * LINK, -j * LINK, 0.0) for i, j in places], dtype)
    for k, (i, j) in enumerate(places):
        if i + 1 < side:
            scene.add(jc.Distance(f"along{k}", f"p{k}", f"p{k + side}"))
        if j + 1 < side:
            scene.add(jc.Distance(f"down{k}", f"p{k}", f"p{k + 1}"))
        if j == 0:
            top = (i * LINK, LINK, 0.0)
            scene.add(jc.Distance(f"hung{k}", jc.WORLD, f"p{k}", point_a=top))
    return scene.build()


def rows(m: int, dtype: DTypeLike) -> tuple[Any, jc.State]:
    """Builds a hundred particles in a row with m constraints.

    The constraints connect the first m particles in a chain that starts at the world.
    """
    scene = particles([(i * LINK + LINK, 0.0) for i in range(BODIES)], dtype)
    for i in range(m):
        first = (jc.WORLD, (0.0, 0.0)) if i == 0 else (f"p{i - 1}", None)
        scene.add(jc.Distance(f"rod{i}", first[0], f"p{i}", point_a=first[1]))
    return scene.build()


FAMILIES = {
    "rope": Family("particles in a row", (1, 10, 100, 1000, 10_000), of("rope")),
    "chain": Family("bodies in space on hinges", (1, 10, 100, 1000), of("chain")),
    "posts": Family("particles, each tied to the ground", (1, 10, 100, 1000), posts),
    "hub": Family("particles tied to one body", (1, 10, 30, 100, 300), hub),
    "net": Family("a net of particles in space", (4, 25, 100, 400, 900), net),
    "rows": Family("m constraints on 100 particles", (1, 10, 30, 100), rows),
}
