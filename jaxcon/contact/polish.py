"""Refines the multipliers of inequality rows by Newton steps and Gauss–Seidel sweeps."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.contact.bounded import Bounded, RowsByLaw
from jaxcon.contact.gauss_seidel import pivots, sweep
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array
from jaxcon.linear import gauss_jordan

MUCH = 1000
"""The residual, in units of the rounding error, above which a solution counts as poor."""


class Tried(NamedTuple):
    """An iterate λ, its residual, and the residual in units of velocity, (n,) each."""

    multipliers: Array
    residual: Array
    missed: Array

    @property
    def worst(self) -> Array:
        """The largest residual in units of velocity, for each world."""
        return jnp.max(self.missed, axis=0)


def polished(problem: Bounded, multipliers: Array, rounds: int) -> Array:
    """Refines multipliers near a solution; returns the best iterate.

    A round is a Newton step on the residual, or a Gauss–Seidel sweep if Newton does not reduce the
    residual. If `rounds` do not suffice, as many further rounds continue from the best iterate, and
    `carried` extrapolates every other sweep. If a large residual remains, for example if a contact
    jams, three times as many rounds start at λ = 0.

    Args:
        problem: the problem u = G λ + c with bounds on λ.
        multipliers: multipliers λ near a solution, (n,).
        rounds: number of rounds.
    """
    pivot, scale = pivots(problem), problem.diagonal()

    def tried(x: Array) -> Tried:
        residual = problem.residual(x)
        return Tried(x, residual, jnp.abs(residual * scale))

    zero, near = tried(jnp.zeros_like(multipliers)), tried(multipliers)
    # start at λ = 0 if its residual is smaller, since rounding may spoil the given λ
    start = chosen((near.worst < zero.worst)[None], near, zero)
    terms = problem.matrix * start.multipliers[None]
    terms = jnp.sum(jnp.abs(terms), axis=1) + jnp.abs(problem.offset)
    # a tolerance by row: a corner high above the floor has a large u, which must not relax the
    # tolerance of corners at rest. The rounding error of a sum of n terms grows like √n
    share = min(max(8.0, 2.3 * len(terms) ** 0.5), 16.0) * float(jnp.finfo(terms.dtype).eps)
    enough = share * problem.kinds.largest(terms)

    def unmet(count: Array, best: Tried) -> Array:
        much = jnp.where(count < 2 * rounds, 1, MUCH) * enough
        return jnp.any(best.missed > much, axis=0)

    def going(carry: tuple[Array, Tried, Tried]) -> Array:
        count, _, best = carry
        return (count < 5 * rounds) & somewhere(unmet(count, best))

    def once(carry: tuple[Array, Tried, Tried]) -> tuple[Array, Tried, Tried]:
        count, here, best = carry
        here = chosen(count == rounds, best, chosen(count == 2 * rounds, zero, here))
        x = here.multipliers
        inverse = gauss_jordan.inverse(problem.slope(x, problem.velocity(x)))
        new = tried(here.multipliers - gauss_jordan.apply(inverse, here.residual))
        swept = sweep(problem, here.multipliers, pivot)
        farther = (count >= rounds) & (count < 2 * rounds) & (count % 2 == 1)
        swept = jnp.where(farther, carried(problem, here.multipliers, swept), swept)
        here = chosen((new.worst < here.worst)[None], new, tried(swept))
        closer = (here.worst < best.worst) & unmet(count, best)  # finished worlds do not change
        return count + 1, here, chosen(closer[None], here, best)

    first = jnp.zeros((), jnp.int32), start, start
    return jax.lax.while_loop(going, once, first)[2].multipliers


def chosen(condition: Array, yes: Tried, no: Tried) -> Tried:
    """Returns the iterate `yes` where the condition is True, else `no`."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), yes, no)


def carried(problem: Bounded, multipliers: Array, swept: Array) -> Array:
    """Extrapolates the change of λ by a sweep until the first one-sided row is unloaded.

    If more rows carry load than are linearly independent, as at the four corners of a face, one of
    them must release. Newton's matrix is then singular, and plain sweeps unload the row slowly.

    Args:
        problem: the problem u = G λ + c with bounds on λ.
        multipliers: multipliers λ before the sweep, (n,).
        swept: multipliers λ after the sweep, (n,).
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
    return kinds.join(RowsByLaw(single, box, normal, discs))
