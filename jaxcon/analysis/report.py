"""What a scene amounts to: degrees of freedom, rank, redundant rows. Host code, for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxcon.analysis.memory import Memory, memory
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State, at
from jaxcon.simulation.method import Method


@dataclass(frozen=True)
class Report:
    """The structure of a system at one state; `print` it.

    Attributes:
        coordinates, velocities: n_q, n_v.
        rows: n_c.
        rank: number of independent rows.
        degrees_of_freedom: n_v − rank.
        redundant: (constraint, row in it) of each row that depends on those before it.
        condition: of J M⁻¹ Jᵀ with rows scaled to unit length, independent rows only.
        violation: ‖φ‖ and ‖φ̇‖ by constraint.
        memory: of a world in a batch [B], where a method was given.
    """

    coordinates: int
    velocities: int
    rows: int
    rank: int
    degrees_of_freedom: int
    redundant: tuple[tuple[str, int], ...]
    condition: float
    violation: dict[str, tuple[float, float]]
    memory: Memory | None = None

    def __str__(self) -> str:
        lines = [
            f"{self.coordinates} coordinates, {self.velocities} velocities",
            f"{self.rows} constraint rows of rank {self.rank}: "
            f"{self.degrees_of_freedom} degrees of freedom",
            f"condition of the independent rows: {self.condition:.2g}",
        ]
        if self.redundant:
            named = ", ".join(f"{name}[{row}]" for name, row in self.redundant)
            lines.append(
                f"redundant rows (each depends on rows before it): {named}; keep only independent"
                " ones, for example close a loop with a joint or a Holonomic of fewer rows, or give"
                " the solver a little tikhonov"
            )
        if self.memory:
            lines.append(str(self.memory))
        lines += [
            f"  {name}: violation {phi:.2e}, rate {rate:.2e}"
            for name, (phi, rate) in self.violation.items()
        ]
        return "\n".join(lines)


def report(
    system: Any, state: State, method: Method | None = None, control: PyTree = None
) -> Report:
    """Degrees of freedom, rank, redundant rows by name, violation, and memory of a world.

    Rows are compared in the metric of M⁻¹, scaled to unit length; a row counts as dependent where
    the part that earlier rows do not explain is below 1e-9 (float64) or 1e-4 (float32).

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: of one world.
        method: by which the system is to be stepped, for `memory`, which compiles it and takes
            seconds; None leaves that out.
        control: for `memory`.

    Returns:
        A `Report`.
    """
    system = at(system, state)
    rows, dense_j, dense_m = _linearized(system, state)
    owners = _owners(rows.layout)
    jacobian = np.asarray(dense_j, np.float64)[list(owners)]
    mass = np.asarray(dense_m, np.float64)
    # J M⁻¹ Jᵀ = Ĵ Ĵᵀ with Ĵ = J L⁻ᵀ and M = L Lᵀ
    scaled = np.linalg.solve(np.linalg.cholesky(mass), jacobian.T).T
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    scaled = scaled / np.where(length > 0, length, 1)
    tolerance = 1e-9 if state.q.dtype == np.float64 else 1e-4
    dependent = dependent_rows(scaled, tolerance)
    kept = np.delete(scaled, dependent, axis=0)
    singular = np.linalg.svd(kept, compute_uv=False)
    rank = len(scaled) - len(dependent)
    return Report(
        coordinates=state.q.shape[0],
        velocities=state.v.shape[0],
        rows=len(scaled),
        rank=rank,
        degrees_of_freedom=state.v.shape[0] - rank,
        redundant=tuple(list(owners.values())[i] for i in dependent),
        condition=float((singular[0] / singular[-1]) ** 2) if len(singular) else 1.0,
        violation={
            name: (float(rows.violation[name]), float(rows.violation.rate(name)))
            for name in rows.layout.names
        },
        memory=None if method is None else memory(system, method, state, control),
    )


@jax.jit
def _linearized(system: Any, state: State) -> tuple[Rows, Array, Array]:
    """The rows with J and M as arrays."""
    rows = linearize(system, state.q, state.v, state.time)
    return rows, rows.jacobian.dense(), system.mass(state.q).dense()


def dependent_rows(rows: Array | np.ndarray, tolerance: float) -> list[int]:
    """Numbers of the unit rows that are combinations of the rows before them (Gram–Schmidt)."""
    basis = np.zeros((0, rows.shape[1]))
    dependent = []
    for i, row in enumerate(np.asarray(rows)):
        rest = row - basis.T @ (basis @ row)
        rest = rest - basis.T @ (basis @ rest)
        size = np.linalg.norm(rest)
        if size > tolerance:
            basis = np.vstack([basis, rest / size])
        else:
            dependent.append(i)
    return dependent


def _owners(layout: Any) -> dict[int, tuple[str, int]]:
    """Constraint and row in it, by row number, of the rows that take away a freedom."""
    holding = [name for name in layout.names if name not in layout.inertial]
    owned = {int(row): (name, i) for name in holding for i, row in enumerate(layout.rows(name))}
    return dict(sorted(owned.items()))
