"""A solver with constraint priorities: lower levels act in the null space of higher levels.

See chapter 3.5.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, numerics
from jaxcon.core.pytree import pytree, static
from jaxcon.core.status import Status, first
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear.saddle import Factored, Mass, Saddle, Solution, free_motion, judge
from jaxcon.linear.schur import delassus
from jaxcon.protocols import Solver
from jaxcon.staging.worlds import per_world

LEVELS = range(4)
"""The allowed priority levels; 0 is the highest priority."""


def Priority(  # noqa: N802
    levels: Mapping[str, int],
    cutoff: Scalar | None = None,
    conflict: Scalar | None = None,
    damping: Scalar | None = None,
) -> Lexicographic:
    """Returns a solver that satisfies constraints by priority level; see `Lexicographic`.

    Args:
        levels: the priority level by constraint name, or by shell pattern such as "leg_*". Levels
            go from 0, the highest priority, to 3. If several patterns match a name, the last one
            counts. Constraints that match no pattern have level 0.
        cutoff: see `Lexicographic`.
        conflict: see `Lexicographic`.
        damping: see `Lexicographic`.

    Raises:
        ValueError: a level is not 0, 1, 2 or 3.
    """
    if not isinstance(levels, Mapping):
        raise ValueError(
            "Priority: levels must be a mapping of names of constraints to levels, got"
            f" {checks.shortened(levels)}."
        )
    for name, level in levels.items():
        whole = isinstance(level, int | np.integer) and not isinstance(level, bool)
        if not isinstance(name, str) or not whole or level not in LEVELS:
            raise ValueError(
                f"Priority: the level of '{name}' must be 0, 1, 2 or 3, got {level!r}."
            )
    pairs = tuple((str(name), int(level)) for name, level in levels.items())
    return Lexicographic(cutoff, conflict, damping, pairs)


@pytree
class Lexicographic(checks.Checked, Solver):
    """Solves M a = f + Jᵀλ and J a + C λ = b by priority level; constructed by `Priority`.

    Level 0 is solved first, by least squares if its rows contradict each other. Among the remaining
    accelerations, level 1 is satisfied as well as possible, and so on. Of the accelerations that
    remain, the solution is the one nearest to M⁻¹f in the metric of M (Gauss). Level k acts in the
    null space of the levels above it. With N the projector onto that null space in the metric of M,

        a ← a + N (J_k N)⁺ (b_k − J_k a),    N ← N − N (J_k N)⁺ J_k.

    The implementation eliminates A = J M⁻¹ Jᵀ + C block by block, level after level. It uses the
    pseudo-inverse of each pivot block S_k = J_k N M⁻¹ J_kᵀ + C_k. M a = f + Jᵀλ then holds to
    rounding, and the λ of each level has the least norm. Rows are scaled by their length √A_ii. The
    matrices are dense, so the solver suits mechanisms of up to a few hundred rows.

    Higher levels may leave no freedom to a lower level, as for an arm at the end of its reach. Then
    J_k N loses rank while the target b_k stays, and S_k⁺ grows without bound. Below the highest
    level, S_k⁺ is therefore replaced by three rounds of a damped iteration, with the approximate
    inverse (S² + μ²)⁻¹ S. The system is solved twice, the second time for the residual. Along an
    eigenvector of the scaled S_k with eigenvalue σ, the fraction (μ² / (σ² + μ²))⁶ of the target is
    not met.

    The highest level is not damped: the mechanism passes singular positions, and no lower level
    disturbs it. A damped intermediate level yields slightly to the levels below it. If its rows are
    at angles around √μ to rows of higher levels, its error is a few hundredths of the targets of
    the lower levels.

    Rows with a compliance, such as rows of rotors and soft constraints, can always be satisfied.
    The status is CONFLICT if the rows of one level contradict each other. A level that cannot be
    satisfied because of higher levels is not a conflict. `report` names the constraints in both
    cases.

    The gradient is exact while no row changes between dependent and independent. Eigenvalues that
    count as zero are held at zero, so that the gradient is finite everywhere.

    Attributes:
        cutoff: the largest eigenvalue of the scaled S_k that counts as zero. None takes 1e-9 in
            float64 and 1e-5 in float32. It is raised to n_c times the machine precision.
        conflict: the residual above which the rows of a level contradict each other, relative to b
            and J M⁻¹ f. None takes 1e-2; infinity disables the test.
        damping: μ. A lower level yields where its rows come within an angle of √μ [rad] of the rows
            above it. None takes 3e-3 (3 degrees); 0 gives the undamped pseudo-inverse.
        levels: pairs (pattern of constraint names, level).

    References:
        Siciliano and Slotine, A general framework for managing multiple tasks in highly redundant
            robotic systems, ICAR 1991.
        Khatib, A unified approach for motion and force control of robot manipulators (1987).
        Nakamura and Hanafusa, Inverse kinematic solutions with singularity robustness for robot
            manipulator control, ASME J. Dynamic Systems, Measurement and Control 108 (1986).
        Escande, Mansard and Wieber, Hierarchical quadratic programming, Int. J. Robotics Research
            33 (2014).
    """

    cutoff: Scalar | None = None
    conflict: Scalar | None = None
    damping: Scalar | None = None
    levels: tuple[tuple[str, int], ...] = static(default=())

    def check(self) -> None:
        """Checks the cutoff, the damping and the conflict threshold.

        Raises:
            ValueError: a value is negative or no number, or `cutoff` or `damping` is infinite.
        """
        for what in ("cutoff", "damping", "conflict"):
            x, finite = getattr(self, what), what != "conflict"
            checks.check("Priority", what, x, (), least=0, finite=finite, optional=True)

    def factor(self, system: Saddle) -> Factored:
        """Factors A = J M⁻¹ Jᵀ + C level by level, for repeated solves.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).

        Raises:
            ValueError: a pattern matches no constraint, or rows have no names.
        """
        if not system.target.size:
            return free_motion(system)
        layout: Any = system.layout
        names = getattr(layout, "names", ())
        for pattern, _ in self.levels:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise ValueError(
                    f"Priority: there is no constraint '{pattern}'; there are {list(names)}."
                )
        level = np.zeros(system.jacobian.shape[0], int)
        for name in names:
            for pattern, k in self.levels:
                if fnmatchcase(name, pattern):
                    level[layout.rows(name)] = k
        parts = tuple(part for k in LEVELS if (part := np.flatnonzero(level == k)).size)
        rank, dtype = system.target.ndim - 1, system.target.dtype
        default = 1e-9 if jnp.finfo(dtype).bits == 64 else 1e-5, 3e-3, 1e-2
        given = self.cutoff, self.damping, self.conflict
        cutoff, damping, conflict = (
            jnp.full((1,) * rank, y, dtype) if x is None else jnp.asarray(x, dtype)
            for x, y in zip(given, default, strict=True)
        )
        cutoff = jnp.maximum(cutoff, len(system.target) * float(jnp.finfo(dtype).eps))
        factored = per_world(partial(_factor, parts), rank)(system, cutoff, damping)
        solve = per_world(partial(_solve, parts), rank)
        return lambda force, target: solve(factored, force, target, conflict)


class Pivot(NamedTuple):
    """One priority level in the block elimination of A = J M⁻¹ Jᵀ + C.

    Attributes:
        inverse: S⁺, the pseudo-inverse of the pivot block S; damped below the highest level.
        coupling: S⁺ times the block of A that couples the level to the levels below it.
        own: A A⁺ of the diagonal block A of this level: the projector onto the right-hand sides
            that the rows of the level can satisfy together.
    """

    inverse: Array
    coupling: Array
    own: Array


Eliminated = tuple[Mass, Array, Array, Array, list[Pivot]]
"""One factored world: M, J, A scaled to A_ii = 1, the scale 1/√A_ii, and the pivots by level."""


def _factor(
    parts: tuple[np.ndarray, ...], system: Saddle, cutoff: Array, damping: Array
) -> Eliminated:
    """Factors A = J M⁻¹ Jᵀ + C of one world, level by level.

    Args:
        parts: the row numbers of each level, highest priority first.
        system: the saddle system, of which M, J and C are used.
        cutoff: the largest eigenvalue that counts as zero, ().
        damping: μ, ().
    """
    order = np.concatenate(parts)
    j = system.jacobian.dense()[order]
    a = delassus(system.mass, j, None if system.compliance is None else system.compliance[order])
    scale = numerics.safe_divide(1.0, numerics.safe_sqrt(jnp.diagonal(a)))
    a = a * scale[None] * scale[:, None]
    pivots, left, start = [], a, 0
    for part in parts:
        n, end = part.size, start + part.size
        pivot = left[:n, :n]
        inverse = damped(pivot, cutoff, damping) if start else pseudoinverse(pivot, cutoff)
        coupling = inverse @ left[:n, n:]
        alone = jax.lax.stop_gradient(a[start:end, start:end])
        own = pseudoinverse(alone, cutoff) if start else inverse
        pivots.append(Pivot(inverse, coupling, alone @ own))
        left = left[n:, n:] - left[n:, :n] @ coupling
        start = end
    return system.mass, j, a, scale, pivots


def _solve(
    parts: tuple[np.ndarray, ...], factored: Eliminated, force: Array, target: Array, bound: Array
) -> Solution:
    """Solves the factored system of one world.

    Args:
        parts: the row numbers of each level, highest priority first.
        factored: the result of `_factor`.
        force: f, (n_v,).
        target: b, (n_c,).
        bound: the residual of a level above which its rows conflict, relative to b and J M⁻¹ f, ().
    """
    (mass, j, a, scale, pivots), order = factored, np.concatenate(parts)

    def substitute(right: Array) -> Array:
        """Solves A λ = r, by elimination from the highest level down and back substitution."""
        answers = []
        for pivot in pivots:
            n = len(pivot.inverse)
            answers.append(pivot.inverse @ right[:n])
            right = right[n:] - pivot.coupling.T @ right[:n]
        λ = right
        for pivot, answer in zip(reversed(pivots), reversed(answers), strict=True):
            λ = jnp.concatenate([answer - pivot.coupling @ λ, λ])
        return λ

    free = mass.solve(force)
    wanted, moved = scale * target[order], scale * (j @ free)
    right = wanted - moved
    λ = substitute(right)
    λ = scale * (λ + substitute(right - a @ λ))
    acceleration = free + mass.solve(j.T @ λ)
    size, contradicts, start = jnp.abs(wanted) + jnp.abs(moved), jnp.zeros((), bool), 0
    for pivot in pivots:
        rows = slice(start, start + len(pivot.inverse))
        left = right[rows] - pivot.own @ right[rows]
        contradicts |= jnp.max(jnp.abs(left)) > bound * jnp.max(size[rows])
        start = rows.stop
    conflict = jnp.where(contradicts, Status.CONFLICT, Status.OK).astype(jnp.int32)
    status = first(judge(acceleration, mass.singular), conflict)
    return Solution(acceleration, λ[np.argsort(order)], status)


def damped(matrix: Array, cutoff: Array, damping: Array) -> Array:
    """Returns the damped pseudo-inverse (1 − (1 − D A)³) A⁺ of a symmetric matrix A, (n, n).

    D = (A² + μ²)⁻¹ A, with the damping μ. The result approaches A⁺ for eigenvalues of A far above
    μ. Eigenvalues up to the cutoff count as zero.
    """
    real, imaginary, _ = resolvent(matrix, cutoff, damping)
    lacking = damping * imaginary
    return (jnp.eye(len(matrix), dtype=matrix.dtype) + lacking + lacking @ lacking) @ real


def pseudoinverse(matrix: Array, cutoff: Array) -> Array:
    """Returns the pseudo-inverse A⁺, (n, n), of a symmetric positive semidefinite matrix A.

    Eigenvalues up to the cutoff count as zero.
    """
    return resolvent(matrix, cutoff, jnp.zeros_like(cutoff))[0]


@jax.custom_jvp
def resolvent(matrix: Array, cutoff: Array, damping: Array) -> tuple[Array, Array, Array]:
    """Returns E and N of the resolvent Z = (A + iμ)⁻¹ = E − iN, and A⁺, (n, n) each.

    A is symmetric and positive semidefinite, E = A (A² + μ²)⁻¹ and N = μ (A² + μ²)⁻¹. Eigenvalues
    of A up to the cutoff count as zero: their eigenvectors contribute nothing to E, N and A⁺. The
    derivative assumes constant rank, and does not differentiate eigenvectors. With Q = 1 − A⁺A,

        dZ = −Z dA Z + Z A⁺ dA Q + Q dA A⁺ Z − i Z² dμ.

    The derivative of A⁺ is the case μ = 0.

    References:
        Golub and Pereyra, The differentiation of pseudo-inverses and nonlinear least squares
            problems whose variables separate, SIAM J. Numerical Analysis 10 (1973).
    """
    values, vectors = jnp.linalg.eigh(matrix)
    nonzero = values > cutoff
    safe = jnp.where(nonzero, values, 1)
    square = safe * safe + damping * damping
    real, imaginary, inverse = (
        (vectors * jnp.where(nonzero, x, 0)[None]) @ vectors.T
        for x in (safe / square, damping / square, 1 / safe)
    )
    return real, imaginary, inverse


@resolvent.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> Any:
    (matrix, cutoff, damping), (change, _, dμ) = primals, tangents
    e, n, p = resolvent(matrix, cutoff, damping)
    turn = p @ change @ (jnp.eye(len(p), dtype=p.dtype) - p @ matrix)

    def turned(x: Array) -> Array:
        """Returns X A⁺ dA Q + Q dA A⁺ X for a symmetric matrix X; see `resolvent`."""
        return x @ turn + (x @ turn).T

    de = n @ change @ n - e @ change @ e + turned(e) - 2 * e @ n * dμ
    dn = -(e @ change @ n + n @ change @ e) + turned(n) + (e @ e - n @ n) * dμ
    return (e, n, p), (de, dn, turned(p) - p @ change @ p)
