"""Estimates the number of operations to compute the accelerations of one world. Host code.

The estimate uses the structure of the system. No step is traced or compiled, which would take
seconds to minutes for hundreds of rows. For exact counts, `work.work` traces a whole step;
`work.seconds` measures its time.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax

from jaxcon.constraints.rows import linearize
from jaxcon.contact.bounded import RowCounts
from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.contact.nearest_rows import ActiveSet
from jaxcon.contact.newton import Newton
from jaxcon.contact.rows import kinds_of, linearize_at_rest
from jaxcon.core.typing import DType
from jaxcon.linear.conjugate_gradients import ConjugateGradients
from jaxcon.methods.choice import Choice, innermost, words
from jaxcon.methods.method import Method
from jaxcon.protocols import ContactSolver, Solver, System
from jaxcon.staging.operations import count
from jaxcon.system.state import State

NEWTON_OPERATIONS = {1: 30.0, 2: 120.0}
"""The number of operations a row in an iteration of `Newton`, by the number of tangents."""

NEWTON_ITERATIONS = 8
"""The assumed number of iterations of `Newton`. In a fall an ant takes 3 to 4 in the mean,
and the slowest of 64 takes 10."""

INTERIOR_POINT_ITERATIONS = 15
"""The assumed number of iterations of `InteriorPoint`."""


@dataclass(frozen=True)
class Cost:
    """Estimated number of operations to compute the accelerations of one world, by part.

    A step of `SemiImplicitEuler` evaluates the accelerations once.

    Attributes:
        rows: operations to linearize equality and inequality constraints, counted from a trace.
        solver: operations of the linear solver: one factorization, one substitution for the
            accelerations, and one for each inequality row. None if there is no estimate for it.
        contact: operations to solve the inequality constraints; 0 if there are none.
        contact_solver: description of the contact solver; empty without inequality constraints.
    """

    rows: float
    solver: float | None
    contact: float
    contact_solver: str = ""

    @property
    def operations(self) -> float:
        """The total number of operations; a part without an estimate counts as zero."""
        return self.rows + (self.solver or 0.0) + self.contact

    def __str__(self) -> str:
        solver = "no estimate" if self.solver is None else f"{self.solver:.2g}"
        parts = f"{self.rows:.2g} for the rows, {solver} for the solver of the constraints"
        if self.contact_solver:
            parts += f", {self.contact:.2g} for the inequality constraints by {self.contact_solver}"
        return f"about {self.operations:.2g} operations for the accelerations: {parts} (estimated)"


def cost(system: System, method: Method, state: State, choice: Choice) -> Cost:
    """Estimates the number of operations to compute the accelerations once.

    Args:
        system: the system, as `checked_system` returns it for the state.
        method: the method with its solvers.
        state: state of one world.
        choice: result of `choose`, with the operation counts of linear solvers for this system.
    """
    kinds = kinds_of(system, state.q, state.v)
    solver = method.contact_solver_for(system, state)
    contact = contact_operations(solver, kinds, state.q.dtype)
    named = words(solver) if kinds else ""
    return Cost(_rows(system, state), _of_solver(method.solver, choice), contact, named)


def _of_solver(solver: Solver, choice: Choice) -> float | None:
    """Returns the estimated number of operations of a linear solver; None without an estimate.

    The number is 0 if there are no constraints.

    Args:
        solver: the linear solver of the method.
        choice: result of `choose`, with the operation counts of linear solvers.
    """
    solver = innermost(solver)
    if not choice.efforts:
        return 0.0  # there are no constraints
    effort_of_solver = choice.efforts.get(type(solver).__name__)
    if effort_of_solver is None:
        return None
    share = 1.0
    if isinstance(solver, ConjugateGradients):  # its effort assumes default iterations
        share = solver.iterations / ConjugateGradients().iterations
    return share * effort_of_solver.operations


def contact_operations(
    solver: ContactSolver | GaussSeidel, kinds: RowCounts | None, dtype: DType
) -> float:
    """Estimates the number of operations of a contact solver.

    Args:
        solver: `Newton`, `InteriorPoint`, `GaussSeidel`, or an `ActiveSet` around one of them.
        kinds: number of inequality rows of each law; None without inequality constraints.
        dtype: floating-point type of the scene.
    """
    if kinds is None:
        return 0.0
    rows = solved_rows(solver, kinds)
    inner = solver.solver if isinstance(solver, ActiveSet) else solver
    if isinstance(inner, GaussSeidel):  # a sweep is a matrix–vector product
        return inner.sweeps * (2.0 * rows * rows + 6.0 * rows)
    if isinstance(inner, Newton):  # a row changes the inertia of its body
        iterations = min(inner.max_iterations(dtype), NEWTON_ITERATIONS)
        return iterations * rows * NEWTON_OPERATIONS[kinds.tangents or 2]
    if isinstance(inner, InteriorPoint):  # an iteration inverts a matrix, and applies it twice
        return INTERIOR_POINT_ITERATIONS * (2.0 * rows**3 + 6.0 * rows * rows)
    return 0.0


def solved_rows(solver: ContactSolver | GaussSeidel, kinds: RowCounts) -> int:
    """Returns the number of inequality rows that a contact solver solves simultaneously.

    Args:
        solver: the contact solver.
        kinds: number of inequality rows of each law.
    """
    if not isinstance(solver, ActiveSet):
        return kinds.size
    single = kinds.single if solver.stops is None else min(solver.stops, kinds.single)
    contacts = kinds.contacts if solver.contacts is None else min(solver.contacts, kinds.contacts)
    others = kinds.size - kinds.single - kinds.contacts * (1 + kinds.tangents)
    return single + contacts * (1 + kinds.tangents) + others


def _rows(system: System, state: State) -> float:
    """Counts the operations to linearize the equality and inequality constraints of one world."""
    point = state.q, state.v, state.time
    operations = count(jax.make_jaxpr(linearize)(system, *point).jaxpr)
    if not system.bounds:
        return operations
    return operations + count(jax.make_jaxpr(linearize_at_rest)(system, state.q, state.v).jaxpr)
