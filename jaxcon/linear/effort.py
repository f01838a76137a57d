"""Estimates the cost of each solver from the structure of J, on the host, before tracing.

The structure of J lists `(first row, rows per element, columns)` for each Jacobian block. All
operation counts are leading terms, accurate to a small factor.
"""

from dataclasses import dataclass

from jaxcon.linear import ordering
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.ordering import EliminationBatch, Structure


@dataclass(frozen=True)
class Effort:
    """The cost of one factorization and of the substitutions that use it.

    Attributes:
        operations: the number of additions and multiplications for each world.
        instructions: the size of the compiled code; a loop body or a LAPACK call counts once.
        numbers: the number of floats stored between factorization and substitution, for each world.
    """

    operations: float
    instructions: float
    numbers: float


def structure_of(jacobian: Jacobian) -> Structure:
    """Returns the structure of a Jacobian, whose arrays may be abstract (without values)."""
    return tuple((b.start, b.shape[0], b.columns) for b in jacobian.blocks)


def clique(structure: Structure) -> int:
    """Returns the largest number of constraint rows that touch one body.

    The constraints of a body form a clique in the graph of A = J M⁻¹ Jᵀ: all are neighbors.
    """
    rows: dict[tuple[int, int], int] = {}
    for _, size, columns in structure:
        for body in columns.indices:
            key = columns.start, body
            rows[key] = rows.get(key, 0) + size
    return max(rows.values(), default=0)


def entries(structure: Structure) -> int:
    """Returns the number of structural nonzeros of J."""
    return sum(m * columns.components * len(columns.indices) for _, m, columns in structure)


def elimination(
    structure: Structure, order: str, solves: int = 1, most: float = float("inf")
) -> Effort | None:
    """Estimates the effort of `Sparse`: block LDLᵀ along an elimination plan with known fill.

    Args:
        structure: the structure of J.
        order: the elimination order, "runs" or "levels"; see `Sparse`.
        solves: the number of substitutions with one factorization.
        most: the limit on instructions. The result is None if the constraints of a single body
            already exceed this limit. They are all coupled to each other, so they are eliminated
            one after another.
    """

    def factor(m: float, r: float) -> float:
        """Returns the number of operations that eliminate a constraint p with m rows.

        Let q be the constraints that are coupled to p and eliminated later. The operations factor
        A_pp = L D Lᵀ, compute A_qp L⁻ᵀ for all q, and update the blocks between them.

        Args:
            m: the number of rows of p.
            r: the total number of rows of all q.
        """
        return m**3 / 3 + m * m * r + m * r * (r + 1)

    met = clique(structure)
    if met > 1 and factor(1, met - 1) * met / 3 > most:
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
        later = step.later[0] if isinstance(step, EliminationBatch) else (step.parent, *step.border)
        count, m, r = len(step.nodes), step.nodes[0].size, sum(node.size for node in later)
        substitution = 2 * m * m + 4 * m * r
        code += factor(m, r) + substitution
        operations += count * (factor(m, r) + solves * substitution)
        numbers += count * (m * (m + 1) / 2 + m * r)
    return Effort(operations + 4 * solves * entries(structure), code, numbers)


def schur(n_v: int, n_c: int, full: bool, solves: int = 1, elsewhere: float = 30.0) -> Effort:
    """Estimates the effort of `Schur`: the matrix product J M⁻¹ Jᵀ, and its Cholesky factor.

    Args:
        n_v: the number of velocities.
        n_c: the number of rows of J.
        full: True if M is a full matrix, which must be factored as well.
        solves: the number of substitutions with one factorization.
        elsewhere: the number of instructions, which does not depend on n_v and n_c.
    """
    mass = n_v**3 / 3 + 2 * n_v * n_v * (n_c + 2 * solves) if full else float(n_v * n_c)
    form = 2.0 * n_c * n_c * n_v + n_c**3 / 3
    substitution = 2.0 * n_c * n_c + 4.0 * n_c * n_v
    return Effort(mass + form + solves * substitution, elsewhere, float(n_c * (n_c + n_v)))


def saddle(n_v: int, n_c: int, solves: int = 1, elsewhere: float = 20.0) -> Effort:
    """Estimates the effort of `Dense`: LU decomposition of the whole saddle matrix.

    Args:
        n_v: the number of velocities.
        n_c: the number of rows of J.
        solves: the number of substitutions with one factorization.
        elsewhere: the number of instructions, which does not depend on n_v and n_c.
    """
    n = n_v + n_c
    return Effort(2 * n**3 / 3 + 2.0 * solves * n * n, elsewhere, float(n * n))


def iterations(structure: Structure, rows: int, rounds: int, solves: int = 1) -> Effort:
    """Estimates the effort of `ConjugateGradients`: products with J and Jᵀ, and block Jacobi.

    Args:
        structure: the structure of J.
        rows: the number of rows of J.
        rounds: the number of iterations for each right-hand side.
        solves: the number of right-hand sides.
    """
    sizes = {start: (m, len(columns.indices)) for start, m, columns in structure}
    blocks = sum(count * (m**3 / 3 + m * m) for m, count in sizes.values())
    swept = sum(2 * count * m * m for m, count in sizes.values())
    code = sum(m**3 / 3 + 3 * m * m for m, _ in sizes.values())
    code += sum(4 * m * columns.components for _, m, columns in structure)
    iteration = 4.0 * entries(structure) + swept + 12 * rows
    return Effort(blocks + solves * rounds * iteration, code, float(8 * rows))
