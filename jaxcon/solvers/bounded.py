"""Rows whose multipliers are bounded: complementarity, boxes and friction cones.

With the equality rows eliminated, what is left of a step is, in the multipliers λ of the bounded
rows and the velocities u that they leave,

    u = G λ + c,   each row or contact obeying its law:

    one-sided   λ ≥ 0,  u ≥ 0,  λ u = 0
    box         lo ≤ λ ≤ hi,  λ = lo where u > 0,  λ = hi where u < 0
    contact     one-sided for the normal, and for the tangents ‖λ_t‖ ≤ μ λ_n,
                λ_t = −μ λ_n u_t/‖u_t‖ where ‖u_t‖ > 0: Signorini and Coulomb.

Resistance to rolling and to spinning obeys the law of the tangents with a length in place of μ, a
moment for λ_t and a relative angular velocity for u_t. So each law of a disc, ‖λ_t‖ ≤ μ λ_n, is one
`Disc`: the tangents of all contacts, and what some of them have beside it.

Rows are ordered one-sided, boxes, normals, then by disc each component of all its contacts.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.solvers import gauss_jordan, roots


def is_exact(solver: Any) -> bool:
    """Returns True for a solver that finds the multipliers to full precision.

    Landings are then impacts within a step. A solver of a user says so by an attribute `exact`.
    """
    return getattr(solver, "exact", False)


@dataclass(frozen=True)
class Disc:
    """What is bounded by the normals of contacts in succession.

    Attributes:
        first, count: the contacts.
        rank: of each, how many rows.
    """

    first: int
    count: int
    rank: int

    def of(self, normal: Array) -> Array:
        """What its contacts have, of what all have."""
        return normal[self.first : self.first + self.count] if self.count < len(normal) else normal


@dataclass(frozen=True)
class Kinds:
    """How many rows there are of each law.

    Attributes:
        single, boxes, contacts: one-sided rows, boxes, and contacts.
        tangents: of each contact: 1 in the plane, 2 in space.
        turning: resistance to rolling and spinning, of some contacts.
    """

    single: int = 0
    boxes: int = 0
    contacts: int = 0
    tangents: int = 0
    turning: tuple[Disc, ...] = ()

    @property
    def discs(self) -> tuple[Disc, ...]:
        """Friction first."""
        return (Disc(0, self.contacts, self.tangents), *self.turning)

    @property
    def starts(self) -> tuple[int, ...]:
        """The first row of each disc, and the number of rows."""
        sizes = [disc.count * disc.rank for disc in self.discs]
        return tuple(itertools.accumulate(sizes, initial=self.normal + self.contacts))

    @property
    def size(self) -> int:
        """The number of rows."""
        return self.starts[-1]

    @property
    def normal(self) -> int:
        """The row of the first normal."""
        return self.single + self.boxes

    @property
    def one_sided(self) -> np.ndarray:
        """A mask of the rows of stops and of normals of contacts, (n,)."""
        rows = np.arange(self.size)
        return (rows < self.single) | (rows >= self.normal) & (rows < self.normal + self.contacts)

    def split(self, x: Array) -> Parts:
        """An array (n, …) by law."""
        box, normal = x[self.single : self.normal], x[self.normal : self.starts[0]]
        discs = []
        for disc, start in zip(self.discs, self.starts, strict=False):
            places = (start + i * disc.count for i in range(disc.rank))
            discs.append(Vector(*(x[i : i + disc.count] for i in places)))
        return Parts(x[: self.single], box, normal, tuple(discs))

    def join(self, parts: Parts) -> Array:
        """The array of its parts."""
        rows = itertools.chain(*parts.discs)
        return jnp.concatenate([parts.single, parts.box, parts.normal, *rows])

    def under_normals(self, flags: Parts) -> Array:
        """Flags (n,) of which those of discs hold only where their normals' do."""
        sets = zip(self.discs, flags.discs, strict=True)
        discs = tuple(Vector(*(y & disc.of(flags.normal) for y in x)) for disc, x in sets)
        return self.join(flags._replace(discs=discs))

    def by_contact(self, x: Array) -> Array:
        """An array (n, …) whose discs have what the normal of their contact has."""
        parts = self.split(x)
        sets = zip(self.discs, parts.discs, strict=True)
        discs = tuple(y.map(lambda _, d=disc: d.of(parts.normal)) for disc, y in sets)
        return self.join(parts._replace(discs=discs))

    def largest(self, x: Array) -> Array:
        """Returns the largest of rows (n, …) that obey a law together."""
        parts = self.split(x)
        slip, *turning = parts.discs
        most = functools.reduce(jnp.maximum, slip, parts.normal)
        discs = [slip.map(lambda _: most)]
        for disc in turning:
            own = functools.reduce(jnp.maximum, disc)
            discs.append(disc.map(lambda _, x=own: x))
        return self.join(parts._replace(normal=most, discs=tuple(discs)))


class Parts(NamedTuple):
    """Lanes of the rows of each law: (single,), (boxes,), (contacts,), and a Vector by disc."""

    single: Array
    box: Array
    normal: Array
    discs: tuple[Vector, ...]


@pytree
class Bounded:
    """u = G λ + c, and the bounds of λ.

    Attributes:
        matrix: G, (n, n), symmetric, not negative; zero rows are allowed.
        offset: c, (n,).
        lower, upper: of the boxes, (boxes,).
        friction: μ, (contacts,).
        kinds: how many rows of each law.
        resistance: of each of `kinds.turning`, (its contacts,) [m].
    """

    matrix: Array
    offset: Array
    lower: Array
    upper: Array
    friction: Array
    kinds: Kinds = static()
    resistance: tuple[Array, ...] = ()

    @property
    def coefficients(self) -> tuple[Array, ...]:
        """By disc, the bound of ‖λ_t‖ by λ_n."""
        return (self.friction, *self.resistance)

    def velocity(self, multipliers: Array) -> Array:
        """G λ + c, (n,)."""
        return jnp.sum(self.matrix * multipliers[None], axis=1) + self.offset

    def residual(self, multipliers: Array) -> Array:
        """λ − P(λ − u/g), (n,), zero where and only where all laws hold; see `laws`."""
        live = (self.lower, self.upper, self.coefficients)
        return laws(self.kinds, self.diagonal(), multipliers, self.velocity(multipliers), live)

    def slope(self, multipliers: Array, velocity: Array, width: Any = None) -> Array:
        """∂(residual)/∂λ, (n, n), a little regularised; `width` as of `laws`.

        A law takes from u its own rows alone, so that a column of G goes through it like a vector.

        Args:
            multipliers: λ, (n,).
            velocity: G λ + c, (n,).
            width: of smoothed corners, (1,) [m/s, rad/s]; None leaves them sharp.
        """
        scale = self.diagonal()
        live = (self.lower, self.upper, self.coefficients)
        share = float(jnp.finfo(multipliers.dtype).eps) ** 0.75
        every = gauss_jordan.identity(multipliers)

        def law(x: Array, u: Array) -> Array:
            return laws(self.kinds, scale, x, u, live, width)

        def along(direction: Array, column: Array) -> Array:
            here = multipliers, velocity
            return jax.jvp(law, here, (jnp.broadcast_to(direction, column.shape), column))[1]

        return jax.vmap(along, (1, 1), 1)(every, self.matrix) + share * every

    def missed(self, multipliers: Array) -> Array:
        """|residual| as velocities, (n,)."""
        return jnp.abs(self.residual(multipliers) * self.diagonal())

    def worst(self, multipliers: Array) -> Array:
        """The largest that is missed, by world."""
        return jnp.max(self.missed(multipliers), axis=0)

    def released(self, multipliers: Array) -> Array:
        """λ with none of what rounding, or the end of a path, leaves to a contact that opens.

        However little that is, it would hold in the derivative what does not slip. Nor does
        rounding leave a row that only pushes a pull.
        """
        ahead = multipliers - self.velocity(multipliers) / self.diagonal()
        here = self.kinds.split(multipliers)
        bears = (self.kinds.split(ahead).normal > 0) & (here.normal > 0)
        sets = zip(self.kinds.discs, here.discs, strict=True)
        discs = tuple(x * disc.of(bears).astype(ahead.dtype) for disc, x in sets)
        single, normal = jnp.maximum(here.single, 0), jnp.where(bears, here.normal, 0)
        return self.kinds.join(here._replace(single=single, normal=normal, discs=discs))

    def diagonal(self) -> Array:
        """What a multiplier adds to the velocity of its own row, (n,).

        It is one number for the normal and the tangents of a contact, and one for what resists its
        rolling or spinning, whose unit is another.
        """
        own = gauss_jordan.diagonal(self.matrix)
        joint = self.kinds.largest(own)
        largest = jnp.max(own, axis=0)[None]
        moves = joint > float(jnp.finfo(own.dtype).eps) ** 2 * largest
        return jnp.where(moves, joint, jnp.where(largest > 0, largest, 1))


Limits = tuple[Array, Array, tuple[Array, ...]]
"""lower, upper and, by disc, μ."""


def laws(
    kinds: Kinds, scale: Array, multipliers: Array, velocity: Array, live: Limits, width: Any = None
) -> Array:
    """λ − P(λ − u/g), (n,), P the nearest that bounds allow, friction by the normal part of λ.

    Args:
        kinds: how many rows of each law.
        scale: g, (n,), the velocity that a unit of multiplier makes.
        multipliers: λ, (n,).
        velocity: u − u*, (n,).
        live: lower, upper and μ.
        width: of the smoothed corners of P, (1,) [m/s, rad/s]; None leaves them sharp.
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
    return multipliers - kinds.join(Parts(single, box, normal, discs))


@dataclass(frozen=True)
class _Positive:
    """max(x, 0), or ½ (x + √(x² + 4 c²)) for a corner of width c."""

    smooth: bool = False

    def __call__(self, x: Array, corner: Array) -> Array:
        if not self.smooth:
            return jnp.maximum(x, 0)
        return (x + numerics.safe_sqrt(x * x + 4 * corner * corner)) / 2


def onto_disc(x: Vector, radius: Array, corner: Any = 0.0, positive: Any = _Positive()) -> Vector:
    """The nearest vector of at most this length."""
    if not len(x):
        return x
    length = numerics.norm(x)
    return x * numerics.safe_divide(radius, radius + positive(length - radius, corner))


def implicit_multipliers(
    problem: Bounded, multipliers: Array, velocity: Any, live: Limits, width: Any
) -> Array:
    """λ with the derivative that the laws give it where they hold.

    Args:
        problem: a constant, for the matrix of the derivative.
        multipliers: λ that solves it, (n,).
        velocity: λ → u − u*, with all that it depends on.
        live: lower, upper and μ, with all that they depend on.
        width: of smoothed corners [m/s, rad/s]; None leaves them sharp.
    """
    kinds, scale = problem.kinds, problem.diagonal()
    corner = None if width is None else jnp.asarray(width, scale.dtype)[None]

    here = problem.velocity(multipliers)

    def law(x: Array) -> Array:
        # choices without a derivative, which is stopped in here, see `roots.implicit`
        fixed, smooth, there = jax.lax.stop_gradient((scale, corner, here))
        # u as the matrix below has it: a contact at the corner of its law, which rounding alone
        # says to press or to open, must do the same in both
        u = velocity(x)
        return laws(kinds, fixed, x, there + (u - jax.lax.stop_gradient(u)), live, smooth)

    def prepared() -> tuple[roots.Operator, roots.Operator]:
        known = gauss_jordan.inverse(problem.slope(multipliers, here, corner))
        return partial(gauss_jordan.apply, known), partial(
            gauss_jordan.apply, jnp.swapaxes(known, 0, 1)
        )

    def iterate(_: Any, x: Array) -> tuple[Array, None]:
        return x, None

    return roots.implicit(law, multipliers, iterate, ROUNDS, prepared=prepared)[0]


ROUNDS = 3
"""The rounds of refinement of a derivative, whose matrix is inverted without pivoting."""
