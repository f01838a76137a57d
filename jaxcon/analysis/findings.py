"""Finds wrong terms of the equations, and the bodies, constraints or forces that cause them.

Host code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rank import UnitRows, dependent_rows
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.saddle import Full
from jaxcon.protocols import System
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import LARGEST_SPEED, State


@dataclass(frozen=True)
class Finding:
    """A wrong term of the equations of motion, and the element that it belongs to.

    Attributes:
        term: "position", "velocity", "control", "parameter", "mass", "force", "residual", "rate",
            "jacobian", "bias", "compliance", "rows", "acceleration" or "violation".
        name: name of the body, constraint, force element or control channel.
        detail: description of the error.
    """

    term: str
    name: str
    detail: str

    def __str__(self) -> str:
        return f"{self.term} of '{self.name}' {self.detail}"


def given(system: System, state: State, control: PyTree) -> Iterator[Finding]:
    """Yields a finding for each position, velocity, time, control or parameter that is not finite.

    A quaternion of zeros is a finding, too. Parameters that may be infinite, such as a missing stop
    of a `Limit`, are only checked for NaN.
    """
    yield from positions(system, state.q)
    yield from velocities(system, state.v)
    if not np.isfinite(state.time):
        yield Finding("time", "the state", f"is {checks.numerals(state.time)}")
    channels = (("control", 0, None),) if system.layout is None else system.layout.controls
    for name, start, stop in channels:
        parts = [np.asarray(x)[start:stop] for x in jax.tree.leaves(control) if np.ndim(x)]
        if any(not np.all(np.isfinite(x)) for x in parts):
            yield Finding("control", name, f"is {checks.numerals(np.concatenate(parts))}")
    params = system.params if isinstance(system.params, dict) else {"params": system.params}
    unbounded = {
        f"{name}.{field}"
        for group in system.bounds
        for name in group.names
        for field in group.unbounded_fields
    }
    for name, fields in params.items():
        for path, leaf in jax.tree_util.tree_flatten_with_path(fields)[0]:
            key = jax.tree_util.keystr(path, simple=True, separator=".")
            good = ~np.isnan(leaf) if f"{name}.{key}" in unbounded else np.isfinite(leaf)
            if not np.all(good):
                whole = f"{name}.{key}" if key else name
                yield Finding("parameter", whole, f"is {checks.numerals(leaf)}")


def positions(system: System, q: Array) -> Iterator[Finding]:
    """Yields a finding for each body or coordinate whose position is not finite, or no pose."""
    layout = system.layout
    places = layout and {name: layout.q(name) for name in layout.bodies}
    yield from _infinite("position", q, places)
    for name in () if layout is None else layout.without_orientation(q):
        yield Finding("position", name, "has a quaternion of zeros")


def velocities(system: System, v: Array) -> Iterator[Finding]:
    """Yields a finding for each body or coordinate whose velocity makes `is_finite` False.

    If the magnitudes add up to more than `LARGEST_SPEED`, these are the larger ones.
    """
    in_range = bool(jnp.sum(jnp.abs(v)) <= LARGEST_SPEED)
    return entries(system, "velocity", v, np.inf if in_range else LARGEST_SPEED / v.size)


def entries(system: System, term: str, x: Array, largest: float = np.inf) -> Iterator[Finding]:
    """Yields a finding for each body or coordinate with a non-finite entry in an array (n_v,).

    Args:
        system: the system.
        term: name of the wrong term, as in `Finding`.
        x: the array to check, (n_v,).
        largest: entries of a larger magnitude count as infinite.
    """
    layout = system.layout
    places = layout and {name: layout.v(name) for name in layout.bodies}
    return _infinite(term, x, places, largest)


def _infinite(
    term: str,
    x: Array,
    places: dict[str, np.ndarray] | None,
    largest: float = np.inf,
) -> Iterator[Finding]:
    """Yields a finding for each body or coordinate with a non-finite entry in an array.

    Args:
        term: name of the wrong term, as in `Finding`.
        x: the array to check, (n_q,) or (n_v,).
        places: indices into x for each body; None for generalized coordinates.
        largest: entries of a larger magnitude count as infinite.
    """
    if places is None:
        places = {f"coordinate {i}": np.array([i]) for i in range(len(x))}
    for name, indices in places.items():
        if not np.all(np.isfinite(x[indices]) & (np.abs(x[indices]) <= largest)):
            yield Finding(term, name, f"is {checks.numerals(x[indices])}")


def masses(system: System, q: Array) -> Iterator[Finding]:
    """Yields a finding for each body whose mass or moment of inertia is not positive.

    If there is no such body, yields a finding for a mass matrix that is not positive definite. A
    matrix that is not symmetric is the only finding.
    """
    mass = system.mass(q)
    if isinstance(mass, Full) and np.all(np.isnan(mass.values)):
        yield Finding("mass", "the system", "is not symmetric, or NaN")
        return
    wrong = jnp.where(mass.diagonal > 0, mass.diagonal, jnp.nan)
    yield from (Finding("mass", f.name, "is not positive") for f in entries(system, "mass", wrong))
    if np.all(mass.diagonal > 0) and mass.singular:
        yield Finding("mass", "the system", "is not positive definite")


def forces(
    system: System, q: Array, v: Array, t: Doubled | Array, control: PyTree
) -> Iterator[Finding]:
    """Yields a finding for each force element, then each body, with a non-finite force."""
    snapshot = system.snapshot(q, v, t)
    if isinstance(system, BodySystem) and (layout := system.layout) is not None:
        for group in system.forces:
            for place, pull in group.pulls(snapshot, control):
                size = sum(jnp.abs(jnp.asarray(component)) for component in pull)
                for i in np.flatnonzero(~np.isfinite(np.atleast_1d(size))):
                    name = group.names[min(i, len(group.names) - 1)]
                    body = layout.groups[place.group].names[place.indices[i]]
                    yield Finding("force", name, f"on '{body}' is not finite")
    yield from entries(system, "force", system.force(q, v, t, control))


def terms(rows: Rows) -> Iterator[Finding]:
    """Yields a finding for each non-finite term in the linearization of each constraint."""
    values = {"residual": rows.residual, "rate": rows.rate, "bias": rows.bias}
    if rows.layout.size:
        values["jacobian"] = rows.jacobian.dense()
    if rows.compliance is not None:
        values["compliance"] = rows.compliance
    for term, value in values.items():
        for name in rows.layout.names:
            entries = np.asarray(value)[rows.layout.rows(name)]
            if not np.all(np.isfinite(entries)):
                yield Finding(term, name, f"is {checks.numerals(entries)}")


def dependent(system: System, q: Array, rows: Rows) -> list[Finding]:
    """Returns a finding for each constraint with rows that depend linearly on rows before them.

    If there is no such row, returns one finding for the whole system.
    """
    by_name: dict[str, list[int]] = {}
    unit = UnitRows(rows.layout, rows.jacobian.dense(), system.mass(q).dense())
    for i in dependent_rows(unit.values, unit.tolerance):
        name, row = unit.owners[i]
        by_name.setdefault(name, []).append(row)
    return [
        Finding("rows", name, f"depend on those before them: {', '.join(map(str, numbers))}")
        for name, numbers in by_name.items()
    ] or [Finding("rows", "the system", "depend on each other to working precision")]


def worst(system: System, state: State) -> Finding:
    """Returns a finding that names the constraint with the largest violation."""
    violation = linearize(system, state.q, state.v, state.instant).violation
    name = max(violation.layout.names, key=lambda n: float(violation[n]), default="none")
    size = float(violation[name]) if violation.layout.names else 0.0
    return Finding("violation", name, f"is {size:.3g} after the step")
