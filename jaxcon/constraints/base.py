"""What a constraint answers, and joints of one class side by side."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp

from jaxcon.constraints.primitives import Row
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import Elements
from jaxcon.model.layout import Place
from jaxcon.solvers.jacobian import Columns


class RowSet(NamedTuple):
    """The rows of equal constraints, row-major: row r of every element, then row r + 1.

    Attributes:
        value, rate, bias: φ, φ̇, γ by row, lanes (element,).
        jacobian: for each body, its columns and its part of every row.
        holonomic: by row, whether it has a φ or is one of velocities alone.
        compliance: C by row, lanes (element,); None where it is zero.
        swings: of the rows that are rods, see `Row.swing`.
    """

    value: tuple[Lane, ...]
    rate: tuple[Lane, ...]
    bias: tuple[Lane, ...]
    jacobian: tuple[tuple[Columns, tuple[Vector, ...]], ...]
    holonomic: tuple[bool, ...]
    compliance: tuple[Lane, ...] | None = None
    swings: Mapping[int, Lane] = MappingProxyType({})


class Constraint(Protocol):
    """A group of equal constraints in a system."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the constraints."""
        ...

    def rows(self, snapshot: Any) -> RowSet:
        """φ, φ̇, J and γ at one instant."""
        ...


class Joint(Protocol):
    """How a joint is described: two bodies, numbers at assembly, and its rows.

    A joint that can be driven and read also has `coordinates`, the unit of each by its name ("rad",
    counted over turns, "m", or "rotation" where the rate is the derivative of no coordinate), and
    `coordinate(name, p, a, b)`, the row of one. A joint whose coordinates need a common computation
    has `coordinate_rows(name, p, a, b)` instead, a mapping that contains that row and may contain
    others. Joints of one class that move in different ways also have `kind`, a hashable value which
    then stands for the class.

    What `attach` keeps of a body goes along with it by its name: points are called anchor, start or
    end, directions axis, first, second, normal, travel or edge, and the orientation of b in a is
    `orientation`. A last word b says that it is of the second body; `in_b` names the fields that
    are without saying so.
    """

    name: str
    body_a: str
    body_b: str

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The numbers of the joint in the frames of its bodies, from their poses at assembly."""
        ...

    @staticmethod
    def rows(p: dict[str, Any], a: Any, b: Any) -> list[Row]:
        """The rows, from those numbers and the motion of the two bodies, by lanes."""
        ...


@pytree
class Joints(Elements):
    """Joints of one class, `joint`, between bodies of the same kinds."""

    joint: Any = static(default=None)

    def rows(self, snapshot: Any) -> RowSet:
        """φ, φ̇, J and γ at one instant."""
        return gather(snapshot, self.places, self.joint.rows(self.params, *self.frames(snapshot)))

    def coordinate_rows(self, snapshot: Any, name: str) -> dict[str, Row]:
        """The row of a coordinate, and of others that the same computation yields, by name.

        A row has the coordinate, zero at assembly, its rate, its bias and its pulls.
        """
        frames = self.frames(snapshot)
        if hasattr(self.joint, "coordinate_rows"):
            return self.joint.coordinate_rows(name, self.params, *frames)
        return {name: self.joint.coordinate(name, self.params, *frames)}

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """The anchor of one joint on its second body, world frame, (dim,); None without a point."""
        if "anchor_b" not in self.params:
            return None
        one = self.select((i,))
        point = one.frames(snapshot)[1].point(one.params["anchor_b"])
        return jnp.stack([x.reshape(()) for x in point.position])


def gather(
    snapshot: Any, places: tuple[Place, ...], rows: list[Row], compliance: Any = None
) -> RowSet:
    """Rows whose pulls act on these places as a set, without the columns of the world."""
    sides = [
        (snapshot.system.columns(place), tuple(row.pulls[side] for row in rows))
        for side, place in enumerate(places)
        if place.group is not None and rows
    ]
    return RowSet(
        tuple(row.value for row in rows),
        tuple(row.rate for row in rows),
        tuple(row.bias for row in rows),
        tuple(sides),
        tuple(row.holonomic for row in rows),
        compliance,
        {r: row.swing for r, row in enumerate(rows) if row.swing is not None},
    )
