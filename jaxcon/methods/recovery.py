"""Repair of failed steps: roll back, project, and relax the feedback (chapter 3.5.4)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.somewhere import somewhere
from jaxcon.core.status import Status, failed, first
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.saddle import Saddle, Solution
from jaxcon.methods.baumgarte import Wrapper, check_stabilizer, weakened
from jaxcon.methods.gains import check_numbers
from jaxcon.methods.hybrid import Hybrid
from jaxcon.methods.penalty import Penalty
from jaxcon.methods.projection import Projection
from jaxcon.protocols import Solver, Stabilizer, System
from jaxcon.staging.failure import mask_failed_gradients
from jaxcon.staging.worlds import where_tree
from jaxcon.step import StepInfo
from jaxcon.system.state import MethodMemory, State, is_finite


@exportable
class Repairs(NamedTuple):
    """The memory of a `Recovery`.

    Attributes:
        relaxation: factor r of the feedback rates, ().
        failures: number of consecutive failed steps, ().
    """

    relaxation: Array
    failures: Array


@pytree
class Recovery(checks.Checked):
    """Repairs failed steps: a world rolls back, projects its state and relaxes its feedback.

    A step fails if its status is a failure, or if it ends with max |φ| above the limit. The world
    then keeps the last valid state and its time. The next call retries the step, with the control
    of that call and with weaker feedback:

        α → r α,  β → r β,    r ← shrink · r at a failure,  r ← min(1, growth · r) after a success.

    The feedback gets r² φ and r φ̇ in place of φ and φ̇, which works for any feedback. Springs of a
    `Penalty` do not change. An integrator that satisfies constraints by itself has no feedback to
    relax; only projection and damping can help it. If the step fails again, or the state before the
    step violates the limit, the state is also projected to the nearest valid configuration. After
    `retries` consecutive failures, the failure is final. It is final at once if the state before
    the step is not finite.

    `info.status` of each step reports the repair: ROLLED_BACK, PROJECTED, or RELAXED if the step
    was taken with r < 1. The status of the state keeps the first such report. Worlds of a batch are
    independent of each other. A step that was rolled back has the derivative of its repair.

    Attributes:
        limit: the largest valid |φ| over all rows [m, rad]; None for no limit.
        shrink: the factor of r at a failure.
        growth: the factor of r after a success.
        damping: fraction of v that a world loses when it rolls back.
        projector: a stabilizer without memory, whose `correct` finds the nearest valid
            configuration. The default is one linearized step of q and v in the metric of M.
        retries: number of consecutive failures that are repaired.
    """

    limit: Any = None
    shrink: Any = 0.5
    growth: Any = 1.05
    damping: Any = 0.0
    projector: Any = Projection(iterations=1)
    retries: int = static(default=10)

    def check(self) -> None:
        """Checks the numbers and the projector.

        Raises:
            ValueError: a number is out of range, or the projector does not correct positions or has
                a memory.
            TypeError: the projector is not a stabilizer.
        """
        checks.count("Recovery", "retries", self.retries, 0)
        check_numbers(
            self,
            shrink={"above": 0, "most": 1},
            growth={"least": 1},
            damping={"least": 0, "most": 1},
            limit={"above": 0, "optional": True},
        )
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

    def init(self, system: System, q: Array, v: Array) -> Repairs:
        """Returns the memory at the start: relaxation factor r = 1, and no failures."""
        return Repairs(jnp.ones((), jnp.result_type(q)), jnp.zeros((), jnp.int32))

    def relax(self, stabilizer: Stabilizer, memory: Repairs) -> Stabilizer:
        """Returns the stabilizer with relaxed feedback. Springs are physical and do not change."""
        if isinstance(stabilizer, Penalty):
            return stabilizer.with_inner(self.relax(stabilizer.others, memory))
        if isinstance(stabilizer, Hybrid):
            return dataclasses.replace(stabilizer, middle=self.relax(stabilizer.middle, memory))
        return Relaxed(stabilizer, memory.relaxation)

    def judge(self, system: System, state: State) -> Array:
        """Returns the status VIOLATED if max |φ| of a state is above the limit, else OK, ()."""
        if self.limit is None:
            return jnp.zeros_like(state.status)
        residual = linearize(system, state.q, state.v, state.instant).residual
        limit = jnp.asarray(self.limit, residual.dtype)
        beyond = jnp.max(jnp.abs(residual), axis=0, initial=0) > limit
        return jnp.where(beyond, Status.VIOLATED, Status.OK).astype(jnp.int32)

    def repair(
        self,
        system: System,
        solver: Solver,
        state: State,
        attempt: tuple[tuple[State, StepInfo], Array],
        dt: Array,
    ) -> tuple[tuple[State, StepInfo], Array]:
        """Returns the result of a step, with failed worlds repaired.

        Args:
            system: system with the whole turns of the state.
            solver: solver of the method.
            state: state before the step; its memory has the field `recovery`.
            attempt: ((new state, info), status of the step).
            dt: step size h, () [s].

        Returns:
            ((new state, info), status of the step), like `attempt`.
        """
        (new, info), code = attempt
        repairs, bad = MethodMemory(*state.memory).recovery, failed(code)
        numbers = (self.limit, self.shrink, self.growth, self.damping)
        arrays = (jnp.asarray(x, state.q.dtype) for x in numbers if x is not None)
        # an invalid number would enter derivatives even where it is not used
        sound = functools.reduce(jnp.logical_and, map(jnp.isfinite, arrays))
        again = bad & (repairs.failures < self.retries) & is_finite(state) & sound

        # roll back, and project worlds that need it
        left = 1 - jnp.asarray(self.damping, state.v.dtype)
        back = dataclasses.replace(state, v=left[None] * state.v)
        wanted = again & (repairs.failures > 0)
        if self.limit is not None:
            wanted |= again & failed(self.judge(system, state))

        def projected(
            projector: Stabilizer,
            system: System,
            solver: Solver,
            state: State,
            wanted: Array,
            dt: Array,
        ) -> tuple[State, Array]:
            """Returns the projected state and a status.

            The status is a failure if the projection fails, if its result is not finite, or if the
            world needs no projection (`wanted` is False).
            """
            new, code = projector.correct(system, solver, state, state, (), dt)
            finite = jnp.where(is_finite(new), Status.OK, Status.NON_FINITE).astype(jnp.int32)
            code = jnp.where(wanted, first(code, finite), Status.NOT_CONVERGED)
            return new, code.astype(jnp.int32)

        # most batches need no projection; an unused one may have infinite derivatives
        closest, projection = jax.lax.cond(
            somewhere(wanted),
            lambda *args: mask_failed_gradients(projected, args),
            lambda *args: (args[3], jnp.full_like(state.status, Status.NOT_CONVERGED)),
            *(self.projector, system, solver, back, wanted, dt),
        )
        done = ~failed(projection)
        note = jnp.where(done, Status.PROJECTED, Status.ROLLED_BACK).astype(jnp.int32)
        back = where_tree(done, closest, back)

        # update the status and the memory
        relaxed = jnp.where(repairs.relaxation < 1, Status.RELAXED, Status.OK).astype(jnp.int32)
        code = jnp.where(again, note, first(code, relaxed))
        code = first(code, jnp.where(sound, Status.OK, Status.NON_FINITE).astype(jnp.int32))
        r = repairs.relaxation
        shrink, growth = (jnp.asarray(x, r.dtype) for x in (self.shrink, self.growth))
        r = jnp.where(bad, shrink * r, jnp.minimum(1, growth * r))
        failures = jnp.where(bad, repairs.failures + 1, 0).astype(jnp.int32)
        new = where_tree(~again, new, back)
        memory = MethodMemory(*new.memory)._replace(recovery=Repairs(r, failures))
        info = where_tree(~again, info, info.of_failed_world(state))
        return (dataclasses.replace(new, memory=memory), info), code


@pytree
class Relaxed(Wrapper):
    """Multiplies all rates of an inner stabilizer by r: it gets r² φ and r φ̇ in place of φ and φ̇.

    Attributes:
        stabilizer: the inner stabilizer.
        factor: factor r of the rates, ().
    """

    stabilizer: Stabilizer
    factor: Array
    inner_field: ClassVar[str] = "stabilizer"

    @property
    def completes(self) -> bool:
        """True if the inner stabilizer completes the constraint forces of the step."""
        return self.stabilizer.completes

    def constraint_equations(self, rows: Rows, memory: PyTree, dt: Array) -> Rows:
        """Returns the inner stabilizer's equations, with decay rates [1/s] scaled by `factor`."""
        weak = weakened(rows, self.factor[None])
        return self.stabilizer.constraint_equations(weak, memory, dt)

    def solve(
        self, solver: Solver, rows: Rows, memory: PyTree, dt: Array, system: Saddle
    ) -> Solution | None:
        """Returns the inner stabilizer's solution, with decay rates [1/s] scaled by `factor`.

        It is None if the inner stabilizer leaves the solution to the solver.
        """
        weak = weakened(rows, self.factor[None])
        return self.stabilizer.solve(solver, weak, memory, dt, system)

    @property
    def solves(self) -> bool:
        """True if the inner stabilizer has a `solve` method of its own."""
        return self.stabilizer.solves
