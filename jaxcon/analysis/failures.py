"""Where a rollout first went wrong: step, world, and the term of the equations. Host code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis import findings
from jaxcon.analysis.findings import Finding
from jaxcon.constraints.rows import Rows
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status, failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.forward import Dynamics
from jaxcon.model.state import MethodMemory, State, at_instant
from jaxcon.simulation.attempt import dynamics_at
from jaxcon.simulation.integrators import reached
from jaxcon.simulation.method import Method
from jaxcon.simulation.step import check_step, controls_in, policy_in, step_quietly
from jaxcon.solvers.saddle import Solution


@dataclass(frozen=True)
class Failure:
    """The first step of a rollout that failed; `print` it.

    Attributes:
        step: its number, from 0.
        world: its number in the batch; None where there is but one.
        time: at its start [s].
        status: what it said.
        findings: what was wrong, in the order in which a step computes; the first is the cause,
            others at the same stage may follow from it.
        stage: of the integrator, from 0.
    """

    step: int
    world: int | None
    time: float
    status: Status
    findings: tuple[Finding, ...]
    stage: int = 0

    @property
    def term(self) -> str:
        """The term of the first finding."""
        return self.findings[0].term

    @property
    def name(self) -> str:
        """The name in the first finding."""
        return self.findings[0].name

    def __str__(self) -> str:
        where = "" if self.world is None else f" of world {self.world}"
        stage = f" at stage {self.stage}" if self.stage else ""
        head = f"step {self.step}{where}, from t = {self.time:g} s: {self.status.name}{stage}"
        lines = [f"{head}: {self.findings[0]}", *(f"  then {f}" for f in self.findings[1:])]
        return "\n".join([*lines, MEANING[self.status]])


def find_first_failure(
    system: Any, method: Method, state: State, controls: Any, dt: Any, steps: int
) -> Failure | None:
    """Replays a rollout up to the first step that fails, and says what went wrong in it.

    Failures that the state remembers are forgotten first, so that the final state of a rollout,
    which is the last one before it failed, can be given as well. With a `Recovery` the first step
    that is rolled back counts. The batch runs compiled; the step that failed is then evaluated once
    more, term by term.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: the start, of one world or of a batch, (worlds, …) in each leaf.
        controls: as of `rollout`; arrays for a batch have a first axis of worlds, then of steps.
        dt: h, () [s].
        steps: how many.

    Returns:
        The `Failure`, of the first world where several fail in one step; None where none does.
    """
    checks.count("find_first_failure", "steps", steps, 0)
    checks.check("find_first_failure", "dt", dt, least=0)
    batch = state.q.ndim > 1
    controls = controls if callable(controls) else controls_in(state.q.dtype, controls)
    if not batch:
        state = jax.tree.map(lambda x: x[None], state)
        controls = controls if callable(controls) else jax.tree.map(lambda x: x[None], controls)
    state = dataclasses.replace(state, status=jnp.zeros_like(state.status))
    policy = controls if callable(controls) else None
    args = (system, method, state, None if policy else controls, dt)
    count, before, control, codes = _replay(policy, steps, *args)
    bad = np.flatnonzero(_wrong(codes))
    if not bad.size:
        return None
    world = int(bad[0])
    before, control = jax.tree.map(lambda x: x[world], (before, control))
    found, stage, code = _look(system, method, before, control, dt)
    code = Status(int(codes[world])) if failed(codes[world]) else code
    time = float(before.time)
    return Failure(int(count) - 1, world if batch else None, time, code, tuple(found), stage)


@partial(jax.jit, static_argnums=(0, 1))
def _replay(
    policy: Callable[[State], PyTree] | None,
    steps: int,
    system: Any,
    method: Method,
    state: State,
    controls: PyTree,
    dt: Any,
) -> tuple[Array, State, PyTree, Array]:
    """Steps taken, the states before the last of them, its controls, and what became of it."""

    def control(k: Array, state: State) -> PyTree:
        if policy:
            return jax.vmap(policy_in(policy))(state)
        return jax.tree.map(lambda x: jnp.asarray(x)[:, k], controls)

    def go(carry: Any) -> Array:
        k, _, _, _, codes = carry
        return (k < steps) & ~jnp.any(_wrong(codes))

    def advance(carry: Any) -> Any:
        k, _, state, _, _ = carry
        u = control(k, state)
        new, info = jax.vmap(lambda s, u: step_quietly(system, method, s, u, dt))(state, u)
        return k + 1, state, new, u, info.status

    zero = jnp.zeros((), jnp.int32)
    unknown = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(control, zero, state)
    )
    first = (zero, state, state, unknown, jnp.zeros_like(state.status))
    count, before, _, control_, codes = jax.lax.while_loop(go, advance, first)
    return count, before, control_, codes


def _wrong(codes: Array) -> Array:
    """Returns True where a step failed, or would have but for a repair."""
    return failed(codes) | (codes == Status.ROLLED_BACK) | (codes == Status.PROJECTED)


def _look(
    system: Any, method: Method, state: State, control: PyTree, dt: Any
) -> tuple[list[Finding], int, Status]:
    """What is wrong in one step of one world, the stage at which it is seen, and its status."""
    control = check_step(system, method, state, control)
    h = jnp.asarray(dt, state.q.dtype)
    found = [*findings.given(system, state, control)]
    if found:
        return found, 0, Status.NON_FINITE
    plain = dynamics_at(system, method, state, control, h)
    watched = Watched(*(getattr(plain, f.name) for f in dataclasses.fields(plain)))
    memory = MethodMemory(*state.memory)
    advanced = method.integrator.advance(watched, state, memory.integrator, h)
    if not watched.seen:  # an integrator that iterates shows no values
        watched(state.q, state.v, state.instant)
    for stage, (found, code) in enumerate(watched.seen):
        if found:
            return found, stage, code
    q, v, time = advanced.point
    new = at_instant(dataclasses.replace(state, q=q, v=v), reached(state, time, h))
    found = [*findings.entries(system, "velocity", v), *findings.positions(system, q)]
    if found:
        return found, 0, Status.NON_FINITE
    return [findings.worst(watched.system, new)], 0, Status.VIOLATED


@dataclass(frozen=True)
class Watched(Dynamics):
    """Dynamics that keep what they find wrong at each stage.

    Attributes:
        seen: findings and status by stage.
    """

    seen: list[tuple[list[Finding], Status]] = field(default_factory=list)

    def factored(self, q: Array, v: Array, t: Any, age: Any = None, ahead: Any = None) -> Any:
        """`Dynamics.factored` at (q, v, t), watched."""
        return self._watched(q, v, t, super().factored(q, v, t, age, ahead))

    def _watched(self, q: Array, v: Array, t: Any, found: Any) -> Any:
        """What was found, after a look at it."""
        if checks.is_concrete((q, v, t, found[0])):
            self.seen.append(self._judge(q, v, t, *found[:2]))
        return found

    def _judge(
        self, q: Array, v: Array, t: Any, solution: Solution, rows: Rows
    ) -> tuple[list[Finding], Status]:
        """What is wrong at one stage: of the terms, or else of what the solver made of them."""
        code = Status(int(solution.status))
        system = self.system
        found = [*findings.masses(system, q), *findings.forces(system, q, v, t, self.control)]
        found += findings.terms(rows)
        if not found and code == Status.SINGULAR:
            found = findings.dependent(system, q, rows)
        if not found and failed(solution.status):
            reason = "is not finite" if code == Status.NON_FINITE else "was not found"
            found = [Finding("acceleration", type(self.solver).__name__, reason)]
        return found, code if failed(solution.status) else Status.NON_FINITE
