"""The saddle system of a constrained system, and its accelerations and multipliers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.bound_layout import Reactions
from jaxcon.constraints.bounds import BoundRows, linearize_bounds
from jaxcon.constraints.inequality import OneSided
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import notices, numerics, status
from jaxcon.core.doubled import rounded
from jaxcon.core.lanes import widened
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics import impacts
from jaxcon.dynamics.parts import Part, Struck
from jaxcon.dynamics.reactions import Impulse
from jaxcon.solvers.bounded import is_exact
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


@pytree
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
        """a and λ at (q, v, t), and the rows there; feedback sees their rates `age` [s] ago.

        With bounded rows these are means over the step, its impacts included.
        """
        solution, rows, *_ = self.factored(q, v, t, age)
        return impacts.with_jump(solution, impacts.jump_of(rows.reactions), self.dt), rows

    def begun(self, q: Array, v: Array, t: Any) -> tuple[Solution, Rows, Dynamics]:
        """Returns a and λ and the rows at the start of a step, and what the rest of it sees.

        Bounded rows contain the step: they are solved once, and act as a force that stays. Impacts
        are none: they are the `jump` of the reactions, for the end of the step.
        """
        if self.bounded is None:
            return *self(q, v, t), self
        rows, law, problem = self._problem(q, v, t, None)
        solution, rows, force, *_ = self._reacted(q, v, t, rows, law, problem, None, True, None)
        return solution, rows, dataclasses.replace(self, bounded=None, held=force)

    def _reacted(
        self,
        q: Array,
        v: Array,
        t: Any,
        rows: Rows,
        law: Any,
        problem: Saddle,
        lag: float | None,
        every: bool,
        ahead: BoundRows | None,
    ) -> tuple[Solution, Rows, Array, Factored, Array | None]:
        """a and λ with bounded rows, the rows with what these do, their force, and the factors.

        The last is the force of the one-sided rows among them, where they are given ahead.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            rows: the equality rows.
            law: of the stabilizer.
            problem: the saddle system of both.
            lag: velocities are those of lag · h before the positions; None for none.
            every: whether landings without restitution are impacts beside every solver.
            ahead: the bounded rows, from `bounds_ahead`; None where they are not known yet.
        """
        if self.part is None:
            bounds = self.bounds(q, v, t, self.dt) if ahead is None else ahead
            length, acts = self.dt, None
            # an impact takes two more solves, which sweeps save where nothing can bounce
            apart = every or is_exact(self.bounded) or bounds.restitution is not None
            strikes = any(bounds.ends) and apart
            lands = lag is not None and not strikes
            shares = type(self.bounded).__name__ if lands else None
            doubt = impacts.doubt(bounds, shares, self._leaves_out(bounds))
            if doubt is not None:
                gap = notices.when_differentiated(bounds.gap, doubt)
                bounds = dataclasses.replace(bounds, gap=gap)
        else:
            bounds, acts = self.part.ask(lambda dt: self.bounds(q, v, t, dt), self.dt)
            length, strikes, lands = self.part.length, False, False
        share = 1.0 if lag is None else 0.5  # velocities at the end of a step belong to its middle
        if strikes:
            bounds = dataclasses.replace(bounds, rate_change=self.rate_change(bounds, q, v, t))
        base = dataclasses.replace(bounds, restitution=None) if strikes else bounds
        impulse = self._impulse(base, law, problem, length, acts, share)
        both_stops, e, bounds = bounds, bounds.restitution, impulse.rows
        seen, may = None, jnp.zeros_like(bounds.rate, bool)
        if lands:
            start = self.dt[None] * jax.lax.stop_gradient(bounds.jacobian).apply(impulse.start)
            seen = impacts.closing(bounds, start, self.dt) if notices.is_observing() else None
            asked = impacts.landing(bounds, start, self.dt)
            impulse = dataclasses.replace(impulse, rows=asked)
        if strikes:
            bouncy = dataclasses.replace(bounds, restitution=e)
            may = impacts.candidates(bouncy, impulse.start, self.dt)
            impulse = impulse.without(bounds.kinds.by_contact(may))
        known = impulse.react(self.bounded, self.guess)
        solution = self.system.complete(impulse.motion(known.multipliers))
        solution = solution._replace(status=status.first(solution.status, impulse.judge()))
        known = self._judged(impulse, known, solution.acceleration)
        own = impulse.rows.jacobian.transpose(known.multipliers)
        push = None
        if ahead is not None:
            ends = impacts.mask(bounds.ends, bounds)
            push = impulse.rows.jacobian.transpose(jnp.where(ends, known.multipliers, 0))
        if strikes:
            facing = dataclasses.replace(impulse.rows, restitution=e)
            impact = impacts.Impact(
                laws=_Laws(dataclasses.replace(self, guess=None)),
                system=self.system,
                q=q,
                v=v,
                t=t,
                rows=facing,
                stops=both_stops,
                may=may,
                acceleration=solution.acceleration,
                multipliers=known.multipliers,
                joints=solution.multipliers,
                lag=0.0 if lag is None else lag,
                dt=self.dt,
                response=impulse.moved(),
            )
            if notices.is_observing():
                arrivals = impact.arrivals()
                solution = self._observed(solution, t, arrivals.hits, arrivals.bounces, bounds)
            solution, known = self._struck(impact, solution, known)
        elif seen is not None:
            solution = self._observed(solution, t, seen, seen, bounds)
        return solution, dataclasses.replace(rows, reactions=known), own, impulse.alone, push

    def _observed(
        self, solution: Solution, t: Any, hits: Array, fast: Array, rows: BoundRows
    ) -> Solution:
        """The solution; `notices` observes the rows that hit in this step."""
        kind = impacts.Seen(rows.layout)
        a = notices.observe(solution.acceleration, kind, hits, fast, rounded(t), self.dt)
        return solution._replace(acceleration=a)

    def _struck(
        self, impact: impacts.Impact, solution: Solution, known: Reactions
    ) -> tuple[Solution, Reactions]:
        """Adds the impacts of the step: their jump, and the mean of their impulses."""
        jump, struck, lost = impact.outcome()
        λ, joints = (
            x + numerics.safe_divide(more, self.dt[None])
            for x, more in (
                (known.multipliers, struck.multipliers),
                (solution.multipliers, struck.joints),
            )
        )
        known = dataclasses.replace(
            known,
            multipliers=λ,
            residual=jnp.maximum(known.residual, struck.residual),
            kept=jnp.minimum(known.kept, struck.kept),
            jump=jump,
        )
        code = lost_impacts(solution.status, lost)
        return solution._replace(multipliers=joints, status=code), known

    def bounds(self, q: Array, v: Array, t: Any, dt: Any) -> BoundRows:
        """The bounded rows, and what a step of dt wants of them."""
        return linearize_bounds(self.system, q, v, t, self.control, dt)

    def rate_change(self, rows: BoundRows, q: Array, v: Array, t: Any) -> Array:
        """The `rate_change` of the bounded rows at (q, v, t), (n,).

        h J̇ v has no bound: a slack rope that passes its anchor at a distance d has J̇ v = −v²/d. The
        change of φ̇ over the step is at most 2 |J| |v|, but where a contact goes from one end of a
        body to the other it says nothing of either. So the smaller of the two counts, and nothing
        where they disagree in sign. The derivative is that of the change.
        """
        dt = self.dt

        def rate(q: Array, time: Array) -> Array:
            return self.bounds(q, v, t + time, dt).rate

        path = dt[None] * self.system.kinematics(q, v)
        _, local = jax.jvp(rate, (q, jnp.zeros_like(dt)), (path, dt))
        # this turns bodies in space by 2 atan(h|ω|/2) for h|ω|, and saves a step's sine and cosine
        end, elapsed = self.system.normalize(q + path), dt
        if any(isinstance(group, OneSided) for group in self.system.bounds):
            # a user's φ may not exist there, and must not be differentiated where it does not
            exists = jax.lax.stop_gradient(jnp.all(jnp.isfinite(rate(end, dt)), axis=0))
            end, elapsed = jnp.where(exists[None], end, q), jnp.where(exists, dt, 0)
        change = rate(end, elapsed) - rows.rate
        agree = local * change > 0  # false where J̇ v is not a number
        smaller = jnp.where(agree & (jnp.abs(local) < jnp.abs(change)), local, change)
        value = jnp.where(agree, smaller, 0)
        ends = rows.kinds.by_contact(impacts.mask(rows.ends, rows))
        return jnp.where(ends, change + jax.lax.stop_gradient(value - change), 0)

    def unbounded(self, q: Array, v: Array, t: Any) -> Array:
        """a without bounded rows."""
        _, law, problem = self._problem(q, v, t, None)
        return self._factors(law, problem)(problem.force, law.target).acceleration

    def impact(self, q: Array, v: Array, t: Any, struck: Struck) -> tuple[Array, Reactions]:
        """Δv of an impact, and its impulses [N s, N m s] in the place of multipliers."""
        rows, acts = struck.ask(self.bounds(q, v, t, self.dt), self.dt)
        solution, known = self.found(q, v, t, rows, acts, False)
        return solution.acceleration, known

    def found(
        self, q: Array, v: Array, t: Any, rows: BoundRows, acts: Array, lasts: Any
    ) -> tuple[Solution, Reactions]:
        """Δv, Λ_e and Λ of an impact by the rows that act; or a, λ_e and λ of a step if it `lasts`.

        In an impact time stands still, and forces have none of it: M Δv = J_eᵀ Λ_e + Jᵀ Λ and
        J_e Δv + C Λ_e = 0.
        """
        _, law, problem = self._problem(q, v, t, None)
        force, target = (jnp.where(lasts, x, 0) for x in (problem.force, law.target))
        problem = dataclasses.replace(problem, force=force, target=target)
        time = jnp.where(lasts, self.dt, jnp.ones_like(self.dt))
        impulse = self._impulse(rows, law, problem, time, acts)
        known = impulse.react(self.bounded, None)
        solution = self.system.complete(impulse.motion(known.multipliers))
        return solution, self._judged(impulse, known, solution.acceleration)

    def bounds_ahead(self, q: Array, v: Array, t: Any) -> BoundRows:
        """The bounded rows, for `pressed` and `factored`; of a part of a step their structure."""
        if self.part is None:
            return self.bounds(q, v, t, self.dt)
        return jax.eval_shape(self.bounds, q, v, t, self.dt)

    @staticmethod
    def pressed(rows: BoundRows) -> np.ndarray:
        """A mask of the velocities of bodies on which one-sided rows may act, (n_v,)."""
        ends, found = np.asarray(rows.ends, bool), np.zeros(rows.jacobian.shape[1], bool)
        for block in rows.jacobian.blocks:
            m, k = block.shape
            own = ends[block.start : block.start + m * k].reshape(m, k).any(axis=0)
            found[block.columns.index()[:, own]] = True
        return found

    def factored(
        self, q: Array, v: Array, t: Any, age: Any = None, ahead: BoundRows | None = None
    ) -> tuple[Solution, Rows, Callable[[Array], Solution] | None, Array | None]:
        """a and λ, the rows, b → the least a, in the metric of M, with J a + C λ = b, and a force.

        The third uses the factors of the step, and is None where the stabilizer solves by itself.
        The force (n_v,) is that of one-sided rows; None where no bounded rows are given. Impacts
        are not in a: they are the `jump` of the reactions.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            age: how long ago feedback sees the rates, () [s]; None for now.
            ahead: the bounded rows, from `bounds_ahead`; None where they are not known yet.
        """
        rows, law, problem = self._problem(q, v, t, age)
        push = None
        if self.bounded is not None:
            lag = None if age is None else 0.5
            reacted = self._reacted(q, v, t, rows, law, problem, lag, False, ahead)
            solution, rows, _, solve, push = reacted
        elif law.solve is not None:
            return self.system.complete(law.solve(self.solver, problem)), rows, None, None
        else:
            solve = self._factors(law, problem)
            solution = self.system.complete(solve(problem.force, law.target))
        return solution, rows, lambda target: solve(0 * problem.force, target), push

    def _impulse(
        self,
        rows: BoundRows,
        law: Any,
        problem: Saddle,
        dt: Any,
        acts: Any,
        share: float = 1.0,
    ) -> Impulse:
        """How bounded rows act, by factors of wide lanes, to which the solver's numbers belong."""
        wide = dataclasses.replace(self, solver=widened(self.solver, problem.force.ndim - 1))
        factor = partial(wide._factors, law)
        return Impulse.of(rows, factor, problem, dt, acts, self._leaves_out(rows), share)

    def _judged(self, impulse: Impulse, known: Reactions, acceleration: Array) -> Reactions:
        """The reactions with what is missed by rows that were left out."""
        if not self._leaves_out(impulse.rows):
            return known
        missed = impulse.overlooked(known.multipliers, acceleration)
        return dataclasses.replace(known, residual=jnp.maximum(known.residual, missed))

    def _leaves_out(self, rows: BoundRows) -> bool:
        """Returns True where only some of the rows are solved."""
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


def lost_impacts(code: Array, lost: Array | None) -> Array:
    """The code, or LOST_IMPACTS where it is no failure and impacts are lost, ()."""
    if lost is None:
        return code
    found = jnp.where(lost, status.Status.LOST_IMPACTS, status.Status.OK)
    return status.first(code, found.astype(code.dtype))


@pytree
class _Laws:
    """The `impacts.Laws` of these dynamics."""

    dynamics: Dynamics

    def rows(self, q: Array, v: Array, t: Any) -> BoundRows:
        """The bounded rows at a state."""
        return self.dynamics.bounds(q, v, t, self.dynamics.dt)

    def rate_change(self, rows: BoundRows, q: Array, v: Array, t: Any) -> Array:
        """The `rate_change` of the bounded rows at a state, (n,)."""
        return self.dynamics.rate_change(rows, q, v, t)

    def find(
        self, q: Array, v: Array, t: Any, rows: BoundRows, acts: Array, lasts: Array
    ) -> impacts.Found:
        """The impulses of the rows that act; or, where it lasts, (), the forces over a step."""
        solution, known = self.dynamics.found(q, v, t, rows, acts, lasts)
        a, joints, _ = solution
        return impacts.Found(a, known.multipliers, joints, known.residual, known.kept)
