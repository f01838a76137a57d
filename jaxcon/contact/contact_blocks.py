"""Matrices over inequality rows that couple only the rows of one contact."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.contact.bounded import Limits, RowCounts, RowsByLaw, laws
from jaxcon.core.lanes import Vector, total
from jaxcon.core.typing import Array


class ContactBlocks(NamedTuple):
    """A block for each contact, and a number for each other row.

    A normal acts on itself and on the rows of its discs; the rows of a disc act on each other:

        y_n = a_n x_n,    y_t = a_t x_n + T x_t.

    Attributes:
        kinds: the numbers of rows by law.
        first: a, (n,).
        discs: for each disc, the columns of T, vectors of lanes (contact, …).
    """

    kinds: RowCounts
    first: Array
    discs: tuple[tuple[Vector, ...], ...]

    def apply(self, x: Array) -> Array:
        """Returns A x, (n,)."""
        a, parts, discs = self.kinds.split(self.first), self.kinds.split(x), []
        for disc, c, y, columns in zip(
            self.kinds.discs, a.discs, parts.discs, self.discs, strict=True
        ):
            discs.append(c * disc.of(parts.normal) + _combined(columns, y))
        return self.kinds.join(
            RowsByLaw(
                a.single * parts.single, a.box * parts.box, a.normal * parts.normal, tuple(discs)
            )
        )

    def pull(self, x: Array) -> Array:
        """Returns Aᵀ x, (n,)."""
        a, parts, discs = self.kinds.split(self.first), self.kinds.split(x), []
        normal = a.normal * parts.normal
        for disc, c, y, columns in zip(
            self.kinds.discs, a.discs, parts.discs, self.discs, strict=True
        ):
            if not disc.rank:
                discs.append(y)
                continue
            discs.append(Vector(*(t.dot(y) for t in columns)))
            normal = normal.at[disc.first : disc.first + disc.count].add(c.dot(y))
        return self.kinds.join(
            RowsByLaw(a.single * parts.single, a.box * parts.box, normal, tuple(discs))
        )

    def inverse(self) -> ContactBlocks:
        """Returns A⁻¹."""
        a, discs, firsts = self.kinds.split(self.first), [], []
        normal = 1 / a.normal
        for disc, c, columns in zip(self.kinds.discs, a.discs, self.discs, strict=True):
            if disc.rank == 2:
                (p, q), (r, s) = columns
                inverse = 1 / (p * s - q * r)
                columns = (Vector(s, -q) * inverse, Vector(-r, p) * inverse)
            else:
                columns = tuple(Vector(1 / t[0]) for t in columns)
            firsts.append(_combined(columns, c) * -disc.of(normal))
            discs.append(columns)
        parts = RowsByLaw(1 / a.single, 1 / a.box, normal, tuple(firsts))
        return ContactBlocks(self.kinds, self.kinds.join(parts), tuple(discs))

    def __matmul__(self, other: ContactBlocks) -> ContactBlocks:
        """Returns A B."""
        kinds = self.kinds
        a, b = kinds.split(self.first), kinds.split(other.first)
        firsts, discs = [], []
        sets = zip(kinds.discs, a.discs, b.discs, self.discs, other.discs, strict=True)
        for disc, c, d, own, others in sets:
            firsts.append(c * disc.of(b.normal) + _combined(own, d))
            discs.append(tuple(_combined(own, column) for column in others))
        first = RowsByLaw(a.single * b.single, a.box * b.box, a.normal * b.normal, tuple(firsts))
        return ContactBlocks(kinds, kinds.join(first), tuple(discs))

    def scaled(self, x: Array) -> ContactBlocks:
        """Returns A diag(x) for x that is equal in all rows of a disc, (n,)."""
        s = self.kinds.split(x)
        first = self.first * self.kinds.by_contact(x)
        discs = tuple(
            tuple(column * own[0] for column in columns)
            for columns, own in zip(self.discs, s.discs, strict=True)
        )
        return ContactBlocks(self.kinds, first, discs)

    def masked(self, rows: Array) -> ContactBlocks:
        """Returns the matrix with zeros in the rows that are not in a mask, (n,)."""
        flags, discs = self.kinds.split(rows), []
        for own, columns in zip(flags.discs, self.discs, strict=True):
            discs.append(
                tuple(
                    Vector(*(jnp.where(f, x, 0) for f, x in zip(own, t, strict=True)))
                    for t in columns
                )
            )
        return ContactBlocks(self.kinds, jnp.where(rows, self.first, 0), tuple(discs))

    def plus(self, other: ContactBlocks, share: float = 0.0) -> ContactBlocks:
        """Returns A + B + s I."""
        n = self.kinds.starts[0]
        first = (self.first + other.first).at[:n].add(share)
        discs = tuple(
            tuple(
                Vector(
                    *(
                        x + y + (share if i == k else 0.0)
                        for i, (x, y) in enumerate(zip(a, b, strict=True))
                    )
                )
                for k, (a, b) in enumerate(zip(p, q, strict=True))
            )
            for p, q in zip(self.discs, other.discs, strict=True)
        )
        return ContactBlocks(self.kinds, first, discs)

    def ordered(self, order: np.ndarray) -> ContactBlocks:
        """Returns the matrix of the same rows in another order, which keeps contacts together."""
        kinds, discs = self.kinds, []
        for disc, start, columns in zip(kinds.discs, kinds.starts, self.discs, strict=False):
            indices = order[start : start + disc.count] - start
            discs.append(tuple(t.map(lambda x, i=indices: x[i]) for t in columns))
        return ContactBlocks(kinds, self.first[order], tuple(discs))


def _combined(columns: Sequence[Vector], x: Vector) -> Vector:
    """Returns T x, for the columns of T."""
    return Vector(
        *(total(t[i] * y for t, y in zip(columns, x, strict=True)) for i in range(len(columns)))
    )


def law_blocks(
    kinds: RowCounts,
    scale: Array,
    multipliers: Array,
    velocity: Array,
    live: Limits,
    width: Array | None,
) -> tuple[ContactBlocks, ContactBlocks]:
    """Returns the derivatives of `laws` by λ, for constant u, and by u.

    Rows of different contacts are independent, so one derivative along all first rows, and one
    along each component of all discs, give all entries.
    """

    def law(x: Array, u: Array) -> Array:
        return laws(kinds, scale, x, u, live, width)

    ones = kinds.split(jnp.ones_like(multipliers))
    none = kinds.split(jnp.zeros_like(multipliers))
    seeds = [kinds.join(ones._replace(discs=none.discs))]
    for k in range(max(disc.rank for disc in kinds.discs)):
        discs = tuple(
            Vector(*(x if i == k else y for i, (x, y) in enumerate(zip(p, q, strict=True))))
            for p, q in zip(ones.discs, none.discs, strict=True)
        )
        seeds.append(kinds.join(none._replace(discs=discs)))
    slope = functools.partial(jax.jvp, law, (multipliers, velocity))
    zero = jnp.zeros_like(multipliers)
    found = []
    for by_velocity in (False, True):
        first, *columns = (slope((zero, s) if by_velocity else (s, zero))[1] for s in seeds)
        parts = [kinds.split(column).discs for column in columns]
        discs = tuple(
            tuple(part[i] for part in parts[: disc.rank]) for i, disc in enumerate(kinds.discs)
        )
        found.append(ContactBlocks(kinds, first, discs))
    return found[0], found[1]
