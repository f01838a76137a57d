"""Block LDLᵀ of the Delassus matrix by a plan found when tracing.

Three tiers. Once for each structure, on the host: the graph of A = J M⁻¹ Jᵀ and an elimination
order, as steps that each take many nodes (`ordering.plan`). Once for each state: the blocks of A
and their factorization, small blocks in unrolled scalar formulas, equal nodes side by side, runs of
them in a loop (`Elimination`). For each right side: one sweep down the order and one back
(`substitute`). A tree of joints costs and compiles in proportion to its joints, and no matrix of
the size of the system is ever formed.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.solvers import ordering
from jaxcon.solvers.delassus import Delassus
from jaxcon.solvers.elimination import Elimination
from jaxcon.solvers.saddle import Diagonal, Factored, Saddle, Solution, free_motion, judge
from jaxcon.solvers.schur import Schur


@pytree
class Sparse(checks.Checked):
    """Solves M a = f + Jᵀλ, J a + C λ = b by sparse elimination of A = J M⁻¹ Jᵀ + C.

    The solution is differentiated implicitly, with A λ written as J (M⁻¹ (Jᵀ λ)) + C λ: forward and
    reverse mode reuse the factorization and never differentiate it. Where M is not diagonal A is
    dense, and `Schur` takes over.

    Attributes:
        tikhonov: ε of a regularised system (A + ε diag A) λ = b − J M⁻¹ f, or None; gives redundant
            rows a solution, which holds them to ε λ. 1e-6 suits float32, 1e-10 float64. The
            derivative is that of the regularised system with diag A held.
        run: equal nodes in a row from which a loop is used instead of unrolled code.
        order: "runs" for the fewest operations; "levels" for the fewest steps one after another,
            each of many nodes, which suits GPUs; None for what suits `jax.default_backend()`,
            whatever the device a function is then compiled for.

    References:
        Baraff, Linear-time dynamics using Lagrange multipliers, SIGGRAPH 1996.
        Davis, Direct Methods for Sparse Linear Systems (2006), chapters 4 and 7.
    """

    tikhonov: Any = None
    run: int = static(default=ordering.RUN)
    order: str | None = static(default=None)

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            ValueError: one is out of range, or there is no such order.
        """
        checks.check("Sparse", "tikhonov", self.tikhonov, (), least=0, optional=True)
        checks.count("Sparse", "run", self.run)
        if self.order is not None and self.order not in ordering.ORDERS:
            raise ValueError(
                f"Sparse: order must be one of {list(ordering.ORDERS)}, got {self.order!r}."
            )

    def solve(self, system: Saddle) -> Solution:
        """The acceleration (n_v,), multipliers (n_c,) and status.

        The status is SINGULAR where a row is, to working precision, a combination of others.
        """
        return self.factor(system)(system.force, system.target)

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b."""
        if not system.target.size:
            return free_motion(system)
        if not isinstance(system.mass, Diagonal):
            return Schur(self.tikhonov).factor(system)
        rounding = len(system.target) * float(jnp.finfo(system.force.dtype).eps)
        return self.checked(system, 0.0 if self.tikhonov is not None else rounding)[0]

    def checked(
        self, system: Saddle, share: float, leaves_out: bool = False
    ) -> tuple[Factored, Array]:
        """The solution as a function of f and b, and whether all rows are independent.

        Args:
            system: M, diagonal, J and C.
            share: of the diagonal entry of a row, what other rows must leave of it.
            leaves_out: whether other rows are solved without those that are not; if not, the status
                is SINGULAR.
        """
        j, delassus = system.jacobian, Delassus(system, self.tikhonov)
        structure = tuple((b.start, b.shape[0], b.columns) for b in j.blocks)
        plan = ordering.plan(structure, self.run, self.order or suits_device())
        batch = system.force.shape[1:]
        elimination = Elimination(delassus.matrices, plan, batch, share, leaves_out)
        independent = elimination.margin > 0
        dependent = system.mass.singular
        if not leaves_out:
            dependent = dependent | (~independent & elimination.finite)

        def solve(force: Array, target: Array) -> Solution:
            free = system.mass.solve(force)
            multipliers = jax.lax.custom_linear_solve(
                delassus,
                target - j.apply(free),
                lambda _, x: elimination.substitute(x),
                symmetric=True,
            )
            acceleration = free + system.mass.solve(j.transpose(multipliers))
            return Solution(acceleration, multipliers, judge(acceleration, dependent))

        return solve, independent


def suits_device() -> str:
    """The order of elimination for the default device."""
    return "runs" if jax.default_backend() == "cpu" else "levels"
