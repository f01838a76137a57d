"""The saddle system of a constrained system at one instant."""

from __future__ import annotations

from typing import Any

from jaxcon.constraints.rows import Rows
from jaxcon.core.typing import Array
from jaxcon.solvers.saddle import Saddle


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
