"""Which terms of the equations are not as they must be, and whose they are. Host code."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.rank import UnitRows, dependent_rows
from jaxcon.model.state import State


@dataclass(frozen=True)
class Finding:
    """A term of the equations that is not as it must be.

    Attributes:
        term: "position", "velocity", "control", "parameter", "mass", "force", "residual", "rate",
            "jacobian", "bias", "compliance", "rows", "acceleration" or "violation".
        name: whose it is: of a body, constraint, force element or control channel.
        detail: what is wrong with it.
    """

    term: str
    name: str
    detail: str

    def __str__(self) -> str:
        return f"{self.term} of '{self.name}' {self.detail}"


def given(system: Any, state: State, control: PyTree) -> Iterator[Finding]:
    """State, control and parameters that are not finite."""
    yield from positions(system, state.q)
    yield from entries(system, "velocity", state.v)
    channels = getattr(getattr(system, "layout", None), "controls", (("control", 0, None),))
    for name, start, stop in channels:
        parts = [np.asarray(x)[start:stop] for x in jax.tree.leaves(control) if np.ndim(x)]
        if any(not np.all(np.isfinite(x)) for x in parts):
            yield Finding("control", name, f"is {checks.numerals(np.concatenate(parts))}")
    params = system.params if isinstance(system.params, dict) else {"params": system.params}
    for name, fields in params.items():
        for path, leaf in jax.tree_util.tree_flatten_with_path(fields)[0]:
            if not np.all(np.isfinite(leaf)):
                key = jax.tree_util.keystr(path, simple=True, separator=".")
                whole = f"{name}.{key}" if key else name
                yield Finding("parameter", whole, f"is {checks.numerals(leaf)}")


def positions(system: Any, q: Array) -> Iterator[Finding]:
    """Bodies, or coordinates, whose position is not finite."""
    return _infinite("position", q, getattr(system, "layout", None), "q")


def entries(system: Any, term: str, x: Array) -> Iterator[Finding]:
    """Bodies, or coordinates, whose part of an array (n_v,) is not finite."""
    return _infinite(term, x, getattr(system, "layout", None), "v")


def _infinite(term: str, x: Array, layout: Any, kind: str) -> Iterator[Finding]:
    own = {f"coordinate {i}": np.array([i]) for i in range(len(x))}
    if layout is not None:
        own = {name: getattr(layout, kind)(name) for name in layout.bodies}
    for name, indices in own.items():
        if not np.all(np.isfinite(x[indices])):
            yield Finding(term, name, f"is {checks.numerals(x[indices])}")


def masses(system: Any, q: Array) -> Iterator[Finding]:
    """Bodies whose mass or moments are not positive."""
    mass = system.mass(q)
    wrong = jnp.where(mass.diagonal > 0, mass.diagonal, jnp.nan)
    yield from (Finding("mass", f.name, "is not positive") for f in entries(system, "mass", wrong))
    if np.all(mass.diagonal > 0) and mass.singular:
        yield Finding("mass", "the system", "is not positive definite")


def forces(system: Any, q: Array, v: Array, t: Any, control: PyTree) -> Iterator[Finding]:
    """Force elements whose force on a body is not finite, then bodies whose whole force is not."""
    snapshot = system.snapshot(q, v, t)
    for group in getattr(system, "forces", ()):
        for place, pull in group.pulls(snapshot, control):
            size = sum(jnp.abs(jnp.asarray(lane)) for lane in pull)
            for i in np.flatnonzero(~np.isfinite(np.atleast_1d(size))):
                name = group.names[min(i, len(group.names) - 1)]
                body = system.layout.groups[place.group].names[place.indices[i]]
                yield Finding("force", name, f"on '{body}' is not finite")
    yield from entries(system, "force", system.force(q, v, t, control))


def terms(rows: Rows) -> Iterator[Finding]:
    """Constraints of which a term is not finite."""
    known = {"residual": rows.residual, "rate": rows.rate, "bias": rows.bias}
    if rows.layout.size:
        known["jacobian"] = rows.jacobian.dense()
    if rows.compliance is not None:
        known["compliance"] = rows.compliance
    for term, value in known.items():
        for name in rows.layout.names:
            own = np.asarray(value)[rows.layout.rows(name)]
            if not np.all(np.isfinite(own)):
                yield Finding(term, name, f"is {checks.numerals(own)}")


def dependent(system: Any, q: Array, rows: Rows) -> list[Finding]:
    """Constraints whose rows are combinations of others."""
    found: dict[str, list[int]] = {}
    unit = UnitRows(rows.layout, rows.jacobian.dense(), system.mass(q).dense())
    for i in dependent_rows(unit.values, unit.tolerance):
        name, row = unit.owners[i]
        found.setdefault(name, []).append(row)
    return [
        Finding("rows", name, f"depend on those before them: {', '.join(map(str, own))}")
        for name, own in found.items()
    ] or [Finding("rows", "the system", "depend on each other to working precision")]


def worst(system: Any, state: State) -> Finding:
    """The constraint that is furthest off."""
    found = linearize(system, state.q, state.v, state.instant).violation
    name = max(found.layout.names, key=lambda n: float(found[n]), default="none")
    size = float(found[name]) if found.layout.names else 0.0
    return Finding("violation", name, f"is {size:.3g} after the step")
