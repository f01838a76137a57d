"""The multipliers of bounded rows in a step, and what they do to the motion."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.bound_layout import Reactions
from jaxcon.constraints.bounds import BoundRows
from jaxcon.core import numerics
from jaxcon.core.jaxprs import each
from jaxcon.core.lanes import widened
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.dynamics.bounces import restitution_gain
from jaxcon.solvers import gauss_jordan
from jaxcon.solvers.bounded import Bounded, implicit_multipliers
from jaxcon.solvers.jacobian import Jacobian
from jaxcon.solvers.nearest_rows import Nearest
from jaxcon.solvers.proximal import own_diagonal
from jaxcon.solvers.saddle import Factored, Saddle, Solution


@dataclass(frozen=True)
class Impulse:
    """How bounded multipliers act within a step, the equality rows being eliminated.

    M a = f + Jᵀλ_e + J_bᵀλ and J a + C λ_e = b hold by the factors at hand, so that one solution
    tells the velocities u = φ̇ + h (J_b a + s J̇_b v) that multipliers λ lead to, and several of
    them, done at once, G = ∂u/∂λ: those of what each row pulls, or, where there are more rows than
    velocities, those of a unit force along each velocity, between J_b and J_bᵀ.

    Attributes:
        rows: the bounded rows.
        solve: (f, b) → a and λ_e, for right sides with an axis of their own, see `widened`.
        saddle: M and f, of the equality rows.
        target: b, (n_c,).
        dt: h, () [s]; 1 where λ are impulses, and time stands still.
        start: a without them, (n_v,), a constant.
        bare: J_b M⁻¹ J_bᵀ on the diagonal, (n,): what rows would move without the equality rows.
        acts: which rows act, (n,), tangents where their normal does; None for all.
        answers: a of `probing` forces, (n_v, k, …), a constant; None where that is not known yet.
        share: s, ½ where the velocities at the end of a step belong to its middle.
    """

    rows: BoundRows
    solve: Factored
    saddle: Saddle
    target: Array
    dt: Any
    start: Array
    bare: Array
    acts: Any = None
    answers: Any = None
    share: float = 1.0

    @classmethod
    def of(
        cls,
        rows: BoundRows,
        factor: Callable[[Saddle], Factored],
        saddle: Saddle,
        dt: Any,
        acts: Array | None = None,
        sifts: bool = False,
        share: float = 1.0,
    ) -> Impulse:
        """Returns the impulse of a step of h, by the factors of its saddle system.

        Args:
            rows: the bounded rows.
            factor: wide saddle system → its solution as a function of f and b.
            saddle: M and f, of the equality rows.
            dt: h, () [s].
            acts: which rows act, (n,); None for all.
            sifts: whether rows that nothing moves are left out, as `nearest` needs it.
            share: s.
        """
        bare = own_diagonal(saddle.mass, rows.jacobian, rows.rate.ndim - 1)
        solve = factor(widened(saddle, saddle.force.ndim - 1))
        start = 0 * saddle.force
        own = cls(rows, solve, saddle, saddle.target, dt, start, bare, acts, share=share)
        return (own._sifted() if sifts else own._begun())._facing()

    def _begun(self) -> Impulse:
        """With the a of no multipliers, and of `probing` forces."""
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
        found = jax.lax.stop_gradient(self.solve(forces, targets).acceleration)
        return dataclasses.replace(self, start=found[:, 0], answers=found[:, 1:])

    def _facing(self) -> Impulse:
        """With the stops that it would pass in place of those that it leaves.

        What is known of a row that changes its side only changes its sign.
        """
        if self.rows.far is None:
            return self
        second, answers = self.rows.passes(self.led(self.start), self.dt), self.answers
        if answers is not None and not self._by_velocities():
            answers = jnp.where(second[None], -answers, answers)
        rows = self.rows.facing(second, self.dt)
        return dataclasses.replace(self, rows=rows, answers=answers)

    def _by_velocities(self) -> bool:
        """Returns True where there are fewer velocities than rows."""
        return isinstance(self.rows.jacobian, Jacobian) and len(self.start) < len(self.bare)

    def _probing(self) -> Array:
        """What each row pulls, or a unit along each velocity, (n_v, k, …)."""
        if not self._by_velocities():
            return jax.lax.stop_gradient(self.rows.jacobian).columns(self.rows.rate)
        unit = gauss_jordan.identity(self.start)
        return jnp.broadcast_to(unit, (*unit.shape[:2], *self.start.shape[1:]))

    def _sifted(self) -> Impulse:
        """Returns the impulse in which only those rows act that some multipliers move.

        As G is not negative, the row of it of one that nothing moves is zero, and so is G z there.
        Where a row does move that is so for hardly any z, and for two of them hardly ever.
        """
        length = jnp.sqrt(self.bare)
        force, none = self.saddle.force, jnp.zeros_like(self.target)
        pulls = [self._pull(z * numerics.safe_divide(1.0, length)) for z in probes(length)]
        forces = [force, *(jnp.broadcast_to(pull, force.shape) for pull in pulls)]
        targets = jnp.stack([self.target, none, none], axis=1)
        found = self.solve(jnp.stack(forces, axis=1), targets).acceleration
        start, *moved = (jax.lax.stop_gradient(found[:, i]) for i in range(3))
        rounding = 64 * float(jnp.finfo(force.dtype).eps) * len(length) ** 0.5
        largest = functools.reduce(
            jnp.maximum, (jnp.abs(self.rows.jacobian.apply(a)) for a in moved)
        )
        moves = largest > rounding * length
        acts = moves if self.acts is None else moves & self.acts
        return dataclasses.replace(self, start=start, acts=acts)

    def judge(self) -> Array:
        """NON_FINITE where a number of the rows is not finite, ().

        Laws and solvers compare numbers, and from what compares false they leave the row out.
        """
        finite = self.rows.finite(self.bare)
        return jnp.where(finite, Status.OK, Status.NON_FINITE).astype(jnp.int32)

    def motion(self, multipliers: Array) -> Solution:
        """a and λ_e under multipliers λ (n,)."""
        return self.alone(self.saddle.force + self._pull(multipliers), self.target)

    def velocity(self, multipliers: Array) -> Array:
        """u at the end of the step, (n,)."""
        return self.led(self.motion(multipliers).acceleration)

    def led(self, acceleration: Array) -> Array:
        """φ̇ + h (J_b a + s J̇_b v), (n,)."""
        return self.rows.rate + self.rows.change(acceleration, self.dt, self.share)

    def moved(self) -> Array | None:
        """∂a/∂λ, (n_v, n), a constant; None where it is not known."""
        if self.answers is None:
            return None
        if not self._by_velocities():
            return self.answers
        j = jax.lax.stop_gradient(self.rows.jacobian)
        return jax.lax.stop_gradient(jnp.swapaxes(j.each(self.answers), 0, 1))

    def without(self, rows: Array) -> Impulse:
        """Returns a problem in which some rows, (n,), do not act."""
        acts = ~rows if self.acts is None else self.acts & ~rows
        return dataclasses.replace(self, acts=acts)

    def matrix(self) -> Array:
        """G, (n, n), a constant."""
        j, moved = jax.lax.stop_gradient(self.rows.jacobian), self.answers
        if moved is None:
            force = self._probing()
            none = jnp.zeros((len(self.target), *force.shape[1:]), force.dtype)
            moved = jax.lax.stop_gradient(self.solve(force, none).acceleration)
        if self._by_velocities():
            moved = jnp.swapaxes(j.each(moved), 0, 1)
        return jax.lax.stop_gradient(self.dt[None, None] * j.each(moved))

    def _pull(self, multipliers: Array) -> Array:
        return self.rows.jacobian.transpose(multipliers)

    def alone(self, force: Array, target: Array) -> Solution:
        """The solution for one right side."""
        a, multipliers, status = self.solve(force[:, None], target[:, None])
        return Solution(a[:, 0], multipliers[:, 0], status[0])

    def moves(self, matrix: Array) -> Array:
        """Returns True where a row acts and moves at all, (n,).

        It does not move where the equality rows hold it, but for rounding. Such a row, as of two
        points of one body, can be neither met nor missed: it is left out.
        """
        own = gauss_jordan.diagonal(matrix)
        rounding = 64 * float(jnp.finfo(matrix.dtype).eps) * self.dt[None] * self.bare
        moving = jax.lax.stop_gradient(own > rounding)
        moving = moving if self.acts is None else moving & self.acts
        kinds = self.rows.kinds
        return kinds.under_normals(kinds.split(moving))

    def react(self, solver: Any, guess: Array | None) -> Reactions:
        """λ by the laws of the rows, with restitution as far as it adds no energy.

        Args:
            solver: `InteriorPoint()` or `GaussSeidel()`, or `Nearest(…)` of one.
            guess: λ of a step ago, (n,), or None.
        """
        if isinstance(solver, Nearest):
            some = solver.leaves_out(self.rows.kinds)
            return self.nearest(solver, guess) if some else self.react(solver.solver, guess)
        rows = self.rows
        matrix = self.matrix()
        moves = self.moves(matrix)
        free = self.led(self.start)
        soft = jnp.where(moves[None] & moves[:, None], matrix, 0)
        soft = jax.lax.stop_gradient(
            soft + rows.compliance[None] * gauss_jordan.identity(rows.rate)
        )

        def met(wanted: Array) -> tuple[Array, Array]:
            offset = jax.lax.stop_gradient(jnp.where(moves, free - wanted, 0))
            bounds = jax.lax.stop_gradient((rows.lower, rows.upper, rows.friction))
            more = jax.lax.stop_gradient(rows.resistance)
            problem = Bounded(soft, offset, *bounds, rows.kinds, more)
            start = jnp.zeros_like(offset) if guess is None else jax.lax.stop_gradient(guess)
            found = jnp.where(moves, solver.solve(problem, start), 0)

            def moved(multipliers: Array) -> Array:
                here = self.velocity(multipliers) + rows.compliance * multipliers - wanted
                return jnp.where(moves, here, 0)

            live = (rows.lower, rows.upper, (rows.friction, *rows.resistance))
            left = problem.worst(found)
            return implicit_multipliers(problem, found, moved, live, solver.smoothing), left

        if rows.restitution is None:
            found, left = met(rows.target)
            return Reactions(found, rows.gap, left, jnp.ones_like(left), None, rows.layout)
        more = restitution_gain(rows, rows.restitution, self.dt)
        (plain, bounced), left = each(met, jnp.stack([rows.target, rows.target + more]))
        without = self.velocity(jnp.zeros_like(more))
        kept = self.harmless(without, plain, bounced - plain)
        found = plain + kept[None] * (bounced - plain)
        return Reactions(found, rows.gap, jnp.max(left, axis=0), kept, None, rows.layout)

    def nearest(self, solver: Nearest, guess: Array | None) -> Reactions:
        """Returns the reactions of the rows that are nearest to act; others have λ = 0."""
        rows, length = self.rows, jnp.sqrt(self.bare)
        distance = numerics.safe_divide(self.led(self.start) - rows.target, length)
        distance = jnp.where(self.acts, distance, jnp.inf)
        choice = solver.choose(rows.kinds, jax.lax.stop_gradient(distance))
        bare, acts = choice.take(self.bare), choice.take(self.acts)
        own = dataclasses.replace(
            self, rows=rows.chosen(choice), bare=bare, acts=acts, answers=None
        )
        known = own.react(solver.solver, None if guess is None else choice.take(guess))
        return dataclasses.replace(
            known, multipliers=choice.put(known.multipliers), gap=rows.gap, layout=rows.layout
        )

    def overlooked(self, multipliers: Array, acceleration: Array) -> Array:
        """By how much rows that do not act miss their u*, at most, ()."""
        kinds, rows = self.rows.kinds, self.rows
        short = jnp.where(multipliers == 0, rows.target - self.led(acceleration), 0)
        parts = kinds.split(jax.lax.stop_gradient(jnp.where(self.acts, short, 0)))
        return jnp.max(jnp.concatenate([parts.single, parts.normal]), axis=0, initial=0)

    def harmless(self, free: Array, multipliers: Array, more: Array) -> Array:
        """An s ≤ 1 for which λ + s Δλ does no work, or no more than λ, by world; 1 where it may be.

        Over a step multipliers do the work h λ·(u₀ + u)/2, u₀ the velocities without them; motors
        and friction in joints, which are boxes, may do what they want.

        Args:
            free: u₀, (n,).
            multipliers: λ, (n,).
            more: Δλ, (n,).
        """
        kinds = self.rows.kinds
        acts = jnp.ones(kinds.size, free.dtype).at[kinds.single : kinds.normal].set(0)
        acts = acts.reshape(-1, *(1,) * (free.ndim - 1))
        change = self.velocity(more + multipliers) - self.velocity(multipliers)
        mean = (free + self.velocity(multipliers)) / 2

        def work(x: Array, u: Array) -> Array:
            return jnp.sum(acts * x * u, axis=0)

        start = work(multipliers, mean)
        linear = work(more, mean) + work(multipliers, change) / 2
        square = work(more, change) / 2
        rounding = 64 * float(jnp.finfo(free.dtype).eps)
        gains = start + linear + square > rounding * work(jnp.abs(more), jnp.abs(mean))
        gains, grows = gains & (start + linear + square > start), linear > 0
        # a common factor leaves the root as it is, and squares of small works beyond float32
        size = functools.reduce(jnp.maximum, map(jnp.abs, (start, linear, square)))
        size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
        room, linear, square = jnp.maximum(-start, 0) / size, linear / size, square / size
        inner = jnp.abs(linear) + numerics.safe_sqrt(linear * linear + 4 * square * room)
        # two forms of one root, each where it subtracts nothing, and none where none is asked
        few = 2 * room / jnp.where(gains & grows & (inner > 0), inner, 1)
        many = inner / jnp.where(gains & ~grows, 2 * square, 1)
        return jnp.where(gains, jnp.clip(jnp.where(grows, few, many), 0, 1), 1)


def probes(like: Array) -> list[Array]:
    """Two fixed vectors (n, …) of random numbers of either sign, 1 to 2 in size."""
    random = np.random.default_rng(0)
    shape = (2, len(like), *(1,) * (like.ndim - 1))
    return list(
        jnp.asarray(random.choice([-1, 1], shape) * random.uniform(1, 2, shape), like.dtype)
    )
