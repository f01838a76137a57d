"""Preconditioned conjugate gradients on the multipliers: A is applied, never formed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.numerics import safe_divide
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status, first
from jaxcon.core.typing import Array, Lane
from jaxcon.solvers import blocks
from jaxcon.solvers.blocks import Block, freeze
from jaxcon.solvers.delassus import Delassus, diagonal_blocks, softened, weighted
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.proximal import conflicts, scaled
from jaxcon.solvers.saddle import Diagonal, Factored, Saddle, Solution, free_motion, judge
from jaxcon.solvers.schur import Schur

Operator = Callable[[Array], Array]

CONTRADICTING = 1e-2
"""The part of b and J M⁻¹ f that redundant rows may leave open before it is a conflict."""


@pytree
class ConjugateGradients(checks.Checked):
    """Solves M a = f + Jᵀλ, J a + C λ = b by conjugate gradients on A = J M⁻¹ Jᵀ + C.

    A x is J (M⁻¹ (Jᵀ x)) + C x and the preconditioner is the blocks of A on its diagonal, one for
    each constraint, so that memory is that of the rows and compile time does not depend on how many
    constraints of a kind there are. The error falls with the root of the condition number: few
    iterations are enough where each body is near to the ground, while a chain of n links takes more
    than n, and `Sparse` is then faster. Where M is not diagonal A is dense, and `Schur` takes over.

    The variant is that of conjugate residuals, whose residual is the least in the norm of the
    preconditioner. Redundant rows that agree have a solution, and it is found: λ is shared among
    them. Off the constraints, and by rounding that feedback amplifies, they do not quite agree:
    they are met by least squares, with the least λ. Where these leave more than a hundredth of b
    and J M⁻¹ f, and more than rounding, rows contradict each other, and the status is CONFLICT.

    The solution is differentiated implicitly, by one more solve of as many iterations.

    Attributes:
        tikhonov: ε of a regularised system (A + ε diag A) λ = b − J M⁻¹ f, or None; see `Sparse`.
        tolerance: residual, relative to the right side in the norm of the preconditioner, at which
            a world is solved and stays as it is. One that does not come there in all iterations is
            NOT_CONVERGED; a tolerance of 0.1 or more accepts rough solutions, whose error the
            feedback of later steps corrects. If None, ⅔ of the digits: 2e-5 in float32, 4e-11 in
            float64.
        iterations: how many, whatever the numbers.

    References:
        Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 9.1 and section 10.2.
        Kaasschieter, Preconditioned conjugate gradients for solving singular systems, Journal of
            Computational and Applied Mathematics 24 (1988).
    """

    tikhonov: Any = None
    tolerance: Any = None
    iterations: int = static(default=100)

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: one is out of range.
        """
        checks.check("ConjugateGradients", "tikhonov", self.tikhonov, (), least=0, optional=True)
        checks.count("ConjugateGradients", "iterations", self.iterations)
        checks.check("ConjugateGradients", "tolerance", self.tolerance, (), least=0, optional=True)

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status.

        The status is NOT_CONVERGED where the residual is neither below the tolerance nor the least,
        CONFLICT where the least is large, and SINGULAR where M is not positive definite.
        """
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size:
            return free_motion(system)
        if not isinstance(system.mass, Diagonal):
            return Schur(self.tikhonov).factor(system)
        j, delassus = system.jacobian, Delassus(system, self.tikhonov)
        preconditioner = BlockJacobi(*delassus.matrices)
        tolerance = freeze(self._tolerance(system.force.dtype))

        length = jnp.sqrt(scaled(system, 1e-6))

        def iterate(a: Operator, x: Array) -> tuple[Array, Any]:
            return descend(a, preconditioner.solve, x, tolerance, self.iterations, system.loops)

        def solve(force: Array, target: Array) -> Solution:
            free = system.mass.solve(force)
            multipliers, (left, solved, beyond) = jax.lax.custom_linear_solve(
                delassus, target - j.apply(free), iterate, symmetric=True, has_aux=True
            )
            acceleration = free + system.mass.solve(j.transpose(multipliers))
            status = judge(acceleration, system.mass.singular)
            ended = jnp.logical_or(solved, beyond)
            late = jnp.where(ended, Status.OK, Status.NOT_CONVERGED).astype(status.dtype)
            late = first(status, late)
            if not system.loops:
                return Solution(acceleration, multipliers, late)
            conflict = conflicts(system, force, target, left, length, CONTRADICTING)
            conflict = jnp.where(solved, Status.OK, conflict).astype(status.dtype)
            return Solution(acceleration, multipliers, first(late, conflict))

        return solve

    def _tolerance(self, dtype: Any) -> Array:
        given = self.tolerance
        return jnp.asarray(
            float(jnp.finfo(dtype).eps) ** (2 / 3) if given is None else given, dtype
        )


class Descent(NamedTuple):
    """How far an iteration has come.

    Attributes:
        x: (n_c, …).
        r: b − A x, (n_c, …).
        z: P⁻¹ r, (n_c, …).
        az: A z, (n_c, …).
        paz: P⁻¹ A z, (n_c, …).
        p: the direction, (n_c, …).
        ap: A p, (n_c, …).
        pap: P⁻¹ A p, (n_c, …).
    """

    x: Array
    r: Array
    z: Array
    az: Array
    paz: Array
    p: Array
    ap: Array
    pap: Array

    @property
    def size(self) -> Array:
        """‖r‖² = rᵀP⁻¹r, by world."""
        return _dot(self.r, self.z)

    @property
    def least(self) -> Array:
        """Worlds whose ‖r‖ is as small as it can be: ‖A P⁻¹ r‖ is small, or zᵀA z rounding.

        Eigenvalues of P⁻¹A up to the first bound count as zero, as in `RankSafe`.
        """
        information = jnp.finfo(self.x.dtype)
        zero = 1e-9 if information.bits == 64 else 1e-5
        flat = _dot(self.az, self.paz) <= zero * zero * self.size
        return flat | (_dot(self.z, self.az) <= 16 * float(information.eps) * self.size)


def descend(
    a: Operator,
    preconditioner: Operator,
    b: Array,
    tolerance: Array,
    iterations: int,
    singular: bool = True,
) -> tuple[Array, tuple[Array, Array, Array]]:
    """The x with the least residual r = b − A x, in the norm of P⁻¹, from x = 0.

    Conjugate residuals: each iteration makes ‖r‖ least on the directions so far. Its steps
    zᵀA z / ‖A p‖² do not see the part of r that A cannot reach, as those of plain conjugate
    gradients, ‖r‖² / pᵀA p, would: once the rest of r is no larger, these go astray.

    A world whose ‖r‖ has come down to the tolerance stays as it is. So does one whose ‖r‖ is the
    least: r then lies outside of the range of A. Along z, which A does not feel, x has a part in
    proportion to r and to the condition number; it is taken out, and x is the least in the norm
    of P.

    Args:
        a: x → A x, symmetric and positive semidefinite.
        preconditioner: r → P⁻¹ r.
        b: (n_c, …).
        tolerance: of ‖r‖, in units of ‖b‖, number or one for each world.
        iterations: how many.
        singular: whether A may be; if not, small eigenvalues are those of heavy loads, and ‖r‖
            is never the least.

    Returns:
        x (n_c, …), and r (n_c, …), whether the tolerance is reached, and whether ‖r‖ is not below
        it and yet the least, by world.

    References:
        Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 6.20.
        Liu, Milzarek and Roosta, Obtaining pseudo-inverse solutions with MINRES (2023).
    """
    z = preconditioner(b)
    az = a(z)
    paz = preconditioner(az)
    solved = tolerance * tolerance * _dot(b, z)

    def advance(_: Any, known: Descent) -> Descent:
        x, r, z, az, _, p, ap, pap = known
        pull = _dot(z, az)
        stays = known.size <= solved
        if singular:
            stays |= known.least
        step = safe_divide(jnp.where(stays, 0, pull), _dot(ap, pap))[None]
        x, r, z = x + step * p, r - step * ap, z - step * pap
        az = a(z)
        paz = preconditioner(az)
        more = safe_divide(_dot(z, az), pull)[None]
        return Descent(x, r, z, az, paz, z + more * p, az + more * ap, paz + more * pap)

    start = Descent(jnp.zeros_like(b), b, z, az, paz, z, az, paz)
    end = jax.lax.fori_loop(0, iterations, advance, start)
    done = end.size <= solved
    if not singular:
        return end.x, (end.r, done, jnp.zeros_like(done))
    beyond = ~done & end.least
    share = safe_divide(jnp.where(beyond, _dot(end.x, end.r), 0), end.size)
    return end.x - share[None] * end.z, (end.r, done, beyond)


class BlockJacobi:
    """P⁻¹ with P the blocks of A on its diagonal, one for each constraint, each L D Lᵀ.

    A diagonal entry is raised by √eps of itself, so that a block with rows that depend on each
    other has an inverse, too; that of an empty row is 1.
    """

    def __init__(self, jacobian: Jacobian, inverse_mass: Array, compliance: Array | None) -> None:
        self.shapes = {block.start: block.shape for block in jacobian.blocks}
        found = diagonal_blocks(jacobian, weighted(jacobian, inverse_mass))
        if compliance is not None:
            found = softened(found, self.shapes, compliance)
        share = float(jnp.finfo(inverse_mass.dtype).eps) ** 0.5
        self.factors = {start: blocks.ldl(_raised(found[start], share)) for start in sorted(found)}

    def solve(self, r: Array) -> Array:
        """P⁻¹ r, (n_c,)."""
        parts: list[Array] = []
        for start, factor in self.factors.items():
            m, k = self.shapes[start]
            own = Vector.of_rows(r, start, m, k)
            y = blocks.scale(factor, blocks.forward(factor, list(own)))
            parts += blocks.backward(factor, y)
        return jnp.concatenate(parts)


def _raised(block: Block, share: float) -> Block:
    """A block with its diagonal raised by a share of it."""

    def raised(x: Lane) -> Lane:
        return jnp.where(x == 0, 1, (1 + share) * x)

    return [[*row[:-1], raised(row[-1])] for row in block]


def _dot(x: Array, y: Array) -> Array:
    """xᵀy of each world."""
    return jnp.sum(x * y, axis=0)
