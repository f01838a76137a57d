"""One step: linearize, assemble, solve, advance, correct."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions, native, status
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import batch_of, keep, per_world, spread
from jaxcon.model.state import State, at, recall
from jaxcon.simulation.attempt import StepInfo, attempt, bare, dynamics_at, nothing_seen
from jaxcon.simulation.initialize import check_dtype
from jaxcon.simulation.method import Method, check_method
from jaxcon.simulation.recovery import contain
from jaxcon.simulation.stability import warn_if_unstable
from jaxcon.solvers.saddle import Solution


def step(
    system: Any, method: Method, state: State, control: PyTree, dt: Any
) -> tuple[State, StepInfo]:
    """The state one step later. Pure: jit, vmap, grad, jvp and scan it.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabiliser and solver.
        state: from `Scene.build` or `init`.
        control: (n_u,) by `system.layout.controls`, or what the user's force expects; None only
            where no motor waits for it.
        dt: h, () [s].

    Shapes and dtypes are always checked. Values are read only where they are numbers of Python or
    NumPy: an array of JAX may still be computed, and is judged by the status.

    Returns:
        The new state and what the step saw at its start. A world that fails keeps its last finite
        state, says why in `status`, and has no gradient; the others do not notice.

    Raises:
        ValueError: shapes or dtypes disagree (at trace time), or a motor has no control.
    """
    check_method(method, wait=False)
    with checks.without_waiting():  # of dt as given: under jit an array of it would be traced
        warn_if_unstable(method, dt, system, state)
    return step_quietly(system, method, state, control, dt)


def step_quietly(
    system: Any, method: Method, state: State, control: PyTree, dt: Any
) -> tuple[State, StepInfo]:
    """`step` without a warning of unstable gains, for those who have given it."""
    control = check_step(system, method, state, control)
    with checks.without_waiting():
        h = checks.real("step", "dt", dt, state.q.dtype, least=0)
        method = method.known_at(dt, state.q.dtype)
    new, info = native.call(contained_step, system, method, state, control, h)
    # put in outside of the step, which so computes what it did; a rollout that does not record it
    # does not carry it either
    return new, info if info.state is not None else dataclasses.replace(info, state=bare(state))


def undo(system: Any, method: Method, state: State, control: PyTree, dt: Any) -> State:
    """The state from which a step by h led to this one, by a step by −h of a symmetric integrator.

    The angles that it counts turns from are those at its end, not those before its start; either
    tells the same turns.
    """
    control = check_step(system, method, state, control)
    with checks.without_waiting():
        h = checks.real("step", "dt", dt, state.q.dtype)
    return native.call(contained_step, system, method, state, control, -h)[0]


def contained_step(
    system: Any, method: Method, state: State, control: PyTree, dt: Array
) -> tuple[State, StepInfo]:
    """One step of worlds along trailing axes; those that fail stop, with their gradients."""
    if not hasattr(system, "layout") and state.q.ndim > 1:
        one = per_world(contained_step, state.q.ndim - 1)
        return one(system, method, state, control, dt)
    args = (system, method, state, control, dt)
    whole = spread(state, batch_of(args, state.q.ndim - 1))
    args = (system, method, whole, control, dt)
    if method.recovery is None:
        return contain(_step, args)[0]
    # one after the other: what is taken back must leave no derivative either
    return contain(_repair, (system, method, whole, contain(_attempt, args), dt))[0]


def _step(system: Any, method: Method, state: State, control: PyTree, dt: Array) -> Any:
    """(new state, info) and the status of the world."""
    return _settle(state, _attempt(system, method, state, control, dt))


def _repair(system: Any, method: Method, state: State, attempt: Any, dt: Array) -> Any:
    """Steps as `_attempt` does, and repairs an attempt that failed."""
    system = recall(system, state.turns, state.angle_remainder)
    return _settle(state, method.recovery.repair(system, method.solver, state, attempt, dt))


def _attempt(system: Any, method: Method, state: State, control: PyTree, dt: Array) -> Any:
    """(new state, info) and the status of this step alone, split at impacts where that is asked."""
    whole = attempt if method.events is None else method.events.attempt
    return whole(system, method, state, control, dt)


def _settle(state: State, attempt: Any) -> Any:
    """The outcome of a step where the world is healthy, and the state before it where it failed."""
    (new, info), own = attempt
    code = status.first(state.status, own)
    healthy = ~status.failed(code)
    info = keep(healthy, info, nothing_seen(info, state))
    new = dataclasses.replace(keep(healthy, new, state), status=code)
    return (new, dataclasses.replace(info, status=jnp.where(healthy, own, code))), code


@jax.tree_util.register_pytree_node_class
class SolutionAt(Solution):
    """A `Solution` with the `state` to which it belongs; unpacks as `a, λ, status`."""

    state: Any = None

    def __new__(
        cls, acceleration: Any, multipliers: Any, status: Any, state: Any = None
    ) -> SolutionAt:
        """The solution at a state, without the memory of a method."""
        solution = super().__new__(cls, acceleration, multipliers, status)
        solution.state = state
        return solution

    def tree_flatten(self) -> Any:
        """Children, the state among them."""
        return (*self, self.state), None

    @classmethod
    def tree_unflatten(cls, _: Any, children: Any) -> SolutionAt:
        """Rebuilds the solution from its children."""
        return cls(*children)


def forward_dynamics(
    system: Any, state: State, control: PyTree, method: Method, dt: Any
) -> SolutionAt:
    """a and λ at a state, under the method's feedback of φ and φ̇ as they are there.

    Bounded rows are solved as over a step of h: a then holds their mean over it, of an impact the
    impulse over h.

    To read the forces at a state, take `Unstabilized()`: what feedback adds is not of the motion,
    and the φ̇ that semi-implicit Euler leaves, ½hγ, is no error to be fed back.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: where.
        control: as of `step`.
        method: its stabiliser and solver are used.
        dt: h, () [s], on which default gains depend.

    Returns:
        acceleration (n_v,) [m/s², rad/s²], multipliers (n_c,) [N, N·m], status (): a `Solution`
        that unpacks so, and whose `state` is the one given.

    Raises:
        ValueError: shapes or dtypes disagree (at trace time).
    """
    control = check_step(system, method, state, control)
    with checks.without_waiting():
        h = checks.real("forward_dynamics", "dt", dt, state.q.dtype, least=0)
    found = native.call(_dynamics, system, method, state, control, h)
    return SolutionAt(*found, state=bare(state))


def _dynamics(system: Any, method: Method, state: State, control: PyTree, dt: Array) -> Solution:
    """Returns the dynamics of worlds along trailing axes."""
    if not hasattr(system, "layout") and state.q.ndim > 1:
        one = per_world(_dynamics, state.q.ndim - 1)
        return one(system, method, state, control, dt)
    args = (system, method, state, control, dt)
    state = spread(state, batch_of(args, state.q.ndim - 1))
    dynamics = dynamics_at(system, method, state, control, dt)
    return dynamics(state.q, state.v, state.instant)[0]


def check_step(system: Any, method: Method, state: State, control: PyTree) -> PyTree:
    """Checks that system, state, control and method fit together; returns the control as arrays.

    Raises:
        ValueError: wrong shapes, mixed dtypes, or memory of another method.
    """
    at(system, state, "jc.step(system, method, s, control, dt)")
    check_method(method, wait=False)
    layout = getattr(system, "layout", None)
    if layout is not None and control is not None:
        control = _channels(layout, control, state.q.dtype)
    if control is None and (waiting := _motors(system)):
        raise ValueError(
            f"step: control is None, but the motors {waiting} wait for one, an array"
            f" ({system.layout.n_u},); its channels (name, first, end) are"
            f" {list(system.layout.controls)}."
        )
    control = controls_in(state.q.dtype, control)
    for leaf in jax.tree.leaves(control):
        got = getattr(leaf, "dtype", state.q.dtype)
        if jnp.issubdtype(got, jnp.floating) and got != state.q.dtype:
            raise ValueError(f"step: control is {got}, but the state is {state.q.dtype}.")
    check_dtype(system, state.q.dtype)
    method.check_system(system)
    method.check_memory(system, state)
    return control


def idle(system: Any, control: PyTree) -> PyTree:
    """A control, zeros where there is none and motors wait for one."""
    return np.zeros(system.layout.n_u) if control is None and _motors(system) else control


def _motors(system: Any) -> list[str]:
    """The names of actuators, which act by what their channels say."""
    groups = (*getattr(system, "forces", ()), *getattr(system, "bounds", ()))
    driven = (g for g in groups if getattr(g, "starts", ()) and hasattr(g, "law"))
    return [name for group in driven for name in group.names]


def _channels(layout: Any, control: Any, dtype: Any) -> Array:
    """The control of a `BodySystem` as one array.

    Raises:
        ValueError: it is none of numbers, or of another length.
    """
    try:
        with checks.without_waiting():
            array = checks.check("step", "control", control, dtype=dtype)
        array = array if isinstance(array, jax.Array) else jnp.asarray(array, dtype)
        got = str(array.shape)
    except ValueError:
        array, got = None, checks.shortened(control)
        if isinstance(control, Mapping):
            got = f"a {type(control).__name__} with {checks.described(control)}"
    if (array is None or array.size) and not layout.n_u:
        raise ValueError(
            f"step: control must be None, since no element of the scene takes one, got {got}."
        )
    if array is None or array.shape != (layout.n_u,):
        raise ValueError(
            f"step: control must have shape ({layout.n_u},), got {got}; its channels (name, first,"
            f" end) are {list(layout.controls)}."
        )
    return array


def policy_in(policy: Callable[[State], PyTree]) -> Callable[[State], PyTree]:
    """A policy whose controls are in the dtype of the scene; see `controls_in`."""

    def called(state: State) -> PyTree:
        controls = functions.call("rollout", "controls", policy, state)
        return controls_in(state.q.dtype, functions.tree("rollout", "controls", controls))

    return called


def controls_in(dtype: Any, controls: PyTree) -> PyTree:
    """Controls in the dtype of the scene where they choose none themselves.

    NumPy's arrays choose none, nor do numbers, and what JAX makes of numbers alone (a weak type).
    """

    def one(x: Any) -> Any:
        if isinstance(x, jax.Array):
            free = x.aval.weak_type and jnp.issubdtype(x.dtype, jnp.floating)
        else:
            free = isinstance(x, np.ndarray | np.floating | float)
        return jnp.asarray(x, dtype) if free else x

    return jax.tree.map(one, controls)
