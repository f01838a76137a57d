"""Dependence of a function on its argument, found by tracing it."""

from collections.abc import Callable
from typing import Any

import jax

from jaxcon.core.jaxprs import read_arguments


def depends(function: Callable[[Any], Any], x: Any) -> bool:
    """Returns True where the result of function(x) depends on some number in x."""
    return any(read_arguments(jax.make_jaxpr(function)(x).jaxpr))
