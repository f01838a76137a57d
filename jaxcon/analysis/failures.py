"""Where a rollout first went wrong: step, world, and the term of the equations. Host code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.report import UnitRows, dependent_rows
from jaxcon.constraints.rows import Rows, linearize
from jaxcon.core import checks
from jaxcon.core.status import MEANING, Status, failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.dynamics.forward import Dynamics
from jaxcon.model.state import State
from jaxcon.simulation.method import Memory, Method
from jaxcon.simulation.step import check_step, dynamics_at, step_quietly
from jaxcon.solvers.saddle import Solution


@dataclass(frozen=True)
class Finding:
    """A term of the equations that is not as it must be.

    Attributes:
        term: "position", "velocity", "control", "parameter", "mass", "force", "residual", "rate",
            "jacobian", "bias", "compliance", "rows", "acceleration" or "violation".
        name: whose it is: of a body, constraint, force element or control channel.
        detail: what is wrong with it.
    """

    term: str
    name: str
    detail: str

    def __str__(self) -> str:
        return f"{self.term} of '{self.name}' {self.detail}"


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
        """Of the first finding."""
        return self.findings[0].term

    @property
    def name(self) -> str:
        """Of the first finding."""
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
    batch = state.q.ndim > 1
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
    findings, stage, code = _look(system, method, before, control, dt)
    code = Status(int(codes[world])) if failed(codes[world]) else code
    time = float(before.time)
    return Failure(int(count) - 1, world if batch else None, time, code, tuple(findings), stage)


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
            return jax.vmap(policy)(state)
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
    """Whether a step failed, or would have but for a repair."""
    return failed(codes) | (codes == Status.ROLLED_BACK) | (codes == Status.PROJECTED)


def _look(
    system: Any, method: Method, state: State, control: PyTree, dt: Any
) -> tuple[list[Finding], int, Status]:
    """What is wrong in one step of one world, the stage at which it is seen, and its status."""
    control = check_step(system, method, state, control)
    h = jnp.asarray(dt, state.q.dtype)
    found = [*_given(system, state, control)]
    if found:
        return found, 0, Status.NON_FINITE
    plain = dynamics_at(system, method, state, control, h)
    watched = Watched(*(getattr(plain, f.name) for f in dataclasses.fields(plain)))
    memory = Memory(*state.memory)
    advanced = method.integrator.advance(watched, state, memory.integrator, h)
    for stage, (findings, code) in enumerate(watched.seen):
        if findings:
            return findings, stage, code
    q, v, time = advanced.point
    new = dataclasses.replace(state, q=q, v=v, time=time)
    found = [*_entries(system, "velocity", v), *_positions(system, q)]
    if found:
        return found, 0, Status.NON_FINITE
    return [_worst(watched.system, new)], 0, Status.VIOLATED


@dataclass(frozen=True)
class Watched(Dynamics):
    """Dynamics that keep what they find wrong at each stage.

    Attributes:
        seen: findings and status by stage.
    """

    seen: list[tuple[list[Finding], Status]] = field(default_factory=list)

    def __call__(self, q: Array, v: Array, t: Any) -> tuple[Solution, Rows]:
        """a and λ at (q, v, t), and the rows there."""
        solution, rows = super().__call__(q, v, t)
        if checks.is_concrete((q, v, t, solution)):
            self.seen.append(self._judge(q, v, t, solution, rows))
        return solution, rows

    def _judge(
        self, q: Array, v: Array, t: Any, solution: Solution, rows: Rows
    ) -> tuple[list[Finding], Status]:
        """What is wrong at one stage: of the terms, or else of what the solver made of them."""
        code = Status(int(solution.status))
        found = [*_masses(self.system, q), *_forces(self.system, q, v, t, self.control)]
        found += _rows(rows)
        if not found and code == Status.SINGULAR:
            found = _dependent(self.system, q, rows)
        if not found and failed(solution.status):
            reason = "is not finite" if code == Status.NON_FINITE else "was not found"
            found = [Finding("acceleration", type(self.solver).__name__, reason)]
        return found, code if failed(solution.status) else Status.NON_FINITE


def _given(system: Any, state: State, control: PyTree) -> Iterator[Finding]:
    """State, control and parameters that are not finite."""
    yield from _positions(system, state.q)
    yield from _entries(system, "velocity", state.v)
    channels = getattr(getattr(system, "layout", None), "controls", (("control", 0, None),))
    for name, start, stop in channels:
        parts = [np.asarray(x)[start:stop] for x in jax.tree.leaves(control) if np.ndim(x)]
        if any(not np.all(np.isfinite(x)) for x in parts):
            yield Finding("control", name, f"is {np.concatenate(parts).tolist()}")
    params = system.params if isinstance(system.params, dict) else {"params": system.params}
    for name, fields in params.items():
        for path, leaf in jax.tree_util.tree_flatten_with_path(fields)[0]:
            if not np.all(np.isfinite(leaf)):
                key = jax.tree_util.keystr(path, simple=True, separator=".")
                whole = f"{name}.{key}" if key else name
                yield Finding("parameter", whole, f"is {np.asarray(leaf).tolist()}")


def _positions(system: Any, q: Array) -> Iterator[Finding]:
    """Bodies, or coordinates, whose position is not finite."""
    return _infinite("position", q, getattr(system, "layout", None), "q")


def _entries(system: Any, term: str, x: Array) -> Iterator[Finding]:
    """Bodies, or coordinates, whose part of an array (n_v,) is not finite."""
    return _infinite(term, x, getattr(system, "layout", None), "v")


def _infinite(term: str, x: Array, layout: Any, kind: str) -> Iterator[Finding]:
    own = {f"coordinate {i}": np.array([i]) for i in range(len(x))}
    if layout is not None:
        own = {name: getattr(layout, kind)(name) for name in layout.bodies}
    for name, indices in own.items():
        if not np.all(np.isfinite(x[indices])):
            yield Finding(term, name, f"is {x[indices].tolist()}")


def _masses(system: Any, q: Array) -> Iterator[Finding]:
    """Bodies whose mass or moments are not positive."""
    mass = system.mass(q)
    wrong = jnp.where(mass.diagonal > 0, mass.diagonal, jnp.nan)
    yield from (Finding("mass", f.name, "is not positive") for f in _entries(system, "mass", wrong))
    if np.all(mass.diagonal > 0) and mass.singular:
        yield Finding("mass", "the system", "is not positive definite")


def _forces(system: Any, q: Array, v: Array, t: Any, control: PyTree) -> Iterator[Finding]:
    """Force elements whose force on a body is not finite, then bodies whose whole force is not."""
    snapshot = system.snapshot(q, v, t)
    for group in getattr(system, "forces", ()):
        for place, pull in group.pulls(snapshot, control):
            size = sum(jnp.abs(jnp.asarray(lane)) for lane in pull)
            for i in np.flatnonzero(~np.isfinite(np.atleast_1d(size))):
                name = group.names[min(i, len(group.names) - 1)]
                body = system.layout.groups[place.group].names[place.indices[i]]
                yield Finding("force", name, f"on '{body}' is not finite")
    yield from _entries(system, "force", system.force(q, v, t, control))


def _rows(rows: Rows) -> Iterator[Finding]:
    """Constraints of which a term is not finite."""
    terms = {"residual": rows.residual, "rate": rows.rate, "bias": rows.bias}
    if rows.layout.size:
        terms["jacobian"] = rows.jacobian.dense()
    if rows.compliance is not None:
        terms["compliance"] = rows.compliance
    for term, value in terms.items():
        for name in rows.layout.names:
            own = np.asarray(value)[rows.layout.rows(name)]
            if not np.all(np.isfinite(own)):
                yield Finding(term, name, f"is {own.tolist()}")


def _dependent(system: Any, q: Array, rows: Rows) -> list[Finding]:
    """Constraints whose rows are combinations of others."""
    found: dict[str, list[int]] = {}
    unit = UnitRows(rows.layout, rows.jacobian.dense(), system.mass(q).dense())
    for i in dependent_rows(unit.values, unit.tolerance):
        name, row = unit.owners[i]
        found.setdefault(name, []).append(row)
    return [
        Finding("rows", name, f"depend on those before them: {', '.join(map(str, own))}")
        for name, own in found.items()
    ] or [Finding("rows", "the system", "depend on each other to working precision")]


def _worst(system: Any, state: State) -> Finding:
    """The constraint that is furthest off."""
    found = linearize(system, state.q, state.v, state.time).violation
    name = max(found.layout.names, key=lambda n: float(found[n]), default="none")
    size = float(found[name]) if found.layout.names else 0.0
    return Finding("violation", name, f"is {size:.3g} after the step")
