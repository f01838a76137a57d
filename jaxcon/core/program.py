"""A traced function as a flat list of operations: calls inlined, repetitions removed."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jex

from jaxcon.core.jaxprs import called, without_unused
from jaxcon.core.typing import Array

IDENTITIES = ("stop_gradient", "copy", "copy_p", "optimization_barrier")
"""Primitives that return their arguments; XLA, too, drops barriers before it forms kernels."""

REDUCTIONS: dict[str, Callable[[Array, Array], Array]] = {
    "reduce_sum": jax.lax.add,
    "reduce_max": jax.lax.max,
    "reduce_min": jax.lax.min,
    "reduce_and": jax.lax.bitwise_and,
    "reduce_or": jax.lax.bitwise_or,
}
"""Reductions that are done by halves, elementwise, where they run over the first axes."""


class Constant:
    """A literal or a captured array among the operands of an operation."""

    def __init__(self, value: Any) -> None:
        self.value = value


Operand = int | Constant
"""The number of a value, or a constant."""


@dataclass
class Operation:
    """One instruction on numbered values.

    Attributes:
        inputs, outputs: operands and results.
        plain: whether it may be part of a kernel as far as its dtypes and effects go; not so where
            it handles random keys, or does something besides, such as printing.
        effects: whether it does something besides.
    """

    primitive: Any
    params: dict[str, Any]
    inputs: list[Operand]
    outputs: list[int]
    plain: bool
    effects: bool

    @property
    def name(self) -> str:
        """The name of the primitive."""
        return self.primitive.name

    def __call__(self, operands: list[Any]) -> list[Any]:
        """Its results."""
        results = self.primitive.bind(*operands, **self.params)
        return results if self.primitive.multiple_results else [results]


def traced(function: Any, args: Sequence[Any]) -> Any:
    """The closed jaxpr of a native function, without what no result needs."""
    closed = function.traced(*((x.shape, x.dtype) for x in args))
    return jex.ClosedJaxpr(without_unused(closed.jaxpr), closed.consts)


def evaluated(closed: Any, args: Sequence[Any]) -> list[Any]:
    """The results of a closed jaxpr."""
    return jex.jaxpr_as_fun(closed)(*args)


class Program:
    """A function as operations in order.

    Attributes:
        operations: in order.
        inputs: numbers of the arguments.
        outputs: of the results.
        makers: the operation that makes a value.
        sizes: how many entries a value has.
        bytes: how many bytes they are.
    """

    def __init__(self, closed: Any, inner: Callable[[Any], tuple[Any, bool]]) -> None:
        """Flattens a closed jaxpr.

        Args:
            closed: the jaxpr.
            inner: rewrites the body of a loop, and says whether a kernel may contain all of it.
        """
        self.operations: list[Operation] = []
        self._inner = inner
        self._known: dict[Any, list[int]] = {}
        self.sizes: dict[int, int] = {}
        self.bytes: dict[int, int] = {}
        self._lengths: dict[int, list[Any]] = {}  # of the operands of concatenations
        self.inputs = [self._new(x) for x in closed.jaxpr.invars]
        self.outputs = self._inline_closed(closed, list(self.inputs))
        self._read_parts()
        self.makers = {name: op for op in self.operations for name in op.outputs}
        self._drop_unused()

    def readers(self) -> dict[int, list[Operation]]:
        """The operations that read each value."""
        readers: dict[int, list[Operation]] = {}
        for op in self.operations:
            for x in op.inputs:
                if not isinstance(x, Constant):
                    readers.setdefault(x, []).append(op)
        return readers

    def evaluate(self, values: dict[int, Any], wanted: Operand) -> Any:
        """A value from known ones, remembering what is computed on the way."""
        if isinstance(wanted, Constant):
            return wanted.value
        todo = [wanted]
        while todo:
            if todo[-1] in values:
                todo.pop()
                continue
            op = self.makers[todo[-1]]
            missing = [x for x in op.inputs if not isinstance(x, Constant) and x not in values]
            if missing:
                todo += missing
                continue
            operands = [x.value if isinstance(x, Constant) else values[x] for x in op.inputs]
            values.update(zip(op.outputs, op(operands), strict=True))
        return values[wanted]

    def between(self, known: Any, wanted: list[int]) -> tuple[list[int], list[Operation]]:
        """The known values of which others are made, and the operations that do it."""
        leaves: list[int] = []
        operations: list[Operation] = []
        seen: set[int] = set()
        todo = list(reversed(wanted))
        while todo:
            x = todo.pop()
            if x in seen:
                continue
            seen.add(x)
            if x in known:
                leaves.append(x)
            else:
                operations.append(self.makers[x])
                todo += [y for y in self.makers[x].inputs if not isinstance(y, Constant)]
        return leaves, operations

    def _read_parts(self) -> None:
        """Lets slices read the part of a concatenation in which they lie.

        Only where all readers do, so that the concatenation is never stored.
        """
        readers, results = self.readers(), {x for x in self.outputs if isinstance(x, int)}
        for op in self.operations:
            whole = op.outputs[:1]
            slices = readers.get(whole[0], []) if op.name == "concatenate" else []
            if not slices or not results.isdisjoint(whole):
                continue
            lengths = self._lengths[whole[0]]
            parts = [_part(x, op.inputs, lengths, op.params["dimension"]) for x in slices]
            for x, part in zip(slices, parts if all(parts) else (), strict=False):
                x.inputs, x.params = part or (x.inputs, x.params)

    def _drop_unused(self) -> None:
        """Leaves out operations on which no result depends."""
        needed = {x for x in self.outputs if not isinstance(x, Constant)}
        kept: list[Operation] = []
        for op in reversed(self.operations):
            if op.effects or not needed.isdisjoint(op.outputs):
                kept.append(op)
                needed.update(x for x in op.inputs if not isinstance(x, Constant))
        self.operations = kept[::-1]

    def _new(self, variable: Any) -> int:
        name = len(self.sizes)
        self.sizes[name] = variable.aval.size
        self.bytes[name] = variable.aval.size * variable.aval.dtype.itemsize
        return name

    def _inline_closed(self, jaxpr: Any, args: list[Operand]) -> list[Operand]:
        """Appends the operations of a jaxpr; returns its results."""
        if isinstance(jaxpr, jex.ClosedJaxpr):
            jaxpr, args = jaxpr.jaxpr, [*map(Constant, jaxpr.consts), *args]
        names = dict(zip([*jaxpr.constvars, *jaxpr.invars], args, strict=True))

        def read(x: Any) -> Operand:
            return Constant(x.val) if isinstance(x, jex.Literal) else names[x]

        for equation in jaxpr.eqns:
            results = self._append(equation, [read(x) for x in equation.invars])
            names.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _append(self, equation: Any, args: list[Operand]) -> list[Operand]:
        name, params = equation.primitive.name, equation.params
        inner = called(equation)
        if inner is not None:
            return self._inline_closed(inner, args)
        if name in IDENTITIES:
            return args
        if name == "custom_linear_solve":
            lengths = params["const_lengths"]
            first = lengths.matvec + lengths.vecmat
            last = first + lengths.solve
            given = [*args[first:last], *args[last + lengths.transpose_solve :]]
            return self._inline_closed(params["jaxprs"].solve, given)
        if name == "native":
            avals = [x.aval for x in equation.invars]
            return self._inline_closed(traced(params["fun"], avals), args)
        folded = _known_result(equation, args)
        if folded is not None:
            return folded
        if name in REDUCTIONS and _leading(params["axes"], equation.invars[0].aval.shape):
            fold = functools.partial(by_halves, REDUCTIONS[name], len(params["axes"]))
            return self._inline_closed(jax.make_jaxpr(fold)(equation.invars[0].aval), args)
        if name == "split":
            parts = functools.partial(slices, params["sizes"], params["axis"])
            return self._inline_closed(jax.make_jaxpr(parts)(equation.invars[0].aval), args)
        if name == "scan":
            jaxpr, plain = self._inner(params["jaxpr"])
            return self._emit(equation, params | {"jaxpr": jaxpr}, args, plain)
        if name == "while":  # when it ends is asked outside of kernels, maybe of all devices
            body = self._inner(params["body_jaxpr"])[0]
            return self._emit(equation, params | {"body_jaxpr": body}, args, False)
        if name == "cond":
            branches, plain = zip(*map(self._inner, params["branches"]), strict=True)
            return self._emit(equation, params | {"branches": branches}, args, all(plain))
        return self._emit(equation, params, args, True)

    def _emit(self, equation: Any, params: Any, args: list[Operand], plain: bool) -> list[Any]:
        """Appends an operation, or finds the same one done before."""
        primitive = equation.primitive
        key = _key(primitive, params, args)
        if key is not None and key in self._known:
            return self._known[key]
        outputs = [self._new(x) for x in equation.outvars]
        if primitive.name == "concatenate":
            axis = params["dimension"]
            self._lengths[outputs[0]] = [x.aval.shape[axis] for x in equation.invars]
        effects = bool(equation.effects)
        avals = [x.aval for x in (*equation.invars, *equation.outvars)]
        keys = any(map(_is_key, avals))
        plain = plain and not keys and not effects
        op = Operation(primitive, params, args, outputs, plain, effects)
        self.operations.append(op)
        if key is not None and not effects:
            self._known[key] = outputs
        return outputs


def _part(
    reader: Operation, operands: list[Operand], lengths: list[Any], axis: int
) -> tuple[list[Operand], dict[str, Any]] | None:
    """Operand and parameters of a slice that lies in one operand of a concatenation, or None.

    Args:
        reader: of the concatenation.
        operands: of the concatenation.
        lengths: their sizes along its axis.
        axis: along which they are joined.
    """
    if reader.name != "slice" or not is_known(lengths):
        return None
    start = 0
    low, high = reader.params["start_indices"], reader.params["limit_indices"]
    for operand, length in zip(operands, lengths, strict=True):
        if start <= low[axis] and high[axis] <= start + length:
            shifted = {"start_indices": _shifted(low, axis, start)}
            shifted["limit_indices"] = _shifted(high, axis, start)
            return [operand], reader.params | shifted
        start += length
    return None


def _shifted(indices: Sequence[int], axis: int, by: int) -> tuple[int, ...]:
    """The indices less a number along one axis."""
    return tuple(i - by if a == axis else i for a, i in enumerate(indices))


def by_halves(operation: Callable[[Array, Array], Array], axes: int, x: Array) -> Array:
    """The reduction over the first axes: the second half onto the first, until one is left.

    Of an odd number the one in the middle belongs to both halves where that changes nothing, and
    the last one waits where it does.
    """
    x = x.reshape((math.prod(x.shape[:axes]), *x.shape[axes:]))
    waiting: list[Array] = []
    while len(x) > 1:
        if len(x) % 2 and operation is jax.lax.add:
            waiting.append(x[-1])
            x = x[:-1]
        half = (len(x) + 1) // 2
        x = operation(x[:half], x[len(x) - half :])
    return functools.reduce(operation, waiting, x[0])


def slices(sizes: Sequence[int], axis: int, x: Array) -> list[Array]:
    """The parts of these sizes along an axis, one by one, so that kernels read through them."""
    ends = itertools.accumulate(sizes)
    pairs = zip(ends, sizes, strict=True)
    return [jax.lax.slice_in_dim(x, end - size, end, axis=axis) for end, size in pairs]


def _leading(axes: Any, shape: tuple[int, ...]) -> bool:
    """Returns True for the first axes, of known sizes, none of them empty."""
    sizes = shape[: len(axes)]
    return tuple(axes) == tuple(range(len(axes))) and is_known(sizes) and all(sizes)


def is_known(shape: Sequence[Any]) -> bool:
    """Returns True where all sizes are numbers; those of `jax.export.symbolic_shape` are not."""
    return all(isinstance(n, int) for n in shape)


def _known_result(equation: Any, args: list[Operand]) -> list[Operand] | None:
    """The result of an operation that does not depend on all its operands.

    The compiler would find it out later, when what is stored has been decided.
    """
    if len(equation.outvars) != 1:
        return None
    name, aval = equation.primitive.name, equation.outvars[0].aval
    if not is_known(aval.shape):  # no constant is of a size that is still open
        return None
    if 0 in aval.shape and not _is_key(aval):
        return [Constant(np.zeros(aval.shape, aval.dtype))]
    exponent = args[1] if name == "pow" and len(args) == 2 else None
    power = equation.params.get("y") if name == "integer_pow" else exponent
    if isinstance(power, Constant) and jnp.shape(power.value) == ():
        power = power.value
    if isinstance(power, int | float | np.generic) and power == 0:
        return [Constant(np.ones(aval.shape, aval.dtype))]
    if name == "pad" and not any(map(any, equation.params["padding_config"])):
        return [args[0]]
    if name == "select_n" and all(x is args[1] or x == args[1] for x in args[2:]):
        return [args[1]]
    if name == "select_n" and isinstance(args[0], Constant) and jnp.shape(args[0].value) == ():
        return [args[1 + int(args[0].value)]]
    return None


def _key(primitive: Any, params: Any, args: list[Operand]) -> Any:
    """What makes an operation the same as another; None where that cannot be told."""
    if primitive.name in ("scan", "while", "cond"):
        return None
    parts: list[Any] = []
    for x in args:
        if not isinstance(x, Constant):
            parts.append(x)
        elif jnp.shape(x.value) == () and not _is_key(x.value):
            value = np.asarray(x.value, jnp.result_type(x.value))
            parts.append((str(value.dtype), value.tobytes()))
        else:
            parts.append((type(x.value).__name__, id(x.value)))  # kept alive by the operation
    key = (primitive, tuple(sorted(params.items(), key=lambda item: item[0])), tuple(parts))
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _is_key(x: Any) -> bool:
    """Returns True where it is a random key, or another array without numbers."""
    return jnp.issubdtype(getattr(x, "dtype", np.float32), jax.dtypes.extended)
