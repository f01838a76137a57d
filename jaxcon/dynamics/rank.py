"""Which rows depend on each other, and which contradict each other. Host code."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import jax
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows, linearize
from jaxcon.core import host
from jaxcon.core.typing import Array
from jaxcon.model.state import State

SHARE = 1e-2
"""The share of the largest entry above which a remainder of least squares is a conflict."""


class UnitRows:
    """Rows that take away a freedom, in the metric of M⁻¹ and scaled to unit length.

    J M⁻¹ Jᵀ = Ĵ Ĵᵀ with Ĵ = J L⁻ᵀ and M = L Lᵀ; each row of Ĵ is divided by its length.

    Attributes:
        owners: (constraint, row in it) of each.
        values: (rows, n_v).
        length: of each before it was scaled.
        tolerance: below which a length counts as zero.
    """

    def __init__(self, layout: RowLayout, jacobian: Any, mass: Any) -> None:
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
        """U, the singular values and Vᵀ of the values."""
        u, s, vt = np.linalg.svd(self.values)
        return u, s, vt

    @property
    def least(self) -> float:
        """The least singular value, by rows; 0 where there are more rows than velocities."""
        u, s, _ = self.svd
        return float(s[-1]) if len(s) == len(u) else 0.0

    def within(self, x: Array, low: float, high: float) -> np.ndarray:
        """The part of an array by rows (n_c,) in directions with singular values in (low, high].

        These are combinations of rows; −1 … 0 are those that no motion changes.
        """
        own = np.asarray(x, np.float64)[self.numbers] / self.length
        u, s, _ = self.svd
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


def linearized(system: Any, state: State) -> tuple[Rows, np.ndarray, np.ndarray]:
    """The rows, J and M of a state as NumPy arrays; nothing is compiled.

    Args:
        system: as the state remembers it.
        state: of one world, with known numbers.
    """
    return host.evaluate(_linearized, system, state)


@jax.jit  # so that a system is traced once, however many of its states are looked at
def _linearized(system: Any, state: State) -> tuple[Rows, Array, Array]:
    rows = linearize(system, state.q, state.v, state.instant)
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
