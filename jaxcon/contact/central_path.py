"""The central path of the interior-point method: its products, and a Newton step along it.

On the path, the product of each complementary pair is the target τ. One-sided rows and normals have
one pair, λ u = τ. Boxes have one pair for each bound. A contact has a further pair for each of its
discs, in the second-order cone: (λ_n, y) ∘ (ψ, w) = (τ, 0) with y = λ_t/μ, w = μ u_t and a dual
variable ψ. In components,

    λ_n ψ + y·w = τ,   λ_n w + ψ y = 0.

For τ → 0 the second equation gives w = −ψ y/λ_n: friction opposes slip. During slip, the first
equation then gives ‖λ_t‖ = μ λ_n.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxcon.contact.bounded import Bounded, RowCounts, RowsByLaw
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.linear import gauss_jordan


class PathPoint(NamedTuple):
    """A strictly feasible primal–dual iterate.

    Attributes:
        primal: multipliers λ by law; tangents are divided by their coefficient, λ_t/μ.
        single, normal: velocities u of one-sided rows and of normals.
        below, above: distances of box multipliers from their bounds, separate variables to avoid
            cancellation.
        low, high: dual variables of the two bounds of boxes, u = low − high.
        head, slip: dual cone variables ψ and μ u_t of contacts, by disc.
    """

    primal: RowsByLaw
    below: Array
    above: Array
    single: Array
    low: Array
    high: Array
    normal: Array
    head: tuple[Array, ...]
    slip: tuple[Vector, ...]

    @property
    def dual(self) -> RowsByLaw:
        """The velocities u of all rows, split by law."""
        return RowsByLaw(self.single, self.low - self.high, self.normal, self.slip)


class Target(NamedTuple):
    """The target τ of the complementary products.

    Attributes:
        plain: τ of the pairs of scalars, (1,).
        cone: τ of the cones of each disc, (contacts,).
    """

    plain: Array
    cone: tuple[Array, ...]


class Cone(NamedTuple):
    """The cone variables of a disc: λ_n and y = λ_t/μ, and their duals ψ and w = μ u_t."""

    normal: Array
    tail: Vector
    head: Array
    slip: Vector


def cones(kinds: RowCounts, point: PathPoint) -> list[Cone]:
    """Returns the cone variables of each disc."""
    sets = zip(kinds.discs, point.primal.discs, point.head, point.slip, strict=True)
    normal = point.primal.normal
    return [Cone(disc.of(normal), tail, head, slip) for disc, tail, head, slip in sets]


def normalized(problem: Bounded) -> tuple[Array, Array, Bounded]:
    """Scales G to a unit diagonal and the largest offset to 1; μ becomes part of the scales.

    Returns:
        The factors that restore the multipliers, by row (n,) and by world (1,), and the scaled
        problem.
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


def center(problem: Bounded) -> PathPoint:
    """Returns the start of the central path, where all complementary products are 1."""
    kinds = problem.kinds.split(jnp.ones_like(problem.offset))
    still = tuple(disc.map(jnp.zeros_like) for disc in kinds.discs)
    heads = tuple(disc.of(kinds.normal) for disc in problem.kinds.discs)
    middle = (problem.lower + problem.upper) / 2
    half = (problem.upper - problem.lower) / 2
    away = 1 / half
    primal = RowsByLaw(kinds.single, middle, kinds.normal, still)
    return PathPoint(primal, half, half, kinds.single, away, away, kinds.normal, heads, still)


def products(kinds: RowCounts, point: PathPoint) -> tuple[list[Array], list[Array]]:
    """Returns the complementary products at a point of the path.

    Returns:
        The products of pairs of scalars: of one-sided rows, of the lower and the upper bounds of
        boxes, and of normals. The products λ_n ψ + y·w of the cones, one array for each disc.
    """
    x = point.primal
    numbers = [
        x.single * point.single,
        point.below * point.low,
        point.above * point.high,
        x.normal * point.normal,
    ]
    return numbers, [_product(cone) for cone in cones(kinds, point)]


def _product(cone: Cone) -> Array:
    """Returns the complementary product λ_n ψ + y·w of a cone."""
    along = cone.normal * cone.head
    return along + cone.tail.dot(cone.slip) if len(cone.tail) else along


def unmet(problem: Bounded, point: PathPoint) -> Array:
    """Returns G λ + c − u, (n,), the residual of the velocities at a point of the path."""
    kinds = problem.kinds
    return problem.velocity(kinds.join(point.primal)) - kinds.join(point.dual)


def stiffness(problem: Bounded, point: PathPoint) -> Array:
    """Returns D = −∂u/∂λ, (n, n), where u changes with λ at constant complementary products."""
    kinds, x = problem.kinds, point.primal
    boxes = point.low / point.below + point.high / point.above
    diagonal = jnp.concatenate([point.single / x.single, boxes, point.normal / x.normal])
    blocks = {(0, 0): diagonal}
    sets = zip(kinds.discs, kinds.starts, cones(kinds, point), strict=False)
    for disc, start, cone in sets:
        ones, zeros = jnp.ones_like(cone.normal), jnp.zeros_like(cone.normal)
        places = [start + i * disc.count for i in range(disc.rank)]
        rates = [_slip_rate(cone, zeros, _axis(cone.tail, i)) for i in range(disc.rank)]
        columns = [*zip(places, rates, strict=True)]
        columns.append((kinds.normal + disc.first, _slip_rate(cone, ones, _zero(cone.tail))))
        for column, rate in columns:
            blocks |= {(r, column): -c for r, c in zip(places, rate.components, strict=True)}
    return _assembled(blocks, kinds.size)


def _assembled(blocks: dict[tuple[int, int], Array], n: int) -> Array:
    """Assembles a matrix (n, n) from diagonal blocks.

    Args:
        blocks: the diagonal of each block, by the block's first row and first column.
        n: the number of rows.
    """
    rows = []
    for row in sorted({row for row, _ in blocks}):
        entries = sorted(
            ((c, x) for (r, c), x in blocks.items() if r == row), key=lambda pair: pair[0]
        )
        parts, end = [], 0
        for column, block in entries:
            parts += [_nothing(block, column - end), _on_diagonal(block)]
            end = column + len(block)
        parts.append(_nothing(entries[0][1], n - end))
        rows.append(jnp.concatenate(parts, axis=1))
    return jnp.concatenate(rows)


def _nothing(like: Array, columns: int) -> Array:
    """Returns a zero block (rows, columns, …), with the rows and batch axes of `like`."""
    return jnp.zeros((len(like), columns, *like.shape[1:]), like.dtype)


def complementarity_step(kinds: RowCounts, point: PathPoint, aim: Target) -> RowsByLaw:
    """Returns the change of u, by law, that brings all products to the target at constant λ."""
    x, τ = point.primal, aim.plain
    low, high = point.below, point.above
    box = (τ - low * point.low) / low - (τ - high * point.high) / high
    single = (τ - x.single * point.single) / x.single
    normal = (τ - x.normal * point.normal) / x.normal
    sets = zip(cones(kinds, point), aim.cone, strict=True)
    return RowsByLaw(single, box, normal, tuple(_slip_change(cone, head) for cone, head in sets))


def _slip_change(cone: Cone, head: Array) -> Vector:
    """Returns the change of the slip w = μ u_t that, at constant λ, makes the product (head, 0)."""
    across = cone.slip * cone.normal + cone.tail * cone.head
    left = (head - _product(cone)) / cone.normal
    return _through(cone, -across - cone.tail * left)


def moved(
    kinds: RowCounts, point: PathPoint, wanted: RowsByLaw, change: RowsByLaw, aim: Target
) -> PathPoint:
    """Returns the change of all variables for a change of λ.

    Args:
        kinds: numbers of rows by law.
        point: the current point of the path.
        wanted: change of u at constant λ, from `complementarity_step`.
        change: change of λ.
        aim: target of the products.
    """
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
    return PathPoint(
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
    """Returns the change of the slip w = μ u_t that keeps the cone product, for a change of λ.

    Args:
        cone: the current variables of the cone.
        normal: the change of λ_n.
        tail: the change of λ_t/μ.
    """
    change = cone.slip * normal + tail * cone.head
    head = -(cone.head * normal + cone.slip.dot(tail))
    return _through(cone, -change - cone.tail * (head / cone.normal))


def _through(cone: Cone, right: Vector) -> Vector:
    """Solves (λ_n − y yᵀ/λ_n) x = r for x, where y = λ_t/μ."""
    y, n = cone.tail, cone.normal
    length = numerics.norm(y) if len(y) else n
    inside = (n - length) * (n + length)
    return (right + y * (y.dot(right) / inside)) * (1 / n)


def _on_diagonal(x: Array) -> Array:
    """Returns the diagonal matrix (n, n, …) with the given diagonal."""
    return gauss_jordan.identity(x) * x[:, None]


def _zero(x: Vector) -> Vector:
    """Returns a zero vector with the shape of x."""
    return x.map(jnp.zeros_like)


def _axis(x: Vector, i: int) -> Vector:
    """Returns the i-th unit vector with the shape of x."""
    return Vector(*(jnp.ones_like(c) if j == i else jnp.zeros_like(c) for j, c in enumerate(x)))
