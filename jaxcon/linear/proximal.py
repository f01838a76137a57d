"""A solver for dependent constraint rows, by proximal iteration (chapter 3.5.4)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status, failed, first
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear.delassus import diagonal
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.saddle import Diagonal, Factored, Mass, Saddle, Solution
from jaxcon.linear.schur import delassus
from jaxcon.linear.sparse import Sparse
from jaxcon.protocols import Solver
from jaxcon.staging.worlds import per_world, where_tree


@pytree
class RankSafe(checks.Checked, Solver):
    """Solves M a = f + Jᵀλ, J a + C λ = b with dependent rows allowed, by proximal iteration.

    The iteration is (A + ε W) λ⁺ = r + ε W λ from λ = 0. Here A = J M⁻¹ Jᵀ + C, r = b − J M⁻¹ f,
    and W is the diagonal weight max(diag A, w² max diag A). After k rounds, the relative error
    along an eigenvector of the scaled A with eigenvalue σ is (ε / (σ + ε))ᵏ. All rounds share one
    factorization.

    The regularization of independent rows is negligible. Consistent dependent rows do not change
    the acceleration, and λ has the least norm in the scaled rows. At singular positions, λ stays
    finite. Contradictory rows are solved by least squares, with status CONFLICT. The gradient is
    that of the iteration, with W held constant. A scene without closed loops is solved directly.

    Attributes:
        solver: the solver of each round: `Sparse()`, `Schur()`, `Dense()` or
            `ConjugateGradients()`.
        share: ε. None takes 1e-9 in float64 and 1e-5 in float32.
        rounds: k, the number of rounds.
        scaling: w, the lower bound on the length of a row, relative to the longest row. None takes
            1e-6.
        conflict: the least-squares residual above which rows conflict, relative to b and J M⁻¹ f.
            None takes 1e-2; infinity disables the test.
        always: True to iterate also if the structure has no closed loops, for rows that become
            dependent by their numerical values alone.

    References:
        Carpentier, Budhiraja and Mansard, Proximal and sparse resolution of constrained dynamic
            equations, Robotics: Science and Systems (2021).
        Parikh and Boyd, Proximal algorithms (2014), section 4.1.
    """

    solver: Solver = Sparse()
    share: Array | float | None = None
    scaling: Array | float | None = None
    conflict: Array | float | None = None
    rounds: int = static(default=3)
    always: bool = static(default=False)

    def check(self) -> None:
        """Checks all attributes and the inner solver.

        Raises:
            ValueError: there are no rounds, or a number is out of range.
            TypeError: `solver` is not a `Sparse`, `Schur`, `Dense` or `ConjugateGradients`.
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
        checks.derives("RankSafe", "solver", self.solver, Solver)
        self.solver.check()

    def factor(self, system: Saddle) -> Factored:
        """Factors the system for repeated solves.

        With `Sparse` and a diagonal M, all worlds are first solved directly. The proximal iteration
        runs only if some world has dependent rows, and only changes the solutions of such worlds.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        if not system.target.size or not (system.loops or self.always):
            return self.solver.factor(system)
        if not isinstance(self.solver, Sparse) or not isinstance(system.mass, Diagonal):
            return self._iterated(system)
        margin = float(jnp.finfo(system.target.dtype).eps) ** (3 / 8)
        direct, independent = self.solver.checked(system, margin, leaves_out=True)

        def each(solve: Factored) -> Factored:
            return column_by_column(solve) if system.has_columns else solve

        def solve(force: Array, target: Array) -> Solution:
            solution = each(direct)(force, target)
            # failed worlds need no iteration: they must not make the whole batch iterate
            settled = independent | failed(solution.status)
            return jax.lax.cond(
                everywhere(settled),
                lambda: solution,
                lambda: where_tree(settled, solution, each(self._iterated(system))(force, target)),
            )

        return solve

    def _iterated(self, system: Saddle) -> Factored:
        """Prepares the proximal iteration for repeated solves.

        The iteration runs twice. If rows contradict each other, a residual remains, and its 1/ε
        multiple enters λ. The second run therefore subtracts the residual of the first run from b.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        dtype = system.target.dtype
        share = 1e-9 if jnp.finfo(dtype).bits == 64 else 1e-5
        if self.share is not None:
            share = jnp.asarray(self.share, dtype)[None]
        weight = share * scaled(system, 1e-6 if self.scaling is None else self.scaling)
        iterate = proximal(self.solver, system, weight, self.rounds)
        length = jnp.sqrt(weight)

        def solve(force: Array, target: Array) -> Solution:
            def iterate_once(before: tuple[Array, Solution], _: None) -> Any:
                right = before[0]
                solution = iterate(force, right, jnp.zeros_like(right))
                return (right - remainder(system, right, solution), solution), None

            start = target, unsolved(force, target, weight.shape[1:])
            (met, solution), _ = jax.lax.scan(iterate_once, start, None, length=2)
            limit = 1e-2 if self.conflict is None else jnp.asarray(self.conflict, dtype)
            code = conflicts(system, force, target, target - met, length, limit)
            return solution._replace(status=first(solution.status, code))

        return solve


def column_by_column(solve: Factored) -> Factored:
    """Returns a solver of many right-hand sides that loops over them.

    The program then contains the solver once, for a single right-hand side.

    Args:
        solve: solver of f, (n_v, k, …), and b, (n_c, k, …), for k right-hand sides.
    """

    def solve_each(force: Array, target: Array) -> Solution:
        if force.shape[1] == target.shape[1] == 1:
            return solve(force, target)

        def column(_: None, right: tuple[Array, Array]) -> tuple[None, Solution]:
            a, λ, code = solve(*(x[:, None] for x in right))
            return None, Solution(a[:, 0], λ[:, 0], code[0])

        count = max(force.shape[1], target.shape[1])
        forces, targets = (
            jnp.moveaxis(jnp.broadcast_to(x, (len(x), count, *x.shape[2:])), 1, 0)
            for x in (force, target)
        )
        a, λ, code = jax.lax.scan(column, None, (forces, targets))[1]
        return Solution(jnp.moveaxis(a, 0, 1), jnp.moveaxis(λ, 0, 1), code)

    return solve_each


def proximal(
    solver: Solver, system: Saddle, weight: Array, rounds: int
) -> Callable[[Array, Array, Array], Solution]:
    """Returns a function (f, b, λ₀) → `Solution` that iterates (A + W) λ⁺ = r + W λ.

    A = J M⁻¹ Jᵀ + C and r = b − J M⁻¹ f. Each round solves a saddle system with compliance C + W
    and target b + W λ. This is also the method of multipliers, for constraints that are enforced by
    springs of stiffness 1/W.

    Args:
        solver: the solver of each round.
        system: the saddle system, of which M, J and C are used.
        weight: W, (n_c,).
        rounds: the number of rounds.
    """
    compliance = weight if system.compliance is None else system.compliance + weight
    solve = solver.factor(dataclasses.replace(system, compliance=compliance))

    def iterate(force: Array, target: Array, multipliers: Array) -> Solution:
        unknown = unsolved(force, target, weight.shape[1:])
        start = jnp.broadcast_to(multipliers, unknown.multipliers.shape)
        if rounds == 1:
            return solve(force, target + weight * start)
        unknown = unknown._replace(multipliers=start)
        return jax.lax.scan(
            lambda known, _: (solve(force, target + weight * known.multipliers), None),
            unknown,
            None,
            length=rounds,
        )[0]

    return iterate


def unsolved(force: Array, target: Array, batch: tuple[int, ...]) -> Solution:
    """Returns a solution of zeros, from which an iteration starts.

    Args:
        force: f, (n_v,).
        target: b, (n_c,).
        batch: the trailing batch axes of other numbers of the system.
    """
    batch = jnp.broadcast_shapes(force.shape[1:], target.shape[1:], batch)
    code = jnp.zeros(batch, jnp.int32)
    acceleration, multipliers = (jnp.zeros((len(x), *batch), x.dtype) for x in (force, target))
    return Solution(acceleration, multipliers, code)


def scaled(system: Saddle, floor: Scalar) -> Array:
    """Returns the proximal weight of each row, (n_c,), constant under differentiation.

    Args:
        system: the saddle system.
        floor: the lower bound on the length of a row; see `row_weights`.
    """
    return jax.lax.stop_gradient(row_weights(system, floor))


def row_weights(system: Saddle, floor: Scalar) -> Array:
    """Returns the proximal weight of each row, W = max(diag A, w² max diag A), (n_c,).

    Args:
        system: the saddle system, with A = J M⁻¹ Jᵀ + C.
        floor: w, the lower bound on the length of a row, relative to the longest row.
    """
    weight = own_diagonal(system.mass, system.jacobian, system.target.ndim - 1)
    if system.compliance is not None:
        weight = weight + system.compliance
    least = jnp.asarray(floor, weight.dtype) ** 2 * jnp.max(weight, axis=0)
    return jnp.maximum(weight, least[None])


def own_diagonal(mass: Mass, jacobian: Jacobian, worlds: int) -> Array:
    """Returns the diagonal of J M⁻¹ Jᵀ, (n_c,): the inverse effective mass of each row.

    Args:
        mass: M.
        jacobian: J.
        worlds: the number of trailing batch axes.
    """
    if isinstance(mass, Diagonal):
        return diagonal(jacobian, 1 / mass.diagonal)
    return per_world(lambda m, j: jnp.diagonal(delassus(m, j.dense(), None)), worlds)(
        mass, jacobian
    )


def conflicts(
    system: Saddle, force: Array, target: Array, left: Array, length: Array, share: Array | float
) -> Array:
    """Returns the status of each world: CONFLICT if a residual is too large, otherwise OK.

    The limit on the residual is its rounding error plus `share` times the size of b and J M⁻¹ f. If
    `system.noise` is None, the rounding error is estimated from the sum of the absolute terms of
    J M⁻¹ f. The terms may cancel, as gravity does in a joint between bodies that fall together, but
    their rounding errors do not.

    Args:
        system: the saddle system.
        force: f, (n_v,).
        target: b, (n_c,).
        left: the residual b − J a − C λ, (n_c,).
        length: the scale of each row, (n_c,).
        share: the allowed residual relative to the size of b and J M⁻¹ f; one number for all
            worlds, or one for each world.
    """
    free = system.mass.solve(force)
    terms = jnp.abs(target) + jnp.abs(system.jacobian.apply(free))
    size = jnp.max(terms / length, axis=0)
    rounding = system.noise
    if rounding is None:
        rounding = 64 * float(jnp.finfo(target.dtype).eps) * system.jacobian.reach(free)
    allowed = (share * size)[None] * length + rounding
    conflict = jnp.any(jnp.abs(left) > allowed, axis=0)
    return jnp.where(conflict, Status.CONFLICT, Status.OK).astype(jnp.int32)


def remainder(system: Saddle, target: Array, solution: Solution) -> Array:
    """Returns the residual b − J a − C λ, (n_c,), of a solution (a, λ) for a target b."""
    moved = system.jacobian.apply(solution.acceleration)
    if system.compliance is not None:
        moved = moved + system.compliance * solution.multipliers
    return target - moved
