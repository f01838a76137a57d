"""Native functions: `vmap` calls them once, with the whole batch along the last axis.

A function written with lanes takes arrays with any number of trailing batch axes, and each of its
operations is one loop over contiguous memory. Plain `jax.vmap` puts the batch first and rewrites
every instruction, so that small matrices are processed one by one. `call` wraps the function in a
primitive whose batching rule passes the whole batch along the last axis.

On NVIDIA's GPUs, the lowering rule writes the function as one kernel; see `cuda`. Where it cannot,
and on other GPUs, it keeps the batch last in memory. XLA would otherwise store arrays as the caller
does, batch first, and read them with strides or move them one by one.

On CPUs, the lowering rule also cuts a function into stages. Without stages, XLA computes shared
values again in each kernel that needs them: a chain of 5 links then runs at 0.054 instead of 2.9
million steps a second (two cores, a batch in the hundreds). See `fusion`.

The derivative of a native function is a native function, too. The rules below bind the same
primitive again, for the tangent map and for its transpose. So native functions compose with `grad`,
`jvp`, `vmap(grad)`, `grad(vmap)`, `hessian` and `scan`, and the results are native.

An argument that is not mapped gets a trailing axis of size 1, and the function broadcasts it: a
parameter shared by all worlds is read once. The transpose of that broadcast is a sum over worlds.
The sum is right for `grad(vmap(f))`, and wrong for `vmap(grad(f))`. Therefore a batched transposed
map returns one cotangent for each world, also for arguments that the worlds share.

The reverse pass keeps only the arguments of each call, with the solution of an iteration in place
of its start. A call is a checkpoint, and its derivative evaluates the function once more.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive
from jax.extend.core.primitives import stop_gradient_p
from jax.interpreters import ad, batching, mlir, partial_eval

from jaxcon.core import notices
from jaxcon.core.jaxprs import settings, without_unused
from jaxcon.core.somewhere import asking
from jaxcon.core.typing import Array, PyTree, Scalar, T
from jaxcon.staging import cpu, cuda, fusion, kernels, meshes
from jaxcon.staging.thread import UnsupportedError
from jaxcon.staging.worlds import broadcast_worlds

FEW = 64
"""The largest number of entries of a concrete array that becomes a constant of the program."""

# Set while `TangentNative` traces a derivative, read by the custom JVP rule in `failure`. JAX calls
# that rule while it traces, with a fixed signature: no argument can carry the order.
_ORDER = ContextVar("order", default=0)

# Set while `TransposedNative` traces, read by `_stopped`. JAX calls transpose rules with a fixed
# signature.
_TRANSPOSED = ContextVar("transposed", default=False)

# Set around the loop of a rollout, read in `call`. An argument in place of this variable would have
# to pass through the adjoint's scan, which users may replace, and through reverse passes that JAX
# traces.
_CONSTANTS = ContextVar("constants", default=True)

# Set while the lowering rule for GPUs traces a native function, read by this rule. JAX calls it for
# native functions within the function, with a fixed signature.
_IN_ORDER = ContextVar("in order", default=False)

# Set while a native function is traced for its values, read at the start of a step. The functions
# between the two belong to the caller.
_VALUES = ContextVar("values", default=False)


def for_values_only() -> bool:
    """Returns True while a native function is traced for its values, False in its derivatives."""
    return _VALUES.get()


def order() -> int:
    """Returns the order of the derivative being traced: 0 for the native function itself."""
    return _ORDER.get()


@contextmanager
def during(variable: ContextVar[T], value: T) -> Iterator[None]:
    """Sets a context variable for the duration of a `with` block."""
    before = variable.set(value)
    try:
        yield
    finally:
        variable.reset(before)


@contextmanager
def without_collections() -> Iterator[None]:
    """Pauses Python's search for cyclic garbage, which takes a quarter of the time of tracing.

    A trace makes hundreds of thousands of objects that live until it is compiled. The collector
    looks at all of them again and again, and finds nothing to free.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


Aval = tuple[tuple[int, ...], Any]
"""A shape and a dtype."""
Guess = tuple[Callable[[Any], Array | None], Callable[[Any], Array | None]]
"""The start of an iteration in the arguments of a function, and its solution in the result."""


class Native:
    """A function of arrays with trailing batch axes, compared by identity.

    Attributes:
        function: (arrays) → list of arrays.
        staged: True if the function and its derivatives may be cut into stages.
        guess: the index of an argument that is only the start of an iteration, and of the result
            from which the iteration would end at once; None if there is none, or before the
            function is traced.
        sums: True if a result that has size 1 along a batch axis is a sum over the worlds.
    """

    def __init__(self, function: Callable[..., Any], staged: bool = True) -> None:
        self.function, self.staged = function, staged
        self.guess: tuple[int, int] | None = None
        self.sums = False
        self.compiled = jax.jit(
            lambda *args, rank=0: bound(args, self, rank), static_argnames="rank"
        )
        self.tangent = functools.lru_cache(maxsize=64)(functools.partial(TangentNative, self))
        self.transposed = functools.lru_cache(maxsize=64)(functools.partial(TransposedNative, self))
        self.part = functools.lru_cache(maxsize=64)(functools.partial(PartialNative, self))
        self.among = functools.lru_cache(maxsize=64)(self._among)

    def __call__(self, *args: Array) -> list[Array]:
        """Calls the wrapped function directly, not through the primitive; returns its results."""
        return list(self.function(*args))

    def without_batch(self) -> Native:
        """Returns the function as it was before `vmap` added any batch axes to it."""
        return self

    def sums_shared(self, shared: Sequence[bool]) -> bool:
        """Returns True if a sum over the worlds contains a cotangent that they share.

        Args:
            shared: for each argument, True if it has size 1 along an axis of several worlds.
        """
        return False

    def eager(self, *args: Array, rank: int) -> list[Array]:
        """Evaluates the function for a call outside jit: compiled, unless jit is disabled.

        Args:
            args: its arguments.
            rank: the number of their batch axes.
        """
        if jax.config.values["jax_disable_jit"]:
            return self(*args)
        return self.compiled(*args, rank=rank)

    def shapes(self, args: Sequence[Array | ShapedArray], rank: int) -> list[Any]:
        """Returns the shapes and dtypes of the results, for arguments of these shapes.

        The function is traced for one world. A result has the batch of the arguments that it may
        depend on.

        Args:
            args: its arguments, with `rank` trailing batch axes.
            rank: the number of batch axes.
        """
        closed = self.traced(*(((*x.shape[: x.ndim - rank], 1), x.dtype) for x in args))
        if any(y.shape[-1:] != (1,) for y in closed.out_avals):
            raise ValueError("a native function returns an array without the axis of its worlds.")
        batches = [x.shape[x.ndim - rank :] for x in args]
        shared = (1,) * rank
        return [
            ShapedArray(
                (*y.shape[:-1], *jnp.broadcast_shapes(shared, *(batches[i] for i in sources))),
                y.dtype,
            )
            for y, sources in zip(closed.out_avals, sources_of(closed), strict=True)
        ]

    def traced(self, *avals: Aval) -> ClosedJaxpr:
        """Returns the closed jaxpr for arguments of these shapes and dtypes, from a cache.

        JAX's current settings are part of the key of the cache, because operations keep the mesh
        and the default precision under which they were traced.
        """
        return self.among((*settings(), notices.is_observing()), *avals)

    def pruned(self, *avals: Aval) -> ClosedJaxpr:
        """Returns the closed jaxpr without unused equations, from a cache."""
        return pruned(self.traced(*avals))

    def _among(self, settings: tuple[Any, ...], *avals: Aval) -> ClosedJaxpr:
        """Returns `_traced(*avals)`, and is cached by settings, shapes and dtypes.

        Args:
            settings: JAX's current settings, which are only a part of the key of the cache.
            avals: shapes and dtypes of the arguments.
        """
        return self._traced(*avals)

    def _traced(self, *avals: Aval) -> ClosedJaxpr:
        """Traces the function for arguments of these shapes and dtypes; returns the closed jaxpr.

        Raises:
            TypeError: a user's function closes over a traced value, with respect to which the
                derivative would silently be zero.
        """
        with meshes.apart(), without_collections(), during(_VALUES, True):
            closed = jax.make_jaxpr(self)(*(jax.ShapeDtypeStruct(*aval) for aval in avals))
        if any(isinstance(x, Tracer) for x in closed.consts):
            raise TypeError(
                "a function of the scene (a force, constraint, motion, mass or potential) closes"
                " over a traced value, which would be invisible to vmap and grad: pass it through"
                " params= instead."
            )
        return closed


@functools.lru_cache(maxsize=256)
def pruned(closed: ClosedJaxpr) -> ClosedJaxpr:
    """Returns a closed jaxpr without unused equations."""
    return ClosedJaxpr(without_unused(closed.jaxpr), closed.consts)


@functools.lru_cache(maxsize=256)
def sources_of(closed: ClosedJaxpr) -> list[list[int]]:
    """Returns the arguments that each result of a jaxpr may depend on, by their numbers."""
    jaxpr = closed.jaxpr
    # sets of arguments as the bits of integers
    known = {x: 1 << i for i, x in enumerate(jaxpr.invars)}

    def sources(xs: Sequence[Any]) -> int:
        bits = 0
        for x in xs:
            if not isinstance(x, Literal):
                bits |= known.get(x, 0)
        return bits

    for equation in jaxpr.eqns:
        bits = sources(equation.invars)
        known.update((x, bits) for x in equation.outvars)
    every = [sources([x]) for x in jaxpr.outvars]
    return [[i for i in range(len(jaxpr.invars)) if bits >> i & 1] for bits in every]


class TangentNative(Native):
    """The tangent map of a native function: (x, ẋ) → tangents of the floating results.

    x are all arguments, and ẋ the tangents of the arguments whose flag `moved` is True.
    """

    def __init__(self, whole: Native, moved: tuple[bool, ...]) -> None:
        super().__init__(self._along, whole.staged)
        self.whole, self.count = whole, len(moved)
        self.places = [i for i, flag in enumerate(moved) if flag]
        self.moved, self.sums = moved, whole.sums

    def without_batch(self) -> Native:
        """Returns the tangent map as it was before `vmap` added any batch axes to it."""
        whole = self.whole.without_batch()
        return self if whole is self.whole else whole.tangent(self.moved)

    def sums_shared(self, shared: Sequence[bool]) -> bool:
        """Returns True if a sum over the worlds contains a cotangent that they share."""
        tangents = dict(zip(self.places, shared[self.count :], strict=True))
        either = [flag or tangents.get(i, False) for i, flag in enumerate(shared[: self.count])]
        return self.whole.sums_shared(either)

    def shapes(self, args: Sequence[Array | ShapedArray], rank: int) -> list[Any]:
        """Returns the shapes and dtypes of the tangents of the results, without a trace of them.

        They are those of the floating results of the function itself, whose trace is cached.
        """
        given: list[Any] = list(args[: self.count])
        for i, x in zip(self.places, args[self.count :], strict=True):
            shape = jnp.broadcast_shapes(x.shape, given[i].shape)
            given[i] = jax.ShapeDtypeStruct(shape, given[i].dtype)
        return list(filter(is_real, self.whole.shapes(given, rank)))

    def _along(self, *args: Array) -> list[Array]:
        """Returns the tangents of the floating results, for arguments (x, ẋ)."""
        primals, tangents = list(args[: self.count]), []
        for i, x in zip(self.places, args[self.count :], strict=True):
            shape = jnp.broadcast_shapes(x.shape, primals[i].shape)
            primals[i] = jnp.broadcast_to(primals[i], shape)
            tangents.append(jnp.broadcast_to(x, shape))

        def along(*xs: Array) -> list[Array]:
            replaced = dict(zip(self.places, xs, strict=True))
            results = self.whole(*(replaced.get(i, x) for i, x in enumerate(primals)))
            return list(filter(is_real, results))

        with during(_ORDER, order() + 1), during(_VALUES, False):
            return jax.jvp(along, [primals[i] for i in self.places], tangents)[1]


class TransposedNative(Native):
    """The transpose of a native function that is linear in some of its arguments.

    It maps (the other arguments, cotangents ȳ of the results) to the cotangents of the linear
    arguments.

    Attributes:
        whole: the native function.
        linear: for each argument, True if the function is linear in it.
        avals: shapes and dtypes of the linear arguments, when the transpose was made. `vmap` may
            add batch axes later.
        rank: the number of axes of the first cotangent in ȳ, without batch axes added later.
        axes: the number of batch axes among these, and of each shape in `avals`.
    """

    def __init__(
        self,
        whole: Native,
        linear: tuple[bool, ...],
        avals: tuple[Aval, ...],
        rank: int,
        axes: int,
    ) -> None:
        super().__init__(self._back, whole.staged)
        self.whole, self.linear, self.avals, self.rank = whole, linear, avals, rank
        self.axes, self.sums = axes, True
        self.fixed = linear.count(False)

    def without_batch(self) -> Native:
        """Returns the transpose as it was before `vmap` added any batch axes to it."""
        avals = tuple((shape[: len(shape) - self.axes], dtype) for shape, dtype in self.avals)
        return self.whole.without_batch().transposed(self.linear, avals, self.rank - self.axes, 0)

    def sums_shared(self, shared: Sequence[bool]) -> bool:
        """Returns True if a sum over the worlds contains a cotangent that they share.

        A result that the worlds share is computed once, so its cotangent counts once. If it is a
        sum over the worlds, its cotangent is that of the term of each world.
        """
        return not self.whole.sums and any(shared[self.fixed :])

    def shapes(self, args: Sequence[Array | ShapedArray], rank: int) -> list[Any]:
        """Returns the shapes and dtypes of the cotangents of the linear arguments."""
        return [ShapedArray(x.shape, x.dtype) for x in self._arguments(args)]

    def _arguments(self, args: Sequence[Array | ShapedArray]) -> list[Any]:
        """Returns shapes and dtypes of the linear arguments, with the batch axes added later."""
        batch = self._batch(args)
        return [jax.ShapeDtypeStruct((*shape, *batch), dtype) for shape, dtype in self.avals]

    def _batch(self, args: Sequence[Array | ShapedArray]) -> tuple[int, ...]:
        """Returns the shape of the batch axes that were added since the transpose was made."""
        added = args[self.fixed].ndim - self.rank
        return jnp.broadcast_shapes(*(x.shape[x.ndim - added :] for x in args))

    def _back(self, *args: Array) -> list[Array]:
        """Returns the cotangents of the linear arguments, for (other arguments, ȳ).

        A cotangent has all batch axes, even for an argument that the worlds share.
        """
        batch, given = self._batch(args), args[: self.fixed]

        def along(*xs: Array) -> list[Array]:
            moving, fixed = iter(xs), iter(given)
            merged = (next(moving) if flag else next(fixed) for flag in self.linear)
            return broadcast_worlds(self.whole(*merged), batch)

        cotangents = broadcast_worlds(list(args[self.fixed :]), batch)
        with during(_TRANSPOSED, True), during(_VALUES, False):
            return list(jax.linear_transpose(along, *self._arguments(args))(cotangents))


class PartialNative(Native):
    """A native function that returns only some results of another one, and reuses its trace.

    Args:
        whole: the other native function.
        wanted: for each of its results, True to return it.
    """

    def __init__(self, whole: Native, wanted: tuple[bool, ...]) -> None:
        super().__init__(self._chosen, whole.staged)
        self.whole, self.wanted, self.sums = whole, wanted, whole.sums

    def without_batch(self) -> Native:
        """Returns the function as it was before `vmap` added any batch axes to it."""
        whole = self.whole.without_batch()
        return self if whole is self.whole else whole.part(self.wanted)

    def sums_shared(self, shared: Sequence[bool]) -> bool:
        """Returns True if a sum over the worlds contains a cotangent that they share."""
        return self.whole.sums_shared(shared)

    def shapes(self, args: Sequence[Array | ShapedArray], rank: int) -> list[Any]:
        """Returns the shapes and dtypes of the wanted results."""
        return self._among_wanted(self.whole.shapes(args, rank))

    def _chosen(self, *args: Array) -> list[Array]:
        """Evaluates the whole function; returns the wanted results."""
        return self._among_wanted(self.whole(*args))

    def _among_wanted(self, results: Sequence[Any]) -> list[Any]:
        """Returns the wanted ones among the results of the whole function."""
        return [y for y, flag in zip(results, self.wanted, strict=True) if flag]

    def _traced(self, *avals: Aval) -> ClosedJaxpr:
        closed = self.whole.traced(*avals)
        return ClosedJaxpr(without_unused(closed.jaxpr, self.wanted), closed.consts)


native_p = Primitive("native")
native_p.multiple_results = True


def bound(args: Iterable[Any], fun: Native, rank: int = 0) -> list[Array]:
    """Calls a native function through the primitive `native_p`; returns its results.

    The parameter `rank` of the primitive is the number of batch axes that `vmap` has added. The
    parameter `asks` of the primitive tells JAX that the function may contain conditions on
    worlds; see `somewhere.asking`.
    """
    return native_p.bind(*args, fun=fun, rank=rank, asks=asking())


class Known(NamedTuple):
    """An array that becomes a constant of the program; equal if shape, dtype and data are equal.

    Attributes:
        shape: the shape of the array.
        dtype: the name of its dtype.
        data: its bytes.
    """

    shape: tuple[int, ...]
    dtype: str
    data: bytes

    def lanes(self, axes: int) -> Array:
        """Returns the array as a constant of the trace.

        Args:
            axes: the number of axes of size 1 to add at the end.
        """
        value = np.frombuffer(self.data, self.dtype).reshape((*self.shape, *(1,) * axes))
        return jax.lax.stop_gradient(jnp.asarray(value))


def _known(x: Scalar) -> Known | None:
    """Returns x as a `Known` if it is concrete and has at most `FEW` numbers, otherwise None."""
    if isinstance(x, Tracer) or np.size(x) > FEW:
        return None
    dtype = jnp.result_type(x)
    if not jnp.issubdtype(dtype, np.number):
        return None
    value = np.asarray(x, dtype)
    return Known(value.shape, dtype.name, value.tobytes())


@contextmanager
def as_it_is_called() -> Iterator[None]:
    """Keeps known values from becoming constants in a loop that is called outside `jit`.

    JAX traces the body of a loop even if the loop itself is not traced. Within this context, known
    values then stay arguments, so that another call with other values does not compile the loop
    again. If the caller of the loop is traced, known values become constants as usual.
    """
    with during(_CONSTANTS, _CONSTANTS.get() and _is_tracing()):
        yield


def _is_tracing() -> bool:
    """Returns True while JAX is tracing."""
    return isinstance(jax.lax.full((), 0.0), Tracer)


def _native(
    function: Callable[..., Any],
    structure: Any,
    shapes: Sequence[tuple[int, ...]],
    known: tuple[Known | None, ...],
    staged: bool,
    guess: Guess | None,
) -> tuple[Native, list[Any]]:
    """Makes a native function of the leaves of some arguments, with known leaves as constants.

    Args:
        function: a function of pytrees.
        structure: the tree structure of its arguments.
        shapes: the shape of each leaf.
        known: the value of each known leaf, and None for other leaves, of which there must be one.
        staged: True if the function may be cut into stages.
        guess: see `call`.

    Returns:
        The native function of the leaves that are not known.
        A list whose only entry becomes the tree structure of the result when the function is
        traced. It is not available before, because the static data of a result may depend on
        shapes, such as the number of rows.
    """
    # a primitive returns arrays only, so `flat` stores the structure of the result in this list.
    # `jax.eval_shape` would find it before, but trace the function twice
    result: list[Any] = [None]

    def flat(*given: Array) -> list[Array]:
        axes = given[0].ndim - len(next(s for s, x in zip(shapes, known, strict=True) if x is None))
        moving = iter(given)
        leaves = [next(moving) if x is None else x.lanes(axes) for x in known]
        whole = jax.tree.unflatten(structure, leaves)
        output = function(*whole)
        arrays, result[0] = jax.tree.flatten(output)
        if guess is not None:
            start, solution = _place(guess[0](whole), given), _place(guess[1](output), arrays)
            native.guess = None if start is None or solution is None else (start, solution)
        return [jnp.asarray(x) for x in arrays]

    native = Native(flat, staged)
    return native, result


def _place(x: Array | None, arrays: Sequence[Array]) -> int | None:
    """Returns the index of an array in a list; None if it is not there once, or None itself."""
    places = [i for i, y in enumerate(arrays) if x is not None and y is x]
    return places[0] if len(places) == 1 else None


_shared = functools.lru_cache(maxsize=256)(_native)
_with_constants = functools.lru_cache(maxsize=64)(_native)
"""`_native` with a cache of its own, in which each set of values of constants takes an entry."""


def call(
    function: Callable[..., T], *args: PyTree, staged: bool = True, guess: Guess | None = None
) -> T:
    """Calls function(*args); `vmap` calls it once, with the whole batch along the last axis.

    During tracing, small arrays with known values become constants of the function. The compiler
    then removes trivial operations, such as a product with 1.

    Args:
        function: a pure function from pytrees of arrays to a pytree of arrays. It should be defined
            once, since it is cached by identity. If all leaves of its arguments have trailing
            batch axes (of the batch's size or of size 1), all its results must have them.
        args: pytrees of arrays.
        staged: True if the function may be cut into stages; False for users' functions, which may
            contain any operations.
        guess: a pair of functions (arguments → start, result → solution), which may return None.
            The function iterates from `start` until it reaches `solution`, and its result does not
            depend on the start. A derivative, which evaluates the function once more, starts from
            the solution.

    Returns:
        The result of the function.
    """
    leaves, structure = jax.tree.flatten(args)
    known = [None] * len(leaves)
    if _CONSTANTS.get() and any(isinstance(x, Tracer) for x in leaves) and _is_tracing():
        known = [_known(x) for x in leaves]
    shapes = tuple(np.shape(x) for x in leaves)
    cached = _with_constants if any(x is not None for x in known) else _shared
    native, result = cached(function, structure, shapes, tuple(known), staged, guess)
    arrays = [jnp.asarray(x) for x, value in zip(leaves, known, strict=True) if value is None]
    arrays = meshes.together(arrays)
    arrays = bound(arrays, native)  # the trace of `native` sets result[0]
    return jax.tree.unflatten(result[0], arrays)


def is_real(x: Array | ShapedArray | jax.ShapeDtypeStruct) -> bool:
    """Returns True for floating-point arrays, which have derivatives."""
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _abstract(*args: ShapedArray, fun: Native, rank: int, asks: ClosedJaxpr) -> list[Any]:
    """The abstract evaluation rule: returns the shapes, dtypes and placement of the results."""
    return meshes.typed(fun.shapes(args, rank), args)


def _batched(
    args: Sequence[Array], axes: Sequence[int | None], *, fun: Native, rank: int, asks: ClosedJaxpr
) -> tuple[list[Array], list[int]]:
    """The batching rule: moves the batch to the last axis of the arguments, and calls once."""
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)

    def last(x: Array | float, axis: int | None) -> Array:
        x = jnp.asarray(x)  # a constant of the trace may be a Python number
        return x[..., None] if axis is None else jnp.moveaxis(x, axis, -1)

    results = bound(map(last, args, axes), fun, rank + 1)
    results = [jnp.broadcast_to(y, (*y.shape[:-1], size)) for y in results]
    return results, [y.ndim - 1 for y in results]


def _jvp(
    primals: Sequence[Array],
    tangents: Sequence[Array | ad.Zero],
    *,
    fun: Native,
    rank: int,
    asks: ClosedJaxpr,
) -> tuple[list[Array], list[Array | ad.Zero]]:
    """The JVP rule: calls the function, and its tangent map as another native function.

    The tangent map evaluates the function once more. Its iteration starts from the solution.
    """
    results = bound(primals, fun, rank)
    if fun.guess is not None:
        argument, solution = fun.guess
        primals = list(primals)
        dtype = primals[argument].dtype
        primals[argument] = jax.lax.stop_gradient(results[solution]).astype(dtype)
    moved = tuple(type(x) is not ad.Zero for x in tangents)
    given = (x for x, flag in zip(tangents, moved, strict=True) if flag)
    moving = iter(bound((*primals, *given), fun.tangent(moved), rank))
    return results, [
        next(moving) if is_real(y) else ad.Zero(ShapedArray(y.shape, jax.dtypes.float0))
        for y in results
    ]


def _transpose(
    cotangents: Sequence[Array | ad.Zero],
    *args: Array | ad.UndefinedPrimal,
    fun: Native,
    rank: int,
    asks: ClosedJaxpr,
) -> list[Array | None]:
    """The transpose rule: calls the transpose of the function as another native function."""
    linear = tuple(ad.is_undefined_primal(x) for x in args)
    fixed = [x for x, flag in zip(args, linear, strict=True) if not flag]
    pairs = zip(args, linear, strict=True)
    avals = tuple((x.aval.shape, x.aval.dtype) for x, flag in pairs if flag)
    cotangents = [ad.instantiate_zeros(x) for x in cotangents]
    transposed = fun.transposed(linear, avals, cotangents[0].ndim, rank)
    results = iter(bound((*fixed, *cotangents), transposed, rank))
    return [next(results) if flag else None for flag in linear]


def _in_stages(*args: Array, fun: Native, rank: int) -> list[Array]:
    """Calls a native function in stages, on arrays with a further last axis of size 1.

    XLA lets LLVM unroll loops over the last axis of an array. Without the further axis, unrolling
    takes up to half of the compile time, and makes the vectorized code no faster.
    """
    lanes = [jnp.expand_dims(x, -1) for x in args]
    if not (fun.staged and fusion.staged()):
        return squeezed(*fun(*lanes))
    # `squeezed` is a stage: if it were inlined, XLA would copy results to move their axes
    return fusion.run_staged(fun, lanes, squeezed)


def _directly(*args: Array, fun: Native, rank: int) -> list[Array]:
    """Calls a native function for its values."""
    with during(_VALUES, True):
        return fun(*args)


def _in_order(*args: Array, fun: Native, rank: int) -> list[Array]:
    """Calls a native function whose arguments and results lie in memory with the batch last."""
    if _IN_ORDER.get():  # within another native function
        return _directly(*args, fun=fun, rank=rank)
    with during(_IN_ORDER, True):
        return list(map(_contiguous, _directly(*map(_contiguous, args), fun=fun, rank=rank)))


def _in_kernel(
    platform: kernels.Platform, otherwise: Callable[..., list[Array]]
) -> Callable[..., list[Array]]:
    """Makes a function that calls a native function as one kernel.

    Args:
        platform: the devices that run it.
        otherwise: calls it if no kernel can be written.
    """

    def call(*args: Array, fun: Native, rank: int, spreads: bool = False) -> list[Array]:
        try:
            return kernels.run(platform, fun, args, rank, spreads)
        except UnsupportedError:
            return otherwise(*args, fun=fun, rank=rank)

    return call


def _contiguous(x: Array) -> Array:
    """Returns an array whose last axis is contiguous in memory."""
    if x.ndim < 2 or x.shape[-1] == 1:
        return x
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim))))


def squeezed(*lanes: Array) -> list[Array]:
    """Removes the last axis, of size 1, from arrays."""
    return [jnp.squeeze(x, -1) for x in lanes]


def _lowered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a lowering rule for the primitive `native_p`.

    Args:
        function: (*args, fun=native function, rank=number of batch axes, …) → results. Types of
            args are without placement.
    """

    def fitted(*args: Array, results: Sequence[Any], **params: Any) -> list[Array]:
        ys = function(*args, **params)
        return [_fitted(y, like.shape) for y, like in zip(ys, results, strict=True)]

    rule = mlir.lower_fun(fitted, multiple_results=True)

    def lower(ctx: mlir.LoweringRuleContext, *args: Any, asks: ClosedJaxpr, **params: Any) -> Any:
        with meshes.apart(), without_collections():
            avals: Sequence[Any] = ctx.avals_in
            plain = [meshes.plain(x) for x in avals]
            results = ctx.avals_out
            return rule(ctx.replace(avals_in=plain), *args, results=results, **params)

    return lower


def _fitted(x: Array, shape: tuple[int, ...]) -> Array:
    """Returns a result with batch axes of these sizes; values along other axes are equal."""
    for axis, (n, m) in enumerate(zip(x.shape, shape, strict=True)):
        if n != m and m == 1:
            x = jax.lax.slice_in_dim(x, 0, 1, axis=axis)
    return jnp.broadcast_to(x, shape)


_CUDA_KERNEL, _SEVERAL_KERNELS = _lowered(_in_kernel(cuda.Cuda(), _in_order)), _lowered(_in_order)
_CPU_KERNEL, _STAGES = _lowered(_in_kernel(cpu.Cpu(), _in_stages)), _lowered(_in_stages)
_EXPORTED = _lowered(_directly)


def _lowered_for_cuda(ctx: mlir.LoweringRuleContext, *args: Any, **params: Any) -> Any:
    """The lowering rule for NVIDIA's GPUs."""
    one = kernels.are_possible(ctx) and kernels.is_alone(ctx) and not _IN_ORDER.get()
    return (_CUDA_KERNEL if one else _lowered_for_gpu)(ctx, *args, **params)


def _lowered_for_cpu(ctx: mlir.LoweringRuleContext, *args: Any, **params: Any) -> Any:
    """The lowering rule for CPUs."""
    alone = kernels.is_alone(ctx)
    if kernels.are_possible(ctx) and (alone or kernels.can_spread(ctx)):
        return _CPU_KERNEL(ctx, *args, spreads=not alone, **params)
    return _STAGES(ctx, *args, **params)


def _lowered_for_gpu(ctx: mlir.LoweringRuleContext, *args: Any, **params: Any) -> Any:
    """The lowering rule for other GPUs. JAX exports no program that constrains layouts."""
    exported = ctx.module_context.lowering_parameters.for_export
    return (_EXPORTED if exported else _SEVERAL_KERNELS)(ctx, *args, **params)


def _stopped(cotangent: Array | ad.Zero, _: Array | ad.UndefinedPrimal) -> list[None]:
    """The transpose rule of `stop_gradient` within native functions: cotangents become zero.

    A batched `lax.cond` evaluates each branch in all worlds, and applies `stop_gradient` to the
    operands of worlds that take another branch, tangents included. JAX has no transpose rule for
    `stop_gradient` (jax-ml/jax#39219). The cotangents of those worlds are zero, and must not be
    multiplied by infinite derivatives of the branch. If a user's own derivative rule stops a
    tangent, this tangent counts as zero in reverse mode only.

    Raises:
        NotImplementedError: the call is outside native functions, where JAX itself has no rule.
    """
    if not _TRANSPOSED.get():
        raise NotImplementedError(
            "Transpose rule (for reverse-mode differentiation) for 'stop_gradient' not implemented"
        )
    return [None]


def _without_unused(
    wanted: list[bool], *context: bool | JaxprEqn
) -> tuple[list[bool], JaxprEqn | None]:
    """The rule for dead code elimination: removes unused results and the work for them.

    Args:
        wanted: for each result, True if it is used.
        context: the equation, as the last argument. From JAX 0.12 on, an argument about references
            that are read later comes before it; native functions have no references.

    Returns:
        For each input, True if it is still used; and the new equation, or None if it is not needed.
    """
    equation: Any = context[-1]
    if not any(wanted):
        return [False] * len(equation.invars), None
    results = [x for x, flag in zip(equation.outvars, wanted, strict=True) if flag]
    params = equation.params | {"fun": equation.params["fun"].part(tuple(wanted))}
    pruned = equation if all(wanted) else equation.replace(outvars=results, params=params)
    return [True] * len(equation.invars), pruned


native_p.def_impl(lambda *args, fun, rank, asks: fun.eager(*args, rank=rank))
native_p.def_abstract_eval(_abstract)
mlir.register_lowering(native_p, _lowered(_directly))
mlir.register_lowering(native_p, _lowered_for_cpu, platform="cpu")
mlir.register_lowering(native_p, _lowered_for_cuda, platform="cuda")
mlir.register_lowering(native_p, _lowered_for_gpu, platform="rocm")
batching.primitive_batchers[native_p] = _batched
ad.primitive_jvps[native_p] = _jvp
partial_eval.dce_rules[native_p] = _without_unused
ad.primitive_transposes[native_p] = _transpose
# JAX looks up transpose rules in this table only, and a batched `lax.cond` inserts `stop_gradient`
# where the library cannot replace it. If JAX gets a rule of its own, that rule takes precedence
ad.primitive_transposes.setdefault(stop_gradient_p, _stopped)
