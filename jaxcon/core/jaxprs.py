"""Traced functions as JAX writes them down; what its versions write differently is read here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.interpreters import partial_eval

CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
}
"""Primitives that only call a function, and the parameter that holds it."""


def called(equation: Any) -> Any:
    """The jaxpr that an equation only calls, or None where it does anything else.

    From JAX 0.11 on, `lax.custom_root` is a primitive with derivatives of its own, a `HiPrim`: its
    `expand` is the function, which is traced here.
    """
    name, params = equation.primitive.name, equation.params
    if name in CALLS:
        return params[CALLS[name]]
    primitive = params.get("_prim")
    if hasattr(primitive, "expand"):
        return jax.make_jaxpr(primitive.expand)(*primitive.in_avals)
    return None


def each(function: Callable[[Any], Any], xs: Any) -> Any:
    """`jax.vmap(function)(xs)`, of functions that contain a `lax.custom_root`.

    JAX 0.11 maps it to a primitive without a derivative in the branches of `lax.cond`; there the
    function runs once for each x.
    """
    if jax.__version_info__[:2] == (0, 11):
        return jax.lax.map(function, xs)
    return jax.vmap(function)(xs)


def without_unused(jaxpr: Any, wanted: Sequence[bool] | None = None) -> Any:
    """An open jaxpr with the wanted results alone, and without what none of them needs.

    Args:
        jaxpr: open; it keeps all its arguments.
        wanted: whether each result is; all of them unless given.
    """
    chosen = [True] * len(jaxpr.outvars) if wanted is None else list(wanted)
    return partial_eval.dce_jaxpr(jaxpr, chosen, instantiate=True)[0]


def read_arguments(jaxpr: Any) -> list[bool]:
    """Returns, for each argument of an open jaxpr, True where some result is computed from it."""
    return partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]
