"""Many steps in one scan."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import TracerIntegerConversionError

from jaxcon.core import checks, functions, native, numerics
from jaxcon.core.closures import opened
from jaxcon.core.meshes import together
from jaxcon.core.operations import primitives
from jaxcon.core.status import Status, failed
from jaxcon.core.typing import PyTree
from jaxcon.core.worlds import per_world
from jaxcon.model.state import State, at
from jaxcon.simulation.adjoints import EVERY_STEP, Path, check_adjoint
from jaxcon.simulation.method import Method, check_method
from jaxcon.simulation.recovery import contain, stop_failed
from jaxcon.simulation.stability import warn_if_unstable
from jaxcon.simulation.step import StepInfo, controls_in, policy_in, step_quietly, undo

FEEDBACK = (
    "controls are a function of the state, and that before a step is not known until the step is"
    " undone"
)
"""Why steps under such controls are not taken back."""

Record = Callable[[State, StepInfo], PyTree]


def record_state(state: State, info: StepInfo) -> State:
    """The whole state: what `rollout` records unless told otherwise."""
    return state


def rollout(
    system: Any,
    method: Method,
    state: State,
    controls: Any,
    dt: Any,
    steps: int,
    *,
    record: Record = record_state,
    every: int = 1,
    adjoint: Any = EVERY_STEP,
) -> tuple[State, PyTree]:
    """Steps in one scan, with a trajectory of chosen quantities at a chosen stride.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: the start.
        controls: None, where no motor waits for any; arrays whose first axis enumerates steps,
            those of NumPy in the dtype of the state; or a function of the state of one world, which
            collectives over a batch do not reach.
        dt: h, () [s].
        steps: how many.
        record: (state, info) → what to keep; the whole state unless given. `info` is what the step
            that led to the state saw at its start.
        every: keep one of so many steps; must divide `steps`.
        adjoint: what the reverse pass keeps, `EveryStep()`, `Checkpoints(…)` or `Reversible()`, and
            how far back it goes, `Truncated(…)` or `Discounted(…)`.

    Returns:
        The final state, and what was recorded with a first axis of steps // every. A world that
        failed has no gradient in either.

    Raises:
        ValueError: `every` does not divide `steps`, or controls of another length.
        TypeError: `steps` or `every` is not an integer, the adjoint is none, or `record` or
            controls are no functions of what they are called with.
    """
    steps, every = _integer("steps", steps, 0), _integer("every", every)
    if steps % every:
        raise ValueError(f"rollout: every={every} must divide steps={steps}.")
    check_method(method)
    checks.takes("rollout", "record", record, ("state", "info"))
    at(system, state, "jc.rollout(system, method, s, controls, dt, steps)")
    check_adjoint(adjoint)
    warn_if_unstable(method, dt, system, state)
    method = method.known_at(dt, state.q.dtype)
    policy = controls if callable(controls) else None
    if policy is not None:
        checks.takes("rollout", "controls", policy, ("state",))
    wanted = not hasattr(system, "layout") or system.layout.n_u
    inputs = jnp.arange(steps), None if policy else _rows(controls, steps, state.q.dtype)
    # once, not in every step: in reverse mode devices then add what they share once
    system, method, state, inputs, dt = together((system, method, state, inputs, dt))

    def one(state: State, given: Any) -> tuple[State, StepInfo]:
        control = contained_policy(policy, state) if policy else given[1]
        if policy and control is None and wanted:
            raise TypeError(
                "rollout: controls, a function of the state, returned None; is a return missing?"
            )
        return step_quietly(system, method, state, control, dt)

    def back(state: State, given: Any) -> State:
        return undo(system, method, state, given[1], dt)

    reason = FEEDBACK if policy else method.irreversible()
    path = Path(one, _recorded(record), state, inputs, steps, every, reason or back)
    with native.as_it_is_called():
        final, trajectory = adjoint.scan(path)
    return stop_failed(final.status, final), stop_failed(final.status, trajectory)


def _recorded(record: Record) -> Record:
    """Wraps a user's record function, so that errors name it."""

    def recorded(state: State, info: StepInfo) -> PyTree:
        return functions.tree(
            "rollout", "record", functions.call("rollout", "record", record, state, info)
        )

    return record if record is record_state else recorded


def contained_policy(policy: Callable[[State], PyTree], state: State) -> PyTree:
    """policy(state), with no gradient in a world where its result is not finite."""
    # what it closes over has tangents to be masked
    function, known, _ = opened(policy_in(policy), state)

    def judged(state: State, constants: Any) -> tuple[PyTree, Any]:
        control = function(constants, state)
        good = ~failed(state.status) & numerics.all_finite(control)
        return control, jnp.where(good, Status.OK, Status.NON_FINITE)

    own_vjp = "custom_vjp_call" in primitives(jax.make_jaxpr(function)(known, state).jaxpr)

    def contained(state: State, constants: Any) -> PyTree:
        args, rank = (state, constants), state.q.ndim - 1
        if own_vjp:  # JAX cannot batch its tangents; masked outside, what worlds share is spread
            return contain(per_world(judged, rank), args)[0]
        return per_world(lambda *own: contain(judged, own)[0], rank)(*args)

    # natively, as steps are: the derivative of a derivative is masked there, too
    return native.call(contained, state, known, staged=False)


def _integer(what: str, number: Any, least: int = 1) -> int:
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


def _rows(controls: PyTree, steps: int, dtype: Any) -> PyTree:
    """The controls as arrays, one row a step, in the dtype of the scene if they choose none."""

    def checked(x: Any) -> Any:
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
