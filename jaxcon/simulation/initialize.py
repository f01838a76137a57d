"""The first state of a world."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.custom import Custom, check_function
from jaxcon.core import checks
from jaxcon.core.pytree import unshared
from jaxcon.core.status import Status
from jaxcon.model.state import State
from jaxcon.simulation.method import Method, check_method


def init(system: Any, method: Method, q: Any, v: Any, time: Any = 0.0, turns: Any = None) -> State:
    """A state at q and v with the memory of the method.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        method: whose stabiliser may need memory.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        time: () [s].
        turns: as of a `State`, for systems that count turns; unless given, every angle counted is
            taken to lie within half a turn of where it was at assembly.

    Returns:
        The state; nothing is projected.

    Raises:
        TypeError: the method is none, or a part of it is not.
        ValueError: wrong shapes, mixed dtypes, or a user's function that returns the wrong shape.
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
    if hasattr(system, "check"):
        system.check(q)
    snapshot = system.snapshot(q, v, jnp.zeros((), dtype))
    for group in (*snapshot.system.constraints, *snapshot.system.bounds):
        if isinstance(group, Custom):
            check_function(group, snapshot)
    status = jnp.asarray(Status.OK, jnp.int32)
    memory = method.init(system, q, v)
    if turns is not None:
        turns = checks.real("init", "turns", turns, dtype, np.shape(system.turns)[:1])
    turns = system.turns if turns is None else turns
    time = checks.real("init", "time", time, dtype)
    start = State(q, v, time, status, memory, turns)
    start = dataclasses.replace(start, angle_remainder=system.no_remainder(dtype))
    return unshared(start, system)


def _length(q: Any) -> int:
    """The number of positions given, where a system takes any."""
    array = checks.check("init", "q", q)
    return array.shape[-1] if array.ndim else 0


def check_dtype(system: Any, dtype: Any) -> None:
    """Checks that the system's numbers have the dtype of the state.

    Raises:
        ValueError: they have another floating dtype.
    """
    for leaf in jax.tree.leaves(system):
        got = getattr(leaf, "dtype", dtype)
        if jnp.issubdtype(got, jnp.floating) and got != dtype:
            raise ValueError(
                f"the state is {jnp.dtype(dtype).name}, but the system holds {got}: mixed dtypes"
                " are not promoted; build both with one dtype."
            )
