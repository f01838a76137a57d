"""Derivatives of the solution of inequality rows, by elimination along the joints.

The derivative of the laws by λ is E + F (G + C) with the block-diagonal E and F of `law_blocks`. G
is h J H⁻¹ Jᵀ, where H are the equations of motion of the bodies. With R > 0 and B = E + F (C + R),

    (B + F G) x = r   ⟺   x = B⁻¹ r − D u,   u = J y,   (H + h Jᵀ D J) y = h Jᵀ B⁻¹ r,   D = B⁻¹ F.

No matrix of all rows is formed. R makes B invertible. Each round of iterative refinement reduces
its effect by R/(R + μ), where μ is the smallest eigenvalue of G other than zero.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxcon.contact.body_space import BodySpace
from jaxcon.contact.bordered import Bordered, Directions
from jaxcon.contact.bounded import Limits, RowCounts
from jaxcon.contact.contact_blocks import ContactBlocks, law_blocks
from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array
from jaxcon.linear.articulated import Articulated
from jaxcon.linear.roots import Operator

RIDGE = 0.4
"""The exponent k of R = ε^k g. A smaller R needs fewer rounds of refinement, but then contacts that
share their load lose digits to rounding."""


def inverses(
    space: BodySpace,
    kinds: RowCounts,
    scale: Array,
    compliance: Array,
    movable: Array,
    dt: Array,
    live: Limits,
    width: Array | None,
    multipliers: Array,
    velocity: Array,
) -> tuple[Operator, Operator]:
    """Returns approximations of (E + F (G + C))⁻¹ and of its transpose, as functions of (n,).

    Args:
        space: the equations of motion.
        kinds: numbers of rows by law.
        scale: scale g of the velocities, (n,); see `Bounded.diagonal`.
        compliance: the diagonal of C, (n,).
        movable: mask of the rows that act and can move, (n,).
        dt: step size h, () [s].
        live: bounds of the boxes, and the coefficient μ of each disc.
        width: width of the smoothed corners of the laws, (1,) [m/s, rad/s]; None for sharp corners.
        multipliers: the solution λ, (n,).
        velocity: its velocities u − u*, (n,).
    """
    eps, h, order = float(jnp.finfo(scale.dtype).eps), dt[None], space.order
    by_multipliers, by_velocity = law_blocks(kinds, scale, multipliers, velocity, live, width)
    by_velocity = by_velocity.masked(movable)
    stiff = by_multipliers.plus(by_velocity.scaled(compliance + eps**RIDGE * scale), eps**0.75)
    inverse = stiff.inverse()
    ahead = kinds.split((multipliers - velocity / scale)[order])
    inverse, slope = inverse.ordered(order), (inverse @ by_velocity).ordered(order)
    discs, diagonal = _principal(slope, ahead.discs)
    columns = slope.first.at[: kinds.starts[0]].set(0)
    # rounding must not give a contact that sticks a term of its own
    matters = jnp.abs(columns) > eps**0.5 * jnp.abs(kinds.by_contact(slope.first))
    columns = h * jnp.where(matters, columns, 0)
    diagonal, discs = h * diagonal, [(h * b, t) for b, t in discs]
    directions = Directions.of(space.between(scale), kinds, diagonal, discs, columns)
    most = space.pair_rows + kinds.contacts
    back = np.argsort(order)

    tree = Articulated(space.motions, *space.stiffened(diagonal, kinds, discs))
    solve = solve_transposed = tree.solve
    if most and space.motions.freedom:
        factors = Bordered(space, tree, directions, most)
        solve, solve_transposed = factors.solve, factors.solve_transposed

    def down(right: Array) -> Array:
        x = inverse.apply(right[order])
        z, y = solve(*space.pull(h * x))
        return (x - slope.apply(space.rows_of(y, z, x)))[back]

    def up(right: Array) -> Array:
        r = right[order]
        z, y = solve_transposed(*space.pull(h * slope.pull(r)))
        return inverse.pull(r - space.rows_of(y, z, r))[back]

    return down, up


def _principal(
    slope: ContactBlocks, ahead: tuple[Vector, ...]
) -> tuple[list[tuple[Array, Vector]], Array]:
    """Returns D of the discs as a I − b t tᵀ: b and t of each disc, and the diagonal, (n,).

    One principal direction t of a disc is that of the multiplier before projection.
    """
    parts, found, diagonals = slope.kinds.split(slope.first), [], []
    for columns, x in zip(slope.discs, ahead, strict=True):
        if len(columns) < 2:
            diagonals.append(Vector(*(column[0] for column in columns)))
            none = parts.normal[:0] if not columns else jnp.zeros_like(columns[0][0])
            found.append((none, x.map(jnp.zeros_like)))
            continue
        length = numerics.norm(x)
        safe = jnp.where(length > 0, length, 1)
        c, s = jnp.where(length > 0, x[0] / safe, 1), x[1] / safe
        (p, q), (r, w) = columns
        along = c * c * p + c * s * (q + r) + s * s * w
        across = s * s * p - c * s * (q + r) + c * c * w
        diagonals.append(Vector(across, across))
        found.append((across - along, Vector(c, s)))
    return found, slope.kinds.join(parts._replace(discs=tuple(diagonals)))
