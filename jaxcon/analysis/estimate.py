"""Estimates the operations of a world's accelerations from the structure of the scene. Host code.

Nothing is compiled and no step is traced, which takes seconds to minutes where there are hundreds
of rows. `work` counts a whole step from its trace, and `seconds` measures it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax

from jaxcon.constraints.bounds import kinds_of, linearize_at_rest
from jaxcon.constraints.rows import linearize
from jaxcon.core.operations import count
from jaxcon.model.state import State
from jaxcon.simulation.choice import Choice, innermost, words
from jaxcon.simulation.method import Method
from jaxcon.solvers import effort
from jaxcon.solvers.bounded import Kinds
from jaxcon.solvers.conjugate_gradients import ConjugateGradients
from jaxcon.solvers.gauss_seidel import GaussSeidel
from jaxcon.solvers.interior_point import InteriorPoint
from jaxcon.solvers.nearest_rows import Nearest


@dataclass(frozen=True)
class Cost:
    """Operations of the accelerations of one world, by part; a step of `SemiImplicitEuler` is one.

    Attributes:
        rows: linearization of constraints and inequality constraints, counted from its trace.
        solver: factorization of the constraints and a substitution by inequality row; None where
            the solver has no estimate.
        contact: solution of the inequality constraints; 0 in a scene without.
        contact_solver: their solver in words; empty in a scene without.
    """

    rows: float
    solver: float | None
    contact: float
    contact_solver: str = ""

    @property
    def operations(self) -> float:
        """All parts that are known."""
        return self.rows + (self.solver or 0.0) + self.contact

    def __str__(self) -> str:
        solver = "no estimate" if self.solver is None else f"{self.solver:.2g}"
        parts = f"{self.rows:.2g} for the rows, {solver} for the solver of the constraints"
        if self.contact_solver:
            parts += f", {self.contact:.2g} for the inequality constraints by {self.contact_solver}"
        return f"about {self.operations:.2g} operations for the accelerations: {parts} (estimated)"


def cost(system: Any, method: Method, state: State, choice: Choice) -> Cost:
    """Estimates the operations of one evaluation of the accelerations.

    Args:
        system: as the state remembers it.
        method: its solvers count.
        state: of one world.
        choice: of `choose`, whose efforts are those of the solvers on this structure.
    """
    kinds = kinds_of(system, state.q, state.v)
    bounded = method.resolve(system, state).bounded
    contact, named = contact_operations(bounded, kinds), words(bounded) if kinds else ""
    return Cost(_rows(system, state), _of_solver(method.solver, choice), contact, named)


def _of_solver(solver: Any, choice: Choice) -> float | None:
    """Operations of the solver of the constraints; None where its effort is not known."""
    solver = innermost(solver)
    if not choice.efforts:
        return 0.0  # there are no constraints
    known = choice.efforts.get(type(solver).__name__)
    if known is None:
        return None
    share = 1.0
    if isinstance(solver, ConjugateGradients):  # whose effort is that of the default iterations
        share = solver.iterations / ConjugateGradients().iterations
    return share * known.operations


def contact_operations(solver: Any, kinds: Kinds | None) -> float:
    """Operations of a solver of inequality constraints.

    Args:
        solver: `InteriorPoint`, `GaussSeidel` or `Nearest` of one.
        kinds: the numbers of rows by law; None in a scene without.
    """
    if kinds is None:
        return 0.0
    rows = solved_rows(solver, kinds)
    inner = solver.solver if isinstance(solver, Nearest) else solver
    if isinstance(inner, GaussSeidel):
        return effort.gauss_seidel(rows, inner.sweeps)
    return effort.interior_point(rows) if isinstance(inner, InteriorPoint) else 0.0


def solved_rows(solver: Any, kinds: Kinds) -> int:
    """The number of inequality rows that a solver takes at once."""
    if not isinstance(solver, Nearest):
        return kinds.size
    single = kinds.single if solver.stops is None else min(solver.stops, kinds.single)
    contacts = kinds.contacts if solver.contacts is None else min(solver.contacts, kinds.contacts)
    others = kinds.size - kinds.single - kinds.contacts * (1 + kinds.tangents)
    return single + contacts * (1 + kinds.tangents) + others


def _rows(system: Any, state: State) -> float:
    """Operations of linearizing all rows of one world."""
    point = state.q, state.v, state.time
    own = count(jax.make_jaxpr(linearize)(system, *point).jaxpr)
    if not system.bounds:
        return own
    return own + count(jax.make_jaxpr(linearize_at_rest)(system, state.q, state.v).jaxpr)
