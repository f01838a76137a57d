"""What a scene amounts to: degrees of freedom, rank, redundant rows. Host code, for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jaxcon.analysis.memory import Memory, memory
from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State, at
from jaxcon.simulation.method import Method

SHARE = 1e-2
"""Of the largest entry, from which a part that least squares leave is called a conflict."""
OFF = 1e-4
"""‖φ‖ [m, rad] from which on a report speaks of it."""


@dataclass(frozen=True)
class Report:
    """The structure of a system at one state; `print` it.

    Attributes:
        coordinates, velocities: n_q, n_v.
        rows: n_c.
        rank: number of independent rows.
        degrees_of_freedom: n_v − rank.
        redundant: (constraint, row in it) of each row that depends on those before it.
        conflicts: by constraint, what least squares leave of φ, φ̇ and γ: the part that no
            displacement, velocity or acceleration can take away, because rows contradict each
            other; only of constraints where there is such a part.
        condition: of J M⁻¹ Jᵀ with rows scaled to unit length, independent rows only.
        violation: ‖φ‖ and ‖φ̇‖ by constraint; both ‖ψ‖ where it holds velocities alone.
        memory: of a world in a batch [B], where a method was given.
        bounded: names of what has bounded rows, limits, friction and contact, left out of the rest.
        off: names of the constraints with ‖φ‖ above 1e-4; those that hold velocities have no φ.
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
    conflicts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    off: tuple[str, ...] = ()
    bounded: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [
            f"{self.coordinates} coordinates, {self.velocities} velocities",
            f"{self.rows} constraint rows of rank {self.rank}: "
            f"{self.degrees_of_freedom} degrees of freedom",
            f"condition of the independent rows: {self.condition:.2g}",
        ]
        if self.bounded:
            lines.append(f"besides, rows with bounds: {', '.join(self.bounded)}")
        if self.redundant:
            named = ", ".join(f"{name}[{row}]" for name, row in self.redundant)
            lines.append(
                f"redundant rows (each depends on rows before it here): {named}; the default"
                " solver takes them as they are, but shares forces among them as it chooses; to"
                " know these, keep only independent rows, as with a joint of fewer rows in the"
                " loop, unless this is a singular position, which another state tells"
            )
        if self.conflicts:
            lines.append(
                "contradicting constraints, and what no motion can take away of them; keep those"
                " that agree, or rank them by jc.Priority"
            )
            lines += [
                f"  {name}: {phi:.2e} of φ, {rate:.2e} of φ̇, {bias:.2e} of φ̈"
                for name, (phi, rate, bias) in self.conflicts.items()
            ]
        if self.memory:
            lines.append(str(self.memory))
        lines += [
            f"  {name}: violation {phi:.2e}, rate {rate:.2e}"
            for name, (phi, rate) in self.violation.items()
        ]
        if self.off:
            lines.append(
                f"off {', '.join(self.off)}: print(jc.assemble(system, state)) takes it to the"
                " nearest positions that meet them, or names those that cannot be met"
            )
        return "\n".join(lines)


def report(
    system: Any, state: State, method: Method | None = None, control: PyTree = None
) -> Report:
    """Degrees of freedom, rank, redundant and contradicting rows by name, violation, and memory.

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
    system = at(system, state, "jc.report(system, s)")
    rows, dense_j, dense_m = linearized(system, state)
    unit = UnitRows(rows.layout, dense_j, dense_m)
    dependent = dependent_rows(unit.values, unit.tolerance)
    singular = np.linalg.svd(np.delete(unit.values, dependent, axis=0), compute_uv=False)
    rank = len(unit.values) - len(dependent)
    left = [unit.contradicting(x) for x in (rows.residual, rows.rate, rows.bias)]
    violation = {
        name: (float(rows.violation[name]), float(rows.violation.rate(name)))
        for name in rows.layout.names
    }
    return Report(
        coordinates=state.q.shape[0],
        velocities=state.v.shape[0],
        rows=len(unit.values),
        rank=rank,
        degrees_of_freedom=state.v.shape[0] - rank,
        redundant=tuple(unit.owners[i] for i in dependent),
        condition=float((singular[0] / singular[-1]) ** 2) if len(singular) else 1.0,
        violation=violation,
        off=tuple(
            name
            for name, (size, _) in violation.items()
            if size > OFF and name not in rows.layout.velocity_level
        ),
        bounded=tuple(name for group in system.bounds for name in group.names),
        memory=None if method is None else memory(system, method, state, control),
        conflicts={
            name: (left[0].get(name, 0.0), left[1].get(name, 0.0), left[2].get(name, 0.0))
            for name in rows.layout.names
            if any(name in part for part in left)
        },
    )


class UnitRows:
    """Rows that take away a freedom, in the metric of M⁻¹ and scaled to unit length.

    J M⁻¹ Jᵀ = Ĵ Ĵᵀ with Ĵ = J L⁻ᵀ and M = L Lᵀ; each row of Ĵ is divided by its length.

    Attributes:
        owners: (constraint, row in it) of each.
        values: (rows, n_v).
        length: of each before it was scaled.
        tolerance: below which a length counts as zero.
    """

    def __init__(self, layout: RowLayout, jacobian: Array, mass: Array) -> None:
        owners = _owners(layout)
        self.numbers, self.owners = list(owners), list(owners.values())
        self.tolerance = 1e-9 if jacobian.dtype == np.float64 else 1e-4
        j = np.asarray(jacobian, np.float64)[self.numbers]
        factor = np.linalg.cholesky(np.asarray(mass, np.float64))
        scaled = np.linalg.solve(factor, j.T).T
        length = np.linalg.norm(scaled, axis=1)
        self.length = np.where(length > 0, length, 1)
        self.values = scaled / self.length[:, None]

    def within(self, x: Array, low: float, high: float) -> np.ndarray:
        """The part of an array by rows (n_c,) in directions with singular values in (low, high].

        These are combinations of rows; −1 … 0 are those that no motion changes.
        """
        own = np.asarray(x, np.float64)[self.numbers] / self.length
        u, s, _ = np.linalg.svd(self.values)
        s = np.append(s, np.zeros(len(u) - len(s)))
        chosen = u[:, (low < s) & (s <= high)]
        return self.length * (chosen @ (chosen.T @ own))

    def contradicting(self, x: Array) -> dict[str, float]:
        """The norm of what least squares leave of an array by rows (n_c,), by constraint."""
        left = self.within(x, -1.0, self.tolerance) / self.length
        size = np.max(np.abs(np.asarray(x)[self.numbers] / self.length), initial=0)
        bound = max(SHARE * size, self.tolerance)
        found: dict[str, float] = {}
        for (name, _), part, length in zip(self.owners, left, self.length, strict=True):
            if abs(part) > bound:
                found[name] = float(np.hypot(found.get(name, 0.0), part * length))
        return found


@jax.jit
def linearized(system: Any, state: State) -> tuple[Rows, Array, Array]:
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
