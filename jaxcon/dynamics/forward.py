"""The saddle system of a constrained system, and its accelerations and multipliers."""

from __future__ import annotations

from typing import Any

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core.typing import Array
from jaxcon.solvers.saddle import Saddle, Solution


def saddle(system: Any, q: Array, rows: Rows, force: Array, target: Array) -> Saddle:
    """M a = f + Jᵀλ, J a + C λ = b.

    Args:
        system: with `mass(q)`.
        q: positions, (n_q,).
        rows: the linearized constraints.
        force: f, (n_v,).
        target: b, (n_c,).

    Returns:
        What a solver takes.
    """
    return Saddle(system.mass(q), force, rows.jacobian, target, rows.compliance)


def accelerate(
    system: Any, stabilizer: Any, solver: Any, control: Any, memory: Any, dt: Any
) -> Any:
    """The function (q, v, t) → (solution, rows) that integrators call."""

    def at(q: Array, v: Array, t: Any) -> tuple[Solution, Rows]:
        rows = linearize(system, q, v, t)
        target = stabilizer.target(rows, memory, dt)
        force = system.force(q, v, t, control)
        return system.complete(solver.solve(saddle(system, q, rows, force, target))), rows

    return at
