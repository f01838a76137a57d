"""The saddle system of a constrained system, and its accelerations and multipliers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.bound_layout import Reactions
from jaxcon.constraints.bounds import BoundRows, linearize_bounds
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import status
from jaxcon.core.lanes import widened
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.parts import Part, Struck
from jaxcon.dynamics.reactions import Impulse
from jaxcon.solvers.nearest_rows import Nearest
from jaxcon.solvers.saddle import Factored, Saddle, Solution


def saddle(
    system: Any, q: Array, rows: Rows, force: Array, target: Array, noise: Any = None
) -> Saddle:
    """M a = f + Jᵀλ, J a + C λ = b.

    Args:
        system: with `mass(q)`.
        q: positions, (n_q,).
        rows: the linearized constraints.
        force: f, (n_v,).
        target: b, (n_c,).
        noise: what b may be off by rounding; see `Saddle`.

    Returns:
        What a solver takes.
    """
    mass = system.mass(q) if rows.mass is None else rows.mass
    compliance, layout = rows.compliance, rows.layout
    return Saddle(mass, force, rows.jacobian, target, compliance, noise, layout.loops, layout)


@dataclass(frozen=True)
class Dynamics:
    """What an integrator sees of a system under control and feedback, during one step.

    Attributes:
        system: as remembered by the state.
        stabilizer: with all its gains.
        solver: of the saddle system.
        control: u.
        memory: of the stabiliser.
        dt: h, () [s].
        bounded: the solver of bounded rows; None where there are none.
        guess: their multipliers a step ago, (n,); None where they are not kept.
        held: what they do over the whole step, once it is known, (n_v,).
        part: of the step that is advanced; None for all of it.
    """

    system: Any
    stabilizer: Any
    solver: Any
    control: PyTree
    memory: PyTree
    dt: Any
    bounded: Any = None
    guess: Any = None
    held: Any = None
    part: Part | None = None

    def __call__(self, q: Array, v: Array, t: Any, age: Any = None) -> tuple[Solution, Rows]:
        """a and λ at (q, v, t), and the rows there; feedback sees their rates `age` [s] ago."""
        rows, law, problem = self._problem(q, v, t, age)
        if self.bounded is not None:
            return self._reacted(q, v, t, rows, law, problem, leaps=age is not None)[:2]
        own = self.solver.solve(problem) if law.solve is None else law.solve(self.solver, problem)
        return self.system.complete(own), rows

    def begun(self, q: Array, v: Array, t: Any) -> tuple[Solution, Rows, Dynamics]:
        """The same at the start of a step, and what the rest of it sees.

        Bounded rows contain the step: they are solved once, and act as a force that stays.
        """
        if self.bounded is None:
            return *self(q, v, t), self
        rows, law, problem = self._problem(q, v, t, None)
        solution, rows, force, _ = self._reacted(q, v, t, rows, law, problem)
        return solution, rows, dataclasses.replace(self, bounded=None, held=force)

    def _reacted(
        self,
        q: Array,
        v: Array,
        t: Any,
        rows: Rows,
        law: Any,
        problem: Saddle,
        leaps: bool = False,
    ) -> tuple[Solution, Rows, Array, Factored]:
        """a and λ with inequality rows, the rows with λ of these, their force, and the factors."""
        if self.part is None:
            bounds, length, acts = self.bounds(q, v, t, self.dt), self.dt, None
        else:
            bounds, acts = self.part.ask(lambda dt: self.bounds(q, v, t, dt), self.dt)
            length = self.part.length
        leaps &= bounds.restitution is not None
        weight = self.system.weight(q) if leaps else None
        impulse = self._impulse(bounds, law, problem, length, acts, weight)
        known = impulse.react(self.bounded, self.guess)
        solution = self.system.complete(impulse.motion(known.multipliers))
        solution = solution._replace(status=status.first(solution.status, impulse.judge()))
        known = self._judged(impulse, known, solution.acceleration)
        own = impulse.rows.jacobian.transpose(known.multipliers)
        solve = partial(impulse.beside_stops, known.multipliers)
        return solution, dataclasses.replace(rows, reactions=known), own, solve

    def bounds(self, q: Array, v: Array, t: Any, dt: Any) -> BoundRows:
        """The bounded rows, and what a step of dt wants of them."""
        return linearize_bounds(self.system, q, v, t, self.control, dt)

    def unbounded(self, q: Array, v: Array, t: Any) -> Array:
        """a without bounded rows."""
        _, law, problem = self._problem(q, v, t, None)
        return self._factors(law, problem)(problem.force, law.target).acceleration

    def impact(self, q: Array, v: Array, t: Any, struck: Struck) -> tuple[Array, Reactions]:
        """Δv of an impact, and its impulses [N s, N m s] in the place of multipliers.

        Time stands still, and forces have none of it: M Δv = J_eᵀ Λ_e + Jᵀ Λ, J_e Δv + C Λ_e = 0.
        """
        _, law, problem = self._problem(q, v, t, None)
        rows, acts = struck.ask(self.bounds(q, v, t, self.dt), self.dt)
        none = jnp.zeros_like(problem.force), jnp.zeros_like(law.target)
        still = dataclasses.replace(problem, force=none[0], target=none[1])
        impulse = self._impulse(rows, law, still, jnp.ones_like(self.dt), acts)
        known = impulse.react(self.bounded, None)
        jump = impulse.change(known.multipliers)
        return jump, self._judged(impulse, known, jump)

    def factored(
        self, q: Array, v: Array, t: Any, age: Any = None
    ) -> tuple[Solution, Rows, Callable[[Array], Solution] | None]:
        """As the call, and b → the least a, in the metric of M, with J a + C λ = b.

        It uses the factors of the step. It is None where the stabilizer solves by itself.
        """
        rows, law, problem = self._problem(q, v, t, age)
        if self.bounded is not None:
            solution, rows, _, solve = self._reacted(
                q, v, t, rows, law, problem, leaps=age is not None
            )
        elif law.solve is not None:
            return self.system.complete(law.solve(self.solver, problem)), rows, None
        else:
            solve = self._factors(law, problem)
            solution = self.system.complete(solve(problem.force, law.target))
        return solution, rows, lambda target: solve(0 * problem.force, target)

    def _impulse(
        self,
        rows: BoundRows,
        law: Any,
        problem: Saddle,
        dt: Any,
        acts: Any,
        weight: Array | None = None,
    ) -> Impulse:
        """How bounded rows act, by factors of wide lanes, to which the solver's numbers belong."""
        wide = dataclasses.replace(self, solver=widened(self.solver, problem.force.ndim - 1))
        factor = partial(wide._factors, law)
        return Impulse.of(rows, factor, problem, dt, acts, weight, self._leaves_out(rows))

    def _judged(self, impulse: Impulse, known: Reactions, acceleration: Array) -> Reactions:
        """The reactions with what is missed by rows that were left out."""
        if not self._leaves_out(impulse.rows):
            return known
        missed = impulse.overlooked(known.multipliers, acceleration)
        return dataclasses.replace(known, residual=jnp.maximum(known.residual, missed))

    def _leaves_out(self, rows: BoundRows) -> bool:
        """Whether only some of the rows are solved."""
        return isinstance(self.bounded, Nearest) and self.bounded.leaves_out(rows.kinds)

    def _factors(self, law: Any, problem: Saddle) -> Factored:
        """The solution as a function of f and b.

        Raises:
            ValueError: the stabiliser solves by itself, without factors to be used again.
        """
        if law.solve is not None:
            raise ValueError(
                "bounded rows solve with the factors of the step, and AugmentedLagrangian has"
                " rounds of its own; take Baumgarte(), or do without them."
            )
        return self.solver.factor(problem)

    def _problem(self, q: Array, v: Array, t: Any, age: Any) -> tuple[Rows, Any, Saddle]:
        """The rows, the law of the stabiliser, and the saddle system of both."""
        rows = dataclasses.replace(linearize(self.system, q, v, t), mass=self.system.mass(q))
        law = self.stabilizer.impose(
            rows if age is None else rows.earlier(age), self.memory, self.dt
        )
        force = self.system.force(q, v, t, self.control)
        force = force if law.force is None else force + law.force
        force = force if self.held is None else force + self.held
        return rows, law, saddle(self.system, q, law.rows, force, law.target, law.noise)
