"""Groups the elements of a scene by their class and by the kinds of bodies on which they act."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.builders.coordinate_elements import CoordinateElements
from jaxcon.builders.inputs import Resolved
from jaxcon.constraints.base import Joint, Joints
from jaxcon.constraints.curves import Curves, PointOnCurve
from jaxcon.constraints.custom import CustomOnBodies, Holonomic, UserFunction, VelocityLevel
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.momentum import Momenta, PrescribedMomentum
from jaxcon.contact.contact import Contacts
from jaxcon.contact.limits import Inequality, InequalityOnBodies, numbers_of
from jaxcon.core import checks
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.geometry.pose import Pose
from jaxcon.system.body_system import MassProperties
from jaxcon.system.elements import BetweenBodies, Element, label, stack
from jaxcon.system.forces import (
    CustomForce,
    CustomForces,
    ExternalWrench,
    ExternalWrenches,
    ForceElement,
    ForceElements,
)
from jaxcon.system.layout import WORLD, Group, Layout, Place

T = TypeVar("T")


def lay_out(
    dim: int, bodies: dict[str, Resolved], elements: Iterable[Element]
) -> tuple[Layout, tuple[MassProperties, ...]]:
    """Returns the layout of coordinates and control channels, and the mass properties of groups.

    Args:
        dim: 2 or 3.
        bodies: the bodies in their principal frames, by name.
        elements: all elements of the scene.
    """
    kinds = {body.kind: None for body in bodies.values() if body.kind is not None}
    groups: list[Group] = []
    inertia: list[MassProperties] = []
    q = v = u = 0
    for kind in kinds:
        names = tuple(name for name, body in bodies.items() if body.kind == kind)
        groups.append(Group(kind, names, q, v))
        q, v = q + kind.n_q * len(names), v + kind.n_v * len(names)
        rows = [{"mass": bodies[n].mass, "moments": bodies[n].moments} for n in names]
        inertia.append(MassProperties(**stack(rows)))
    controls: list[tuple[str, int, int]] = []
    for element in elements:
        width = element.controls
        name = element.body if isinstance(element, ExternalWrench) else None
        if isinstance(name, str) and name in bodies:
            kind = bodies[name].kind
            width = 0 if kind is None else kind.n_v
        if width:
            controls.append((element.name, u, u + width))
            u += width
    fixed = tuple(name for name, body in bodies.items() if body.kind is None)
    return Layout(dim, tuple(groups), fixed, tuple(controls)), tuple(inertia)


class Gather:
    """Finds and checks the bodies of the elements of a scene, and groups equal elements.

    Args:
        dim: 2 or 3.
        dtype: dtype of every number.
        layout: names and indices.
        poses: the principal frames to which elements are attached, by body name.
        offsets: the pose of the user's frame in the principal frame, by body name.
        elements: all elements of the scene.
    """

    def __init__(
        self,
        dim: int,
        dtype: DType,
        layout: Layout,
        poses: dict[str, Pose],
        offsets: dict[str, Pose],
        elements: Iterable[Element],
    ) -> None:
        self.dim, self.dtype, self.layout, self.poses = dim, dtype, layout, poses
        self.offsets, self.elements = offsets, elements
        self.origin = Pose(jnp.zeros(dim, dtype))
        joints = [e for e in self._of(Joint) if not isinstance(e, PointOnCurve)]
        groups = [Joints(*group) for group in self._gather(joints)]
        self.on_coordinates = CoordinateElements(groups, elements, layout, dtype)
        self.joints = self.on_coordinates.joints

    def constraints(self) -> list[Any]:
        """Returns the groups of equality constraints in their order in the system.

        Joints and tendons come first, then drives, couplings and rotors, then curves, momenta and
        users' functions.
        """
        curves, momenta = [], []
        drives = self.on_coordinates.drives(self._of(Drive), self._params, _bare)
        held = [*drives, *self.on_coordinates.couplings(), *self.on_coordinates.armatures()]
        for curve in self._of(PointOnCurve):
            self._check_bodies(curve)
            frame = self.offsets.get(curve.body_a, self.origin)
            a, b = self.poses[curve.body_a], self.poses[curve.body_b]
            numbers = stack([curve.attach(a, b, frame)])
            places = tuple(self._place((name,)) for name in curve.bodies)
            bare = dataclasses.replace(curve, point=None, params=None)
            curves.append(Curves(numbers, (curve.name,), places, bare, self._params(curve)))
        for law in self._of(PrescribedMomentum):
            bodies = self.layout.bodies if law.bodies is None else law.bodies
            law = dataclasses.replace(law, bodies=bodies)
            places = self._places(law)
            for name, place in zip(bodies, places, strict=True):
                if place.group is None:
                    raise ValueError(
                        f"{label(law)}: '{name}' is fixed to the world and has no momentum."
                    )
            numbers = stack([law.attach(self.dim, self.dtype)])
            bare = dataclasses.replace(law, value=None)
            momenta.append(Momenta(numbers, (law.name,), places, bare))
        custom = [
            CustomOnBodies(self._params(c), _bare(c), self._moving(c))
            for c in self._of(Holonomic, VelocityLevel)
        ]
        return [*self.joints, *held, *curves, *momenta, *custom]

    def bounds(self) -> list[Any]:
        """Returns the groups of inequality constraints.

        Bounds of joint coordinates come first, then contacts between bodies, then users' functions.
        """
        pairs = [e for e in self._of(BetweenBodies) if not isinstance(e, Joint | ForceElement)]
        touches = [Contacts(*group) for group in self._gather(pairs)]
        inequalities = [
            InequalityOnBodies(self._params(c), c.bare, self._moving(c), numbers_of(c, self.dtype))
            for c in self._of(Inequality)
        ]
        return [*self.on_coordinates.bounds(), *touches, *inequalities]

    def forces(self) -> list[Any]:
        """Returns the groups of force elements of every class."""
        simple = [ForceElements(*group) for group in self._gather(self._of(ForceElement))]
        wrenches = []
        for group in self._gather(self._of(ExternalWrench)):
            starts = tuple(self.layout.control(name).start for name in group[1])
            wrenches.append(ExternalWrenches(*group, starts=starts))
        custom = []
        for force in self._of(CustomForce):
            places, channel = self._places(force), (0, 0)
            if force.controls:
                inputs = self.layout.control(force.name)
                channel = (inputs.start, inputs.stop)
            custom.append(CustomForces(self._params(force), _bare(force), places, channel))
        return [*simple, *self.on_coordinates.forces(), *wrenches, *custom]

    def _of(self, *classes: type[T]) -> list[T]:
        """Returns the elements of the given classes."""
        return [element for element in self.elements if isinstance(element, classes)]

    def _moving(self, element: UserFunction) -> tuple[Place, ...]:
        """Returns the places of the bodies of a user's element, without fixed bodies."""
        return tuple(place for place in self._places(element) if place.group is not None)

    def _places(
        self, element: UserFunction | PrescribedMomentum | CustomForce
    ) -> tuple[Place, ...]:
        """Checks the bodies of a user's element; returns one `Place` for each body.

        Raises:
            ValueError: the bodies are not a tuple of names, or a body is unknown.
        """
        if not isinstance(element.bodies, tuple) or not element.bodies:
            raise ValueError(
                f"{label(element)}: bodies must be a tuple of names, got {element.bodies!r}."
            )
        self._check_bodies(element)
        return tuple(self._place((name,)) for name in element.bodies)

    def _params(self, element: UserFunction | CustomForce | Drive | PointOnCurve) -> PyTree:
        """Returns the user's parameters of an element as arrays.

        Numbers and floating arrays get the dtype of the scene; other arrays keep their dtype.
        """

        def convert(x: Scalar) -> Array:
            if checks.is_discrete(x):
                return jnp.asarray(x)
            return checks.real(label(element), "params", x, self.dtype, np.shape(x))

        return jax.tree.map(convert, element.params)

    def _gather(self, elements: list[Any]) -> list[tuple[Any, ...]]:
        """Checks elements, and groups those of one kind whose bodies are in the same groups.

        Returns:
            The values of the fields of `Elements`, as a tuple for each group of elements.
        """
        groups: dict[Any, list[Any]] = {}
        for element in elements:
            self._check_bodies(element)
            poses = [self.poses[name] for name in element.bodies]
            if element.framed:
                poses += [self.offsets.get(name, self.origin) for name in element.bodies]
            params = element.attach(*poses)
            element.check_numbers(label(element), vars(element), self.origin.position.dtype)
            sides = tuple(self._place((name,)).group for name in element.bodies)
            fields = tuple((field, jax.tree.map(jnp.shape, x)) for field, x in params.items())
            groups.setdefault((element.kind, sides, fields), []).append((element, params))
        result = []
        for (kind, *_), members in groups.items():
            names = tuple(element.name for element, _ in members)
            columns = zip(*(element.bodies for element, _ in members), strict=True)
            places = tuple(map(self._place, columns))
            result.append((stack([p for _, p in members]), names, places, kind))
        return result

    def _place(self, names: tuple[str, ...]) -> Place:
        """Returns the `Place` of bodies, one for each element.

        Args:
            names: the names of the bodies; all in one group, or all fixed to the world.
        """
        if names[0] not in self.layout.places:
            return Place(None, (), names)
        groups, indices = zip(*(self.layout.locate(name) for name in names), strict=True)
        return Place(groups[0], indices)

    def _check_bodies(self, element: Any) -> None:
        """Checks that an element's bodies exist, differ and can move, and that the dimension fits.

        Raises:
            ValueError: a body is unknown, two bodies are the same, no body can move, a body has no
                orientation but needs one, or the element exists in another dimension only.
        """
        owner, names = label(element), element.bodies
        for name in names:
            if not isinstance(name, str) or name not in self.poses:
                known = [WORLD, *self.layout.bodies, *self.layout.fixed]
                raise ValueError(f"{owner}: body {name!r} is unknown; known are {known}.")
        moving = [name for name in names if name in self.layout.places]
        repeated = len(set(moving)) < len(moving) or len(names) == 2 and names[0] == names[1]
        if repeated and not element.repeats:
            raise ValueError(f"{owner}: it joins body '{names[0]}' to itself.")
        if not moving:
            raise ValueError(f"{owner}: it acts on {list(names)}, none of which can move.")
        if self.dim not in element.dims:
            raise ValueError(f"{owner}: it exists in {element.dims[0]} dimensions only.")
        for name in names:
            if element.oriented and self.poses[name].orientation is None:
                raise ValueError(
                    f"{owner}: it needs an orientation, but '{name}' is a particle; a Coincident"
                    " joins a particle to a body."
                )
        if self.dim == 2 and element.turns and element.axis is not None:
            raise ValueError(f"{owner}: in the plane the axis is the normal; give none.")


def _bare(description: UserFunction | CustomForce | Drive) -> Any:
    """Returns a copy of a user's element without its params, which is static and hashable."""
    return dataclasses.replace(description, params=None)
