"""Preconditioned conjugate gradients on the multipliers: A is applied, never formed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
from jaxcon.solvers.saddle import Diagonal, Factored, Saddle, Solution, free_motion, judge
from jaxcon.solvers.schur import Schur

Operator = Callable[[Array], Array]


@pytree
class ConjugateGradients(checks.Checked):
    """Solves M a = f + Jᵀλ, J a + C λ = b by conjugate gradients on A = J M⁻¹ Jᵀ + C.

    A x is J (M⁻¹ (Jᵀ x)) + C x and the preconditioner is the blocks of A on its diagonal, one for
    each constraint, so that memory is that of the rows and compile time does not depend on how many
    constraints of a kind there are. The error falls with the root of the condition number: few
    iterations are enough where each body is near to the ground, while a chain of n links takes more
    than n, and `Sparse` is then faster. Where M is not diagonal A is dense, and `Schur` takes over.

    Redundant rows that agree have a solution, and it is found: λ is shared among them. Rows that
    contradict each other, if only by rounding that the feedback has amplified, need `tikhonov` or
    a larger `tolerance`, and so does the gradient of multipliers that are not unique.

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

        The status is NOT_CONVERGED where the residual is above the tolerance, and SINGULAR where M
        is not positive definite.
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

        def iterate(a: Operator, x: Array) -> tuple[Array, Array]:
            return descend(a, preconditioner.solve, x, tolerance, self.iterations)

        def solve(force: Array, target: Array) -> Solution:
            free = system.mass.solve(force)
            multipliers, open_ = jax.lax.custom_linear_solve(
                delassus, target - j.apply(free), iterate, symmetric=True, has_aux=True
            )
            acceleration = free + system.mass.solve(j.transpose(multipliers))
            status = judge(acceleration, system.mass.singular)
            late = jnp.where(open_, Status.NOT_CONVERGED, Status.OK).astype(status.dtype)
            return Solution(acceleration, multipliers, first(status, late))

        return solve

    def _tolerance(self, dtype: Any) -> Array:
        given = self.tolerance
        return jnp.asarray(
            float(jnp.finfo(dtype).eps) ** (2 / 3) if given is None else given, dtype
        )


def descend(
    a: Operator, preconditioner: Operator, b: Array, tolerance: Array, iterations: int
) -> tuple[Array, Array]:
    """x with A x = b, from x = 0 along directions p conjugate by A, and whether it is not one.

    A world whose rᵀP⁻¹r has come down to tolerance² bᵀP⁻¹b stays as it is: in a singular system
    what is left of r is rounding, which would be divided by a curvature pᵀA p of rounding. A
    direction without curvature is not followed for the same reason.

    Args:
        a: x → A x, symmetric and positive semidefinite.
        preconditioner: r → P⁻¹ r.
        b: (n_c, …).
        tolerance: number or one for each world.
        iterations: how many.

    Returns:
        x (n_c, …), and for each world whether the tolerance is not reached.
    """
    flat = float(jnp.finfo(b.dtype).eps)
    z = preconditioner(b)
    size = _dot(b, z)
    solved = tolerance * tolerance * size

    def advance(_: Any, state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, r, p, rz = state
        y = a(p)
        curvature = _dot(p, y)
        stays = (rz <= solved) | (curvature <= flat * rz)
        step = safe_divide(jnp.where(stays, 0, rz), curvature)[None]
        x, r = x + step * p, r - step * y
        z = preconditioner(r)
        new = _dot(r, z)
        return x, r, z + safe_divide(new, rz)[None] * p, new

    x, _, _, rz = jax.lax.fori_loop(0, iterations, advance, (jnp.zeros_like(b), b, z, size))
    return x, rz > solved


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
