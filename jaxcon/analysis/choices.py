"""The methods that a scene is tried with unless others are given, the most useful first."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxcon.analysis.reference import Reference
from jaxcon.constraints.contact_default import default_contact_solver
from jaxcon.constraints.rows import layout_of
from jaxcon.core.precision import cast, precision
from jaxcon.dynamics.rank import UnitRows, dependent_rows, linearized
from jaxcon.simulation.events import Events
from jaxcon.simulation.generalized_alpha import GeneralizedAlpha
from jaxcon.simulation.integrators import RK4, Heun, SemiImplicitEuler
from jaxcon.simulation.method import Method
from jaxcon.simulation.rattle import RATTLE
from jaxcon.solvers.gauss_seidel import GaussSeidel
from jaxcon.solvers.proximal import RankSafe
from jaxcon.solvers.schur import Schur
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.baumgarte import Baumgarte
from jaxcon.stabilization.projection import Projection

SMALL = 30
"""Rows up to which the dense elimination is tried, too."""
LOOKED = 11
"""Configurations at which the rank is looked at, at most."""


def methods_for(system: Any, reference: Reference) -> dict[str, Method]:
    """Integrators × stabilisers with the solver that suits the scene, then other solvers.

    Args:
        system: in float64.
        reference: a motion of it.

    Returns:
        Methods by name, the most useful first.
    """
    loops, independent, rows = _rank(system, reference)
    name, solver = ("Sparse", Sparse()) if independent else ("RankSafe", RankSafe())
    found = {
        f"{words}, {name}": Method(integrator, stabilizer, solver, bounded=bounded, events=events)
        for words, integrator, stabilizer, bounded, events in _pairs(system, reference)
    }
    others: dict[str, Any] = {"RankSafe": RankSafe()} if loops and independent else {}
    if loops and independent and rows <= SMALL:
        others["Schur"] = Schur()
    for other, another in others.items():
        found[f"RK4, Baumgarte, {other}"] = Method(RK4(), solver=another)
    return found


def _pairs(system: Any, reference: Reference) -> list[tuple[str, Any, Any, Any, Any]]:
    """Words, integrator, stabiliser, what solves bounded rows, and events."""
    bounded, feedback, projection = Method().bounded, Baumgarte(), Projection()
    pairs = [
        ("RK4, Baumgarte", RK4(), feedback),
        ("semi-implicit Euler, Baumgarte", SemiImplicitEuler(), feedback),
        ("RATTLE", RATTLE(), feedback),
        ("RK4, projection", RK4(), projection),
        ("semi-implicit Euler, projection", SemiImplicitEuler(), projection),
        ("Heun, Baumgarte", Heun(), feedback),
        ("generalized-α", GeneralizedAlpha(), feedback),
    ]
    if not system.constraints and not system.bounds:  # nothing to stabilise
        pairs = [pair for pair in pairs if pair[2] is feedback]
    found: list[Any] = [(*pair, bounded, None) for pair in pairs]
    if system.bounds:
        split = ("RK4, Baumgarte, events", RK4(), feedback, bounded, Events())
        found[1:2] = [split, found[1]]
        q, v = reference.points.q[0], reference.points.v[0]
        if not isinstance(default_contact_solver(system, q, v), GaussSeidel):
            swept = ("semi-implicit Euler, Baumgarte, sweeps", SemiImplicitEuler(), feedback)
            found.insert(3, (*swept, GaussSeidel(), None))
    return found


def _rank(system: Any, reference: Reference) -> tuple[bool, bool, int]:
    """Returns whether there are loops, whether rows stay independent, and their number."""
    points = reference.points
    with precision(np.float64):
        own = cast(points, np.float64)
        q, v, t = own.q[0], own.v[0], own.time[0]
        layout = layout_of(system, q, v, t)
        if not layout.loops:
            return False, True, layout.size
        chosen = np.unique(np.linspace(0, len(points.time) - 1, LOOKED).astype(int))
        for i in chosen:
            state = jax.tree.map(lambda x, i=i: x[i], own).begin(system, Method())
            rows, jacobian, mass = linearized(system, state)
            unit = UnitRows(rows.layout, jacobian, mass)
            if dependent_rows(unit.values, unit.tolerance):
                return True, False, layout.size
    return True, True, layout.size
