"""The end of the path of bounded rows: rounds on the laws themselves."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, Parts
from jaxcon.solvers.gauss_seidel import pivots, sweep

MUCH = 1000
"""Times what rounding leaves."""


class Tried(NamedTuple):
    """λ, its residual, and what of it is missed as velocities, (n,) each."""

    multipliers: Array
    residual: Array
    missed: Array

    @property
    def worst(self) -> Array:
        """The largest that is missed, by world."""
        return jnp.max(self.missed, axis=0)


def polished(problem: Bounded, multipliers: Array, rounds: int) -> Array:
    """The best of none, of multipliers near to the solution and of those of some rounds from there.

    A round is a Newton step on the residual, or a sweep where that does not make it smaller. Where
    this does not suffice, as many rounds go on from the best, with every other sweep carried on;
    where they leave much, as where a contact jams, three times as many begin at zero.

    Args:
        problem: u = G λ + c and bounds.
        multipliers: λ, (n,).
        rounds: how many.
    """
    pivot, scale = pivots(problem), problem.diagonal()

    def tried(x: Array) -> Tried:
        residual = problem.residual(x)
        return Tried(x, residual, jnp.abs(residual * scale))

    zero, near = tried(jnp.zeros_like(multipliers)), tried(multipliers)
    start = chosen((near.worst < zero.worst)[None], near, zero)  # not where rounding led it astray
    terms = problem.matrix * start.multipliers[None]
    terms = jnp.sum(jnp.abs(terms), axis=1) + jnp.abs(problem.offset)
    # by row: a corner high above the floor has a large u, and says nothing of those that rest
    # what rounding leaves of a sum of n terms grows like √n
    share = min(max(8.0, 2.3 * len(terms) ** 0.5), 16.0) * float(jnp.finfo(terms.dtype).eps)
    enough = share * problem.kinds.largest(terms)

    def unmet(count: Any, best: Tried) -> Array:
        much = jnp.where(count < 2 * rounds, 1, MUCH) * enough
        return jnp.any(best.missed > much, axis=0)

    def going(known: tuple[Any, Tried, Tried]) -> Array:
        count, _, best = known
        return (count < 5 * rounds) & somewhere(unmet(count, best))

    def once(known: tuple[Any, Tried, Tried]) -> tuple[Any, Tried, Tried]:
        count, here, best = known
        here = chosen(count == rounds, best, chosen(count == 2 * rounds, zero, here))
        x = here.multipliers
        inverse = gauss_jordan.inverse(problem.slope(x, problem.velocity(x)))
        new = tried(here.multipliers - gauss_jordan.apply(inverse, here.residual))
        swept = sweep(problem, here.multipliers, pivot)
        farther = (count >= rounds) & (count < 2 * rounds) & (count % 2 == 1)
        swept = jnp.where(farther, carried(problem, here.multipliers, swept), swept)
        here = chosen((new.worst < here.worst)[None], new, tried(swept))
        closer = (here.worst < best.worst) & unmet(count, best)  # others are done
        return count + 1, here, chosen(closer[None], here, best)

    known = jnp.zeros((), jnp.int32), start, start
    return jax.lax.while_loop(going, once, known)[2].multipliers


def chosen(condition: Array, yes: Tried, no: Tried) -> Tried:
    """One of two."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), yes, no)


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
