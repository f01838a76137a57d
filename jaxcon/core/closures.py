"""Closure conversion of functions, and evaluation of single equations of a jaxpr."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from jaxcon.core.typing import PyTree


def hoist_closure(
    function: Callable[..., Any], *args: PyTree
) -> tuple[Callable[..., Any], list[Any], Any]:
    """Turns the arrays that a function closes over into an explicit argument.

    The function is traced once, for arguments with the shapes of `args`.

    Args:
        function: a pure function.
        args: pytrees of arrays, or of shapes and dtypes.

    Returns:
        A function (constants, *args) → function(*args), which can also be differentiated with
        respect to the constants.
        The list of constants: all arrays that `function` closes over, traced or not.
        The shapes and dtypes of the result.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shapes)

    def pure(constants: Sequence[Any], *args: PyTree) -> Any:
        flat = jaxpr_as_fun(ClosedJaxpr(jaxpr, constants))(*jax.tree.leaves(args))
        return jax.tree.unflatten(structure, flat)

    return pure, closed.consts, shapes


def apply_equation(jaxpr: Jaxpr, equation: JaxprEqn, inputs: Sequence[Any]) -> list[Any]:
    """Evaluates a single equation of a jaxpr with JAX.

    Args:
        jaxpr: an open jaxpr that contains the equation.
        equation: the equation to evaluate.
        inputs: the values of all operands, literals included.
    """
    pairs = zip(equation.invars, inputs, strict=True)
    given = {x: value for x, value in pairs if not isinstance(x, Literal)}
    alone = jaxpr.replace(
        constvars=[],
        invars=[*given],
        outvars=list(equation.outvars),
        eqns=[equation],
        effects=equation.effects,
    )
    return jaxpr_as_fun(ClosedJaxpr(alone, ()))(*given.values())
