"""A solver by sparse block LDLᵀ of the Delassus matrix, along a plan made at trace time.

There are three stages:

- Once for each structure, on the host: `ordering.plan` builds the graph of A = J M⁻¹ Jᵀ and an
  elimination order, in steps of many nodes each.
- Once for each state: `Elimination` forms and factors the blocks of A. Small blocks are unrolled
  scalar formulas, equal nodes are vectorized, and runs of nodes are loops.
- Once for each right-hand side: `substitute` sweeps forward and backward along the order.

For a tree of joints, run time and compile time are proportional to the number of joints. No dense
matrix of the system is ever formed.
"""

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.jaxprs import traced_once
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear import ordering
from jaxcon.linear.delassus import Delassus
from jaxcon.linear.effort import structure_of
from jaxcon.linear.elimination import Elimination
from jaxcon.linear.roots import solve_symmetric
from jaxcon.linear.saddle import Diagonal, Factored, Saddle, Solution, free_motion, judge
from jaxcon.linear.schur import Schur
from jaxcon.protocols import Solver


@pytree
class Sparse(checks.Checked, Solver):
    """Solves M a = f + Jᵀλ, J a + C λ = b by sparse elimination of A = J M⁻¹ Jᵀ + C.

    The solution is differentiated implicitly, with A λ written as J (M⁻¹ (Jᵀ λ)) + C λ. Forward and
    reverse mode reuse the factorization and never differentiate it. If M is not diagonal, A is
    dense, and `Schur` solves the system.

    In trees of bodies in space, accelerations are computed by elimination of the motions that
    joints allow instead of rows (`TreeEquations`) where that is faster: for joints of up to
    three freedoms, with rotors, or if there are on average two equal joints or more at each depth.
    Joints of your own must say so (`Joint.relative`). Projection and `RATTLE` use the rows. In
    single precision, accelerations then err by the order of the drift φ of the joints, relative to
    the arms of the bodies, and in double precision by φ². `tikhonov`, `Unstabilized()`, and in
    single precision more than 12 joints in a row, exclude this.

    The status is SINGULAR if a row is a linear combination of other rows, to working precision.

    Attributes:
        tikhonov: ε of a regularized system (A + ε diag A) λ = b − J M⁻¹ f, or None. With ε,
            redundant rows have a solution, whose error is ε diag(A) λ. 1e-6 suits float32, 1e-10
            float64. The derivative treats ε diag A as constant.
        run: the smallest number of successive equal nodes for which a loop replaces unrolled code.
        order: "runs" for the fewest operations; "levels" for the fewest sequential steps, each of
            many nodes, which suits GPUs. None chooses by `jax.default_backend()`, even if a
            function is compiled for another device.

    References:
        Baraff, Linear-time dynamics using Lagrange multipliers, SIGGRAPH 1996.
        Davis, Direct Methods for Sparse Linear Systems (2006), chapters 4 and 7.
    """

    tikhonov: Scalar | None = None
    run: int = static(default=ordering.RUN)
    order: str | None = static(default=None)

    def check(self) -> None:
        """Checks the regularization, the run length and the elimination order.

        Raises:
            ValueError: `tikhonov` or `run` is out of range, or `order` is unknown.
        """
        checks.check("Sparse", "tikhonov", self.tikhonov, (), least=0, optional=True)
        checks.count("Sparse", "run", self.run)
        if self.order is not None and self.order not in ordering.ORDERS:
            raise ValueError(
                f"Sparse: order must be one of {list(ordering.ORDERS)}, got {self.order!r}."
            )

    def factor(self, system: Saddle) -> Factored:
        """Factors A = J M⁻¹ Jᵀ + C for repeated solves.

        Returns:
            A function (f, b) → `Solution`, for forces f, (n_v,), and targets b, (n_c,).
        """
        if not system.target.size:
            return free_motion(system)
        if not isinstance(system.mass, Diagonal):
            return Schur(self.tikhonov).factor(system)
        rounding = len(system.target) * float(jnp.finfo(system.force.dtype).eps)
        return self.checked(system, 0.0 if self.tikhonov is not None else rounding)[0]

    def checked(
        self, system: Saddle, share: float, leaves_out: bool = False
    ) -> tuple[Factored, Array]:
        """Factors A and tests each row for dependence on earlier rows.

        Args:
            system: the saddle system, with a diagonal M.
            share: the threshold of the test. A row is dependent if its pivot is at most `share`
                times its diagonal entry of A.
            leaves_out: True to leave dependent rows out; False to give status SINGULAR.

        Returns:
            A function (f, b) → `Solution`; and True for each world whose rows are independent, ().
        """
        j, delassus = system.jacobian, Delassus(system, self.tikhonov)
        plan = ordering.plan(structure_of(j), self.run, self.order or suits_device())
        batch = system.force.shape[1:]
        elimination = Elimination(delassus.matrices, plan, batch, share, leaves_out)
        independent = elimination.margin > 0
        dependent = system.mass.singular
        if not leaves_out:
            dependent = dependent | (~independent & elimination.finite)

        multiply, substitute = traced_once(delassus), traced_once(elimination.substitute)

        def solve(force: Array, target: Array) -> Solution:
            free = system.mass.solve(force)
            right = target - j.apply(free)
            multipliers = solve_symmetric(multiply, right, substitute)
            acceleration = free + system.mass.solve(j.transpose(multipliers))
            return Solution(acceleration, multipliers, judge(acceleration, dependent))

        return solve, independent


def suits_device() -> str:
    """Returns the elimination order for the default device: "runs" on a CPU, otherwise "levels"."""
    return "runs" if jax.default_backend() == "cpu" else "levels"
