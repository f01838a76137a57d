"""The saddle system of a constrained system, and its accelerations and multipliers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core.typing import Array, PyTree
from jaxcon.solvers.saddle import Saddle, Solution


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
    """

    system: Any
    stabilizer: Any
    solver: Any
    control: PyTree
    memory: PyTree
    dt: Any

    def __call__(self, q: Array, v: Array, t: Any, age: Any = None) -> tuple[Solution, Rows]:
        """a and λ at (q, v, t), and the rows there; feedback sees their rates `age` [s] ago."""
        rows, law, problem = self._problem(q, v, t, age)
        own = self.solver.solve(problem) if law.solve is None else law.solve(self.solver, problem)
        return self.system.complete(own), rows

    def factored(
        self, q: Array, v: Array, t: Any, age: Any = None
    ) -> tuple[Solution, Rows, Callable[[Array], Solution]]:
        """The same, and Δv → the nearest change of v in the metric of M that the rows allow."""
        rows, law, problem = self._problem(q, v, t, age)
        solve, none = self.solver.factor(problem), jnp.zeros_like(law.target)

        def allowed(change: Array) -> Solution:
            return solve(problem.mass.apply(change), none)

        return self.system.complete(solve(problem.force, law.target)), rows, allowed

    def _problem(self, q: Array, v: Array, t: Any, age: Any) -> tuple[Rows, Any, Saddle]:
        """The rows, the law of the stabiliser, and the saddle system of both."""
        rows = dataclasses.replace(linearize(self.system, q, v, t), mass=self.system.mass(q))
        law = self.stabilizer.impose(
            rows if age is None else rows.earlier(age), self.memory, self.dt
        )
        force = self.system.force(q, v, t, self.control)
        force = force if law.force is None else force + law.force
        return rows, law, saddle(self.system, q, law.rows, force, law.target, law.noise)
