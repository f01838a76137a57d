"""Bounded rows by projected Gauss–Seidel sweeps."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, onto_disc, slope


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
        return jax.lax.fori_loop(0, self.sweeps, lambda _, x: sweep(problem, x), start)


def sweep(problem: Bounded, multipliers: Array) -> Array:
    """Each row and each contact solved once, with all others held."""
    x = _contacts(problem, _rows(problem, multipliers))
    for i in range(len(problem.kinds.turning)):
        x = _turning(problem, i, x)
    return x


def polished(problem: Bounded, multipliers: Array, rounds: int) -> Array:
    """The best of multipliers near to the solution and those of some rounds from there.

    A round is a Newton step on the residual, or a sweep where that does not make it smaller.

    Args:
        problem: u = G λ + c and bounds.
        multipliers: λ, (n,).
        rounds: how many.
    """
    rounding = 16 * float(jnp.finfo(multipliers.dtype).eps)
    terms = jnp.sum(jnp.abs(problem.matrix * multipliers[None]), axis=1) + jnp.abs(problem.offset)
    enough = rounding * jnp.max(terms, axis=0)

    def going(known: tuple[Any, Array, Array]) -> Array:
        count, _, best = known
        return (count < rounds) & jnp.any(problem.worst(best) > enough)

    def once(known: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        count, x, best = known
        inverse = gauss_jordan.inverse(slope(problem.residual, x))
        new = x - gauss_jordan.apply(inverse, problem.residual(x))
        swept = sweep(problem, x)
        x = jnp.where((problem.worst(new) < problem.worst(x))[None], new, swept)
        best = jnp.where((problem.worst(x) < problem.worst(best))[None], x, best)
        return count + 1, x, best

    start = jnp.zeros((), jnp.int32), multipliers, multipliers
    return jax.lax.while_loop(going, once, start)[2]


def _rows(problem: Bounded, multipliers: Array) -> Array:
    """One-sided rows and boxes, one after the other."""
    kinds, scale = problem.kinds, problem.diagonal()
    if not kinds.normal:
        return multipliers
    free = jnp.zeros((kinds.single, *problem.lower.shape[1:]), multipliers.dtype)
    lower = jnp.concatenate([free, problem.lower])
    upper = jnp.concatenate([free + jnp.inf, problem.upper])

    def one(i: Any, x: Array) -> Array:
        new = x[i] - _velocity(problem, i, x) / scale[i]
        return x.at[i].set(jnp.clip(new, lower[i], upper[i]))

    return jax.lax.fori_loop(0, kinds.normal, one, multipliers)


def _contacts(problem: Bounded, multipliers: Array) -> Array:
    """Contacts, one after the other."""
    kinds = problem.kinds
    if not kinds.contacts:
        return multipliers

    def one(i: Any, x: Array) -> Array:
        n = kinds.normal + i
        rows = [n + (1 + j) * kinds.contacts for j in range(kinds.tangents)]
        stiffness = jnp.maximum(problem.matrix[n, n], _tiny(problem))
        normal = jnp.maximum(x[n] - _velocity(problem, n, x) / stiffness, 0)
        return _disc(problem, rows, problem.friction[i] * normal, x.at[n].set(normal))

    return jax.lax.fori_loop(0, kinds.contacts, one, multipliers)


def _turning(problem: Bounded, which: int, multipliers: Array) -> Array:
    """Resistance to rolling or spinning, contact by contact."""
    kinds = problem.kinds
    disc, start, most = kinds.turning[which], kinds.starts[1 + which], problem.resistance[which]

    def one(i: Any, x: Array) -> Array:
        rows = [start + j * disc.count + i for j in range(disc.rank)]
        return _disc(problem, rows, most[i] * x[kinds.normal + disc.first + i], x)

    return jax.lax.fori_loop(0, disc.count, one, multipliers)


def _disc(problem: Bounded, rows: list[Any], radius: Array, x: Array) -> Array:
    """λ with that of one disc solved, all others held."""
    most = jnp.maximum(_largest(problem, rows), _tiny(problem))
    tangent = Vector(*(x[j] - _velocity(problem, j, x) / most for j in rows))
    for j, y in zip(rows, onto_disc(tangent, radius), strict=True):
        x = x.at[j].set(y)
    return x


def _velocity(problem: Bounded, i: Any, multipliers: Array) -> Array:
    """uᵢ, by world."""
    return jnp.sum(problem.matrix[i] * multipliers, axis=0) + problem.offset[i]


def _largest(problem: Bounded, rows: list[Any]) -> Array:
    """The larger eigenvalue of a block of one or two rows."""
    g = problem.matrix
    if len(rows) == 1:
        return g[rows[0], rows[0]]
    a, b, c = (g[i, j] for i, j in ((rows[0], rows[0]), (rows[0], rows[1]), (rows[1], rows[1])))
    return (a + c) / 2 + jnp.sqrt(((a - c) / 2) ** 2 + b * b)


def _tiny(problem: Bounded) -> Array:
    """Below it a row does not move itself, by world."""
    dtype = problem.matrix.dtype
    return float(jnp.finfo(dtype).tiny) ** 0.5 + 0 * problem.offset[0]
