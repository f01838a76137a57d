"""Rotor inertia that a geared motor adds to a joint coordinate."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.protocols import Constraint
from jaxcon.system.coordinates import JointCoordinate, OnJoint
from jaxcon.system.elements import Elements, label

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class Armature(OnJoint):
    """A rotor of inertia I that turns with a joint's coordinate θ; its one row gives λ = −I θ̈.

    The row J a + λ/I = −γ constrains nothing: it is the momentum balance of the rotor. A rotor
    behind a gear g has the inertia I = g² I_rotor about θ. The result is exact, as if I were added
    to the mass matrix in reduced coordinates. Bearing reactions of the rotor are neglected.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        inertia: I > 0 [kg m²] about an angle, [kg] along a travel. A joint without a rotor needs no
            `Armature`.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    name: str
    joint: str
    inertia: Any
    coordinate: str | None = None
    counts = False
    ranges = MappingProxyType({"inertia": checks.NumberRange(above=0)})

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the inertia I by field name, () [kg m²] or [kg]."""
        return {"inertia": checks.real(label(self), "inertia", self.inertia, dtype)}


@pytree
class Armatures(Elements, Constraint):
    """A group of rotors on the same coordinate of joints of one class.

    Attributes:
        coordinate: the coordinates on which the rotors turn, one for each rotor.
    """

    is_inertia: ClassVar[bool] = True
    closes_loops: ClassVar[bool] = False

    coordinate: JointCoordinate = static(default=None)  # type: ignore[assignment]

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns the row J a + λ/I = −γ of each rotor, without a φ and without feedback."""
        # NaN for I = ∞, since the compliance 0 would lock the joint
        compliance = 1 / finite_or_nan(self.params["inertia"])
        row = self.coordinate.read(snapshot)
        return [row._replace(value=0.0, rate=0.0, compliance=compliance)]

    def kinetic(self, snapshot: Snapshot) -> Lane:
        """Returns the kinetic energy ½ I θ̇² of each rotor [J]."""
        return self.params["inertia"] * self.coordinate.read(snapshot).rate ** 2 / 2

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchors of the joints, world frame [m]; None without anchors."""
        return self.coordinate.anchors(snapshot)
