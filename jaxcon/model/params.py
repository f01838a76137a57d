"""The numbers of a system by name: read, and replaced."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

from jaxcon.core import checks
from jaxcon.model import inertial
from jaxcon.model.elements import replace_at

POSITIVE = {"inertia", "length"}
NOT_NEGATIVE = {"stiffness", "damping", "rest_length"}
"""Fields of elements whose values are checked where they are known."""


def read(system: Any, only: Collection[str] | None = None) -> dict[str, Any]:
    """`gravity`, and the fields of each body, constraint and force by its name.

    Args:
        system: a `BodySystem`.
        only: the names that are wanted; None for all.
    """
    result: dict[str, Any] = {"gravity": system.gravity}
    held = _held(system)
    for name in system.layout.bodies:
        if only is None or name in only:
            fields, _ = _body(system, name)
            result[name] = {k: x for k, x in fields.items() if k != "axes" or name not in held}
    for element in (*system.constraints, *system.forces, *system.bounds):
        for i, name in enumerate(element.names):
            if only is None or name in only:
                result[name] = element.get(i)
    return result


def _held(system: Any) -> set[str]:
    """The bodies whose principal axes cannot turn, as elements go by them."""
    return {
        system.layout.groups[place.group].names[i]
        for element in system.forces
        if getattr(getattr(element, "law", None), "by_principal_axes", False)
        for place in element.places
        if place.group is not None
        for i in place.indices
    }


def replaced(system: Any, changes: Mapping[str, Any]) -> Any:
    """The system with some of its numbers replaced.

    Raises:
        ValueError: an unknown name or field, a wrong shape, or a value out of range.
    """
    if not isinstance(changes, Mapping):
        raise ValueError(f"with_params: give a mapping of names to changes, got {changes!r}.")
    known = read(system, changes)
    for name, fields in changes.items():
        _check(system, known, name, fields)
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
        here = (inertial.moved(group, shifts, system.layout) for group in groups)
        return tuple(group.set(changes) for group in here)

    groups = zip(system.layout.groups, system.inertia, strict=True)
    return dataclasses.replace(
        system,
        gravity=gravity,
        inertia=tuple(_with_inertia(p, group.names, bodies) for group, p in groups),
        offsets=system.offsets | {name: bodies[name].offset for name in shifts},
        constraints=elements(system.constraints),
        forces=elements(system.forces),
        bounds=elements(system.bounds),
    )


def _body(system: Any, name: str) -> tuple[dict[str, Any], Any]:
    """The inertial parameters of a body, and its offset."""
    (group, i), offset = system.layout.locate(name), system.offsets.get(name)
    return inertial.numbers(system.inertia[group], i, offset), offset


def _with_inertia(properties: Any, names: tuple[str, ...], bodies: Mapping[str, Any]) -> Any:
    """The mass properties of a group, where some of its bodies are changed."""
    fields = {"mass": properties.mass, "moments": properties.moments}
    for i, name in enumerate(names):
        for field, x in fields.items():
            if name in bodies and x is not None:
                fields[field] = replace_at(name, x, i, getattr(bodies[name], field))
    return dataclasses.replace(properties, **fields)


def _check(system: Any, known: Mapping[str, Any], name: str, fields: Any) -> None:
    """Checks names, and values of elements whose range their field tells.

    Raises:
        ValueError: an unknown name or field, or a value out of range.
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
        why = "".join(group.why_without(unknown) for group in owners)
        raise ValueError(f"'{name}' has no {sorted(unknown)}, it has {sorted(known[name])}.{why}")
    if name in system.layout.places:
        return
    for field in fields.keys() & POSITIVE | fields.keys() & NOT_NEGATIVE:
        shape, dtype = known[name][field].shape, system.gravity.dtype
        limit = {"above": 0} if field in POSITIVE else {"least": 0}
        checks.real(f"with_params: '{name}'", field, fields[field], dtype, shape, **limit)
