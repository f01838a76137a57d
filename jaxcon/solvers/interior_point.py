"""Bounded rows by a primal-dual interior-point method."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, Kinds
from jaxcon.solvers.central_path import (
    Cone,
    Point,
    Target,
    center,
    complementarity_step,
    cones,
    moved,
    normalized,
    products,
    stiffness,
    unmet,
)
from jaxcon.solvers.polish import polished

NEAREST = 0.99
"""The largest share of the way to the boundary that a step goes."""


@pytree
class InteriorPoint(checks.Checked):
    """Newton's method on the central path, whose products λ u = τ go to zero; to full precision.

    Each contact has two pairs on the path, λ_n u_n = τ, and in the second-order cone
    (λ_n, λ_t/μ) ∘ (ψ, μ u_t) = (τ, 0), in the limit of which friction opposes slip: Coulomb's law
    with Signorini's, not its convex relaxation. An iteration inverts one matrix of the size of the
    bounded rows; 10 to 20 are usual, some fewer in float32, whatever masses are to each other.

    Attributes:
        iterations: how many at most; worlds that have converged wait for the others.
        polish: rounds at the end, at most, of Newton steps on the laws themselves: the boundary of
            a cone is where two numbers agree, so that rounding ends the path before it; then as
            many in which one of several contacts lets go that cannot all bear.
        smoothing: the width of smoothed corners of the laws, for the derivative only [m/s, rad/s].

    References:
        Howell, Le Cleac'h, Kolter, Schwager, Manchester, Dojo: a differentiable physics engine for
            robotics (2022), section IV.
        Nocedal, Wright, Numerical Optimization (2006), section 16.6.
    """

    iterations: int = static(default=30)
    polish: int = static(default=12)
    smoothing: Any = None
    warm = False
    exact = True  # so a landing without restitution is an impact within the step, too

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: there are no iterations, or a number is out of range.
        """
        checks.count("InteriorPoint", "iterations", self.iterations)
        checks.count("InteriorPoint", "polish", self.polish, 0)
        checks.check("InteriorPoint", "smoothing", self.smoothing, (), least=0, optional=True)

    def solve(self, problem: Bounded, start: Array) -> Array:
        """λ, (n,); it does not start from a guess."""
        scale, size, scaled = normalized(problem)

        def going(known: tuple[Any, Point]) -> Array:
            count, point = known
            return (count < self.iterations) & somewhere(unfinished(scaled, point))

        def once(known: tuple[Any, Point]) -> tuple[Any, Point]:
            count, point = known
            on = unfinished(scaled, point)
            new = iterate(scaled, point)
            finite = jnp.all(jnp.isfinite(scaled.kinds.join(new.primal)), axis=0)
            keep = (on & finite)[None]
            return count + 1, jax.tree.map(lambda x, y: jnp.where(keep, x, y), new, point)

        _, point = jax.lax.while_loop(going, once, (jnp.zeros((), jnp.int32), center(scaled)))
        known = scaled.kinds.join(point.primal) * scale * size
        return problem.released(polished(problem, known, self.polish))


def target(problem: Bounded, point: Point, share: Array) -> Target:
    """A share of the mean product, and not less than what rounding lets be reached.

    Of a cone that counts which is beyond its end: others would wait for what goes no further.
    """
    numbers, heads = products(problem.kinds, point)
    plain, ends = least(problem, point)
    beyond = [jnp.maximum(head - end, 0) for head, end in zip(heads, ends, strict=True)]
    aim = share[None] * jnp.mean(jnp.concatenate([*numbers, *beyond]), axis=0)[None]
    return Target(jnp.maximum(aim, plain), tuple(jnp.maximum(aim, end) for end in ends))


def least(problem: Bounded, point: Point) -> tuple[float, list[Array]]:
    """Where the path ends, for numbers and for cones.

    The boundary of a cone is where two numbers agree, so that rounding ends its path much earlier.
    """
    eps = float(jnp.finfo(problem.offset.dtype).eps)
    plain = (10 * eps) ** 2

    def end(cone: Cone) -> Array:
        slip = numerics.norm(cone.slip) if len(cone.slip) else 0.0
        return plain + eps**0.6 * cone.normal * slip

    return plain, [end(cone) for cone in cones(problem.kinds, point)]


def unfinished(problem: Bounded, point: Point) -> Array:
    """Returns True where products or u are not yet near enough to what they should be, by world."""
    eps, (plain, ends) = float(jnp.finfo(problem.offset.dtype).eps), least(problem, point)
    numbers, heads = products(problem.kinds, point)
    off = jnp.max(jnp.abs(unmet(problem, point)), axis=0)
    far = off > eps**0.6
    enough = plain + eps**1.25
    far |= jnp.any(jnp.concatenate(numbers) > 2 * enough, axis=0)
    for head, end in zip(heads, ends, strict=True):
        far |= jnp.any(head > 4 * (end + enough), axis=0)
    return far


def iterate(problem: Bounded, point: Point) -> Point:
    """One step: how far the path can be followed is tried first, and says how far to aim."""
    kinds, dtype = problem.kinds, problem.offset.dtype
    share = float(jnp.finfo(dtype).eps) ** 0.75 * gauss_jordan.identity(problem.offset)
    known = gauss_jordan.inverse(problem.matrix + share + stiffness(problem, point))
    off = unmet(problem, point)

    def toward(aim: Target) -> Point:
        wanted = complementarity_step(kinds, point, aim)
        primal = gauss_jordan.apply(known, kinds.join(wanted) - off)
        return moved(kinds, point, wanted, kinds.split(primal), aim)

    trial = toward(Target(0 * off[:1], tuple(jnp.zeros_like(head) for head in point.head)))
    left = 1 - jnp.minimum(reach(kinds, point, trial), 1)
    step = toward(target(problem, point, jnp.clip(left**2, 1e-3, 0.8)))
    length = jnp.minimum(NEAREST * reach(kinds, point, step), 1)
    return jax.tree.map(lambda x, d: x + length[None] * d, point, step)


def reach(kinds: Kinds, point: Point, step: Point) -> Array:
    """How much of a step stays inside of all bounds, at most 1/NEAREST, by world."""
    x, d = point.primal, step.primal
    pairs = [
        (x.single, d.single),
        (point.single, step.single),
        (point.below, step.below),
        (point.above, step.above),
        (point.low, step.low),
        (point.high, step.high),
        (x.normal, d.normal),
        (point.normal, step.normal),
        *zip(point.head, step.head, strict=True),
    ]
    longest = [jnp.where(dy < 0, -y / jnp.where(dy < 0, dy, -1), jnp.inf) for y, dy in pairs]
    for here, ahead in zip(cones(kinds, point), cones(kinds, step), strict=True):
        longest.append(_reach_of_cone(here.normal, here.tail, ahead.normal, ahead.tail))
        longest.append(_reach_of_cone(here.head, here.slip, ahead.head, ahead.slip))
    return jnp.minimum(jnp.min(jnp.concatenate(longest), axis=0), 1 / NEAREST)


def _reach_of_cone(head: Array, tail: Vector, d_head: Array, d_tail: Vector) -> Array:
    """The smallest positive root of (a + s ȧ)² = ‖y + s ẏ‖²."""
    square = d_head * d_head - d_tail.dot(d_tail)
    mixed = head * d_head - tail.dot(d_tail)
    length = numerics.norm(tail) if len(tail) else 0 * head
    own = (head - length) * (head + length)
    inner = mixed * mixed - square * own
    below = -mixed + jnp.sqrt(jnp.maximum(inner, 0))
    crosses = (inner >= 0) & (below > 0)
    return jnp.where(crosses, own / jnp.where(crosses, below, 1), jnp.inf)
