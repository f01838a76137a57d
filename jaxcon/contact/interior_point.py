"""Solves inequality rows by a primal–dual interior-point method."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.contact.bounded import Bounded, RowCounts
from jaxcon.contact.central_path import (
    Cone,
    PathPoint,
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
from jaxcon.contact.polish import polished
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array
from jaxcon.linear import gauss_jordan
from jaxcon.protocols import ContactSolver

NEAREST = 0.99
"""The largest fraction of the distance to the boundary of the cone that a step covers."""


@pytree
class InteriorPoint(checks.Checked, ContactSolver):
    """A primal–dual interior-point method that solves the laws of contact to full precision.

    Newton steps follow the central path, on which the products λ u = τ decrease to zero. Each
    contact has two pairs: λ_n u_n = τ, and in the second-order cone (λ_n, λ_t/μ) ∘ (ψ, μ u_t) = (τ,
    0). In the limit, friction opposes slip: the laws are those of Signorini and Coulomb, not a
    convex relaxation. An iteration inverts one n×n matrix for n inequality rows. 10 to 20
    iterations are usual for any mass ratio, somewhat fewer in float32.

    Attributes:
        iterations: largest number of iterations; converged worlds of a batch wait for the others.
        polish: largest number of final Newton steps on the laws themselves. They are needed since
            rounding ends the path early: near the boundary of a cone two numbers nearly cancel. If
            these steps do not suffice, as many further rounds unload redundant contacts, such as
            one of the four corners of a face.
        smoothing: width of the smoothed corners of the laws, for the derivative only [m/s, rad/s].
        regularization: the least compliance of a row, see `Newton`; None for exact laws.

    References:
        Howell, Le Cleac'h, Kolter, Schwager, Manchester, Dojo: a differentiable physics engine for
            robotics (2022), section IV.
        Nocedal, Wright, Numerical Optimization (2006), section 16.6.
    """

    iterations: int = static(default=30)
    polish: int = static(default=12)
    smoothing: Any = None
    regularization: Any = None
    warm = False  # type: ignore[assignment]
    # so a landing without restitution is resolved as an impact within the step
    exact = True  # type: ignore[assignment]

    def check(self) -> None:
        """Checks the numbers of iterations, and the smoothing.

        Raises:
            ValueError: a number is out of range.
        """
        checks.count("InteriorPoint", "iterations", self.iterations)
        checks.count("InteriorPoint", "polish", self.polish, 0)
        checks.check("InteriorPoint", "smoothing", self.smoothing, (), least=0, optional=True)
        checks.check(
            "InteriorPoint", "regularization", self.regularization, (), least=0, optional=True
        )

    def solve(self, problem: Bounded, start: Array) -> Array:
        """Returns the multipliers λ, (n,); `start` is not used."""
        scale, size, scaled = normalized(problem)

        def going(carry: tuple[Array, PathPoint]) -> Array:
            count, point = carry
            return (count < self.iterations) & somewhere(unfinished(scaled, point))

        def once(carry: tuple[Array, PathPoint]) -> tuple[Array, PathPoint]:
            count, point = carry
            on = unfinished(scaled, point)
            new = iterate(scaled, point)
            finite = jnp.all(jnp.isfinite(scaled.kinds.join(new.primal)), axis=0)
            keep = (on & finite)[None]
            return count + 1, jax.tree.map(lambda x, y: jnp.where(keep, x, y), new, point)

        _, point = jax.lax.while_loop(going, once, (jnp.zeros((), jnp.int32), center(scaled)))
        multipliers = scaled.kinds.join(point.primal) * scale * size
        return problem.released(polished(problem, multipliers, self.polish))


def target(problem: Bounded, point: PathPoint, share: Array) -> Target:
    """Returns a fraction of the mean product as the target, bounded below by `least`.

    The mean includes only the excess of each cone's product over its lower bound. Otherwise, cones
    would slow down the other pairs.
    """
    numbers, heads = products(problem.kinds, point)
    plain, ends = least(problem, point)
    beyond = [jnp.maximum(head - end, 0) for head, end in zip(heads, ends, strict=True)]
    aim = share[None] * jnp.mean(jnp.concatenate([*numbers, *beyond]), axis=0)[None]
    return Target(jnp.maximum(aim, plain), tuple(jnp.maximum(aim, end) for end in ends))


def least(problem: Bounded, point: PathPoint) -> tuple[float, list[Array]]:
    """Returns the smallest products that rounding allows: of pairs of scalars, and of each cone.

    Near the boundary of a cone two numbers nearly cancel, so the smallest product of a cone is much
    larger.
    """
    eps = float(jnp.finfo(problem.offset.dtype).eps)
    plain = (10 * eps) ** 2

    def end(cone: Cone) -> Array:
        slip = numerics.norm(cone.slip) if len(cone.slip) else 0.0
        return plain + eps**0.6 * cone.normal * slip

    return plain, [end(cone) for cone in cones(problem.kinds, point)]


def unfinished(problem: Bounded, point: PathPoint) -> Array:
    """Returns True for each world in which products or the residual of u have not converged."""
    eps, (plain, ends) = float(jnp.finfo(problem.offset.dtype).eps), least(problem, point)
    numbers, heads = products(problem.kinds, point)
    off = jnp.max(jnp.abs(unmet(problem, point)), axis=0)
    far = off > eps**0.6
    enough = plain + eps**1.25
    far |= jnp.any(jnp.concatenate(numbers) > 2 * enough, axis=0)
    for head, end in zip(heads, ends, strict=True):
        far |= jnp.any(head > 4 * (end + enough), axis=0)
    return far


def iterate(problem: Bounded, point: PathPoint) -> PathPoint:
    """Makes one predictor–corrector step; the predictor's step length sets the target."""
    kinds, dtype = problem.kinds, problem.offset.dtype
    share = float(jnp.finfo(dtype).eps) ** 0.75 * gauss_jordan.identity(problem.offset)
    inverse = gauss_jordan.inverse(problem.matrix + share + stiffness(problem, point))
    off = unmet(problem, point)

    def toward(aim: Target) -> PathPoint:
        wanted = complementarity_step(kinds, point, aim)
        primal = gauss_jordan.apply(inverse, kinds.join(wanted) - off)
        return moved(kinds, point, wanted, kinds.split(primal), aim)

    trial = toward(Target(0 * off[:1], tuple(jnp.zeros_like(head) for head in point.head)))
    left = 1 - jnp.minimum(reach(kinds, point, trial), 1)
    step = toward(target(problem, point, jnp.clip(left**2, 1e-3, 0.8)))
    length = jnp.minimum(NEAREST * reach(kinds, point, step), 1)
    return jax.tree.map(lambda x, d: x + length[None] * d, point, step)


def reach(kinds: RowCounts, point: PathPoint, step: PathPoint) -> Array:
    """Returns the fraction of a step at which it reaches the boundary, for each world.

    Beyond the boundary, a variable is negative or outside of its cone. The result is at most
    1/NEAREST.
    """
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
    """Returns the smallest s > 0 for which (a, y) + s (ȧ, ẏ) is on the boundary of the cone.

    The boundary is (a + s ȧ)² = ‖y + s ẏ‖²; a is `head` and y is `tail`.
    """
    square = d_head * d_head - d_tail.dot(d_tail)
    mixed = head * d_head - tail.dot(d_tail)
    length = numerics.norm(tail) if len(tail) else 0 * head
    margin = (head - length) * (head + length)
    inner = mixed * mixed - square * margin
    below = -mixed + jnp.sqrt(jnp.maximum(inner, 0))
    crosses = (inner >= 0) & (below > 0)
    return jnp.where(crosses, margin / jnp.where(crosses, below, 1), jnp.inf)
