"""Rotor inertia: what a geared motor adds to the inertia of a joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxcon.constraints.base import RowSet, gather
from jaxcon.core import checks
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.model.coordinates import JointCoordinate
from jaxcon.model.elements import Elements, label


@dataclass(frozen=True)
class Armature:
    """The inertia I of a rotor that turns with a joint's coordinate θ: λ = −I θ̈, one row.

    The row J a + λ/I = −γ holds nothing: it is the momentum balance of the rotor, whose inertia,
    reflected by a gear g, is I = g² I_rotor about θ. So it is exact, and as stable as the mass
    matrix to which reduced coordinates would add it. What its bearing takes up is left out, as
    everywhere.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        inertia: I [kg m²] about an angle, [kg] along a travel.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    inertia: Any
    coordinate: str | None = None
    counts = False

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The inertia.

        Raises:
            ValueError: it is not positive; a joint without a rotor has no armature.
        """
        inertia = checks.real(label(self), "inertia", self.inertia, dtype, above=0)
        return {"inertia": inertia}


@pytree
class Armatures(Elements):
    """Rotors along one coordinate of joints of one group."""

    along: JointCoordinate = static(default=None)  # type: ignore[assignment]

    def rows(self, snapshot: Any) -> RowSet:
        """J a + λ/I = −γ; there is no φ, and no feedback."""
        row = self.along.read(snapshot)._replace(value=0.0, rate=0.0)
        compliance = 1 / finite_or_nan(self.params["inertia"])  # not 0, which would hold the joint
        return gather(snapshot, self.places, [row], (compliance,))

    def kinetic(self, snapshot: Any) -> Lane:
        """½ I θ̇² [J]."""
        return self.params["inertia"] * self.along.read(snapshot).rate ** 2 / 2

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """The anchor of the joint."""
        group = snapshot.system.constraints[self.along.group]
        return group.anchor(snapshot, self.along.joints[i])
