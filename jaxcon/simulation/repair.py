"""Repair of steps that failed: roll back, project, relax (chapter 3.5.4)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.status import Status, failed, first
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep
from jaxcon.model.state import State, is_finite
from jaxcon.simulation.attempt import nothing_seen
from jaxcon.simulation.recovery import contain
from jaxcon.stabilization.baumgarte import Law, check_stabilizer, completes_steps
from jaxcon.stabilization.hybrid import Hybrid
from jaxcon.stabilization.penalty import Penalty
from jaxcon.stabilization.projection import Projection

UNWANTED = Status.NOT_CONVERGED
"""The status of worlds for which no projection was asked."""


@exportable
class Repairs(NamedTuple):
    """What a world remembers of its repairs.

    Attributes:
        relaxation: r, by which the rates of feedback are multiplied, ().
        failures: how many steps in a row have failed, ().
    """

    relaxation: Array
    failures: Array


@pytree
class Recovery(checks.Checked):
    """What a world does when a step fails, by itself: it rolls back, projects, and relaxes.

    A step has failed where its status says so, or where it ends with max |φ| above the limit. The
    world then keeps the state before it, the last valid one, and its time: the step is tried again
    by the next call, with the control of that call, and with weaker feedback,

        α → r α,  β → r β,    r ← shrink · r at a failure,  r ← min(1, growth · r) after a success.

    That is done by what the feedback sees, φ → r² φ and φ̇ → r φ̇, and so works with any; springs of
    a `Penalty` stay as they are. An integrator that keeps constraints by itself has no feedback to
    relax: there projection and damping are what can help. Where the step fails again, or the state
    itself is beyond the limit, the state is also projected to the nearest valid configuration.
    After `retries` failures in a row the failure sticks; at once where the state before the step is
    not finite itself.

    What acted is in `info.status` of each step, as a note: ROLLED_BACK, PROJECTED, or RELAXED where
    the step was taken with r < 1; the state remembers the first note. A world decides by itself and
    the others do not notice. The derivative of a step that was rolled back is that of what was done
    instead.

    Attributes:
        limit: of max |φ| over rows [m, rad]; None for none.
        shrink: of r at a failure.
        growth: of r after a success.
        damping: share of v that a world loses when it rolls back.
        projector: a stabiliser without memory, whose `correct` finds the nearest valid
            configuration; one linearized step of q and v in the metric of M unless given.
        retries: how many failures in a row are repaired.
    """

    limit: Any = None
    shrink: Any = 0.5
    growth: Any = 1.05
    damping: Any = 0.0
    projector: Any = Projection(iterations=1)
    retries: int = static(default=10)

    def check(self) -> None:
        """Checks its numbers.

        Raises:
            ValueError: one is out of range, or the projector moves no positions or has a memory.
            TypeError: the projector is no stabiliser.
        """
        checks.count("Recovery", "retries", self.retries, 0)
        checks.check("Recovery", "shrink", self.shrink, (), above=0, most=1)
        checks.check("Recovery", "growth", self.growth, (), least=1)
        checks.check("Recovery", "damping", self.damping, (), least=0, most=1)
        checks.check("Recovery", "limit", self.limit, (), above=0, optional=True)
        check_stabilizer("Recovery", "projector", self.projector)
        kind = type(self.projector).__name__
        if "position" not in self.projector.corrects:
            raise ValueError(
                f"Recovery: projector={kind} corrects no positions; take a Projection."
            )
        if self.projector.remembers:
            raise ValueError(
                f"Recovery: projector={kind} has a memory, but a projector acts at once; take a"
                " Projection with every=1."
            )

    def init(self, system: Any, q: Array, v: Array) -> Repairs:
        """Full gains, and no failure yet."""
        return Repairs(jnp.ones((), jnp.result_type(q)), jnp.zeros((), jnp.int32))

    def relax(self, stabilizer: Any, memory: Repairs) -> Any:
        """The stabiliser with its feedback made weaker; springs, which are physics, stay."""
        if isinstance(stabilizer, Penalty):
            others = self.relax(stabilizer.others, memory)
            return dataclasses.replace(stabilizer, others=others)
        if isinstance(stabilizer, Hybrid):
            return dataclasses.replace(stabilizer, middle=self.relax(stabilizer.middle, memory))
        return Relaxed(stabilizer, memory.relaxation)

    def judge(self, system: Any, state: State) -> Array:
        """VIOLATED where a state is beyond the limit, ()."""
        if self.limit is None:
            return jnp.zeros_like(state.status)
        rows = linearize(system, state.q, state.v, state.instant)
        return jnp.where(self._beyond(rows), Status.VIOLATED, Status.OK).astype(jnp.int32)

    def repair(self, system: Any, solver: Any, state: State, attempt: Any, dt: Any) -> Any:
        """The outcome of a step, repaired where it failed.

        Args:
            system: as remembered by the state.
            solver: of the method.
            state: before the step; its memory has a part `recovery`.
            attempt: ((new state, info), status of the step).
            dt: h, () [s].

        Returns:
            The same kind of tuple.
        """
        (new, info), code = attempt
        known = state.memory.recovery
        bad = failed(code)
        sound = self._finite(state)
        again = bad & (known.failures < self.retries) & is_finite(state) & sound
        back, note = self._back(system, solver, state, again, dt)
        relaxed = jnp.where(known.relaxation < 1, Status.RELAXED, Status.OK).astype(jnp.int32)
        code = jnp.where(again, note, first(code, relaxed))
        code = first(code, jnp.where(sound, Status.OK, Status.NON_FINITE).astype(jnp.int32))
        new = keep(~again, new, back)
        memory = new.memory._replace(recovery=self._remember(known, bad))
        info = keep(~again, info, nothing_seen(info, state))
        return (dataclasses.replace(new, memory=memory), info), code

    def _finite(self, state: State) -> Array:
        """True where its own numbers are finite, (). Unused ones would still enter derivatives."""
        numbers = (self.limit, self.shrink, self.growth, self.damping)
        known = [jnp.asarray(x, state.q.dtype) for x in numbers if x is not None]
        return functools.reduce(jnp.logical_and, map(jnp.isfinite, known))

    def _remember(self, known: Repairs, bad: Array) -> Repairs:
        r = known.relaxation
        shrink, growth = (jnp.asarray(x, r.dtype) for x in (self.shrink, self.growth))
        relaxation = jnp.where(bad, shrink * r, jnp.minimum(1, growth * r))
        failures = jnp.where(bad, known.failures + 1, 0).astype(jnp.int32)
        return Repairs(relaxation, failures)

    def _back(self, system: Any, solver: Any, state: State, again: Array, dt: Any) -> Any:
        """The state before a step, damped and projected where that is called for, and a note."""
        share = 1 - jnp.asarray(self.damping, state.v.dtype)
        back = dataclasses.replace(state, v=share[None] * state.v)
        wanted = again & (state.memory.recovery.failures > 0)
        if self.limit is not None:
            wanted |= again & failed(self.judge(system, state))
        args = (self.projector, system, solver, back, wanted, dt)
        # most steps of most batches need none
        projected, code = jax.lax.cond(somewhere(wanted), _project, _leave, *args)
        done = ~failed(code)
        note = jnp.where(done, Status.PROJECTED, Status.ROLLED_BACK).astype(jnp.int32)
        return keep(done, projected, back), note

    def _beyond(self, rows: Rows) -> Array:
        limit = jnp.asarray(self.limit, rows.residual.dtype)
        return jnp.max(jnp.abs(rows.residual), axis=0, initial=0) > limit


@pytree
class Relaxed:
    """A stabiliser with all its rates multiplied by r: it sees r² φ and r φ̇."""

    stabilizer: Any
    factor: Array

    @property
    def completes(self) -> bool:
        """Returns True where the stabilizer completes each step."""
        return completes_steps(self.stabilizer)

    def target(self, rows: Rows, memory: PyTree, dt: Any) -> Array:
        """b (n_c,)."""
        return self.stabilizer.target(self._weak(rows), memory, dt)

    def impose(self, rows: Rows, memory: PyTree, dt: Any) -> Law:
        """The law of the stabiliser for what it sees."""
        return self.stabilizer.impose(self._weak(rows), memory, dt)

    def _weak(self, rows: Rows) -> Rows:
        r = self.factor[None]
        return dataclasses.replace(rows, residual=r * r * rows.residual, rate=r * rows.rate)


def _project(*args: Any) -> tuple[State, Array]:
    """The state corrected; where it is not used its derivative, which may be infinite, is none."""
    return contain(_correct, args)


def _correct(
    projector: Any, system: Any, solver: Any, state: State, wanted: Array, dt: Any
) -> tuple[State, Array]:
    """The state corrected where that is wanted, and a failure where it is not or does not help."""
    new, code = projector.correct(system, solver, state, state, (), dt)
    code = first(code, jnp.where(is_finite(new), Status.OK, Status.NON_FINITE).astype(jnp.int32))
    return new, jnp.where(wanted, code, UNWANTED).astype(jnp.int32)


def _leave(
    projector: Any, system: Any, solver: Any, state: State, wanted: Array, dt: Any
) -> tuple[State, Array]:
    """The state as it is, not corrected."""
    return state, jnp.full_like(state.status, UNWANTED)
