"""Simulations with one method, compiled once: step size and number of steps are traced.

The simulated time (horizon) is cut into equal parts, and every step size divides a part. Runs are
compared at the ends of parts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.cores import compiler_options
from jaxcon.core.precision import cast, precision
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.execution.initialize import init
from jaxcon.execution.step import step_quietly
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.readout.quantities import energy, violation
from jaxcon.system.state import State

PARTS = 10
"""The least number of parts of a horizon, except with a policy.

If an array of controls has more rows than this, each row has a part of its own. With a policy, each
interval `hold` is a part.
"""


class Points(NamedTuple):
    """Positions, velocities, times and counted turns of a world at n instants.

    Attributes:
        q: positions, (n, n_q).
        v: velocities, (n, n_v).
        time: times, (n,) [s].
        turns: counted angles of joints, as in `State.turns`, (n, …) [rad].
    """

    q: Any
    v: Any
    time: Any
    turns: Any

    @classmethod
    def of(cls, state: State) -> Points:
        """Returns the points of a state or a trajectory.

        Args:
            state: one state, or states with a leading axis.
        """
        counted = jax.tree.leaves(state.turns)
        turns = counted[0] if counted else np.zeros((*np.shape(state.time), 0))
        return cls(state.q, state.v, state.time, turns)

    def begin(self, system: System, method: Method) -> State:
        """Returns a state at this single point, with the initial memory of a method."""
        turns = self.turns if self.turns.size else None
        return init(system, method, self.q, self.v, self.time, turns)


@dataclass(frozen=True)
class Inputs:
    """Control inputs that do not depend on the step size: constant over each part of the horizon.

    Attributes:
        parts: number of parts of the horizon.
        rows: control inputs with a leading axis of parts; None without arrays of controls.
        policy: function from state to controls, evaluated at the start of each part; or None.
    """

    parts: int
    rows: PyTree = None
    policy: Callable[[State], PyTree] | None = None

    @classmethod
    def of(
        cls,
        system: System,
        controls: PyTree | Callable[[State], PyTree],
        hold: float | None,
        horizon: float,
    ) -> Inputs:
        """Converts the user's controls to inputs by parts.

        Args:
            system: the system.
            controls: None, an array of rows of control inputs, or a function of the state.
            hold: time for which each value of the function is held [s].
            horizon: simulated time [s].

        Raises:
            ValueError: `controls` has no leading axis of rows, or is a function without `hold`.
        """
        if callable(controls):
            return cls(_holds(hold, horizon), policy=controls)
        if hold is not None:
            raise ValueError(
                "tradeoff: hold= belongs to controls that are a function of the state; the rows of"
                " an array are held for horizon / rows each."
            )
        if controls is None:
            return cls(PARTS)
        layout = system.layout
        rows = jax.tree.map(np.asarray, controls)
        if layout is not None and np.ndim(rows) == 1:
            rows = rows[None]
        lengths = {np.shape(x)[0] if np.ndim(x) else 0 for x in jax.tree.leaves(rows)}
        if len(lengths) != 1 or 0 in lengths or layout and rows.shape[1:] != (layout.n_u,):
            shapes = [np.shape(x) for x in jax.tree.leaves(controls)]
            names = [] if layout is None else [name for name, *_ in layout.controls]
            channels = "" if layout is None else f" of {layout.n_u} channels of {names}"
            raise ValueError(
                f"tradeoff: controls must have rows{channels}, each held for an equal part of the"
                f" horizon, got shapes {shapes}; a constant control has one row, u[None]."
            )
        count = lengths.pop()
        each = -(-PARTS // count)
        return cls(count * each, jax.tree.map(lambda x: np.repeat(x, each, 0), rows))


def _holds(hold: float | None, horizon: float) -> int:
    """Returns the number of parts of the horizon if each input is held for `hold` seconds.

    Raises:
        ValueError: `hold` is missing or does not divide the horizon.
    """
    if hold is None:
        raise ValueError(
            "tradeoff: controls that are a function of the state need hold=, the time in seconds"
            " for which each value is held; else they would mean another thing at every step."
        )
    checks.check("tradeoff", "hold", hold, above=0)
    count = round(horizon / float(hold))
    if count < 1 or abs(count * float(hold) / horizon - 1) > 1e-6:
        raise ValueError(
            f"tradeoff: hold must divide the horizon, got {hold:g} s and {horizon:g} s."
        )
    return count


@dataclass(frozen=True)
class Problem:
    """The problem that all runs simulate, in any precision.

    Attributes:
        system: the system.
        start: the initial point, as float64 arrays on the host.
        horizon: simulated time [s].
        inputs: control inputs.
    """

    system: System
    start: Points
    horizon: float
    inputs: Inputs

    @property
    def parts(self) -> int:
        """The number of parts of the horizon."""
        return self.inputs.parts

    def dt(self, count: int) -> float:
        """Returns the step size [s] for `count` steps per part of the horizon."""
        return self.horizon / (self.parts * count)


@dataclass(frozen=True)
class Trip:
    """The simulation of one world over the horizon.

    Attributes:
        dt: step size h [s].
        points: points at the ends of the parts, as float64 arrays on the host.
        status: status at the end.
        violation: the largest |φ| over the starts of all steps.
        seconds: computing time [s].
    """

    dt: float
    points: Points
    status: Status
    violation: float
    seconds: float

    @property
    def failed(self) -> bool:
        """True if a step failed, or a position or velocity is not finite."""
        finite = all(np.all(np.isfinite(x)) for x in (self.points.q, self.points.v))
        return bool(failed(jnp.asarray(int(self.status)))) or not finite


class Lowered:
    """A traced program in one precision; `compile` compiles it.

    Attributes:
        lowered: the traced program.
        program: the compiled program; None before `compile`.
        dtype: floating-point dtype of the program.
    """

    lowered: Any
    program: Any = None
    dtype: np.dtype

    def compile(self) -> None:
        """Compiles the program, which takes seconds."""
        self.program = self.lowered.compile(dict(compiler_options))

    def numbers(self, dt: float, count: int) -> tuple[Array, Array]:
        """Converts the step size h and the number of steps to arguments of the program."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(count, jnp.int32)


class Course(Lowered):
    """The program that simulates a problem by one method in one precision."""

    def __init__(self, problem: Problem, method: Method, dtype: str | DType) -> None:
        self.dtype, self.problem = np.dtype(dtype), problem
        with precision(dtype):
            system, method = cast((problem.system, method), dtype)
            policy, parts = problem.inputs.policy, problem.parts
            rows = cast(problem.inputs.rows, dtype)
            start = cast(problem.start, dtype).begin(system, method)

            def travel(start: State, rows: PyTree, h: Array, count: Array) -> tuple[State, Array]:
                return along(system, method, policy, start, rows, h, count, parts)

            self.args = start, rows
            self.lowered = jax.jit(travel).lower(*self.args, *self.numbers(1e-3, 1))

    def go(self, dt: float, count: int) -> Trip:
        """Simulates the whole horizon.

        Args:
            dt: step size [s].
            count: number of steps per part.
        """
        with precision(self.dtype):
            numbers = self.numbers(dt, count)
            begin = time.perf_counter()
            state, worst = jax.block_until_ready(self.program(*self.args, *numbers))
            spent = time.perf_counter() - begin
        points = jax.tree.map(lambda x: np.asarray(x, np.float64), Points.of(state))
        # a failure status persists, so the last one shows whether any step failed
        code = Status(int(np.asarray(state.status)[-1]))
        return Trip(dt, points, code, float(worst), spent)


def along(
    system: System,
    method: Method,
    policy: Callable[[State], PyTree] | None,
    start: State,
    rows: PyTree,
    h: Array,
    count: Array,
    parts: int,
) -> tuple[State, Array]:
    """Simulates all parts of a horizon.

    Args:
        system: the system.
        method: the method.
        policy: function from state to controls, evaluated at the start of each part; None with
            rows.
        start: the initial state.
        rows: control inputs with a leading axis of parts; or None.
        h: step size, () [s].
        count: number of steps per part, ().
        parts: number of parts.

    Returns:
        The states at the ends of the parts, with a leading axis of parts; and the largest |φ| over
        all steps, ().
    """

    def part(carry: tuple[State, Array], row: PyTree) -> tuple[tuple[State, Array], State]:
        control = row if policy is None else policy(carry[0])

        def step(_: Array, carry: tuple[State, Array]) -> tuple[State, Array]:
            state, worst = carry
            state, info = step_quietly(system, method, state, control, h)
            return state, jnp.maximum(worst, info.violation.worst)

        carry = jax.lax.fori_loop(0, count, step, carry)
        return carry, carry[0]

    carry = start, jnp.zeros((), start.q.dtype)
    (_, worst), states = jax.lax.scan(part, carry, rows, parts)
    return states, worst


class Observation(NamedTuple):
    """Energies and constraint violations of a world at n instants.

    Attributes:
        energy: total energy, (n,) [J].
        kinetic: kinetic energy, (n,) [J].
        violation: max |φ|, (n,) [m, rad].
        rate: max |φ̇|, (n,) [m/s, rad/s].
    """

    energy: np.ndarray
    kinetic: np.ndarray
    violation: np.ndarray
    rate: np.ndarray


class Observer:
    """Evaluates energies and violations at points in float64, with a program compiled once."""

    def __init__(self, problem: Problem) -> None:
        with precision(np.float64):
            self.system = cast(problem.system, np.float64)

            def read(points: Points) -> tuple[Array, Array, Array, Array]:
                ok = jnp.zeros((), jnp.int32)
                state = State(points.q, points.v, points.time, ok, (), points.turns)
                φ, mechanical = violation(self.system, state), energy(self.system, state)
                return mechanical.total, mechanical.kinetic, φ.worst, φ.worst_rate

            self.read = jax.jit(jax.vmap(read))

    def __call__(self, points: Points) -> Observation:
        """Returns the energies and violations at n points."""
        with precision(np.float64):
            return Observation(*(np.asarray(x) for x in self.read(cast(points, np.float64))))
