"""Arithmetic of a traced function, counted from its jaxpr, each distinct value once.

Each arithmetic operation on a floating-point number counts as one, whether it is an addition, a
division or a sine; data movement, comparisons and integers count as none. What is computed twice
from the same values counts once, and what nobody uses not at all: neither has to be done.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from jaxcon.core.jaxprs import called, without_unused

COUNTED = """add sub mul div neg max min sqrt rsqrt cbrt square pow exp exp2 log tanh
             sin cos tan asin acos atan atan2 sinh cosh"""
ELEMENTWISE = frozenset(COUNTED.split())
REDUCTIONS = frozenset({"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "cumsum"})
COMMUTING = frozenset({"add", "mul", "max", "min"})

Branch = Callable[[Iterable[float]], float]


def count(jaxpr: Any, branch: Branch = max) -> float:
    """Arithmetic operations of a jaxpr, those of inner ones included.

    Args:
        jaxpr: to be counted.
        branch: which of the branches of a conditional counts: max, or min for the cheapest.
    """
    values = Values(branch)
    return values.evaluate(jaxpr, [values.fresh() for _ in jaxpr.invars])[0]


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


class Values:
    """What a program computes: each distinct value by a number.

    Two equations with the same primitive, parameters and inputs give the same values; additions and
    multiplications also with their inputs exchanged. A loop is known by the jaxpr of its body, and
    within it values are distinct from those outside.

    Attributes:
        branch: as of `count`.
        known: the numbers of the results, by what they are computed from.
    """

    def __init__(self, branch: Branch) -> None:
        self.branch = branch
        self.known: dict[Any, list[int]] = {}
        self.numbers = itertools.count()

    def fresh(self) -> int:
        """The number of a value that is not computed from others."""
        return next(self.numbers)

    def evaluate(self, jaxpr: Any, given: list[int]) -> tuple[float, list[int]]:
        """Operations that a jaxpr adds to what is computed, and its results.

        Args:
            jaxpr: open.
            given: its inputs.
        """
        used = without_unused(jaxpr)
        place = dict(zip(used.invars, given, strict=True))
        place |= {x: self.fresh() for x in used.constvars}

        def number(x: Any) -> int:
            return self.literal(x) if isinstance(x, Literal) else place[x]

        total = 0.0
        for equation in used.eqns:
            cost, results = self.equation(equation, [number(x) for x in equation.invars])
            place.update(zip(equation.outvars, results, strict=True))
            total += cost
        return total, [number(x) for x in used.outvars]

    def equation(self, equation: Any, inputs: list[int]) -> tuple[float, list[int]]:
        """Operations that an equation adds, and its results."""
        evaluated = called_by(equation, inputs)
        if evaluated is not None:
            return self.evaluate(*evaluated)
        name = equation.primitive.name
        key = name, tuple(sorted(inputs) if name in COMMUTING else inputs), parameters(equation)
        if key in self.known:
            return 0.0, self.known[key]
        self.known[key] = [self.fresh() for _ in equation.outvars]
        return operations(equation, self.branch), self.known[key]

    def literal(self, x: Any) -> int:
        """A number written into the program."""
        value = np.asarray(x.val)
        key = "literal", value.tobytes(), value.dtype.name, x.aval.shape
        return self.known.setdefault(key, [self.fresh()])[0]


def called_by(equation: Any, inputs: list[int]) -> tuple[Any, list[int]] | None:
    """The jaxpr that an equation evaluates once, and its inputs; None where it does other things.

    A linear solve runs its solver; the matrix is only for derivatives.
    """
    name, params = equation.primitive.name, equation.params
    if name == "custom_linear_solve":
        lengths = params["const_lengths"]
        before = lengths.matvec + lengths.vecmat
        constants = inputs[before : before + lengths.solve]
        return params["jaxprs"].solve.jaxpr, constants + inputs[sum(lengths) :]
    inner = [] if name in ("scan", "while", "cond") else list(inside(equation))
    whole = len(inner) == 1 and len(inner[0].invars) == len(inputs)
    return (inner[0], inputs) if whole else None


def parameters(equation: Any) -> Any:
    """Returns the parameters of an equation, to be compared; a new object where they cannot be."""
    params = tuple(sorted(equation.params.items()))
    try:
        hash(params)
    except TypeError:
        return object()
    return params


def operations(equation: Any, branch: Branch = max) -> float:
    """Returns the operations of one equation; a loop of unknown length counts as one round."""
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return params["length"] * count(params["jaxpr"].jaxpr, branch)
    if name == "cond":
        return branch(count(part.jaxpr, branch) for part in params["branches"])
    inner = list(inside(equation))
    return sum(count(x, branch) for x in inner) if inner else arithmetic(equation)


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
    function = called(equation)
    if function is not None:
        yield getattr(function, "jaxpr", function)
        return
    for value in params.values():
        for part in value if isinstance(value, tuple) else (value,):
            closed = getattr(part, "jaxpr", part)
            if hasattr(closed, "eqns"):
                yield closed


def arithmetic(equation: Any) -> float:
    """Returns the arithmetic of one instruction, by its size."""
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
