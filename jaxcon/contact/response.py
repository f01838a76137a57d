"""The response of limits, friction, motors and contacts within a step.

A step evaluates inequality rows once, at velocity level. The factors of the step eliminate the
equality rows. `reactions` then solves for the multipliers of the inequality rows. `impacts`
computes how an impact within the step changes q and v at its end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.joint_trees import follows_tree, tree_equations
from jaxcon.constraints.rows import Rows, keeps_rows
from jaxcon.contact import impacts
from jaxcon.contact.body_space import tree_below
from jaxcon.contact.limits import OneSided
from jaxcon.contact.nearest_rows import ActiveSet
from jaxcon.contact.newton import Newton
from jaxcon.contact.parts import ImpactSet, StepPart
from jaxcon.contact.reactions import ContactProblem
from jaxcon.contact.rows import BoundRows, Reactions, bound_rows, linearize_bounds, reaches
from jaxcon.core import notices, numerics, status
from jaxcon.core.doubled import Doubled, rounded
from jaxcon.core.lanes import add_rhs_axis
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.saddle import Diagonal, Factored, Saddle, Solution
from jaxcon.protocols import ContactSolver

if TYPE_CHECKING:
    from jaxcon.step import Dynamics
    from jaxcon.system.body_system import Snapshot

Point = tuple[Array, Array, "Doubled | Array"]
"""A point of a motion: q (n_q,), v (n_v,) and the time t () [s]."""


@pytree
class Response:
    """The response of the inequality rows in a step, or in a part of a step.

    Attributes:
        solver: contact solver, which finds the multipliers.
        guess: multipliers of the last step, (n,), for a warm start; None for a cold start.
        part: part of the step to advance; None for the whole step.
    """

    solver: ContactSolver
    guess: Array | None = None
    part: StepPart | None = None

    def rows(self, snapshot: Snapshot, control: PyTree, dt: Array) -> BoundRows:
        """Returns the inequality rows, with their target velocities for the step."""
        rows = partial(bound_rows, snapshot, control)
        return rows(dt) if self.part is None else self.part.ask(rows, dt)

    def solve(
        self,
        dynamics: Dynamics,
        rows: Rows,
        system: Saddle,
        point: Point,
        delayed: bool,
        every_landing: bool,
    ) -> tuple[Solution, Rows, Callable[[Array], Solution], Array, Array]:
        """Solves a step with inequality rows; returns the fields of `step.Solved`.

        Args:
            dynamics: equations of motion of the step.
            rows: constraints linearized at the point, with the inequality rows.
            system: saddle system M a = f + Jᵀλ, J a + C λ = b of the equality rows.
            point: q, v and t at the start of the step.
            delayed: True if velocities belong to half a step before the positions.
            every_landing: True if landings (impacts without rebound) are resolved within the step
                with every solver.

        Raises:
            ValueError: the stabilizer has a `solve` of its own, whose factors cannot be reused, or
                the state has the multipliers of another scene.
        """
        if dynamics.stabilizer.solves:
            raise ValueError(
                f"{type(dynamics.stabilizer).__name__} has a `solve` of its own, but limits,"
                " friction and contacts are solved with the factors of the step; take Baumgarte(),"
                " or a scene without them."
            )
        (q, v, t), dt, bounds = point, dynamics.dt, rows.inequalities
        assert isinstance(bounds, BoundRows)
        if self.guess is not None and self.guess.shape[0] != bounds.kinds.size:
            raise ValueError(
                f"the state has multipliers of {self.guess.shape[0]} inequality rows, but this"
                f" scene has {bounds.kinds.size}; start with"
                " state = jc.init(system, method, state.q, state.v)."
            )
        strikes = lands = False
        if self.part is None:
            # an impact needs two more solves; `GaussSeidel` avoids them if nothing can bounce
            apart = every_landing or self.solver.exact or bounds.restitution is not None
            strikes = any(bounds.ends) and apart
            lands = delayed and not strikes
            shares = type(self.solver).__name__ if lands else None
            doubt = impacts.doubt(bounds, shares, self._leaves_out(bounds))
            if doubt is not None:
                gap = notices.when_differentiated(bounds.gap, doubt)
                bounds = dataclasses.replace(bounds, gap=gap)
        length = dt if self.part is None else self.part.length
        share = 0.5 if delayed else 1.0  # velocities at the end of a step belong to its middle
        if strikes:
            change = self.rate_change(dynamics, bounds, q, v, t)
            bounds = dataclasses.replace(bounds, rate_change=change)
        base = dataclasses.replace(bounds, restitution=None) if strikes else bounds
        hard = keeps_rows(system, rows)
        given = length, bounds.acts, hard, share, self.solver.regularization
        impulse = self._impulse(dynamics, (q, v), base, system, *given)
        both_stops, e, bounds = bounds, bounds.restitution, impulse.rows
        seen, may = None, jnp.zeros_like(bounds.rate, bool)
        if lands:
            start = dt[None] * jax.lax.stop_gradient(bounds.jacobian).apply(impulse.start)
            seen = impacts.closing(bounds, start, dt) if notices.is_observing() else None
            landing_rows = impacts.landing(bounds, start, dt)
            impulse = dataclasses.replace(impulse, rows=landing_rows)
        if strikes:
            bouncy = dataclasses.replace(bounds, restitution=e)
            may = impacts.candidates(bouncy, impulse.start, dt)
            impulse = impulse.without(bounds.kinds.by_contact(may))
        reactions = impulse.react(self.solver, self.guess)
        solution = dynamics.system.complete(impulse.motion(reactions.multipliers))
        solution = solution._replace(status=status.first(solution.status, impulse.judge()))
        reactions = self._judged(impulse, reactions, solution.acceleration)
        jacobian = impulse.rows.jacobian
        force = jacobian.transpose(reactions.multipliers)
        one_sided = force  # its friction acts on the bodies on which its normal forces act
        if not all(bounds.ends[: bounds.kinds.normal + bounds.kinds.contacts]):
            ends = impacts.mask(bounds.ends, bounds)
            one_sided = jacobian.transpose(jnp.where(ends, reactions.multipliers, 0))
        if strikes:
            impact = impacts.Impact(
                laws=_Laws(
                    dataclasses.replace(dynamics, contact=dataclasses.replace(self, guess=None))
                ),
                system=dynamics.system,
                q=q,
                v=v,
                t=t,
                rows=dataclasses.replace(impulse.rows, restitution=e),
                stops=both_stops,
                may=may,
                acceleration=solution.acceleration,
                multipliers=reactions.multipliers,
                joints=solution.multipliers,
                lag=0.5 if delayed else 0.0,
                dt=dt,
                response=_response(impulse, system),
            )
            if notices.is_observing():
                arrivals = impact.arrivals()
                hits, bounces = arrivals.hits, arrivals.bounces
                solution = _observed(solution, t, hits, bounces, bounds, dt)
            solution, reactions = _struck(impact, solution, reactions, dt)
        elif seen is not None:
            solution = _observed(solution, t, seen, seen, bounds, dt)

        def solve_rows(target: Array) -> Solution:
            return impulse.alone(0 * system.force, target)

        rows = dataclasses.replace(rows, reactions=reactions)
        return solution, rows, solve_rows, one_sided, force

    def rate_change(
        self, dynamics: Dynamics, rows: BoundRows, q: Array, v: Array, t: Doubled | Array
    ) -> Array:
        """Returns h J̇ v, (n,): the change of the rows' φ̇ in a step of constant v.

        There are two estimates. The local one, h J̇ v, has no bound: a slack rope that passes its
        anchor at a distance d has J̇ v = −v²/d. The other is the change of φ̇ over the step. It is
        at most 2 |J| |v|, but meaningless if a contact moves from one end of a body to the other.
        The result is the smaller of the two, or zero if their signs differ. Its derivative is that
        of the second estimate.
        """
        system, dt = dynamics.system, dynamics.dt

        def rate(q: Array, time: Array) -> Array:
            return _rows_at(dynamics, q, v, t + time).rate

        path = dt[None] * system.kinematics(q, v)
        _, local = jax.jvp(rate, (q, jnp.zeros_like(dt)), (path, dt))
        # this rotates bodies in space by 2 atan(h|ω|/2), not h|ω|, which saves a sine and a cosine
        end, elapsed = system.normalize(q + path), dt
        if any(isinstance(group, OneSided) for group in system.bounds):
            # a user's φ may be undefined at the end, and must not be differentiated if it is
            exists = jax.lax.stop_gradient(jnp.all(jnp.isfinite(rate(end, dt)), axis=0))
            end, elapsed = jnp.where(exists[None], end, q), jnp.where(exists, dt, 0)
        change = rate(end, elapsed) - rows.rate
        agree = local * change > 0  # False where J̇ v is NaN
        smaller = jnp.where(agree & (jnp.abs(local) < jnp.abs(change)), local, change)
        value = jnp.where(agree, smaller, 0)
        ends = rows.kinds.by_contact(impacts.mask(rows.ends, rows))
        return jnp.where(ends, change + jax.lax.stop_gradient(value - change), 0)

    def without(self, dynamics: Dynamics, q: Array, v: Array, t: Doubled | Array) -> Array:
        """Returns the acceleration a without inequality rows, (n_v,)."""
        free = dataclasses.replace(dynamics, contact=None)
        return free.solve(free.linearize(q, v, t), q, v, t).solution.acceleration

    def impact(
        self, dynamics: Dynamics, q: Array, v: Array, t: Doubled | Array, struck: ImpactSet
    ) -> tuple[Array, Reactions]:
        """Returns the velocity change Δv of an impact, with impulses [N s, N m s] as reactions."""
        rows, acts = struck.ask(_rows_at(dynamics, q, v, t), dynamics.dt)
        solution, reactions = self.find(dynamics, (q, v, t), rows, acts, False)
        return solution.acceleration, reactions

    def find(
        self, dynamics: Dynamics, point: Point, rows: BoundRows, acts: Array, lasts: Array | bool
    ) -> tuple[Solution, Reactions]:
        """Solves for the response to the active rows: an impact, or a step where `lasts` is True.

        An impact has a velocity change Δv and impulses Λ_e and Λ. A step has an acceleration a and
        forces λ_e and λ. Only the rows in the mask `acts` are active. Λ_e and λ_e belong to the
        equality rows, Λ and λ to the inequality rows. An impact takes no time, so smooth forces
        drop out: M Δv = J_eᵀ Λ_e + Jᵀ Λ and J_e Δv + C Λ_e = 0.
        """
        free, dt = dataclasses.replace(dynamics, contact=None), dynamics.dt
        linearized = free.linearize(*point)
        equations = free.stabilizer.constraint_equations(linearized, free.memory, dt)
        system = free.assemble(equations, *point)
        force, target = (jnp.where(lasts, x, 0) for x in (system.force, system.target))
        system = dataclasses.replace(system, force=force, target=target)
        time = jnp.where(lasts, dt, jnp.ones_like(dt))
        hard = keeps_rows(system, linearized)
        ρ = self.solver.regularization
        ρ = None if ρ is None else jnp.where(lasts, ρ, 0)  # impacts obey the exact laws
        problem = rows, system, time, acts, hard
        impulse = self._impulse(dynamics, point[:2], *problem, regularization=ρ)
        reactions = impulse.react(self.solver, None)
        solution = dynamics.system.complete(impulse.motion(reactions.multipliers))
        return solution, self._judged(impulse, reactions, solution.acceleration)

    def _impulse(
        self,
        dynamics: Dynamics,
        point: tuple[Array, Array],
        rows: BoundRows,
        system: Saddle,
        dt: Array,
        acts: Array | None,
        hard: bool,
        share: float = 1.0,
        regularization: Scalar | None = None,
    ) -> ContactProblem:
        """Returns the contact problem, with factors of the equality rows.

        With Newton's method the equality rows are eliminated along the joints, unless the solver
        has options.
        `hard` is False if the stabilizer has made joints compliant, as `Penalty` does. They then do
        not allow the motions of a tree only.
        """
        equations = None
        if isinstance(self.solver, Newton) and hard and isinstance(system.mass, Diagonal):
            tree = tree_below(dynamics.system, system.jacobian, system.layout, rows)
            if tree is not None:
                equations = tree_equations(dynamics.system, *point, tree, system)
        parts = dynamics.solver, dynamics.stabilizer
        if equations is not None and follows_tree(*parts, equations.motions.tree, system):
            solve = _of_column(equations.solver(system))
        else:
            solver = add_rhs_axis(dynamics.solver, system.force.ndim - 1)
            columns = add_rhs_axis(system, system.force.ndim - 1)
            solve = solver.factor(dataclasses.replace(columns, has_columns=True))
        return ContactProblem.of(
            rows, solve, system, dt, acts, self._leaves_out(rows), share, regularization, equations
        )

    def _judged(
        self, impulse: ContactProblem, reactions: Reactions, acceleration: Array
    ) -> Reactions:
        """Returns the reactions with the violations of left-out rows included in their residual."""
        if not self._leaves_out(impulse.rows):
            return reactions
        missed = impulse.overlooked(reactions.multipliers, acceleration)
        return dataclasses.replace(reactions, residual=jnp.maximum(reactions.residual, missed))

    def _leaves_out(self, rows: BoundRows) -> bool:
        """Returns True if the solver leaves rows out."""
        return isinstance(self.solver, ActiveSet) and self.solver.leaves_out(rows.kinds)


def _of_column(solve: Factored) -> Factored:
    """Returns a solver of (n, …) as one of a single column, (n, 1, …)."""

    def solve_column(force: Array, target: Array) -> Solution:
        assert force.shape[1] == target.shape[1] == 1
        a, λ, code = solve(force[:, 0], target[:, 0])
        return Solution(a[:, None], λ[:, None], code[None])

    return solve_column


def _rows_at(dynamics: Dynamics, q: Array, v: Array, t: Doubled | Array) -> BoundRows:
    """Returns the inequality rows at a point, with their targets for a whole step."""
    return linearize_bounds(dynamics.system, q, v, t, dynamics.control, dynamics.dt)


def _observed(
    solution: Solution, t: Doubled | Array, hits: Array, fast: Array, rows: BoundRows, dt: Array
) -> Solution:
    """Reports the rows that hit in this step to `notices`; returns the solution."""
    kind = impacts.Seen(rows.layout)
    a = notices.observe(solution.acceleration, kind, hits, fast, rounded(t), dt)
    return solution._replace(acceleration=a)


def _struck(
    impact: impacts.Impact, solution: Solution, reactions: Reactions, dt: Array
) -> tuple[Solution, Reactions]:
    """Adds the jump and the mean forces of a step's impacts to its solution and reactions."""
    jump, struck, lost = impact.outcome()
    λ, joints = (
        x + numerics.safe_divide(impulse, dt[None])
        for x, impulse in (
            (reactions.multipliers, struck.multipliers),
            (solution.multipliers, struck.joints),
        )
    )
    reactions = dataclasses.replace(
        reactions,
        multipliers=λ,
        lasting=reactions.multipliers,
        residual=jnp.maximum(reactions.residual, struck.residual),
        kept=jnp.minimum(reactions.kept, struck.kept),
        jump=jump,
    )
    code = lost_impacts(solution.status, lost)
    return solution._replace(multipliers=joints, status=code), reactions


def _response(impulse: ContactProblem, system: Saddle) -> Array:
    """Returns ∂a/∂λ, (n_v, n), or a mask of the entries that may differ from zero."""
    moved = impulse.moved()
    if moved is not None:
        return moved
    shape, dtype = impulse.start.shape, impulse.start.dtype
    rows = impulse.rows.jacobian
    mask = np.ones((shape[0], rows.shape[0]), bool)
    if isinstance(system.mass, Diagonal) and isinstance(rows, Jacobian):
        mask = reaches(system.jacobian, rows)
    mask = jnp.asarray(mask.reshape(*mask.shape, *(1,) * (len(shape) - 1)), dtype)
    return jnp.broadcast_to(mask, (*mask.shape[:2], *shape[1:]))


def lost_impacts(code: Array, lost: Array | None) -> Array:
    """Returns the status code; LOST_IMPACTS if impacts are lost and nothing else has failed, ()."""
    if lost is None:
        return code
    note = jnp.where(lost, status.Status.LOST_IMPACTS, status.Status.OK)
    return status.first(code, note.astype(code.dtype))


@pytree
class _Laws:
    """Implements the protocol `impacts.Laws` with the dynamics of a step."""

    dynamics: Dynamics

    def rows(self, q: Array, v: Array, t: Doubled | Array) -> BoundRows:
        """Returns the inequality rows at a state."""
        return _rows_at(self.dynamics, q, v, t)

    def rate_change(self, rows: BoundRows, q: Array, v: Array, t: Doubled | Array) -> Array:
        """Returns h J̇ v, (n,): the change of the rows' φ̇ in a step of constant v."""
        return self._response.rate_change(self.dynamics, rows, q, v, t)

    def find(
        self,
        q: Array,
        v: Array,
        t: Doubled | Array,
        rows: BoundRows,
        acts: Array,
        lasts: Array,
    ) -> impacts.Found:
        """Solves for the response to the active rows: an impact, or the forces of a step.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            rows: the inequality rows, with their targets.
            acts: mask of the active rows, (n,).
            lasts: True for the forces of a step, False for the impulses of an impact, ().
        """
        solution, reactions = self._response.find(self.dynamics, (q, v, t), rows, acts, lasts)
        a, joints, _ = solution
        return impacts.Found(a, reactions.multipliers, joints, reactions.residual, reactions.kept)

    @property
    def _response(self) -> Response:
        assert self.dynamics.contact is not None
        return self.dynamics.contact
