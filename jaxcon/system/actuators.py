"""Forces along the coordinates of joints: springs, dampers, motors and servos.

Each class describes one element for the user. A gear g scales the joint's coordinate θ to the
coordinate l = g θ of the actuator. The static method `force` computes the forces of many elements
along l, as lanes (element, …). The force along θ is g times as large.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector, take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.system.coordinates import JointCoordinate, OnJoint
from jaxcon.system.elements import Elements, Named, label
from jaxcon.system.forces import Pulls

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import Row
    from jaxcon.system.body_system import Snapshot

SHAPES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("stiffness", "damping", "rest", "gear", "lower", "upper"), ()),
    **dict.fromkeys(("gain", "bias"), (3,)),
    **dict.fromkeys(("control_range", "force_range", "length_range", "working_range"), (2,)),
    **dict.fromkeys(("max_force", "length", "shortest", "longest", "fastest"), ()),
    **dict.fromkeys(("passive", "lengthening"), ()),
}
"""The shapes of the numeric fields of elements, by field name."""


@dataclass(frozen=True)
class JointForce(OnJoint):
    """The base class of forces along a joint's coordinate; `SHAPES` lists their numeric fields.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
    """

    name: str
    joint: str
    ranges = MappingProxyType(dict.fromkeys(("stiffness", "damping"), checks.NumberRange(least=0)))

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the numbers of the element by field, without ranges that are None.

        Raises:
            ValueError: a wrong shape, or a number that is not finite.
        """
        return {
            field: checks.real(label(self), field, x, dtype, SHAPES[field])
            for field, x in vars(self).items()
            if field in SHAPES and not (x is None and field.endswith("range"))
        }

    @classmethod
    def check_numbers(cls, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks that stiffness and damping are not negative, and that ranges are not reversed.

        Args:
            owner: first words of errors.
            numbers: the numbers by field.
            dtype: dtype of the scene.

        Raises:
            ValueError: a number is negative, or the lower end of a range is above its upper end.
        """
        super().check_numbers(owner, numbers, dtype)
        for field in ("control_range", "force_range"):
            x = numbers.get(field)
            if x is not None and checks.is_concrete(x) and not x[0] <= x[1]:
                raise ValueError(
                    f"{owner}: {field} must be (lowest, highest), got {checks.numerals(x)}."
                )


@dataclass(frozen=True)
class JointSpring(JointForce):
    """A spring and damper about a joint's coordinate θ: force −k (θ − θ₀) − c θ̇.

    θ is zero at assembly; angles count whole turns.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        stiffness: k [N m/rad] or [N/m].
        damping: c [N m s/rad] or [N s/m].
        rest: rest position θ₀ [rad] or [m].
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    stiffness: Any
    damping: Any = 0.0
    rest: Any = 0.0
    coordinate: str | None = None

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force −k (θ − θ₀) − c θ̇ along the joint's coordinate θ.

        Args:
            p: the numbers of the elements, by field.
            u: unused.
            value: θ.
            rate: θ̇.
        """
        return -p["stiffness"] * (value - p["rest"]) - p["damping"] * rate

    @staticmethod
    def potential(p: dict[str, Any], value: Lane) -> Lane:
        """Returns the energy ½ k (θ − θ₀)² of the spring at the coordinate θ [J]."""
        return p["stiffness"] * (value - p["rest"]) ** 2 / 2


@dataclass(frozen=True)
class DeadBandSpring(JointForce):
    """A spring that is slack between two positions, and a damper about a joint's coordinate θ.

    The force is −k (θ − clip(θ, lower, upper)) − c θ̇. θ is zero at assembly; angles count whole
    turns.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        stiffness: k [N m/rad] or [N/m].
        lower, upper: the positions between which the spring is slack [rad] or [m].
        damping: c [N m s/rad] or [N s/m].
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    stiffness: Any
    lower: Any
    upper: Any
    damping: Any = 0.0
    coordinate: str | None = None

    @classmethod
    def check_numbers(cls, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks that stiffness and damping are not negative, and that lower ≤ upper.

        Args:
            owner: first words of errors.
            numbers: the numbers by field.
            dtype: dtype of the scene.

        Raises:
            ValueError: a number is out of range.
        """
        super().check_numbers(owner, numbers, dtype)
        lower, upper = numbers["lower"], numbers["upper"]
        if checks.is_concrete((lower, upper)) and not lower <= upper:
            raise ValueError(
                f"{owner}: lower must not be above upper, got {checks.numerals(lower)} and"
                f" {checks.numerals(upper)}."
            )

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force −k (θ − clip(θ, lower, upper)) − c θ̇ along the joint's coordinate θ.

        Args:
            p: the numbers of the elements, by field.
            u: unused.
            value: θ.
            rate: θ̇.
        """
        return -p["stiffness"] * _beyond(p, value) - p["damping"] * rate

    @staticmethod
    def potential(p: dict[str, Any], value: Lane) -> Lane:
        """Returns the energy ½ k (θ − clip(θ, lower, upper))² at the coordinate θ [J]."""
        return p["stiffness"] * _beyond(p, value) ** 2 / 2


def _beyond(p: dict[str, Any], value: Lane) -> Lane:
    """Returns how far θ lies beyond the dead band, θ − clip(θ, lower, upper)."""
    return value - jnp.clip(value, p["lower"], p["upper"])


@dataclass(frozen=True)
class JointDamper(JointForce):
    """Viscous friction about a joint's coordinate θ: force −c θ̇.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        damping: c [N m s/rad] or [N s/m].
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    damping: Any
    coordinate: str | None = None
    counts = False

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the damping force −c θ̇ along the joint's coordinate θ.

        Args:
            p: the numbers of the elements, by field.
            u: unused.
            value: unused.
            rate: θ̇.
        """
        return -p["damping"] * rate


@dataclass(frozen=True)
class Motor(JointForce):
    """A force or torque g clip(u) along a joint's coordinate, with control input u.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, one
            number u.
        joint: name of the joint.
        gear: gear ratio g; the force on the joint is g times the force of the motor.
        control_range: (lowest, highest) u; u is clipped to this range. None for no limit.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    gear: Any = 1.0
    control_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = False

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force of the motor: the clipped control input u.

        Args:
            p: the numbers of the elements, by field.
            u: the control input.
            value: unused.
            rate: unused.
        """
        return u


@dataclass(frozen=True)
class PositionServo(JointForce):
    """A servo that follows a position: force k (clip(u) − l) − c l̇ along l = g θ.

    θ is the joint's coordinate; angles count whole turns.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, the
            target position u.
        joint: name of the joint.
        stiffness: k [N m/rad] or [N/m].
        damping: c [N m s/rad] or [N s/m].
        gear: gear ratio g.
        control_range: (lowest, highest) u; u is clipped to this range. None for no limit.
        force_range: (lowest, highest) force before gearing; the force is clipped to this range.
            None for no limit.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    stiffness: Any
    damping: Any = 0.0
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force k (u − l) − c l̇ along the geared coordinate l.

        Args:
            p: the numbers of the elements, by field.
            u: the target position.
            value: l.
            rate: l̇.
        """
        return p["stiffness"] * (u - value) - p["damping"] * rate


@dataclass(frozen=True)
class VelocityServo(JointForce):
    """A servo that follows a velocity: force c (clip(u) − l̇) along l = g θ.

    θ is the joint's coordinate.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, the
            target velocity u.
        joint: name of the joint.
        damping: c [N m s/rad] or [N s/m].
        gear: gear ratio g.
        control_range: (lowest, highest) u; u is clipped to this range. None for no limit.
        force_range: (lowest, highest) force before gearing; the force is clipped to this range.
            None for no limit.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    damping: Any
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1
    counts = False

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force c (u − l̇) along the geared coordinate l.

        Args:
            p: the numbers of the elements, by field.
            u: the target velocity.
            value: unused.
            rate: l̇.
        """
        return p["damping"] * (u - rate)


@dataclass(frozen=True)
class AffineActuator(JointForce):
    """An actuator with the force (g₀ + g₁ l + g₂ l̇) clip(u) + b₀ + b₁ l + b₂ l̇ along l = g θ.

    θ is the joint's coordinate; angles count whole turns.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, one
            number u.
        joint: name of the joint.
        gain: (g₀, g₁, g₂).
        bias: (b₀, b₁, b₂).
        gear: gear ratio g.
        control_range: (lowest, highest) u; u is clipped to this range. None for no limit.
        force_range: (lowest, highest) force before gearing; the force is clipped to this range.
            None for no limit.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    gain: Any = (1.0, 0.0, 0.0)
    bias: Any = (0.0, 0.0, 0.0)
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force (g₀ + g₁ l + g₂ l̇) u + b₀ + b₁ l + b₂ l̇ along the coordinate l.

        Args:
            p: the numbers of the elements, by field.
            u: the control input.
            value: l.
            rate: l̇.
        """
        at = Vector(1.0, value, rate)
        return p["gain"].dot(at) * u + p["bias"].dot(at)


@dataclass(frozen=True)
class Muscle(JointForce):
    """A muscle along l = g θ + l₀, with the force −F (f_L(L) f_V(V) clip(u) + f_P(L)).

    u is the activation, usually in [0, 1]. Positive forces of the muscle shorten it, so they act
    along −l. L and V are the length and rate in units of the length L₀ of largest force:

        L = a + (l − l_a)/L₀,   V = l̇/(L₀ v),   L₀ = (l_b − l_a)/(b − a),

    for the working range (a, b), the length range (l_a, l_b) and the fastest rate v. f_L is a bell
    of parabolas between the shortest and the longest L, with f_L(1) = 1. f_V rises from 0 at V = −1
    to f_V(0) = 1 and to its largest value under lengthening. f_P is the passive force of a
    stretched muscle, 0 up to L = 1.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, the
            activation u.
        joint: name of the joint or tendon.
        max_force: F, the active force at L = 1 and V = 0 [N].
        length: l₀, the length at assembly [m].
        length_range: (l_a, l_b), the lengths at which L is a and b [m].
        working_range: (a, b).
        shortest, longest: the L between which the muscle has an active force.
        fastest: v, the rate of shortening without a force, in L₀ per second [1/s].
        passive: f_P at L = (1 + longest)/2, times 2.
        lengthening: the largest f_V.
        gear: gear ratio g.
        control_range: (lowest, highest) u; u is clipped to this range. None for no limit.
        force_range: (lowest, highest) force before gearing; the force is clipped to this range.
            None for no limit.
        coordinate: name of the joint's coordinate; needed if the joint has several.

    References:
        MuJoCo documentation, Modeling, Muscles.
    """

    max_force: Any
    length: Any
    length_range: Any
    working_range: Any = (0.75, 1.05)
    shortest: Any = 0.5
    longest: Any = 1.6
    fastest: Any = 1.5
    passive: Any = 1.3
    lengthening: Any = 1.2
    gear: Any = 1.0
    control_range: Any = None
    force_range: Any = None
    coordinate: str | None = None
    controls = 1
    ranges = MappingProxyType(
        {
            **dict.fromkeys(("max_force", "passive"), checks.NumberRange(least=0)),
            **dict.fromkeys(("shortest", "fastest"), checks.NumberRange(above=0)),
            **dict.fromkeys(("longest", "lengthening"), checks.NumberRange(above=1)),
        }
    )

    @classmethod
    def check_numbers(cls, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks the ranges of the numbers; the length and working ranges must not be empty.

        Args:
            owner: first words of errors.
            numbers: the numbers by field.
            dtype: dtype of the scene.

        Raises:
            ValueError: a number is out of range.
        """
        super().check_numbers(owner, numbers, dtype)
        for field in ("length_range", "working_range"):
            x = numbers[field]
            if checks.is_concrete(x) and not x[0] < x[1]:
                raise ValueError(
                    f"{owner}: {field} must be (smaller, larger), got {checks.numerals(x)}."
                )

    @staticmethod
    def force(p: dict[str, Any], u: Lane, value: Lane, rate: Lane) -> Lane:
        """Returns the force −F (f_L(L) f_V(V) u + f_P(L)) along the geared coordinate l.

        Args:
            p: the numbers of the elements, by field.
            u: the activation.
            value: l − l₀.
            rate: l̇.
        """
        (low, high), (a, b) = p["length_range"], p["working_range"]
        unit = (high - low) / (b - a)
        length = a + (value + p["length"] - low) / unit
        speed = rate / (unit * p["fastest"])
        active = bell(length, p["shortest"], p["longest"]) * by_rate(speed, p["lengthening"])
        middle = (1 + p["longest"]) / 2
        stretch = (length - 1) / (middle - 1)
        passive = jnp.where(stretch <= 1, stretch**2 / 2, stretch - 0.5)
        passive = p["passive"] * jnp.where(stretch > 0, passive, 0)
        return -p["max_force"] * (active * u + passive)


def bell(length: Lane, shortest: Lane, longest: Lane) -> Lane:
    """Returns f_L of a `Muscle`: parabolas from 0 at the shortest L by 1 at L = 1 to 0 again."""
    below = length < 1
    reach = jnp.where(below, 1 - shortest, longest - 1) / 2
    x = jnp.abs(length - 1) / reach
    return jnp.where(x <= 1, 1 - x**2 / 2, jnp.where(x <= 2, (2 - x) ** 2 / 2, 0))


def by_rate(speed: Lane, largest: Lane) -> Lane:
    """Returns f_V of a `Muscle`: 0 up to V = −1, 1 at V = 0, and at most `largest`."""
    room = largest - 1
    shortens = jnp.where(speed <= -1, 0, (speed + 1) ** 2)
    lengthens = jnp.where(speed <= room, largest - (room - speed) ** 2 / room, largest)
    return jnp.where(speed <= 0, shortens, lengthens)


@pytree
class JointForces(Elements):
    """A group of `JointForce` elements of one class, on the same coordinate of joints of one class.

    Attributes:
        coordinate: the joint coordinates.
        starts: the index of the control input of each element; empty without control.
    """

    coordinate: JointCoordinate = static(default=None)  # type: ignore[assignment]
    starts: tuple[int, ...] = static(default=())

    def pulls(self, snapshot: Snapshot, control: Array | None) -> Pulls:
        """Returns the generalized forces on the bodies of each side.

        If control is None, the control inputs are zero.
        """
        row = self.coordinate.read(snapshot)
        force = self.along(row, control)
        return [(p, pull * force) for p, pull in zip(self.places, row.pulls, strict=True)]

    def along(self, row: Row, control: Array | None) -> Lane:
        """Returns the forces along the coordinates θ, (element,) [N, N m].

        Args:
            row: the coordinates, from `JointCoordinate.read`.
            control: the control inputs; zero if None.
        """
        u: Lane = 0.0
        if self.starts and control is not None:
            u = clip(self.params, "control_range", take(control, self.starts))
        gear = self.params.get("gear", 1.0)
        force = self.law.force(self.params, u, gear * row.value, gear * row.rate)
        return gear * clip(self.params, "force_range", force)

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchors of the joints, world frame [m]; None without anchors."""
        return self.coordinate.anchors(snapshot)

    def potential(self, snapshot: Snapshot) -> Iterable[Lane]:
        """Returns the energy stored in each element [J]; empty for elements without an energy."""
        if self.law.potential is None:
            return ()
        return (self.law.potential(self.params, self.coordinate.read(snapshot).value),)


def clip(p: dict[str, Any], field: str, x: Lane) -> Lane:
    """Clips x to the range in a field; returns x unchanged if there is no such field."""
    if field not in p:
        return x
    lowest, highest = p[field]
    return jnp.clip(x, lowest, highest)


def numbers(
    element: Named, dtype: DType, *fields: str, shape: tuple[int, ...] = ()
) -> dict[str, Array]:
    """Returns fields of an element, checked to be finite numbers of one shape.

    Args:
        element: the element.
        dtype: dtype of the result.
        fields: names of the fields.
        shape: the shape of each field.

    Raises:
        ValueError: a field has another shape, or is not finite.
    """
    owner = label(element)
    return {f: checks.real(owner, f, getattr(element, f), dtype, shape) for f in fields}
