"""Solves inequality rows by projected Gauss–Seidel sweeps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.contact.bounded import Bounded, onto_disc
from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.linear import gauss_jordan
from jaxcon.linear.gauss_jordan import at, put
from jaxcon.protocols import ContactSolver


@pytree
class GaussSeidel(checks.Checked, ContactSolver):
    """Projected Gauss–Seidel: a fixed number of sweeps over rows and contacts, with a warm start.

    A sweep solves each row with all other rows fixed: λᵢ ← P(λᵢ − uᵢ/Gᵢᵢ), where P projects onto
    the bounds. In a contact the normal comes first, then the tangents: λ_t ← P(λ_t − u_t/ρ), where
    ρ is the larger eigenvalue of the tangents' block of G. A fixed point satisfies Signorini's and
    Coulomb's laws without relaxation. Convergence is linear, and slow if light bodies carry heavy
    ones.

    Attributes:
        sweeps: number of sweeps in a step.
        warm: True to start from the multipliers of the last step.
        smoothing: width of the smoothed corners of the laws, for the derivative only [m/s, rad/s].
        regularization: the least compliance of a row, see `Newton`; None for exact laws.

    References:
        Jourdan, Alart, Jean, A Gauss–Seidel like algorithm to solve frictional contact problems,
            Comput. Methods Appl. Mech. Eng. 155 (1998).
    """

    sweeps: int = static(default=30)
    warm: bool = static(default=True)  # type: ignore[override]
    smoothing: Any = None
    regularization: Any = None
    # a landing without restitution is split between two steps, see `landing`
    exact = False  # type: ignore[assignment]

    def check(self) -> None:
        """Checks the number of sweeps, the warm start and the smoothing.

        Raises:
            ValueError: `sweeps` is not a positive integer, `warm` is not a bool, or `smoothing` or
                `regularization` is negative.
        """
        checks.count("GaussSeidel", "sweeps", self.sweeps)
        checks.flag("GaussSeidel", "warm", self.warm)
        checks.check("GaussSeidel", "smoothing", self.smoothing, (), least=0, optional=True)
        checks.check(
            "GaussSeidel", "regularization", self.regularization, (), least=0, optional=True
        )

    def solve(self, problem: Bounded, start: Array) -> Array:
        """Returns the multipliers λ, (n,), after sweeps from an initial guess, (n,)."""
        pivot = pivots(problem)
        return jax.lax.fori_loop(0, self.sweeps, lambda _, x: sweep(problem, x, pivot), start)


class Pivots(NamedTuple):
    """The diagonal blocks of G by which a sweep divides.

    Attributes:
        rows: diagonal entries Gᵢᵢ of one-sided rows and boxes.
        lower, upper: bounds on λ of these rows.
        normal: diagonal entries Gᵢᵢ of the normals of contacts.
        discs: for each disc, the larger eigenvalue of the block of each contact.
    """

    rows: Array
    lower: Array
    upper: Array
    normal: Array
    discs: tuple[Array, ...]


def pivots(problem: Bounded) -> Pivots:
    """Returns the pivots of a problem; all sweeps use the same pivots."""
    kinds, diagonals = problem.kinds, problem.kinds.split(gauss_jordan.diagonal(problem.matrix))
    free = jnp.zeros((kinds.single, *problem.lower.shape[1:]), problem.lower.dtype)
    tiny = float(jnp.finfo(problem.matrix.dtype).tiny) ** 0.5  # a smaller Gᵢᵢ counts as zero
    largest = []
    for disc, start, diagonal in zip(kinds.discs, kinds.starts, diagonals.discs, strict=False):
        most = diagonal[0] if len(diagonal) else diagonals.normal
        if len(diagonal) == 2:
            (a, c), b = diagonal, _across(problem.matrix, start, disc.count)
            most = (a + c) / 2 + jnp.sqrt(((a - c) / 2) ** 2 + b * b)
        largest.append(jnp.maximum(most, tiny))
    return Pivots(
        problem.diagonal()[: kinds.normal],
        jnp.concatenate([free, problem.lower]),
        jnp.concatenate([free + jnp.inf, problem.upper]),
        jnp.maximum(diagonals.normal, tiny),
        tuple(largest),
    )


def _across(matrix: Array, start: int, count: int) -> Array:
    """Returns the off-diagonal entry of G for the two disc rows of each contact, (count,)."""
    block = matrix[start : start + count, start + count : start + 2 * count]
    return gauss_jordan.diagonal(block)


def sweep(problem: Bounded, multipliers: Array, pivot: Pivots | None = None) -> Array:
    """Returns λ after one sweep: each row and contact solved once, with all other rows fixed."""
    pivot = pivots(problem) if pivot is None else pivot
    x = _contacts(problem, _rows(problem, multipliers, pivot), pivot)
    for i in range(len(problem.kinds.turning)):
        x = _turning(problem, i, x, pivot)
    return x


def _rows(problem: Bounded, multipliers: Array, pivot: Pivots) -> Array:
    """Returns λ with one-sided rows and boxes solved one after another."""
    if not problem.kinds.normal:
        return multipliers

    def update(i: Array | int, x: Array) -> Array:
        new = at(x, i) - _velocity(problem, i, x) / at(pivot.rows, i)
        return put(x, jnp.clip(new, at(pivot.lower, i), at(pivot.upper, i)), i)

    return jax.lax.fori_loop(0, problem.kinds.normal, update, multipliers)


def _contacts(problem: Bounded, multipliers: Array, pivot: Pivots) -> Array:
    """Returns λ with contacts solved in turn: the normal, then the tangents with the new λ_n."""
    kinds = problem.kinds
    if not kinds.contacts:
        return multipliers

    def update(i: Array | int, x: Array) -> Array:
        n = kinds.normal + i
        rows = [n + (1 + j) * kinds.contacts for j in range(kinds.tangents)]
        normal = jnp.maximum(at(x, n) - _velocity(problem, n, x) / at(pivot.normal, i), 0)
        change = normal - at(x, n)
        slips = [_velocity(problem, j, x) + at(at(problem.matrix, j), n) * change for j in rows]
        radius = at(problem.friction, i) * normal
        return _disc(rows, slips, at(pivot.discs[0], i), radius, put(x, normal, n))

    return jax.lax.fori_loop(0, kinds.contacts, update, multipliers)


def _turning(problem: Bounded, which: int, multipliers: Array, pivot: Pivots) -> Array:
    """Returns λ with a disc of rolling or spinning resistance solved, contact by contact.

    Args:
        problem: the problem u = G λ + c with bounds on λ.
        which: index of the disc in `kinds.turning`.
        multipliers: multipliers λ, (n,).
        pivot: the pivots of the problem.
    """
    kinds = problem.kinds
    disc, start, most = kinds.turning[which], kinds.starts[1 + which], problem.resistance[which]

    def update(i: Array | int, x: Array) -> Array:
        rows = [start + j * disc.count + i for j in range(disc.rank)]
        slips = [_velocity(problem, j, x) for j in rows]
        radius = at(most, i) * at(x, kinds.normal + disc.first + i)
        return _disc(rows, slips, at(pivot.discs[1 + which], i), radius, x)

    return jax.lax.fori_loop(0, disc.count, update, multipliers)


def _disc(rows: list[Any], slips: list[Array], pivot: Array, radius: Array, x: Array) -> Array:
    """Returns λ with the disc rows of one contact solved, and all other rows fixed.

    Args:
        rows: the indices of these disc rows in λ.
        slips: the velocities u of the disc rows.
        pivot: the larger eigenvalue of the block of G of the disc rows.
        radius: the bound μ λ_n on the norm of the multipliers of the disc rows.
        x: multipliers λ, (n,).
    """
    tangent = Vector(*(at(x, j) - u / pivot for j, u in zip(rows, slips, strict=True)))
    for j, y in zip(rows, onto_disc(tangent, radius), strict=True):
        x = put(x, y, j)
    return x


def _velocity(problem: Bounded, i: Array | int, multipliers: Array) -> Array:
    """Returns the velocity uᵢ of row i, for each world."""
    return jnp.sum(at(problem.matrix, i) * multipliers, axis=0) + at(problem.offset, i)
