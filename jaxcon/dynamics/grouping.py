"""Elements of one class on bodies of the same kinds, gathered side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.base import Joints
from jaxcon.constraints.contact import Touches
from jaxcon.constraints.curves import Curves, PointOnCurve
from jaxcon.constraints.custom import CustomOnBodies, Holonomic, VelocityLevel
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.inequality import Inequality, InequalityOnBodies, numbers_of
from jaxcon.constraints.momentum import AngularMomentum, LinearMomentum, Momenta
from jaxcon.core import checks
from jaxcon.dynamics.along import Along
from jaxcon.dynamics.inputs import Resolved
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label, stack
from jaxcon.model.forces import (
    CustomForce,
    CustomForces,
    ExternalWrench,
    ExternalWrenches,
    ForceElements,
)
from jaxcon.model.layout import WORLD, Group, Layout, Place
from jaxcon.model.system import MassProperties

SPECIAL = (
    *(Drive, PointOnCurve, Holonomic, VelocityLevel, AngularMomentum, LinearMomentum),
    *(ExternalWrench, CustomForce),
)
"""Elements that are not attached to their bodies by `attach` alone."""


def lay_out(
    dim: int, bodies: dict[str, Resolved], elements: Iterable[Any]
) -> tuple[Layout, tuple[MassProperties, ...]]:
    """The order of coordinates and control channels, and the mass properties in that order."""
    kinds = {body.kind: None for body in bodies.values() if body.kind is not None}
    groups: list[Group] = []
    inertia: list[MassProperties] = []
    q = v = 0
    for kind in kinds:
        names = tuple(name for name, body in bodies.items() if body.kind == kind)
        groups.append(Group(kind, names, q, v))
        q, v = q + kind.n_q * len(names), v + kind.n_v * len(names)
        rows = [{"mass": bodies[n].mass, "moments": bodies[n].moments} for n in names]
        inertia.append(MassProperties(**stack(rows)))
    controls: list[tuple[str, int, int]] = []
    u = 0
    for element in elements:
        width = 0
        if isinstance(element, ExternalWrench) and element.body in bodies:
            kind = bodies[element.body].kind
            width = 0 if kind is None else kind.n_v
        elif not isinstance(element, ExternalWrench):
            width = getattr(element, "controls", 0)
        if width:
            controls.append((element.name, u, u + width))
            u += width
    fixed = tuple(name for name, body in bodies.items() if body.kind is None)
    return Layout(dim, tuple(groups), fixed, tuple(controls)), tuple(inertia)


class Gather:
    """Finds the bodies of elements, checks them, and puts equal ones side by side."""

    def __init__(
        self,
        dim: int,
        dtype: Any,
        layout: Layout,
        poses: dict[str, Pose],
        own: dict[str, Pose],
    ) -> None:
        """`poses` are of the frames where elements are attached, `own` of users' frames in them."""
        self.dim, self.dtype, self.layout, self.poses, self.own = dim, dtype, layout, poses, own

    def along(self, elements: Iterable[Any]) -> Along:
        """The joints, and what acts along their coordinates."""
        plain = [e for e in elements if not isinstance(e, SPECIAL) and hasattr(e, "rows")]
        return Along(self.joints(plain), elements, self.layout, self.dtype)

    def constraints(self, elements: Iterable[Any], along: Along) -> list[Any]:
        """Joints first, then what constrains their coordinates, then the user's constraints."""
        drives = along.drives(_of(elements, Drive), self._params, _bare)
        held = [*drives, *along.couplings(), *along.armatures()]
        curves = self.curves(_of(elements, PointOnCurve))
        momenta = self.momenta(_of(elements, AngularMomentum, LinearMomentum))
        custom = self.customs(_of(elements, Holonomic, VelocityLevel))
        return [*along.joints, *held, *curves, *momenta, *custom]

    def bounds(self, elements: Iterable[Any], along: Along) -> list[Any]:
        """What has bounded multipliers: along joints, and between bodies."""
        pairs = [e for e in elements if hasattr(e, "bounds") and not hasattr(e, "joint")]
        for pair in pairs:
            self._check_joint(pair)
        groups = self._gather(pairs, lambda e: (e.body_a, e.body_b))
        touches = [Touches(p, names, places, law=cls) for cls, p, names, places in groups]
        return [*along.bounds(), *touches, *self.inequalities(_of(elements, Inequality))]

    def forces(self, elements: Iterable[Any], along: Along) -> list[Any]:
        """Force elements of every class."""
        plain = [e for e in elements if not isinstance(e, SPECIAL) and hasattr(e, "forces")]
        return [
            *self.simple_forces(plain),
            *along.forces(),
            *self.wrenches(_of(elements, ExternalWrench)),
            *self.user_forces(_of(elements, CustomForce)),
        ]

    def joints(self, joints: list[Any]) -> list[Any]:
        """Joints by class and by the kinds of their bodies."""
        for joint in joints:
            self._check_joint(joint)
        groups = self._gather(joints, lambda j: (j.body_a, j.body_b))
        return [Joints(p, names, places, joint=cls) for cls, p, names, places in groups]

    def simple_forces(self, forces: list[Any]) -> list[Any]:
        """Springs, constant forces and their like by class and by the kinds of their bodies."""
        for force in forces:
            self._check_bodies(force, force.bodies)
        groups = self._gather(forces, lambda f: f.bodies)
        return [ForceElements(p, names, places, law=cls) for cls, p, names, places in groups]

    def wrenches(self, wrenches: list[Any]) -> list[Any]:
        """External wrenches by the kind of their body."""
        for wrench in wrenches:
            self._check_bodies(wrench, wrench.bodies)
        result = []
        for _, params, names, places in self._gather(wrenches, lambda w: w.bodies):
            starts = tuple(self.layout.control(name).start for name in names)
            result.append(ExternalWrenches(params, names, places, starts=starts))
        return result

    def curves(self, curves: list[Any]) -> list[Any]:
        """Points on users' curves, one group each."""
        origin = Pose(jnp.zeros(self.dim, self.dtype))
        result = []
        for curve in curves:
            self._check_joint(curve)
            names = (curve.body_a, curve.body_b)
            own = self.own.get(curve.body_a, origin)
            numbers = stack([curve.attach(*(self.poses[name] for name in names), own)])
            places = tuple(self._place((name,)) for name in names)
            bare = dataclasses.replace(curve, point=None, params=None)
            result.append(Curves(numbers, (curve.name,), places, bare, self._params(curve)))
        return result

    def customs(self, constraints: list[Any]) -> list[Any]:
        """User constraints on bodies, one group each."""
        return [CustomOnBodies(self._params(c), _bare(c), self._moving(c)) for c in constraints]

    def inequalities(self, constraints: list[Inequality]) -> list[Any]:
        """One-sided user constraints on bodies, one group each."""
        return [
            InequalityOnBodies(self._params(c), c.bare, self._moving(c), numbers_of(c, self.dtype))
            for c in constraints
        ]

    def momenta(self, momenta: list[Any]) -> list[Any]:
        """Prescribed momenta, one group each."""
        result = []
        for one in momenta:
            bodies = self.layout.bodies if one.bodies is None else one.bodies
            one = dataclasses.replace(one, bodies=bodies)
            self._check_user(one)
            params = stack([one.attach(self.dim, self.dtype)])
            places = tuple(self._place((name,)) for name in bodies)
            for name, place in zip(bodies, places, strict=True):
                if place.group is None:
                    raise ValueError(
                        f"{type(one).__name__} '{one.name}': '{name}' is fixed to the world and"
                        " has no momentum."
                    )
            bare = dataclasses.replace(one, value=None)
            result.append(Momenta(params, (one.name,), places, law=bare))
        return result

    def user_forces(self, forces: list[Any]) -> list[Any]:
        """User forces, one group each."""
        result = []
        for force in forces:
            self._check_user(force)
            places = tuple(self._place((name,)) for name in force.bodies)
            channel = (0, 0)
            if force.controls:
                own = self.layout.control(force.name)
                channel = (own.start, own.stop)
            params = self._params(force)
            result.append(
                CustomForces(params, (force.name,), places, force.function, channel, force.bodies)
            )
        return result

    def _moving(self, element: Any) -> tuple[Place, ...]:
        """The bodies of a user's element that have coordinates."""
        self._check_user(element)
        return tuple(self._place((n,)) for n in element.bodies if n in self.layout.places)

    def _params(self, element: Any) -> Any:
        def convert(x: Any) -> Any:
            got = getattr(x, "dtype", None)
            if got is not None and not jnp.issubdtype(got, jnp.floating):
                return jnp.asarray(x)
            shape = jnp.asarray(x).shape
            return checks.real(f"'{element.name}'", "params", x, self.dtype, shape)

        return jax.tree.map(convert, element.params)

    def _gather(self, elements: list[Any], bodies: Any) -> list[Any]:
        groups: dict[Any, list[Any]] = {}
        for element in elements:
            names = bodies(element)
            params = self._attach(element, names)
            sides = tuple(self._group(name) for name in names)
            fields = tuple((field, jax.tree.map(jnp.shape, x)) for field, x in params.items())
            groups.setdefault((_kind(element), sides, fields), []).append((element, params))
        result = []
        for (cls, _, _), members in groups.items():
            names = tuple(element.name for element, _ in members)
            columns = zip(*(bodies(element) for element, _ in members), strict=True)
            places = tuple(map(self._place, columns))
            result.append((cls, stack([p for _, p in members]), names, places))
        return result

    def _attach(self, element: Any, names: tuple[str, ...]) -> dict[str, Any]:
        """The numbers of an element, which may ask for the users' frames of its bodies too."""
        poses = [self.poses[name] for name in names]
        if getattr(element, "framed", False):
            origin = Pose(jnp.zeros(self.dim, self.dtype))
            poses += [self.own.get(name, origin) for name in names]
        return element.attach(*poses)

    def _group(self, name: str) -> int | None:
        return self.layout.locate(name)[0] if name in self.layout.places else None

    def _place(self, names: tuple[str, ...]) -> Place:
        if names[0] not in self.layout.places:
            return Place(None, (), names)
        located = [self.layout.locate(name) for name in names]
        return Place(located[0][0], tuple(index for _, index in located))

    def _check_bodies(self, element: Any, names: tuple[str, ...]) -> None:
        owner = label(element)
        for name in names:
            if name not in self.poses:
                known = [WORLD, *self.layout.bodies, *self.layout.fixed]
                raise ValueError(f"{owner}: body '{name}' is unknown; known are {known}.")
        moving = [name for name in names if name in self.layout.places]
        if len(set(moving)) < len(moving) or len(names) == 2 and names[0] == names[1]:
            raise ValueError(f"{owner}: it joins body '{names[0]}' to itself.")
        if not any(name in self.layout.places for name in names):
            raise ValueError(f"{owner}: it acts on {list(names)}, none of which can move.")

    def _check_joint(self, joint: Any) -> None:
        owner = label(joint)
        names = (joint.body_a, joint.body_b)
        self._check_bodies(joint, names)
        if self.dim not in getattr(joint, "dims", (2, 3)):
            raise ValueError(f"{owner}: this joint exists in {joint.dims[0]} dimensions only.")
        for name in names:
            if getattr(joint, "oriented", False) and self.poses[name].orientation is None:
                raise ValueError(
                    f"{owner}: it needs an orientation, but '{name}' is a particle; a Coincident"
                    " joins a particle to a body."
                )
        turns = getattr(joint, "turns", False)
        if self.dim == 2 and turns and getattr(joint, "axis", None) is not None:
            raise ValueError(f"{owner}: in the plane the axis is the normal; give none.")

    def _check_user(self, element: Any) -> None:
        owner = label(element)
        if not isinstance(element.bodies, tuple) or not element.bodies:
            raise ValueError(f"{owner}: bodies must be a tuple of names, got {element.bodies!r}.")
        self._check_bodies(element, element.bodies)


def _kind(element: Any) -> Any:
    """What elements of one group share: a class, or what the element says."""
    return getattr(element, "kind", type(element))


def _of(elements: Iterable[Any], *classes: type) -> list[Any]:
    return [element for element in elements if isinstance(element, classes)]


def _bare(description: Any) -> Any:
    """The description without its numbers: static, hashable."""
    return dataclasses.replace(description, params=None)
