"""One method along a horizon, compiled once for every step: h and the number of steps are traced.

The horizon is cut into equal parts, at whose ends runs are compared; every step divides a part.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.analysis.quantities import energy, violation
from jaxcon.core import checks
from jaxcon.core.precision import cast, precision
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.state import State
from jaxcon.simulation.initialize import init
from jaxcon.simulation.method import Method
from jaxcon.simulation.step import step_quietly

PARTS = 10
"""The number of parts of a horizon, unless its control inputs change more often."""


class Points(NamedTuple):
    """Where a world is at several times: q (n, n_q), v (n, n_v), t (n,) and counted turns."""

    q: Any
    v: Any
    time: Any
    turns: Any

    @classmethod
    def of(cls, state: State) -> Points:
        """Returns the points of one state, or of a trajectory."""
        counted = jax.tree.leaves(state.turns)
        turns = counted[0] if counted else np.zeros((*np.shape(state.time), 0))
        return cls(state.q, state.v, state.time, turns)

    def begin(self, system: Any, method: Method) -> State:
        """A state at one of them with the memory of a method."""
        turns = self.turns if self.turns.size else None
        return init(system, method, self.q, self.v, self.time, turns)


@dataclass(frozen=True)
class Inputs:
    """Control inputs that mean the same at every step: each value is held over a part.

    Attributes:
        parts: of the horizon.
        rows: one control a part, arrays with a first axis of parts; None without.
        policy: a function of the state, read at the start of each part; None where there are rows.
    """

    parts: int
    rows: PyTree = None
    policy: Callable[[State], PyTree] | None = None

    @classmethod
    def of(cls, system: Any, controls: Any, hold: float | None, horizon: float) -> Inputs:
        """Returns the controls that a user gave.

        Raises:
            ValueError: no array by time, or a function without the time for which it is held.
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
        layout = getattr(system, "layout", None)
        rows = jax.tree.map(np.asarray, controls)
        if layout is not None and np.ndim(rows) == 1:
            rows = rows[None]
        lengths = {np.shape(x)[0] if np.ndim(x) else 0 for x in jax.tree.leaves(rows)}
        if len(lengths) != 1 or 0 in lengths or layout and rows.shape[1:] != (layout.n_u,):
            shapes = [np.shape(x) for x in jax.tree.leaves(controls)]
            names = [] if layout is None else [name for name, *_ in layout.controls]
            own = "" if layout is None else f" of {layout.n_u} channels of {names}"
            raise ValueError(
                f"tradeoff: controls must have rows{own}, each held for an equal part of the"
                f" horizon, got shapes {shapes}; a constant control has one row, u[None]."
            )
        count = lengths.pop()
        each = -(-PARTS // count)
        return cls(count * each, jax.tree.map(lambda x: np.repeat(x, each, 0), rows))

    def at(self, dtype: Any) -> Inputs:
        """In a precision, within it."""
        return Inputs(self.parts, cast(self.rows, dtype), self.policy)


def _holds(hold: float | None, horizon: float) -> int:
    """Into how many parts a horizon is cut by the time for which an input is held."""
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
    """What is simulated: arrays of the host, from which runs in any precision start."""

    system: Any
    start: Points
    horizon: float
    inputs: Inputs

    @property
    def parts(self) -> int:
        """The number of parts of the horizon."""
        return self.inputs.parts

    def dt(self, count: int) -> float:
        """h at so many steps a part [s]."""
        return self.horizon / (self.parts * count)


@dataclass(frozen=True)
class Trip:
    """One world along the horizon.

    Attributes:
        dt: h [s].
        points: at the ends of the parts, on the host in float64.
        status: at the end.
        violation: max |φ| that a step saw at its start.
        seconds: that it took.
    """

    dt: float
    points: Points
    status: Status
    violation: float
    seconds: float

    @property
    def failed(self) -> bool:
        """Returns True where it stopped, or is not finite."""
        finite = all(np.all(np.isfinite(x)) for x in (self.points.q, self.points.v))
        return bool(failed(jnp.asarray(int(self.status)))) or not finite


class Lowered:
    """A traced program in one precision, which `compile` makes ready.

    Attributes:
        lowered: the traced program.
        program: the compiled one.
        dtype: of its numbers.
    """

    lowered: Any
    program: Any = None
    dtype: np.dtype

    def compile(self) -> None:
        """Makes it ready; takes seconds."""
        self.program = self.lowered.compile()

    def numbers(self, dt: float, count: int) -> tuple[Array, Array]:
        """h and a number of steps as arguments."""
        return jnp.asarray(dt, self.dtype), jnp.asarray(count, jnp.int32)


class Course(Lowered):
    """One method in one precision on a problem; h and the number of steps are traced."""

    def __init__(self, problem: Problem, method: Method, dtype: Any) -> None:
        self.dtype, self.problem = np.dtype(dtype), problem
        with precision(dtype):
            system, own = cast((problem.system, method), dtype)
            inputs = problem.inputs.at(dtype)
            start = cast(problem.start, dtype).begin(system, own)

            def travel(start: State, rows: PyTree, h: Array, count: Array) -> Any:
                return along(system, own, inputs.policy, (start, rows), (h, count), inputs.parts)

            self.args = start, inputs.rows
            self.lowered = jax.jit(travel).lower(*self.args, *self.numbers(1e-3, 1))

    def go(self, dt: float, count: int) -> Trip:
        """Runs it with so many steps of this length in each part."""
        with precision(self.dtype):
            numbers = self.numbers(dt, count)
            begin = time.perf_counter()
            state, worst = jax.block_until_ready(self.program(*self.args, *numbers))
            spent = time.perf_counter() - begin
        points = jax.tree.map(lambda x: np.asarray(x, np.float64), Points.of(state))
        code = Status(int(np.asarray(state.status)[-1]))
        return Trip(dt, points, code, float(worst), spent)


def along(
    system: Any, method: Method, policy: Any, given: Any, numbers: tuple[Array, Array], parts: int
) -> tuple[State, Array]:
    """The states at the ends of the parts, and max |φ| over all steps."""
    (start, rows), (h, count) = given, numbers

    def part(carry: Any, row: PyTree) -> Any:
        control = row if policy is None else policy(carry[0])

        def one(_: Any, carry: Any) -> Any:
            state, worst = carry
            state, info = step_quietly(system, method, state, control, h)
            return state, jnp.maximum(worst, info.violation.worst)

        carry = jax.lax.fori_loop(0, count, one, carry)
        return carry, carry[0]

    carry = start, jnp.zeros((), start.q.dtype)
    (_, worst), states = jax.lax.scan(part, carry, rows, parts)
    return states, worst


class Seen(NamedTuple):
    """What is read of points, (n,) each: energies [J], max |φ| and max |φ̇|."""

    energy: np.ndarray
    kinetic: np.ndarray
    violation: np.ndarray
    rate: np.ndarray


class Observer:
    """Reads energy and violation of points in float64; compiled once for all runs."""

    def __init__(self, problem: Problem) -> None:
        with precision(np.float64):
            self.system = cast(problem.system, np.float64)

            def read(points: Points) -> Any:
                healthy = jnp.zeros((), jnp.int32)
                state = State(points.q, points.v, points.time, healthy, (), points.turns)
                held, mechanical = violation(self.system, state), energy(self.system, state)
                return mechanical.total, mechanical.kinetic, held.worst, held.worst_rate

            self.read = jax.jit(jax.vmap(read))

    def __call__(self, points: Points) -> Seen:
        """What is read of several points."""
        with precision(np.float64):
            return Seen(*(np.asarray(x) for x in self.read(cast(points, np.float64))))
