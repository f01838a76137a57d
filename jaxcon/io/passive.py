"""What acts along MuJoCo's joints: springs, dampers, rotors, dry friction and limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxcon.constraints.armature import Armature
from jaxcon.constraints.limits import JointFriction, Limit
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate, pushing, turning
from jaxcon.io.links import Link, LinkJoint
from jaxcon.model.actuators import JointDamper, JointSpring


def passive(
    compiled: Compiled, link: Link, joint: LinkJoint, at: Coordinate | None, names: Names
) -> Iterator[Any]:
    """What acts along one of MuJoCo's joints, along its coordinate or freedoms."""
    m = compiled.model
    own = compiled.name("joint", joint.id)
    rubs = not compiled.disabled("friction", "frictionloss", "constraint")
    numbers = {
        "stiffness": 0.0 if compiled.disabled("spring", "passive") else m.jnt_stiffness[joint.id],
        "damping": 0.0 if compiled.disabled("damper", "passive") else m.dof_damping[joint.v],
        "armature": m.dof_armature[joint.v],
        "friction": rubs * m.dof_frictionloss[joint.v],
    }
    if at is not None:
        rest = m.qpos_spring[joint.q] - m.qpos0[joint.q]
        yield from _along(own, at, numbers, rest, names)
        yield from _limit(compiled, joint, at, names)
    elif any(numbers.values()):
        elements, coordinates = _freedoms(compiled, link, joint, names)
        yield from elements
        for freedom in coordinates:
            yield from _along(f"{own} {freedom.name}", freedom, numbers, 0.0, names)


def _along(
    own: str, at: Coordinate, numbers: dict[str, float], rest: float, names: Names
) -> Iterator[Any]:
    """A spring with damping, or a damper, a rotor, and dry friction."""
    stiffness, damping, armature, friction = numbers.values()
    if stiffness:
        name = names.take(f"{own} spring", "spring")
        yield JointSpring(name, at.joint, stiffness, damping, rest, at.name)
    elif damping:
        yield JointDamper(names.take(f"{own} damper", "damper"), at.joint, damping, at.name)
    if armature:
        yield Armature(names.take(f"{own} rotor", "rotor"), at.joint, armature, at.name)
    if friction:
        yield JointFriction(names.take(f"{own} friction", "friction"), at.joint, friction, at.name)


def _limit(compiled: Compiled, joint: LinkJoint, at: Coordinate, names: Names) -> Iterator[Limit]:
    """The range of a hinge or slide, less its margin, within which MuJoCo's stop pushes."""
    m = compiled.model
    if compiled.disabled("limit", "constraint") or not m.jnt_limited[joint.id]:
        return
    inward = m.jnt_margin[joint.id] * np.array([1.0, -1.0])
    lower, upper = m.jnt_range[joint.id] - m.qpos0[joint.q] + inward
    name = names.take(f"{compiled.name('joint', joint.id)} limit", "limit")
    yield Limit(name, at.joint, lower, upper, at.name)


def _freedoms(compiled: Compiled, link: Link, joint: LinkJoint, names: Names) -> Any:
    """Joints without rows along the freedoms of a ball or free joint, and their coordinates."""
    own = compiled.name("joint", joint.id)
    frame = compiled.data.xmat[link.body].reshape(3, 3)
    elements = [turning(link, axis, names.take(f"{own} twist", "twist")) for axis in frame.T]
    coordinates = [Coordinate(twist.name, "twist") for twist in elements]
    if joint.kind == "free":
        push = pushing(compiled, link, np.eye(3), names.take(f"{own} push", "push"))
        elements = [push, *elements]
        coordinates = [Coordinate(push.name, f"travel_{i}") for i in (1, 2, 3)] + coordinates
    return elements, coordinates
