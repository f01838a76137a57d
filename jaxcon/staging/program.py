"""Flattens a traced function to a list of operations, without calls and repetitions."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core as jex
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive, Var

from jaxcon.core.jaxprs import called
from jaxcon.core.typing import Array
from jaxcon.staging.constants import (
    MAX_SIZE,
    Constant,
    Operand,
    simplified,
    uniform,
    without_repetition,
)

if TYPE_CHECKING:
    from jaxcon.staging.batch_last import Native

IDENTITIES = ("stop_gradient", "copy", "copy_p", "optimization_barrier")
"""Primitives that return their arguments. XLA removes even barriers before it forms kernels."""

BINARY = ("add", "sub", "mul", "div", "max", "min", "and", "or", "eq", "ne", "lt", "le", "gt", "ge")
"""Elementwise primitives of two operands, one of which may be a number without axes."""

COMMUTATIVE = ("add", "mul", "max", "min", "and", "or", "eq", "ne")
"""Elementwise primitives whose two operands may change places."""

REDUCTIONS: dict[str, Callable[[Array, Array], Array]] = {
    "reduce_sum": jax.lax.add,
    "reduce_max": jax.lax.max,
    "reduce_min": jax.lax.min,
    "reduce_and": jax.lax.bitwise_and,
    "reduce_or": jax.lax.bitwise_or,
}
"""The elementwise operation by which `by_halves` replaces each reduction over the first axes."""


def _least(dtype: Any) -> Any:
    """Returns the least number of a dtype."""
    if dtype.kind == "b":
        return False
    return -np.inf if jnp.issubdtype(dtype, jnp.floating) else jnp.iinfo(dtype).min


def _largest(dtype: Any) -> Any:
    """Returns the largest number of a dtype."""
    if dtype.kind == "b":
        return True
    return np.inf if jnp.issubdtype(dtype, jnp.floating) else jnp.iinfo(dtype).max


OF_NOTHING: dict[str, Callable[[Any], Any]] = {
    "dot_general": lambda dtype: 0,
    "reduce_sum": lambda dtype: 0,
    "reduce_prod": lambda dtype: 1,
    "reduce_max": _least,
    "reduce_min": _largest,
    "reduce_and": lambda dtype: ~dtype.type(0),  # all bits are set
    "reduce_or": lambda dtype: 0,
}
"""The results of reductions of no entries, by dtype."""


@dataclass
class Operation:
    """The application of a primitive to numbered values.

    Attributes:
        inputs, outputs: the operands, and the numbers of the results.
        plain: True if a kernel may contain the operation; False for random keys, for side effects
            such as printing, and for loops and branches that do not fit into a kernel.
        effects: True if the operation has side effects.
        fixed: True if no operand depends on the arguments of the program.
    """

    primitive: Primitive
    params: dict[str, Any]
    inputs: list[Operand]
    outputs: list[int]
    plain: bool
    effects: bool
    fixed: bool

    @property
    def name(self) -> str:
        """The name of the primitive."""
        return self.primitive.name

    def __call__(self, operands: list[Any]) -> list[Any]:
        """Applies the primitive to the values of the operands; returns its results."""
        if self.fixed:
            operands = list(map(_hidden, operands))
        results = self.primitive.bind(*operands, **self.params)
        return results if self.primitive.multiple_results else [results]


def traced(function: Native, args: Sequence[Any]) -> ClosedJaxpr:
    """Returns the closed jaxpr of a native function, without unused equations."""
    return function.pruned(*((x.shape, x.dtype) for x in args))


def evaluated(closed: ClosedJaxpr, args: Sequence[Any]) -> list[Any]:
    """Evaluates a closed jaxpr; returns its results."""
    return jex.jaxpr_as_fun(closed)(*args)


Slice = tuple[list[Operand], dict[str, Any]]
"""The operands and the parameters of a slice."""

Inner = Callable[[ClosedJaxpr, Sequence[Constant | None]], tuple[ClosedJaxpr, bool]]
"""Rewrites the body of a loop or a branch; see `Program`."""


class Program:
    """A traced function as a flat list of operations on numbered values.

    Attributes:
        operations: the operations, in the order of the jaxpr.
        inputs: the numbers of the arguments, without those that are constants.
        outputs: the numbers of the results, or constants.
        makers: the operation that computes each value.
        sizes: the number of entries of each value.
        bytes: the size of each value [B].
    """

    def __init__(
        self, closed: ClosedJaxpr, inner: Inner, constants: Sequence[Constant | None] = ()
    ) -> None:
        """Flattens a closed jaxpr.

        Args:
            closed: the jaxpr.
            inner: a function that rewrites the body of a loop or a branch, for constants as below.
                It also returns True if a kernel may contain all of the body.
            constants: for each of the first arguments, the constant that takes its place, or None.
        """
        self.operations: list[Operation] = []
        self._inner = inner
        self._known: dict[Any, list[int]] = {}
        self.sizes: dict[int, int] = {}
        self.bytes: dict[int, int] = {}
        self._lengths: dict[int, list[Any]] = {}  # of the operands of concatenations
        self._fixed: set[Operand] = set()  # values that do not depend on the arguments
        self._slices: dict[Operand, Slice] = {}  # slices of successive entries
        self._broadcasts: dict[Any, JaxprEqn] = {}  # by dtype and both shapes
        pairs = itertools.zip_longest(closed.jaxpr.invars, constants)
        args: list[Operand] = [self._new(x) if known is None else known for x, known in pairs]
        self.inputs = [x for x in args if not isinstance(x, Constant)]
        outputs = self._inline_closed(closed, args)
        self.outputs = list(map(self._broadcast_repeated, outputs))
        self._read_parts()
        self.makers = {name: op for op in self.operations for name in op.outputs}
        self._drop_unused()

    def readers(self) -> dict[int, list[Operation]]:
        """Returns the operations that read each value."""
        readers: dict[int, list[Operation]] = {}
        for op in self.operations:
            for x in op.inputs:
                if not isinstance(x, Constant):
                    readers.setdefault(x, []).append(op)
        return readers

    def evaluate(self, values: dict[int, Any], wanted: Operand) -> Any:
        """Computes a value and returns it.

        Args:
            values: the values computed so far, by number. All values on the way are added.
            wanted: the number of the value; of a constant, its own value is returned.
        """
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

    def between(
        self, known: Container[int], wanted: list[int]
    ) -> tuple[list[int], list[Operation]]:
        """Finds the operations that compute wanted values from known values.

        Args:
            known: the numbers of the known values.
            wanted: the numbers of the wanted values.

        Returns:
            The numbers of the known values that are needed, and the operations, in no fixed order.
        """
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
        """Lets slices of a concatenation read the operand of the concatenation in which they lie.

        This is only done if every operation that reads the concatenation is a slice within one
        operand. The concatenation is then never stored.
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
        """Removes operations on which no result depends."""
        needed = {x for x in self.outputs if not isinstance(x, Constant)}
        operations: list[Operation] = []
        for op in reversed(self.operations):
            if op.effects or not needed.isdisjoint(op.outputs):
                operations.append(op)
                needed.update(x for x in op.inputs if not isinstance(x, Constant))
        self.operations = operations[::-1]

    def _new(self, variable: Var) -> int:
        """Returns the number of a new value, and stores its size.

        Args:
            variable: the variable of the jaxpr, with shape and dtype.
        """
        name = len(self.sizes)
        aval: Any = variable.aval
        self.sizes[name] = aval.size
        self.bytes[name] = aval.size * aval.dtype.itemsize
        return name

    def _inline_closed(self, jaxpr: Jaxpr | ClosedJaxpr, args: list[Operand]) -> list[Operand]:
        """Appends the operations of a jaxpr to the program; returns its results as operands."""
        if isinstance(jaxpr, ClosedJaxpr):
            jaxpr, args = jaxpr.jaxpr, [*map(Constant, jaxpr.consts), *args]
        names = dict(zip([*jaxpr.constvars, *jaxpr.invars], args, strict=True))

        def read(x: Var | Literal) -> Operand:
            return _literal(x) if isinstance(x, Literal) else names[x]

        for equation in jaxpr.eqns:
            results = self._append(equation, [read(x) for x in equation.invars])
            names.update(zip(equation.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _append(self, equation: JaxprEqn, args: list[Operand]) -> list[Operand]:
        """Appends an equation to the program; returns its results as operands.

        If the equation calls a function, the operations of the function are appended instead.
        """
        name, params = equation.primitive.name, equation.params
        if name in BINARY:
            result = self._append_arithmetic(equation, args)
            if result is not None:
                return result
        operands: list[Any] = [x.aval for x in equation.invars]
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
            return self._inline_closed(traced(params["fun"], operands), args)
        result = _known_result(equation, args)
        if result is not None:
            return [result]
        if name == "slice" and args[0] in self._slices:
            args, params = _within(self._slices[args[0]], params)
        if name in REDUCTIONS and _leading(params["axes"], operands[0].shape):
            fold = functools.partial(by_halves, REDUCTIONS[name], len(params["axes"]))
            return self._inline_closed(jax.make_jaxpr(fold)(operands[0]), args)
        if name == "split":
            parts = functools.partial(slices, params["sizes"], params["axis"])
            return self._inline_closed(jax.make_jaxpr(parts)(operands[0]), args)
        if name == "scan":
            jaxpr, plain = self._inner(params["jaxpr"], ())
            return self._emit(equation, params | {"jaxpr": jaxpr}, args, plain)
        if name == "while":
            return self._append_while(equation, args)
        if name == "cond":
            known = [x if isinstance(x, Constant) else None for x in args[1:]]
            rewritten = [self._inner(x, known) for x in params["branches"]]
            branches, plain = zip(*rewritten, strict=True)
            given = [args[0], *(x for x in args[1:] if not isinstance(x, Constant))]
            return self._emit(equation, params | {"branches": branches}, given, all(plain))
        return self._emit(equation, params, args, True)

    def _append_arithmetic(self, equation: JaxprEqn, args: list[Operand]) -> list[Any] | None:
        """Appends an arithmetic operation on two arrays of numbers that are not constant.

        Most operations of a step are such. They have no effects, a kernel may contain them, and
        none of their results is known. Returns None for other operands, and for results without
        entries or of symbolic size.
        """
        first, second = args
        aval: Any = equation.outvars[0].aval
        if isinstance(first, Constant) or isinstance(second, Constant):
            return None
        given: Any = equation.invars[0].aval
        if not all(type(n) is int and n for n in aval.shape) or _is_key(given):
            return None
        primitive, params = equation.primitive, equation.params
        swaps = second < first and primitive.name in COMMUTATIVE
        key = primitive, tuple(params.items()), (second, first) if swaps else (first, second)
        if key not in self._known:
            outputs = [self._new(equation.outvars[0])]
            fixed = first in self._fixed and second in self._fixed
            if fixed:
                self._fixed.update(outputs)
            op = Operation(primitive, params, args, outputs, True, False, fixed)
            self.operations.append(op)
            self._known[key] = outputs
        return self._known[key]

    def _append_while(self, equation: JaxprEqn, args: list[Operand]) -> list[Operand]:
        """Appends a loop with a condition, which is outside of kernels, maybe on all devices."""
        params = equation.params
        first = params["cond_nconsts"]
        last = first + params["body_nconsts"]
        known = [x if isinstance(x, Constant) else None for x in args[first:last]]
        body, _ = self._inner(params["body_jaxpr"], known)
        given = [x for x in args[first:last] if not isinstance(x, Constant)]
        params = params | {"body_jaxpr": body, "body_nconsts": len(given)}
        return self._emit(equation, params, [*args[:first], *given, *args[last:]], False)

    def _emit(
        self, equation: JaxprEqn, params: dict[str, Any], args: list[Operand], plain: bool
    ) -> list[Any]:
        """Appends an operation; returns the numbers of its results.

        If an identical operation was appended before, the numbers of its results are returned.

        Args:
            equation: the equation, which gives the primitive and the types.
            params: the parameters of the operation.
            args: the operands.
            plain: False if a kernel must not contain the operation.
        """
        primitive = equation.primitive
        args = self._stored(equation, args)
        key = _key(primitive, params, args)
        if key is not None and key in self._known:
            return self._known[key]
        outputs = [self._new(x) for x in equation.outvars]
        operands: list[Any] = [x.aval for x in equation.invars]
        if primitive.name == "slice" and params["strides"] is None:
            self._slices[outputs[0]] = args, params
        if primitive.name == "concatenate":
            axis = params["dimension"]
            self._lengths[outputs[0]] = [x.shape[axis] for x in operands]
        effects = bool(equation.effects)
        avals = [x.aval for x in (*equation.invars, *equation.outvars)]
        keys = any(map(_is_key, avals))
        plain = plain and not keys and not effects
        fixed = all(isinstance(x, Constant) or x in self._fixed for x in args)
        if fixed:
            self._fixed.update(outputs)
        op = Operation(primitive, params, args, outputs, plain, effects, fixed)
        self.operations.append(op)
        if key is not None and not effects:
            self._known[key] = outputs
        return outputs

    def _stored(self, equation: JaxprEqn, args: Sequence[Operand]) -> list[Operand]:
        """Returns the operands of an equation without constants that repeat their entries.

        An array of equal numbers becomes one number if the equation permits that, otherwise the
        broadcast of a smaller array.

        Args:
            equation: the equation.
            args: its operands.
        """
        if not any(isinstance(x, Constant) for x in args):
            return list(args)
        avals: list[Any] = [x.aval for x in (*equation.invars, *equation.outvars)]
        pairs = zip(args, avals, strict=False)
        moving = [y.shape for x, y in pairs if not isinstance(x, Constant)]
        if equation.primitive.name in BINARY and avals[-1].shape in moving:
            numbers = [x.number() if isinstance(x, Constant) else None for x in args]
            pairs = zip(args, numbers, strict=True)
            args = [x if number is None else Constant(number) for x, number in pairs]
        return list(map(self._broadcast_repeated, args))

    def _broadcast_repeated(self, operand: Operand) -> Operand:
        """Returns an operand; a broadcast in place of a constant with axes that repeat entries."""
        x = operand.value if isinstance(operand, Constant) else None
        if not isinstance(x, np.ndarray) or without_repetition(x).size == x.size:
            return operand
        once = without_repetition(x)
        if once.size == 1:
            once = once.reshape(())
        key = x.dtype, once.shape, x.shape
        if key not in self._broadcasts:
            axes = range(once.ndim)
            wide = functools.partial(
                jax.lax.broadcast_in_dim, shape=x.shape, broadcast_dimensions=axes
            )
            self._broadcasts[key] = jax.make_jaxpr(wide)(once).jaxpr.eqns[0]
        equation = self._broadcasts[key]
        (result,) = self._emit(equation, equation.params, [Constant(once)], True)
        return result


def _hidden(x: Any) -> Any:
    """Hides a constant array of floats from the compiler by a barrier; returns other operands.

    The compiler would otherwise fold its broadcast to a constant for all worlds, of which a device
    then reads its part by its own number. A kernel cannot read that number.
    """
    if isinstance(x, Tracer) or not np.ndim(x) or not jnp.issubdtype(x.dtype, np.floating):
        return x
    return jax.lax.optimization_barrier(jnp.asarray(x))


def _literal(x: Literal) -> Constant:
    """Returns a literal as a constant of its type."""
    aval: Any = x.aval
    return Constant(x.val if _is_key(aval) else np.asarray(x.val, aval.dtype)[()])


def _part(
    reader: Operation, operands: list[Operand], lengths: list[Any], axis: int
) -> Slice | None:
    """Converts a slice of a concatenation to a slice of one operand of the concatenation.

    Returns the new inputs and parameters of the slice. The result is None if the reader is no
    slice, or if the slice does not lie within one operand.

    Args:
        reader: an operation that reads the concatenation.
        operands: the operands of the concatenation.
        lengths: the sizes of the operands along the axis.
        axis: the axis of the concatenation.
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


def _within(whole: Slice, params: dict[str, Any]) -> Slice:
    """Returns a slice of a slice of successive entries, as a slice of the operand of the latter.

    Args:
        whole: the slice that is read.
        params: the parameters of the slice that reads it.
    """
    args, outer = whole
    first = outer["start_indices"]
    moved = {
        name: tuple(a + b for a, b in zip(first, params[name], strict=True))
        for name in ("start_indices", "limit_indices")
    }
    return args, params | moved


def _shifted(indices: Sequence[int], axis: int, by: int) -> tuple[int, ...]:
    """Returns the indices of all axes, with the number `by` subtracted from that of `axis`."""
    return tuple(i - by if a == axis else i for a, i in enumerate(indices))


def by_halves(operation: Callable[[Array, Array], Array], axes: int, x: Array) -> Array:
    """Reduces the first axes of an array, by combining its two halves until one entry is left.

    For an odd number of entries, the middle entry belongs to both halves, which does not change a
    maximum, for example. A sum, in which no entry may count twice, adds the last entry at the end
    instead.

    Args:
        operation: the elementwise operation, such as `jax.lax.add`.
        axes: the number of axes to reduce.
        x: the array.
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
    """Splits an array into parts of these sizes along an axis, by slices.

    Unlike the primitive `split`, slices do not store their results: kernels read through them.
    """
    ends = itertools.accumulate(sizes)
    pairs = zip(ends, sizes, strict=True)
    return [jax.lax.slice_in_dim(x, end - size, end, axis=axis) for end, size in pairs]


def _leading(axes: Sequence[int], shape: tuple[int, ...]) -> bool:
    """Returns True if `axes` are the first axes in order, and their sizes are known and not 0."""
    sizes = shape[: len(axes)]
    return tuple(axes) == tuple(range(len(axes))) and is_known(sizes) and all(sizes)


def is_known(shape: Sequence[Any]) -> bool:
    """Returns True if no size of a shape is symbolic, as from `jax.export.symbolic_shape`."""
    return all(isinstance(n, int) for n in shape)


def _known_result(equation: JaxprEqn, args: list[Operand]) -> Operand | None:
    """Returns the result of an equation that equals a constant or one of its operands, else None.

    Examples are x⁰ and a selection by a constant. The compiler would also simplify such an
    equation, but only after `fusion` has chosen the values to store.
    """
    if len(equation.outvars) != 1:
        return None
    name = equation.primitive.name
    operands: list[Any] = [x.aval for x in equation.invars]
    aval: Any = equation.outvars[0].aval
    if not is_known(aval.shape):  # a constant cannot have a symbolic size
        return None
    if 0 in aval.shape and not _is_key(aval):
        return uniform(0, aval)
    if name in OF_NOTHING and 0 in operands[0].shape:
        return uniform(OF_NOTHING[name](aval.dtype), aval)
    exponent = args[1] if name == "pow" and len(args) == 2 else None
    power = equation.params.get("y") if name == "integer_pow" else exponent
    if isinstance(power, Constant):
        power = power.number()
    if isinstance(power, int | float | np.generic) and power == 0:
        return uniform(1, aval)
    if name == "pad" and not any(map(any, equation.params["padding_config"])):
        return args[0]
    if name == "select_n" and all(x is args[1] or x == args[1] for x in args[2:]):
        return args[1]
    return simplified(equation, args)


def _key(primitive: Primitive, params: dict[str, Any], args: list[Operand]) -> Any:
    """Returns a key that is equal for identical operations; None for loops and branches.

    It is also None if a parameter cannot be hashed.
    """
    if primitive.name in ("scan", "while", "cond"):
        return None
    parts: list[Any] = []
    if primitive.name in COMMUTATIVE:
        args = sorted(args, key=lambda x: -1 if isinstance(x, Constant) else x)
    for x in args:
        if not isinstance(x, Constant):
            parts.append(x)
        elif jnp.shape(x.value) == () and not _is_key(x.value):
            value = np.asarray(x.value, jnp.result_type(x.value))
            parts.append((str(value.dtype), value.tobytes()))
        elif isinstance(x.value, np.ndarray) and x.value.size <= MAX_SIZE:
            parts.append((str(x.value.dtype), x.value.shape, x.value.tobytes()))
        else:
            parts.append((type(x.value).__name__, id(x.value)))  # the operation keeps it alive
    key = (primitive, tuple(sorted(params.items(), key=lambda item: item[0])), tuple(parts))
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _is_key(x: Any) -> bool:
    """Returns True if x is a random key or another array of an extended dtype."""
    dtype = getattr(x, "dtype", None)
    return not isinstance(dtype, np.dtype | None) and jnp.issubdtype(dtype, jax.dtypes.extended)
