"""Solutions of dependent rows by proximal iteration (chapter 3.5.4)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status, failed, first
from jaxcon.core.typing import Array
from jaxcon.core.worlds import keep, per_world
from jaxcon.solvers.delassus import diagonal
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.saddle import Diagonal, Factored, Mass, Saddle, Solution
from jaxcon.solvers.schur import delassus
from jaxcon.solvers.sparse import Sparse


@pytree
class RankSafe(checks.Checked):
    """Solves J a + C λ = b also where rows depend on each other, by proximal iteration.

    (A + ε W) λ⁺ = r + ε W λ from λ = 0, with r = b − J M⁻¹ f and W = max(diag A, w² max diag A):
    what an eigenvalue σ of A scaled by W lacks after k rounds is (ε / (σ + ε))ᵏ of its part. Rows
    that are independent feel no regularization, dependent ones that agree get the acceleration of
    the independent ones and, of all λ, the one of least norm in the scaled rows, and singular
    positions are passed with finite λ. Rows that contradict each other are met by least squares,
    and say so: `Status.CONFLICT`. The gradient is that of the iteration as it is, with W held; all
    rounds share one factorization. A scene without closed loops is solved directly.

    Attributes:
        solver: `Sparse()`, `Schur()`, `Dense()` or `ConjugateGradients()`.
        share: ε; if None, 1e-9 in float64 and 1e-5 in float32.
        rounds: k.
        scaling: w, the least length of a row beside the longest one; if None, 1e-6.
        conflict: the part of b and J M⁻¹ f that least squares may leave before it is called a
            conflict; if None, a hundredth; infinite for no limit.
        always: also where the structure has no loops, for rows that depend on each other by their
            numbers alone.

    References:
        Carpentier, Budhiraja and Mansard, Proximal and sparse resolution of constrained dynamic
            equations, Robotics: Science and Systems (2021).
        Parikh and Boyd, Proximal algorithms (2014), section 4.1.
    """

    solver: Any = Sparse()
    share: Any = None
    scaling: Any = None
    conflict: Any = None
    rounds: int = static(default=3)
    always: bool = static(default=False)

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: there are no rounds, or a number is out of range.
            TypeError: the solver is none, or no solver of independent rows.
        """
        checks.count("RankSafe", "rounds", self.rounds)
        checks.flag("RankSafe", "always", self.always)
        for what in ("share", "scaling", "conflict"):
            x, finite = getattr(self, what), what != "conflict"
            checks.check("RankSafe", what, x, (), least=0, finite=finite, optional=True)
        wrong = isinstance(self.solver, type | RankSafe) or not hasattr(self.solver, "factor")
        if wrong or hasattr(self.solver, "levels"):
            raise TypeError(
                "RankSafe: solver must be Sparse(), Schur(), Dense() or ConjugateGradients(), got"
                f" {checks.shortened(self.solver)}."
            )
        if hasattr(self.solver, "check"):
            self.solver.check()

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status."""
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size or not (system.loops or self.always):
            return self.solver.factor(system)
        if not isinstance(self.solver, Sparse) or not isinstance(system.mass, Diagonal):
            return self._iterated(system)
        margin = float(jnp.finfo(system.target.dtype).eps) ** (3 / 8)
        direct, independent = self.solver.checked(system, margin, leaves_out=True)

        def solve(force: Array, target: Array) -> Solution:
            known = direct(force, target)
            # numbers that are not finite stay so: such a world is not worth the rounds of all
            settled = independent | failed(known.status)

            def rescued() -> Solution:
                return keep(settled, known, self._iterated(system)(force, target))

            return jax.lax.cond(everywhere(settled), lambda: known, rescued)

        return solve

    def _iterated(self, system: Saddle) -> Factored:
        """The solution by proximal iteration, as a function of f and b.

        It is done twice: what the first one leaves of b is taken out of it for the second, which
        otherwise would bring 1/ε of it into λ.
        """
        floor = 1e-6 if self.scaling is None else self.scaling
        weight = self._share(system.target.dtype) * scaled(system, floor)
        iterate = proximal(self.solver, system, weight, self.rounds)
        length = jnp.sqrt(weight)

        def solve(force: Array, target: Array) -> Solution:
            def twice(right: Array, _: Any) -> Any:
                solution = iterate(force, right, jnp.zeros_like(right))
                return right - remainder(system, right, solution), solution

            met, found = jax.lax.scan(twice, target, None, length=2)
            solution = jax.tree.map(lambda x: x[1], found)
            share = 1e-2 if self.conflict is None else jnp.asarray(self.conflict, target.dtype)
            code = conflicts(system, force, target, target - met, length, share)
            return solution._replace(status=first(solution.status, code))

        return solve

    def _share(self, dtype: Any) -> Any:
        """ε, a number or one by world (1, …)."""
        if self.share is None:
            return 1e-9 if jnp.finfo(dtype).bits == 64 else 1e-5
        return jnp.asarray(self.share, dtype)[None]


def proximal(solver: Any, system: Saddle, weight: Array, rounds: int) -> Any:
    """The function (f, b, λ₀) → solution after some rounds of (A + W) λ⁺ = r + W λ.

    Each is a saddle system whose compliance is C + W and whose target is b + W λ. It is also the
    method of multipliers for constraints held by springs of stiffness 1/W.

    Args:
        solver: with `factor`.
        system: M, J and C.
        weight: W, (n_c,).
        rounds: how many.
    """
    compliance = weight if system.compliance is None else system.compliance + weight
    solve = solver.factor(dataclasses.replace(system, compliance=compliance))

    def iterate(force: Array, target: Array, multipliers: Array) -> Solution:
        batch = jnp.broadcast_shapes(force.shape[1:], target.shape[1:], weight.shape[1:])
        start = jnp.broadcast_to(multipliers, (len(target), *batch))
        if rounds == 1:
            return solve(force, target + weight * start)

        def once(known: Solution, _: Any) -> tuple[Solution, None]:
            return solve(force, target + weight * known.multipliers), None

        code = jnp.zeros(batch, jnp.int32)
        unknown = Solution(jnp.zeros((len(force), *batch), force.dtype), start, code)
        return jax.lax.scan(once, unknown, None, length=rounds)[0]

    return iterate


def scaled(system: Saddle, floor: Any) -> Array:
    """W = max(diag A, w² max diag A), (n_c,), constant under differentiation."""
    return jax.lax.stop_gradient(row_weights(system, floor))


def row_weights(system: Saddle, floor: Any) -> Array:
    """W = max(diag A, w² max diag A), (n_c,)."""
    own = own_diagonal(system.mass, system.jacobian, system.target.ndim - 1)
    if system.compliance is not None:
        own = own + system.compliance
    least = jnp.asarray(floor, own.dtype) ** 2 * jnp.max(own, axis=0)
    return jnp.maximum(own, least[None])


def own_diagonal(mass: Mass, jacobian: Jacobian, worlds: int) -> Array:
    """diag(J M⁻¹ Jᵀ), (n_c,): one over the mass that each row feels.

    Args:
        mass: M.
        jacobian: J.
        worlds: how many trailing axes enumerate worlds.
    """
    if isinstance(mass, Diagonal):
        return diagonal(jacobian, 1 / mass.diagonal)
    return per_world(_diagonal, worlds)(mass, jacobian)


def _diagonal(mass: Mass, jacobian: Jacobian) -> Array:
    return jnp.diagonal(delassus(mass, jacobian.dense(), None))


def conflicts(
    system: Saddle, force: Array, target: Array, left: Array, length: Array, share: Any
) -> Array:
    """CONFLICT where more of b is left open than rounding and a share of b and J M⁻¹ f, by world.

    Where the stabilizer does not say what b may be off by rounding, it is that of the terms of
    J M⁻¹ f, which may cancel: gravity asks nothing of a joint between bodies that fall together.

    Args:
        system: M, J and C.
        force: f, (n_v,).
        target: b, (n_c,).
        left: of b, (n_c,).
        length: in which rows are compared, (n_c,).
        share: what may be left, a number or one by world.
    """
    free = system.mass.solve(force)
    asked = jnp.abs(target) + jnp.abs(system.jacobian.apply(free))
    size = jnp.max(asked / length, axis=0)
    rounding = system.noise
    if rounding is None:
        rounding = 64 * float(jnp.finfo(target.dtype).eps) * system.jacobian.reach(free)
    allowed = (share * size)[None] * length + rounding
    conflict = jnp.any(jnp.abs(left) > allowed, axis=0)
    return jnp.where(conflict, Status.CONFLICT, Status.OK).astype(jnp.int32)


def remainder(system: Saddle, target: Array, solution: Solution) -> Array:
    """b − J a − C λ, (n_c,)."""
    moved = system.jacobian.apply(solution.acceleration)
    if system.compliance is not None:
        moved = moved + system.compliance * solution.multipliers
    return target - moved
