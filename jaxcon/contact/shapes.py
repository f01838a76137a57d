"""Shapes of bodies in contact: what users give, and their numbers in the frames of the bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from jaxcon.constraints.joints import unit_vector
from jaxcon.contact.point_sets import AXES, own_frame, own_points
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, zeros
from jaxcon.core.lanes import axes as coordinate_axes
from jaxcon.core.typing import DType
from jaxcon.geometry.pose import Pose
from jaxcon.geometry.solids import Solid
from jaxcon.system.elements import BetweenBodies, Grid, label, own_point
from jaxcon.system.frames import BodyFrame


class Shape:
    """The base class of shapes. Their places are given in the world frame at assembly."""

    sizes: ClassVar[Mapping[str, tuple[tuple[int, ...], checks.NumberRange]]] = {}
    """The shape and the range of each field that is a length [m]."""

    def attach(
        self, element: BetweenBodies, field: str, pose: Pose, user_frame: Pose
    ) -> dict[str, Any]:
        """Returns the numbers of the shape by name; points and axes are in the body frame.

        Args:
            element: the contact, for error messages.
            field: its field that holds the shape.
            pose: pose of the body's principal frame.
            user_frame: pose of the user's frame of the body, relative to the principal frame.

        Raises:
            ValueError: a number has a wrong shape or range, or the body is a particle.
        """
        owner, dtype = label(element), pose.position.dtype
        result: dict[str, Any] = {
            name: checks.real(owner, f"{field}.{name}", getattr(self, name), dtype, shape, **limits)
            for name, (shape, limits) in self.sizes.items()
        }
        if pose.orientation is None and hasattr(self, "orientation"):
            raise ValueError(
                f"{owner}: {field} is a {type(self).__name__}, but its body is a particle, which"
                " does not turn; give a Sphere, or a body with an inertia."
            )
        names = (f"{field}.position", f"{field}.orientation")
        place, turn = getattr(self, "position", None), getattr(self, "orientation", None)
        center, axes = own_frame(element, pose, user_frame, names, (place, turn))
        return result | {"anchor": center} | axes

    @classmethod
    def check(cls, owner: str, numbers: Mapping[str, Any], dtype: DType, side: str) -> None:
        """Checks the ranges of changed numbers.

        Args:
            owner: first words of errors.
            numbers: the numbers of the contact by name.
            dtype: dtype of the scene, in which they are compared.
            side: "a" or "b", which ends the names of the shape's numbers.
        """
        for name, (_, limits) in cls.sizes.items():
            if numbers.get(f"{name}_{side}") is not None:
                field = f"{name}_{side}"
                checks.check(owner, field, numbers[field], dtype=dtype, **limits)

    @classmethod
    def solid(cls, p: Mapping[str, Any], side: str, frame: BodyFrame) -> Solid:
        """Returns the shapes of many contacts in the world frame.

        Args:
            p: the numbers of the contacts by name.
            side: "a" or "b", which ends the names of the shape's numbers.
            frame: the motion of the bodies.
        """
        axes = [frame.direction(p[f"{n}_{side}"]).position for n in AXES if f"{n}_{side}" in p]
        half = p.get(f"length_{side}", p.get(f"size_{side}", 0.0))
        half = half * 0.5 if not isinstance(half, float) else half
        half = p.get(f"radii_{side}", half)
        center = frame.point(p[f"anchor_{side}"]).position
        return Solid(center, tuple(axes), p.get(f"radius_{side}", 0.0), half)


@dataclass(frozen=True)
class Plane(Shape):
    """A half space below a plane.

    Attributes:
        normal: outward normal in the world at assembly, (3,). If None, the axis z.
        point: a point of the plane in the world at assembly, (3,) [m]. If None, the origin.
    """

    normal: Any = None
    point: Any = None

    def attach(
        self, element: BetweenBodies, field: str, pose: Pose, user_frame: Pose
    ) -> dict[str, Any]:
        """Returns the normal and a point of the plane in the body frame.

        Raises:
            ValueError: a number has a wrong shape or range, or the body is a particle.
        """
        if pose.orientation is None:
            raise ValueError(
                f"{label(element)}: {field} is a Plane, but its body is a particle, which does not"
                " turn; give the plane to the world, or to a body with an inertia."
            )
        dtype = pose.position.dtype
        normal = (0.0, 0.0, 1.0) if self.normal is None else self.normal
        point = jnp.zeros(3, dtype) if self.point is None else self.point
        normal = unit_vector(element, f"{field}.normal", normal, pose)
        point = own_point(element, f"{field}.point", point, pose)
        return {"anchor": pose.local_point(point), "normal": pose.local_direction(normal)}

    @classmethod
    def solid(cls, p: Mapping[str, Any], side: str, frame: BodyFrame) -> Solid:
        """Returns the planes of many contacts in the world frame; see `Shape.solid`."""
        normal = frame.direction(p[f"normal_{side}"]).position
        return Solid(frame.point(p[f"anchor_{side}"]).position, (normal,))


@dataclass(frozen=True)
class Sphere(Shape):
    """A ball.

    Attributes:
        radius: radius r ≥ 0 [m].
        position: center in the world at assembly, (3,) [m]. If None, the origin of the user's frame
            of the body.
    """

    radius: Any
    position: Any = None
    sizes = {"radius": ((), {"least": 0})}

    def attach(
        self, element: BetweenBodies, field: str, pose: Pose, user_frame: Pose
    ) -> dict[str, Any]:
        """Returns the radius, and the center in the body frame; see `Shape`."""
        result = super().attach(element, field, pose, user_frame)
        return {name: x for name, x in result.items() if name not in AXES}


@dataclass(frozen=True)
class Capsule(Shape):
    """A capsule: a cylinder along z between two half balls.

    Attributes:
        radius: radius r ≥ 0 [m].
        length: length of the cylinder, without the half balls, ≥ 0 [m].
        position: center in the world at assembly, (3,) [m]. If None, the origin of the user's frame
            of the body.
        orientation: orientation of its axes in the world at assembly, a quaternion (4,). If None,
            the orientation of the user's frame.
    """

    radius: Any
    length: Any
    position: Any = None
    orientation: Any = None
    sizes = {"radius": ((), {"least": 0}), "length": ((), {"least": 0})}

    def attach(
        self, element: BetweenBodies, field: str, pose: Pose, user_frame: Pose
    ) -> dict[str, Any]:
        """Returns the lengths, and the center and the axis in the body frame; see `Shape`."""
        result = super().attach(element, field, pose, user_frame)
        return {name: x for name, x in result.items() if name not in AXES[:2]}


@dataclass(frozen=True)
class Cylinder(Shape):
    """A cylinder along z.

    Attributes:
        radius: radius r > 0 [m].
        length: length > 0 [m].
        position: center in the world at assembly, (3,) [m]. If None, the origin of the user's frame
            of the body.
        orientation: orientation of its axes in the world at assembly, a quaternion (4,). If None,
            the orientation of the user's frame.
    """

    radius: Any
    length: Any
    position: Any = None
    orientation: Any = None
    sizes = {"radius": ((), {"above": 0}), "length": ((), {"above": 0})}


@dataclass(frozen=True)
class Box(Shape):
    """A box.

    Attributes:
        size: edge lengths > 0, (3,) [m].
        position: center in the world at assembly, (3,) [m]. If None, the origin of the user's frame
            of the body.
        orientation: orientation of its edges in the world at assembly, a quaternion (4,). If None,
            the orientation of the user's frame.
    """

    size: Any
    position: Any = None
    orientation: Any = None
    sizes = {"size": ((3,), {"above": 0})}


@dataclass(frozen=True)
class Ellipsoid(Shape):
    """An ellipsoid.

    Attributes:
        radii: semi-axes > 0, (3,) [m].
        position: center in the world at assembly, (3,) [m]. If None, the origin of the user's frame
            of the body.
        orientation: orientation of its axes in the world at assembly, a quaternion (4,). If None,
            the orientation of the user's frame.
    """

    radii: Any
    position: Any = None
    orientation: Any = None
    sizes = {"radii": ((3,), {"above": 0})}


@dataclass(frozen=True)
class Hull(Shape):
    """The convex hull of points, such as the vertices of a mesh.

    Attributes:
        points: the points in the world at assembly, (k, 3) [m], with k ≥ 2.
    """

    points: Any

    def attach(
        self, element: BetweenBodies, field: str, pose: Pose, user_frame: Pose
    ) -> dict[str, Any]:
        """Returns the points in the body frame.

        Raises:
            ValueError: the points have a wrong shape or are not finite, or the body is a particle.
        """
        anchor = own_points(element, f"{field}.points", self.points, pose)
        if not isinstance(anchor, Grid):
            raise ValueError(
                f"{label(element)}: {field}.points must have shape (k, 3) with k ≥ 2, got (3,)."
            )
        return {"anchor": anchor}

    @classmethod
    def solid(cls, p: Mapping[str, Any], side: str, frame: BodyFrame) -> Solid:
        """Returns the hulls of many contacts in the world frame; see `Shape.solid`."""
        values = p[f"anchor_{side}"].values
        points = Vector(*(values[:, :, i] for i in range(3)))
        axes = tuple(frame.direction(u).position for u in coordinate_axes(3))
        return Solid(frame.point(zeros(3)).position, axes, points=points)
