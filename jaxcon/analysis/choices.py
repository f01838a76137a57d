"""The methods that `tradeoff` compares by default on a scene, the most useful first."""

from __future__ import annotations

from typing import TypeAlias

import jax
import numpy as np

from jaxcon.analysis.reference import Reference
from jaxcon.constraints.rank import UnitRows, dependent_rows, linearized
from jaxcon.constraints.rows import layout_of
from jaxcon.contact.contact_default import default_contact_solver
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.core.precision import cast, precision
from jaxcon.linear.proximal import RankSafe
from jaxcon.linear.schur import Schur
from jaxcon.linear.sparse import Sparse
from jaxcon.methods.baumgarte import Baumgarte
from jaxcon.methods.events import Events
from jaxcon.methods.generalized_alpha import GeneralizedAlpha
from jaxcon.methods.integrators import RK4, Heun, SemiImplicitEuler
from jaxcon.methods.method import Method
from jaxcon.methods.projection import Projection
from jaxcon.methods.rattle import RATTLE
from jaxcon.protocols import ContactSolver, Integrator, Stabilizer, System

MethodParts: TypeAlias = tuple[
    str, Integrator, Stabilizer, ContactSolver | GaussSeidel | None, Events | None
]
"""The name of a method, with its integrator, stabilizer, contact solver and events."""
SMALL = 30
"""The largest number of constraint rows for which dense elimination (`Schur`) is also compared."""
LOOKED = 11
"""The largest number of configurations at which the rank of J is computed."""


def methods_for(system: System, reference: Reference) -> dict[str, Method]:
    """Returns the methods that `tradeoff` compares by default on a system.

    Combinations of integrator, stabilizer, contact solver and events come first, all with one
    linear solver: `Sparse`, or `RankSafe` if rows of the constraint Jacobian J are dependent. For
    kinematic loops with independent rows, RK4 with `Baumgarte` is also compared with the linear
    solvers `RankSafe` and, if there are few rows, `Schur`.

    Args:
        system: the system, in float64.
        reference: reference solution of the system, along which the rank of J is checked.

    Returns:
        Methods by name, the most useful first.
    """
    loops, independent, rows = _rank(system, reference)
    name, solver = ("Sparse", Sparse()) if independent else ("RankSafe", RankSafe())
    methods = {
        f"{words}, {name}": Method(
            integrator, stabilizer, solver, contact_solver=contact, events=events
        )
        for words, integrator, stabilizer, contact, events in _pairs(system, reference)
    }
    if loops and independent:
        methods["RK4, Baumgarte, RankSafe"] = Method(RK4(), solver=RankSafe())
        if rows <= SMALL:
            methods["RK4, Baumgarte, Schur"] = Method(RK4(), solver=Schur())
    return methods


def _pairs(system: System, reference: Reference) -> list[MethodParts]:
    """Returns the combinations of integrator, stabilizer, contact solver and events to compare."""
    contact, feedback, projection = Method().contact_solver, Baumgarte(), Projection()
    pairs = [
        ("RK4, Baumgarte", RK4(), feedback),
        ("semi-implicit Euler, Baumgarte", SemiImplicitEuler(), feedback),
        ("RATTLE", RATTLE(), feedback),
        ("RK4, projection", RK4(), projection),
        ("semi-implicit Euler, projection", SemiImplicitEuler(), projection),
        ("Heun, Baumgarte", Heun(), feedback),
        ("generalized-α", GeneralizedAlpha(), feedback),
    ]
    if not system.constraints and not system.bounds:  # there is nothing to stabilize
        pairs = [pair for pair in pairs if pair[2] is feedback]
    methods: list[MethodParts] = [(*pair, contact, None) for pair in pairs]
    if system.bounds:
        split = ("RK4, Baumgarte, events", RK4(), feedback, contact, Events())
        methods[1:2] = [split, methods[1]]
        q, v = reference.points.q[0], reference.points.v[0]
        if isinstance(default_contact_solver(system, q, v), InteriorPoint):
            name = "semi-implicit Euler, Baumgarte, sweeps"
            methods.insert(3, (name, SemiImplicitEuler(), feedback, GaussSeidel(), None))
    return methods


def _rank(system: System, reference: Reference) -> tuple[bool, bool, int]:
    """Checks the rank of the constraint Jacobian J at some configurations of the reference motion.

    Returns:
        loops: True if the bodies form kinematic loops.
        independent: True if all rows are independent at the checked configurations. Always True
            without loops, where nothing is checked.
        rows: the number of constraint rows.
    """
    points = reference.points
    with precision(np.float64):
        points = cast(points, np.float64)
        q, v, t = points.q[0], points.v[0], points.time[0]
        layout = layout_of(system, q, v, t)
        if not layout.loops:
            return False, True, layout.size
        chosen = np.unique(np.linspace(0, len(points.time) - 1, LOOKED).astype(int))
        for i in chosen:
            state = jax.tree.map(lambda x, i=i: x[i], points).begin(system, Method())
            rows, jacobian, mass = linearized(system, state)
            unit = UnitRows(rows.layout, jacobian, mass)
            if dependent_rows(unit.values, unit.tolerance):
                return True, False, layout.size
    return True, True, layout.size
