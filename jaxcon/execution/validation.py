"""Checks that system, method, state and control fit together, and casts of control inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions
from jaxcon.core.summary import listed
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.execution.initialize import check_dtype
from jaxcon.methods.method import Method, check_method
from jaxcon.protocols import System
from jaxcon.system.layout import Layout
from jaxcon.system.state import State, checked_system

CALLS = {
    "step": "jc.step(system, method, s, control, dt)",
    "rollout": "jc.rollout(system, method, s, controls, dt, steps)",
    "forward_dynamics": "jc.forward_dynamics(system, s, control, method, dt)",
    "reaction": "jc.reaction(system, s, name)",
}
"""Calls with the state s of one world; messages show how to apply `jax.vmap` to them."""


def check_step(
    system: System, method: Method, state: State, control: PyTree, owner: str = "step"
) -> PyTree:
    """Checks that system, method, state and control fit together. Returns the control as arrays.

    Args:
        system: the system.
        method: the method.
        state: the state of one world.
        control: the control of one step.
        owner: the public function that was called, for messages; a key of `CALLS`.

    Raises:
        ValueError: shapes are wrong, dtypes are mixed, or the state has the memory of another
            method.
    """
    checked_system(system, state, CALLS[owner])
    check_method(method, wait=False)
    control = checked_control(owner, system, control, state.q.dtype)
    check_dtype(system, state.q.dtype)
    method.check_system(system)
    method.check_memory(system, state, owner)
    return control


def checked_control(owner: str, system: System, control: PyTree, dtype: DType) -> PyTree:
    """Checks the control of one step, and returns it as arrays of the given dtype.

    Raises:
        ValueError: the control is not numeric, has a wrong shape or another dtype, or is None
            although motors need one.
    """
    layout = system.layout
    if layout is not None and control is not None:
        control = _channels(owner, layout, control, dtype)
    if layout is not None and control is None and (waiting := _motors(system)):
        raise ValueError(
            f"{owner}: control is None, but {listed(waiting)} (motors) wait for one, an array"
            f" ({layout.n_u},); its channels (name, first, end) are"
            f" {list(layout.controls)}."
        )
    control = controls_in(dtype, control)
    for leaf in jax.tree.leaves(control):
        got = getattr(leaf, "dtype", dtype)
        if jnp.issubdtype(got, jnp.floating) and got != dtype:
            raise ValueError(f"{owner}: control is {got}, but the state is {dtype}.")
    return control


def idle(system: System, control: PyTree) -> PyTree:
    """Returns the control, or zeros if it is None although motors need a control."""
    layout = system.layout
    if layout is None or control is not None or not _motors(system):
        return control
    return np.zeros(layout.n_u)


def _motors(system: System) -> list[str]:
    """Returns the names of the actuators that need a control input."""
    groups = (*system.forces, *system.bounds)
    driven = (g for g in groups if getattr(g, "starts", ()) and hasattr(g, "coordinate"))
    return [name for group in driven for name in group.names]


def _channels(owner: str, layout: Layout, control: PyTree, dtype: DType) -> Array:
    """Converts the control of a `BodySystem` to one array, (n_u,).

    Raises:
        ValueError: the control is not numeric, or has another length.
    """
    try:
        with checks.without_waiting():
            array = checks.check(owner, "control", control, dtype=dtype)
        array = array if isinstance(array, jax.Array) else jnp.asarray(array, dtype)
        got = str(array.shape)
    except ValueError:
        array, got = None, checks.shortened(control)
        if isinstance(control, Mapping):
            kind = f"a {type(control).__name__}"
            got = f"{kind} with {checks.described(control)} in place of one array"
    if (array is None or array.size) and not layout.n_u:
        raise ValueError(
            f"{owner}: control must be None, since no element of the scene takes one, got {got}."
        )
    if array is None or array.shape != (layout.n_u,):
        raise ValueError(
            f"{owner}: control must have shape ({layout.n_u},), got {got}; its channels (name,"
            f" first, end) are {list(layout.controls)}."
        )
    return array


def policy_in(policy: Callable[[State], PyTree]) -> Callable[[State], PyTree]:
    """Wraps a policy, so that it returns controls in the dtype of the state; see `controls_in`."""

    def called(state: State) -> PyTree:
        controls = functions.call("rollout", "controls", policy, state)
        return controls_in(state.q.dtype, functions.tree("rollout", "controls", controls))

    return called


def controls_in(dtype: DType, controls: PyTree) -> PyTree:
    """Casts controls to the given dtype, except JAX arrays with an explicit dtype.

    Python floats, floating NumPy values, NumPy arrays and weakly typed JAX arrays are cast.
    """

    def one(x: Any) -> Any:
        if isinstance(x, jax.Array):
            free = x.aval.weak_type and jnp.issubdtype(x.dtype, jnp.floating)
        else:
            free = isinstance(x, np.ndarray | np.floating | float)
        return jnp.asarray(x, dtype) if free else x

    return jax.tree.map(one, controls)
