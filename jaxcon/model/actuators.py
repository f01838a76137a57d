"""What acts along the coordinates of joints: springs, dampers, motors and servos.

Each class describes one element for the user. With l = g θ, the joint's coordinate θ geared by g,
its static `force` is what many of them exert along l, lane by lane; along θ it is g times as much.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector, take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.model.coordinates import JointCoordinate
from jaxcon.model.elements import Elements, label
from jaxcon.model.forces import Pulls


@dataclass(frozen=True)
class JointSpring:
    """A spring and damper about a joint's coordinate θ: force −k (θ − θ₀) − c θ̇.

    θ is zero at assembly; angles count whole turns.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        stiffness: k [N m/rad] or [N/m].
        damping: c [N m s/rad] or [N s/m].
        rest: θ₀ [rad] or [m].
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    stiffness: Any
    damping: Any = 0.0
    rest: Any = 0.0
    coordinate: str | None = None
    counts = True

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        params = numbers(self, dtype, "stiffness", "damping", "rest")
        return not_negative(self, params, "stiffness", "damping")

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """−k (θ − θ₀) − c θ̇."""
        return -p["stiffness"] * (value - p["rest"]) - p["damping"] * rate

    @staticmethod
    def potential(p: dict[str, Any], value: Lane) -> Lane:
        """½ k (θ − θ₀)²."""
        return p["stiffness"] * (value - p["rest"]) ** 2 / 2


@dataclass(frozen=True)
class JointDamper:
    """Viscous friction about a joint's coordinate: force −c θ̇.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        damping: c [N m s/rad] or [N s/m].
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    damping: Any
    coordinate: str | None = None
    counts = False

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return not_negative(self, numbers(self, dtype, "damping"), "damping")

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """−c θ̇."""
        return -p["damping"] * rate


@dataclass(frozen=True)
class Motor:
    """A force or torque as control: g clip(u) along a joint's coordinate.

    Attributes:
        name: unique in the scene; also that of the control channel, of one number u.
        joint: name of the joint.
        gear: g, the force on the joint is g times that of the motor.
        control_range: (lowest, highest) u that is obeyed; all unless given.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    gear: Any = 1.0
    control_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = False

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return numbers(self, dtype, "gear") | ranges(self, dtype, "control_range")

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """u."""
        return u


@dataclass(frozen=True)
class PositionServo:
    """A servo that follows a position: k (clip(u) − l) − c l̇ with l = g θ; angles count turns.

    Attributes:
        name: unique in the scene; also that of the control channel: u is the position wanted.
        joint: name of the joint.
        stiffness: k [N m/rad] or [N/m].
        damping: c [N m s/rad] or [N s/m].
        gear: g.
        control_range: (lowest, highest) u that is obeyed; all unless given.
        force_range: (lowest, highest) force, before gear; any unless given.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    stiffness: Any
    damping: Any = 0.0
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = True

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        params = numbers(self, dtype, "stiffness", "damping", "gear")
        not_negative(self, params, "stiffness", "damping")
        return params | ranges(self, dtype, "control_range", "force_range")

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """k (u − l) − c l̇."""
        return p["stiffness"] * (u - value) - p["damping"] * rate


@dataclass(frozen=True)
class VelocityServo:
    """A servo that follows a velocity: c (clip(u) − l̇) with l = g θ.

    Attributes:
        name: unique in the scene; also that of the control channel: u is the velocity wanted.
        joint: name of the joint.
        damping: c [N m s/rad] or [N s/m].
        gear: g.
        control_range: (lowest, highest) u that is obeyed; all unless given.
        force_range: (lowest, highest) force, before gear; any unless given.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    damping: Any
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = False

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        params = not_negative(self, numbers(self, dtype, "damping", "gear"), "damping")
        return params | ranges(self, dtype, "control_range", "force_range")

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """c (u − l̇)."""
        return p["damping"] * (u - rate)


@dataclass(frozen=True)
class AffineActuator:
    """Any affine law: (g₀ + g₁ l + g₂ l̇) clip(u) + b₀ + b₁ l + b₂ l̇ with l = g θ over turns.

    Attributes:
        name: unique in the scene; also that of the control channel, of one number u.
        joint: name of the joint.
        gain: (g₀, g₁, g₂).
        bias: (b₀, b₁, b₂).
        gear: g.
        control_range: (lowest, highest) u that is obeyed; all unless given.
        force_range: (lowest, highest) force, before gear; any unless given.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    gain: Any = (1.0, 0.0, 0.0)
    bias: Any = (0.0, 0.0, 0.0)
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = True

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        laws = numbers(self, dtype, "gain", "bias", shape=(3,))
        limits = ranges(self, dtype, "control_range", "force_range")
        return laws | numbers(self, dtype, "gear") | limits

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """(g₀ + g₁ l + g₂ l̇) u + b₀ + b₁ l + b₂ l̇."""
        at = Vector(1.0, value, rate)
        return p["gain"].dot(at) * u + p["bias"].dot(at)


@pytree
class JointForces(Elements):
    """Forces of one class, `law`, along one coordinate of joints of one group."""

    law: Any = static(default=None)
    along: JointCoordinate = static(default=None)  # type: ignore[assignment]
    starts: tuple[int, ...] = static(default=())

    def pulls(self, snapshot: Any, control: Any) -> Pulls:
        """The generalized forces on the bodies of each side; without control, u = 0."""
        coordinate = self.along.read(snapshot)
        u: Lane = 0.0
        if self.starts and control is not None:
            u = clip(self.params, "control_range", take(control, self.starts))
        gear = self.params.get("gear", 1.0)
        force = self.law.force(self.params, u, gear * coordinate.value, gear * coordinate.rate)
        force = gear * clip(self.params, "force_range", force)
        return [(p, pull * force) for p, pull in zip(self.places, coordinate.pulls, strict=True)]

    def potential(self, snapshot: Any) -> Iterable[Lane]:
        """The energy stored in each element [J]."""
        if not hasattr(self.law, "potential"):
            return ()
        return (self.law.potential(self.params, self.along.read(snapshot).value),)


def clip(p: dict[str, Any], field: str, x: Lane) -> Lane:
    """x within the range of this name, where there is one."""
    if field not in p:
        return x
    lowest, highest = p[field]
    return jnp.clip(x, lowest, highest)


def numbers(
    element: Any, dtype: Any, *fields: str, shape: tuple[int, ...] = ()
) -> dict[str, Array]:
    """Fields of an element as finite numbers of one shape."""
    owner = label(element)
    return {f: checks.real(owner, f, getattr(element, f), dtype, shape) for f in fields}


def not_negative(element: Any, params: dict[str, Array], *fields: str) -> dict[str, Array]:
    """The numbers, checked.

    Raises:
        ValueError: one of these fields is negative.
    """
    for field in fields:
        checks.check(label(element), field, params[field], least=0)
    return params


def ranges(element: Any, dtype: Any, *fields: str) -> dict[str, Array]:
    """The ranges (2,) that an element has.

    Raises:
        ValueError: a range of another shape, or whose lower end lies above the upper.
    """
    given = {f: getattr(element, f) for f in fields if getattr(element, f) is not None}
    result = {f: checks.real(label(element), f, x, dtype, (2,)) for f, x in given.items()}
    for field, x in result.items():
        if checks.is_concrete(x) and not x[0] <= x[1]:
            raise ValueError(
                f"{label(element)}: {field} must be (lowest, highest), got {checks.numerals(x)}."
            )
    return result
