"""Whether a function reads its argument, found by tracing it."""

from collections.abc import Callable
from typing import Any

import jax
from jax.interpreters import partial_eval


def depends(function: Callable[[Any], Any], x: Any) -> bool:
    """Whether some number in the result of function(x) is computed from the numbers in x."""
    jaxpr = jax.make_jaxpr(function)(x).jaxpr
    used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1]
    return any(used)
