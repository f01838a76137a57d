"""Import of MuJoCo's tendons: over joints (fixed), and through sites and pulleys (spatial).

A spatial tendon is the sum of a `Span` or `WrappedSpan` for each segment between sites of different
links, divided by the divisor of the last pulley.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np

from jaxcon.constraints.armature import Armature
from jaxcon.constraints.pairs import Span
from jaxcon.constraints.tendons import Tendon
from jaxcon.constraints.wrapping import WrappedSpan
from jaxcon.contact.limits import JointFriction, Limit
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate
from jaxcon.io.links import Link, scene_body
from jaxcon.system.actuators import DeadBandSpring, JointDamper, JointSpring

Element: TypeAlias = JointSpring | DeadBandSpring | JointDamper | Armature | JointFriction | Limit
"""A passive element on a tendon."""


PASSIVE = {
    "stiffness": ("spring", "passive"),
    "damping": ("damper", "passive"),
    "armature": (),
    "frictionloss": ("friction", "frictionloss", "constraint"),
    "limited": ("limit", "constraint"),
}
"""The fields of MuJoCo's tendons for passive elements, with the features that disable each."""


class Tendons(NamedTuple):
    """The tendons of a model.

    Attributes:
        elements: the scene elements of the tendons, without passive elements.
        coordinates: the scene coordinate of each imported tendon, by MuJoCo's tendon id.
    """

    elements: list[Span | WrappedSpan | Tendon]
    coordinates: dict[int, Coordinate]


def tendons(
    compiled: Compiled, links: tuple[Link, ...], joints: dict[int, Coordinate], names: Names
) -> Tendons:
    """Returns the scene elements of all tendons that something acts on or reads.

    Args:
        compiled: the model.
        links: the links of the model.
        joints: the scene coordinate of each hinge and slide, by MuJoCo's joint id.
        names: the names in the scene.

    Raises:
        NotImplementedError: a tendon that affects the motion has a sidesite, or cannot change its
            length.
    """
    found = Tendons([], {})
    acting, read = _acting(compiled), _read(compiled)
    for t in sorted(acting | read):
        label = compiled.name("tendon", t)
        if why := unsupported(compiled, links, t):
            if t in acting:
                raise NotImplementedError(f"from_mjcf: tendon '{label}' {why}.")
            continue
        spatial = _spatial(compiled, t)
        terms = _spans(compiled, links, t, names) if spatial else _terms(compiled, t, joints)
        found.elements.extend(x for x, _, _ in terms if x is not None)
        ends = {}
        for _, at, coefficient in terms:
            ends[at] = ends.get(at, 0.0) + coefficient
        name = names.take(label, "tendon")
        coordinates = tuple(at.name for at in ends)
        joint_names = tuple(at.joint for at in ends)
        tendon = Tendon(name, joint_names, np.array([*ends.values()]), coordinates)
        found.elements.append(tendon)
        found.coordinates[t] = Coordinate(name, "length")
    return found


def _acting(compiled: Compiled) -> set[int]:
    """Returns MuJoCo's ids of the tendons that affect the motion."""
    m, result = compiled.model, set()
    for numbers in _passive(compiled).values():
        result |= set(map(int, np.flatnonzero(numbers)))
    for i in range(m.neq):
        if m.eq_active0[i] and compiled.choice("mjtEq", m.eq_type[i]) == "tendon":
            off = compiled.disabled("equality", "constraint")
            ends = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
            result |= set() if off else {t for t in ends if t >= 0}
    for i in range(len(m.actuator_trntype)):
        if compiled.choice("mjtTrn", m.actuator_trntype[i]) == "tendon":
            result.add(int(m.actuator_trnid[i, 0]))
    return result


def _passive(compiled: Compiled) -> dict[str, np.ndarray]:
    """Returns MuJoCo's numbers of the passive elements, (ntendon,), by the fields in `PASSIVE`.

    Numbers that a flag or `ignore` disables are zero.
    """
    m = compiled.model
    return {
        field: np.asarray(getattr(m, f"tendon_{field}", np.zeros(m.ntendon)))
        * (not compiled.disabled("tendon", *switches))
        for field, switches in PASSIVE.items()
    }


def _read(compiled: Compiled) -> set[int]:
    """Returns MuJoCo's ids of the tendons with sensors."""
    m, kind = compiled.model, int(compiled.mujoco.mjtObj.mjOBJ_TENDON)
    return {int(m.sensor_objid[i]) for i in range(m.nsensor) if m.sensor_objtype[i] == kind}


def _wraps(compiled: Compiled, t: int) -> list[tuple[str, int, float]]:
    """Returns the path of a tendon: the type, the object's id and the parameter of each point."""
    m, start = compiled.model, int(compiled.model.tendon_adr[t])
    return [
        (
            compiled.choice("mjtWrap", m.wrap_type[w]),
            int(m.wrap_objid[w]),
            float(m.wrap_prm[w]),
        )
        for w in range(start, start + int(m.tendon_num[t]))
    ]


def _spatial(compiled: Compiled, t: int) -> bool:
    """Returns True for a tendon through sites, False for a combination of joints."""
    return _wraps(compiled, t)[0][0] != "joint"


class Segment(NamedTuple):
    """A segment of a spatial tendon between two sites.

    Attributes:
        first, second: MuJoCo's ids of the sites.
        factor: the factor of its length, the inverse divisor of the last pulley.
        geom: MuJoCo's id of the geom around which it wraps; −1 for none.
        side: MuJoCo's id of the site on whose side it passes the geom; −1 for none.
    """

    first: int
    second: int
    factor: float
    geom: int = -1
    side: int = -1


def unsupported(compiled: Compiled, links: tuple[Link, ...], t: int) -> str:
    """Returns why a tendon is not supported; empty if it is."""
    if not _spatial(compiled, t):
        return ""
    segments = _segments(compiled, links, t)
    for x in segments:
        if x.side >= 0:
            return (
                f"wraps around the geom '{compiled.name('geom', x.geom)}' on the side of the site"
                f" '{compiled.name('site', x.side)}'; wrapping is supported without sidesite"
            )
    return "" if segments else "lies in one body and cannot change its length; remove it"


def _segments(compiled: Compiled, links: tuple[Link, ...], t: int) -> list[Segment]:
    """Returns the segments of a spatial tendon that may change their length."""
    m, factor, before, geom, side = compiled.model, 1.0, -1, -1, -1
    found = []
    for kind, i, parameter in _wraps(compiled, t):
        if kind == "pulley":
            factor, before = 1 / parameter, -1
        elif kind in ("sphere", "cylinder"):
            geom, side = i, int(round(parameter))
        else:
            if before >= 0:
                owners = [m.site_bodyid[before], m.site_bodyid[i]]
                owners += [m.geom_bodyid[geom]] if geom >= 0 else []
                if len({scene_body(compiled, links, int(b)) for b in owners}) > 1:
                    found.append(Segment(before, i, factor, geom, side if geom >= 0 else -1))
            before, geom, side = i, -1, -1
    return found


def moved_joints(compiled: Compiled, links: tuple[Link, ...], t: int) -> set[int]:
    """Returns MuJoCo's ids of the joints that change the length of a tendon."""
    m = compiled.model
    if not _spatial(compiled, t):
        return {j for _, j, coefficient in _wraps(compiled, t) if coefficient}
    found = set()
    for x in _segments(compiled, links, t):
        bodies = [int(m.site_bodyid[x.first]), int(m.site_bodyid[x.second])]
        bodies += [int(m.geom_bodyid[x.geom])] if x.geom >= 0 else []
        found |= joints_between(compiled, bodies)
    return found


def joints_between(compiled: Compiled, bodies: Iterable[int]) -> set[int]:
    """Returns MuJoCo's ids of the joints that move some of the bodies, but not all of them."""
    m, above = compiled.model, []
    for body in bodies:
        joints = set()
        while body:
            start = int(m.body_jntadr[body])
            joints |= set(range(start, start + int(m.body_jntnum[body])))
            body = int(m.body_parentid[body])
        above.append(joints)
    return set.union(*above) - set.intersection(*above)


Term: TypeAlias = tuple[Span | WrappedSpan | None, Coordinate, float]
"""A term of a tendon: its span, if it is new; the coordinate; and the coefficient."""


def _spans(compiled: Compiled, links: tuple[Link, ...], t: int, names: Names) -> list[Term]:
    """Returns the terms of a tendon through sites, with a span for each segment."""
    m, data, terms = compiled.model, compiled.data, []
    for k, segment in enumerate(_segments(compiled, links, t), 1):
        first, second, factor, geom, _ = segment
        start, end = data.site_xpos[first], data.site_xpos[second]
        bodies = [scene_body(compiled, links, int(m.site_bodyid[s])) for s in (first, second)]
        name = names.take(f"{compiled.name('tendon', t)} span {k}", "span")
        if geom < 0:
            span = Span(name, bodies[0], bodies[1], start, end)
        else:
            round_axis = compiled.choice("mjtGeom", m.geom_type[geom]) == "cylinder"
            span = WrappedSpan(
                name,
                bodies[0],
                bodies[1],
                scene_body(compiled, links, int(m.geom_bodyid[geom])),
                m.geom_size[geom, 0],
                center=data.geom_xpos[geom],
                axis=data.geom_xmat[geom].reshape(3, 3)[:, 2] if round_axis else None,
                point_a=start,
                point_b=end,
            )
        terms.append((span, Coordinate(name, "stretch"), factor))
    return terms


def _terms(compiled: Compiled, t: int, joints: dict[int, Coordinate]) -> list[Term]:
    """Returns the terms of a tendon over joints."""
    return [(None, joints[j], coefficient) for _, j, coefficient in _wraps(compiled, t)]


def passive_tendons(
    compiled: Compiled, coordinates: dict[int, Coordinate], names: Names
) -> Iterator[Element]:
    """Yields springs, dampers, rotors, dry friction and limits of tendons."""
    m, numbers = compiled.model, _passive(compiled)
    for t, at in coordinates.items():
        label, length = compiled.name("tendon", t), m.tendon_length0[t]
        stiffness, damping, armature, friction, limited = (numbers[x][t] for x in PASSIVE)
        lower, upper = m.tendon_lengthspring[t] - length
        if stiffness:
            name = names.take(f"{label} spring", "spring")
            if lower < upper:
                yield DeadBandSpring(name, at.joint, stiffness, lower, upper, damping)
            else:
                yield JointSpring(name, at.joint, stiffness, damping, lower)
        elif damping:
            yield JointDamper(names.take(f"{label} damper", "damper"), at.joint, damping)
        if armature:
            yield Armature(names.take(f"{label} rotor", "rotor"), at.joint, armature)
        if friction:
            name = names.take(f"{label} friction", "friction")
            yield JointFriction(name, at.joint, friction)
        if limited:
            inward = m.tendon_margin[t] * np.array([1.0, -1.0])
            lower, upper = m.tendon_range[t] - length + inward
            name = names.take(f"{label} limit", "limit", "tendon limit")
            yield Limit(name, at.joint, lower, upper)
