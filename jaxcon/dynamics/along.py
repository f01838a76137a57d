"""Elements that act along the coordinates of joints, gathered by the groups of these joints."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.armature import Armature, Armatures
from jaxcon.constraints.base import Joints
from jaxcon.constraints.couplings import Couplings
from jaxcon.constraints.drive import Drives
from jaxcon.constraints.limits import Bounds
from jaxcon.core import checks
from jaxcon.model.actuators import JointForces
from jaxcon.model.coordinates import (
    End,
    JointCoordinate,
    TurnCounter,
    at,
    directory,
    find,
    numbered,
    turns_over,
)
from jaxcon.model.elements import label, stack
from jaxcon.model.layout import Layout, Place


class Along:
    """Finds the coordinates that elements act on, and which of them count turns.

    Args:
        joints: groups of joints, as they stand first among the constraints of the system.
        elements: all elements of the scene.
        layout: names and indices.
        dtype: of every number.
    """

    def __init__(
        self, joints: list[Joints], elements: Iterable[Any], layout: Layout, dtype: Any
    ) -> None:
        self.joints, self.layout, self.dtype = joints, layout, dtype
        self.elements = [e for e in elements if hasattr(e, "joint") or hasattr(e, "along")]
        self.where = directory(joints)
        self.counted = self._count()
        self.counters = numbered(self.counted)

    def forces(self) -> list[JointForces]:
        """Springs, dampers, motors and servos."""
        acting = [e for e in self.elements if hasattr(e, "joint") and hasattr(e, "force")]
        result = []
        for cls, params, names, (along,), places, _ in self._gather(acting):
            own = [self.layout.control(n).start for n in names] if _width(cls) else ()
            forces = JointForces(params, names, places, law=cls, along=along, starts=tuple(own))
            result.append(forces)
        return result

    def armatures(self) -> list[Armatures]:
        """Rotors."""
        rotors = [e for e in self.elements if isinstance(e, Armature)]
        return [
            Armatures(params, names, places, along=along)
            for _, params, names, (along,), places, _ in self._gather(rotors)
        ]

    def bounds(self) -> list[Bounds]:
        """Limits, dry friction, and motors by their rate."""
        bounded = [e for e in self.elements if hasattr(e, "law") and hasattr(e, "joint")]
        result = []
        for cls, params, names, (along,), places, _ in self._gather(bounded):
            own = [self.layout.control(n).start for n in names] if _width(cls) else ()
            result.append(Bounds(params, names, places, law=cls, along=along, starts=tuple(own)))
        return result

    def couplings(self) -> list[Couplings]:
        """Gears and their like."""
        couplings = [e for e in self.elements if hasattr(e, "relation")]
        return [
            Couplings(params, names, places, law=cls, along=along, sides=sides)
            for cls, params, names, along, places, sides in self._gather(couplings)
        ]

    def drives(self, drives: list[Any], params: Callable[[Any], Any], bare: Any) -> list[Drives]:
        """Prescribed motions, one group each."""
        result = []
        for drive in drives:
            (end,) = self._ends(drive)
            along = at(self.counters, [end])
            places, _ = self._places(((end,),))
            one = Drives(params(drive), bare(drive), along, places)
            one.check(self.dtype)
            result.append(one)
        return result

    def _gather(self, elements: list[Any]) -> Iterable[Any]:
        """Elements of one class on coordinates of the same groups, with their bodies."""
        groups: dict[Any, list[Any]] = {}
        for element in elements:
            ends, params = self._ends(element), element.attach(self.dtype)
            group, _, name = ends[0]
            if self.joints[group].joint.coordinates[name] == "rad":
                for field in getattr(element, "angles", ()):
                    checks.radians(label(element), field, params[field])
            shapes = tuple((field, x.shape) for field, x in params.items())
            kinds = tuple((group, name) for group, _, name in ends)
            key = (type(element), shapes, kinds, self._pattern(ends))
            groups.setdefault(key, []).append((element, ends, params))
        for (cls, *_), members in groups.items():
            names = tuple(element.name for element, _, _ in members)
            columns = tuple(zip(*(ends for _, ends, _ in members), strict=True))
            along = tuple(at(self.counters, column) for column in columns)
            places, sides = self._places(columns)
            yield cls, stack([p for *_, p in members]), names, along, places, sides

    def _count(self) -> tuple[JointCoordinate, ...]:
        """The angles whose turns are counted, each once, and where the state holds them."""
        wanted: dict[tuple[int, str], set[int]] = {}
        for element in self.elements:
            for group, index, name in self._ends(element):
                turns = turns_over(self.joints[group].joint, name, self.layout.dim)
                if isinstance(element, TurnCounter) and not turns and self.layout.dim == 3:
                    raise ValueError(
                        f"{label(element)}: the {name} of '{element.joint}' makes no turns."
                    )
                if turns and getattr(element, "counts", True):
                    wanted.setdefault((group, name), set()).add(index)
        counted, start = [], 0
        for (group, name), indices in wanted.items():
            counters = tuple(range(start, start + len(indices)))
            counted.append(JointCoordinate(group, tuple(sorted(indices)), name, counters))
            start += len(indices)
        return tuple(counted)

    def _bodies(self, end: End) -> tuple[tuple[int | None, int], ...]:
        """Group and index of the bodies of a joint; those fixed to the world are all alike."""
        group, index, _ = end
        places = self.joints[group].places
        return tuple((p.group, -1 if p.group is None else p.indices[index]) for p in places)

    def _pattern(self, ends: tuple[End, ...]) -> tuple[int, ...]:
        """Which of the bodies of an element are the same one, and what its angles count."""
        bodies = [body for end in ends for body in self._bodies(end)]
        counts = [len(at(self.counters, [end]).counters) for end in ends]
        return (*(bodies.index(body) for body in bodies), *counts)

    def _places(
        self, columns: tuple[Iterable[End], ...]
    ) -> tuple[tuple[Place, ...], tuple[tuple[int, ...], ...]]:
        """The places of all bodies, each once, and for each coordinate those of its joint."""
        places: list[Place] = []
        sides = []
        for column in columns:
            group, joints, _ = zip(*column, strict=True)
            own = self.joints[group[0]].select(joints).places
            places += [p for p in own if p not in places]
            sides.append(tuple(places.index(p) for p in own))
        return tuple(places), tuple(sides)

    def _ends(self, element: Any) -> tuple[End, ...]:
        """The coordinates that an element acts on."""
        own = element.along if hasattr(element, "along") else ((element.joint, element.coordinate),)
        ends = tuple(find(self.joints, self.where, label(element), *end) for end in own)
        if len(set(ends)) < len(ends):
            raise ValueError(f"{label(element)}: it couples a coordinate with itself: {own}.")
        if hasattr(element, "along") or hasattr(element, "motion"):
            self._check_integrable(element, ends)
        return ends

    def _check_integrable(self, element: Any, ends: tuple[End, ...]) -> None:
        """Checks that a coordinate to be prescribed or coupled is the integral of its rate.

        Raises:
            ValueError: it is a component of a rotation vector.
        """
        for group, index, name in ends:
            if self.joints[group].joint.coordinates[name] == "rotation":
                raise ValueError(
                    f"{label(element)}: the {name} of '{self.joints[group].names[index]}' is not"
                    " the integral of its rate; couple or drive the angle of a hinge."
                )


def _width(cls: type) -> int:
    """How many control inputs elements of a class take."""
    return getattr(cls, "controls", 0)


def no_turns(counted: tuple[JointCoordinate, ...], dtype: Any) -> Any:
    """The turns at assembly, where every angle is zero."""
    n = sum(len(c.counters) for c in counted)
    return jnp.zeros(n, dtype) if n else ()
