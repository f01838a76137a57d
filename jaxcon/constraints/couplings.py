"""Couplings between the coordinates of joints: gears, racks, differentials, cams, pulleys.

A coupling is a relation φ(θ₁, …, θₖ) = 0 between joint coordinates θᵢ. Its row is

    φ̇ = Σ sᵢ θ̇ᵢ,   J = Σ sᵢ Jᵢ,   γ = Σ sᵢ γᵢ + θ̇ᵀ H θ̇,   s = ∇φ, H = ∇²φ,

so a coupling needs only the value, rate, bias and pulls (∂θ̇ᵢ/∂v by body) of each coordinate.
Coordinates are zero at assembly, so couplings hold there. Angles count whole turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled
from jaxcon.core.lanes import total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.protocols import Constraint
from jaxcon.system.actuators import numbers
from jaxcon.system.coordinates import JointCoordinate, OnCoordinates
from jaxcon.system.elements import Elements, label

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


class Relation(NamedTuple):
    """A relation φ(θ) = 0 between joint coordinates θ, and its derivatives.

    Attributes:
        value: φ.
        slopes: s = ∇φ, one entry for each coordinate.
        curvature: θ̇ᵀ ∇²φ θ̇.
    """

    value: Lane
    slopes: tuple[Lane, ...]
    curvature: Lane = 0.0


class Coupling(OnCoordinates):
    """The base class of relations between joint coordinates.

    The static method `relation` returns φ and its derivatives as a `Relation`.
    """

    linear: ClassVar[bool] = True
    """True if φ is a linear combination of the coordinates."""


class Pair(Coupling):
    """The base class of couplings between two joint coordinates; subclasses define the relation."""

    joint_a: str
    joint_b: str
    coordinate_a: str | None
    coordinate_b: str | None
    nonzero = ("ratio", "radius", "radius_a", "radius_b", "parts")

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the coupled joints, each with the name of its coordinate."""
        return ((self.joint_a, self.coordinate_a), (self.joint_b, self.coordinate_b))

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the numeric fields of the element as checked arrays.

        Raises:
            ValueError: a number is not finite.
        """
        return numbers(self, dtype, *(field for field in self.nonzero if field in vars(self)))


@dataclass(frozen=True)
class Gear(Pair):
    """A pair of gears, or any fixed ratio: θ_b = r θ_a; λ is the torque on b.

    Meshing outer gears turn against each other: r < 0. θ_a and θ_b are the hinge angles, each of
    the joint's second body relative to its first. Hinges on one moving carrier therefore make a
    planetary gear.

    Attributes:
        name: name of the element, unique in the scene.
        joint_a, joint_b: names of the joints with angles θ_a and θ_b.
        ratio: r, not zero.
        coordinate_a, coordinate_b: names of the joints' coordinates; needed for joints with
            several.
    """

    name: str
    joint_a: str
    joint_b: str
    ratio: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """Returns the relation φ = θ_b − r θ_a, with hinge angles θ_a, θ_b and ratio r."""
        return in_ratio(p["ratio"], a, b)


@dataclass(frozen=True)
class RackAndPinion(Pair):
    """A pinion that rolls along a rack: s = r θ, with the rack's travel s and the pinion's angle θ.

    λ is the force on the rack [N].

    Attributes:
        name: name of the element, unique in the scene.
        pinion: name of the joint with the angle θ.
        rack: name of the joint with the travel s.
        radius: r [m], not zero; negative if a positive turn moves the rack backwards.
        coordinate_a, coordinate_b: names of the coordinates of pinion and rack; needed for joints
            with several.
    """

    name: str
    pinion: str
    rack: str
    radius: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the pinion's and the rack's joint, each with the name of its coordinate."""
        return ((self.pinion, self.coordinate_a), (self.rack, self.coordinate_b))

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """Returns the relation φ = s − r θ, with travel s, angle θ and radius r."""
        return in_ratio(p["radius"], a, b)


@dataclass(frozen=True)
class Belt(Pair):
    """A belt that runs round two pulleys without slip: r_b θ_b = r_a θ_a.

    λ is the belt's force on pulley b, along its circumference [N].

    Attributes:
        name: name of the element, unique in the scene.
        joint_a, joint_b: names of the joints on which the pulleys turn by θ_a and θ_b.
        radius_a, radius_b: radii r_a, r_b of the pulleys [m], not zero; of opposite signs for a
            crossed belt.
        coordinate_a, coordinate_b: names of the joints' coordinates; needed for joints with
            several.
    """

    name: str
    joint_a: str
    joint_b: str
    radius_a: Any
    radius_b: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """Returns the relation φ = r_b θ_b − r_a θ_a, with the pulleys' angles θ and radii r."""
        value = p["radius_b"] * b.value - p["radius_a"] * a.value
        return Relation(value, (-p["radius_a"], p["radius_b"]))


@dataclass(frozen=True)
class Pulley(Pair):
    """A rope that runs from one span over a pulley into another: l_a + n l_b is constant.

    l_a and l_b are the lengths of the spans. The rope is massless, and like a rod bent round the
    pulley it carries tension and compression; λ is minus the tension [N]. With n parts of rope in
    the second span it models a block and tackle.

    Attributes:
        name: name of the element, unique in the scene.
        span_a, span_b: names of the `Span`s between pulley and load.
        parts: the number n of parts of rope in the second span, not zero.
    """

    name: str
    span_a: str
    span_b: str
    parts: Any = 1.0

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the two spans; None stands for the only coordinate of a span."""
        return ((self.span_a, None), (self.span_b, None))

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """Returns the relation φ = l_a + n l_b, with the spans' elongations l and n parts.

        Elongations are changes of length since assembly [m].
        """
        return Relation(a.value + p["parts"] * b.value, (1.0, p["parts"]))


@dataclass(frozen=True)
class Differential(Coupling):
    """A differential: the carrier turns by the mean of its two shafts, θ_l + θ_r = 2 θ_c.

    θ_l, θ_r and θ_c are the angles of left shaft, right shaft and carrier. λ is the torque on each
    shaft; the torque on the carrier is −2 λ.

    Attributes:
        name: name of the element, unique in the scene.
        left, right, carrier: names of the joints of left shaft, right shaft and carrier.
        coordinates: names of the coordinates of left, right and carrier joint; None for a joint
            with only one.
    """

    name: str
    left: str
    right: str
    carrier: str
    coordinates: tuple[str | None, str | None, str | None] = (None, None, None)

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the left, right and carrier joint, each with the name of its coordinate."""
        if not isinstance(self.coordinates, tuple | list) or len(self.coordinates) != 3:
            raise ValueError(
                f"{label(self)}: coordinates must be three, of left, right and carrier, got"
                f" {self.coordinates!r}."
            )
        return tuple(zip((self.left, self.right, self.carrier), self.coordinates, strict=True))

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns an empty dictionary: a differential has no numbers."""
        return {}

    @staticmethod
    def relation(p: dict[str, Any], left: Row, right: Row, carrier: Row) -> Relation:
        """Returns the relation φ = θ_l + θ_r − 2 θ_c, with angles of both shafts and carrier."""
        return Relation(left.value + right.value - 2 * carrier.value, (1.0, 1.0, -2.0))


@dataclass(frozen=True)
class PolynomialCoupling(Pair):
    """A joint coordinate that is a polynomial of another, θ_b = Σ cₖ θ_aᵏ, such as a cam.

    Attributes:
        name: name of the element, unique in the scene.
        joint_a, joint_b: names of the joints with coordinates θ_a and θ_b.
        coefficients: (c₀, c₁, …), at least two. Both coordinates are zero at assembly, so a
            coefficient c₀ ≠ 0 violates the coupling there. `assemble` then moves the joints to a
            configuration that satisfies it.
        coordinate_a, coordinate_b: names of the joints' coordinates; needed for joints with
            several.
    """

    name: str
    joint_a: str
    joint_b: str
    coefficients: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None
    linear = False

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the coefficients as a checked array, (k + 1,) for degree k.

        Raises:
            ValueError: there are fewer than two coefficients.
        """
        shape = np.shape(checks.check(label(self), "coefficients", self.coefficients))
        if len(shape) != 1 or shape[0] < 2:
            raise ValueError(
                f"{label(self)}: coefficients must be (c0, c1, …), at least two, got shape {shape}."
            )
        return numbers(self, dtype, "coefficients", shape=shape)

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """Returns the relation φ = θ_b − P(θ_a) with the polynomial P(θ) = Σ cₖ θᵏ.

        Horner's rule evaluates P and both derivatives; the curvature is θ̇ᵀ H θ̇ = −P″ θ̇_a².
        """
        value = slope = bend = 0.0
        for c in reversed(tuple(p["coefficients"])):
            bend = bend * a.value + 2 * slope
            slope = slope * a.value + value
            value = value * a.value + c
        return Relation(b.value - value, (-slope, 1.0), -bend * a.rate**2)


@pytree
class Couplings(Elements, Constraint):
    """A group of couplings of one class, `law`, whose joints share bodies in the same way.

    Attributes:
        coordinates: the coupled coordinates.
        sides: for each coordinate, the index in `places` of each body of its joint.
    """

    coordinates: tuple[JointCoordinate, ...] = static(default=())
    sides: tuple[tuple[int, ...], ...] = static(default=())

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns the row of each coupling at one instant: φ, φ̇, γ and J = ∂φ̇/∂v by body."""
        coordinates = [each.read(snapshot) for each in self.coordinates]
        value, slopes, curvature = self.law.relation(self.params, *coordinates)
        if self.law.linear and any(row.reduced is not None for row in coordinates):
            # float32 rounds large angles: evaluate φ for the angles without whole turns and for
            # the turns, then add both results, whose sum is small
            pairs = [row.reduced or (row.value, jnp.zeros_like(row.value)) for row in coordinates]
            rows = list(zip(coordinates, pairs, strict=True))
            less = [row._replace(value=value) for row, (value, _) in rows]
            turns = [row._replace(value=Doubled.of(laps)) for row, (_, laps) in rows]
            value, turned = (self.law.relation(self.params, *x).value for x in (less, turns))
            value = value + 2 * jnp.pi * turned.value
        row = combination(value, slopes, coordinates, self.sides, len(self.places))
        return [row._replace(bias=row.bias + curvature)]


def combination(
    value: Lane,
    slopes: Sequence[Lane],
    coordinates: Sequence[Row],
    sides: Sequence[tuple[int, ...]],
    places: int,
) -> Row:
    """Returns the row of a function of joint coordinates with constant slopes sᵢ.

    Its rate, bias and pulls are the sums of those of the coordinates, each times sᵢ.

    Args:
        value: the value of the function.
        slopes: sᵢ, one for each coordinate.
        coordinates: the coordinates as rows.
        sides: for each coordinate, the place of each body of its joint.
        places: the number of places.
    """
    pulls: dict[int, Any] = {}
    for slope, row, own in zip(slopes, coordinates, sides, strict=True):
        for side, pull in zip(own, row.pulls, strict=True):
            pulls[side] = pull * slope if side not in pulls else pulls[side] + pull * slope
    pairs = list(zip(slopes, coordinates, strict=True))
    rate = total(slope * row.rate for slope, row in pairs)
    bias = total(slope * row.bias for slope, row in pairs)
    return Row(value, rate, bias, tuple(pulls[i] for i in range(places)))


def in_ratio(ratio: Lane, a: Row, b: Row) -> Relation:
    """Returns the relation φ = θ_b − r θ_a between the coordinates of two rows, with ratio r."""
    return Relation(b.value - ratio * a.value, (-ratio, 1.0))
