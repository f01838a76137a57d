"""Accelerations and multipliers at one state."""

from __future__ import annotations

from typing import Any

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core.typing import Array
from jaxcon.dynamics.assembly import saddle
from jaxcon.solvers.saddle import Solution


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
