"""Import of contacts between the planes, spheres, capsules and boxes of a MuJoCo model."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from jaxcon.contact.contact import CapsuleContact, PlaneContact
from jaxcon.io import pairs
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link, scene_body
from jaxcon.io.pairs import GeomPair


def contacts(
    compiled: Compiled, links: tuple[Link, ...], names: Names
) -> Iterator[PlaneContact | CapsuleContact]:
    """Yields the contacts of all supported pairs of geoms."""
    for pair in pairs.pairs(compiled):
        if not pairs.supported(compiled, pair):
            continue
        ends = [scene_body(compiled, links, int(compiled.model.geom_bodyid[g])) for g in pair[:2]]
        flat = pairs.shapes(compiled, pair)[0] == "plane"
        make = _on_plane if flat else _round
        yield from make(compiled, pair, ends, names)


def _on_plane(
    compiled: Compiled, pair: GeomPair, ends: list[str], names: Names
) -> Iterator[PlaneContact]:
    """Yields the contacts of a shape with a plane: one per sphere, capsule end or box corner."""
    data, label = compiled.data, pairs.label(compiled, pair)
    normal = data.geom_xmat[pair.first].reshape(3, 3)[:, 2]
    centers, radius = _balls(compiled, pair.second)
    for i, center in enumerate(centers, 1):
        yield PlaneContact(
            names.take(label if len(centers) == 1 else f"{label} {i}", "contact"),
            *ends,
            radius=radius + pair.margin,
            center=center,
            normal=normal,
            point=data.geom_xpos[pair.first],
            **pair.material(compiled.ignored),
        )


def _balls(compiled: Compiled, geom: int) -> tuple[np.ndarray, float]:
    """Returns the spheres by which a geom touches a plane.

    They are the sphere itself, the two ends of a capsule, or the eight corners of a box.

    Returns:
        The centers of the spheres in the world frame, (n, 3) [m], and their common radius [m]; 0
        for the corners of a box.
    """
    kind = compiled.choice("mjtGeom", compiled.model.geom_type[geom])
    size = compiled.model.geom_size[geom]
    if kind != "box":
        return _axis(compiled, geom)[: 1 if kind == "sphere" else 2], size[0]
    turn, center = compiled.data.geom_xmat[geom].reshape(3, 3), compiled.data.geom_xpos[geom]
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * size
    return center + corners @ turn.T, 0.0


def _axis(compiled: Compiled, geom: int) -> np.ndarray:
    """Returns both ends of a capsule's axis in the world frame, (2, 3) [m].

    For a sphere, both ends are its center.
    """
    m, data = compiled.model, compiled.data
    long = compiled.choice("mjtGeom", m.geom_type[geom]) == "capsule"
    half = m.geom_size[geom, 1] * long * data.geom_xmat[geom].reshape(3, 3)[:, 2]
    return data.geom_xpos[geom] + np.array([-half, half])


def _round(
    compiled: Compiled, pair: GeomPair, ends: list[str], names: Names
) -> Iterator[CapsuleContact]:
    """Yields the contact of two spheres or capsules, each enlarged by half the margin."""
    radii = compiled.model.geom_size[list(pair[:2]), 0] + pair.margin / 2
    yield CapsuleContact(
        names.take(pairs.label(compiled, pair), "contact"),
        *ends,
        radius_a=radii[0],
        radius_b=radii[1],
        segment_a=_axis(compiled, pair.first),
        segment_b=_axis(compiled, pair.second),
        **pair.material(compiled.ignored),
    )
