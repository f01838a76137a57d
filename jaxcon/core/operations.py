"""Arithmetic of a traced function, counted from its jaxpr.

Each operation on a floating-point number counts as one, whether it is an addition, a division or a
sine; data movement, comparisons and integers count as none. What XLA finds to be computed twice is
counted twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

COUNTED = """add sub mul div neg max min sqrt rsqrt cbrt square pow exp exp2 log tanh
             sin cos tan asin acos atan atan2 sinh cosh"""
ELEMENTWISE = frozenset(COUNTED.split())
REDUCTIONS = frozenset({"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "cumsum"})

Branch = Callable[[Iterable[float]], float]


def count(jaxpr: Any, branch: Branch = max) -> float:
    """Arithmetic operations of a jaxpr, those of inner ones included.

    Args:
        jaxpr: to be counted.
        branch: which of the branches of a conditional counts: max, or min for the cheapest.
    """
    return float(sum(operations(equation, branch) for equation in jaxpr.eqns))


def operations(equation: Any, branch: Branch = max) -> float:
    """Of one equation; a loop of unknown length counts as one round."""
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return params["length"] * count(params["jaxpr"].jaxpr, branch)
    if name == "cond":
        return branch(count(part.jaxpr, branch) for part in params["branches"])
    inner = list(inside(equation))
    return sum(count(x, branch) for x in inner) if inner else arithmetic(equation)


def instructions(jaxpr: Any) -> int:
    """Equations of a jaxpr, those of inner ones in the place of what holds them; loops once."""
    total = 0
    for equation in jaxpr.eqns:
        inner = list(inside(equation))
        total += sum(map(instructions, inner)) if inner else 1
    return total


def primitives(jaxpr: Any) -> set[str]:
    """Names of the primitives of a jaxpr, those of inner ones included."""
    found: set[str] = set()
    for equation in jaxpr.eqns:
        found.add(equation.primitive.name)
        found = found.union(*map(primitives, inside(equation)))
    return found


def inside(equation: Any) -> Iterator[Any]:
    """The jaxprs that an equation evaluates; none where it is an instruction."""
    name, params = equation.primitive.name, equation.params
    if name == "custom_linear_solve":  # runs its solver; the matrix is only for derivatives
        yield params["jaxprs"].solve.jaxpr
        return
    if name == "native":
        shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
        yield jax.make_jaxpr(params["fun"])(*shapes).jaxpr
        return
    for value in params.values():
        for part in value if isinstance(value, tuple) else (value,):
            closed = getattr(part, "jaxpr", part)
            if hasattr(closed, "eqns"):
                yield closed


def arithmetic(equation: Any) -> float:
    """Of one instruction, by its size."""
    if not equation.outvars:
        return 0.0
    name, result = equation.primitive.name, equation.outvars[0].aval
    if not jnp.issubdtype(getattr(result, "dtype", jnp.int32), jnp.floating):
        return 0.0
    if name == "integer_pow":
        return result.size * math.ceil(math.log2(max(2, abs(equation.params["y"]))))
    if name == "dot_general":
        left = equation.invars[0].aval.shape
        (contracted, _), _ = equation.params["dimension_numbers"]
        return 2.0 * result.size * math.prod(left[i] for i in contracted)
    if name in REDUCTIONS:
        return equation.invars[0].aval.size
    if name == "cholesky":
        return result.size * result.shape[-1] / 3
    if name == "lu":
        return 2 * result.size * result.shape[-1] / 3
    if name == "eigh":  # Golub and Van Loan, Matrix Computations (2013), section 8.3
        vectors = max(equation.outvars, key=lambda x: x.aval.size).aval
        return 9 * vectors.size * vectors.shape[-1]
    if name == "triangular_solve":
        return result.size * equation.invars[0].aval.shape[-1]
    return result.size if name in ELEMENTWISE else 0.0
