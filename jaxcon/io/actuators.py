"""Import of MuJoCo's actuators; each is a control channel, in the order of MuJoCo's ctrl."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from jaxcon.constraints.compound import Compound
from jaxcon.constraints.measures import Thrust
from jaxcon.constraints.pairs import Twist
from jaxcon.core import checks
from jaxcon.io.activations import DYNAMIC, SHORTEST
from jaxcon.io.compiled import Compiled, Names
from jaxcon.io.joints import Coordinate, Ends, pushing, turning
from jaxcon.io.links import Link, LinkJoint, scene_body
from jaxcon.io.tendons import joints_between, moved_joints
from jaxcon.system.actuators import AffineActuator, Motor, Muscle
from jaxcon.system.layout import WORLD


class Transmission(NamedTuple):
    """The transmission of an actuator: the coordinate on which it acts, and its gear ratio.

    Attributes:
        at: the coordinate θ, zero at assembly.
        gear: the gear ratio g.
        reference: MuJoCo's value of the coordinate at assembly, such as qpos.
        measured: True if the actuator length is g (θ + reference); False for free joints, and for
            sites without a reference site, whose actuator length is zero.
    """

    at: Coordinate
    gear: float
    reference: float = 0.0
    measured: bool = True


LAWS = (
    ("trntype", "mjtTrn", ("joint", "jointinparent", "tendon", "site")),
    ("dyntype", "mjtDyn", ("none", *DYNAMIC)),
    ("gaintype", "mjtGain", ("fixed", "affine", "muscle")),
    ("biastype", "mjtBias", ("none", "affine", "muscle")),
)
"""The supported types of transmission, dynamics, gain and bias.

Each entry has MuJoCo's field, its enumeration, and the names of the supported values.
"""

ON_JOINTS = ("joint", "jointinparent")
"""The types of transmission of actuators on joints."""
ALIGNED = 1e-9
"""The largest angle [rad] between a site and its reference site that count as aligned."""

Element: TypeAlias = Motor | AffineActuator | Muscle | Compound | Twist | Thrust
"""A scene element: an actuator, or a joint without constraint rows.

Such a joint defines the coordinate on which an actuator acts.
"""


class Actuators(NamedTuple):
    """The actuators of a model.

    Attributes:
        elements: the scene elements.
        transmissions: the transmission of each actuator, in MuJoCo's order.
    """

    elements: list[Element]
    transmissions: list[Transmission]


def actuators(
    compiled: Compiled,
    links: tuple[Link, ...],
    ends: Ends,
    names: Names,
) -> Actuators:
    """Returns the scene elements of all actuators of a model.

    Args:
        compiled: the model.
        links: the links of the model.
        ends: the scene coordinates of joints and tendons.
        names: the names in the scene.

    Raises:
        NotImplementedError: an actuator is not supported.
    """
    m, found = compiled.model, Actuators([], [])
    indices = range(len(m.actuator_trntype))
    for i in indices:
        _check(compiled, i)
    _check_joint_ranges(compiled, links)
    for i in indices:
        name = names.take(compiled.name("actuator", i), "actuator")
        kind, element = compiled.choice("mjtTrn", m.actuator_trntype[i]), None
        if kind == "site":
            element, transmission = _at_site(compiled, i, links, names)
        elif kind == "tendon":
            t, gear = int(m.actuator_trnid[i, 0]), float(m.actuator_gear[i, 0])
            transmission = Transmission(ends.tendons[t], gear, float(m.tendon_length0[t]))
        else:
            element, transmission = _on_joint(compiled, i, links, ends.joints, names)
        found.elements.extend([] if element is None else [element])
        found.elements.append(_law(compiled, i, name, transmission))
        found.transmissions.append(transmission)
    return found


def _on_joint(
    compiled: Compiled,
    i: int,
    links: tuple[Link, ...],
    coordinates: dict[int, Coordinate],
    names: Names,
) -> tuple[Compound | Twist | None, Transmission]:
    """Returns the transmission of an actuator on a joint.

    Returns:
        A joint without constraint rows for actuators on ball and free joints, otherwise None; and
        the transmission.
    """
    m = compiled.model
    joints = {joint.id: (link, joint) for link in links for joint in link.joints}
    link, joint = joints[int(m.actuator_trnid[i, 0])]
    if joint.id not in coordinates:
        return _vector(compiled, i, link, joint, names)
    gear, reference = float(m.actuator_gear[i, 0]), float(m.qpos0[joint.q])
    return None, Transmission(coordinates[joint.id], gear, reference)


def _check(compiled: Compiled, i: int) -> None:
    """Checks that an actuator has supported types of transmission, dynamics, gain and bias.

    Raises:
        NotImplementedError: a type is not supported, or only one of gain and bias is a muscle.
    """
    m = compiled.model
    label = compiled.name("actuator", i)
    if (count := int(m.actuator_actnum[i])) > 1:
        raise NotImplementedError(
            f"from_mjcf: actuator '{label}' has {count} activations; supported is one."
        )
    for field, enum, supported in LAWS:
        kind = compiled.choice(enum, getattr(m, f"actuator_{field}")[i])
        if kind not in supported:
            raise NotImplementedError(
                f"from_mjcf: actuator '{label}' has the {field} '{kind}';"
                f" supported are {list(supported)}."
            )
    laws = (
        compiled.choice("mjtGain", m.actuator_gaintype[i]),
        compiled.choice("mjtBias", m.actuator_biastype[i]),
    )
    if "muscle" in laws and laws != ("muscle", "muscle"):
        raise NotImplementedError(
            f"from_mjcf: actuator '{label}' has the gaintype '{laws[0]}' and the biastype"
            f" '{laws[1]}'; a muscle needs both."
        )


def _check_joint_ranges(compiled: Compiled, links: tuple[Link, ...]) -> None:
    """Checks that each joint with an actuatorfrcrange has one actuator, which acts on it directly.

    MuJoCo clamps the sum of all actuator forces on such a joint.

    Raises:
        NotImplementedError: several actuators act on the joint, or one by a tendon or at a site.
    """
    m = compiled.model
    limited = {int(j) for j in np.flatnonzero(m.jnt_actfrclimited)}
    if not limited:
        return
    moved = [_moved_joints(compiled, links, i) for i in range(len(m.actuator_trntype))]
    for joint in sorted(limited):
        acting = [i for i, joints in enumerate(moved) if joint in joints]
        owner = f"from_mjcf: joint '{compiled.name('joint', joint)}' has an actuatorfrcrange and"
        if len(acting) > 1:
            raise NotImplementedError(
                f"{owner} {len(acting)} actuators, whose sum it limits; give each a forcerange"
                " instead."
            )
        for i in acting:
            kind = compiled.choice("mjtTrn", m.actuator_trntype[i])
            if kind not in ON_JOINTS:
                raise NotImplementedError(
                    f"{owner} the actuator '{compiled.name('actuator', i)}', which acts on it by a"
                    f" {kind}; it limits only actuators on the joint. Give the actuator a"
                    " forcerange instead."
                )


def _moved_joints(compiled: Compiled, links: tuple[Link, ...], i: int) -> set[int]:
    """Returns MuJoCo's ids of the joints on which actuator i has a moment."""
    m, (first, second) = compiled.model, map(int, compiled.model.actuator_trnid[i])
    kind, gear = compiled.choice("mjtTrn", m.actuator_trntype[i]), m.actuator_gear[i]
    if kind == "site":
        above = 0 if second < 0 else int(m.site_bodyid[second])
        ends = int(m.site_bodyid[first]), above
        return joints_between(compiled, ends) if gear.any() else set()
    if kind == "tendon":
        return moved_joints(compiled, links, first) if gear[0] else set()
    return {first} if gear[0] else set()  # ball and free joints have no actuatorfrcrange


def _law(
    compiled: Compiled, i: int, name: str, transmission: Transmission
) -> Motor | AffineActuator | Muscle:
    """Builds actuator i with MuJoCo's force law (g₀ + g₁ l + g₂ l̇) u + b₀ + b₁ l + b₂ l̇.

    u is the control, l = g (θ + reference) the actuator length with the gear ratio g, g_i the gain
    parameters and b_i the bias parameters. The result is a `Motor` if the force is proportional to
    u and has no limits. Muscles have a law of their own.
    """
    at, gear, reference, measured = transmission
    m = compiled.model
    # the input of an actuator with an activation is the activation, which has another range
    acts = compiled.choice("mjtDyn", m.actuator_dyntype[i]) != "none"
    clamped = m.actuator_ctrllimited[i] and not compiled.disabled("clampctrl") and not acts
    control = m.actuator_ctrlrange[i] if clamped else None
    force = _force_range(compiled, i, gear)
    if compiled.choice("mjtGain", m.actuator_gaintype[i]) == "muscle":
        if not measured:
            raise NotImplementedError(
                f"from_mjcf: actuator '{compiled.name('actuator', i)}' is a muscle on a free joint"
                " or at a site without a reference site. Its length is always zero in MuJoCo, which"
                " is not supported; use a tendon."
            )
        length = gear * reference
        return _muscle(compiled, i, name, at, (gear, length), control, force)
    gain, bias = m.actuator_gainprm[i, :3].copy(), m.actuator_biasprm[i, :3].copy()
    gain[1:] *= compiled.choice("mjtGain", m.actuator_gaintype[i]) == "affine"
    bias *= compiled.choice("mjtBias", m.actuator_biastype[i]) == "affine"
    for law in (gain, bias):
        law[0] += law[1] * gear * reference
        law[1] *= measured
    if not gain[1:].any() and not bias.any() and force is None:
        return Motor(name, at.joint, gear * gain[0], control, at.name)
    return AffineActuator(name, at.joint, gain, bias, gear, control, force, at.name)


def _muscle(
    compiled: Compiled,
    i: int,
    name: str,
    at: Coordinate,
    lever: tuple[float, float],
    control: np.ndarray | None,
    force: np.ndarray | None,
) -> Muscle:
    """Builds actuator i as a muscle.

    Args:
        compiled: the model.
        i: MuJoCo's id of the actuator.
        name: the name of the element.
        at: the coordinate on which the muscle acts.
        lever: the gear ratio, and the length of the actuator at assembly.
        control: the range of the activation.
        force: the range of the force.

    Raises:
        NotImplementedError: gain and bias have different parameters.
    """
    m, parameters = compiled.model, compiled.model.actuator_gainprm[i, :9]
    passive = m.actuator_biasprm[i, :9]
    if np.any(parameters[[0, 1, 2, 3, 5]] != passive[[0, 1, 2, 3, 5]]):
        raise NotImplementedError(
            f"from_mjcf: actuator '{compiled.name('actuator', i)}' has different muscle parameters"
            " in gainprm and biasprm, which is not supported."
        )
    low, high, largest, scale, shortest, longest, fastest, _, lengthening = parameters
    if largest < 0:
        largest = scale / max(m.actuator_acc0[i], SHORTEST)
    return Muscle(
        name,
        at.joint,
        largest,
        lever[1],
        m.actuator_lengthrange[i],
        (low, high),
        shortest,
        longest,
        fastest,
        passive[7],
        lengthening,
        lever[0],
        control,
        force,
        at.name,
    )


def _force_range(compiled: Compiled, i: int, gear: float) -> np.ndarray | None:
    """Returns the force range of an actuator, (2,); None if there are no limits.

    It is the range of the actuator's force before multiplication by the gear ratio. It respects the
    limits of the actuator and of its joint or tendon.

    Raises:
        NotImplementedError: the tendon limits the sum of several actuators.
    """
    m, owner = compiled.model, int(compiled.model.actuator_trnid[i, 0])
    of_actuator = m.actuator_forcerange[i] if m.actuator_forcelimited[i] else None
    kinds = [compiled.choice("mjtTrn", kind) for kind in m.actuator_trntype]
    if kinds[i] == "site" or (not gear and kinds[i] != "tendon"):
        return of_actuator
    what, field = ("tendon", "tendon") if kinds[i] == "tendon" else ("joint", "jnt")
    if not getattr(m, f"{field}_actfrclimited")[owner]:
        return of_actuator
    beside = (np.array(kinds) == "tendon") & (m.actuator_trnid[:, 0] == owner)
    if what == "tendon" and sum(beside) > 1:
        raise NotImplementedError(
            f"from_mjcf: tendon '{compiled.name('tendon', owner)}' has an actuatorfrcrange and"
            f" {sum(beside)} actuators, whose sum it limits; give each a forcerange instead."
        )
    # MuJoCo limits a joint's force after the gear, and a tendon's force before it
    limits = np.sort(getattr(m, f"{field}_actfrcrange")[owner] / (gear if what == "joint" else 1))
    return limits if of_actuator is None else np.clip(of_actuator, *limits)


def _vector(
    compiled: Compiled, i: int, link: Link, joint: LinkJoint, names: Names
) -> tuple[Compound | Twist, Transmission]:
    """Builds the transmission of an actuator on a ball or free joint.

    The actuator acts along its gear vector, with the gear ratio ‖gear‖.

    Returns:
        A joint without constraint rows, whose coordinate lies along the gear vector, and the
        transmission on this coordinate.

    Raises:
        NotImplementedError: the gear has both a force and a torque.
    """
    label, gear = compiled.name("actuator", i), compiled.model.actuator_gear[i]
    force, torque = (gear[:3], gear[3:]) if joint.kind == "free" else (np.zeros(3), gear[:3])
    if force.any() and torque.any():
        raise NotImplementedError(
            f"from_mjcf: actuator '{label}' has a gear with a force and a"
            f" torque, {checks.numerals(gear)}; give each an actuator of its own."
        )
    axis = force if force.any() else torque
    size = float(np.linalg.norm(axis))
    axis = axis / size if size else np.array([1.0, 0.0, 0.0])
    if force.any():
        axes = np.linalg.svd(axis[None])[2]
        axes[0] = axis
        push = pushing(compiled, link, axes, names.take(f"{label} push", "push"))
        return push, Transmission(Coordinate(push.name, "travel_1"), size, measured=False)
    in_parent = compiled.choice("mjtTrn", compiled.model.actuator_trntype[i]) == "jointinparent"
    frame = compiled.data.xmat[link.body].reshape(3, 3)
    world = axis if in_parent and joint.kind == "free" else frame @ axis
    twist = turning(link, world, names.take(f"{label} twist", "twist"), backward=in_parent)
    at, sign = Coordinate(twist.name, "twist"), -1 if in_parent else 1
    return twist, Transmission(at, sign * size, measured=joint.kind == "ball")


def _at_site(
    compiled: Compiled, i: int, links: tuple[Link, ...], names: Names
) -> tuple[Compound | Twist | Thrust, Transmission]:
    """Builds the transmission of an actuator at a site.

    Without a reference site, the gear is a force and a torque in the frame of the site. With a
    reference site, the gear is a force or a torque in its frame, and the actuator length is the
    position of the site, or its rotation vector, in this frame.

    Returns:
        A joint without constraint rows, and the transmission on its coordinate.

    Raises:
        NotImplementedError: the site cannot move relative to its reference, the reference site is
            in no link that carries the site, the gear has both a force and a torque, or a torque
            depends on the rotation between sites that are not aligned at the reference pose.
    """
    m, data = compiled.model, compiled.data
    label, (site, reference) = compiled.name("actuator", i), map(int, m.actuator_trnid[i])
    owner, gear = f"from_mjcf: actuator '{label}'", m.actuator_gear[i]
    body = scene_body(compiled, links, int(m.site_bodyid[site]))
    point = data.site_xpos[site]
    above = WORLD if reference < 0 else scene_body(compiled, links, int(m.site_bodyid[reference]))
    if body == above:
        what = "world" if reference < 0 else "link of its reference site"
        raise NotImplementedError(f"{owner} is at a site that cannot move in the {what}.")
    frame = data.site_xmat[site if reference < 0 else reference].reshape(3, 3)
    force, torque = frame @ gear[:3], frame @ gear[3:]
    if reference < 0:
        thrust = Thrust(names.take(f"{label} thrust", "thrust"), WORLD, body, point, force, torque)
        return thrust, Transmission(Coordinate(thrust.name, "thrust"), 1.0, measured=False)
    parents = {link.name: link.above for link in links}
    carriers = [parents[body]]
    while carriers[-1] != WORLD:
        carriers.append(parents[carriers[-1]])
    if above not in carriers:
        raise NotImplementedError(
            f"{owner} has a reference site in the body '{above}', which does not carry the site;"
            " put the reference site into one of the bodies that do, or into the world."
        )
    if force.any() and torque.any():
        raise NotImplementedError(
            f"{owner} has a reference site and a gear with a force and a torque,"
            f" {checks.numerals(gear)}; give each an actuator of its own."
        )
    if torque.any():
        size = float(np.linalg.norm(torque))
        turned = np.zeros(3)
        turns = [np.zeros(4) for _ in range(2)]
        for turn, end in zip(turns, (site, reference), strict=True):
            compiled.mujoco.mju_mat2Quat(turn, data.site_xmat[end])
        compiled.mujoco.mju_subQuat(turned, *turns)
        if np.linalg.norm(turned) > ALIGNED and (
            m.actuator_gainprm[i, 1] or m.actuator_biasprm[i, 1]
        ):
            raise NotImplementedError(
                f"{owner} has a torque that depends on the rotation from its reference site to its"
                f" site, which are turned by {np.linalg.norm(turned):.3g} rad in the reference"
                " pose; align them there."
            )
        name = names.take(f"{label} twist", "twist")
        twist = Twist(name, body, above, axis=torque / size)  # the axis turns with `above`
        return twist, Transmission(Coordinate(name, "twist"), -size)
    size = float(np.linalg.norm(force))
    axes = np.linalg.svd(force[None])[2] if size else np.eye(3)
    axes[0] = force / size if size else axes[0]
    name = names.take(f"{label} push", "push")
    push = Compound(name, above, body, point, slides=(*axes,), ball=True)
    distance = float(axes[0] @ (point - data.site_xpos[reference]))
    return push, Transmission(Coordinate(name, "travel_1"), size, distance)
