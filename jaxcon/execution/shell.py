"""The layers around a step: batching, failed worlds and repairs.

    jc.step            checks the user's arguments                        execution/step.py
    batch_last.call    moves the batch last, stages kernels               staging/batch_last.py
    masked_step        freezes failed worlds and masks their gradients    execution/shell.py
    attempt            subtracts whole turns of angles and counts them    methods/attempt.py
    step.step          the algorithm                                      step.py

`step` and `rollout` go through all of them. `forward_dynamics` has `solve_at` in place of
`masked_step`, and solves for a and λ without a step. Each layer has a reason:

- The batch is the last axis, so that each operation is one loop over contiguous memory. `vmap`
  alone would make it the first axis, and process small matrices one by one.
- XLA recomputes shared values in each kernel that needs them. Splitting the step into stages avoids
  this. On a CPU, a chain of 5 links then runs at 2.9 instead of 0.054 million steps per second.
- A failed world must not corrupt the gradients of other worlds through shared parameters.
- In float32, angles of many turns lose precision.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from numbers import Number
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Violation
from jaxcon.contact.rows import Reactions
from jaxcon.core import derivatives, status
from jaxcon.core.typing import Array, PyTree
from jaxcon.linear.saddle import Solution
from jaxcon.methods.attempt import attempt
from jaxcon.methods.method import Method
from jaxcon.protocols import System
from jaxcon.staging.batch_last import for_values_only
from jaxcon.staging.failure import mask_failed_gradients
from jaxcon.staging.worlds import batch_of, broadcast_worlds, per_world, where_tree
from jaxcon.step import StepInfo
from jaxcon.system.state import State, with_turns

Attempted = tuple[tuple[State, StepInfo], Array]
"""The new state with the step's info, and the status of the step."""

CONSTANTS = (str, bytes, Number, np.ndarray, np.generic, np.dtype, jax.Array)
"""Types of values without fields."""


def masked_step(
    system: System, method: Method, state: State, control: PyTree, dt: Array
) -> tuple[State, StepInfo]:
    """Steps a batch of worlds (trailing axis). Failed worlds are frozen and get zero gradients."""
    if system.layout is None and state.q.ndim > 1:  # user functions take one world
        one = per_world(masked_step, state.q.ndim - 1)
        return one(system, method, state, control, dt)
    args = (system, method, state, control, dt)
    state = broadcast_worlds(state, batch_of(args, state.q.ndim - 1))
    args = (system, method, state, control, dt)
    # the rule of `mask_failed_gradients` takes this value along: it is traced for derivatives only,
    # and they start from this function
    with_rules = not for_values_only() or has_user_parts(system, method)

    def take(system: System, method: Method, state: State, control: PyTree, dt: Array) -> Attempted:
        whole = attempt if method.events is None else method.events.attempt
        with derivatives.taken(with_rules):
            return whole(system, method, state, control, dt)

    def frozen(
        system: System, method: Method, state: State, control: PyTree, dt: Array
    ) -> tuple[tuple[State, StepInfo], Array]:
        return _freeze(state, take(system, method, state, control, dt))

    def repaired(
        system: System, method: Method, state: State, tried: Attempted, dt: Array
    ) -> tuple[tuple[State, StepInfo], Array]:
        assert method.recovery is not None
        system = with_turns(system, state.turns, state.angle_remainder)
        return _freeze(state, method.recovery.repair(system, method.solver, state, tried, dt))

    batch = state.q.shape[1:]
    if method.recovery is None:
        return mask_failed_gradients(frozen, args, batch)[0]
    # two masks, since a rolled-back attempt may have a NaN derivative
    tried = mask_failed_gradients(take, args, batch)
    return mask_failed_gradients(repaired, (system, method, state, tried, dt), batch)[0]


def _freeze(state: State, tried: Attempted) -> tuple[tuple[State, StepInfo], Array]:
    """Resets failed worlds to `state`, as before the step. Returns ((state, info), status)."""
    (new, info), code = tried
    sticky = status.first(state.status, code)
    healthy = ~status.failed(sticky)
    info = where_tree(healthy, info, info.of_failed_world(state))
    new = dataclasses.replace(where_tree(healthy, new, state), status=sticky)
    return (new, dataclasses.replace(info, status=jnp.where(healthy, code, sticky))), sticky


def solve_at(
    system: System, method: Method, state: State, control: PyTree, dt: Array
) -> tuple[Solution, Violation, Reactions | None]:
    """Solves the dynamics of a batch of worlds (trailing axis) at their states.

    Worlds whose solution fails get zero gradients.

    Returns:
        The accelerations a and multipliers λ as a `Solution`; the violation; and contact reactions,
        None without inequality constraints.
    """
    if system.layout is None and state.q.ndim > 1:
        one = per_world(solve_at, state.q.ndim - 1)
        return one(system, method, state, control, dt)
    args = (system, method, state, control, dt)
    state = broadcast_worlds(state, batch_of(args, state.q.ndim - 1))
    with_rules = not for_values_only() or has_user_parts(system, method)

    def solved(
        system: System, method: Method, state: State, control: PyTree, dt: Array
    ) -> tuple[tuple[Solution, Violation, Reactions | None], Array]:
        turning = with_turns(system, state.turns, state.angle_remainder)
        dynamics = method.dynamics(turning, state, control, dt)
        with derivatives.taken(with_rules):
            solution, rows = dynamics(state.q, state.v, state.instant)
        reactions = None if rows.reactions is None else rows.reactions.without_jump()
        return (solution, rows.violation, reactions), solution.status

    args = (system, method, state, control, dt)
    return mask_failed_gradients(solved, args, state.q.shape[1:])[0]


def has_user_parts(system: System, method: Method) -> bool:
    """Returns True if a class of a user's may take derivatives of a solution within a step.

    Functions of users may take them anyway, see `core.functions.call`.
    """
    if system.layout is None:
        return True
    inside = [x for x in _parts_of(system) if not isinstance(x, FunctionType)]
    return any(map(_is_of_user, [*inside, *_parts_of(method)]))


def _is_of_user(x: Any) -> bool:
    """Returns True if a value is of a class, or is a class, outside of this package."""
    cls = x if isinstance(x, type) else type(x)
    return x is not None and cls.__module__.split(".")[0] != __name__.split(".")[0]


def _parts_of(x: Any) -> Iterator[Any]:
    """Yields a value and those in its fields, however deep, other than arrays and constants."""
    if x is None or isinstance(x, CONSTANTS):
        return
    if type(x) in (tuple, list, dict):
        inner = x.values() if isinstance(x, dict) else x
    else:
        yield x
        fields = dataclasses.is_dataclass(x) and not isinstance(x, type)
        inner = [getattr(x, field.name) for field in dataclasses.fields(x)] if fields else ()
    for part in inner:
        yield from _parts_of(part)
