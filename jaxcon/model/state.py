"""The state of a world between two steps."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.doubled import Doubled
from jaxcon.core.pytree import exportable, pytree
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree

UNSET: Any = object()
"""In the place of a remainder that was not given."""


@exportable
class MethodMemory(NamedTuple):
    """The memory of a method between steps, by part of the method; () where a part has none.

    Attributes:
        integrator: accelerations of the last step, for integrators that use them.
        stabilizer: integrals or histories of the feedback.
        recovery: counters of repaired steps.
        bounded: multipliers of the inequality constraints in the last step, (n,), from which
            iterative solvers start.
    """

    integrator: PyTree = ()
    stabilizer: PyTree = ()
    recovery: PyTree = ()
    bounded: PyTree = ()


@pytree
class State:
    """Everything that a step changes.

    Time is kept as the sum of two floats, `time` and `time_remainder`: steps of 1 ms added up in
    one float32 would be 0.9 % off after a million. `time` is the float nearest to the sum, which
    users' functions of time get. A remainder that no longer fits, since `time` was replaced, counts
    as zero.

    Attributes:
        q: positions, (n_q,); `system.layout` maps names to indices.
        v: velocities, (n_v,); not q̇ where bodies turn in space.
        time: () [s], rounded.
        status: `Status` code of this world, (); the first failure sticks.
        memory: of the method (integrals, histories); `jc.init` makes it.
        turns: the angles near which those of joints whose whole turns are counted lie, within half
            a turn, (n,) [rad]; empty where there are none.
        time_remainder: what `time` lacks of the sum of all steps, () [s]; zero unless given.
        angle_remainder: what the angles in q of rigid bodies in the plane lack by rounding after
            whole turns, (bodies,) [rad]. Empty where there are none, and in states made by hand,
            whose angles are rounded once a step; `jc.init` makes it.
    """

    q: Array
    v: Array
    time: Array
    status: Array
    memory: PyTree = ()
    turns: PyTree = ()
    time_remainder: Array = UNSET
    angle_remainder: PyTree = ()

    # written out, since the default of the remainder has the shape of the time
    def __init__(
        self,
        q: Any,
        v: Any,
        time: Any,
        status: Any,
        memory: PyTree = (),
        turns: PyTree = (),
        time_remainder: Any = UNSET,
        angle_remainder: PyTree = (),
    ) -> None:
        if time_remainder is UNSET:
            time_remainder = _without_remainder(time)
        fields = (q, v, time, status, memory, turns, time_remainder, angle_remainder)
        for field, value in zip(dataclasses.fields(State), fields, strict=True):
            object.__setattr__(self, field.name, value)

    def __setstate__(self, fields: dict[str, Any]) -> None:
        """Also reads states that were pickled before time had a remainder."""
        self.__init__(**fields)  # type: ignore[misc]

    @property
    def instant(self) -> Doubled:
        """The time with its remainder, () [s]."""
        fits = self.time + self.time_remainder == self.time
        return Doubled(self.time, jnp.where(fits, self.time_remainder, 0))


def _without_remainder(time: Any) -> Any:
    """Zero in the shape of a time; in trees of axes or of shardings, what stands for the time."""
    if isinstance(time, np.ndarray | np.generic):
        return np.zeros_like(time)
    if hasattr(time, "dtype"):
        return jnp.zeros_like(time)
    return 0 * time if isinstance(time, int | float) else time


def at_instant(state: State, instant: Doubled) -> State:
    """The state at another time."""
    return dataclasses.replace(state, time=instant.high, time_remainder=instant.low)


def is_finite(state: State) -> Array:
    """Returns True where all positions and velocities of a world are finite, ()."""
    # 0 · x is NaN where x is not finite; a sum takes less time than a test of each number
    return jnp.sum(0 * state.q, axis=0) + jnp.sum(0 * state.v, axis=0) == 0


def at(system: Any, state: Any, call: str = "f(system, s)") -> Any:
    """The system as one of its worlds remembers it, checked: see `recall`.

    Args:
        system: of the state.
        state: of one world.
        call: what was called, of a state s, for errors.

    Raises:
        TypeError: they are something else, such as a Scene that was not built.
        ValueError: the state has another shape, such as that of a batch or trajectory.
    """
    if not hasattr(system, "snapshot") or not isinstance(state, State):
        raise TypeError(
            f"expected a system and a State, got {type(system).__name__} and"
            f" {type(state).__name__}; `system, state = scene.build()` makes them."
        )
    _check_kinds(state)
    sizes = system.sizes(state.q.shape[-1] if state.q.ndim else 0)
    for what, got, size in zip("qv", (state.q.shape, state.v.shape), sizes, strict=True):
        if got != (size,):
            raise ValueError(
                f"state.{what} must have shape ({size},), got {got}; for batches and trajectories"
                f" use jax.vmap: jax.vmap(lambda s: {call})(states)."
            )
    for what in ("time", "time_remainder", "status"):
        if got := np.shape(getattr(state, what)):
            raise ValueError(f"state.{what} must have shape (), got {got}.")
    return recall(system, state.turns, state.angle_remainder)


def _check_kinds(state: State) -> None:
    """Checks that what a state holds are arrays of one floating dtype, and a code.

    Values that a device may still compute are not waited for.

    Raises:
        ValueError: a field is of another kind, or the status is no `Status`.
    """
    for what in ("q", "v", "time", "time_remainder", "turns", "angle_remainder"):
        x: Any = getattr(state, what)
        own: Any = getattr(x, "dtype", None)
        array = own is not None and jnp.issubdtype(own, jnp.floating)
        number = type(x) is float or (type(x) is int and abs(x) < 2**53)
        plain = what.startswith("time") and number
        plain = plain or what in ("turns", "angle_remainder") and isinstance(x, tuple) and not x
        if not array and not plain:
            raise ValueError(
                f"state.{what} must be an array of floating numbers, got {_kind(x)};"
                " jc.init(system, method, q, v) makes a state."
            )
        if array and not isinstance(x, np.ndarray | np.generic) and own != state.q.dtype:
            raise ValueError(
                f"state.{what} is {own}, but state.q is {state.q.dtype}: mixed dtypes are not"
                " promoted."
            )
    code = state.status
    known = isinstance(code, int | np.integer) and not isinstance(code, bool | np.timedelta64)
    whole = known or getattr(getattr(code, "dtype", None), "kind", "?") in "iu"
    known = known or whole and isinstance(code, np.ndarray) and code.ndim == 0
    if not whole or (known and int(code) not in Status.__members__.values()):
        raise ValueError(f"state.status must be a code of jc.Status, got {_kind(code)}.")


def _kind(x: Any) -> str:
    """Describes a value given in place of an array, in few words."""
    return f"{x.dtype}{list(x.shape)}" if hasattr(x, "dtype") else checks.shortened(x)


def recall(system: Any, turns: PyTree, remainder: PyTree = ()) -> Any:
    """The system with the angles near which those of joints lie whose turns it counts.

    Args:
        system: of a state.
        turns: of the state.
        remainder: its `angle_remainder`.

    Raises:
        ValueError: there are not as many as it counts.
    """
    expected, got = (np.shape(x)[:1] for x in (system.turns, turns))
    if expected != got and sum(expected + got):
        raise ValueError(
            f"state.turns must have shape {expected}, got {got}: this system counts the whole turns"
            f" of {sum(expected)} joints; go on from a state that counts them, with"
            " dataclasses.replace, or start with jc.init."
        )
    return system.remember(turns if sum(got) else system.turns, remainder)


@pytree
class Energy:
    """Mechanical energy [J].

    Attributes:
        kinetic: ½ vᵀMv, and that of rotors, () [J].
        potential: of gravity and springs, () [J]; forces of one's own have none.
    """

    kinetic: Any
    potential: Any

    @property
    def total(self) -> Any:
        """Kinetic and potential together."""
        return self.kinetic + self.potential
