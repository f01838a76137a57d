"""Import of springs, dampers, rotor inertia, dry friction and limits of MuJoCo's joints.

Gravity compensation and drag of bodies are imported here, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from jaxcon.constraints.armature import Armature
from jaxcon.constraints.compound import Compound
from jaxcon.constraints.measures import RotationAngle
from jaxcon.constraints.pairs import Twist
from jaxcon.contact.limits import JointFriction, Limit
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate, pushing, turning
from jaxcon.io.links import Link, LinkJoint, scene_body
from jaxcon.system.actuators import JointDamper, JointSpring
from jaxcon.system.fluid import FluidDrag
from jaxcon.system.forces import Force
from jaxcon.system.layout import WORLD

SMALLEST = 1e-15
"""MuJoCo's mjMINVAL: lighter bodies have no drag, and squares of sizes are at least as large."""
Joint: TypeAlias = Compound | Twist | RotationAngle
Element: TypeAlias = JointSpring | JointDamper | Armature | JointFriction | Limit | Joint
"""A scene element: a passive element, or a joint without constraint rows.

Such a joint defines the coordinate on which passive elements act.
"""


def passive(
    compiled: Compiled, link: Link, joint: LinkJoint, at: Coordinate | None, names: Names
) -> Iterator[Element]:
    """Yields the passive elements of one of MuJoCo's joints.

    Args:
        compiled: the model.
        link: the link with the joint.
        joint: the joint.
        at: the scene coordinate of a hinge or slide. None for a ball or free joint, which gets
            elements along each degree of freedom.
        names: the names in the scene.
    """
    m = compiled.model
    label = compiled.name("joint", joint.id)
    rubs = not compiled.disabled("friction", "frictionloss", "constraint")
    numbers = {
        "stiffness": 0.0 if compiled.disabled("spring", "passive") else m.jnt_stiffness[joint.id],
        "damping": 0.0 if compiled.disabled("damper", "passive") else m.dof_damping[joint.v],
        "armature": m.dof_armature[joint.v],
        "friction": rubs * m.dof_frictionloss[joint.v],
    }
    if at is not None:
        rest = m.qpos_spring[joint.q] - m.qpos0[joint.q]
        yield from _along(label, at, numbers, rest, names)
        yield from _limit(compiled, joint, at, names)
        return
    if joint.kind == "ball":
        yield from _ball_limit(compiled, link, joint, names)
    if any(numbers.values()):
        elements, coordinates = _freedoms(compiled, link, joint, names)
        yield from elements
        for freedom in coordinates:
            yield from _along(f"{label} {freedom.name}", freedom, numbers, 0.0, names)


def gravity_compensation(
    compiled: Compiled, links: tuple[Link, ...], names: Names
) -> Iterator[Force]:
    """Yields the force −c m g at the center of mass of each body with gravity compensation c.

    m is the mass of the body and g the gravitational acceleration. MuJoCo applies no compensation
    if both springs and dampers are disabled.
    """
    m = compiled.model
    if compiled.disabled("gravity", "gravcomp") or not has_passive_forces(compiled):
        return
    for body in map(int, np.flatnonzero(m.body_gravcomp)):
        link = scene_body(compiled, links, body)
        if link != WORLD:
            name = names.take(f"{compiled.name('body', body)} gravcomp", "force")
            force = -m.body_gravcomp[body] * m.body_mass[body] * m.opt.gravity
            yield Force(name, link, force, compiled.data.xipos[body])


def has_passive_forces(compiled: Compiled) -> bool:
    """Returns False if springs and dampers are disabled; MuJoCo then has no passive forces."""
    return not (compiled.disabled("spring") and compiled.disabled("damper"))


def fluid_drag(compiled: Compiled, links: tuple[Link, ...], names: Names) -> Iterator[FluidDrag]:
    """Yields the drag of the fluid on the inertia box of each body.

    The box has the mass and the inertia of the body: bᵢ² = 6 (Iⱼ + Iₖ − Iᵢ)/m.
    """
    m = compiled.model
    fluid = m.opt.density, m.opt.viscosity
    if not any(fluid) or compiled.disabled("fluid") or not has_passive_forces(compiled):
        return
    for body in range(1, m.nbody):
        link, mass = scene_body(compiled, links, body), m.body_mass[body]
        if link == WORLD or mass < SMALLEST:
            continue
        moments = m.body_inertia[body]
        squares = np.maximum(moments.sum() - 2 * moments, SMALLEST) * 6 / mass
        turn = np.zeros(4)
        compiled.mujoco.mju_mat2Quat(turn, compiled.data.ximat[body])
        yield FluidDrag(
            names.take(f"{compiled.name('body', body)} drag", "force"),
            link,
            np.sqrt(squares),
            *fluid,
            wind=m.opt.wind,
            point=compiled.data.xipos[body],
            orientation=turn,
        )


def _along(
    label: str, at: Coordinate, numbers: dict[str, float], rest: float, names: Names
) -> Iterator[Element]:
    """Yields the nonzero elements of one coordinate: spring, damper, rotor and dry friction.

    Args:
        label: the name of the joint, for the names of the elements.
        at: the coordinate.
        numbers: stiffness, damping, armature and friction, in this order.
        rest: the coordinate at which the spring is relaxed.
        names: the names in the scene.
    """
    stiffness, damping, armature, friction = numbers.values()
    if stiffness:
        name = names.take(f"{label} spring", "spring")
        yield JointSpring(name, at.joint, stiffness, damping, rest, at.name)
    elif damping:
        yield JointDamper(names.take(f"{label} damper", "damper"), at.joint, damping, at.name)
    if armature:
        yield Armature(names.take(f"{label} rotor", "rotor"), at.joint, armature, at.name)
    if friction:
        yield JointFriction(
            names.take(f"{label} friction", "friction"), at.joint, friction, at.name
        )


def _limit(compiled: Compiled, joint: LinkJoint, at: Coordinate, names: Names) -> Iterator[Limit]:
    """Yields the limit of a hinge or slide, if it has one.

    The range of the scene's hard limit is smaller by MuJoCo's margin at both ends, since MuJoCo's
    soft limit begins to push there.
    """
    m = compiled.model
    if compiled.disabled("limit", "constraint") or not m.jnt_limited[joint.id]:
        return
    inward = m.jnt_margin[joint.id] * np.array([1.0, -1.0])
    lower, upper = m.jnt_range[joint.id] - m.qpos0[joint.q] + inward
    name = names.take(f"{compiled.name('joint', joint.id)} limit", "limit", "joint limit")
    yield Limit(name, at.joint, lower, upper, at.name)


def _ball_limit(
    compiled: Compiled, link: Link, joint: LinkJoint, names: Names
) -> Iterator[RotationAngle | Limit]:
    """Yields the limit of the rotation angle of a ball joint, if it has one, and its coordinate."""
    m, label = compiled.model, compiled.name("joint", joint.id)
    if compiled.disabled("limit", "ball_limit", "constraint") or not m.jnt_limited[joint.id]:
        return
    name = names.take(f"{label} angle", "angle")
    yield RotationAngle(name, link.above, link.name, compiled.data.xanchor[joint.id])
    upper = m.jnt_range[joint.id].max() - m.jnt_margin[joint.id]
    yield Limit(names.take(f"{label} limit", "limit", "joint limit"), name, upper=upper)


def _freedoms(
    compiled: Compiled, link: Link, joint: LinkJoint, names: Names
) -> tuple[list[Compound | Twist], list[Coordinate]]:
    """Builds coordinates for the degrees of freedom of a ball or free joint.

    Returns:
        Joints without constraint rows that define the coordinates, and the coordinates.
    """
    label = compiled.name("joint", joint.id)
    frame = compiled.data.xmat[link.body].reshape(3, 3)
    twists = [turning(link, axis, names.take(f"{label} twist", "twist")) for axis in frame.T]
    angles = [Coordinate(twist.name, "twist") for twist in twists]
    if joint.kind != "free":
        return [*twists], angles
    push = pushing(compiled, link, np.eye(3), names.take(f"{label} push", "push"))
    travels = [Coordinate(push.name, f"travel_{i}") for i in (1, 2, 3)]
    return [push, *twists], travels + angles
