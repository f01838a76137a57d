"""A test whether a function depends on its argument, by tracing."""

from collections.abc import Callable
from typing import Any

import jax

from jaxcon.core.jaxprs import read_arguments
from jaxcon.core.typing import PyTree


def depends(function: Callable[[Any], PyTree], x: PyTree) -> bool:
    """Returns True if the result of function(x) depends on any leaf of x."""
    return any(read_arguments(jax.make_jaxpr(function)(x).jaxpr))
