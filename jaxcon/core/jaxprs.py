"""Functions on jaxprs that hide differences between versions of JAX."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, jaxpr_as_fun
from jax.interpreters import partial_eval

from jaxcon.core.selection import evaluate_selection, select_rows_p
from jaxcon.core.typing import Array, PyTree

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
"""Primitives that only call a function, and the name of their parameter for its jaxpr."""


def called(equation: JaxprEqn) -> Any:
    """Returns the jaxpr that an equation calls; None if the equation is not a plain call.

    A selection of rows counts as a call of the operations that evaluate it. From JAX 0.11 on,
    `lax.custom_root` is a `HiPrim`, a primitive with its own derivative rule. The method `expand`
    of a `HiPrim` is the called function, which is traced to a jaxpr.
    """
    name, params = equation.primitive.name, equation.params
    if name in CALLS:
        return params[CALLS[name]]
    if name == select_rows_p.name:
        x: Any = equation.invars[0].aval
        return _selection(x.shape, x.dtype, params["places"], settings())
    primitive: Any = params.get("_prim")
    if hasattr(primitive, "expand"):
        return jax.make_jaxpr(primitive.expand)(*primitive.in_avals)
    return None


def settings() -> tuple[Any, ...]:
    """Returns JAX's settings that operations keep when they are traced."""
    return jax.sharding.get_abstract_mesh(), jnp.result_type(float)


@functools.lru_cache(maxsize=1024)
def _selection(
    shape: tuple[Any, ...], dtype: Any, places: tuple[int, ...], settings: tuple[Any, ...]
) -> ClosedJaxpr:
    """Returns the jaxpr of a selection of rows; `settings` are only a part of the cache's key."""
    select = functools.partial(evaluate_selection, places=places)
    return jax.make_jaxpr(select)(jax.ShapeDtypeStruct(shape, dtype))


def traced_once(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Returns an equal function that is traced once for each shape of its argument.

    Each call is a single equation. Without this, a function given to `lax.custom_linear_solve` is
    traced up to three times a call. Outside of `jit`, each returned function is compiled.

    Args:
        function: a function of one array. It must not store anything that it computes. JAX's
            settings must not change between calls.
    """
    traces: dict[Any, tuple[Callable[..., Any], list[Any]]] = {}

    def call(x: Array) -> Array:
        key = x.shape, x.dtype
        if key not in traces:
            closed = jax.make_jaxpr(function)(x)
            # what the function closes over are arguments, since they may belong to an outer trace
            evaluate = jax.jit(lambda c, x: jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, c))(x)[0])
            traces[key] = evaluate, closed.consts
        evaluate, consts = traces[key]
        return evaluate(consts, x)

    return call


def each(function: Callable[[Any], Any], xs: PyTree) -> Any:
    """Returns `jax.vmap(function)(xs)`, even if the function contains a `lax.custom_root`.

    In branches of `lax.cond`, JAX 0.11 vectorizes `custom_root` to a primitive without a
    derivative. With that version, `each` uses `jax.lax.map` instead.
    """
    if jax.__version_info__[:2] == (0, 11):
        return jax.lax.map(function, xs)
    return jax.vmap(function)(xs)


def without_unused(jaxpr: Jaxpr, wanted: Sequence[bool] | None = None) -> Any:
    """Removes unwanted results and unused equations from an open jaxpr.

    Args:
        jaxpr: the open jaxpr. The returned jaxpr keeps all arguments, even unused ones.
        wanted: True for each result to keep; None for all.
    """
    chosen = [True] * len(jaxpr.outvars) if wanted is None else list(wanted)
    return partial_eval.dce_jaxpr(jaxpr, chosen, instantiate=True)[0]


def read_arguments(jaxpr: Jaxpr) -> list[bool]:
    """Returns a flag for each argument of an open jaxpr: True if any result depends on it."""
    return partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]
