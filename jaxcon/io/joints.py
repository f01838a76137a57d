"""Import of the joints of a MuJoCo model: one joint between each link and its parent."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from jaxcon.constraints.compound import DEPENDENT, Compound
from jaxcon.constraints.joints import Prismatic, Revolute, Spherical
from jaxcon.constraints.pairs import Twist
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.links import Link, LinkJoint
from jaxcon.system.layout import WORLD

MEETING = 1e-9
"""The largest distance [m] between hinge axes that count as intersecting in one point."""

Joint: TypeAlias = Revolute | Prismatic | Spherical | Compound
"""The types of joints that may connect a link to its parent."""


class Coordinate(NamedTuple):
    """The scene coordinate of one of MuJoCo's hinges or slides.

    Attributes:
        joint: the name of the joint in the scene.
        name: the name of the coordinate of this joint, such as "angle".
    """

    joint: str
    name: str


class Ends(NamedTuple):
    """The scene coordinates on which actuators and equalities act.

    Attributes:
        joints: the coordinate of each hinge and slide, by MuJoCo's joint id.
        tendons: the coordinate of each tendon, by MuJoCo's tendon id.
    """

    joints: dict[int, Coordinate]
    tendons: dict[int, Coordinate]


class Joined(NamedTuple):
    """The joint between a link and its parent, as scene elements.

    Attributes:
        elements: a list with the joint; empty for a free link.
        coordinates: the scene coordinate of each hinge and slide, by MuJoCo's joint id.
    """

    elements: list[Joint]
    coordinates: dict[int, Coordinate]


def join(compiled: Compiled, link: Link, names: Names) -> Joined:
    """Builds the joint between a link and its parent.

    Raises:
        NotImplementedError: no single joint has the degrees of freedom of the link.
    """
    joint = link.joints[0]
    if joint.kind == "free":
        return Joined([], {})
    ends = (link.above, link.name)
    if len(link.joints) > 1:
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
    """Builds a `Compound` from several joints of one body: slides, followed by hinges or a ball.

    If hinges are followed by slides, the `Compound` is built with the two bodies exchanged.

    Args:
        compiled: the model.
        link: the link with the joints.
        ends: the names of the parent link and of the link.
        names: the names in the scene.

    Raises:
        NotImplementedError: the joints have another order, or more than one ball.
    """
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
    labels = [(s, f"travel_{i}") for i, s in enumerate(slides, 1)]
    labels += [(h, f"angle_{i}") for i, h in enumerate(turns, 1) if not balls]
    return Joined([joint], {j.id: Coordinate(joint.name, name) for j, name in labels})


def _axes(
    compiled: Compiled, link: Link, joints: list[LinkJoint], sign: int
) -> tuple[np.ndarray, ...]:
    """Returns the axes of slides or hinges in the world frame, (3,) each, multiplied by `sign`.

    Raises:
        NotImplementedError: there are more than three axes, or they are linearly dependent.
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
    """Returns the intersection point of the hinge axes of a link, world frame, (3,) [m].

    The point x solves Σ (1 − n nᵀ)(x − p) = 0, for axes through points p with unit directions n.
    Without hinges, it is the origin of the body.

    Raises:
        NotImplementedError: the axes do not intersect in one point.
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


def turning(link: Link, axis: np.ndarray, name: str, backward: bool = False) -> Twist:
    """Returns a joint without constraint rows that measures the rotation of a link about an axis.

    Args:
        link: the link.
        axis: the axis in the world frame at assembly, (3,); fixed in the link.
        name: the name of the joint.
        backward: True to fix the axis in the parent instead; the sign of the angle is then
            reversed.
    """
    ends = (link.above, link.name)
    return Twist(name, *(ends[::-1] if backward else ends), axis=axis)


def pushing(compiled: Compiled, link: Link, axes: np.ndarray, name: str) -> Compound:
    """Returns a joint without constraint rows that measures the travel of a free link.

    Args:
        compiled: the model.
        link: the free link.
        axes: the directions of travel in the world frame, one per row, (3, 3).
        name: the name of the joint.
    """
    origin = compiled.data.xpos[link.body]
    return Compound(name, WORLD, link.name, origin, slides=(*axes,), ball=True)
