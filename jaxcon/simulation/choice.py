"""Which solver suits a system, from its structure, and why. Host code, once for each system."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.bounds import count_bounds
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.dynamics.rank import UnitRows, dependent_rows, linearized
from jaxcon.model.state import State, at
from jaxcon.solvers import effort
from jaxcon.solvers.conjugate_gradients import ConjugateGradients
from jaxcon.solvers.effort import Effort
from jaxcon.solvers.proximal import RankSafe
from jaxcon.solvers.saddle import Diagonal
from jaxcon.solvers.schur import Schur
from jaxcon.solvers.sparse import Sparse, suits_device

PROGRAM = 30_000
"""Instructions of an elimination that is still worth compiling; at 2 to 3 ms each, a minute."""
HELD = 4e9
"""What the matrices of all worlds may take [B]."""
SURE = 20.0
"""How many times the operations of an iteration elimination may take, whose end is sure."""
LOOKED = 300
"""Rows without loops up to which it is looked whether they depend on each other in this state."""


@dataclass(frozen=True)
class Choice:
    """A solver, and what led to it; `print` it.

    Attributes:
        solver: of the saddle system.
        efforts: by name of a solver, what it would take; those that were weighed.
        reasons: in words.
    """

    solver: Any
    efforts: dict[str, Effort]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"jc.Method.auto takes {words(self.solver)}: " + "; ".join(self.reasons)


@dataclass(frozen=True)
class Facts:
    """What the choice is made from.

    Attributes:
        rows, velocities: n_c, n_v.
        loops: whether rows may depend on each other by structure.
        dependent: how many do in this state; None where that was not looked at.
        diagonal: whether M is.
        structure: of J.
        bounded: rows with bounded multipliers, each of which takes a substitution.
    """

    rows: int
    velocities: int
    loops: bool
    dependent: int | None
    diagonal: bool
    structure: effort.Structure
    bounded: int


def choose(
    system: Any,
    state: State,
    batch: int = 1,
    platform: str | None = None,
    dependent: int | None = None,
) -> Choice:
    """The solver that `Method.auto` takes, and why.

    Args:
        system: a `BodySystem`, `GeneralizedSystem` or `Vakonomic`.
        state: of one world, with known numbers.
        batch: worlds that are to be stepped together.
        platform: "cpu", "gpu", …; None for that of JAX.
        dependent: how many rows depend on others, where that is known.

    Raises:
        TypeError: the state is traced.
    """
    if not checks.is_concrete((system, state)):
        raise TypeError("Method.auto looks at numbers: call it outside jit, vmap and grad.")
    checks.count("Method.auto", "batch", batch)
    facts = look(at(system, state, "jc.Method.auto(system, s)"), state, dependent)
    if not facts.rows:
        return Choice(RankSafe(), {}, ("there are no rows to solve for",))
    place = platform or jax.default_backend()
    order = None if platform is None else "runs" if platform == "cpu" else "levels"
    efforts = weigh(facts, order or suits_device())
    inner, why = _inner(facts, efforts, batch * jnp.finfo(state.q.dtype).bits // 8, order, place)
    solver, rank = _safe(facts, inner)
    return Choice(solver, efforts, (rank, why))


def look(system: Any, state: State, dependent: int | None = None) -> Facts:
    """The facts of a system at a state."""
    point = state.q, state.v, state.instant
    rows: Rows = jax.eval_shape(linearize, system, *point)
    size = rows.layout.size
    if dependent is None and not rows.layout.loops and 0 < size <= LOOKED:
        known, jacobian, mass = linearized(system, state)
        unit = UnitRows(known.layout, jacobian, mass)
        dependent = len(dependent_rows(unit.values, unit.tolerance))
    return Facts(
        size,
        state.v.shape[0],
        rows.layout.loops,
        dependent,
        isinstance(jax.eval_shape(system.mass, state.q), Diagonal),
        effort.structure_of(rows.jacobian),
        count_bounds(system, state.q, state.v),
    )


def weigh(facts: Facts, order: str) -> dict[str, Effort]:
    """What each solver that could do would take, by name, the best for small systems first."""
    solves, found = 1 + facts.bounded, {}
    n_v, n_c = facts.velocities, facts.rows
    if facts.diagonal:
        sparse = effort.elimination(facts.structure, order, solves, PROGRAM)
        if sparse is not None and sparse.instructions <= PROGRAM:
            found["Sparse"] = sparse
    found["Schur"] = effort.schur(n_v, n_c, not facts.diagonal, solves)
    found["Dense"] = effort.saddle(n_v, n_c, solves)
    if facts.diagonal:
        rounds = ConjugateGradients().iterations
        swept = effort.iterations(facts.structure, n_c, rounds, solves)
        found["ConjugateGradients"] = swept
    return found


def _inner(
    facts: Facts, efforts: dict[str, Effort], width: int, order: str | None, place: str
) -> tuple[Any, str]:
    """The solver of independent rows, and why it is taken."""
    swept = efforts.get("ConjugateGradients")
    direct = {
        name: efforts[name]
        for name in ("Sparse", "Schur")
        if name in efforts and efforts[name].numbers * width <= HELD
    }
    best = min(direct, key=lambda name: direct[name].operations, default=None)
    if swept and (best is None or direct[best].operations > SURE * swept.operations):
        return ConjugateGradients(), (
            f"elimination would take {_cost(efforts, 'Sparse', 'Schur')}, iterations"
            f" {swept.operations:.2g}, which end as NOT_CONVERGED where they are too few"
        )
    if best == "Sparse":
        loop = "loops over equal joints" if (order or suits_device()) == "runs" else "few levels"
        return Sparse(order=order), (
            f"elimination along the structure, in {loop} as suits a {place}, takes"
            f" {efforts['Sparse'].operations:.2g} operations, dense matrices"
            f" {efforts['Schur'].operations:.2g}"
        )
    if not facts.diagonal:
        return Schur(), "M is no diagonal matrix, so that J M⁻¹ Jᵀ is dense whatever J is"
    if "Sparse" not in efforts:
        met = effort.clique(facts.structure)
        return Schur(), (
            f"elimination along the structure, where up to {met} rows meet on one body, would be"
            f" more than {PROGRAM} instructions to compile"
        )
    return Schur(), f"rows meet so closely that elimination takes {_cost(efforts, 'Sparse')}"


def _cost(efforts: dict[str, Effort], *names: str) -> str:
    """The operations of some solvers in words."""
    known = [name for name in names if name in efforts]
    told = [f"{efforts[name].operations:.2g} operations ({name})" for name in known]
    return " or ".join(told)


def _safe(facts: Facts, inner: Any) -> tuple[Any, str]:
    """Returns a solver for rows that may depend on each other, and why."""
    count = "" if facts.dependent is None else f", and {facts.dependent or 'none'} do here"
    if not facts.loops and not facts.dependent:
        own = several(facts.rows, "row")
        return inner, f"constraints, {own}, close no loop, so that no row depends on others"
    if isinstance(inner, ConjugateGradients):
        return inner, f"rows may depend on each other{count}, which iterations allow if they agree"
    if not facts.loops:
        return RankSafe(inner, always=True), (
            f"of {several(facts.rows, 'row')} some, {facts.dependent}, depend on others by their"
            " numbers alone"
        )
    own = RankSafe() if isinstance(inner, Sparse) and inner.order is None else RankSafe(inner)
    rows = several(facts.rows, "row")
    return own, f"constraints, {rows}, close loops, where they may depend on each other{count}"


def several(count: int, what: str) -> str:
    """A number of things in words."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def innermost(solver: Any) -> Any:
    """The solver inside others, such as that of `RankSafe`."""
    while hasattr(solver, "solver"):
        solver = solver.solver
    return solver


def words(solver: Any) -> str:
    """A solver as it is written, with what is not the default."""
    inside = []
    for field in dataclasses.fields(solver):
        own, default = getattr(solver, field.name), cast(Any, field.default)
        nested = dataclasses.is_dataclass(default)
        if nested and words(own) != words(default):
            inside.append(words(own))
        elif not nested and not np.array_equal(own, default):  # numbers may be arrays
            inside.append(f"{field.name}={own!r}")
    return f"{type(solver).__name__}({', '.join(inside)})"
