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
from jaxcon.solvers.bounded import Bounded, Parts, onto_disc
from jaxcon.solvers.gauss_jordan import at, put

MUCH = 1000
"""Times what rounding leaves."""


@pytree
class GaussSeidel:
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

    def check(self) -> None:
        """Checks the number of sweeps.

        Raises:
            ValueError: there are none.
        """
        checks.count("GaussSeidel", "sweeps", self.sweeps)

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
    """The same for all sweeps."""
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


def polished(problem: Bounded, multipliers: Array, rounds: int) -> Array:
    """The best of multipliers near to the solution and those of some rounds from there.

    A round is a Newton step on the residual, or a sweep where that does not make it smaller. Where
    this does not suffice, as many rounds go on from the best, with every other sweep carried on;
    where they leave much, as where a contact jams, three times as many begin at zero.

    Args:
        problem: u = G λ + c and bounds.
        multipliers: λ, (n,).
        rounds: how many.
    """
    rounding = 16 * float(jnp.finfo(multipliers.dtype).eps)
    terms = jnp.sum(jnp.abs(problem.matrix * multipliers[None]), axis=1) + jnp.abs(problem.offset)
    # by row: a corner high above the floor has a large u, and says nothing of those that rest
    enough, pivot = rounding * problem.kinds.largest(terms), pivots(problem)

    def going(known: tuple[Any, Array, Array]) -> Array:
        return (known[0] < 5 * rounds) & jnp.any(unmet(known[0], known[2]))

    def unmet(count: Any, best: Array) -> Array:
        much = jnp.where(count < 2 * rounds, 1, MUCH) * enough
        return jnp.any(problem.missed(best) > much, axis=0)

    def once(known: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        count, x, best = known
        x = jnp.where(count == rounds, best, jnp.where(count == 2 * rounds, 0, x))
        inverse = gauss_jordan.inverse(problem.slope(x))
        new = x - gauss_jordan.apply(inverse, problem.residual(x))
        swept = sweep(problem, x, pivot)
        farther = (count >= rounds) & (count < 2 * rounds) & (count % 2 == 1)
        swept = jnp.where(farther, carried(problem, x, swept), swept)
        x = jnp.where((problem.worst(new) < problem.worst(x))[None], new, swept)
        closer = (problem.worst(x) < problem.worst(best)) & unmet(count, best)  # others are done
        return count + 1, x, jnp.where(closer[None], x, best)

    start = jnp.zeros((), jnp.int32), multipliers, multipliers
    return jax.lax.while_loop(going, once, start)[2]


def carried(problem: Bounded, multipliers: Array, swept: Array) -> Array:
    """A sweep's change of λ carried on until the first one-sided row that it unloads bears nothing.

    Where more rows bear than can be met together, as at the four corners of a face, one has to let
    go. Newton's matrix is singular there, and sweeps unload it by little at a time.

    Args:
        problem: u = G λ + c and bounds.
        multipliers: λ, (n,).
        swept: λ after a sweep, (n,).
    """
    kinds, change = problem.kinds, swept - multipliers
    here, rate = kinds.split(multipliers), kinds.split(change)
    lasts = [
        jnp.where((x > 0) & (d < 0), -x / jnp.where(d < 0, d, -1), jnp.inf)
        for x, d in ((here.single, rate.single), (here.normal, rate.normal))
    ]
    first = jnp.maximum(jnp.min(jnp.concatenate(lasts), axis=0, initial=jnp.inf), 1)
    far = kinds.split(multipliers + jnp.where(jnp.isfinite(first), first, 1)[None] * change)
    single, normal = (
        jnp.where(jnp.isfinite(last) & (last <= first[None]), 0, jnp.maximum(x, 0))
        for last, x in zip(lasts, (far.single, far.normal), strict=True)
    )
    sets = zip(kinds.discs, far.discs, strict=True)
    discs = tuple(x * disc.of(normal > 0).astype(normal.dtype) for disc, x in sets)
    box = jnp.clip(far.box, problem.lower, problem.upper)
    return kinds.join(Parts(single, box, normal, discs))


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
