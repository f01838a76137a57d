"""Contact of a box with a plane, at each corner of the box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxcon.constraints.primitives import Row
from jaxcon.contact import point_sets
from jaxcon.contact.contact import PlaneContact, plane
from jaxcon.contact.contact_rows import material
from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import BetweenBodies, label

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame


@dataclass(frozen=True)
class BoxContact(BetweenBodies):
    """Contact of a body's box with another body's plane; in 2-D a rectangle on a line.

    Each corner is a contact point, 4 in 2-D and 8 in 3-D. λ of the element has a row for each
    corner, (2^dim, 1 + tangents). Where more than three corners lie on the plane, their resultant
    force and moment are determined, but not the split between the corners.

    Attributes:
        name: name of the element, unique in the scene.
        body_a: the body with the plane, or `WORLD`.
        body_b: the body with the box.
        size: edge lengths of the box, (dim,) [m].
        position: center of the box in the world at assembly, (dim,) [m]. If None, the origin of the
            user's frame of the body.
        orientation: orientation of its edges in the world at assembly, an angle [rad] in the plane
            and a quaternion (4,) in space. If None, the orientation of the user's frame.
        normal: outward normal of the plane in the world at assembly, (dim,). If None, the last
            axis.
        point: a point of the plane in the world at assembly, (dim,) [m]. If None, the origin.
        friction: coefficient of friction μ ≥ 0. With the number 0 there are normal rows only.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness, damping: spring and damper of a soft contact at each corner [N/m], [N s/m].
            Without a stiffness, contact is hard.
        recovery: the largest speed at which a penetration closes [m/s].
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
        """Returns the plane in a's frame, the box in b's frame, and the material parameters."""
        owner, dtype = label(self), b.position.dtype
        size = checks.real(owner, "size", self.size, dtype, b.position.shape, above=0)
        if b.orientation is None:
            raise ValueError(f"{owner}: '{self.body_b}' is a particle, which has no corners.")
        middle, axes = point_sets.own_frame(self, b, own_b)
        box = {"size": size, "anchor_b": middle} | axes
        return plane(self, a) | box | material(self, a, b)

    points = staticmethod(point_sets.corners)

    @staticmethod
    def bounds(
        p: dict[str, Any], a: JointFrame, b: JointFrame, dt: Array
    ) -> tuple[list[Row], dict[str, Any]]:
        """Returns the contact rows of each corner, and further fields of their `BoundSet`.

        The gap is n·(p_b − p_a), with the plane's normal n and point p_a, and the corner p_b.
        """
        return PlaneContact.bounds(p | {"radius": 0.0}, a, b, dt)
