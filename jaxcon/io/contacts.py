"""Import of contacts between the geoms of a MuJoCo model."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator

import numpy as np

from jaxcon.contact.contact import CapsuleContact, PlaneContact
from jaxcon.contact.shape_contact import ShapeContact
from jaxcon.contact.shapes import Box, Capsule, Cylinder, Ellipsoid, Hull, Plane, Shape, Sphere
from jaxcon.io import pairs
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link, scene_body
from jaxcon.io.pairs import GeomPair

HULL_POINTS = 16
"""The largest number of points by which a mesh touches a plane."""

DIRECTIONS = 500
"""The number of directions in which a mesh is compared with its points."""


def contacts(
    compiled: Compiled, links: tuple[Link, ...], names: Names
) -> Iterator[PlaneContact | CapsuleContact | ShapeContact]:
    """Yields the contacts of all supported pairs of geoms, and notes their bodies in `names`."""
    for pair in pairs.pairs(compiled):
        if not pairs.supported(compiled, pair):
            continue
        first, second = (int(compiled.model.geom_bodyid[g]) for g in pair[:2])
        ends = [scene_body(compiled, links, body) for body in (first, second)]
        for element in _of_pair(compiled, pair, ends, names):
            names.touching[element.name] = first, second
            yield element


def _of_pair(
    compiled: Compiled, pair: GeomPair, ends: list[str], names: Names
) -> Iterator[PlaneContact | CapsuleContact | ShapeContact]:
    """Yields the contacts of a supported pair of geoms."""
    first, second = pairs.shapes(compiled, pair)
    if first == "plane" and second in pairs.ON_PLANE:
        yield from _on_plane(compiled, pair, ends, names)
    elif {first, second} <= set(pairs.ROUND):
        yield from _round(compiled, pair, ends, names)
    else:
        yield from _of_shapes(compiled, pair, ends, names)


def _of_shapes(
    compiled: Compiled, pair: GeomPair, ends: list[str], names: Names
) -> Iterator[ShapeContact]:
    """Yields the contact of two other shapes."""
    first, second = (_shape(compiled, geom) for geom in pair[:2])
    yield ShapeContact(
        names.take(pairs.label(compiled, pair), "contact"),
        ends[0],
        ends[1],
        first,
        second,
        friction=pair.friction[0] if pair.condim > 1 else 0.0,
        margin=pair.margin,
    )


def _shape(compiled: Compiled, geom: int) -> Shape:
    """Returns the shape of a geom in the world frame."""
    m, data = compiled.model, compiled.data
    kind = compiled.choice("mjtGeom", m.geom_type[geom])
    size, center = m.geom_size[geom], data.geom_xpos[geom]
    turn = data.geom_xmat[geom].reshape(3, 3)
    if kind == "plane":
        return Plane(turn[:, 2], center)
    if kind == "mesh":
        return Hull(center + _hull_points(compiled, int(m.geom_dataid[geom])) @ turn.T)
    if kind == "sphere":
        return Sphere(size[0], center)
    quaternion = np.zeros(4)
    compiled.mujoco.mju_mat2Quat(quaternion, turn.ravel())
    if kind == "box":
        return Box(2 * size, center, quaternion)
    if kind == "ellipsoid":
        return Ellipsoid(size, center, quaternion)
    long = {"capsule": Capsule, "cylinder": Cylinder}[kind]
    return long(size[0], 2 * size[1], center, quaternion)


def _hull_points(compiled: Compiled, mesh: int) -> np.ndarray:
    """Returns the vertices of a mesh's convex hull, in the frame of the mesh, (k, 3) [m].

    A hull of more than `HULL_POINTS` vertices is replaced by that many of them: in turn, the vertex
    that lies farthest beyond the others in one of many directions.
    """
    m = compiled.model
    start, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
    vertices = np.asarray(m.mesh_vert[start : start + count], float)
    graph = int(m.mesh_graphadr[mesh])
    if graph >= 0:  # MuJoCo's convex hull: its number of vertices, …, and their indices
        size = int(m.mesh_graph[graph])
        vertices = vertices[m.mesh_graph[graph + 2 + size : graph + 2 + 2 * size]]
    if len(vertices) <= HULL_POINTS:
        return vertices
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    heights = directions @ vertices.T
    chosen = [int(np.argmax(heights[0]))]
    while len(chosen) < HULL_POINTS:
        missing = heights.max(axis=1) - heights[:, chosen].max(axis=1)
        chosen.append(int(np.argmax(heights[np.argmax(missing)])))
    missing = heights.max(axis=1) - heights[:, chosen].max(axis=1)
    warnings.warn(
        f"from_mjcf: mesh '{compiled.name('mesh', mesh)}' has {len(vertices)} vertices in its"
        f" convex hull; contacts use {HULL_POINTS} of them, beyond which the hull extends by up to"
        f" {missing.max():.2g} m.",
        stacklevel=2,
    )
    return vertices[sorted(set(chosen))]


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
