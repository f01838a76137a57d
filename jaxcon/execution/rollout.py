"""Rollouts: many steps in one scan."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import TracerIntegerConversionError

from jaxcon.core import checks, functions, numerics
from jaxcon.core.closures import hoist_closure
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.execution.adjoints import EVERY_STEP, Inputs, Path, check_adjoint
from jaxcon.execution.step import step_quietly, undo, with_origin
from jaxcon.execution.validation import controls_in, policy_in
from jaxcon.methods.method import Method, check_method
from jaxcon.methods.stability import warn_if_unstable
from jaxcon.protocols import Adjoint, System
from jaxcon.staging import batch_last
from jaxcon.staging.chunks import by_world
from jaxcon.staging.failure import mask_failed_gradients, stop_failed
from jaxcon.staging.meshes import together
from jaxcon.staging.operations import primitives
from jaxcon.staging.worlds import per_world
from jaxcon.step import StepInfo
from jaxcon.system.state import State, checked_system

FEEDBACK = (
    "controls are a function of the state, and the state before a step is unknown until the step"
    " is undone"
)
"""The reason why steps under a policy cannot be undone, for an error message."""

Record = Callable[[State, StepInfo], PyTree]


def record_state(state: State, info: StepInfo) -> State:
    """Returns the whole state as the record of a step; the default of `rollout`."""
    return state


def rollout(
    system: System,
    method: Method,
    state: State,
    controls: PyTree | Callable[[State], PyTree],
    dt: Scalar,
    steps: int,
    *,
    record: Record = record_state,
    every: int = 1,
    adjoint: Adjoint = EVERY_STEP,
) -> tuple[State, Any]:
    """Takes many steps in one scan, and records chosen quantities at a fixed interval.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabilizer and solvers.
        state: the initial state.
        controls: None if no motor needs a control; or arrays with a first axis of steps; or a
            policy, a function of the state of one world. NumPy arrays are cast to the dtype of the
            state. A policy must not use collectives over the batch.
        dt: step size h, () [s].
        steps: number of steps.
        record: function (state, info) → recorded values; by default the whole state. `info` belongs
            to the step that led to the state.
        every: number of steps from one record to the next; must divide `steps`.
        adjoint: how the reverse pass gets its states: `EveryStep()`, `Checkpoints(…)` or
            `Reversible()`. `Truncated(…)` and `Discounted(…)` truncate the gradient.

    Returns:
        The final state, and the record with a first axis of steps // every. A failed world has zero
        gradient in both.

    Raises:
        ValueError: `every` does not divide `steps`, or controls do not have `steps` rows.
        TypeError: `steps` or `every` is not an integer, `adjoint` is not an adjoint, or `record` or
            the policy has a wrong signature.
    """
    steps, every = _integer("steps", steps, 0), _integer("every", every)
    if steps % every:
        raise ValueError(f"rollout: every={every} must divide steps={steps}.")
    check_method(method)
    checks.takes("rollout", "record", record, ("state", "info"))
    checked_system(system, state, "jc.rollout(system, method, s, controls, dt, steps)")
    check_adjoint(adjoint)
    warn_if_unstable(method, dt, system, state)
    method = method.known_at(dt, state.q.dtype)
    policy = controls if callable(controls) else None
    if policy is not None:
        checks.takes("rollout", "controls", policy, ("state",))
    wanted = system.layout is None or system.layout.n_u
    rows = None if callable(controls) else _rows(controls, steps, state.q.dtype)
    inputs = jnp.arange(steps), rows
    # here, not in every step, so that in reverse mode devices sum shared gradients only once
    system, method, state, inputs, dt = together((system, method, state, inputs, dt))

    def one(state: State, inputs: Inputs) -> tuple[State, StepInfo]:
        control = inputs[1] if policy is None else masked_policy(policy, state)
        if policy is not None and control is None and wanted:
            raise TypeError(
                "rollout: controls, a function of the state, returned None; is a return missing?"
            )
        return step_quietly(system, method, state, control, dt, owner="rollout")

    def back(state: State, inputs: Inputs) -> State:
        return undo(system, method, state, inputs[1], dt)

    reason = method.irreversible() if policy is None else FEEDBACK
    path = Path(one, _recorded(record, system), state, inputs, steps, every, reason or back)

    def run() -> tuple[State, Any]:
        final, trajectory = adjoint.scan(path)
        return stop_failed(final.status, final), stop_failed(final.status, trajectory)

    with batch_last.as_it_is_called():
        return by_world(run, chunk_size(state.v.size), (system, state, inputs, dt))


def chunk_size(velocities: int) -> int:
    """Returns the number of worlds whose steps a core of a CPU computes fastest, a power of 2.

    Their states and the intermediate values of a step then fit its cache. Measured on an AMD EPYC:
    512 for three velocities, 128 for thirty.
    """
    return int(np.clip(2 ** round(np.log2(4096 / max(velocities, 1))), 32, 512))


def _recorded(record: Record, system: System) -> Record:
    """Wraps a user's record function: errors name it, and its `info` also has the system."""

    def recorded(state: State, info: StepInfo) -> PyTree:
        return functions.tree(
            "rollout",
            "record",
            functions.call("rollout", "record", record, state, with_origin(info, system)),
        )

    return record if record is record_state else recorded


def masked_policy(policy: Callable[[State], PyTree], state: State) -> Any:
    """Returns policy(state). Worlds whose control is not finite get zero gradient."""
    # captured values become arguments, since their tangents must be masked as well
    function, captured, _ = hoist_closure(policy_in(policy), state)

    def judged(state: State, constants: PyTree) -> tuple[PyTree, Array]:
        control = function(constants, state)
        good = ~failed(state.status) & numerics.all_finite(control)
        return control, jnp.where(good, Status.OK, Status.NON_FINITE)

    has_vjp = "custom_vjp_call" in primitives(jax.make_jaxpr(function)(captured, state).jaxpr)

    def masked(state: State, constants: PyTree) -> PyTree:
        args, rank = (state, constants), state.q.ndim - 1
        if has_vjp:  # JAX cannot batch tangents of a custom VJP, so the mask goes outside
            return mask_failed_gradients(per_world(judged, rank), args)[0]
        return per_world(lambda *one: mask_failed_gradients(judged, one)[0], rank)(*args)

    # the batch is last, as in steps, so that second derivatives are masked, too
    return batch_last.call(masked, state, captured, staged=False)


def _integer(what: str, number: SupportsIndex, least: int = 1) -> int:
    """Converts a number to an int. Its value must be known when tracing.

    Raises:
        TypeError: the number is not an integer, or is traced.
        ValueError: the number is less than `least`.
    """
    try:
        if isinstance(number, bool | np.bool_):
            raise TypeError("a truth value is no count")
        whole = operator.index(number)
    except (TypeError, TracerIntegerConversionError) as error:
        raise TypeError(
            f"rollout: {what} must be an integer known when tracing, got"
            f" {checks.shortened(number)}."
        ) from error
    checks.count("rollout", what, whole, least)
    return whole


def _rows(controls: PyTree, steps: int, dtype: DType) -> Any:
    """Returns the controls as arrays with one row per step, cast by `controls_in`."""

    def checked(x: Scalar) -> Array:
        try:
            x = jnp.asarray(x)
        except TypeError as error:
            raise TypeError(
                f"rollout: controls must be None, arrays by step, or a function of the state, got"
                f" {controls!r}."
            ) from error
        if x.ndim == 0 or x.shape[0] != steps:
            raise ValueError(
                f"rollout: controls must have {steps} rows, one a step, got shape {x.shape}; repeat"
                " a constant one with jnp.tile, or give a function of the state."
            )
        return x

    for x in jax.tree.leaves(controls):
        if isinstance(x, int | float | np.generic):
            raise ValueError(
                f"rollout: controls must have {steps} rows, one a step, in an array, got the number"
                f" {x}; of a list make an array by jnp.asarray."
            )
    return jax.tree.map(checked, controls_in(dtype, controls))
