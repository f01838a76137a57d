"""What a model of MuJoCo may have that jaxcon does not simulate: named, never dropped silently."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from jaxcon.io.compiled import Compiled

ZERO = (
    ("joint", "jnt_stiffnesspoly", "polynomial stiffness"),
    ("joint", "jnt_springyield", "a spring that yields"),
    ("joint", "jnt_actfrclimited", "actuatorfrcrange"),
    ("actuator", "actuator_damping", "damping"),
    ("actuator", "actuator_dampingpoly", "polynomial damping"),
    ("actuator", "actuator_armature", "armature"),
    ("actuator", "actuator_delay", "a delay"),
)
"""Arrays of MuJoCo's model that must be zero: of what, which, and what they mean."""


def contacts(compiled: Compiled) -> list[str]:
    """Pairs of geoms that may touch."""
    if compiled.disabled("contact", "constraint"):
        return []
    m = compiled.model
    pairs = [f"pair {i}" for i in range(m.npair)]
    weld, parent = m.body_weldid, m.body_weldid[m.body_parentid]
    excluded = {int(x) for x in m.exclude_signature}
    filtered = not compiled.disabled("filterparent")
    for g in range(m.ngeom):
        for h in range(g):
            a, b = sorted((int(m.geom_bodyid[h]), int(m.geom_bodyid[g])))
            u, w = int(weld[a]), int(weld[b])
            related = u and w and (parent[u] == w or parent[w] == u)
            known = u == w or (a << 16) + b in excluded
            first = m.geom_contype[g] & m.geom_conaffinity[h]
            second = m.geom_contype[h] & m.geom_conaffinity[g]
            if (first or second) and not known and not (related and filtered):
                pairs.append(f"{compiled.name('geom', h)} and {compiled.name('geom', g)}")
    return pairs


def limits(compiled: Compiled) -> list[str]:
    """Joints and tendons that have a range."""
    if compiled.disabled("limit", "constraint"):
        return []
    m = compiled.model
    return _named(compiled, "joint", m.jnt_limited) + _named(compiled, "tendon", m.tendon_limited)


def friction(compiled: Compiled) -> list[str]:
    """Joints and tendons with dry friction."""
    if compiled.disabled("frictionloss", "constraint"):
        return []
    m = compiled.model
    rubbing = np.unique(m.dof_jntid[m.dof_frictionloss > 0])
    joints = [compiled.name("joint", int(i)) for i in rubbing]
    return joints + _named(compiled, "tendon", m.tendon_frictionloss)


def tendons(compiled: Compiled) -> list[str]:
    """Tendons that pull or resist; those which are only measured have no effect."""
    m = compiled.model
    fields = ("stiffness", "damping", "armature")
    arrays = [np.asarray(getattr(m, f"tendon_{f}", np.zeros(m.ntendon))) != 0 for f in fields]
    return _named(compiled, "tendon", np.any(arrays, axis=0))


def fluid(compiled: Compiled) -> list[str]:
    """The medium, where it has a density or viscosity."""
    options = compiled.model.opt
    return [f for f in ("density", "viscosity") if getattr(options, f)]


def gravity_compensation(compiled: Compiled) -> list[str]:
    """Bodies whose weight is taken up."""
    return _named(compiled, "body", compiled.model.body_gravcomp)


IGNORABLE: dict[str, tuple[str, Callable[[Compiled], list[str]]]] = {
    "contact": ("contacts between", contacts),
    "limit": ("the limits of", limits),
    "friction": ("the frictionloss of", friction),
    "tendon": ("the tendons", tendons),
    "fluid": ("the option", fluid),
    "gravcomp": ("the gravcomp of", gravity_compensation),
}
"""What may be left out where the user says so: what it is, and what has it."""


def refuse(compiled: Compiled, ignore: tuple[str, ...]) -> None:
    """Checks that everything that has an effect is simulated, but for what the user gives up.

    Raises:
        ValueError: `ignore` has an unknown entry.
        NotImplementedError: the model has what is not supported.
    """
    if isinstance(ignore, str) or set(ignore) - set(IGNORABLE):
        raise ValueError(
            f"from_mjcf: ignore must be names out of {list(IGNORABLE)}, got {ignore!r}."
        )
    for key, (what, found) in IGNORABLE.items():
        if key not in ignore and (names := found(compiled)):
            raise NotImplementedError(
                f"from_mjcf: {what} {_listed(names)} are not supported; to simulate the model"
                f" without them, say so by ignore=('{key}',)."
            )
    for what in _unsupported(compiled):
        raise NotImplementedError(f"from_mjcf: {what} is not supported.")


def _unsupported(compiled: Compiled) -> Iterable[str]:
    """What cannot be left out either."""
    m = compiled.model
    for count, what in (("nflex", "flex"), ("nmocap", "mocap body"), ("nplugin", "plugin")):
        if getattr(m, count):
            yield f"a {what}, of which there are {getattr(m, count)},"
    for kind, field, what in ZERO:
        for name in _named(compiled, kind, getattr(m, field, ())):
            yield f"{what} of {kind} '{name}'"
    if np.any(getattr(m, "dof_dampingpoly", 0.0)):
        yield "polynomial damping of joints"
    if compiled.disabled("actuation") and m.nu:
        yield "the flag actuation='disable' of a model with actuators"
    if m.opt.disableactuator:
        yield "the option actuatorgroupdisable"


def _named(compiled: Compiled, kind: str, flags: Any) -> list[str]:
    """The names of those elements of a kind for which there is something."""
    rows = np.asarray(flags)
    rows = rows.reshape(len(rows), -1).any(axis=1) if len(rows) else rows
    return [compiled.name(kind, int(i)) for i in np.flatnonzero(rows)]


def _listed(names: list[str], most: int = 4) -> str:
    """Some of the names, and how many more there are."""
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"
