"""Constraints held by the method of multipliers (chapter 3.5.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, layout_of
from jaxcon.core import checks
from jaxcon.core.dependence import depends
from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.somewhere import everywhere
from jaxcon.core.status import Status, first
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.solvers.proximal import (
    RankSafe,
    conflicts,
    own_diagonal,
    proximal,
    remainder,
    row_weights,
    scaled,
)
from jaxcon.solvers.saddle import Saddle, Solution
from jaxcon.stabilization.baumgarte import Baumgarte, Law, Unstabilized, check_stabilizer
from jaxcon.stabilization.gains import check_gains, column

OPEN = 0.25
"""The part of b that rounds may leave open before it is asked whether all of it can be met.

A smaller `conflict` of a `RankSafe` takes its place.
"""


@exportable
class Held(NamedTuple):
    """What the method of multipliers remembers: λ of the last step (n_c,), and the feedback's."""

    multipliers: Array
    feedback: PyTree


@pytree
class AugmentedLagrangian(Unstabilized):
    """λ⁺ = λ + (b − J a)/W: springs whose rest point gives way until the rows hold.

    Rounds of (A + W) λ⁺ = r + W λ with W = A_ii/stiffness, from the λ of the last step. An
    eigenvalue σ of A, in units of A_ii, leaves 1/(1 + σ·stiffness) of the error of λ after each
    round: a soft system with the multipliers of a hard one. Every round is solvable, also where
    rows depend on each other or a mechanism passes a singular position, and stiffness bounds how
    stiff it is; rounds share one factorization. Each step starts from the λ of the last one, which
    is near, so that one or two rounds do. b is that of the feedback.

    In its k rounds a step meets the share e = 1 − 1/(1 + σ·stiffness)ᵏ of a change of b, so that
    feedback lags behind by τ = h/e. With the whole of b, an error would obey

        τ φ⃛ + φ̈ + 2α φ̇ + g β² φ = 0, stable for τ g β² < 2α, with g = 1.

    With the default gains 2α = β = 1/h this is e > 1: all errors of small σ, which chains of some
    links have, would grow. The part of b that is due to φ is therefore taken down to what one round
    from λ = 0 meets of it, g = σ·stiffness/(1 + σ·stiffness), or g² where k = 1. Then τ g ≤ h/2 for
    small σ, and g is 1 for large σ: steps are stable for every stiffness and σ for which the gains
    suit hard rows.

    The derivative is that of the rounds as they are. Rotors, which hold nothing, are solved as they
    are. Rows that contradict each other are met by least squares. Where more than a quarter of b is
    left open, `RankSafe` tells, once more and by itself, whether b can be met; if not, the status
    is CONFLICT.

    Attributes:
        stiffness: in units of the mass that a row feels, 1/A_ii.
        feedback: stabiliser that says what b is.
        iterations: rounds a step.

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

    def check(self) -> None:
        """Checks the numbers.

        Raises:
            TypeError: the feedback is no stabiliser.
            ValueError: the stiffness is not positive, or there is no round.
        """
        check_gains("AugmentedLagrangian", strictly=True, optional=False, stiffness=self.stiffness)
        checks.count("AugmentedLagrangian", "iterations", self.iterations)
        check_stabilizer("AugmentedLagrangian", "feedback", self.feedback)

    def init(self, system: Any, q: Array, v: Array) -> Held:
        """λ = 0."""
        layout = layout_of(system, q, v, jnp.zeros((), q.dtype))
        return Held(jnp.zeros(layout.size, q.dtype), self.feedback.init(system, q, v))

    def resolve(self, gains: tuple[Any, Any]) -> AugmentedLagrangian:
        """Returns the stabilizer with the gains of the feedback resolved."""
        return dataclasses.replace(self, feedback=self.feedback.resolve(gains))

    def bounded(self, stable_rate: Callable[[float], Any]) -> AugmentedLagrangian:
        """Returns the stabilizer with the gains of the feedback bounded."""
        return dataclasses.replace(self, feedback=self.feedback.bounded(stable_rate))

    def target(self, rows: Rows, memory: Held, dt: Any) -> Array:
        """b (n_c,) of the feedback."""
        return self.feedback.target(rows, memory.feedback, dt)

    def impose(self, rows: Rows, memory: Held, dt: Any) -> Law:
        """The law of the feedback, solved in rounds."""

        def asked(residual: Array) -> Law:
            moved = dataclasses.replace(rows, residual=residual)
            return self.feedback.impose(moved, memory.feedback, dt)

        law, place = asked(rows.residual), None
        if depends(lambda residual: asked(residual).target, rows.residual):
            place = law.target - asked(jnp.zeros_like(rows.residual)).target
        solve = partial(self._rounds, rows, memory.multipliers, place)
        return law._replace(solve=solve)

    def _rounds(
        self, rows: Rows, start: Array, place: Array | None, solver: Any, system: Saddle
    ) -> Solution:
        if not system.target.size:
            return solver.solve(system)
        judge = solver if isinstance(solver, RankSafe) else RankSafe(solver)
        solver = judge.solver  # W is enough
        holding = rows.layout.holds
        # few rounds leave a trace of W in the solution, and so in its derivative
        stiffness = finite_or_nan(jnp.asarray(self.stiffness, start.dtype))[None]
        weight = row_weights(system, 1e-6) / stiffness
        weight = jnp.where(column(holding, rows), weight, 0)
        rounds = proximal(solver, system, weight, self.iterations)
        asked = system
        if place is not None:
            within = self._within_reach(solver, system, weight, place)
            system = dataclasses.replace(system, target=system.target - place + within)
        acts = _acts(system)  # of the others W alone would make λ, huge, for the next step to feel
        target, start = (jnp.where(acts, x, 0) for x in (system.target, start))
        solution = rounds(system.force, target, start)
        if not system.loops:
            return solution
        return solution._replace(
            status=first(solution.status, _contradiction(judge, asked, solution))
        )

    def _within_reach(self, solver: Any, system: Saddle, weight: Array, place: Array) -> Array:
        """The part of b due to φ that a round from λ = 0 meets, A (A + W)⁻¹ b, (n_c,).

        With a single round a step, it is the part of that part: its lag is twice that of two.
        """
        once = proximal(solver, system, weight, 1)
        rest, still = jnp.zeros_like(place), jnp.zeros_like(system.force)
        for _ in range(2 if self.iterations == 1 else 1):
            place = place - weight * once(still, place, rest).multipliers
        return place

    def advance(self, rows: Rows, memory: Held, dt: Any) -> Held:
        """With the memory of the feedback after the step."""
        return memory._replace(feedback=self.feedback.advance(rows, memory.feedback, dt))

    def remember(self, memory: Held, solution: Solution) -> Held:
        """With the λ of the step."""
        own = self.feedback.remember(memory.feedback, solution)
        return Held(solution.multipliers, own)

    @property
    def corrects(self) -> tuple[str, ...]:
        """What the feedback moves after a step."""
        return self.feedback.corrects

    def correct(
        self, system: Any, solver: Any, before: State, state: State, memory: Held, dt: Any
    ) -> Any:
        """As the feedback does."""
        return self.feedback.correct(system, solver, before, state, memory.feedback, dt)


def _contradiction(judge: RankSafe, system: Saddle, solution: Solution) -> Array:
    """CONFLICT in worlds whose b cannot be met, which is asked where much of it is left open."""
    left = remainder(system, system.target, solution)
    length = jnp.sqrt(scaled(system, 1e-6))
    share = OPEN if judge.conflict is None else jnp.minimum(OPEN, judge.conflict)
    met = conflicts(system, system.force, system.target, left, length, share) == Status.OK

    def asked() -> Array:
        code = dataclasses.replace(judge, always=True).solve(system).status
        return jnp.where(met | (code != Status.CONFLICT), Status.OK, code).astype(jnp.int32)

    return jax.lax.cond(everywhere(met), lambda: jnp.zeros_like(solution.status), asked)


def _acts(system: Saddle) -> Array:
    """Which rows have a direction or compliance; those of a distance without length have none."""
    own = own_diagonal(system.mass, system.jacobian, system.target.ndim - 1)
    return (own if system.compliance is None else own + system.compliance) != 0
