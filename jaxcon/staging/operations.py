"""Counts the arithmetic operations of a traced function from its jaxpr.

Each arithmetic operation on a floating-point number counts as one, whether it is an addition, a
division or a sine; data movement, comparisons and integers count as none. Repeated computations
count once, and unused ones do not count.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal, Var

from jaxcon.core.jaxprs import called, without_unused

COUNTED = """add sub mul div neg max min sqrt rsqrt cbrt square pow exp exp2 log tanh
             sin cos tan asin acos atan atan2 sinh cosh"""
ELEMENTWISE = frozenset(COUNTED.split())
REDUCTIONS = frozenset({"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "cumsum"})
COMMUTING = frozenset({"add", "mul", "max", "min"})

Branch = Callable[[Iterable[float]], float]


def count(jaxpr: Jaxpr, branch: Branch = max) -> float:
    """Returns the number of arithmetic operations of a jaxpr, inner jaxprs included.

    Args:
        jaxpr: the program.
        branch: max or min, to count the costliest or the cheapest branch of a conditional.
    """
    values = Values(branch)
    return values.evaluate(jaxpr, [values.fresh() for _ in jaxpr.invars])[0]


def instructions(jaxpr: Jaxpr) -> int:
    """Returns the number of equations of a jaxpr, inner jaxprs included; loop bodies count once."""
    total = 0
    for equation in jaxpr.eqns:
        inner = list(inside(equation))
        total += sum(map(instructions, inner)) if inner else 1
    return total


def primitives(jaxpr: Jaxpr) -> set[str]:
    """Returns the names of the primitives of a jaxpr, inner jaxprs included."""
    names: set[str] = set()
    for equation in jaxpr.eqns:
        names.add(equation.primitive.name)
        names = names.union(*map(primitives, inside(equation)))
    return names


class Values:
    """A numbering of the distinct values of a program, to count repeated computations only once.

    Two equations with the same primitive, parameters and inputs give the same values. The order of
    inputs does not matter for the primitives in `COMMUTING`. A loop is identified by the jaxpr of
    its body; values inside a loop are distinct from values outside.

    Attributes:
        branch: see `count`.
        known: the numbers of results by primitive, numbers of inputs, and parameters.
    """

    def __init__(self, branch: Branch) -> None:
        self.branch = branch
        self.known: dict[Any, list[int]] = {}
        self.numbers = itertools.count()

    def fresh(self) -> int:
        """Returns a number that no value has so far."""
        return next(self.numbers)

    def evaluate(self, jaxpr: Jaxpr, given: list[int]) -> tuple[float, list[int]]:
        """Counts the operations of a jaxpr that have not been counted before.

        Args:
            jaxpr: the open jaxpr.
            given: the numbers that identify its inputs.

        Returns:
            The number of operations, and the numbers that identify the results.
        """
        used = without_unused(jaxpr)
        place = dict(zip(used.invars, given, strict=True))
        place |= {x: self.fresh() for x in used.constvars}

        def number(x: Var | Literal) -> int:
            return self.literal(x) if isinstance(x, Literal) else place[x]

        total = 0.0
        for equation in used.eqns:
            cost, results = self.equation(equation, [number(x) for x in equation.invars])
            place.update(zip(equation.outvars, results, strict=True))
            total += cost
        return total, [number(x) for x in used.outvars]

    def equation(self, equation: JaxprEqn, inputs: list[int]) -> tuple[float, list[int]]:
        """Counts the operations of an equation that have not been counted before.

        Args:
            equation: the equation.
            inputs: the numbers that identify its inputs.

        Returns:
            The number of operations, and the numbers that identify the results.
        """
        evaluated = called_by(equation, inputs)
        if evaluated is not None:
            return self.evaluate(*evaluated)
        name = equation.primitive.name
        key = name, tuple(sorted(inputs) if name in COMMUTING else inputs), parameters(equation)
        if key in self.known:
            return 0.0, self.known[key]
        self.known[key] = [self.fresh() for _ in equation.outvars]
        return operations(equation, self.branch), self.known[key]

    def literal(self, x: Literal) -> int:
        """Returns the number that identifies a literal of the program."""
        value = np.asarray(x.val)
        aval: Any = x.aval
        key = "literal", value.tobytes(), value.dtype.name, aval.shape
        return self.known.setdefault(key, [self.fresh()])[0]


def called_by(equation: JaxprEqn, inputs: list[int]) -> tuple[Any, list[int]] | None:
    """Returns the jaxpr that an equation calls once, without a loop or a branch.

    A linear solve calls its solver; the matrix of the solve is only needed for derivatives.

    Args:
        equation: the equation.
        inputs: the numbers that identify its inputs.

    Returns:
        The jaxpr and the numbers of its inputs; None for other equations.
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


def parameters(equation: JaxprEqn) -> Any:
    """Returns a key for the parameters of an equation.

    If they cannot be hashed, the key is a new object, which equals no other key.
    """
    params = tuple(sorted(equation.params.items()))
    try:
        hash(params)
    except TypeError:
        return object()
    return params


def operations(equation: JaxprEqn, branch: Branch = max) -> float:
    """Returns the number of arithmetic operations of one equation, inner jaxprs included.

    A loop of unknown length counts as one round.

    Args:
        equation: the equation.
        branch: max or min, to count the costliest or the cheapest branch of a conditional.
    """
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return params["length"] * count(params["jaxpr"].jaxpr, branch)
    if name == "cond":
        return branch(count(part.jaxpr, branch) for part in params["branches"])
    inner = list(inside(equation))
    return sum(count(x, branch) for x in inner) if inner else arithmetic(equation)


def inside(equation: JaxprEqn) -> Iterator[Any]:
    """Yields the inner jaxprs that an equation evaluates; nothing for a plain instruction."""
    name, params = equation.primitive.name, equation.params
    if name == "custom_linear_solve":  # its matrix is only needed for derivatives
        yield params["jaxprs"].solve.jaxpr
        return
    if name == "native":
        avals: list[Any] = [x.aval for x in equation.invars]
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals]
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


def arithmetic(equation: JaxprEqn) -> float:
    """Returns the number of arithmetic operations of an equation without inner jaxprs.

    The number follows from the shapes of its operands and results.
    """
    if not equation.outvars:
        return 0.0
    name = equation.primitive.name
    operands: list[Any] = [x.aval for x in equation.invars]
    results: list[Any] = [x.aval for x in equation.outvars]
    result = results[0]
    if not jnp.issubdtype(getattr(result, "dtype", jnp.int32), jnp.floating):
        return 0.0
    if name == "integer_pow":
        return result.size * math.ceil(math.log2(max(2, abs(equation.params["y"]))))
    if name == "dot_general":
        left = operands[0].shape
        (contracted, _), _ = equation.params["dimension_numbers"]
        return 2.0 * result.size * math.prod(left[i] for i in contracted)
    if name in REDUCTIONS:
        return operands[0].size
    if name == "cholesky":
        return result.size * result.shape[-1] / 3
    if name == "lu":
        return 2 * result.size * result.shape[-1] / 3
    if name == "eigh":  # Golub and Van Loan, Matrix Computations (2013), section 8.3
        vectors = max(results, key=lambda aval: aval.size)
        return 9 * vectors.size * vectors.shape[-1]
    if name == "triangular_solve":
        return result.size * operands[0].shape[-1]
    return result.size if name in ELEMENTWISE else 0.0
