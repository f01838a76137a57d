"""Tendons: linear combinations of joint coordinates, on which springs, motors and limits act.

A tendon is a joint without rows. Its length l = Σ cᵢ θᵢ is a coordinate with

    l̇ = Σ cᵢ θ̇ᵢ,   J = Σ cᵢ Jᵢ,   γ = Σ cᵢ γᵢ,

for the coordinates θᵢ with rates θ̇ᵢ, pulls Jᵢ = ∂θ̇ᵢ/∂v and biases γᵢ. A force f along l is the
force cᵢ f along each θᵢ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from jaxcon.constraints.base import Joints
from jaxcon.constraints.couplings import combination
from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType
from jaxcon.system.coordinates import JointCoordinate, OnCoordinates
from jaxcon.system.elements import label

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class Tendon(OnCoordinates):
    """A tendon over joints or spans: no rows, one coordinate, "length" = Σ cᵢ θᵢ.

    θᵢ are angles or travels of joints, or stretches of `Span`s, and cᵢ their coefficients: moment
    arms of angles, and the numbers of parallel strands of spans. The length is zero at assembly.
    Springs, dampers, limits, friction, rotors, motors and couplings act on the tendon by its name,
    as on a joint. A tendon through several points is a sum of spans:

        scene.add(jc.joints.Span("upper part", "a", "b", p, q))
        scene.add(jc.joints.Span("lower part", "b", "c", r, s))
        scene.add(jc.joints.Tendon("tendon", ("upper part", "lower part")))
        scene.add(jc.forces.JointSpring("muscle", "tendon", stiffness=100.0))

    Attributes:
        name: name of the element, unique in the scene.
        joints: names of the joints with the coordinates θᵢ, k of them.
        coefficients: cᵢ, (k,) [m/rad] for angles, without unit for travels; 1 unless given.
        coordinate_names: names of the coordinates, k of them; None for a joint with only one.
    """

    name: str
    joints: tuple[str, ...]
    coefficients: Any = None
    coordinate_names: tuple[str | None, ...] | None = None
    coordinates: ClassVar[Mapping[str, str]] = MappingProxyType({"length": "m"})
    relative: ClassVar[bool] = True

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the joints, each with the name of its coordinate."""
        for field in ("joints", "coordinate_names"):
            given = getattr(self, field)
            if not (isinstance(given, tuple | list) and given) and given is not None:
                raise ValueError(
                    f"{label(self)}: {field} must be a tuple with at least one name, got {given!r}."
                )
        names = self.coordinate_names
        names = (None,) * len(self.joints) if names is None else names
        if len(names) != len(self.joints):
            raise ValueError(
                f"{label(self)}: coordinate_names must be {len(self.joints)} names, one for each"
                f" joint, got {len(names)}."
            )
        return tuple(zip(self.joints, names, strict=True))

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the coefficients as a checked array, (k,).

        Raises:
            ValueError: the number of coefficients is not that of the joints.
        """
        count = len(self.joints)
        given = np.ones(count) if self.coefficients is None else self.coefficients
        shape = (count,)
        return {"coefficients": checks.real(label(self), "coefficients", given, dtype, shape)}


@pytree
class Tendons(Joints):
    """A group of tendons over the same coordinates of joints of the same classes.

    Attributes:
        terms: the coordinates θᵢ of all tendons.
        sides: for each coordinate, the index in `places` of each body of its joint.
    """

    terms: tuple[JointCoordinate, ...] = static(default=())
    sides: tuple[tuple[int, ...], ...] = static(default=())

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns an empty list: a tendon constrains nothing."""
        return []

    def coordinate_rows(self, snapshot: Snapshot, name: str) -> dict[str, Row]:
        """Returns the row of the length: its value, rate, bias and pulls by place."""
        terms = [each.read(snapshot) for each in self.terms]
        slopes = tuple(self.params["coefficients"])
        value = total(c * row.value for c, row in zip(slopes, terms, strict=True))
        return {name: combination(value, slopes, terms, self.sides, len(self.places))}

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns None: a tendon has no single anchor."""
        return None

    def select(self, indices: tuple[int, ...]) -> Self:
        """Returns the tendons with the given indices."""
        chosen = super().select(indices)
        return dataclasses.replace(chosen, terms=tuple(c.select(indices) for c in self.terms))
