"""Contacts of planes, spheres, capsules and boxes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxcon.constraints.contact import CapsuleContact, PlaneContact
from jaxcon.io import pairs
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link, scene_body
from jaxcon.io.pairs import Pair


def contacts(compiled: Compiled, links: tuple[Link, ...], names: Names) -> Iterator[Any]:
    """The elements of all pairs that are supported."""
    for pair in pairs.pairs(compiled):
        if not pairs.supported(compiled, pair):
            continue
        ends = [scene_body(compiled, links, int(compiled.model.geom_bodyid[g])) for g in pair[:2]]
        flat = pairs.shapes(compiled, pair)[0] == "plane"
        make = _on_plane if flat else _round
        yield from make(compiled, pair, ends, names)


def _on_plane(
    compiled: Compiled, pair: Pair, ends: list[str], names: Names
) -> Iterator[PlaneContact]:
    """The balls of a shape on a plane: its own, those at the ends of its axis, or its corners."""
    data, own = compiled.data, pairs.label(compiled, pair)
    normal = data.geom_xmat[pair.first].reshape(3, 3)[:, 2]
    centers, radius = _balls(compiled, pair.second)
    for i, center in enumerate(centers, 1):
        yield PlaneContact(
            names.take(own if len(centers) == 1 else f"{own} {i}", "contact"),
            *ends,
            radius=radius + pair.margin,
            center=center,
            normal=normal,
            point=data.geom_xpos[pair.first],
            friction=pair.friction[0] if pair.condim > 1 else 0.0,
        )


def _balls(compiled: Compiled, geom: int) -> tuple[np.ndarray, float]:
    """Centres in the world, (balls, 3), and the radius that they share."""
    kind = compiled.choice("mjtGeom", compiled.model.geom_type[geom])
    size = compiled.model.geom_size[geom]
    if kind != "box":
        return _axis(compiled, geom)[: 1 if kind == "sphere" else 2], size[0]
    turn, center = compiled.data.geom_xmat[geom].reshape(3, 3), compiled.data.geom_xpos[geom]
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * size
    return center + corners @ turn.T, 0.0


def _axis(compiled: Compiled, geom: int) -> np.ndarray:
    """Both ends of the axis of a capsule in the world, (2, 3); of a sphere its centre, twice."""
    m, data = compiled.model, compiled.data
    long = compiled.choice("mjtGeom", m.geom_type[geom]) == "capsule"
    half = m.geom_size[geom, 1] * long * data.geom_xmat[geom].reshape(3, 3)[:, 2]
    return data.geom_xpos[geom] + np.array([-half, half])


def _round(
    compiled: Compiled, pair: Pair, ends: list[str], names: Names
) -> Iterator[CapsuleContact]:
    """Two spheres or capsules, each with half of the margin."""
    radii = compiled.model.geom_size[list(pair[:2]), 0] + pair.margin / 2
    yield CapsuleContact(
        names.take(pairs.label(compiled, pair), "contact"),
        *ends,
        radius_a=radii[0],
        radius_b=radii[1],
        segment_a=_axis(compiled, pair.first),
        segment_b=_axis(compiled, pair.second),
        friction=pair.friction[0] if pair.condim > 1 else 0.0,
    )
