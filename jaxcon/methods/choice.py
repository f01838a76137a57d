"""Choice of a solver by the structure of a system. Host code that runs once for each system."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rank import UnitRows, dependent_rows, linearized
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.contact.rows import count_bounds
from jaxcon.core import checks
from jaxcon.linear import effort
from jaxcon.linear.conjugate_gradients import ConjugateGradients
from jaxcon.linear.effort import Effort
from jaxcon.linear.proximal import RankSafe
from jaxcon.linear.saddle import Diagonal
from jaxcon.linear.schur import Schur
from jaxcon.linear.sparse import Sparse, suits_device
from jaxcon.methods.integrators import RungeKutta
from jaxcon.protocols import ContactSolver, Solver, System
from jaxcon.system.state import State, checked_system

PLATFORMS = ("cpu", "gpu", "cuda", "rocm", "tpu")
"""The platforms for which a solver is chosen, besides JAX's default backend."""

PROGRAM = 30_000
"""The most instructions of an elimination; at 2 to 3 ms each, they compile in about a minute."""
HELD = 4e9
"""The most memory that the matrices of all worlds may need [B]."""
SURE = 20.0
"""The largest cost of elimination, as a multiple of the cost of iterations.

Elimination is preferred up to this cost, since iterations may not converge.
"""
LONG = 80
"""The largest length of text that `brief` prints; a longer part is printed as its class."""

LOOKED = 300
"""The most rows of a system without loops for which linear dependence is tested numerically."""


@dataclass(frozen=True)
class Choice:
    """A solver, and the reasons for its choice; `print` shows them.

    Attributes:
        solver: solver of the saddle system.
        efforts: the effort of each considered solver, by its name.
        reasons: sentences that explain the choice.
    """

    solver: Solver
    efforts: dict[str, Effort]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"jc.Method.auto takes {words(self.solver)}: " + "; ".join(self.reasons)


@dataclass(frozen=True)
class Facts:
    """The properties of a system on which the choice of a solver depends.

    Attributes:
        rows, velocities: the numbers n_c of rows and n_v of velocities.
        loops: True if the structure allows linearly dependent rows.
        dependent: the number of linearly dependent rows in this state; None if not tested.
        diagonal: True if M is diagonal.
        structure: sparsity of J.
        bounded: the number of inequality rows; each needs one more solve with the factored matrix.
    """

    rows: int
    velocities: int
    loops: bool
    dependent: int | None
    diagonal: bool
    structure: effort.Structure
    bounded: int


def choose(
    system: System,
    state: State,
    batch: int = 1,
    platform: str | None = None,
    dependent: int | None = None,
) -> Choice:
    """Returns the solver that `Method.auto` takes, with the reasons.

    Args:
        system: a `BodySystem`, `GeneralizedSystem` or `Vakonomic`.
        state: the state of one world, not traced.
        batch: the number of worlds stepped together.
        platform: "cpu", "gpu", …; None for JAX's default backend.
        dependent: the number of linearly dependent rows, if known.

    Raises:
        TypeError: the state is traced.
    """
    if not checks.is_concrete((system, state)):
        raise TypeError("Method.auto looks at numbers: call it outside jit, vmap and grad.")
    checks.count("Method.auto", "batch", batch)
    facts = look(checked_system(system, state, "jc.Method.auto(system, s)"), state, dependent)
    known = (None, *PLATFORMS, jax.default_backend())
    if not isinstance(platform, str | None) or platform not in known:
        raise ValueError(
            f"Method.auto: platform must be None or one of {', '.join(PLATFORMS)}, got"
            f" {checks.shortened(platform)}."
        )
    if not facts.rows:
        return Choice(RankSafe(), {}, ("there are no rows to solve for",))
    order = None if platform is None else "runs" if platform == "cpu" else "levels"
    efforts = weigh(facts, order or suits_device())
    width = batch * jnp.finfo(state.q.dtype).bits // 8
    inner, why = _inner(facts, efforts, width, order, platform or jax.default_backend())
    solver, rank = _safe(facts, inner)
    return Choice(solver, efforts, (rank, why))


def look(system: System, state: State, dependent: int | None = None) -> Facts:
    """Returns the properties of a system on which the choice of a solver depends.

    Args:
        system: the system.
        state: the state of one world, not traced.
        dependent: the number of linearly dependent rows in this state. If None, rows are counted
            for systems without loops and with at most `LOOKED` rows.
    """
    rows: Rows = jax.eval_shape(linearize, system, state.q, state.v, state.instant)
    layout = rows.layout
    if dependent is None and not layout.loops and 0 < layout.size <= LOOKED:
        full_rows, jacobian, mass = linearized(system, state)
        unit = UnitRows(full_rows.layout, jacobian, mass)
        dependent = len(dependent_rows(unit.values, unit.tolerance))
    return Facts(
        layout.size,
        state.v.shape[0],
        layout.loops,
        dependent,
        isinstance(jax.eval_shape(system.mass, state.q), Diagonal),
        effort.structure_of(rows.jacobian),
        count_bounds(system, state.q, state.v),
    )


def weigh(facts: Facts, order: str) -> dict[str, Effort]:
    """Estimates the effort of each solver that can be used; returns it by the solver's name.

    Args:
        facts: properties of the system.
        order: the order of elimination, "runs" or "levels".
    """
    solves, efforts = 1 + facts.bounded, {}
    n_v, n_c = facts.velocities, facts.rows
    if facts.diagonal:
        sparse = effort.elimination(facts.structure, order, solves, PROGRAM)
        if sparse is not None and sparse.instructions <= PROGRAM:
            efforts["Sparse"] = sparse
    efforts["Schur"] = effort.schur(n_v, n_c, not facts.diagonal, solves)
    efforts["Dense"] = effort.saddle(n_v, n_c, solves)
    if facts.diagonal:
        iterations = ConjugateGradients().iterations
        efforts["ConjugateGradients"] = effort.iterations(facts.structure, n_c, iterations, solves)
    return efforts


def _inner(
    facts: Facts, efforts: dict[str, Effort], width: int, order: str | None, place: str
) -> tuple[Solver, str]:
    """Returns the solver that suits linearly independent rows, and the reason in words.

    Args:
        facts: properties of the system.
        efforts: effort of each solver, by its name.
        width: memory of one number per world, summed over all worlds [B].
        order: the order of elimination, "runs" or "levels"; None for the device's default.
        place: the platform: "cpu", "gpu" or "tpu".
    """
    swept = efforts.get("ConjugateGradients")
    direct = {x: efforts[x].operations for x in ("Sparse", "Schur") if x in efforts}
    fitting = [x for x in direct if efforts[x].numbers * width <= HELD]
    best = min(fitting, key=lambda name: direct[name], default=None)
    if swept and (best is None or direct[best] > SURE * swept.operations):
        costs = " or ".join(f"{x:.2g} operations ({name})" for name, x in direct.items())
        return ConjugateGradients(), (
            f"elimination would take {costs}, iterations"
            f" {swept.operations:.2g}, which end as NOT_CONVERGED where they are too few"
        )
    if best == "Sparse":
        loop = "loops over equal joints" if (order or suits_device()) == "runs" else "few levels"
        return Sparse(order=order), (
            f"elimination along the structure, in {loop} as suits a {place}, takes"
            f" {direct['Sparse']:.2g} operations, dense matrices"
            f" {direct['Schur']:.2g}"
        )
    if not facts.diagonal:
        return Schur(), "M is no diagonal matrix, so that J M⁻¹ Jᵀ is dense whatever J is"
    if "Sparse" not in efforts:
        return Schur(), (
            f"elimination along the structure, where up to {effort.clique(facts.structure)} rows"
            f" meet on one body, would be more than {PROGRAM} instructions to compile"
        )
    return Schur(), (
        f"rows meet so closely that elimination takes {direct['Sparse']:.2g} operations (Sparse)"
    )


def _safe(facts: Facts, inner: Solver) -> tuple[Solver, str]:
    """Returns `inner`, wrapped in `RankSafe` if dependent rows need it, and the reason in words.

    Args:
        facts: properties of the system.
        inner: the solver that suits linearly independent rows.
    """
    rows = several(facts.rows, "row")
    count = "" if facts.dependent is None else f", and {facts.dependent or 'none'} do here"
    if not facts.loops and not facts.dependent:
        return inner, f"constraints, {rows}, close no loop, so that no row depends on others"
    if isinstance(inner, ConjugateGradients):
        return inner, f"rows may depend on each other{count}, which iterations allow if they agree"
    if not facts.loops:
        return RankSafe(inner, always=True), (
            f"of {rows} some, {facts.dependent}, depend on others by their numbers alone"
        )
    default = isinstance(inner, Sparse) and inner.order is None
    solver = RankSafe() if default else RankSafe(inner)
    return solver, f"constraints, {rows}, close loops, where they may depend on each other{count}"


def several(count: int, what: str) -> str:
    """Returns a count with its noun, such as "3 rows"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def innermost(solver: Solver) -> Solver:
    """Returns the solver inside `RankSafe`, or the solver itself."""
    while isinstance(solver, RankSafe):
        solver = solver.solver
    return solver


def brief(part: object) -> str:
    """Returns a part of a method as Python code, without arguments that are defaults.

    If the code is too long or has traced numbers, only the class is named: `Class(…)`.
    """
    name = f"{type(part).__name__}(…)"
    if not dataclasses.is_dataclass(part) or not checks.is_concrete(cast(Any, part)):
        return checks.shortened(part) if isinstance(part, int | float) else name
    text = repr(part) if isinstance(part, RungeKutta) else words(cast(Any, part))
    return text if len(text) <= LONG else name


def words(solver: Solver | ContactSolver) -> str:
    """Returns a solver as Python code, without arguments that are defaults."""
    inside = []
    for field in dataclasses.fields(cast(Any, solver)):
        value, default = getattr(solver, field.name), cast(Any, field.default)
        nested = dataclasses.is_dataclass(default)
        if nested and words(value) != words(cast(Any, default)):
            inside.append(words(value))
        elif not nested and not np.array_equal(value, default):  # numbers may be arrays
            inside.append(f"{field.name}={value!r}")
    return f"{type(solver).__name__}({', '.join(inside)})"
