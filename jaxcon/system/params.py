"""Reading and replacing the numbers of a system by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from jaxcon.core import checks
from jaxcon.core.typing import PyTree
from jaxcon.system import inertial
from jaxcon.system.elements import replace_at

if TYPE_CHECKING:
    from jaxcon.geometry.pose import Pose
    from jaxcon.system.body_system import BodySystem

S = TypeVar("S", bound="BodySystem")


def read(system: BodySystem, only: Collection[str] | None = None) -> dict[str, Any]:
    """Returns the numbers of a system by name: `gravity`, and the fields of bodies and elements.

    Args:
        system: the system.
        only: the names to read; None for all.
    """
    result: dict[str, Any] = {"gravity": system.gravity}
    # the axes of bodies with a Flexure cannot be changed: its energy depends on them
    held = {
        system.layout.groups[place.group].names[i]
        for element in system.forces
        if element.law.by_principal_axes
        for place in element.places
        if place.group is not None
        for i in place.indices
    }
    for name in system.layout.bodies:
        if only is None or name in only:
            fields, _ = _body(system, name)
            result[name] = {k: x for k, x in fields.items() if k != "axes" or name not in held}
    for element in (*system.constraints, *system.forces, *system.bounds):
        for i, name in enumerate(element.names):
            if only is None or name in only:
                result[name] = element.get(i)
    return result


def replaced(system: S, changes: Mapping[str, Any]) -> S:
    """Returns the system with some of its numbers replaced.

    Args:
        system: the system.
        changes: new values by name and field.

    Raises:
        ValueError: an unknown name or field, a wrong shape, or a value out of range.
    """
    if not isinstance(changes, Mapping):
        raise ValueError(f"with_params: give a mapping of names to changes, got {changes!r}.")
    numbers = read(system, changes)
    for name, fields in changes.items():
        _check(system, numbers, name, fields)
    gravity = system.gravity
    if "gravity" in changes:
        shape = (system.layout.dim,)
        gravity = checks.real("with_params", "gravity", changes["gravity"], gravity.dtype, shape)
    bodies = {
        name: inertial.changed(name, fields, *_body(system, name))
        for name, fields in changes.items()
        if name in system.layout.places and fields
    }
    shifts = {name: x.shift for name, x in bodies.items() if x.shift is not None}

    def elements(groups: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(inertial.moved(g, shifts, system.layout).set(changes) for g in groups)

    inertia = []
    for group, properties in zip(system.layout.groups, system.inertia, strict=True):
        mass, moments = properties.mass, properties.moments
        for i, name in enumerate(group.names):
            if name in bodies:
                mass = replace_at(name, mass, i, bodies[name].mass)
                if moments is not None:
                    moments = replace_at(name, moments, i, bodies[name].moments)
        inertia.append(dataclasses.replace(properties, mass=mass, moments=moments))
    return dataclasses.replace(
        system,
        gravity=gravity,
        inertia=tuple(inertia),
        offsets=system.offsets | {name: bodies[name].offset for name in shifts},
        constraints=elements(system.constraints),
        forces=elements(system.forces),
        bounds=elements(system.bounds),
    )


def _body(system: BodySystem, name: str) -> tuple[dict[str, Any], Pose | None]:
    """Returns the inertial parameters of a body by field, and the pose of its user's frame.

    The pose is relative to the principal frame; None if both frames coincide.
    """
    (group, i), offset = system.layout.locate(name), system.offsets.get(name)
    return inertial.numbers(system.inertia[group], i, offset), offset


def _check(system: BodySystem, known: Mapping[str, Any], name: str, fields: PyTree) -> None:
    """Checks that a changed name and its fields exist.

    Args:
        system: the system.
        known: the current numbers, by name and field.
        name: the name to change.
        fields: new values by field.

    Raises:
        ValueError: an unknown name or field.
    """
    if name in system.fixed:
        raise ValueError(f"with_params: '{name}' is fixed to the world and has no numbers.")
    if name not in known:
        raise ValueError(f"with_params: '{name}' is unknown; known are {list(read(system))}.")
    if name == "gravity":
        return
    if not isinstance(fields, Mapping):
        raise ValueError(
            f"with_params: give '{name}' as a mapping of its fields {sorted(known[name])}, got"
            f" {fields!r}."
        )
    if unknown := set(fields) - set(known[name]):
        owners = (group for group in system.bounds if name in group.names)
        why = "".join(group.missing_field_hint(unknown) for group in owners)
        raise ValueError(f"'{name}' has no {sorted(unknown)}, it has {sorted(known[name])}.{why}")
