"""Functions without their closures, so that derivatives by what they close over can be taken."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxcon.core.typing import PyTree


def opened(function: Callable[..., Any], *args: PyTree) -> tuple[Callable[..., Any], Any, PyTree]:
    """(constants, *args) → function(*args), the constants, and the shapes of the result.

    Constants are all arrays that the function closes over, traced or not; what it does with them is
    traced once, for arguments of these shapes.

    Args:
        function: pure.
        args: pytrees of arrays, or of their shapes and dtypes.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shapes)

    def pure(constants: Any, *args: PyTree) -> PyTree:
        flat = jaxpr_as_fun(ClosedJaxpr(jaxpr, constants))(*jax.tree.leaves(args))
        return jax.tree.unflatten(structure, flat)

    return pure, closed.consts, shapes
