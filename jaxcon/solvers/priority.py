"""Constraints by priority: lower levels act in the null space of higher ones (chapter 3.5.3)."""

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
from jaxcon.core.typing import Array
from jaxcon.core.worlds import per_world
from jaxcon.solvers.saddle import Factored, Mass, Saddle, Solution, free_motion, judge
from jaxcon.solvers.schur import delassus

LEVELS = range(4)
"""0 is met first."""


def Priority(  # noqa: N802
    levels: Mapping[str, int], cutoff: Any = None, conflict: Any = None, damping: Any = None
) -> Lexicographic:
    """A solver that meets constraints level by level: see `Lexicographic`.

    Args:
        levels: from names of constraints, or shell patterns such as "leg_*", to a level from 0, the
            highest, to 3; where several match a name, the last one counts. Others have level 0.
        cutoff: as of `Lexicographic`.
        conflict: as of `Lexicographic`.
        damping: as of `Lexicographic`.

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
class Lexicographic(checks.Checked):
    """Solves M a = f + Jᵀλ with J a + C λ = b met level by level; `Priority` makes one.

    Of all accelerations that meet level 0, by least squares where its rows contradict each other,
    those that meet level 1 as well as is then possible, and so on; of what is left the one nearest
    to M⁻¹f in the metric of M (Gauss). A lower level acts in the null space N of those above it,
    taken in the metric of M,

        a ← a + N (J_k N)⁺ (b_k − J_k a),    N ← N − N (J_k N)⁺ J_k.

    This is block elimination of A = J M⁻¹ Jᵀ + C, level after level, with the pseudo-inverse of
    each pivot block S_k = J_k N M⁻¹ J_kᵀ + C_k, and is done so: M a = f + Jᵀλ then holds to
    rounding, and λ of each level is the one of least norm. Rows are compared in units of their own
    length √A_ii. Dense, for mechanisms of up to some hundreds of rows.

    Where a lower level comes to ask for what those above it no longer leave free, as an arm at the
    end of its reach does, J_k N loses rank, and what it asks for stays: S_k⁺ would answer without
    bound. Below the highest level, S_k⁺ is damped, by six rounds of (S² + μ²)⁻¹ S on what is left,
    three in each of two eliminations: the part (μ² / (σ² + μ²))⁶ is not met where S_k, its rows
    scaled, has the eigenvalue σ. The highest level is not damped, so that a mechanism passes its
    singular positions, and nothing below disturbs it. A level between gives way to those below it
    where it is damped, by some hundredths of what they ask for at angles around √μ.

    Rows with a compliance, as those of rotors and soft constraints, can always be met. The status
    is CONFLICT where the rows of one level contradict each other; a level that cannot be met
    because of those above it is what priorities are for, and no conflict. `report` names both.

    The gradient is that of the solution where no row changes between dependent and independent; an
    eigenvalue that counts as zero is held at zero, so that it is finite everywhere.

    Attributes:
        cutoff: eigenvalues of S_k, its rows scaled, that count as zero; if None, 1e-9 in float64
            and 1e-5 in float32; never below what rounding makes of zero, n_c times the precision.
        conflict: the part of b that a level may leave open on its own before it is a conflict; if
            None, 1e-2; infinite for no limit.
        damping: μ; a lower level gives way where its rows come within an angle of √μ of those
            above it; if None, 3e-3, which is 3 degrees; 0 for the pseudo-inverse as it is.
        levels: (pattern, level) of constraints.

    References:
        Siciliano and Slotine, A general framework for managing multiple tasks in highly redundant
            robotic systems, ICAR 1991.
        Khatib, A unified approach for motion and force control of robot manipulators (1987).
        Nakamura and Hanafusa, Inverse kinematic solutions with singularity robustness for robot
            manipulator control, ASME J. Dynamic Systems, Measurement and Control 108 (1986).
        Escande, Mansard and Wieber, Hierarchical quadratic programming, Int. J. Robotics Research
            33 (2014).
    """

    cutoff: Any = None
    conflict: Any = None
    damping: Any = None
    levels: tuple[tuple[str, int], ...] = static(default=())

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: one is negative or no number, or one but `conflict` is infinite.
        """
        for what in ("cutoff", "damping", "conflict"):
            x, finite = getattr(self, what), what != "conflict"
            checks.check("Priority", what, x, (), least=0, finite=finite, optional=True)

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status."""
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size:
            return free_motion(system)
        parts = self._parts(system)
        rank, dtype = system.target.ndim - 1, system.target.dtype
        usual = 1e-9 if jnp.finfo(dtype).bits == 64 else 1e-5, 3e-3, 1e-2
        given = self.cutoff, self.damping, self.conflict
        cutoff, damping, conflict = (
            jnp.full((1,) * rank, y, dtype) if x is None else jnp.asarray(x, dtype)
            for x, y in zip(given, usual, strict=True)
        )
        rounding = system.target.shape[0] * float(jnp.finfo(dtype).eps)
        known = per_world(partial(_factor, parts), rank)(
            system, jnp.maximum(cutoff, rounding), damping
        )
        solve = per_world(partial(_solve, parts), rank)
        return lambda force, target: solve(known, force, target, conflict)

    def _parts(self, system: Saddle) -> tuple[np.ndarray, ...]:
        """The numbers of the rows of each level, highest first.

        Raises:
            ValueError: a pattern matches no constraint, or rows have no names.
        """
        layout: Any = system.layout
        names = getattr(layout, "names", ())
        for pattern, _ in self.levels:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise ValueError(
                    f"Priority: there is no constraint '{pattern}'; there are {list(names)}."
                )
        level = np.zeros(system.jacobian.shape[0], int)
        for name in names:
            chosen = [k for pattern, k in self.levels if fnmatchcase(name, pattern)]
            if chosen:
                level[layout.rows(name)] = chosen[-1]
        parts = (np.flatnonzero(level == k) for k in LEVELS)
        return tuple(part for part in parts if part.size)


class Pivot(NamedTuple):
    """One level of the elimination.

    Attributes:
        inverse: S⁺, below the highest level damped.
        coupling: S⁺ times the block beside S, of the levels below.
        own: A A⁺ of the level alone: the projector on what its rows can be given together.
    """

    inverse: Array
    coupling: Array
    own: Array


class Eliminated(NamedTuple):
    """A scaled saddle system of one world, level by level.

    Attributes:
        mass: M.
        jacobian: J with rows in the order of levels, (n_c, n_v).
        delassus: A with rows scaled to A_ii = 1, (n_c, n_c).
        scale: 1/√A_ii, (n_c,).
        pivots: of the levels.
    """

    mass: Mass
    jacobian: Array
    delassus: Array
    scale: Array
    pivots: tuple[Pivot, ...]


def _factor(
    parts: tuple[np.ndarray, ...], system: Saddle, cutoff: Array, damping: Array
) -> Eliminated:
    """Factors the matrices of one world."""
    order = np.concatenate(parts)
    j = system.jacobian.dense()[order]
    compliance = None if system.compliance is None else system.compliance[order]
    a = delassus(system.mass, j, compliance)
    scale = numerics.safe_divide(1.0, numerics.safe_sqrt(jnp.diagonal(a)))
    a = a * scale[None] * scale[:, None]
    pivots, left, start = [], a, 0
    for part in parts:
        n = part.size
        pivot = left[:n, :n]
        inverse = damped(pivot, cutoff, damping) if start else pseudoinverse(pivot, cutoff)
        coupling = inverse @ left[:n, n:]
        alone = jax.lax.stop_gradient(a[start : start + n, start : start + n])
        own = inverse if start == 0 else pseudoinverse(alone, cutoff)
        pivots.append(Pivot(inverse, coupling, alone @ own))
        left = left[n:, n:] - left[n:, :n] @ coupling
        start += n
    return Eliminated(system.mass, j, a, scale, tuple(pivots))


def _solve(
    parts: tuple[np.ndarray, ...], known: Eliminated, force: Array, target: Array, conflict: Array
) -> Solution:
    """Solves for one world."""
    order = np.concatenate(parts)
    back = np.argsort(order)
    free = known.mass.solve(force)
    asked, moved = known.scale * target[order], known.scale * (known.jacobian @ free)
    right = asked - moved
    λ = _substitute(known.pivots, right)
    λ = known.scale * (λ + _substitute(known.pivots, right - known.delassus @ λ))
    acceleration = free + known.mass.solve(known.jacobian.T @ λ)
    code = judge(acceleration, known.mass.singular)
    size = jnp.abs(asked) + jnp.abs(moved)
    contradicting = jnp.where(
        _contradicts(known.pivots, right, size, conflict), Status.CONFLICT, Status.OK
    )
    return Solution(acceleration, λ[back], first(code, contradicting.astype(jnp.int32)))


def _substitute(pivots: tuple[Pivot, ...], right: Array) -> Array:
    """λ of A λ = r level by level: down with what each asks for, and back up with its price."""
    asked = []
    for pivot in pivots:
        n = pivot.inverse.shape[0]
        asked.append(pivot.inverse @ right[:n])
        right = right[n:] - pivot.coupling.T @ right[:n]
    λ = right
    for pivot, own in zip(reversed(pivots), reversed(asked), strict=True):
        λ = jnp.concatenate([own - pivot.coupling @ λ, λ])
    return λ


def _contradicts(pivots: tuple[Pivot, ...], right: Array, size: Array, bound: Array) -> Array:
    """Returns True where some level alone leaves open more than a share of what it asks for."""
    found, start = jnp.zeros((), bool), 0
    for pivot in pivots:
        rows = slice(start, start + pivot.inverse.shape[0])
        left = right[rows] - pivot.own @ right[rows]
        found |= jnp.max(jnp.abs(left)) > bound * jnp.max(size[rows])
        start = rows.stop
    return found


def damped(matrix: Array, cutoff: Array, damping: Array) -> Array:
    """(1 − (1 − D A)³) A⁺ with D = (A² + μ²)⁻¹ A, for A = Aᵀ: A⁺ where A is much above μ."""
    real, imaginary, _ = resolvent(matrix, cutoff, damping)
    lacking = damping * imaginary
    return (jnp.eye(len(matrix), dtype=matrix.dtype) + lacking + lacking @ lacking) @ real


def pseudoinverse(matrix: Array, cutoff: Array) -> Array:
    """A⁺ (n, n) of a symmetric A ≥ 0, eigenvalues up to a cutoff taken as zero."""
    return resolvent(matrix, cutoff, jnp.zeros_like(cutoff))[0]


@jax.custom_jvp
def resolvent(matrix: Array, cutoff: Array, damping: Array) -> tuple[Array, Array, Array]:
    """E and N of E − iN = (A + iμ)⁻¹ of a symmetric A ≥ 0, and A⁺, (n, n) each.

    E = A (A² + μ²)⁻¹ and N = μ (A² + μ²)⁻¹. Eigenvalues of A up to a cutoff are taken as zero, and
    give zero in all three. The derivative is that at constant rank, and goes through no
    eigenvector: with Z = E − iN and Q = 1 − A⁺A,

        dZ = −Z dA Z + Z A⁺ dA Q + Q dA A⁺ Z − i Z² dμ,

    of which A⁺ is the case μ = 0.

    References:
        Golub and Pereyra, The differentiation of pseudo-inverses and nonlinear least squares
            problems whose variables separate, SIAM J. Numerical Analysis 10 (1973).
    """
    values, vectors = jnp.linalg.eigh(matrix)
    kept = values > cutoff
    safe = jnp.where(kept, values, 1)
    square = safe * safe + damping * damping
    inverses = safe / square, damping / square, 1 / safe
    real, imaginary, inverse = (
        (vectors * jnp.where(kept, x, 0)[None]) @ vectors.T for x in inverses
    )
    return real, imaginary, inverse


@resolvent.defjvp
def _(primals: Any, tangents: Any) -> Any:
    (matrix, cutoff, damping), (change, _, dμ) = primals, tangents
    e, n, p = resolvent(matrix, cutoff, damping)
    turn = p @ change @ (jnp.eye(len(p), dtype=p.dtype) - p @ matrix)

    def turned(x: Array) -> Array:
        return x @ turn + (x @ turn).T

    de = n @ change @ n - e @ change @ e + turned(e) - 2 * e @ n * dμ
    dn = -(e @ change @ n + n @ change @ e) + turned(n) + (e @ e - n @ n) * dμ
    return (e, n, p), (de, dn, turned(p) - p @ change @ p)
