"""Inequality rows and their laws: complementarity, boxes and friction cones.

After the equality rows are eliminated, a step is a problem for the multipliers λ and the velocities
u of the inequality rows. u is at the end of the step, and relative to the target velocities. G is
∂u/∂λ, and c is u for λ = 0:

    u = G λ + c,   each row or contact obeying its law:

    one-sided   λ ≥ 0,  u ≥ 0,  λ u = 0
    box         lo ≤ λ ≤ hi,  λ = lo where u > 0,  λ = hi where u < 0
    contact     one-sided for the normal, and for the tangents ‖λ_t‖ ≤ μ λ_n,
                λ_t = −μ λ_n u_t/‖u_t‖ where ‖u_t‖ > 0: Signorini and Coulomb.

Rolling and spinning resistance obey the law of the tangents, with a length for μ, a moment for λ_t,
and a relative angular velocity for u_t. A set of rows with ‖λ_t‖ ≤ μ λ_n is a `FrictionDisc`. One
disc has the tangents of all contacts; rolling and spinning resistance have a disc each, for some of
the contacts.

Rows are in this order: one-sided rows, boxes, normals, then the rows of each disc, component by
component.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear import gauss_jordan, roots


@dataclass(frozen=True)
class FrictionDisc:
    """The friction, rolling or spinning rows of consecutive contacts, with the law ‖λ_t‖ ≤ μ λ_n.

    Attributes:
        first, count: the index of the first contact, and the number of contacts.
        rank: number of rows of each contact.
    """

    first: int
    count: int
    rank: int

    def of(self, normal: Array) -> Array:
        """Selects the entries of this disc's contacts from an array for all contacts."""
        return normal[self.first : self.first + self.count] if self.count < len(normal) else normal


@dataclass(frozen=True)
class RowCounts:
    """The number of inequality rows of each law; these numbers determine the order of the rows.

    Attributes:
        single, boxes, contacts: the numbers of one-sided rows, boxes, and contacts.
        tangents: the number of tangents of a contact, 1 in the plane, 2 in space.
        turning: discs of rolling and spinning resistance.
    """

    single: int = 0
    boxes: int = 0
    contacts: int = 0
    tangents: int = 0
    turning: tuple[FrictionDisc, ...] = ()

    @property
    def discs(self) -> tuple[FrictionDisc, ...]:
        """All discs: friction first, then rolling and spinning resistance."""
        return (FrictionDisc(0, self.contacts, self.tangents), *self.turning)

    @property
    def starts(self) -> tuple[int, ...]:
        """The index of the first row of each disc; the last entry is the number of all rows."""
        sizes = [disc.count * disc.rank for disc in self.discs]
        return tuple(itertools.accumulate(sizes, initial=self.normal + self.contacts))

    @property
    def size(self) -> int:
        """The number of all inequality rows."""
        return self.starts[-1]

    @property
    def normal(self) -> int:
        """The index of the first normal row."""
        return self.single + self.boxes

    @property
    def one_sided(self) -> np.ndarray:
        """A mask of the one-sided rows and of the normals of contacts, (n,)."""
        rows = np.arange(self.size)
        return (rows < self.single) | (rows >= self.normal) & (rows < self.normal + self.contacts)

    def split(self, x: Array) -> RowsByLaw:
        """Splits an array (n, …) by the law of its rows."""
        box, normal = x[self.single : self.normal], x[self.normal : self.starts[0]]
        discs = []
        for disc, start in zip(self.discs, self.starts, strict=False):
            places = (start + i * disc.count for i in range(disc.rank))
            discs.append(Vector(*(x[i : i + disc.count] for i in places)))
        return RowsByLaw(x[: self.single], box, normal, tuple(discs))

    def join(self, parts: RowsByLaw) -> Array:
        """Joins the parts of an array to the whole, (n, …); the inverse of `split`."""
        rows = itertools.chain(*parts.discs)
        return jnp.concatenate([parts.single, parts.box, parts.normal, *rows])

    def under_normals(self, flags: RowsByLaw) -> Array:
        """Joins flags by law, (n,); a disc row is False, too, if its contact's normal is False."""
        sets = zip(self.discs, flags.discs, strict=True)
        discs = tuple(Vector(*(y & disc.of(flags.normal) for y in x)) for disc, x in sets)
        return self.join(flags._replace(discs=discs))

    def by_contact(self, x: Array) -> Array:
        """Replaces the entries of disc rows, (n, …), by the entries of their contacts' normals."""
        parts = self.split(x)
        sets = zip(self.discs, parts.discs, strict=True)
        discs = tuple(y.map(lambda _, d=disc: d.of(parts.normal)) for disc, y in sets)
        return self.join(parts._replace(discs=discs))

    def largest(self, x: Array) -> Array:
        """Returns, for each row (n, …), the maximum over its group of rows.

        A group is a normal with its tangents, the rolling or spinning rows of a contact, or a
        single row.
        """
        parts = self.split(x)
        slip, *turning = parts.discs
        most = functools.reduce(jnp.maximum, slip, parts.normal)
        discs = [slip.map(lambda _: most)]
        for disc in turning:
            largest = functools.reduce(jnp.maximum, disc)
            discs.append(disc.map(lambda _, x=largest: x))
        return self.join(parts._replace(normal=most, discs=tuple(discs)))


class RowsByLaw(NamedTuple):
    """An array over rows, split by law: (single,), (boxes,), (contacts,), and a Vector per disc."""

    single: Array
    box: Array
    normal: Array
    discs: tuple[Vector, ...]


@pytree
class Bounded:
    """The problem of the inequality rows: the velocities u = G λ + c and the bounds of λ.

    Attributes:
        matrix: the matrix G, (n, n), symmetric and positive semidefinite; zero rows are allowed.
        offset: velocities c for λ = 0, minus their targets, (n,).
        lower, upper: bounds on λ of the boxes, (boxes,).
        friction: coefficient of friction μ, (contacts,).
        kinds: numbers of rows by law.
        resistance: for each disc of `kinds.turning`, the length in place of μ, (contacts of the
            disc,) [m].
    """

    matrix: Array
    offset: Array
    lower: Array
    upper: Array
    friction: Array
    kinds: RowCounts = static()
    resistance: tuple[Array, ...] = ()

    @property
    def coefficients(self) -> tuple[Array, ...]:
        """For each disc, the coefficient μ of ‖λ_t‖ ≤ μ λ_n."""
        return (self.friction, *self.resistance)

    def velocity(self, multipliers: Array) -> Array:
        """Returns the velocities u = G λ + c, (n,).

        Args:
            multipliers: multipliers λ, (n,).
        """
        return jnp.sum(self.matrix * multipliers[None], axis=1) + self.offset

    def residual(self, multipliers: Array) -> Array:
        """Returns λ − P(λ − u/g), (n,), which is zero if and only if all laws hold; see `laws`.

        Args:
            multipliers: multipliers λ, (n,).
        """
        live = (self.lower, self.upper, self.coefficients)
        return laws(self.kinds, self.diagonal(), multipliers, self.velocity(multipliers), live)

    def slope(self, multipliers: Array, velocity: Array, width: Array | None = None) -> Array:
        """Returns the slightly regularized Jacobian ∂(residual)/∂λ, (n, n).

        Args:
            multipliers: multipliers λ, (n,).
            velocity: velocities G λ + c, (n,).
            width: width of the smoothed corners of the laws, (1,) [m/s, rad/s]; None for sharp
                corners.
        """
        live = (self.lower, self.upper, self.coefficients)
        return law_slope(
            self.kinds, self.diagonal(), multipliers, velocity, live, width, self.matrix
        )

    def missed(self, multipliers: Array) -> Array:
        """Returns |residual| in units of velocity, (n,)."""
        return jnp.abs(self.residual(multipliers) * self.diagonal())

    def worst(self, multipliers: Array) -> Array:
        """Returns the largest residual in units of velocity, for each world."""
        return jnp.max(self.missed(multipliers), axis=0)

    def released(self, multipliers: Array) -> Array:
        """Returns λ with zeros for opening contacts, and without negative normal forces.

        A solver leaves small multipliers at opening contacts. However small, they would make such a
        contact stick in the derivative.
        """
        ahead = multipliers - self.velocity(multipliers) / self.diagonal()
        here = self.kinds.split(multipliers)
        bears = (self.kinds.split(ahead).normal > 0) & (here.normal > 0)
        sets = zip(self.kinds.discs, here.discs, strict=True)
        discs = tuple(x * disc.of(bears).astype(ahead.dtype) for disc, x in sets)
        single, normal = jnp.maximum(here.single, 0), jnp.where(bears, here.normal, 0)
        return self.kinds.join(here._replace(single=single, normal=normal, discs=discs))

    def diagonal(self) -> Array:
        """Returns g, (n,), the change of a row's velocity by a unit of its own multiplier.

        The normal and the tangents of a contact share a value. Its rolling rows, whose unit is
        different, share a second value, and its spinning rows a third.
        """
        diagonal = gauss_jordan.diagonal(self.matrix)
        joint = self.kinds.largest(diagonal)
        largest = jnp.max(diagonal, axis=0)[None]
        moves = joint > float(jnp.finfo(diagonal.dtype).eps) ** 2 * largest
        return jnp.where(moves, joint, jnp.where(largest > 0, largest, 1))


SLIP = 0.04
"""The factor of `ContactSolver.regularization` for rows that hold by friction or by a motor.

Without it, contacts that stick would creep by half a mm/s at 2 ms under their own weight.
"""


def regularized(compliance: Array, kinds: RowCounts, scale: Array, share: Scalar | None) -> Array:
    """Raises the compliance C of each row to at least ρ g, or `SLIP` ρ g; returns it, (n,).

    The laws then hold for u + C λ in place of u. A normal row presses where u < 0, and friction
    below its bound is viscous. The forces of redundant contacts become unique.

    Args:
        compliance: C of the rows themselves, (n,).
        kinds: numbers of rows by law.
        scale: g, (n,), the change of each row's velocity by a unit of its own multiplier. The rows
            of a disc share their largest g, so that friction opposes slip.
        share: ρ; None for no regularization.

    References:
        Castro, Permenter, Han, An Unconstrained Convex Formulation of Compliant Contact, IEEE
            Trans. Robotics (2022), section V.B, for ρ = 1/(4 π²) as nearly rigid.
    """
    if share is None:
        return compliance
    least = kinds.split(jnp.asarray(share, scale.dtype)[None] * scale)
    discs = []
    for disc in least.discs:
        largest = functools.reduce(jnp.maximum, disc) if len(disc) else least.normal
        discs.append(disc.map(lambda _, x=largest: SLIP * x))
    whole = kinds.join(least._replace(box=SLIP * least.box, discs=tuple(discs)))
    return jnp.where(whole >= compliance, whole, compliance)


Limits = tuple[Array, Array, tuple[Array, ...]]
"""Bounds of the boxes, lower and upper, and for each disc the coefficient μ."""


def laws(
    kinds: RowCounts,
    scale: Array,
    multipliers: Array,
    velocity: Array,
    live: Limits,
    width: Array | None = None,
) -> Array:
    """Returns the residual λ − P(λ − u/g), (n,), where P projects onto the bounds of λ.

    Args:
        kinds: numbers of rows by law. The bounds of disc rows are μ λ_n.
        scale: scale g of the velocities, (n,); see `Bounded.diagonal`.
        multipliers: multipliers λ, (n,).
        velocity: velocities minus their targets, u − u*, (n,).
        live: bounds of the boxes, and the coefficient μ of each disc; see `Limits`.
        width: width of the smoothed corners of P, (1,) [m/s, rad/s]; None for sharp corners.
    """
    lower, upper, coefficients = live
    here, forward = kinds.split(multipliers), kinds.split(multipliers - velocity / scale)
    corner = kinds.split(0 * scale if width is None else width / scale)
    positive = _Positive(width is not None)
    box = forward.box + positive(lower - forward.box, corner.box)
    box = box - positive(box - upper, corner.box)
    normal = positive(forward.normal, corner.normal)
    pressed = jnp.maximum(here.normal, 0)
    sets = zip(kinds.discs, coefficients, forward.discs, corner.discs, strict=True)
    discs = tuple(
        onto_disc(x, μ * disc.of(pressed), c[0] if len(c) else 0.0, positive)
        for disc, μ, x, c in sets
    )
    single = positive(forward.single, corner.single)
    return multipliers - kinds.join(RowsByLaw(single, box, normal, discs))


@dataclass(frozen=True)
class _Positive:
    """Evaluates max(x, 0), or its smooth approximation ½ (x + √(x² + 4 c²)) with corner width c."""

    smooth: bool = False

    def __call__(self, x: Array, corner: Array | float) -> Array:
        if not self.smooth:
            return jnp.maximum(x, 0)
        return (x + numerics.safe_sqrt(x * x + 4 * corner * corner)) / 2


def onto_disc(
    x: Vector, radius: Array, corner: Array | float = 0.0, positive: _Positive = _Positive()
) -> Vector:
    """Projects a vector onto the disc of the given radius."""
    if not len(x):
        return x
    length = numerics.norm(x)
    return x * numerics.safe_divide(radius, radius + positive(length - radius, corner))


Inverses = tuple[roots.Operator, roots.Operator]
"""Approximate inverses of a matrix and of its transpose."""


def implicit_multipliers(
    problem: Bounded,
    multipliers: Array,
    velocity: Callable[[Array], Array],
    live: Limits,
    width: Scalar | None,
) -> Array:
    """Returns the solution λ of a problem, made differentiable; see `implicit_solution`."""
    here, kinds, scale = problem.velocity(multipliers), problem.kinds, problem.diagonal()

    def inverses(bounds: Limits, corner: Array | None, u: Array) -> Inverses:
        slope = law_slope(kinds, scale, multipliers, u, bounds, corner, problem.matrix)
        inverse = gauss_jordan.inverse(slope)
        return partial(gauss_jordan.apply, inverse), partial(
            gauss_jordan.apply, jnp.swapaxes(inverse, 0, 1)
        )

    return implicit_solution(kinds, scale, multipliers, here, velocity, live, width, inverses)


def implicit_solution(
    kinds: RowCounts,
    scale: Array,
    multipliers: Array,
    here: Array | None,
    velocity: Callable[[Array], Array],
    live: Limits,
    width: Scalar | None,
    inverses: Callable[[Limits, Array | None, Array], Inverses],
) -> Array:
    """Returns the solution λ, made differentiable by implicit differentiation of the laws.

    Args:
        kinds: numbers of rows by law.
        scale: scale g of the velocities, (n,); see `Bounded.diagonal`.
        multipliers: solution λ, (n,).
        here: velocities u − u* of the solution, (n,), a constant; None to evaluate `velocity`.
        velocity: function of λ that returns u − u*, differentiable in its closed-over values.
        live: bounds of the boxes, and the coefficient μ of each disc, differentiable.
        width: width of the smoothed corners of the laws [m/s, rad/s]; None for sharp corners.
        inverses: function that returns approximate inverses of the derivative of the laws by λ, and
            of its transpose, from constants: `live`, the width (1,), and u − u* of the solution. It
            is called only if a derivative is taken.
    """
    corner = None if width is None else jnp.asarray(width, scale.dtype)[None]

    def law(x: Array) -> Array:
        # treat these as constants; stop their gradients inside this function, see `roots.implicit`
        fixed, smooth, there = jax.lax.stop_gradient((scale, corner, here))
        # use the value of u from which `prepared` computes the matrix: at the corner of a law,
        # rounding decides if a contact presses or opens, and residual and matrix must agree
        u = velocity(x)
        u = u if there is None else there + (u - jax.lax.stop_gradient(u))
        return laws(kinds, fixed, x, u, live, smooth)

    def prepared() -> Inverses:
        bounds = jax.lax.stop_gradient(live)
        there = jax.lax.stop_gradient(velocity(multipliers)) if here is None else here
        return inverses(bounds, jax.lax.stop_gradient(corner), there)

    def iterate(_: roots.Operator, x: Array) -> tuple[Array, None]:
        return x, None

    return roots.implicit(law, multipliers, iterate, ROUNDS, prepared=prepared)[0]


def law_slope(
    kinds: RowCounts,
    scale: Array,
    multipliers: Array,
    velocity: Array,
    live: Limits,
    width: Array | None,
    matrix: Array,
) -> Array:
    """Returns the slightly regularized Jacobian of `laws` by λ, (n, n), with u = G λ + c."""
    share = float(jnp.finfo(multipliers.dtype).eps) ** 0.75
    identity = gauss_jordan.identity(multipliers)

    def law(x: Array, u: Array) -> Array:
        return laws(kinds, scale, x, u, live, width)

    # a law depends only on the u of its own rows, so `vmap` can run over the columns of G
    def along(direction: Array, column: Array) -> Array:
        here = multipliers, velocity
        return jax.jvp(law, here, (jnp.broadcast_to(direction, column.shape), column))[1]

    return jax.vmap(along, (1, 1), 1)(identity, matrix) + share * identity


ROUNDS = 3
"""Rounds of iterative refinement of a derivative, whose matrix is inverted without pivoting."""


def probes(like: Array) -> list[Array]:
    """Returns two fixed vectors (n, …) of random numbers with both signs and sizes from 1 to 2."""
    random = np.random.default_rng(0)
    shape = (2, len(like), *(1,) * (like.ndim - 1))
    return list(
        jnp.asarray(random.choice([-1, 1], shape) * random.uniform(1, 2, shape), like.dtype)
    )
