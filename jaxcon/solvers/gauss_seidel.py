"""Bounded rows by projected Gauss–Seidel sweeps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, onto_disc
from jaxcon.solvers.gauss_jordan import at, put


@pytree
class GaussSeidel(checks.Checked):
    """A fixed number of sweeps over rows, contact by contact, from the multipliers of a step ago.

    Each row is solved with all others held: λᵢ ← P(λᵢ − uᵢ/Gᵢᵢ), of a contact first the normal and
    then the tangents, λ_t ← P(λ_t − u_t/ρ) with ρ the larger eigenvalue of their block. Where it
    rests, Signorini's and Coulomb's laws hold as they are, not relaxed. It converges linearly, and
    slowly where light bodies carry heavy ones.

    Attributes:
        sweeps: how many.
        warm: whether it starts where the last step ended.
        smoothing: the width of smoothed corners of the laws, for the derivative only [m/s, rad/s].

    References:
        Jourdan, Alart, Jean, A Gauss–Seidel like algorithm to solve frictional contact problems,
            Comput. Methods Appl. Mech. Eng. 155 (1998).
    """

    sweeps: int = static(default=30)
    warm: bool = static(default=True)
    smoothing: Any = None
    exact = False  # a landing without restitution is shared between two steps

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: there are no sweeps, or a number is out of range.
        """
        checks.count("GaussSeidel", "sweeps", self.sweeps)
        checks.flag("GaussSeidel", "warm", self.warm)
        checks.check("GaussSeidel", "smoothing", self.smoothing, (), least=0, optional=True)

    def solve(self, problem: Bounded, start: Array) -> Array:
        """λ, (n,), from a first guess (n,)."""
        known = pivots(problem)
        return jax.lax.fori_loop(0, self.sweeps, lambda _, x: sweep(problem, x, known), start)


class Pivots(NamedTuple):
    """What multipliers add to their own velocities, by what is solved at once.

    Attributes:
        rows: of one-sided rows and boxes, one each.
        lower, upper: their bounds.
        normal: of contacts.
        discs: by disc, the larger eigenvalue of the block of each contact.
    """

    rows: Array
    lower: Array
    upper: Array
    normal: Array
    discs: tuple[Array, ...]


def pivots(problem: Bounded) -> Pivots:
    """Returns the pivots of all sweeps."""
    kinds, own = problem.kinds, problem.kinds.split(gauss_jordan.diagonal(problem.matrix))
    free = jnp.zeros((kinds.single, *problem.lower.shape[1:]), problem.lower.dtype)
    tiny = float(jnp.finfo(problem.matrix.dtype).tiny) ** 0.5  # below it a row does not move itself
    largest = []
    for disc, start, diagonal in zip(kinds.discs, kinds.starts, own.discs, strict=False):
        most = diagonal[0] if len(diagonal) else own.normal
        if len(diagonal) == 2:
            (a, c), b = diagonal, _across(problem.matrix, start, disc.count)
            most = (a + c) / 2 + jnp.sqrt(((a - c) / 2) ** 2 + b * b)
        largest.append(jnp.maximum(most, tiny))
    return Pivots(
        problem.diagonal()[: kinds.normal],
        jnp.concatenate([free, problem.lower]),
        jnp.concatenate([free + jnp.inf, problem.upper]),
        jnp.maximum(own.normal, tiny),
        tuple(largest),
    )


def _across(matrix: Array, start: int, count: int) -> Array:
    """Between the two rows of each contact of a disc, (count,)."""
    block = matrix[start : start + count, start + count : start + 2 * count]
    return gauss_jordan.diagonal(block)


def sweep(problem: Bounded, multipliers: Array, known: Pivots | None = None) -> Array:
    """Each row and each contact solved once, with all others held."""
    known = pivots(problem) if known is None else known
    x = _contacts(problem, _rows(problem, multipliers, known), known)
    for i in range(len(problem.kinds.turning)):
        x = _turning(problem, i, x, known)
    return x


def _rows(problem: Bounded, multipliers: Array, known: Pivots) -> Array:
    """One-sided rows and boxes, one after the other."""
    if not problem.kinds.normal:
        return multipliers

    def one(i: Any, x: Array) -> Array:
        new = at(x, i) - _velocity(problem, i, x) / at(known.rows, i)
        return put(x, jnp.clip(new, at(known.lower, i), at(known.upper, i)), i)

    return jax.lax.fori_loop(0, problem.kinds.normal, one, multipliers)


def _contacts(problem: Bounded, multipliers: Array, known: Pivots) -> Array:
    """Contacts, one after the other: the normal, and tangents by what it then is."""
    kinds = problem.kinds
    if not kinds.contacts:
        return multipliers

    def one(i: Any, x: Array) -> Array:
        n = kinds.normal + i
        rows = [n + (1 + j) * kinds.contacts for j in range(kinds.tangents)]
        normal = jnp.maximum(at(x, n) - _velocity(problem, n, x) / at(known.normal, i), 0)
        change = normal - at(x, n)
        slips = [_velocity(problem, j, x) + at(at(problem.matrix, j), n) * change for j in rows]
        radius = at(problem.friction, i) * normal
        return _disc(rows, slips, at(known.discs[0], i), radius, put(x, normal, n))

    return jax.lax.fori_loop(0, kinds.contacts, one, multipliers)


def _turning(problem: Bounded, which: int, multipliers: Array, known: Pivots) -> Array:
    """Resistance to rolling or spinning, contact by contact."""
    kinds = problem.kinds
    disc, start, most = kinds.turning[which], kinds.starts[1 + which], problem.resistance[which]

    def one(i: Any, x: Array) -> Array:
        rows = [start + j * disc.count + i for j in range(disc.rank)]
        slips = [_velocity(problem, j, x) for j in rows]
        radius = at(most, i) * at(x, kinds.normal + disc.first + i)
        return _disc(rows, slips, at(known.discs[1 + which], i), radius, x)

    return jax.lax.fori_loop(0, disc.count, one, multipliers)


def _disc(rows: list[Any], slips: list[Array], pivot: Array, radius: Array, x: Array) -> Array:
    """λ with that of one disc solved, all others held."""
    tangent = Vector(*(at(x, j) - u / pivot for j, u in zip(rows, slips, strict=True)))
    for j, y in zip(rows, onto_disc(tangent, radius), strict=True):
        x = put(x, y, j)
    return x


def _velocity(problem: Bounded, i: Any, multipliers: Array) -> Array:
    """uᵢ, by world."""
    return jnp.sum(at(problem.matrix, i) * multipliers, axis=0) + at(problem.offset, i)
