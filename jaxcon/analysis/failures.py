"""Locates the first failure of a rollout: the step, the world and the wrong term. Host code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis import findings
from jaxcon.analysis.findings import Finding
from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled
from jaxcon.core.status import MEANING, Status, failed
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.step import step_quietly
from jaxcon.execution.validation import check_step, controls_in, policy_in
from jaxcon.linear.saddle import Solution
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.step import Dynamics, Solved, reached
from jaxcon.system.state import MethodMemory, State, at_instant, with_turns

Carry: TypeAlias = tuple[Array, State, State, PyTree, Array]
"""The loop carry of `_replay`: the number of steps taken, and four values of the last step.

These values are the states before the step, the states after it, the controls, and the status
codes.
"""


@dataclass(frozen=True)
class Failure:
    """The first failing step of a rollout; `print` it.

    Attributes:
        step: index of the step, from 0.
        world: index of the world in the batch; None for a single world.
        time: time at the start of the step [s].
        status: status of the step.
        findings: the wrong terms, in the order in which a step computes them. The first one is the
            cause. The others occur at the same stage and may be its consequences.
        stage: index of the integrator's stage, from 0.
    """

    step: int
    world: int | None
    time: float
    status: Status
    findings: tuple[Finding, ...]
    stage: int = 0

    @property
    def term(self) -> str:
        """The wrong term of the first finding, such as "force"."""
        return self.findings[0].term

    @property
    def name(self) -> str:
        """The name of the body, constraint, force or control channel in the first finding."""
        return self.findings[0].name

    def __str__(self) -> str:
        where = "" if self.world is None else f" of world {self.world}"
        stage = f" at stage {self.stage}" if self.stage else ""
        head = f"step {self.step}{where}, from t = {self.time:g} s: {self.status.name}{stage}"
        lines = [f"{head}: {self.findings[0]}", *(f"  then {f}" for f in self.findings[1:])]
        return "\n".join([*lines, MEANING[self.status]])


def find_first_failure(
    system: System,
    method: Method,
    state: State,
    controls: PyTree | Callable[[State], PyTree],
    dt: Scalar,
    steps: int,
) -> Failure | None:
    """Replays a rollout up to its first failing step, and reports the wrong terms of that step.

    A failure status in the initial state is reset first. One may thus start from the final state of
    a failed rollout, which is the last state before the failure. If the method has a `Recovery`,
    the first repaired step counts as failed. The batch runs compiled. The failing step is then
    evaluated once more, term by term.

    Args:
        system: the system of a built scene, or a `jc.GeneralizedSystem`.
        method: integrator, stabilizer and solver.
        state: initial state of one world, or of a batch with a leading axis of worlds in each leaf.
        controls: control inputs, as in `jc.rollout`. For a batch, arrays have a leading axis of
            worlds, then one of steps.
        dt: step size h, () [s].
        steps: number of steps.

    Returns:
        A `jc.analysis.Failure`; None if no world fails. If several worlds fail in the same step,
        the result describes the world with the lowest index.
    """
    checks.count("find_first_failure", "steps", steps, 0)
    checks.check("find_first_failure", "dt", dt, least=0)
    batch = state.q.ndim > 1
    controls = controls if callable(controls) else controls_in(state.q.dtype, controls)
    if not batch:
        state = jax.tree.map(lambda x: x[None], state)
        controls = controls if callable(controls) else jax.tree.map(lambda x: x[None], controls)
    # the final state of a failed rollout keeps its status, which would stop the replay at once
    state = dataclasses.replace(state, status=jnp.zeros_like(state.status))
    policy = controls if callable(controls) else None
    args = (system, method, state, None if policy else controls, dt)
    count, before, control, codes = _replay(policy, steps, *args)
    bad = np.flatnonzero(_wrong(codes))
    if not bad.size:
        return None
    world = int(bad[0])
    before, control = jax.tree.map(lambda x: x[world], (before, control))
    wrong, stage, code = _look(system, method, before, control, dt)
    code = Status(int(codes[world])) if failed(codes[world]) else code
    time = float(before.time)
    return Failure(int(count) - 1, world if batch else None, time, code, tuple(wrong), stage)


@partial(jax.jit, static_argnums=(0, 1))
def _replay(
    policy: Callable[[State], PyTree] | None,
    steps: int,
    system: System,
    method: Method,
    state: State,
    controls: PyTree,
    dt: Scalar,
) -> tuple[Array, State, PyTree, Array]:
    """Runs a batch up to the first failing step.

    Args:
        policy: function from state to controls; None if controls are arrays.
        steps: largest number of steps.
        system: the system.
        method: the method.
        state: initial states, with a leading axis of worlds.
        controls: control inputs, (worlds, steps, …); None with a policy.
        dt: step size [s].

    Returns:
        The number of steps taken; then the states before the last step, the controls of that step,
        and its status codes.
    """

    def control(k: Array, state: State) -> PyTree:
        if policy:
            return jax.vmap(policy_in(policy))(state)
        return jax.tree.map(lambda x: jnp.asarray(x)[:, k], controls)

    def goes_on(carry: Carry) -> Array:
        k, _, _, _, codes = carry
        return (k < steps) & ~jnp.any(_wrong(codes))

    def advance(carry: Carry) -> Carry:
        k, _, state, _, _ = carry
        u = control(k, state)
        new, info = jax.vmap(lambda s, u: step_quietly(system, method, s, u, dt))(state, u)
        return k + 1, state, new, u, info.status

    zero = jnp.zeros((), jnp.int32)
    no_control = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(control, zero, state)
    )
    first = (zero, state, state, no_control, jnp.zeros_like(state.status))
    count, before, _, last, codes = jax.lax.while_loop(goes_on, advance, first)
    return count, before, last, codes


def _wrong(codes: Array) -> Array:
    """Returns True where a step failed or was repaired by a `Recovery`."""
    return failed(codes) | (codes == Status.ROLLED_BACK) | (codes == Status.PROJECTED)


def _look(
    system: System, method: Method, state: State, control: PyTree, dt: Scalar
) -> tuple[list[Finding], int, Status]:
    """Evaluates one step of one world term by term.

    Returns:
        The wrong terms; the index of the integrator's stage where they occur; and the failure
        status that belongs to them.
    """
    control = check_step(system, method, state, control)
    h = jnp.asarray(dt, state.q.dtype)
    wrong = [*findings.given(system, state, control)]
    if wrong:
        return wrong, 0, Status.NON_FINITE
    turned = with_turns(system, state.turns, state.angle_remainder)
    plain = method.dynamics(turned, state, control, h)
    watched = Watched(*(getattr(plain, f.name) for f in dataclasses.fields(plain)))
    memory = MethodMemory(*state.memory)
    advanced = method.integrator.advance(watched, state, memory.integrator, h)
    if not watched.seen:  # an iterating integrator calls the dynamics with traced values only
        watched(state.q, state.v, state.instant)
    for stage, (wrong, code) in enumerate(watched.seen):
        if wrong:
            return wrong, stage, code
    q, v, time = advanced.point
    new = at_instant(dataclasses.replace(state, q=q, v=v), reached(state, time, h))
    wrong = [*findings.velocities(system, v), *findings.positions(system, q)]
    if wrong:
        return wrong, 0, Status.NON_FINITE
    return [findings.worst(watched.system, new)], 0, Status.VIOLATED


@dataclass(frozen=True)
class Watched(Dynamics):
    """Dynamics that record the wrong terms at each stage of the integrator.

    Attributes:
        seen: (wrong terms, status) for each stage.
    """

    seen: list[tuple[list[Finding], Status]] = field(default_factory=list)

    def solve(
        self,
        rows: Rows,
        q: Array,
        v: Array,
        t: Doubled | Array,
        rate_delay: Array | None = None,
        every_landing: bool = False,
    ) -> Solved:
        """Solves for accelerations and multipliers, and records the wrong terms of this stage.

        Nothing is recorded if the values are traced.
        """
        solved = super().solve(rows, q, v, t, rate_delay, every_landing)
        if checks.is_concrete((q, v, t, solved.solution)):
            self.seen.append(self._judge(q, v, t, solved.solution, solved.rows))
        return solved

    def _judge(
        self, q: Array, v: Array, t: Doubled | Array, solution: Solution, rows: Rows
    ) -> tuple[list[Finding], Status]:
        """Finds the wrong terms at one stage of the integrator.

        If no term is wrong but the solver failed, the findings name the dependent rows for status
        SINGULAR, and the solver for any other status.

        Returns:
            The wrong terms; and the status of a step that fails at this stage. It is the solver's
            failure status, or NON_FINITE if the solver did not fail.
        """
        code = Status(int(solution.status))
        system = self.system
        wrong = [*findings.masses(system, q), *findings.forces(system, q, v, t, self.control)]
        wrong += findings.terms(rows)
        if not wrong and code == Status.SINGULAR:
            wrong = findings.dependent(system, q, rows)
        if not wrong and failed(solution.status):
            reason = "is not finite" if code == Status.NON_FINITE else "was not found"
            wrong = [Finding("acceleration", type(self.solver).__name__, reason)]
        return wrong, code if failed(solution.status) else Status.NON_FINITE
