"""The joints of a link."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxcon.constraints.compound import DEPENDENT, Compound
from jaxcon.constraints.joints import Prismatic, Revolute, Spherical
from jaxcon.constraints.twist import Twist
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link, LinkJoint
from jaxcon.model.layout import WORLD

MEETING = 1e-9
"""How far apart, in parts of a metre, axes may pass that are to meet in one point."""


class Coordinate(NamedTuple):
    """Where a coordinate of MuJoCo's is found in the scene: that of a joint, by name."""

    joint: str
    name: str


class Joined(NamedTuple):
    """What joins a link to its parent.

    Attributes:
        elements: of the scene.
        coordinates: by the id of each hinge and slide in MuJoCo's model.
    """

    elements: list[Any]
    coordinates: dict[int, Coordinate]


def join(compiled: Compiled, link: Link, names: Names) -> Joined:
    """The joint between a link and its parent.

    Raises:
        NotImplementedError: the freedoms of the link are none that one joint has.
    """
    joint, *more = link.joints
    if joint.kind == "free":
        return Joined([], {})
    ends = (link.above, link.name)
    if more:
        return _compound(compiled, link, ends, names)
    name = names.take(compiled.name("joint", joint.id), "joint")
    point, axis = compiled.data.xanchor[joint.id], compiled.data.xaxis[joint.id]
    if joint.kind == "ball":
        return Joined([Spherical(name, *ends, point=point)], {})
    if joint.kind == "hinge":
        element, coordinate = Revolute(name, *ends, point=point, axis=axis), "angle"
    else:
        element, coordinate = Prismatic(name, *ends, axis=axis, point=point), "travel"
    return Joined([element], {joint.id: Coordinate(name, coordinate)})


def _compound(compiled: Compiled, link: Link, ends: tuple[str, str], names: Names) -> Joined:
    """Slides, then hinges or a ball; hinges, then slides, is the same seen from the other body."""
    kinds = [j.kind for j in link.joints]
    turns = [j for j in link.joints if j.kind != "slide"]
    slides = [j for j in link.joints if j.kind == "slide"]
    forward, backward = list(link.joints) == slides + turns, list(link.joints) == turns + slides
    balls = kinds.count("ball")
    if not (forward or backward) or (balls and (balls > 1 or len(turns) > 1 or not forward)):
        raise NotImplementedError(
            f"from_mjcf: body '{link.name}' has the joints {kinds} in this order; one body may have"
            " slides and then hinges or a ball, or hinges and then slides."
        )
    sign = 1 if forward else -1
    slides, turns = slides[::sign], turns[::sign]
    slide_axes, hinge_axes = (_axes(compiled, link, js, sign) for js in (slides, turns))
    joint = Compound(
        names.take(f"{link.name} joint", "joint"),
        *ends[::sign],
        point=_meeting_point(compiled, link, turns),
        slides=slide_axes,
        hinges=() if balls else hinge_axes,
        ball=bool(balls),
    )
    found = [(s, f"travel_{i}") for i, s in enumerate(slides, 1)]
    found += [(h, f"angle_{i}") for i, h in enumerate(turns, 1) if not balls]
    return Joined([joint], {j.id: Coordinate(joint.name, name) for j, name in found})


def _axes(compiled: Compiled, link: Link, joints: list[LinkJoint], sign: int) -> tuple[Any, ...]:
    """Their axes, as seen by the body that comes first.

    Raises:
        NotImplementedError: there are more than three, or they are dependent.
    """
    axes = [sign * compiled.data.xaxis[j.id] for j in joints]
    gram = np.reshape(axes, (-1, 3)) @ np.reshape(axes, (-1, 3)).T
    if len(axes) > 3 or np.sqrt(max(np.linalg.det(gram), 0.0)) < DEPENDENT:
        names = [compiled.name("joint", j.id) for j in joints]
        raise NotImplementedError(
            f"from_mjcf: the axes of {names} of body '{link.name}' are dependent at the reference"
            " pose; parallel hinges of one body, and three in gimbal lock, are not supported."
        )
    return tuple(axes)


def _meeting_point(compiled: Compiled, link: Link, joints: list[LinkJoint]) -> np.ndarray:
    """The point through which the axes go; that of the body where there are none.

    Σ (1 − n nᵀ)(x − p) = 0 is nearest to the lines with the points p and directions n.

    Raises:
        NotImplementedError: they do not meet.
    """
    if not joints:
        return compiled.data.xpos[link.body]
    ids = [j.id for j in joints]
    points, axes = compiled.data.xanchor[ids], compiled.data.xaxis[ids]
    if len(ids) == 1:
        return points[0]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    nearest = np.linalg.solve(across.sum(0), (across @ points[:, :, None]).sum(0))[:, 0]
    distance = np.linalg.norm(across @ (nearest - points)[:, :, None], axis=1).max()
    if distance > MEETING:
        names = [compiled.name("joint", i) for i in ids]
        raise NotImplementedError(
            f"from_mjcf: the axes of the hinges {names} of body '{link.name}' pass each other at"
            f" {distance:.2g} m; hinges of one body must meet in a point. Put a body between them."
        )
    return nearest


def turning(link: Link, axis: Any, name: str, backward: bool = False) -> Twist:
    """The turning of a link about an axis of its own, or about one of its parent the other way."""
    ends = (link.above, link.name)
    return Twist(name, *(ends[::-1] if backward else ends), axis=axis)


def pushing(compiled: Compiled, link: Link, axes: Any, name: str) -> Compound:
    """The travel of a free link's frame along three axes of the world, which holds nothing."""
    origin = compiled.data.xpos[link.body]
    return Compound(name, WORLD, link.name, origin, slides=(*axes,), ball=True)
