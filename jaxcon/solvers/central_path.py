"""The central path of bounded rows: what products it keeps, and the Newton step along it.

One-sided rows and normals have one pair, λ u = τ, boxes one for each bound, and a contact has, for
each of its discs, one more in the cone, (λ_n, y) ∘ (ψ, w) = (τ, 0) with y = λ_t/μ and w = μ u_t:

    λ_n ψ + y·w = τ,   λ_n w + ψ y = 0.

For τ → 0 the latter says w = −ψ y/λ_n: friction opposes slip, and is at its bound where there is
some.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, Kinds, Parts


class Point(NamedTuple):
    """Multipliers and what stands against them, inside of all bounds.

    Attributes:
        primal: λ by law, tangents as λ_t/μ.
        single, normal: u of one-sided rows and normals.
        below, above: of boxes, how far λ lies from its bounds, for rounding not taken from λ.
        low, high: of boxes, by which u = low − high.
        head, slip: (ψ, μ u_t) of contacts, by disc.
    """

    primal: Parts
    below: Array
    above: Array
    single: Array
    low: Array
    high: Array
    normal: Array
    head: tuple[Array, ...]
    slip: tuple[Vector, ...]

    @property
    def dual(self) -> Parts:
        """u by law."""
        return Parts(self.single, self.low - self.high, self.normal, self.slip)


class Target(NamedTuple):
    """τ of the pairs of numbers, (1,), and by disc of each cone, (contacts,)."""

    plain: Array
    cone: tuple[Array, ...]


class Cone(NamedTuple):
    """One disc of contacts on the path: λ_n, y = λ_t/μ, ψ and w = μ u_t."""

    normal: Array
    tail: Vector
    head: Array
    slip: Vector


def cones(kinds: Kinds, point: Point) -> list[Cone]:
    """By disc."""
    sets = zip(kinds.discs, point.primal.discs, point.head, point.slip, strict=True)
    normal = point.primal.normal
    return [Cone(disc.of(normal), tail, head, slip) for disc, tail, head, slip in sets]


def normalized(problem: Bounded) -> tuple[Array, Array, Bounded]:
    """λ of 1 makes u of 1 in each row, and the largest offset is 1; friction is in the rows.

    Returns:
        What the scaled multipliers are to be multiplied by, by row (n,) and by world (1,), and the
        scaled problem.
    """
    kinds = problem.kinds
    unit = 1 / jnp.sqrt(problem.diagonal())
    parts = kinds.split(unit)
    sets = zip(kinds.discs, problem.coefficients, parts.discs, strict=True)
    tails = tuple(Vector(*(disc.of(parts.normal) * μ for _ in x)) for disc, μ, x in sets)
    scale = kinds.join(parts._replace(discs=tails))
    offset = problem.offset * scale
    size = jnp.max(jnp.abs(offset), axis=0)[None]
    size = jnp.where(size > 0, size, 1)
    tiny = float(jnp.finfo(offset.dtype).eps)
    lower, upper = (x / (parts.box * size) for x in (problem.lower, problem.upper))
    middle, half = (lower + upper) / 2, jnp.maximum((upper - lower) / 2, tiny)
    matrix = problem.matrix * scale[:, None] * scale[None]
    bounds = middle - half, middle + half, problem.friction, kinds, problem.resistance
    return scale, size, Bounded(matrix, offset / size, *bounds)


def center(problem: Bounded) -> Point:
    """Where the path is entered: all pairs 1."""
    kinds = problem.kinds.split(jnp.ones_like(problem.offset))
    still = tuple(disc.map(jnp.zeros_like) for disc in kinds.discs)
    heads = tuple(disc.of(kinds.normal) for disc in problem.kinds.discs)
    middle = (problem.lower + problem.upper) / 2
    half = (problem.upper - problem.lower) / 2
    away = 1 / half
    primal = Parts(kinds.single, middle, kinds.normal, still)
    return Point(primal, half, half, kinds.single, away, away, kinds.normal, heads, still)


def products(kinds: Kinds, point: Point) -> tuple[list[Array], list[Array]]:
    """λ u of each pair of numbers, and of cones by disc."""
    x = point.primal
    numbers = [
        x.single * point.single,
        point.below * point.low,
        point.above * point.high,
        x.normal * point.normal,
    ]
    return numbers, [_product(cone) for cone in cones(kinds, point)]


def _product(cone: Cone) -> Array:
    along = cone.normal * cone.head
    return along + cone.tail.dot(cone.slip) if len(cone.tail) else along


def unmet(problem: Bounded, point: Point) -> Array:
    """G λ + c − u, (n,)."""
    kinds = problem.kinds
    return problem.velocity(kinds.join(point.primal)) - kinds.join(point.dual)


def stiffness(problem: Bounded, point: Point) -> Array:
    """D = −∂u/∂λ along which products stay, (n, n)."""
    kinds, x = problem.kinds, point.primal
    boxes = point.low / point.below + point.high / point.above
    own = jnp.concatenate([point.single / x.single, boxes, point.normal / x.normal])
    blocks = {(0, 0): own}
    sets = zip(kinds.discs, kinds.starts, cones(kinds, point), strict=False)
    for disc, start, cone in sets:
        one, none = jnp.ones_like(cone.normal), jnp.zeros_like(cone.normal)
        places = [start + i * disc.count for i in range(disc.rank)]
        rates = [_slip_rate(cone, none, _axis(cone.tail, i)) for i in range(disc.rank)]
        columns = [*zip(places, rates, strict=True)]
        columns.append((kinds.normal + disc.first, _slip_rate(cone, one, _zero(cone.tail))))
        for column, rate in columns:
            blocks |= {(r, column): -c for r, c in zip(places, rate.components, strict=True)}
    return _assembled(blocks, kinds.size)


def _assembled(blocks: dict[tuple[int, int], Array], n: int) -> Array:
    """The matrix (n, n) of diagonal blocks by their first row and column, zero elsewhere."""
    rows = []
    for row in sorted({row for row, _ in blocks}):
        known = sorted(
            ((c, x) for (r, c), x in blocks.items() if r == row), key=lambda pair: pair[0]
        )
        parts, end = [], 0
        for column, block in known:
            parts += [_nothing(block, column - end), _on_diagonal(block)]
            end = column + len(block)
        parts.append(_nothing(known[0][1], n - end))
        rows.append(jnp.concatenate(parts, axis=1))
    return jnp.concatenate(rows)


def _nothing(like: Array, columns: int) -> Array:
    """Zeros (n, columns, …) beside a diagonal block of n rows."""
    return jnp.zeros((len(like), columns, *like.shape[1:]), like.dtype)


def complementarity_step(kinds: Kinds, point: Point, aim: Target) -> Parts:
    """The change of u, with λ held, that brings all products to the target, by law."""
    x, τ = point.primal, aim.plain
    low, high = point.below, point.above
    box = (τ - low * point.low) / low - (τ - high * point.high) / high
    single = (τ - x.single * point.single) / x.single
    normal = (τ - x.normal * point.normal) / x.normal
    sets = zip(cones(kinds, point), aim.cone, strict=True)
    return Parts(single, box, normal, tuple(_slip_change(cone, head) for cone, head in sets))


def _slip_change(cone: Cone, head: Array) -> Vector:
    """The change of the slip that brings its product to (head, 0)."""
    across = cone.slip * cone.normal + cone.tail * cone.head
    left = (head - _product(cone)) / cone.normal
    return _through(cone, -across - cone.tail * left)


def moved(kinds: Kinds, point: Point, wanted: Parts, change: Parts, aim: Target) -> Point:
    """The step of all parts that goes with a change of λ, `wanted` being the change of u."""
    x, τ = point.primal, aim.plain
    low, high = point.below, point.above
    heads, slips = [], []
    sets = (cones(kinds, point), kinds.discs, wanted.discs, change.discs, aim.cone)
    for cone, disc, ask, tail, head in zip(*sets, strict=True):
        normal = disc.of(change.normal)
        slip = ask + _slip_rate(cone, normal, tail)
        turned = cone.head * normal + cone.tail.dot(slip) + cone.slip.dot(tail)
        heads.append((head - _product(cone) - turned) / cone.normal)
        slips.append(slip)
    return Point(
        change,
        change.box,
        -change.box,
        wanted.single - point.single / x.single * change.single,
        (τ - low * point.low - point.low * change.box) / low,
        (τ - high * point.high + point.high * change.box) / high,
        wanted.normal - point.normal / x.normal * change.normal,
        tuple(heads),
        tuple(slips),
    )


def _slip_rate(cone: Cone, normal: Array, tail: Vector) -> Vector:
    """What becomes of the slip when (λ_n, λ_t/μ) changes so, and its product with (ψ, slip) not."""
    change = cone.slip * normal + tail * cone.head
    head = -(cone.head * normal + cone.slip.dot(tail))
    return _through(cone, -change - cone.tail * (head / cone.normal))


def _through(cone: Cone, right: Vector) -> Vector:
    """(λ_n − y yᵀ/λ_n)⁻¹ r, y = λ_t/μ."""
    y, n = cone.tail, cone.normal
    length = numerics.norm(y) if len(y) else n
    inside = (n - length) * (n + length)
    return (right + y * (y.dot(right) / inside)) * (1 / n)


def _on_diagonal(x: Array) -> Array:
    """The diagonal matrix (n, n, …)."""
    return gauss_jordan.identity(x) * x[:, None]


def _zero(x: Vector) -> Vector:
    return x.map(jnp.zeros_like)


def _axis(x: Vector, i: int) -> Vector:
    return Vector(*(jnp.ones_like(c) if j == i else jnp.zeros_like(c) for j, c in enumerate(x)))
