"""Actuators of MuJoCo's on joints, each one control channel, in the order of its controls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxcon.core import checks
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate, pushing, turning
from jaxcon.io.links import Link, LinkJoint
from jaxcon.model.actuators import AffineActuator, Motor


class Transmission(NamedTuple):
    """How an actuator acts on a coordinate θ = qpos − reference.

    Attributes:
        at: the coordinate.
        gear: g.
        reference: qpos at assembly.
        measured: whether the length g qpos counts; that of a free joint is zero.
    """

    at: Coordinate
    gear: float
    reference: float = 0.0
    measured: bool = True


LAWS = (
    ("trntype", "mjtTrn", ("joint", "jointinparent")),
    ("dyntype", "mjtDyn", ("none",)),
    ("gaintype", "mjtGain", ("fixed", "affine")),
    ("biastype", "mjtBias", ("none", "affine")),
)
"""What is supported of transmission, dynamics, gain and bias."""


def actuators(
    compiled: Compiled,
    links: tuple[Link, ...],
    coordinates: dict[int, Coordinate],
    names: Names,
) -> Iterator[Any]:
    """The elements of all actuators.

    Raises:
        NotImplementedError: one of them is of a kind that is not supported.
    """
    m = compiled.model
    joints = {joint.id: (link, joint) for link in links for joint in link.joints}
    for i in range(m.nu):
        _check(compiled, i)
        link, joint = joints[int(m.actuator_trnid[i, 0])]
        name = names.take(compiled.name("actuator", i), "actuator")
        if joint.id in coordinates:
            gear, reference = float(m.actuator_gear[i, 0]), float(m.qpos0[joint.q])
            transmission = Transmission(coordinates[joint.id], gear, reference)
        else:
            element, transmission = _vector(compiled, i, link, joint, names)
            yield element
        yield _law(compiled, i, name, transmission)


def _check(compiled: Compiled, i: int) -> None:
    """Checks that an actuator is of a supported kind.

    Raises:
        NotImplementedError: it is not.
    """
    m = compiled.model
    for field, enum, known in LAWS:
        found = compiled.choice(enum, getattr(m, f"actuator_{field}")[i])
        if found not in known:
            raise NotImplementedError(
                f"from_mjcf: actuator '{compiled.name('actuator', i)}' has the {field} '{found}';"
                f" supported are {list(known)}."
            )


def _law(compiled: Compiled, i: int, name: str, transmission: Transmission) -> Any:
    """(g₀ + g₁ l + g₂ l̇) u + b₀ + b₁ l + b₂ l̇ with the length l = g θ + g reference."""
    at, gear, reference, measured = transmission
    m = compiled.model
    gain, bias = m.actuator_gainprm[i, :3].copy(), m.actuator_biasprm[i, :3].copy()
    gain[1:] *= compiled.choice("mjtGain", m.actuator_gaintype[i]) == "affine"
    bias *= compiled.choice("mjtBias", m.actuator_biastype[i]) == "affine"
    for law in (gain, bias):
        law[0] += law[1] * gear * reference
        law[1] *= measured
    obeyed = m.actuator_ctrllimited[i] and not compiled.disabled("clampctrl")
    control = m.actuator_ctrlrange[i] if obeyed else None
    force = _force_range(compiled, i, gear)
    if not gain[1:].any() and not bias.any() and force is None:
        return Motor(name, at.joint, gear * gain[0], control, at.name)
    return AffineActuator(name, at.joint, gain, bias, gear, control, force, at.name)


def _force_range(compiled: Compiled, i: int, gear: float) -> np.ndarray | None:
    """Returns the force that passes both the actuator's range and its joint's, before gear.

    Raises:
        NotImplementedError: the joint limits the sum of several actuators.
    """
    m, joint = compiled.model, int(compiled.model.actuator_trnid[i, 0])
    own = m.actuator_forcerange[i] if m.actuator_forcelimited[i] else None
    if not m.jnt_actfrclimited[joint] or not gear:
        return own
    at_joint = [_acts_on(compiled, k, joint) for k in range(m.nu)]
    if sum(at_joint) > 1:
        raise NotImplementedError(
            f"from_mjcf: joint '{compiled.name('joint', joint)}' has an actuatorfrcrange and"
            f" {sum(at_joint)} actuators, whose sum it limits; give each a forcerange instead."
        )
    joints = np.sort(m.jnt_actfrcrange[joint] / gear)
    return joints if own is None else np.clip(own, *joints)


def _acts_on(compiled: Compiled, i: int, joint: int) -> bool:
    """Returns True where an actuator acts on a joint."""
    m = compiled.model
    kind = compiled.choice("mjtTrn", m.actuator_trntype[i])
    return kind in ("joint", "jointinparent") and int(m.actuator_trnid[i, 0]) == joint


def _vector(
    compiled: Compiled, i: int, link: Link, joint: LinkJoint, names: Names
) -> tuple[Any, Transmission]:
    """A joint without rows along the gear of a ball or free joint, and ‖gear‖ along it.

    Raises:
        NotImplementedError: the gear has both a force and a torque.
    """
    own, gear = compiled.name("actuator", i), compiled.model.actuator_gear[i]
    force, torque = (gear[:3], gear[3:]) if joint.kind == "free" else (np.zeros(3), gear[:3])
    if force.any() and torque.any():
        raise NotImplementedError(
            f"from_mjcf: actuator '{own}' has a gear with a force and a"
            f" torque, {checks.numerals(gear)}; give each an actuator of its own."
        )
    axis = force if force.any() else torque
    size = float(np.linalg.norm(axis))
    axis = axis / size if size else np.array([1.0, 0.0, 0.0])
    if force.any():
        axes = np.linalg.svd(axis[None])[2]
        axes[0] = axis
        push = pushing(compiled, link, axes, names.take(f"{own} push", "push"))
        return push, Transmission(Coordinate(push.name, "travel_1"), size, measured=False)
    in_parent = compiled.choice("mjtTrn", compiled.model.actuator_trntype[i]) == "jointinparent"
    frame = compiled.data.xmat[link.body].reshape(3, 3)
    world = axis if in_parent and joint.kind == "free" else frame @ axis
    twist = turning(link, world, names.take(f"{own} twist", "twist"), backward=in_parent)
    at, sign = Coordinate(twist.name, "twist"), -1 if in_parent else 1
    return twist, Transmission(at, sign * size, measured=joint.kind == "ball")
