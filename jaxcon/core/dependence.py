"""Whether a function reads its argument, found by tracing it."""

from collections.abc import Callable
from typing import Any

import jax

from jaxcon.core.jaxprs import read_arguments


def depends(function: Callable[[Any], Any], x: Any) -> bool:
    """Whether some number in the result of function(x) is computed from the numbers in x."""
    return any(read_arguments(jax.make_jaxpr(function)(x).jaxpr))
