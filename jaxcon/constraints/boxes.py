"""A box on a plane: a contact at each corner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxcon.constraints import point_sets
from jaxcon.constraints.contact import PlaneContact, plane
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.touching import material
from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label


@dataclass(frozen=True)
class BoxContact:
    """A box of a body on a plane of another; in the plane a rectangle on a line.

    Each corner touches as a point does, 4 in the plane and 8 in space. λ of the element is that of
    every corner, (2^dim, 1 + tangents): which corners bear how much is not determined where more
    than three of them lie on the plane, and their sum is.

    Attributes:
        name: unique in the scene.
        body_a: that has the plane, or `WORLD`.
        body_b: that has the box.
        size: its edges, (dim,) [m].
        position: of its middle, world, at assembly, (dim,) [m]; the origin of the frame in which
            the body was given unless given.
        orientation: of its edges in the world at assembly, an angle [rad] in the plane and a
            quaternion (4,) in space; those of that frame unless given.
        normal: of the plane, out of it, world, at assembly, (dim,); the last axis unless given.
        point: of the plane, world, at assembly, (dim,) [m]; the origin unless given.
        friction: μ ≥ 0; the number 0 leaves the normal rows alone.
        restitution: e, 0 to 1.
        stiffness, damping: of a soft contact at each corner [N/m], [N s/m]; hard unless given.
        recovery: the fastest way out of an overlap [m/s].
    """

    name: str
    body_a: str
    body_b: str
    size: Any
    position: Any = None
    orientation: Any = None
    normal: Any = None
    point: Any = None
    friction: Any = 0.0
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    framed = True
    optional = ("friction", "restitution")
    in_b = point_sets.AXES

    def attach(self, a: Pose, b: Pose, own_a: Pose, own_b: Pose) -> dict[str, Array]:
        """The plane in the frame of a, the box in that of b, and the material."""
        owner, dtype = label(self), b.position.dtype
        size = checks.real(owner, "size", self.size, dtype, b.position.shape, above=0)
        if b.orientation is None:
            raise ValueError(f"{owner}: '{self.body_b}' is a particle, which has no corners.")
        middle, axes = point_sets.own_frame(self, b, own_b)
        box = {"size": size, "anchor_b": middle} | axes
        return plane(self, a) | box | material(self, a, b)

    points = staticmethod(point_sets.corners)

    @staticmethod
    def bounds(p: dict[str, Any], a: Any, b: Any, dt: Any) -> tuple[list[Row], dict[str, Any]]:
        """n·(p_b − p_a) of each corner."""
        return PlaneContact.bounds(p | {"radius": 0.0}, a, b, dt)
