"""Solves equations of motion of trees whose bodies are also coupled by rows between two bodies.

Rows along joints and on single bodies keep the structure of the tree T = Nᵀ K N + D, which
`Articulated` factors, if D is symmetric. Each active row between two other bodies, and the effect
of each normal force on friction, add a term of rank one, w rᵀ. For H₀ = T and H_k = H_{k−1} + w_k
r_kᵀ, the formula of Sherman and Morrison gives

    H_k⁻¹ b = x − s_k z_k (r_k·x)   for x = H_{k−1}⁻¹ b,   z_k = H_{k−1}⁻¹ w_k,
    s_k = 1/(1 + r_k·z_k).

Few such rows are active at a time. A batch has as many terms as the world with most active rows.

References:
    Sherman, Morrison, Adjustment of an inverse matrix corresponding to a change in one element of a
        given matrix, Annals of Mathematical Statistics (1950).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.contact.body_space import BodySpace
from jaxcon.contact.bounded import RowCounts
from jaxcon.core.lanes import Vector
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array
from jaxcon.linear.articulated import Articulated, ByBranch


class Directions(NamedTuple):
    """The part Σ l rᵀ of D that does not keep the structure of a tree, with a term for each row.

    Rows between two bodies have l = d e and r = e with orthogonal directions e. For most rows, e is
    the row itself. For the two rows of a disc, one direction is along the slip and the other normal
    to it. The effect of a normal force on friction is part of l of the normal.

    Attributes:
        kinds: the numbers of rows by law.
        weight: d of each direction, (n,); zero for rows on single bodies and joints.
        slip: for each disc, the first direction, lanes (contact, …).
        columns: derivatives of disc rows by the velocity of their normals, (n,); None if zero.
    """

    kinds: RowCounts
    weight: Array
    slip: tuple[Vector, ...]
    columns: Array | None = None

    @classmethod
    def of(
        cls,
        between: np.ndarray,
        kinds: RowCounts,
        slope: Array,
        discs: list[tuple[Array, Vector]],
        columns: Array | None = None,
    ) -> Directions:
        """Returns the directions of D.

        Args:
            between: a mask of the rows between two bodies, (n, …).
            kinds: the numbers of rows by law.
            slope: the diagonal part of D, (n,).
            discs: for each disc, the part −b t tᵀ of D: b and t, lanes (contact, …).
            columns: derivatives of disc rows by the velocity of their normals, (n,); None if zero.
        """
        parts = kinds.split(jnp.where(between, slope, 0))
        weights, slips = [], []
        for a, (b, t) in zip(parts.discs, discs, strict=True):
            weights.append(Vector(*(jnp.maximum(x - b, 0) for x in a[:1]), *a[1:]))
            unit = [1.0, 0.0][: len(t)]
            slips.append(Vector(*(jnp.where(b > 0, x, e) for x, e in zip(t, unit, strict=True))))
        weight = kinds.join(parts._replace(discs=tuple(weights)))
        return cls(kinds, jnp.where(between, weight, 0), tuple(slips), columns)

    def active(self) -> Array:
        """Returns a mask of the rows whose terms are not zero, (n,)."""
        if self.columns is None:
            return self.weight > 0
        parts = self.kinds.split(self.columns)
        normal = jnp.zeros(parts.normal.shape, bool)
        for disc, c in zip(self.kinds.discs, parts.discs, strict=True):
            own = slice(disc.first, disc.first + disc.count)
            for x in c:
                normal = normal.at[own].set(normal[own] | (x != 0))
        none = jnp.zeros_like(self.weight, bool)
        first = self.kinds.normal
        return (self.weight > 0) | none.at[first : first + self.kinds.contacts].set(normal)

    def right(self, x: Array) -> Array:
        """Returns Σ x r, (n,), for a number x of each row, (n,)."""
        parts = self.kinds.split(x)
        discs = []
        for y, t in zip(parts.discs, self.slip, strict=True):
            if len(y) == 2:
                y = Vector(t[0] * y[0] - t[1] * y[1], t[1] * y[0] + t[0] * y[1])
            discs.append(y)
        return self.kinds.join(parts._replace(discs=tuple(discs)))

    def left(self, x: Array) -> Array:
        """Returns Σ x l, (n,), for a number x of each row, (n,)."""
        result = self.right(self.weight * x)
        return result if self.columns is None else result + self.columns * self._normals(x)

    def _normals(self, x: Array) -> Array:
        """Returns, for the disc rows, the entries of their normals; zero for other rows, (n,)."""
        return self.kinds.by_contact(x).at[: self.kinds.starts[0]].set(0)


class Terms(NamedTuple):
    """The terms of H that are known so far.

    Attributes:
        number: the number k of terms, ().
        row: the next row with a term, (…); n if there is none.
        right: r of each term, (terms, joint velocities, …).
        z: s_k z_k of each term, (terms, joint velocities, …).
    """

    number: Array
    row: Array
    right: Array
    z: Array


class Bordered:
    """The factors of H = T + Σ w rᵀ; see the module.

    Attributes:
        space: the equations of motion.
        factors: the factors of T.
        terms: the other terms.
    """

    def __init__(
        self,
        space: BodySpace,
        factors: Articulated,
        directions: Directions,
        most: int,
    ) -> None:
        """Computes the terms of the active rows.

        Args:
            space: the equations of motion.
            factors: the factors of T.
            directions: the other terms of D.
            most: the largest number of terms.
        """
        self.space, self.factors = space, factors
        motions, weight = space.motions, directions.weight
        symmetric = directions.columns is None
        n, active = len(weight), directions.active()
        numbers = jnp.arange(n, dtype=jnp.int32).reshape(-1, *(1,) * (weight.ndim - 1))

        def following(row: Array) -> Array:
            return jnp.min(jnp.where(active & (numbers > row[None]), numbers, n), axis=0)

        def along(multipliers: Array) -> Array:
            none: ByBranch = [[0.0] * b.freedom for b in motions.tree.branches]
            forces = (space.pull_pairs(multipliers), none) if symmetric else space.pull(multipliers)
            return motions.flat(motions.gradient(*forces))

        def goes(terms: Terms) -> Array:
            return (terms.number < most) & somewhere(terms.row < n)

        def add(terms: Terms) -> Terms:
            here = (numbers == terms.row[None]).astype(weight.dtype)
            right = along(directions.right(here))
            if symmetric:
                left = right * jnp.sum(here * weight, axis=0)[None]
            else:
                left = along(directions.left(here))
            z = _reduced(terms, self._along_joints(left))
            z = z / (1 + jnp.sum(right * z, axis=0))[None]
            new = (
                jax.lax.dynamic_update_index_in_dim(old, x, terms.number, 0)
                for old, x in ((terms.right, right), (terms.z, z))
            )
            return Terms(terms.number + 1, following(terms.row), *new)

        zeros = jnp.zeros((most, motions.freedom, *motions.shape), weight.dtype)
        first = following(jnp.full(motions.shape, -1, jnp.int32))
        start = Terms(jnp.zeros((), jnp.int32), first, zeros, zeros)
        self.terms: Terms = jax.lax.while_loop(goes, add, start)

    def solve(self, forces: ByBranch, joints: ByBranch) -> tuple[ByBranch, ByBranch]:
        """Returns q̇ = H⁻¹ (Nᵀ f + g), and the velocities y of the bodies.

        Args:
            forces: forces f on the bodies, by branch.
            joints: forces g along the joints, by branch.
        """
        motions = self.space.motions
        z = motions.flat(self.factors.solve(forces, joints)[0])
        change = motions.by_branch(_reduced(self.terms, z))
        return change, motions.velocities(change)

    def solve_transposed(self, forces: ByBranch, joints: ByBranch) -> tuple[ByBranch, ByBranch]:
        """Returns q̇ = H⁻ᵀ (Nᵀ f + g), and the velocities y of the bodies; see `solve`."""
        motions = self.space.motions
        b = motions.flat(motions.gradient(forces, joints))
        b = _reduced(self.terms, b, transposed=True)
        change = motions.by_branch(self._along_joints(b))
        return change, motions.velocities(change)

    def _along_joints(self, force: Array) -> Array:
        """Returns T⁻¹ g for forces g along the joints, (joint velocities,)."""
        motions = self.space.motions
        at_rest: ByBranch = [[0.0] * motions.size for _ in motions.tree.branches]
        return motions.flat(self.factors.solve(at_rest, motions.by_branch(force))[0])


def _reduced(terms: Terms, x: Array, transposed: bool = False) -> Array:
    """Applies the factors I − s z rᵀ of all known terms to x, (joint velocities,).

    H⁻¹ b is the result for x = T⁻¹ b. H⁻ᵀ b is T⁻¹ x for the result x of the transposed factors, in
    reverse order, applied to b.
    """

    def goes(s: Any) -> Array:
        return s[0] < terms.number

    def less(s: Any) -> Any:
        k, x = s
        place = terms.number - 1 - k if transposed else k
        right, z = (
            jax.lax.dynamic_index_in_dim(y, place, 0, keepdims=False)
            for y in (terms.right, terms.z)
        )
        if transposed:
            right, z = z, right
        return k + 1, x - z * jnp.sum(right * x, axis=0)[None]

    return jax.lax.while_loop(goes, less, (jnp.zeros((), jnp.int32), x))[1]
