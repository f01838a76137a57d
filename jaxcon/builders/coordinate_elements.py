"""Groups the elements that act on joint coordinates, by their class and their groups of joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from jaxcon.constraints.armature import Armature, Armatures
from jaxcon.constraints.base import Joints
from jaxcon.constraints.couplings import Coupling, Couplings
from jaxcon.constraints.drive import Drive, Drives
from jaxcon.constraints.tendons import Tendon, Tendons
from jaxcon.contact.limits import Bounds
from jaxcon.core import checks
from jaxcon.core.typing import DType, PyTree
from jaxcon.system.actuators import JointForce, JointForces
from jaxcon.system.coordinates import (
    Counters,
    End,
    JointCoordinate,
    OnCoordinates,
    OnJoint,
    TurnCounter,
    at,
    directory,
    find,
    numbered,
    turns_over,
)
from jaxcon.system.elements import Element, label, stack
from jaxcon.system.layout import Layout, Place


class CoordinateElements:
    """The elements that act on joint coordinates, and the coordinates with counted turns.

    Args:
        joints: groups of joints, which come first among the constraints of the system. The
            attribute `joints` also has the groups of tendons, which follow them.
        elements: all elements of the scene.
        layout: names and indices.
        dtype: dtype of every number.
    """

    def __init__(
        self, joints: list[Joints], elements: Iterable[Element], layout: Layout, dtype: DType
    ) -> None:
        self.joints, self.layout, self.dtype = joints, layout, dtype
        self.counters: Counters = {}
        self.elements = [e for e in elements if isinstance(e, OnCoordinates)]
        where = directory(joints)
        tendons = [e for e in self.elements if isinstance(e, Tendon)]
        self.ends = {e.name: self._ends(e, where) for e in tendons}
        self.joints = [*joints, *self._tendons(tendons)]
        where = directory(self.joints)
        others = [e for e in self.elements if not isinstance(e, Tendon)]
        self.ends |= {e.name: self._ends(e, where) for e in others}
        counting: dict[tuple[int, str], set[int]] = {}
        for element in self.elements:
            for group, index, name in self.ends[element.name]:
                turns = turns_over(self.joints[group].law, name, layout.dim)
                if isinstance(element, TurnCounter) and not turns and layout.dim == 3:
                    raise ValueError(
                        f"{label(element)}: the {name} of '{element.joint}' makes no turns."
                    )
                if turns and element.counts:
                    counting.setdefault((group, name), set()).add(index)
        counted, self.turns = [], 0  # `turns` is the number of counted angles
        for (group, name), indices in counting.items():
            counters = tuple(range(self.turns, self.turns + len(indices)))
            counted.append(JointCoordinate(group, tuple(sorted(indices)), name, counters))
            self.turns += len(indices)
        self.counted = tuple(counted)
        self.counters = numbered(self.counted)
        self.joints = [*joints, *map(self._with_counters, self.joints[len(joints) :])]

    def _tendons(self, tendons: list[Tendon]) -> list[Tendons]:
        """Returns the groups of tendons, without the counters of their coordinates."""
        return [
            Tendons(params, names, places, Tendon, terms=terms, sides=sides)
            for (params, names, places, _), terms, sides, _ in self._gather(tendons)
        ]

    def _with_counters(self, group: Tendons) -> Tendons:
        """Returns a group of tendons whose coordinates count whole turns."""
        ends = [[(c.group, j, c.name) for j in c.joints] for c in group.terms]
        return dataclasses.replace(group, terms=tuple(at(self.counters, x) for x in ends))

    def forces(self) -> list[JointForces]:
        """Returns the groups of springs, dampers, motors and servos."""
        acting = [e for e in self.elements if isinstance(e, JointForce)]
        groups = self._gather(acting)
        return [
            JointForces(*group, coordinate=coordinate, starts=starts)
            for group, (coordinate,), _, starts in groups
        ]

    def armatures(self) -> list[Armatures]:
        """Returns the groups of rotors."""
        groups = self._gather([e for e in self.elements if isinstance(e, Armature)])
        return [Armatures(*group, coordinate=coordinate) for group, (coordinate,), *_ in groups]

    def bounds(self) -> list[Bounds]:
        """Returns the groups of limits, dry friction, rate limits and rate motors."""
        bounded = [e for e in self.elements if isinstance(e, OnJoint) and e.law is not None]
        groups = self._gather(bounded)
        return [
            Bounds(*group, coordinate=coordinate, starts=starts)
            for group, (coordinate,), _, starts in groups
        ]

    def couplings(self) -> list[Couplings]:
        """Returns the groups of gears, racks, belts, pulleys, differentials and cams."""
        groups = self._gather([e for e in self.elements if isinstance(e, Coupling)])
        return [
            Couplings(*group, coordinates=coordinates, sides=sides)
            for group, coordinates, sides, _ in groups
        ]

    def drives(
        self, drives: list[Drive], params: Callable[[Any], PyTree], bare: Callable[[Any], Any]
    ) -> list[Drives]:
        """Returns the prescribed motions, each as a group with one element.

        Args:
            drives: the drives of the scene.
            params: a function that returns the user's parameters of an element.
            bare: a function that returns an element without its parameters.
        """
        result = []
        for drive in drives:
            ends = self.ends[drive.name]
            places, _ = self._places((ends,))
            result.append(Drives(params(drive), bare(drive), places, at(self.counters, ends)))
            result[-1].check(self.dtype)
        return result

    def _gather(self, elements: list[Any]) -> Iterator[tuple[Any, Any, Any, Any]]:
        """Groups elements of one class whose coordinates belong to the same groups of joints.

        Yields:
            A tuple of four items for each group:
            the fields of `Elements`, with `places`, the places of all bodies of the joints;
            the coordinates on which an element acts, each a `JointCoordinate` of all elements;
            for each coordinate, the indices in `places` of the bodies of its joint;
            the start of each element's control channel, or () for elements without control.
        """
        groups: dict[Any, list[Any]] = {}
        for element in elements:
            ends, params = self.ends[element.name], element.attach(self.dtype)
            element.check_numbers(label(element), vars(element), self.dtype)
            group, _, name = ends[0]
            if self.joints[group].law.coordinates[name] == "rad":
                for field in element.angles:
                    checks.radians(label(element), field, params[field])
            # the bodies of the joints; bodies fixed to the world count as one
            bodies = [
                (place.group, -1 if place.group is None else place.indices[index])
                for group, index, _ in ends
                for place in self.joints[group].places
            ]
            key = (
                type(element),
                tuple((field, x.shape) for field, x in params.items()),
                tuple((group, name) for group, _, name in ends),
                tuple(bodies.index(body) for body in bodies),
                tuple(len(at(self.counters, [end]).counters) for end in ends),
            )
            groups.setdefault(key, []).append((element, ends, params))
        for (cls, *_), members in groups.items():
            names = tuple(element.name for element, *_ in members)
            columns = tuple(zip(*(ends for _, ends, _ in members), strict=True))
            places, sides = self._places(columns)
            starts = tuple(self.layout.control(n).start for n in names) if cls.controls else ()
            coordinates = tuple(at(self.counters, column) for column in columns)
            yield (stack([p for *_, p in members]), names, places, cls), coordinates, sides, starts

    def _places(
        self, columns: tuple[Iterable[End], ...]
    ) -> tuple[tuple[Place, ...], tuple[tuple[int, ...], ...]]:
        """Finds the places of all bodies of the joints on which equal elements act.

        Args:
            columns: for each coordinate on which an element acts, this coordinate of each element.

        Returns:
            The places, without repetition; and for each coordinate, the indices in them of the
            places of its joint's bodies.
        """
        places: list[Place] = []
        sides = []
        for column in columns:
            group, joints, _ = zip(*column, strict=True)
            of_joint = self.joints[group[0]].select(joints).places
            for place in of_joint:
                places += [] if place in places else [place]
            sides.append(tuple(places.index(p) for p in of_joint))
        return tuple(places), tuple(sides)

    def _ends(self, element: OnCoordinates, where: dict[str, tuple[int, int]]) -> tuple[End, ...]:
        """Finds the joint coordinates on which an element acts.

        Args:
            element: the element, which names joints and coordinates.
            where: the group of each joint and its index in the group, by joint name.

        Raises:
            ValueError: a coordinate is unknown, used by tendons only, or coupled with itself. Or a
                prescribed or coupled coordinate, or that of a tendon, is not the integral of its
                rate.
        """
        ends = tuple(
            find(self.joints, where, label(element), *end) for end in element.joint_coordinates
        )
        for group, index, _ in ends:
            if self.joints[group].law.repeats and not isinstance(element, Tendon):
                raise ValueError(
                    f"{label(element)}: '{self.joints[group].names[index]}' has several points on"
                    " one body; add a Tendon over it and act on the tendon."
                )
        if len(set(ends)) < len(ends):
            raise ValueError(
                f"{label(element)}: it couples a coordinate with itself:"
                f" {element.joint_coordinates}."
            )
        for group, index, name in ends if isinstance(element, Coupling | Drive | Tendon) else ():
            if self.joints[group].law.coordinates[name] == "rotation":
                raise ValueError(
                    f"{label(element)}: the {name} of '{self.joints[group].names[index]}' is not"
                    " the integral of its rate; couple or drive the angle of a hinge."
                )
        return ends
