"""Solves for the multipliers of inequality rows in a step, and their effect on the motion."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxcon.contact import body_slope, newton
from jaxcon.contact.body_space import BodySpace
from jaxcon.contact.bounces import restitution_gain
from jaxcon.contact.bounded import (
    Bounded,
    Inverses,
    Limits,
    implicit_multipliers,
    implicit_solution,
    laws,
    probes,
    regularized,
)
from jaxcon.contact.nearest_rows import ActiveSet
from jaxcon.contact.newton import Newton
from jaxcon.contact.rows import BoundRows, Reactions
from jaxcon.core import numerics
from jaxcon.core.jaxprs import each
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, Scalar
from jaxcon.linear import gauss_jordan
from jaxcon.linear.jacobian import Jacobian
from jaxcon.linear.proximal import own_diagonal
from jaxcon.linear.saddle import Factored, Saddle, Solution
from jaxcon.linear.tree_equations import TreeEquations

if TYPE_CHECKING:
    from jaxcon.protocols import ContactSolver


@dataclass(frozen=True)
class ContactProblem:
    """The inequality rows of a step, with its equality rows eliminated.

    J_b is the Jacobian of the inequality rows and λ_e the multipliers of the equality rows. The
    factors of the step solve M a = f + Jᵀλ_e + J_bᵀλ, J a + C λ_e = b. One solve gives the
    velocities u = φ̇ + h (J_b a + s J̇_b v) for multipliers λ. One solve with many right-hand sides
    gives G = ∂u/∂λ. These right-hand sides are the forces of a unit of each λ. If there are more
    rows than velocities, they are instead unit forces along each velocity, and the result is
    multiplied by J_b and J_bᵀ.

    Attributes:
        rows: inequality rows.
        solve: function of (f, b) that returns a and λ_e, for many right-hand sides (one, if there
            are `equations`); see `add_rhs_axis`.
        saddle: saddle system of the step, with M, f and the equality rows.
        target: target b of the equality rows, (n_c,).
        dt: step size h, () [s]; 1 if λ are the impulses of an impact.
        start: acceleration a for λ = 0, (n_v,), a constant.
        bare: diagonal of J_b M⁻¹ J_bᵀ, (n,), the inverse mass of each row without equality rows.
        acts: mask of the active rows, (n,). Tangents have the entry of their normal. None if all
            rows are active.
        answers: accelerations a under the forces of `_probing`, (n_v, k, …), a constant; None
            if not computed.
        share: factor s of J̇_b v: ½ if the velocities at the end of a step belong to its middle,
            else 1.
        regularization: ρ of `regularized`; None for exact laws.
        equations: the equations of motion of the trees of bodies if Newton's method solves the
            problem; None otherwise.
    """

    rows: BoundRows
    solve: Factored
    saddle: Saddle
    target: Array
    dt: Array
    start: Array
    bare: Array
    acts: Any = None
    answers: Array | None = None
    share: float = 1.0
    regularization: Any = None
    equations: TreeEquations | None = None

    @classmethod
    def of(
        cls,
        rows: BoundRows,
        solve: Factored,
        saddle: Saddle,
        dt: Array,
        acts: Array | None = None,
        sifts: bool = False,
        share: float = 1.0,
        regularization: Scalar | None = None,
        equations: TreeEquations | None = None,
    ) -> ContactProblem:
        """Returns the contact problem of a step, from the factors of its saddle system.

        Args:
            rows: inequality rows.
            solve: solver of f and b, for many right-hand sides; see `add_rhs_axis`.
            saddle: saddle system of the step, with M, f and the equality rows.
            dt: step size h, () [s].
            acts: mask of the active rows, (n,); None for all.
            sifts: True to make immovable rows inactive, which `nearest` needs.
            share: factor s of J̇_b v in u.
            regularization: ρ of `regularized`; None for exact laws.
            equations: the equations of motion of the trees of bodies if Newton's method solves the
                problem; None otherwise.
        """
        bare = own_diagonal(saddle.mass, rows.jacobian, rows.rate.ndim - 1)
        start = 0 * saddle.force
        target = saddle.target
        options = None, share, regularization, equations
        problem = cls(rows, solve, saddle, target, dt, start, bare, acts, *options)
        if equations is not None:
            first = problem.alone(saddle.force, saddle.target).acceleration
            return dataclasses.replace(problem, start=jax.lax.stop_gradient(first))._facing()
        return (problem.without_immovable_rows() if sifts else problem._begun())._facing()

    def _begun(self) -> ContactProblem:
        """Returns the problem with its fields `start` and `answers`, computed in one solve."""
        probing = self._probing()
        count, *batch = probing.shape[1:]
        force, target = (
            jnp.broadcast_to(x[:, None], (len(x), 1, *batch))
            for x in (self.saddle.force, self.target)
        )
        none = jnp.zeros((len(target), count, *batch), target.dtype)
        forces, targets = (
            jnp.concatenate(pair, axis=1) for pair in ((force, probing), (target, none))
        )
        accelerations = jax.lax.stop_gradient(self.solve(forces, targets).acceleration)
        return dataclasses.replace(self, start=accelerations[:, 0], answers=accelerations[:, 1:])

    def _facing(self) -> ContactProblem:
        """Replaces a stop by the opposite stop if a step with λ = 0 would pass the opposite stop.

        In the Jacobian, this changes only the sign of the row.
        """
        if self.rows.far is None:
            return self
        second, answers = self.rows.passes(self.end_velocity(self.start), self.dt), self.answers
        if answers is not None and not self._by_velocities():
            answers = jnp.where(second[None], -answers, answers)
        rows = self.rows.facing(second, self.dt)
        return dataclasses.replace(self, rows=rows, answers=answers)

    def _by_velocities(self) -> bool:
        """Returns True if `_probing` has one force per velocity, False if it has one per row.

        It has one per velocity if rows outnumber velocities and J is not `Gathered`.
        """
        return isinstance(self.rows.jacobian, Jacobian) and len(self.start) < len(self.bare)

    def _probing(self) -> Array:
        """Returns the forces of unit multipliers, or unit forces on each velocity, (n_v, k, …)."""
        if not self._by_velocities():
            return jax.lax.stop_gradient(self.rows.jacobian).columns(self.rows.rate)
        unit = gauss_jordan.identity(self.start)
        return jnp.broadcast_to(unit, (*unit.shape[:2], *self.start.shape[1:]))

    def without_immovable_rows(self) -> ContactProblem:
        """Returns the problem with the immovable rows inactive.

        A row i is immovable if Gᵢᵢ = 0. Since G is positive semidefinite, (G z)ᵢ is then zero for
        every z. If row i is movable, (G z)ᵢ is almost never zero for a random z; two such z are
        tested.
        """
        length = jnp.sqrt(self.bare)
        force, none = self.saddle.force, jnp.zeros_like(self.target)
        pulls = [self._pull(z * numerics.safe_divide(1.0, length)) for z in probes(length)]
        forces = [force, *(jnp.broadcast_to(pull, force.shape) for pull in pulls)]
        targets = jnp.stack([self.target, none, none], axis=1)
        accelerations = self.solve(jnp.stack(forces, axis=1), targets).acceleration
        start, *moved = (jax.lax.stop_gradient(accelerations[:, i]) for i in range(3))
        rounding = 64 * float(jnp.finfo(force.dtype).eps) * len(length) ** 0.5
        largest = functools.reduce(
            jnp.maximum, (jnp.abs(self.rows.jacobian.apply(a)) for a in moved)
        )
        movable = largest > rounding * length
        acts = movable if self.acts is None else movable & self.acts
        return dataclasses.replace(self, start=start, acts=acts)

    def judge(self) -> Array:
        """Returns the status NON_FINITE if a number of the rows is not finite, else OK, ().

        A regularization must not be negative either.

        Laws and solvers compare numbers. Comparisons with NaN are false and would silently ignore
        the row.
        """
        finite = self.rows.finite(self.bare)
        if self.regularization is not None:
            share = jnp.asarray(self.regularization, self.bare.dtype)
            finite &= jnp.isfinite(share) & (share >= 0)
        return jnp.where(finite, Status.OK, Status.NON_FINITE).astype(jnp.int32)

    def motion(self, multipliers: Array) -> Solution:
        """Returns accelerations a and joint multipliers λ_e for given multipliers λ, (n,)."""
        return self.alone(self.saddle.force + self._pull(multipliers), self.target)

    def velocity(self, multipliers: Array) -> Array:
        """Returns the velocities u at the end of the step for given multipliers, (n,)."""
        return self.end_velocity(self.motion(multipliers).acceleration)

    def end_velocity(self, acceleration: Array) -> Array:
        """Returns u = φ̇ + h (J_b a + s J̇_b v), (n,), the end velocities for accelerations a."""
        return self.rows.rate + self.rows.change(acceleration, self.dt, self.share)

    def moved(self) -> Array | None:
        """Returns ∂a/∂λ, (n_v, n), accelerations per unit of multipliers; None if not known."""
        if self.answers is None:
            return None
        if not self._by_velocities():
            return self.answers
        j = jax.lax.stop_gradient(self.rows.jacobian)
        return jax.lax.stop_gradient(jnp.swapaxes(j.each(self.answers), 0, 1))

    def without(self, rows: Array) -> ContactProblem:
        """Returns the problem with some rows, a mask (n,), inactive."""
        acts = ~rows if self.acts is None else self.acts & ~rows
        return dataclasses.replace(self, acts=acts)

    def matrix(self) -> Array:
        """Returns G = ∂u/∂λ, (n, n), velocities per unit of multipliers, a constant."""
        j, moved = jax.lax.stop_gradient(self.rows.jacobian), self.answers
        if moved is None:
            force = self._probing()
            none = jnp.zeros((len(self.target), *force.shape[1:]), force.dtype)
            moved = jax.lax.stop_gradient(self.solve(force, none).acceleration)
        if self._by_velocities():
            moved = jnp.swapaxes(j.each(moved), 0, 1)
        return jax.lax.stop_gradient(self.dt[None, None] * j.each(moved))

    def _pull(self, multipliers: Array) -> Array:
        """Returns the generalized force J_bᵀ λ of multipliers λ, (n_v,)."""
        return self.rows.jacobian.transpose(multipliers)

    def alone(self, force: Array, target: Array) -> Solution:
        """Returns the solution for a single right-hand side (f, b)."""
        a, multipliers, status = self.solve(force[:, None], target[:, None])
        return Solution(a[:, 0], multipliers[:, 0], status[0])

    def movable(self, matrix: Array) -> Array:
        """Returns a mask of the rows that are active and movable, (n,).

        The equality rows may make a row immovable up to rounding, for example a row between two
        points of one body. No λ can change the velocity of such a row, so it is left out.
        """
        diagonal = gauss_jordan.diagonal(matrix)
        rounding = 64 * float(jnp.finfo(matrix.dtype).eps) * self.dt[None] * self.bare
        moving = jax.lax.stop_gradient(diagonal > rounding)
        moving = moving if self.acts is None else moving & self.acts
        kinds = self.rows.kinds
        return kinds.under_normals(kinds.split(moving))

    def react(self, solver: ContactSolver | ActiveSet, guess: Array | None) -> Reactions:
        """Solves for λ; restitution is reduced if it would add energy.

        Args:
            solver: `InteriorPoint()`, `GaussSeidel()`, or `ActiveSet(…)` with one of these.
            guess: multipliers λ of the last step, (n,), or None.
        """
        if isinstance(solver, ActiveSet):
            some = solver.leaves_out(self.rows.kinds)
            return self.nearest(solver, guess) if some else self.react(solver.solver, guess)
        if isinstance(solver, Newton) and self.equations is not None:
            return self.react_in_bodies(solver, guess, self.equations)
        rows = self.rows
        matrix = self.matrix()
        movable = self.movable(matrix)
        free = self.end_velocity(self.start)
        soft = jnp.where(movable[None] & movable[:, None], matrix, 0)
        scale = gauss_jordan.diagonal(soft)
        compliance = regularized(rows.compliance, rows.kinds, scale, self.regularization)
        soft = jax.lax.stop_gradient(soft + compliance[None] * gauss_jordan.identity(rows.rate))

        def met(wanted: Array) -> tuple[Array, Array]:
            offset = jax.lax.stop_gradient(jnp.where(movable, free - wanted, 0))
            bounds = jax.lax.stop_gradient((rows.lower, rows.upper, rows.friction))
            resistance = jax.lax.stop_gradient(rows.resistance)
            problem = Bounded(soft, offset, *bounds, rows.kinds, resistance)
            start = jnp.zeros_like(offset) if guess is None else jax.lax.stop_gradient(guess)
            solution = jnp.where(movable, solver.solve(problem, start), 0)

            def moved(multipliers: Array) -> Array:
                here = self.velocity(multipliers) + compliance * multipliers - wanted
                return jnp.where(movable, here, 0)

            live = (rows.lower, rows.upper, (rows.friction, *rows.resistance))
            left = problem.worst(solution)
            return implicit_multipliers(problem, solution, moved, live, solver.smoothing), left

        return self._with_restitution(met)

    def react_in_bodies(
        self, solver: Newton, guess: Array | None, equations: TreeEquations
    ) -> Reactions:
        """Solves for λ by Newton's method for the velocities of the bodies."""
        rows, free = self.rows, self.end_velocity(self.start)
        space = BodySpace.of(equations, rows)
        start = jnp.zeros_like(free) if guess is None else jax.lax.stop_gradient(guess)
        fixed = jax.lax.stop_gradient(rows)
        live = (rows.lower, rows.upper, (rows.friction, *rows.resistance))

        def met(wanted: Array) -> tuple[Array, Array]:
            offset = jax.lax.stop_gradient(free - wanted)
            share = jax.lax.stop_gradient(self.regularization)
            λ, mass, movable, own = newton.multipliers(
                space, fixed, offset, start, self.acts, self.bare, self.dt, solver, share
            )
            h = jnp.where(self.dt > 0, self.dt, 1)[None]
            scale, kinds = h * mass, rows.kinds
            compliance = regularized(rows.compliance, kinds, h * own, self.regularization)

            def moved(multipliers: Array) -> Array:
                here = self.velocity(multipliers) + compliance * multipliers - wanted
                return jnp.where(movable, here, 0)

            def inverses(bounds: Limits, corner: Array | None, u: Array) -> Inverses:
                numbers = scale, jax.lax.stop_gradient(compliance), movable, self.dt
                return body_slope.inverses(space, rows.kinds, *numbers, bounds, corner, λ, u)

            solution = implicit_solution(
                rows.kinds, scale, λ, None, moved, live, solver.smoothing, inverses
            )
            # by the solver of the step, which in double precision knows the drift φ of the joints;
            # a program that does not return the residual leaves this out
            missed = laws(rows.kinds, scale, λ, moved(λ), live) * scale
            left = jnp.max(jnp.abs(jnp.where(movable, missed, 0)), axis=0)
            return solution, jax.lax.stop_gradient(left)

        return self._with_restitution(met)

    def _with_restitution(self, met: Callable[[Array], tuple[Array, Array]]) -> Reactions:
        """Returns the reactions; restitution is reduced if it would add energy.

        Args:
            met: function of the target velocities that returns λ and the violation of the laws.
        """
        rows = self.rows
        if rows.restitution is None:
            solution, left = met(rows.target)
            ones = jnp.ones_like(left)
            return Reactions(solution, rows.gap, left, ones, None, rows.layout, rows.direction)
        gain = restitution_gain(rows, rows.restitution, self.dt)
        (plain, bounced), left = each(met, jnp.stack([rows.target, rows.target + gain]))
        without = self.velocity(jnp.zeros_like(gain))
        share = self.cap_energy(without, plain, bounced - plain)
        solution = plain + share[None] * (bounced - plain)
        left = jnp.max(left, axis=0)
        return Reactions(solution, rows.gap, left, share, None, rows.layout, rows.direction)

    def nearest(self, solver: ActiveSet, guess: Array | None) -> Reactions:
        """Solves only the rows that are nearest to becoming active; other rows have λ = 0."""
        rows, length = self.rows, jnp.sqrt(self.bare)
        distance = numerics.safe_divide(self.end_velocity(self.start) - rows.target, length)
        distance = jnp.where(self.acts, distance, jnp.inf)
        choice = solver.choose(rows.kinds, jax.lax.stop_gradient(distance))
        bare, acts = choice.take(self.bare), choice.take(self.acts)
        problem = dataclasses.replace(
            self, rows=rows.chosen(choice), bare=bare, acts=acts, answers=None
        )
        reactions = problem.react(solver.solver, None if guess is None else choice.take(guess))
        return dataclasses.replace(
            reactions,
            multipliers=choice.put(reactions.multipliers),
            gap=rows.gap,
            layout=rows.layout,
            direction=rows.direction,
        )

    def overlooked(self, multipliers: Array, acceleration: Array) -> Array:
        """Returns the largest violation of a target among rows with λ = 0, ()."""
        kinds, rows = self.rows.kinds, self.rows
        short = jnp.where(multipliers == 0, rows.target - self.end_velocity(acceleration), 0)
        parts = kinds.split(jax.lax.stop_gradient(jnp.where(self.acts, short, 0)))
        return jnp.max(jnp.concatenate([parts.single, parts.normal]), axis=0, initial=0)

    def cap_energy(self, free: Array, multipliers: Array, increment: Array) -> Array:
        """Returns the largest s ≤ 1 for which λ + s Δλ adds no energy, for each world.

        The work of λ + s Δλ in a step must not exceed zero, or the work of λ if that is positive.
        Multipliers do the work h λ·(u₀ + u)/2, where u₀ are the velocities without them. The work
        of boxes is not limited, since boxes are motors and friction in joints.

        Args:
            free: velocities u₀ without multipliers, (n,).
            multipliers: multipliers λ without restitution, (n,).
            increment: increase Δλ by restitution, (n,).
        """
        kinds = self.rows.kinds
        acts = jnp.ones(kinds.size, free.dtype).at[kinds.single : kinds.normal].set(0)
        acts = acts.reshape(-1, *(1,) * (free.ndim - 1))
        change = self.velocity(increment + multipliers) - self.velocity(multipliers)
        mean = (free + self.velocity(multipliers)) / 2

        def work(x: Array, u: Array) -> Array:
            return jnp.sum(acts * x * u, axis=0)

        start = work(multipliers, mean)
        linear = work(increment, mean) + work(multipliers, change) / 2
        square = work(increment, change) / 2
        rounding = 64 * float(jnp.finfo(free.dtype).eps)
        gains = start + linear + square > rounding * work(jnp.abs(increment), jnp.abs(mean))
        gains, grows = gains & (start + linear + square > start), linear > 0
        # a common factor does not change the root; without it, squares of small works would
        # underflow in float32
        size = functools.reduce(jnp.maximum, map(jnp.abs, (start, linear, square)))
        size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
        room, linear, square = jnp.maximum(-start, 0) / size, linear / size, square / size
        inner = jnp.abs(linear) + numerics.safe_sqrt(linear * linear + 4 * square * room)
        # two formulas for the same root, each used where it has no cancellation
        few = 2 * room / jnp.where(gains & grows & (inner > 0), inner, 1)
        many = inner / jnp.where(gains & ~grows, 2 * square, 1)
        return jnp.where(gains, jnp.clip(jnp.where(grows, few, many), 0, 1), 1)
