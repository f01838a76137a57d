"""Pairs of geoms that may touch according to MuJoCo's filters, with their contact parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxcon.contact import shapes as shapes_of_jaxcon
from jaxcon.contact.shape_contact import ShapePair
from jaxcon.io.compiled import Compiled

ROUND = ("sphere", "capsule")
ON_PLANE = (*ROUND, "box")
"""The shapes that touch a plane at balls or corners, with a `PlaneContact` for each."""
SHAPES = {
    "plane": shapes_of_jaxcon.Plane,
    "sphere": shapes_of_jaxcon.Sphere,
    "capsule": shapes_of_jaxcon.Capsule,
    "ellipsoid": shapes_of_jaxcon.Ellipsoid,
    "cylinder": shapes_of_jaxcon.Cylinder,
    "box": shapes_of_jaxcon.Box,
    "mesh": shapes_of_jaxcon.Hull,
}
"""The classes of jaxcon's shapes by the name of MuJoCo's geom."""
FLAT = ("plane", "hfield")
"""The shapes that have no contacts with each other in MuJoCo."""


class GeomPair(NamedTuple):
    """Two geoms that may touch.

    Attributes:
        first: MuJoCo's id of the first geom; a plane always comes first.
        second: MuJoCo's id of the second geom.
        condim: MuJoCo's dimension of the contact: 1 without friction, 3 with sliding friction, 4
            also with torsional friction, 6 also with rolling friction.
        friction: the coefficients, (5,): sliding friction μ along both tangents, then the lengths
            of resistance to spinning, and to rolling about both tangents [m].
        margin: the distance at which contact begins [m].
    """

    first: int
    second: int
    condim: int
    friction: np.ndarray
    margin: float

    def material(self, ignored: frozenset[str]) -> dict[str, float]:
        """Returns the fields `friction`, `spinning` and `rolling` of the contact, by condim.

        Args:
            ignored: the features that the user chose to ignore.
        """
        turning = self.condim > 3 and "torsion" not in ignored
        return {
            "friction": float(self.friction[0]) if self.condim > 1 else 0.0,
            "spinning": float(self.friction[2]) if turning else 0.0,
            "rolling": float(self.friction[3]) if turning and self.condim == 6 else 0.0,
        }


def pairs(compiled: Compiled) -> list[GeomPair]:
    """Returns all pairs of geoms that need a contact.

    The pairs that the model lists explicitly come first, then the pairs that pass MuJoCo's filters.
    """
    if compiled.disabled("contact", "constraint"):
        return []
    margins = Margins(compiled)
    listed = list(_listed(compiled, margins))
    ids = {p[:2] for p in listed}
    filtered = [p for p in _filtered(compiled, margins) if p[:2] not in ids]
    return [p for p in (*listed, *filtered) if _acts(compiled, p)]


def _acts(compiled: Compiled, pair: GeomPair) -> bool:
    """Returns True if a pair of geoms needs a contact.

    It needs none if both shapes are in `FLAT`, if both geoms belong to the same link or to the
    world, or if the user ignores contacts between moving bodies ("self_contact").
    """
    first, second = (compiled.root(compiled.model.geom_bodyid[g]) for g in pair[:2])
    flat = all(kind in FLAT for kind in shapes(compiled, pair))
    left_out = first and second and "self_contact" in compiled.ignored
    return first != second and not flat and not left_out


def label(compiled: Compiled, pair: GeomPair) -> str:
    """Returns the names of both geoms, joined by "and", for element names and messages."""
    return " and ".join(compiled.name("geom", g) for g in (pair.first, pair.second))


def shapes(compiled: Compiled, pair: GeomPair) -> tuple[str, str]:
    """Returns the shapes of both geoms, such as "plane" and "sphere"."""
    first, second = (compiled.choice("mjtGeom", compiled.model.geom_type[g]) for g in pair[:2])
    return first, second


def supported(compiled: Compiled, pair: GeomPair) -> bool:
    """Returns True if jaxcon has a contact for the shapes of both geoms."""
    kinds = shapes(compiled, pair)
    if not set(kinds) <= SHAPES.keys():
        return False
    first, second = (SHAPES[kind] for kind in kinds)
    return set(kinds) <= set(ROUND) or ShapePair(first, second).supported


def _listed(compiled: Compiled, margins: Margins) -> Iterator[GeomPair]:
    """Yields the pairs that the model lists explicitly as `<pair>`."""
    m = compiled.model
    for i in range(m.npair):
        ends = _ordered(compiled, int(m.pair_geom1[i]), int(m.pair_geom2[i]))
        margin = margins.of_pair(m.pair_margin[i], m.pair_gap[i])
        yield GeomPair(*ends, int(m.pair_dim[i]), m.pair_friction[i], margin)


def _filtered(compiled: Compiled, margins: Margins) -> Iterator[GeomPair]:
    """Yields the pairs that pass MuJoCo's filters.

    The filters are collision masks, excluded pairs of bodies, and parent and child bodies.
    """
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


def _combined(compiled: Compiled, ends: tuple[int, int], margins: Margins) -> GeomPair:
    """Combines the contact parameters of two geoms as MuJoCo does.

    Condim and friction come from the geom of higher priority. At equal priority, the larger values
    of both geoms are used.

    Args:
        compiled: the model.
        ends: MuJoCo's ids of both geoms, in the order of `_ordered`.
        margins: the rule for the distance at which contact begins.
    """
    m, geoms = compiled.model, list(ends)
    highest = m.geom_priority[geoms].max()
    rule = [g for g in geoms if m.geom_priority[g] == highest]
    sliding, spinning, rolling = m.geom_friction[rule].max(axis=0)
    friction = np.array([sliding, sliding, spinning, rolling, rolling])
    margin = margins.of_geoms(m.geom_margin[geoms], m.geom_gap[geoms])
    return GeomPair(*ends, int(m.geom_condim[rule].max()), friction, margin)


class Margins:
    """The rule for the distance at which contact begins, from the margins and gaps of two geoms.

    The rule differs between versions of MuJoCo: the sum or the maximum of both margins, with or
    without the gap subtracted. To find the rule of the installed version, a model with margins of 1
    and 2 and a gap of 1/4 is evaluated.
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
        distance = float(data.contact.includemargin[0])
        self.together = np.sum if distance > 2 else np.max
        self.by_gap = float(distance % 1 != 0)

    def of_geoms(self, margin: np.ndarray, gap: np.ndarray) -> float:
        """Returns the distance [m] at which contact of two geoms begins.

        Args:
            margin: the margins of both geoms, (2,) [m].
            gap: the gaps of both geoms, (2,) [m].
        """
        return float(self.together(margin) - self.by_gap * self.together(gap))

    def of_pair(self, margin: float, gap: float) -> float:
        """Returns the distance [m] at which contact of an explicitly listed pair begins.

        Args:
            margin: the margin of the pair [m].
            gap: the gap of the pair [m].
        """
        return float(margin - self.by_gap * gap)


def _ordered(compiled: Compiled, g: int, h: int) -> tuple[int, int]:
    """Orders two geoms by shape, as MuJoCo does: a plane comes first."""
    first, second = sorted((g, h), key=lambda i: (compiled.model.geom_type[i], i))
    return first, second
