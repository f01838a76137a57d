"""Scenes with singular configurations, for tests of derivatives: pairs of bodies and mechanisms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import jaxcon as jc
from benchmarks.gradient_elements import ELEMENTS, PAIR, Made, along, hinge


def pair(dim: int, make: Callable[[int], Made]) -> Any:
    """Builds a scene of two bodies with elements between them."""
    scene = jc.Scene(dim=dim)
    for i, name in enumerate(PAIR):
        add(scene, name, i * along(dim, 0))
    for element in make(dim):
        scene.add(element)
    return scene.build()


def add(scene: jc.Scene, name: str, position: np.ndarray) -> None:
    """Adds a body at rest, without rotation."""
    inertia = 0.8 if scene.dim == 2 else (0.8, 1.1, 1.5)
    scene.add_body(name, mass=1.0, inertia=inertia, position=position)


def chain(dim: int) -> Any:
    """Builds three links in a straight line, the first hinged to the world."""
    scene = jc.Scene(dim=dim)
    for i, name in enumerate("abc"):
        add(scene, name, (i + 0.5) * along(dim, 0))
        scene.add(
            hinge(dim, f"joint{i}" if i else "joint", "abc"[i - 1] if i else jc.WORLD, name, i)
        )
    return scene.build()


def rope(dim: int) -> Any:
    """Builds a rope of four particles in a straight line, fixed to the world."""
    scene = jc.Scene(dim=dim)
    for i, name in enumerate("abcd"):
        scene.add_particle(name, mass=0.5, position=(i + 1.0) * along(dim, 0))
        before = "abcd"[i - 1] if i else jc.WORLD
        scene.add(jc.Distance(f"joint{i}" if i else "joint", before, name))
    return scene.build()


def folded(dim: int) -> Any:
    """Builds a parallelogram with all bars in one line, where two branches of its motion meet."""
    scene = jc.Scene(dim=dim)
    places = {"a": 0.5, "b": 2.0, "c": 3.5}
    for name, x in places.items():
        add(scene, name, x * along(dim, 0))
    joints = ((jc.WORLD, "a", 0.0), ("a", "b", 1.0), ("b", "c", 3.0), ("c", jc.WORLD, 4.0))
    for i, (a, b, x) in enumerate(joints):
        scene.add(hinge(dim, f"joint{i}" if i else "joint", a, b, x))
    return scene.build()


def door(dim: int) -> Any:
    """Builds a body on two hinges with one common axis; the second hinge is redundant."""
    scene = jc.Scene(dim=dim)
    add(scene, "a", 0.5 * along(dim, 0))
    for i, name in enumerate(("joint", "joint1")):
        axis = along(dim, dim - 1)
        point = i * axis
        scene.add(jc.Revolute(name, jc.WORLD, "a", point=point, axis=axis))
    return scene.build()


MECHANISMS: dict[str, tuple[tuple[int, ...], Callable[[int], Any]]] = {
    "straight chain": ((2, 3), chain),
    "straight rope": ((2, 3), rope),
    "folded parallelogram": ((2, 3), folded),
    "door on two hinges": ((3,), door),
}


def build(name: str, dim: int) -> Any:
    """Builds a scene by name: (system, state) in float64."""
    if name in MECHANISMS:
        return MECHANISMS[name][1](dim)
    return pair(dim, ELEMENTS[name][1])


SCENES = tuple((name, dim) for name, (dims, _) in (ELEMENTS | MECHANISMS).items() for dim in dims)
"""Scene names with their dimensions."""
