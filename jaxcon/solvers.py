"""Solvers of a step's linear system and of its inequality constraints.

Linear systems: RankSafe, Sparse, Schur, Dense, ConjugateGradients.
Levels of priority: Priority, Lexicographic.
Inequality constraints: Newton, InteriorPoint, GaussSeidel, ActiveSet.
Results: Solution.
"""

from jaxcon.contact.gauss_seidel import GaussSeidel
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.contact.nearest_rows import ActiveSet
from jaxcon.contact.newton import Newton
from jaxcon.linear.conjugate_gradients import ConjugateGradients
from jaxcon.linear.dense import Dense
from jaxcon.linear.priority import Lexicographic, Priority
from jaxcon.linear.proximal import RankSafe
from jaxcon.linear.saddle import Solution
from jaxcon.linear.schur import Schur
from jaxcon.linear.sparse import Sparse


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "RankSafe",
    "Sparse",
    "Schur",
    "Dense",
    "ConjugateGradients",
    "Priority",
    "Lexicographic",
    "Newton",
    "InteriorPoint",
    "GaussSeidel",
    "ActiveSet",
    "Solution",
]
