"""Matrix-free preconditioned conjugate gradients for the multipliers λ of A λ = r."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.numerics import safe_divide
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status, first
from jaxcon.core.typing import Array, Lane, Scalar
from jaxcon.linear import blocks
from jaxcon.linear.blocks import freeze
from jaxcon.linear.delassus import Delassus, diagonal_blocks, weighted
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.proximal import conflicts, scaled
from jaxcon.linear.saddle import Diagonal, Factored, Saddle, Solution, free_motion, judge
from jaxcon.linear.schur import Schur
from jaxcon.protocols import Solver

Operator = Callable[[Array], Array]

CONTRADICTING = 1e-2
"""The residual above which redundant rows count as contradictory.

It is relative to the size of b and J M⁻¹ f.
"""


@pytree
class ConjugateGradients(checks.Checked, Solver):
    """Solves M a = f + Jᵀλ, J a + C λ = b by conjugate gradients on A = J M⁻¹ Jᵀ + C.

    A is never formed: it is applied as A x = J (M⁻¹ (Jᵀ x)) + C x. The preconditioner is the block
    diagonal of A, with one block for each constraint. Memory grows with the number of rows.
    Compile time does not depend on the number of equal constraints. If M is not diagonal, A is
    dense, and `Schur` solves the system.

    The number of iterations grows with the square root of the condition number of A. Few iterations
    suffice if few joints lie between each body and the ground. A chain of n links takes more than n
    iterations, and `Sparse` is then faster.

    The algorithm is the method of conjugate residuals: it minimizes the residual in the norm of the
    preconditioner. If redundant rows are consistent, λ is the solution of least norm. Constraint
    drift and rounding, amplified by the feedback of the stabilizer, make redundant rows slightly
    inconsistent. λ is then the least-squares solution of least norm. The status is CONFLICT if rows
    contradict each other: if the residual exceeds 1% of the size of b and J M⁻¹ f, plus rounding.

    The status is NOT_CONVERGED if the residual is neither below the tolerance nor minimal. It is
    SINGULAR if M is not positive definite.

    The solution is differentiated implicitly, by a second solve with the same number of iterations.

    Attributes:
        tikhonov: ε of a regularized system (A + ε diag A) λ = b − J M⁻¹ f, or None; see `Sparse`.
        tolerance: the residual at which the iteration of a world stops, relative to the right-hand
            side, in the norm of the preconditioner. A tolerance of 0.1 or more accepts rough
            solutions, whose error the feedback of later steps corrects. None takes the machine
            precision to the power ⅔: 2e-5 in float32, 4e-11 in float64.
        iterations: the number of iterations, the same for all worlds.

    References:
        Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 9.1 and section 10.2.
        Kaasschieter, Preconditioned conjugate gradients for solving singular systems, Journal of
            Computational and Applied Mathematics 24 (1988).
    """

    tikhonov: Scalar | None = None
    tolerance: Scalar | None = None
    iterations: int = static(default=100)

    def check(self) -> None:
        """Checks the regularization, the tolerance and the number of iterations.

        Raises:
            ValueError: `tikhonov`, `tolerance` or `iterations` is out of range.
        """
        checks.check("ConjugateGradients", "tikhonov", self.tikhonov, (), least=0, optional=True)
        checks.count("ConjugateGradients", "iterations", self.iterations)
        checks.check("ConjugateGradients", "tolerance", self.tolerance, (), least=0, optional=True)

    def factor(self, system: Saddle) -> Factored:
        """Prepares the preconditioner for repeated solves.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        if not system.target.size:
            return free_motion(system)
        if not isinstance(system.mass, Diagonal):
            return Schur(self.tikhonov).factor(system)
        j, delassus = system.jacobian, Delassus(system, self.tikhonov)
        preconditioner, dtype = block_jacobi(*delassus.matrices), system.force.dtype
        tolerance = self.tolerance
        if tolerance is None:
            tolerance = float(jnp.finfo(dtype).eps) ** (2 / 3)
        tolerance = freeze(jnp.asarray(tolerance, dtype))
        length = jnp.sqrt(scaled(system, 1e-6))

        def solve(force: Array, target: Array) -> Solution:
            free = system.mass.solve(force)
            multipliers, (left, solved, beyond) = jax.lax.custom_linear_solve(
                delassus,
                target - j.apply(free),
                lambda a, x: descend(
                    a, preconditioner, x, tolerance, self.iterations, system.loops
                ),
                symmetric=True,
                has_aux=True,
            )
            acceleration = free + system.mass.solve(j.transpose(multipliers))
            status = judge(acceleration, system.mass.singular)
            late = jnp.where(jnp.logical_or(solved, beyond), Status.OK, Status.NOT_CONVERGED)
            status = first(status, late.astype(status.dtype))
            if system.loops:
                conflict = conflicts(system, force, target, left, length, CONTRADICTING)
                conflict = jnp.where(solved, Status.OK, conflict).astype(status.dtype)
                status = first(status, conflict)
            return Solution(acceleration, multipliers, status)

        return solve


def descend(
    a: Operator,
    preconditioner: Operator,
    b: Array,
    tolerance: Array,
    iterations: int,
    singular: bool = True,
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Minimizes the residual r = b − A x in the norm of P⁻¹, by conjugate residuals from x = 0.

    Each iteration minimizes ‖r‖ over all search directions p so far, with z = P⁻¹ r. The step size
    zᵀA z / ‖A p‖² does not depend on the part of r outside the range of A. The step size of plain
    conjugate gradients, ‖r‖² / pᵀA p, depends on that part and diverges once it dominates r.

    The iteration of a world stops when ‖r‖ reaches the tolerance, or when ‖r‖ is minimal. If ‖r‖ is
    minimal, r has no part in the range of A, and z lies in the null space of A. The component of x
    along z is then an error, proportional to ‖r‖ and to the condition number. Removing this
    component leaves the x with the least norm xᵀP x.

    Args:
        a: x → A x, symmetric and positive semidefinite.
        preconditioner: r → P⁻¹ r.
        b: the right-hand side, (n_c, …).
        tolerance: the bound on ‖r‖ / ‖b‖, one number for all worlds or one for each world.
        iterations: the number of iterations.
        singular: True if A may be singular. If False, small eigenvalues are taken to come from
            heavy loads, and the test for a minimal ‖r‖ is skipped.

    Returns:
        x: the solution, (n_c, …).
        A tuple of three arrays: the residual r, (n_c, …); a mask of the worlds whose ‖r‖ reached
        the tolerance; and a mask of the worlds whose ‖r‖ is minimal, but above the tolerance.

    References:
        Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 6.20.
        Liu, Milzarek and Roosta, Obtaining pseudo-inverse solutions with MINRES (2023).
    """
    information = jnp.finfo(b.dtype)
    # eigenvalues of P⁻¹A up to this count as zero, as in `RankSafe`
    zero = 1e-9 if information.bits == 64 else 1e-5

    def dot(x: Array, y: Array) -> Array:
        """Returns the inner product xᵀy in each world."""
        return jnp.sum(x * y, axis=0)

    def is_least(size: Array, z: Array, az: Array, paz: Array) -> Array:
        """Returns a mask of the worlds whose residual r has its minimal norm ‖r‖² = rᵀP⁻¹ r.

        The gradient A z, with z = P⁻¹ r, is then small compared with ‖r‖, or zᵀA z is at the level
        of rounding errors.

        Args:
            size: ‖r‖².
            z: P⁻¹ r.
            az: A z.
            paz: P⁻¹ A z.
        """
        flat = dot(az, paz) <= zero * zero * size
        return flat | (dot(z, az) <= 16 * float(information.eps) * size)

    z = preconditioner(b)
    az = a(z)
    paz = preconditioner(az)
    solved = tolerance * tolerance * dot(b, z)

    def advance(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, r, z, az, paz, p, ap, pap = state
        pull, size = dot(z, az), dot(r, z)
        stays = size <= solved
        if singular:
            stays |= is_least(size, z, az, paz)
        step = safe_divide(jnp.where(stays, 0, pull), dot(ap, pap))[None]
        x, r, z = x + step * p, r - step * ap, z - step * pap
        az = a(z)
        paz = preconditioner(az)
        more = safe_divide(dot(z, az), pull)[None]
        return x, r, z, az, paz, z + more * p, az + more * ap, paz + more * pap

    start = jnp.zeros_like(b), b, z, az, paz, z, az, paz
    x, r, z, az, paz, *_ = jax.lax.fori_loop(0, iterations, advance, start)
    size = dot(r, z)
    done = size <= solved
    if not singular:
        return x, (r, done, jnp.zeros_like(done))
    beyond = ~done & is_least(size, z, az, paz)
    share = safe_divide(jnp.where(beyond, dot(x, r), 0), size)
    return x - share[None] * z, (r, done, beyond)


def block_jacobi(jacobian: Jacobian, inverse_mass: Array, compliance: Array | None) -> Operator:
    """Returns the block Jacobi preconditioner r → P⁻¹ r.

    P is the block diagonal of A = J M⁻¹ Jᵀ + C, with one block for each constraint. Each diagonal
    entry is multiplied by 1 + √eps, so that blocks with dependent rows stay invertible. The
    diagonal entry of a row of zeros is set to 1.

    Args:
        jacobian: J.
        inverse_mass: the diagonal of M⁻¹, (n_v,).
        compliance: the diagonal of C, (n_c,); None if C is zero.
    """
    shapes = {block.start: block.shape for block in jacobian.blocks}
    diagonal = diagonal_blocks(jacobian, weighted(jacobian, inverse_mass), compliance)
    raised = 1 + float(jnp.finfo(inverse_mass.dtype).eps) ** 0.5
    factors = {
        start: blocks.ldl(
            [[*row[:-1], jnp.where(row[-1] == 0, 1, raised * row[-1])] for row in diagonal[start]]
        )
        for start in sorted(diagonal)
    }

    def solve(r: Array) -> Array:
        """Returns P⁻¹ r, (n_c,), by substitution in the factored blocks of P."""
        parts: list[Lane] = []
        for start, factor in factors.items():
            right = list(Vector.of_rows(r, start, *shapes[start]))
            y = blocks.scale(factor, blocks.forward(factor, right))
            parts += blocks.backward(factor, y)
        return jnp.concatenate(parts)

    return solve
