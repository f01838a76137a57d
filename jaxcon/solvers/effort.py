"""What solving a structure takes with each solver, before anything is traced. Host code.

The structure of J is `(first row, rows an element, columns)` of each of its blocks. Operations are
those of one world, additions and multiplications counted apart; instructions are those that become
code, so that what a loop repeats, or a call of LAPACK does, counts once; numbers are what a world
holds between factorization and substitution. They are leading terms, right to a small factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxcon.solvers import ordering
from jaxcon.solvers.ordering import Batch, Run

Structure = tuple[Any, ...]


@dataclass(frozen=True)
class Effort:
    """What one factorization and some substitutions take.

    Attributes:
        operations: arithmetic, by world.
        instructions: of compiled code.
        numbers: that are held, by world.
    """

    operations: float
    instructions: float
    numbers: float


def structure_of(jacobian: Any) -> Structure:
    """The structure of a Jacobian, of which shapes are enough."""
    return tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)


def clique(structure: Structure) -> int:
    """The most rows that meet on one body: its constraints all touch each other."""
    rows: dict[tuple[int, int], int] = {}
    for _, size, columns in structure:
        for body in columns.indices:
            key = columns.start, body
            rows[key] = rows.get(key, 0) + size
    return max(rows.values(), default=0)


def entries(structure: Structure) -> int:
    """Entries of J that may differ from zero."""
    return sum(m * columns.components * len(columns.indices) for _, m, columns in structure)


def elimination(
    structure: Structure, order: str, solves: int = 1, most: float = float("inf")
) -> Effort | None:
    """Returns the effort of `Sparse`: block LDLᵀ along a plan, whose fill is known.

    Args:
        structure: of J.
        order: "runs" or "levels".
        solves: substitutions with one factorization.
        most: instructions; None is returned where the rows that meet on one body alone, which are
            eliminated one block after the other, make more.
    """
    met = clique(structure)
    if met > 1 and _eliminate(1, met - 1) * met / 3 > most:
        return None
    plan = ordering.plan(structure, order=order)
    width = {start: columns.components for start, _, columns in structure}
    formed = sum(
        2 * p.size * q.size * max(width.values(), default=0)
        for coupling in plan.couplings
        for p, q in coupling.pairs
    )
    operations, code, numbers = float(formed), 0.0, 0.0
    for step in plan.steps:
        m, r = step.nodes[0].size, sum(_later(step))
        once = _eliminate(m, r) + _substitute(m, r)
        code += once
        operations += len(step.nodes) * (_eliminate(m, r) + solves * _substitute(m, r))
        numbers += len(step.nodes) * (m * (m + 1) / 2 + m * r)
    return Effort(operations + 4 * solves * entries(structure), code, numbers)


def _later(step: Batch | Run) -> Sequence[int]:
    """Rows of the later neighbours of each node of a step."""
    if isinstance(step, Run):
        return [step.parent.size, *(node.size for node in step.border)]
    return [node.size for node in step.later[0]]


def _eliminate(m: float, r: float) -> float:
    """A block of m rows with r rows of later neighbours: LDLᵀ, A_qp L⁻ᵀ, and what it changes."""
    return m**3 / 3 + m * m * r + m * r * (r + 1)


def _substitute(m: float, r: float) -> float:
    """Down and back."""
    return 2 * m * m + 4 * m * r


def schur(n_v: int, n_c: int, full: bool, solves: int = 1, elsewhere: float = 30.0) -> Effort:
    """Returns the effort of `Schur`: J M⁻¹ Jᵀ as a product of matrices, and Cholesky.

    Args:
        n_v: velocities.
        n_c: rows.
        full: whether M is, which takes a factorization of its own.
        solves: substitutions with one factorization.
        elsewhere: instructions that do not depend on sizes.
    """
    mass = n_v**3 / 3 + 2 * n_v * n_v * (n_c + 2 * solves) if full else float(n_v * n_c)
    form = 2.0 * n_c * n_c * n_v + n_c**3 / 3
    one = 2.0 * n_c * n_c + 4.0 * n_c * n_v
    return Effort(mass + form + solves * one, elsewhere, float(n_c * (n_c + n_v)))


def saddle(n_v: int, n_c: int, solves: int = 1, elsewhere: float = 20.0) -> Effort:
    """Returns the effort of `Dense`: LU of the whole matrix.

    Args:
        n_v: velocities.
        n_c: rows.
        solves: substitutions with one factorization.
        elsewhere: instructions that do not depend on sizes.
    """
    n = n_v + n_c
    return Effort(2 * n**3 / 3 + 2.0 * solves * n * n, elsewhere, float(n * n))


def iterations(structure: Structure, rows: int, rounds: int, solves: int = 1) -> Effort:
    """Returns the effort of `ConjugateGradients`: products with J and Jᵀ, and a block Jacobi step.

    Args:
        structure: of J.
        rows: how many.
        rounds: iterations.
        solves: systems, each with as many.
    """
    own = {start: (m, len(columns.indices)) for start, m, columns in structure}
    blocks = sum(count * (m**3 / 3 + m * m) for m, count in own.values())
    swept = sum(2 * count * m * m for m, count in own.values())
    code = sum(m**3 / 3 + 3 * m * m for m, _ in own.values())
    code += sum(4 * m * columns.components for _, m, columns in structure)
    once = 4.0 * entries(structure) + swept + 12 * rows
    return Effort(blocks + solves * rounds * once, code, float(8 * rows))


ROUNDS = 15
"""Iterations that the interior point usually takes."""


def interior_point(rows: int) -> float:
    """Operations of `InteriorPoint`: each iteration inverts one matrix, 2 n³, and applies it twice.

    Args:
        rows: n, the number of inequality rows that are solved.
    """
    return ROUNDS * (2.0 * rows**3 + 6.0 * rows * rows)


def gauss_seidel(rows: int, sweeps: int) -> float:
    """Operations of `GaussSeidel`: each sweep is about one product with the matrix, 2 n².

    Args:
        rows: n, the number of inequality rows that are solved.
        sweeps: how many.
    """
    return sweeps * (2.0 * rows * rows + 6.0 * rows)
