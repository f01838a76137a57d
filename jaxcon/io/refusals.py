"""Checks for MuJoCo features that jaxcon does not support, with errors that name the feature."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from jaxcon.core.summary import listed
from jaxcon.io import pairs
from jaxcon.io.compiled import Compiled
from jaxcon.io.pairs import GeomPair

ZERO = (
    ("joint", "jnt_stiffnesspoly", "polynomial stiffness"),
    ("joint", "jnt_springyield", "a spring that yields"),
    ("tendon", "tendon_stiffnesspoly", "polynomial stiffness"),
    ("tendon", "tendon_dampingpoly", "polynomial damping"),
    ("tendon", "tendon_springyield", "a spring that yields"),
    ("actuator", "actuator_damping", "damping"),
    ("actuator", "actuator_dampingpoly", "polynomial damping"),
    ("actuator", "actuator_armature", "armature"),
    ("actuator", "actuator_delay", "a delay"),
)
"""The arrays of MuJoCo's model that must be zero: the kind of object, the field and its meaning."""


def shapes(compiled: Compiled) -> list[str]:
    """Returns the names of all pairs of geoms whose shapes have no contact in jaxcon."""
    unknown = [p for p in pairs.pairs(compiled) if not pairs.supported(compiled, p)]
    return [_described(compiled, p) for p in unknown]


def mocap_bodies(compiled: Compiled) -> list[str]:
    """Returns the names of all mocap bodies."""
    return _named(compiled, "body", compiled.model.body_mocapid >= 0)


REFUSED: dict[str, tuple[str, Callable[[Compiled], list[str]]]] = {
    "shape": ("contacts between", shapes),
    "mocap": ("motions of the mocap bodies", mocap_bodies),
}
"""The unsupported features that `ignore` may leave out.

Each entry has a description and a function that returns the names of the objects with the feature.
"""
IGNORABLE = (
    *("contact", "self_contact", "torsion", "limit", "ball_limit", "friction", "gravcomp"),
    *("tendon", "fluid"),
    *REFUSED,
)
"""The values that the argument `ignore` of `from_mjcf` may have."""


def left_out(ignore: tuple[str, ...]) -> frozenset[str]:
    """Checks the `ignore` argument of `from_mjcf`; returns it as a set.

    Raises:
        ValueError: `ignore` has an unknown entry.
    """
    names = isinstance(ignore, tuple | list | set | frozenset)
    if not names or not all(isinstance(x, str) and x in IGNORABLE for x in ignore):
        raise ValueError(
            f"from_mjcf: ignore must be names out of {list(IGNORABLE)}, got {ignore!r}."
        )
    return frozenset(ignore)


def refuse(compiled: Compiled) -> None:
    """Refuses a model with features that affect its motion but that jaxcon does not simulate.

    Features listed in `REFUSED` are refused unless the user ignores them. Features that
    `_unsupported` describes are always refused.

    Raises:
        NotImplementedError: the model has such a feature.
    """
    for reason in reasons(compiled):
        raise NotImplementedError(f"from_mjcf: {reason}")


def reasons(compiled: Compiled) -> Iterator[str]:
    """Yields why `refuse` refuses a model, as messages; nothing if it does not."""
    for key, (what, search) in REFUSED.items():
        if key not in compiled.ignored and (names := search(compiled)):
            yield (
                f"{what} {_listed(names)} are not supported; to simulate the model without them,"
                f" say so by ignore=('{key}',)."
            )
    for what in _unsupported(compiled):
        yield f"{what} is not supported."


def _unsupported(compiled: Compiled) -> Iterable[str]:
    """Yields descriptions of the unsupported features that `ignore` cannot leave out."""
    m = compiled.model
    for count, what in (("nflex", "flex"), ("nplugin", "plugin")):
        if getattr(m, count):
            yield f"a {what}, of which there are {getattr(m, count)},"
    for kind, field, what in ZERO:
        if kind == "tendon" and compiled.disabled("tendon"):
            continue
        for name in _named(compiled, kind, getattr(m, field, ())):
            yield f"{what} of {kind} '{name}'"
    if np.any(getattr(m, "dof_dampingpoly", 0.0)):
        yield "polynomial damping of joints"
    if compiled.disabled("actuation") and m.nu:
        yield "the flag actuation='disable' of a model with actuators"
    if m.opt.disableactuator:
        yield "the option actuatorgroupdisable"
    if (m.opt.density or m.opt.viscosity) and not compiled.disabled("fluid"):
        for name in _named(compiled, "geom", m.geom_fluid[:, :1]):
            yield f"fluidshape of geom '{name}'"
    if m.body_gravcomp.any() and not compiled.disabled("gravcomp"):
        for name in _named(compiled, "joint", m.jnt_actgravcomp * m.jnt_actfrclimited):
            yield f"actuatorgravcomp of joint '{name}' beside an actuatorfrcrange"
        for name in _named(compiled, "joint", m.jnt_actgravcomp * (m.nu == 0)):
            yield f"actuatorgravcomp of joint '{name}' in a model without actuators"
    yield from _unsupported_contacts(compiled)


def _unsupported_contacts(compiled: Compiled) -> Iterable[str]:
    """Yields descriptions of the unsupported contact features that are not in `REFUSED`."""
    m, contacts = compiled.model, pairs.pairs(compiled)
    if contacts and m.opt.enableflags & int(compiled.mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        yield "the flag override='enable' of a model with contacts"
    touching = sorted({g for pair in contacts for g in pair[:2]})
    for field, what in (("surfacevel", "surfacevel"), ("adhesion", "adhesion")):
        values = np.asarray(getattr(m, f"geom_{field}", np.zeros(m.ngeom)))
        for g in touching:
            if values[g].any():
                yield f"{what} of geom '{compiled.name('geom', g)}'"
    if contacts and np.any(getattr(m, "pair_adhesion", 0.0)):
        yield "adhesion of a pair"
    for pair in contacts:
        sliding, rolling = pair.friction[:2], pair.friction[3:]
        directed = pair.condim > 1 and sliding[0] != sliding[1]
        rolls = pair.condim == 6 and "torsion" not in compiled.ignored
        if directed or (rolls and rolling[0] != rolling[1]):
            yield f"friction that depends on the direction, of {_described(compiled, pair)},"


def _described(compiled: Compiled, pair: GeomPair) -> str:
    """Returns the names of both geoms with their shapes, for messages."""
    return f"{pairs.label(compiled, pair)} ({' and '.join(pairs.shapes(compiled, pair))})"


def _named(compiled: Compiled, kind: str, flags: np.ndarray | tuple[()]) -> list[str]:
    """Returns the names of the objects of a kind that have a nonzero flag.

    Args:
        compiled: the model.
        kind: the kind of object, such as "joint".
        flags: one row for each object of the kind, (n, …); empty if there are no flags.
    """
    rows = np.asarray(flags)
    rows = rows.reshape(len(rows), -1).any(axis=1) if len(rows) else rows
    return [compiled.name(kind, int(i)) for i in np.flatnonzero(rows)]


def _listed(names: list[str], most: int = 4) -> str:
    """Joins quoted names by commas; a long list is cut to the first names and "and n more"."""
    return listed([f"'{name}'" for name in names], most)
