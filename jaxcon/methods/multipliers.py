"""Constraints satisfied by the method of multipliers (augmented Lagrangian; chapter 3.5.2)."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.dependence import depends
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status, first
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.proximal import (
    RankSafe,
    conflicts,
    own_diagonal,
    proximal,
    remainder,
    row_weights,
    scaled,
)
from jaxcon.linear.saddle import Saddle, Solution
from jaxcon.methods.baumgarte import Baumgarte, Wrapper, check_stabilizer
from jaxcon.methods.gains import check_gains, column, zeros_by_row
from jaxcon.protocols import Solver, System
from jaxcon.system.state import State

OPEN = 0.25
"""The residual of the rounds, as a fraction of b, above which the solver tests if b can be met.

If `RankSafe.conflict` is smaller, it is used instead.
"""


@exportable
class Held(NamedTuple):
    """The memory of an `AugmentedLagrangian`.

    Attributes:
        multipliers: multipliers λ of the last step, (n_c,).
        feedback: memory of the feedback stabilizer.
    """

    multipliers: Array
    feedback: PyTree


@pytree
class AugmentedLagrangian(checks.Checked, Wrapper):
    """Springs whose rest position moves until the rows are satisfied: λ⁺ = λ + (b − J a)/W.

    A round solves (A + W) λ⁺ = r + W λ with W = A_ii/stiffness. Here A is J M⁻¹ Jᵀ + C, and r is
    the right-hand side of A λ = r. The first round starts from the λ of the last step. Let σ be an
    eigenvalue of A in units of A_ii. Each round multiplies the error of λ along its eigenvector by
    1/(1 + σ·stiffness). Each round solves a soft system, but λ converges to the λ of the rigid
    system. Every round is solvable, even if rows are linearly dependent or a mechanism passes a
    singular position. `stiffness` bounds the condition of the system. Rounds share one
    factorization. The λ of the last step is a good guess, so one or two rounds are enough. The
    feedback chooses b.

    After k rounds, λ has followed a change of b by the fraction e = 1 − 1/(1 + σ·stiffness)ᵏ.
    Feedback therefore lags by τ = h/e. Without a remedy, an error would obey

        τ φ⃛ + φ̈ + 2α φ̇ + g β² φ = 0, stable for τ g β² < 2α, with g = 1.

    With the default gains 2α = β = 1/h this needs e > 1. Errors with a small σ, as in chains of
    some links, would grow. The part of b that depends on φ is therefore multiplied by g =
    σ·stiffness/(1 + σ·stiffness), or by g² for k = 1. This is the fraction of it that one round
    from λ = 0 satisfies. Then τ g ≤ h/2 for small σ, and g is 1 for large σ. Steps are stable for
    every stiffness and σ if the gains are stable for rigid rows.

    Derivatives are those of the computed rounds. Rotors constrain nothing and are solved directly.
    Contradictory rows are satisfied in the least-squares sense. If the residual exceeds a quarter
    of b, `RankSafe` solves once more to test whether b can be met. If it cannot, the status is
    CONFLICT.

    Attributes:
        stiffness: stiffness of the springs in units of the effective mass of a row, 1/A_ii.
        feedback: the stabilizer that chooses b.
        iterations: number of rounds in a step.

    References:
        Hestenes, Multiplier and gradient methods, Journal of Optimization Theory and Applications
            (1969).
        Bayo, García de Jalón and Serna, A modified Lagrangian formulation for the dynamic analysis
            of constrained mechanical systems, Computer Methods in Applied Mechanics and Engineering
            (1988).
    """

    stiffness: Any = 100.0
    feedback: Any = Baumgarte()
    iterations: int = static(default=2)
    inner_field: ClassVar[str] = "feedback"

    def check(self) -> None:
        """Checks the stiffness, the number of rounds and the feedback.

        Raises:
            TypeError: the feedback is not a stabilizer.
            ValueError: the stiffness is not positive, or the number of rounds is not positive.
        """
        check_gains("AugmentedLagrangian", {"above": 0}, optional=False, stiffness=self.stiffness)
        checks.count("AugmentedLagrangian", "iterations", self.iterations)
        check_stabilizer("AugmentedLagrangian", "feedback", self.feedback)

    def constraint_equations(self, rows: Rows, memory: Held, dt: Array) -> Rows:
        """Returns the constraint equations of the feedback, which `solve` satisfies in rounds."""
        return self.feedback.constraint_equations(rows, memory.feedback, dt)

    def solve(
        self, solver: Solver, rows: Rows, memory: Held, dt: Array, system: Saddle
    ) -> Solution:
        """Solves for a and λ in a fixed number of rounds, starting from the λ of the last step."""

        def target_of(residual: Array) -> Array:
            moved = dataclasses.replace(rows, residual=residual)
            return self.constraint_equations(moved, memory, dt).right_hand_side

        due_to_position, start = None, memory.multipliers
        if depends(target_of, rows.residual):
            due_to_position = target_of(rows.residual) - target_of(jnp.zeros_like(rows.residual))
        if not system.target.size:
            return solver.solve(system)
        rank_safe = solver if isinstance(solver, RankSafe) else RankSafe(solver)
        solver = rank_safe.solver  # W makes every round solvable
        # after few rounds, the solution and its derivative still depend on W
        stiffness = finite_or_nan(jnp.asarray(self.stiffness, start.dtype))[None]
        weight = row_weights(system, 1e-6) / stiffness
        weight = jnp.where(column(rows.layout.holds, rows), weight, 0)
        rounds = proximal(solver, system, weight, self.iterations)
        target = system.target
        if due_to_position is not None:
            # the part of b that one round from λ = 0 meets, A (A + W)⁻¹ b
            once, part = proximal(solver, system, weight, 1), due_to_position
            rest, still = jnp.zeros_like(part), jnp.zeros_like(system.force)
            for _ in range(2 if self.iterations == 1 else 1):  # g² for k = 1, see the docstring
                part = part - weight * once(still, part, rest).multipliers
            target = target - due_to_position + part
        # a row with J = 0 and C = 0, as of a distance of length 0, would get a huge λ by W
        acts = own_diagonal(system.mass, system.jacobian, target.ndim - 1)
        acts = (acts if system.compliance is None else acts + system.compliance) != 0
        solution = rounds(system.force, jnp.where(acts, target, 0), jnp.where(acts, start, 0))
        if not system.loops:
            return solution
        # CONFLICT if b cannot be met; tested only where the residual is a large part of b
        left, length = remainder(system, system.target, solution), jnp.sqrt(scaled(system, 1e-6))
        share = OPEN if rank_safe.conflict is None else jnp.minimum(OPEN, rank_safe.conflict)
        code = conflicts(system, system.force, system.target, left, length, share)
        met = code == Status.OK

        def tested() -> Array:
            code = dataclasses.replace(rank_safe, always=True).solve(system).status
            return jnp.where(met | (code != Status.CONFLICT), Status.OK, code).astype(jnp.int32)

        code = jax.lax.cond(everywhere(met), lambda: jnp.zeros_like(solution.status), tested)
        return solution._replace(status=first(solution.status, code))

    def init(self, system: System, q: Array, v: Array) -> Held:
        """Returns the memory at the start: zero multipliers λ, and the memory of the feedback."""
        return Held(zeros_by_row(system, q, v), self.feedback.init(system, q, v))

    def advance(self, rows: Rows, memory: Held, dt: Array) -> Held:
        """Advances the memory of the feedback; the multipliers do not change."""
        return memory._replace(feedback=self.feedback.advance(rows, memory.feedback, dt))

    def remember(self, memory: Held, solution: Solution) -> Held:
        """Returns the memory with the multipliers λ of the step just solved."""
        feedback = self.feedback.remember(memory.feedback, solution)
        return Held(solution.multipliers, feedback)

    def correct(
        self,
        system: System,
        solver: Solver,
        before: State,
        state: State,
        memory: Held,
        dt: Array,
    ) -> tuple[State, Array]:
        """Returns the state corrected by the feedback, and a status."""
        return self.feedback.correct(system, solver, before, state, memory.feedback, dt)
