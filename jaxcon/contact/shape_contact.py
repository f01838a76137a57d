"""Contact of two bodies with shapes such as boxes and cylinders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp

from jaxcon.contact.contact_rows import MATERIAL, material
from jaxcon.contact.shapes import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Hull,
    Plane,
    Shape,
    Sphere,
)
from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import DType, Lane
from jaxcon.geometry import boxes, solids
from jaxcon.geometry.pose import Pose
from jaxcon.geometry.solids import Gap, Solid
from jaxcon.system.elements import BetweenBodies, label

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

GAPS: Mapping[tuple[type[Shape], type[Shape]], Callable[[Solid, Solid], list[Gap]]] = (
    MappingProxyType(
        {
            (Plane, Sphere): solids.plane_ball,
            (Plane, Capsule): solids.plane_capsule,
            (Plane, Cylinder): solids.plane_cylinder,
            (Plane, Box): boxes.plane_box,
            (Plane, Ellipsoid): solids.plane_ellipsoid,
            (Plane, Hull): solids.plane_hull,
            (Box, Sphere): solids.box_ball,
            (Cylinder, Sphere): solids.cylinder_ball,
            (Ellipsoid, Sphere): solids.ellipsoid_ball,
            (Box, Capsule): solids.box_capsule,
            (Cylinder, Capsule): solids.cylinder_capsule,
            (Box, Box): boxes.box_box,
        }
    )
)
"""The functions that return the gaps of two shapes; for a pair in the other order, they swap."""


class Points(NamedTuple):
    """The contact points of many elements, lanes (element, k, …).

    Attributes:
        gap: gap φ of each point [m].
        normal: unit normal from the first body to the second, world frame.
        place: the point halfway between the surfaces, world frame.
    """

    gap: Lane
    normal: Vector
    place: Vector


@dataclass(frozen=True)
class ShapePair:
    """Two kinds of shapes, by which contacts are grouped.

    Attributes:
        first, second: the classes of the shapes of body a and body b.
    """

    first: type[Shape]
    second: type[Shape]
    optional = (*MATERIAL, "margin")
    unbounded_fields = ()
    in_b = ()
    by_principal_axes = False

    def check_numbers(self, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks the ranges of an element's numbers; see `Element.check_numbers`."""
        self.first.check(owner, numbers, dtype, "a")
        self.second.check(owner, numbers, dtype, "b")
        if numbers.get("margin") is not None:
            checks.check(owner, "margin", numbers["margin"], dtype=dtype, least=0)

    @property
    def element(self) -> type[ShapeContact]:
        """The class of the contacts, for summaries of a system."""
        return ShapeContact

    @property
    def supported(self) -> bool:
        """True if there is a contact of the two shapes."""
        kinds = self.first, self.second
        return kinds in GAPS or kinds[::-1] in GAPS

    def touches(self, p: Mapping[str, Any], a: JointFrame, b: JointFrame) -> Points:
        """Returns the contact points of many elements.

        Args:
            p: the numbers of the elements by name.
            a: the motion of the first bodies.
            b: the motion of the second bodies.
        """
        first, second = self.first.solid(p, "a", a), self.second.solid(p, "b", b)
        kinds = self.first, self.second
        if kinds in GAPS:
            gaps = GAPS[kinds](first, second)
        else:
            gaps = [gap.swapped() for gap in GAPS[self.second, self.first](second, first)]
        if len(gaps) == 1 and Hull in kinds:  # already lanes (element, k, …)
            gap, normal, place = gaps[0]
            shape = jnp.shape(gap)
            normal, place = (
                Vector(*(jnp.broadcast_to(x, shape) for x in v)) for v in (normal, place)
            )
        else:
            gap = solids.stack_points([x.distance for x in gaps])
            normal, place = (
                Vector(*map(solids.stack_points, zip(*vectors, strict=True)))
                for vectors in ([x.normal for x in gaps], [x.place for x in gaps])
            )
        if "margin" in p:
            gap = gap - solids.per_point(p["margin"])
        return Points(gap, normal, place)


@dataclass(frozen=True)
class ShapeContact(BetweenBodies):
    """Contact of two bodies with shapes, in space.

    The shapes are `jc.shapes.Plane`, `Sphere`, `Capsule`, `Cylinder`, `Box`, `Ellipsoid` and
    `Hull`. The table has the number of contact points k of each pair, in either order. Other pairs
    are refused.

        =========  =====  ======  =======  ========  ===  =========  ====
        shape      Plane  Sphere  Capsule  Cylinder  Box  Ellipsoid  Hull
        =========  =====  ======  =======  ========  ===  =========  ====
        Plane             1       2        5         4    1          all
        Sphere     1                       1         1    1
        Capsule    2                       3         2
        Cylinder   5      1       3
        Box        4      1       2                  4
        Ellipsoid  1      1
        Hull       all
        =========  =====  ======  =======  ========  ===  =========  ====

    λ has the shape (k, 1 + tangents), or (1 + tangents,) for one point. A point that does not exist
    in a pose, such as three of the four points of two crossing edges, has a large gap. For spheres
    and capsules with each other, use `CapsuleContact`. For a ball on a height field, use
    `HeightFieldContact`.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        shape_a, shape_b: their shapes.
        friction: coefficient of friction μ ≥ 0. With the number 0 there are normal rows only.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness, damping: spring and damper of a soft contact at each point [N/m], [N s/m].
            Without a stiffness, contact is hard.
        recovery: the largest speed at which a penetration closes [m/s].
        rolling: length c ≥ 0 of rolling resistance [m], ‖τ‖ ≤ c λ_n for its moment τ; 0 for none.
        spinning: length c ≥ 0 of resistance to spinning about the normal [m]; 0 for none.
        margin: the distance of the surfaces at which contact begins, ≥ 0 [m].
    """

    name: str
    body_a: str
    body_b: str
    shape_a: Any
    shape_b: Any
    friction: Any = 0.0
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    rolling: Any = 0.0
    spinning: Any = 0.0
    margin: Any = 0.0
    dims = (3,)
    framed = True
    optional = ShapePair.optional

    @property
    def kind(self) -> ShapePair:
        """The kinds of both shapes."""
        return ShapePair(type(self.shape_a), type(self.shape_b))

    def attach(self, a: Pose, b: Pose, own_a: Pose, own_b: Pose) -> dict[str, Any]:
        """Returns the shapes in the frames of their bodies, and the material parameters.

        Raises:
            ValueError: a shape has a wrong number, or there is no contact of the two shapes.
            TypeError: a shape is no `Shape`.
        """
        owner, numbers = label(self), {}
        for side in "ab":
            checks.instance(
                owner, f"shape_{side}", getattr(self, f"shape_{side}"), Shape,
                "a shape such as jc.shapes.Sphere(radius)",
            )  # fmt: skip
        if not self.kind.supported:
            raise ValueError(f"{owner}: {_refusal(type(self.shape_a), type(self.shape_b))}")
        for side, pose, user_frame in (("a", a, own_a), ("b", b, own_b)):
            shape = getattr(self, f"shape_{side}")
            found = shape.attach(self, f"shape_{side}", pose, user_frame)
            numbers |= {f"{name}_{side}": x for name, x in found.items()}
        if not checks.plain_zero(self.margin):
            dtype = a.position.dtype
            numbers["margin"] = checks.real(owner, "margin", self.margin, dtype, least=0)
        return numbers | material(self, a, b)


def _refusal(first: type[Shape], second: type[Shape]) -> str:
    """Explains why there is no contact of two shapes."""
    if {first, second} <= {Sphere, Capsule}:
        return f"for a {first.__name__} and a {second.__name__}, use jc.contacts.CapsuleContact."
    partners = [b for a, b in GAPS if a is first] + [a for a, b in GAPS if b is first]
    names = ", ".join(dict.fromkeys(kind.__name__ for kind in partners))
    return (
        f"there is no contact of a {first.__name__} with a {second.__name__}; a {first.__name__}"
        f" has contacts with {names}."
    )
