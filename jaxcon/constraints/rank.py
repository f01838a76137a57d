"""Finds dependent and contradicting rows of the Jacobian. Runs in NumPy on the host."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.core import host
from jaxcon.core.typing import Array
from jaxcon.system.state import State

if TYPE_CHECKING:
    from jaxcon.protocols import System

SHARE = 1e-2
"""The smallest residual that counts as a conflict, as a share of the largest right-hand side."""


class UnitRows:
    """The Jacobian rows that remove a degree of freedom, scaled to length one in the metric of M⁻¹.

    J M⁻¹ Jᵀ = Ĵ Ĵᵀ with Ĵ = J L⁻ᵀ and M = L Lᵀ. Each row of Ĵ is divided by its length.

    Attributes:
        numbers: the number of each row in J.
        owners: for each row, the name of its constraint and its number within that constraint.
        values: the scaled rows of Ĵ, (rows, n_v).
        length: the length of each row of Ĵ before scaling, 1 for zero rows, (rows,).
        tolerance: the singular value or residual below which a scaled row counts as zero.
    """

    def __init__(
        self, layout: RowLayout, jacobian: Array | np.ndarray, mass: Array | np.ndarray
    ) -> None:
        owners = _owners(layout)
        self.numbers, self.owners = list(owners), list(owners.values())
        self.tolerance = 1e-9 if jacobian.dtype == np.float64 else 1e-4
        j = np.asarray(jacobian, np.float64)[self.numbers]
        factor = np.linalg.cholesky(np.asarray(mass, np.float64))
        scaled = np.linalg.solve(factor, j.T).T
        length = np.linalg.norm(scaled, axis=1)
        self.length = np.where(length > 0, length, 1)
        self.values = scaled / self.length[:, None]

    @cached_property
    def svd(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The singular value decomposition of the scaled rows: U, the singular values, and Vᵀ."""
        u, s, vt = np.linalg.svd(self.values)
        return u, s, vt

    @property
    def least(self) -> float:
        """The smallest singular value of the rows; 0 if there are more rows than velocities."""
        u, s, _ = self.svd
        return float(s[-1]) if len(s) == len(u) else 0.0

    def within(self, x: Array, low: float, high: float) -> np.ndarray:
        """Projects an array onto combinations of rows with singular values in (low, high].

        The range (−1, 0] selects the linear dependences of the rows: combinations that no motion
        changes.

        Args:
            x: one number for each row of J, (n_c,).
            low: the lower end of the range.
            high: the upper end of the range.

        Returns:
            The projection, (rows,), in the units of x.
        """
        scaled = np.asarray(x, np.float64)[self.numbers] / self.length
        u, s, _ = self.svd
        s = np.append(s, np.zeros(len(u) - len(s)))
        chosen = u[:, (low < s) & (s <= high)]
        return self.length * (chosen @ (chosen.T @ scaled))

    def contradicting(self, x: Array) -> dict[str, float]:
        """Returns the conflicts in a right-hand side x of J a = x, as residual norms by constraint.

        The residual is that of the least-squares solution. Constraints without a conflict are
        omitted.

        Args:
            x: the right-hand side by row, (n_c,).
        """
        left = self.within(x, -1.0, self.tolerance) / self.length
        size = np.max(np.abs(np.asarray(x)[self.numbers] / self.length), initial=0)
        bound = max(SHARE * size, self.tolerance)
        norms: dict[str, float] = {}
        for (name, _), part, length in zip(self.owners, left, self.length, strict=True):
            if abs(part) > bound:
                norms[name] = float(np.hypot(norms.get(name, 0.0), part * length))
        return norms


def linearized(system: System, state: State) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Linearizes the constraints at a state; returns the rows, J and M, as NumPy arrays.

    The function runs on the host and compiles nothing.

    Args:
        system: the system, as `checked_system` returns it for the state.
        state: state of one world, with concrete values.
    """
    return host.evaluate(_linearized, system, state)


@jax.jit  # so that a system is traced once for all of its states
def _linearized(system: System, state: State) -> tuple[Rows, Array, Array]:
    rows = linearize(system, state.q, state.v, state.instant)
    return rows, rows.jacobian.dense(), system.mass(state.q).dense()


def dependent_rows(rows: Array | np.ndarray, tolerance: float) -> list[int]:
    """Returns the numbers of rows that are combinations of rows before them (Gram–Schmidt).

    Args:
        rows: rows of length one, (rows, n_v).
        tolerance: the length of a remainder below which a row counts as dependent.
    """
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


def _owners(layout: RowLayout) -> dict[int, tuple[str, int]]:
    """Maps the number of each row that removes a degree of freedom to its constraint.

    The value is the constraint's name and the number of the row within the constraint.
    """
    holding = [name for name in layout.names if name not in layout.inertial]
    owned = {int(row): (name, i) for name in holding for i, row in enumerate(layout.rows(name))}
    return dict(sorted(owned.items()))
