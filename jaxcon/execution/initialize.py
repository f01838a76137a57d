"""The initial state of a world."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.custom import Custom, check_function
from jaxcon.core import checks
from jaxcon.core.pytree import unshared
from jaxcon.core.status import Status
from jaxcon.core.typing import DType, Scalar
from jaxcon.methods.method import Method, check_method
from jaxcon.protocols import System
from jaxcon.system.state import State


def init(
    system: System,
    method: Method,
    q: Scalar,
    v: Scalar,
    time: Scalar = 0.0,
    turns: Scalar | tuple[()] | None = None,
) -> State:
    """Returns the state at q and v, with the initial memory of a method's parts.

    q and v are used as given; they are not projected onto the constraints.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: integrator, stabilizer and solvers. Their memory, such as a warm start, is part of
            the state.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        time: time, () [s].
        turns: counted angles of joints, (n,) [rad], from the `turns` of an earlier `State`. By
            default every counted angle is within half a turn of its value at assembly.

    Raises:
        TypeError: the method is not a `Method`, or the system is not a system.
        ValueError: shapes are wrong, dtypes are mixed, or a user's function returns a wrong shape.
    """
    check_method(method)
    if not hasattr(system, "snapshot"):
        raise TypeError(
            "init: system must be a BodySystem or GeneralizedSystem, got"
            f" {checks.shortened(system)}; `system, state = scene.build()` makes one."
        )
    dtype = checks.chosen_dtype(q, v, system)
    if jnp.finfo(dtype).bits < 32:
        raise ValueError(f"init: q and v must be float32 or float64, got {dtype}.")
    n_q, n_v = system.sizes(_length(q))
    q = checks.real("init", "q", q, dtype, (n_q,))
    v = checks.real("init", "v", v, dtype, (n_v,))
    check_dtype(system, dtype)
    system.check(q)
    snapshot = system.snapshot(q, v, jnp.zeros((), dtype))
    for group in (*snapshot.system.constraints, *snapshot.system.bounds):
        if isinstance(group, Custom):
            check_function(group, snapshot)
    status = jnp.asarray(Status.OK, jnp.int32)
    memory = method.init(system, q, v)
    counted = system.turns
    if turns is not None:
        counted = checks.real("init", "turns", turns, dtype, np.shape(counted)[:1])
    time = checks.real("init", "time", time, dtype)
    start = State(q, v, time, status, memory, counted)
    start = dataclasses.replace(start, angle_remainder=system.no_remainder(dtype))
    return unshared(start, system)


def _length(q: Scalar) -> int:
    """Returns the length of the last axis of q; 0 for a scalar."""
    array = checks.check("init", "q", q)
    return array.shape[-1] if array.ndim else 0


def check_dtype(system: System, dtype: DType) -> None:
    """Checks that the system's floating-point leaves have the dtype of the state.

    Raises:
        ValueError: a leaf has another floating-point dtype.
    """
    for leaf in jax.tree.leaves(system):
        got = getattr(leaf, "dtype", dtype)
        if jnp.issubdtype(got, jnp.floating) and got != dtype:
            raise ValueError(
                f"the state is {jnp.dtype(dtype).name}, but the system holds {got}: mixed dtypes"
                " are not promoted; build both with one dtype."
            )
