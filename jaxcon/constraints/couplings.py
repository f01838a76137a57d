"""Couplings between the coordinates of joints: gears, racks, differentials, cams, pulleys.

A coupling is φ(θ₁, …, θₖ) = 0, with

    φ̇ = Σ sᵢ θ̇ᵢ,   J = Σ sᵢ Jᵢ,   γ = Σ sᵢ γᵢ + θ̇ᵀ H θ̇,   s = ∇φ, H = ∇²φ,

so it needs of each joint only its coordinate with rate, bias and pulls. Coordinates are zero at
assembly, where the couplings therefore hold, and angles count whole turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.base import RowSet, gather
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled
from jaxcon.core.lanes import total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.model.actuators import numbers
from jaxcon.model.coordinates import JointCoordinate
from jaxcon.model.elements import Elements, label


class Relation(NamedTuple):
    """A relation between coordinates.

    Attributes:
        value: φ.
        slopes: s = ∇φ, one for each coordinate.
        curvature: θ̇ᵀ ∇²φ θ̇.
    """

    value: Lane
    slopes: tuple[Lane, ...]
    curvature: Lane = 0.0


class Pair:
    """A coupling of one coordinate each of two joints."""

    joint_a: str
    joint_b: str
    coordinate_a: str | None
    coordinate_b: str | None
    linear = True
    """True where φ is a sum of multiples of the coordinates."""

    @property
    def along(self) -> tuple[tuple[str, str | None], ...]:
        """The joints and coordinates that are coupled."""
        return ((self.joint_a, self.coordinate_a), (self.joint_b, self.coordinate_b))


@dataclass(frozen=True)
class Gear(Pair):
    """A pair of gears, or any fixed ratio: θ_b = r θ_a; λ is the torque on b.

    Meshing outer gears turn against each other: r < 0. The angles are those of the hinges, each of
    its second body in its first, so hinges on one moving carrier make a planetary gear.

    Attributes:
        name: unique in the scene.
        joint_a, joint_b: names of the joints.
        ratio: r, not zero.
        coordinate_a, coordinate_b: which of the joints'; not needed where they have but one.
    """

    name: str
    joint_a: str
    joint_b: str
    ratio: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The ratio."""
        return nonzero(self, dtype, "ratio")

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """θ_b − r θ_a."""
        return in_ratio(p["ratio"], a, b)


@dataclass(frozen=True)
class RackAndPinion:
    """A pinion that rolls along a rack: s = r θ; λ is the force on the rack [N].

    Attributes:
        name: unique in the scene.
        pinion: name of the joint that turns by θ.
        rack: name of the joint that travels by s.
        radius: r [m], not zero; negative where a positive turn drives the rack back.
        coordinate_a, coordinate_b: which of the joints'; not needed where they have but one.
    """

    name: str
    pinion: str
    rack: str
    radius: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None
    linear = True

    @property
    def along(self) -> tuple[tuple[str, str | None], ...]:
        """The joints and coordinates that are coupled."""
        return ((self.pinion, self.coordinate_a), (self.rack, self.coordinate_b))

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The radius."""
        return nonzero(self, dtype, "radius")

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """s − r θ."""
        return in_ratio(p["radius"], a, b)


@dataclass(frozen=True)
class Belt(Pair):
    """A belt that does not slip round two pulleys: r_b θ_b = r_a θ_a; λ is the pull on b [N].

    Attributes:
        name: unique in the scene.
        joint_a, joint_b: names of the joints on which the pulleys turn.
        radius_a, radius_b: of the pulleys [m], not zero; of opposite signs for a crossed belt.
        coordinate_a, coordinate_b: which of the joints'; not needed where they have but one.
    """

    name: str
    joint_a: str
    joint_b: str
    radius_a: Any
    radius_b: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The radii."""
        return nonzero(self, dtype, "radius_a", "radius_b")

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """r_b θ_b − r_a θ_a."""
        value = p["radius_b"] * b.value - p["radius_a"] * a.value
        return Relation(value, (-p["radius_a"], p["radius_b"]))


@dataclass(frozen=True)
class Pulley:
    """A rope that runs from one span over a pulley into another: l_a + n l_b is constant.

    The rope is massless and taut both ways, a rod bent round the pulley; λ is minus its tension.
    With n parts of rope in the second span it is a block and tackle.

    Attributes:
        name: unique in the scene.
        span_a, span_b: names of the `Span`s between pulley and load.
        parts: n, not zero.
    """

    name: str
    span_a: str
    span_b: str
    parts: Any = 1.0

    @property
    def along(self) -> tuple[tuple[str, str | None], ...]:
        """The joints and coordinates that are coupled."""
        return ((self.span_a, None), (self.span_b, None))

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The number of parts."""
        return nonzero(self, dtype, "parts")

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """l_a + n l_b, less what it was at assembly."""
        return Relation(a.value + p["parts"] * b.value, (1.0, p["parts"]))


@dataclass(frozen=True)
class Differential:
    """A differential: the carrier turns by the mean of its two shafts, θ_l + θ_r = 2 θ_c.

    λ is the torque on each of the shafts, and half of that on the carrier with the opposite sign.

    Attributes:
        name: unique in the scene.
        left, right, carrier: names of the joints.
        coordinates: of the three; not needed where they have but one.
    """

    name: str
    left: str
    right: str
    carrier: str
    coordinates: tuple[str | None, str | None, str | None] = (None, None, None)
    linear = True

    @property
    def along(self) -> tuple[tuple[str, str | None], ...]:
        """The joints and coordinates that are coupled."""
        if len(self.coordinates) != 3:
            raise ValueError(
                f"{label(self)}: coordinates must be three, of left, right and carrier, got"
                f" {self.coordinates!r}."
            )
        return tuple(zip((self.left, self.right, self.carrier), self.coordinates, strict=True))

    def attach(self, dtype: Any) -> dict[str, Array]:
        """No numbers."""
        return {}

    @staticmethod
    def relation(p: dict[str, Any], left: Row, right: Row, carrier: Row) -> Relation:
        """θ_l + θ_r − 2 θ_c."""
        return Relation(left.value + right.value - 2 * carrier.value, (1.0, 1.0, -2.0))


@dataclass(frozen=True)
class PolynomialCoupling(Pair):
    """One coordinate as a polynomial of another, θ_b = Σ cₖ θ_aᵏ: cams, and fits of anything else.

    Attributes:
        name: unique in the scene.
        joint_a, joint_b: names of the joints.
        coefficients: (c₀, c₁, …), at least two. Both coordinates are zero where the scene is built,
            so c₀ ≠ 0 is violated there; `assemble` brings the joints to where it holds.
        coordinate_a, coordinate_b: which of the joints'; not needed where they have but one.
    """

    name: str
    joint_a: str
    joint_b: str
    coefficients: Any
    coordinate_a: str | None = None
    coordinate_b: str | None = None
    linear = False

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The coefficients.

        Raises:
            ValueError: there are fewer than two.
        """
        shape = np.shape(checks.check(label(self), "coefficients", self.coefficients))
        if len(shape) != 1 or shape[0] < 2:
            raise ValueError(
                f"{label(self)}: coefficients must be (c0, c1, …), at least two, got shape {shape}."
            )
        return numbers(self, dtype, "coefficients", shape=shape)

    @staticmethod
    def relation(p: dict[str, Any], a: Row, b: Row) -> Relation:
        """θ_b − P(θ_a), by Horner's rule with both derivatives: θ̇ᵀ H θ̇ = −P″ θ̇_a²."""
        value = slope = bend = 0.0
        for c in reversed(tuple(p["coefficients"])):
            bend = bend * a.value + 2 * slope
            slope = slope * a.value + value
            value = value * a.value + c
        return Relation(b.value - value, (-slope, 1.0), -bend * a.rate**2)


@pytree
class Couplings(Elements):
    """Couplings of one class, `law`, whose bodies coincide in the same way.

    Attributes:
        along: the coordinates that are coupled.
        sides: for each of them, the place of each body of the joint among `places`.
    """

    law: Any = static(default=None)
    along: tuple[JointCoordinate, ...] = static(default=())
    sides: tuple[tuple[int, ...], ...] = static(default=())

    def rows(self, snapshot: Any) -> RowSet:
        """φ, φ̇, J and γ at one instant."""
        coordinates = [along.read(snapshot) for along in self.along]
        value, slopes, curvature = self.law.relation(self.params, *coordinates)
        if getattr(self.law, "linear", False) and any(
            row.reduced is not None for row in coordinates
        ):
            value = self._value(coordinates)
        pairs = list(zip(slopes, coordinates, strict=True))
        pulls: list[Any] = [None] * len(self.places)
        for (slope, row), sides in zip(pairs, self.sides, strict=True):
            for side, pull in zip(sides, row.pulls, strict=True):
                known = pulls[side]
                pulls[side] = pull * slope if known is None else known + pull * slope
        rate = total(slope * row.rate for slope, row in pairs)
        bias = total(slope * row.bias for slope, row in pairs) + curvature
        row = Row(value, rate, bias, tuple(pulls))
        return gather(snapshot, self.places, [row])

    def _value(self, coordinates: list[Row]) -> Lane:
        """φ of the angles less whole turns, and 2π φ of the turns, whose sum is small again."""
        pairs = [row.reduced or (row.value, jnp.zeros_like(row.value)) for row in coordinates]
        rows = list(zip(coordinates, pairs, strict=True))
        less = [row._replace(value=value) for row, (value, _) in rows]
        turns = [row._replace(value=Doubled.of(laps)) for row, (_, laps) in rows]
        value, turned = (self.law.relation(self.params, *x).value for x in (less, turns))
        return value + 2 * jnp.pi * turned.value

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """None: a coupling acts on several joints."""
        return None


def in_ratio(ratio: Lane, a: Row, b: Row) -> Relation:
    """b − r a."""
    return Relation(b.value - ratio * a.value, (-ratio, 1.0))


def nonzero(element: Any, dtype: Any, *fields: str) -> dict[str, Array]:
    """Numbers of an element, checked.

    Raises:
        ValueError: one of them is zero or not finite.
    """
    params = numbers(element, dtype, *fields)
    for field, value in params.items():
        checks.nonzero(label(element), field, value)
    return params
