"""Pairs of geoms that may touch, as MuJoCo finds them, and what their contact is like."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxcon.io.compiled import Compiled

ROUND = ("sphere", "capsule")
ON_PLANE = (*ROUND, "box")
FLAT = ("plane", "hfield")
"""Two of these never touch in MuJoCo."""


class Pair(NamedTuple):
    """Two geoms that may touch.

    Attributes:
        first, second: ids; a plane comes first.
        condim: 1 without friction, 3 with sliding friction, 4 and 6 with torsional and rolling.
        friction: μ along both tangents, (2,).
        margin: the distance at which they touch [m].
    """

    first: int
    second: int
    condim: int
    friction: np.ndarray
    margin: float


def pairs(compiled: Compiled) -> list[Pair]:
    """Returns the pairs that the model lists, and then those that its filters let through."""
    if compiled.disabled("contact", "constraint"):
        return []
    margins = Margins(compiled)
    listed = list(_listed(compiled, margins))
    known = {p[:2] for p in listed}
    found = [p for p in _filtered(compiled, margins) if p[:2] not in known]
    return [p for p in (*listed, *found) if _acts(compiled, p)]


def _acts(compiled: Compiled, pair: Pair) -> bool:
    """Returns True where the geoms can move in each other and touch, and the user wants it."""
    first, second = _welded(compiled, pair)
    flat = all(kind in FLAT for kind in shapes(compiled, pair))
    left_out = first and second and "self_contact" in compiled.ignored
    return first != second and not flat and not left_out


def label(compiled: Compiled, pair: Pair) -> str:
    """The names of both geoms."""
    return " and ".join(compiled.name("geom", g) for g in (pair.first, pair.second))


def shapes(compiled: Compiled, pair: Pair) -> tuple[str, str]:
    """The kinds of both geoms."""
    first, second = (compiled.choice("mjtGeom", compiled.model.geom_type[g]) for g in pair[:2])
    return first, second


def supported(compiled: Compiled, pair: Pair) -> bool:
    """Returns True where there is a contact for these shapes."""
    first, second = shapes(compiled, pair)
    return second in ON_PLANE if first == "plane" else {first, second} <= set(ROUND)


def _listed(compiled: Compiled, margins: Margins) -> Iterator[Pair]:
    """The model's own `<pair>`s."""
    m = compiled.model
    for i in range(m.npair):
        ends = _ordered(compiled, int(m.pair_geom1[i]), int(m.pair_geom2[i]))
        own = margins.of_pair(m.pair_margin[i], m.pair_gap[i])
        yield Pair(*ends, int(m.pair_dim[i]), m.pair_friction[i, :2], own)


def _filtered(compiled: Compiled, margins: Margins) -> Iterator[Pair]:
    """Geoms whose masks match, on bodies that are not excluded and no parent and child."""
    m = compiled.model
    weld, parent = m.body_weldid, m.body_weldid[m.body_parentid]
    excluded = {int(x) for x in m.exclude_signature}
    keeps_parents = compiled.disabled("filterparent")
    for h in range(m.ngeom):
        for g in range(h):
            a, b = sorted((int(m.geom_bodyid[g]), int(m.geom_bodyid[h])))
            u, w = int(weld[a]), int(weld[b])
            related = u and w and (parent[u] == w or parent[w] == u)
            masks = m.geom_contype[g] & m.geom_conaffinity[h]
            masks |= m.geom_contype[h] & m.geom_conaffinity[g]
            if masks and (a << 16) + b not in excluded and (keeps_parents or not related):
                yield _combined(compiled, _ordered(compiled, g, h), margins)


def _combined(compiled: Compiled, ends: tuple[int, int], margins: Margins) -> Pair:
    """The material of the geom of higher priority, or the larger numbers of both."""
    m, own = compiled.model, list(ends)
    most = m.geom_priority[own].max()
    rule = [g for g in own if m.geom_priority[g] == most]
    friction = m.geom_friction[rule, 0].max()
    margin = margins.of_geoms(m.geom_margin[own], m.geom_gap[own])
    return Pair(*ends, int(m.geom_condim[rule].max()), np.full(2, friction), margin)


class Margins:
    """The distance at which geoms touch, by margin and gap, which has changed with versions.

    Two spheres with margins of 1 and 2 and a gap of 1/4 tell which rule it is: the sum or the
    larger one, with the gap taken off or not.
    """

    PROBE = (
        '<mujoco><worldbody><geom size="1" margin="1" gap="0.25"/>'
        '<body><freejoint/><geom size="1" margin="2"/></body></worldbody></mujoco>'
    )

    def __init__(self, compiled: Compiled) -> None:
        mujoco = compiled.mujoco
        model = mujoco.MjModel.from_xml_string(self.PROBE)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        seen = float(data.contact.includemargin[0])
        self.together = np.sum if seen > 2 else np.max
        self.by_gap = float(seen % 1 != 0)

    def of_geoms(self, margin: np.ndarray, gap: np.ndarray) -> float:
        """Returns the distance at which contact of two geoms begins, from numbers of each, (2,)."""
        return float(self.together(margin) - self.by_gap * self.together(gap))

    def of_pair(self, margin: float, gap: float) -> float:
        """Returns the distance at which contact of a listed pair begins."""
        return float(margin - self.by_gap * gap)


def _ordered(compiled: Compiled, g: int, h: int) -> tuple[int, int]:
    """By kind, as MuJoCo orders them: a plane first."""
    first, second = sorted((g, h), key=lambda i: (compiled.model.geom_type[i], i))
    return first, second


def _welded(compiled: Compiled, pair: Pair) -> list[Any]:
    """Returns the body that each geom moves with; 0 where it does not move."""
    m = compiled.model
    return [int(m.body_weldid[m.geom_bodyid[g]]) for g in pair[:2]]
