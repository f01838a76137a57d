"""The base class of joints, groups of joints of one class, and the blocks of their Jacobian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from jaxcon.constraints.primitives import Row
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.linear.jacobian import Block
from jaxcon.protocols import Constraint
from jaxcon.system.elements import BetweenBodies, Elements
from jaxcon.system.layout import Place

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame
    from jaxcon.system.body_system import BodySystem, Snapshot


@dataclass(frozen=True)
class Joint(BetweenBodies):
    """The base class of joints between two bodies.

    `attach` computes the numbers of a joint from the poses of its bodies at assembly. `rows`
    computes its rows from these numbers and the motion of the bodies.

    A joint whose coordinates can be read and driven also has `coordinates` and `coordinate`. If its
    coordinates share a computation, it has `coordinate_rows` in place of `coordinate`. If joints of
    one class differ in their rows or coordinates, the class also has `kind`.

    The names of the fields that `attach` returns have a meaning. Points are called anchor, start or
    end. Directions are called axis, first, second, normal, travel or edge. `orientation` is the
    orientation of the second body in the first. A field whose name ends in `_b` is in the frame of
    the second body; `in_b` lists further fields in that frame.

    `build` and `with_params` check numbers against the class attributes `ranges` and `nonzero`.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the first and the second body, or `WORLD`.
    """

    name: str
    body_a: str
    body_b: str

    coordinates: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """The unit of each coordinate by its name: "m", "rad", "half turn" or "rotation".

    "rad" is an angle with whole turns, and "half turn" an angle in [0, π] [rad]. "rotation" is a
    coordinate whose rate is not the derivative of any function of positions.
    """

    x_axis = None
    """The direction of the first coordinate normal to `axis`; None for a default direction."""

    relative: ClassVar[bool] = False
    """True if rows and coordinates depend only on the motion of b relative to a, where φ = 0.

    Robots of such joints can be eliminated along the joints. A class with `rows`, `coordinate` or
    `coordinate_rows` of its own does not inherit this attribute.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        found = ("relative", "rows", "coordinate", "coordinate_rows")
        says, *others = (min(i for i, c in enumerate(cls.__mro__) if x in vars(c)) for x in found)
        if min(others) < says:
            cls.relative = False

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the numbers of the joint by field; points and directions are in body frames.

        Args:
            a: pose of the first body at assembly, world frame.
            b: pose of the second body at assembly, world frame.
        """
        raise NotImplementedError

    @staticmethod
    def rows(p: dict[str, Any], a: JointFrame, b: JointFrame) -> list[Row]:
        """Returns the rows (φ, φ̇, γ and ∂φ̇/∂v) of many joints at once, as lanes (element, …).

        Args:
            p: the numbers that `attach` returned, lanes (element,) and vectors of lanes.
            a: motion of the first body of each joint.
            b: motion of the second body of each joint.
        """
        raise NotImplementedError

    @staticmethod
    def coordinate(name: str, p: dict[str, Any], a: JointFrame, b: JointFrame) -> Row:
        """Returns a coordinate of many joints as a row: its value, zero at assembly, rate and bias.

        Args:
            name: name of the coordinate.
            p: the numbers of the joints, by field.
            a: motion of the first body of each joint.
            b: motion of the second body of each joint.
        """
        raise NotImplementedError

    @classmethod
    def coordinate_rows(
        cls, name: str, p: dict[str, Any], a: JointFrame, b: JointFrame
    ) -> dict[str, Row]:
        """Returns the row of the named coordinate, and rows computed along with it, by name.

        Args:
            name: name of the coordinate.
            p: the numbers of the joints, by field.
            a: motion of the first body of each joint.
            b: motion of the second body of each joint.
        """
        return {name: cls.coordinate(name, p, a, b)}


@pytree
class Joints(Elements, Constraint):
    """A group of joints of one class, `law`, between bodies of the same kinds."""

    has_vectors: ClassVar[bool] = True

    @property
    def relative(self) -> bool:
        """True if the rows depend on relative motion only; see `Joint.relative`."""
        return getattr(self.law, "relative", False)  # what a user's `kind` returns may lack it

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns the rows of the joints at one instant: φ, φ̇, γ and J = ∂φ̇/∂v by body."""
        return self.law.rows(self.params, *self.frames(snapshot))

    def coordinate_rows(self, snapshot: Snapshot, name: str) -> dict[str, Row]:
        """Returns the row of a coordinate by its name, and rows that share its computation.

        A row has the coordinate (zero at assembly), its rate θ̇, its bias (the part of θ̈ without
        accelerations), and its pulls (∂θ̇/∂v by body).
        """
        return self.law.coordinate_rows(name, self.params, *self.frames(snapshot))


def blocks_of(
    system: BodySystem, places: tuple[Place, ...], rows: Sequence[Row], start: int
) -> list[Block]:
    """Returns the blocks of J for constraints of one type, one block for each side that can move.

    The first bodies of the constraints form one side, the second bodies another. Frames fixed to
    the world have no columns in J.

    Args:
        system: the system of bodies.
        places: the bodies on each side.
        rows: rows of the constraints, each with its pull (∂φ̇/∂v) on each side.
        start: number of the first row in J. Row 0 of every constraint comes first, then row 1 of
            every constraint, and so on.
    """
    return [
        Block(tuple(row.pulls[side] for row in rows), start, system.columns(place))
        for side, place in enumerate(places)
        if place.group is not None and rows
    ]
