"""Functions that are batched natively: `vmap` moves the batch to the last axis and calls them once.

A function written by lanes needs no batching rule of its own: it takes arrays with any number of
trailing batch axes. Plain `jax.vmap` does not know that; it puts the batch first and rewrites every
instruction. `call` wraps such a function in a primitive whose batching rule hands it the whole
batch, last axis contiguous. The derivative of a native function is a native function too: the rules
below bind the same primitive again, for the tangent map and for its transpose, so that `grad`,
`jvp`, `vmap(grad)`, `grad(vmap)`, `hessian` and `scan` compose with it and stay native.

An argument that is not mapped gets a trailing axis of size 1, and the function broadcasts it: a
parameter shared by all worlds is read once. The transpose of that broadcast is a sum over worlds,
which is right when `grad` is outside `vmap` and wrong when it is inside. So a transposed map, when
it is batched, returns one cotangent a world, whatever its arguments share.

The reverse pass keeps the arguments of each call and nothing from inside it: a call is a
checkpoint, and its derivative evaluates the function once more.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive
from jax.extend.core.primitives import stop_gradient_p
from jax.interpreters import ad, batching, mlir, partial_eval

from jaxcon.core import fusion, meshes, notices
from jaxcon.core.jaxprs import without_unused
from jaxcon.core.somewhere import asking
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import spread

FEW = 64
"""Numbers up to which an array whose value is known becomes a part of the program."""

_ORDER = ContextVar("order", default=0)
_TRANSPOSED = ContextVar("transposed", default=False)
_CONSTANTS = ContextVar("constants", default=True)


def order() -> int:
    """Returns the order of the derivative being traced: 0 for the native function itself."""
    return _ORDER.get()


@contextmanager
def during(variable: ContextVar[Any], value: Any) -> Iterator[None]:
    """A variable has this value meanwhile."""
    before = variable.set(value)
    try:
        yield
    finally:
        variable.reset(before)


class Native:
    """A function of arrays with trailing batch axes, compared by identity.

    Attributes:
        function: (arrays) → list of arrays.
        staged: whether it is cut into stages where those are used, and its derivatives with it.
    """

    def __init__(self, function: Callable[..., Any], staged: bool = True) -> None:
        self.function, self.staged = function, staged
        self.compiled = jax.jit(lambda *args: bound(args, self))
        self.tangent = functools.lru_cache(maxsize=64)(functools.partial(Tangent, self))
        self.transposed = functools.lru_cache(maxsize=64)(functools.partial(Transposed, self))
        self.part = functools.lru_cache(maxsize=64)(functools.partial(Part, self))
        self.among = functools.lru_cache(maxsize=64)(self._among)

    def __call__(self, *args: Array) -> list[Array]:
        """The function itself."""
        return list(self.function(*args))

    def eager(self, *args: Array) -> list[Array]:
        """The function outside jit: compiled, unless that is switched off."""
        return self(*args) if jax.config.values["jax_disable_jit"] else self.compiled(*args)

    def shapes(self, args: Sequence[Array]) -> list[Any]:
        """Shape and dtype of the results; traced as `_in_stages` does it."""
        found = self.traced(*(((*x.shape, 1), x.dtype) for x in args)).out_avals
        return [ShapedArray(y.shape[:-1], y.dtype) for y in found]

    def traced(self, *avals: Any) -> Any:
        """The closed jaxpr for arguments of these shapes and dtypes, where JAX now stands.

        Operations keep the mesh and the default precision under which they were traced.
        """
        mesh, real = jax.sharding.get_abstract_mesh(), jnp.result_type(float)
        return self.among((mesh, real, notices.is_observing()), *avals)

    def _among(self, settings: Any, *avals: Any) -> Any:
        return self._traced(*avals)

    def _traced(self, *avals: Any) -> Any:
        """The closed jaxpr for arguments of these shapes and dtypes.

        Raises:
            TypeError: a user's function holds a traced value that is not among the arguments; its
                derivative would silently be zero.
        """
        with meshes.apart():
            closed = jax.make_jaxpr(self)(*(jax.ShapeDtypeStruct(*aval) for aval in avals))
        if any(isinstance(x, Tracer) for x in closed.consts):
            raise TypeError(
                "a function of the scene (a force, constraint, motion, mass or potential) closes"
                " over a traced value, which would be invisible to vmap and grad: pass it through"
                " params= instead."
            )
        return closed


class Tangent(Native):
    """(x, ẋ of the moved arguments) → the tangents of the floating results."""

    def __init__(self, whole: Native, moved: tuple[bool, ...]) -> None:
        super().__init__(self._along, whole.staged)
        self.whole, self.count = whole, len(moved)
        self.places = [i for i, flag in enumerate(moved) if flag]

    def shapes(self, args: Sequence[Array]) -> list[Any]:
        """Returns the shapes of the floating results, as the whole has been traced already."""
        given: list[Any] = list(args[: self.count])
        for i, x in zip(self.places, args[self.count :], strict=True):
            shape = jnp.broadcast_shapes(x.shape, given[i].shape)
            given[i] = jax.ShapeDtypeStruct(shape, given[i].dtype)
        return list(filter(is_real, self.whole.shapes(given)))

    def _along(self, *args: Array) -> list[Array]:
        primals, tangents = list(args[: self.count]), []
        for i, x in zip(self.places, args[self.count :], strict=True):
            shape = jnp.broadcast_shapes(x.shape, primals[i].shape)
            primals[i] = jnp.broadcast_to(primals[i], shape)
            tangents.append(jnp.broadcast_to(x, shape))

        def along(*xs: Array) -> list[Array]:
            replaced = dict(zip(self.places, xs, strict=True))
            results = self.whole(*(replaced.get(i, x) for i, x in enumerate(primals)))
            return list(filter(is_real, results))

        with during(_ORDER, order() + 1):
            return jax.jvp(along, [primals[i] for i in self.places], tangents)[1]


class Transposed(Native):
    """(the other arguments first, then ȳ) → cotangents of those in which a function is linear.

    Attributes:
        whole: the function.
        linear: in which arguments.
        avals: their shapes and dtypes without the batch axes that are added later.
        rank: of the first ȳ without these.
    """

    def __init__(self, whole: Native, linear: tuple[bool, ...], avals: Any, rank: int) -> None:
        super().__init__(self._back, whole.staged)
        self.whole, self.linear, self.avals, self.rank = whole, linear, avals, rank
        self.fixed = linear.count(False)

    def shapes(self, args: Sequence[Array]) -> list[Any]:
        """Returns the shapes of the arguments in which it is linear."""
        return [ShapedArray(x.shape, x.dtype) for x in self._arguments(args)]

    def _arguments(self, args: Sequence[Array]) -> list[Any]:
        """Shapes and dtypes of the arguments in which it is linear."""
        batch = self._batch(args)
        return [jax.ShapeDtypeStruct((*shape, *batch), dtype) for shape, dtype in self.avals]

    def _batch(self, args: Sequence[Array]) -> tuple[int, ...]:
        added = args[self.fixed].ndim - self.rank
        return jnp.broadcast_shapes(*(x.shape[x.ndim - added :] for x in args))

    def _back(self, *args: Array) -> list[Array]:
        batch, given = self._batch(args), args[: self.fixed]

        def along(*xs: Array) -> list[Array]:
            moving, fixed = iter(xs), iter(given)
            merged = (next(moving) if flag else next(fixed) for flag in self.linear)
            return spread(self.whole(*merged), batch)

        cotangents = spread(list(args[self.fixed :]), batch)
        with during(_TRANSPOSED, True):
            return list(jax.linear_transpose(along, *self._arguments(args))(cotangents))


class Part(Native):
    """Some of the results of a native function; its trace is a part of the whole's."""

    def __init__(self, whole: Native, wanted: tuple[bool, ...]) -> None:
        super().__init__(self._chosen, whole.staged)
        self.whole, self.wanted = whole, wanted

    def shapes(self, args: Sequence[Array]) -> list[Any]:
        """Returns the shapes of the wanted results."""
        return self._among_wanted(self.whole.shapes(args))

    def _chosen(self, *args: Array) -> list[Array]:
        return self._among_wanted(self.whole(*args))

    def _among_wanted(self, results: Sequence[Any]) -> list[Any]:
        return [y for y, flag in zip(results, self.wanted, strict=True) if flag]

    def _traced(self, *avals: Any) -> Any:
        closed = self.whole.traced(*avals)
        return ClosedJaxpr(without_unused(closed.jaxpr, self.wanted), closed.consts)


native_p = Primitive("native")
native_p.multiple_results = True


def bound(args: Iterable[Any], fun: Native) -> list[Array]:
    """The results of a native function, of which loops may ask worlds; see `somewhere.asking`."""
    return native_p.bind(*args, fun=fun, asks=asking())


class Known(NamedTuple):
    """An array whose value is a part of the program, compared by value.

    Attributes:
        shape: of the array.
        dtype: its name.
        data: its bytes.
    """

    shape: tuple[int, ...]
    dtype: str
    data: bytes

    def lanes(self, axes: int) -> Array:
        """The array with so many trailing axes of one, as a value of the trace."""
        value = np.frombuffer(self.data, self.dtype).reshape((*self.shape, *(1,) * axes))
        return jax.lax.stop_gradient(jnp.asarray(value))


def _known(x: Any) -> Known | None:
    """The value of an array of at most `FEW` numbers; None of others."""
    if isinstance(x, Tracer) or np.size(x) > FEW:
        return None
    dtype = jnp.result_type(x)
    if not jnp.issubdtype(dtype, np.number):
        return None
    value = np.asarray(x, dtype)
    return Known(value.shape, dtype.name, value.tobytes())


@contextmanager
def as_it_is_called() -> Iterator[None]:
    """Values are no constants of the loops within, unless the caller is being traced itself.

    The body of a loop is traced, too, where the loop runs at once; other numbers must not cost a
    compilation there.
    """
    with during(_CONSTANTS, _CONSTANTS.get() and _is_tracing()):
        yield


def _is_tracing() -> bool:
    """Returns True where a program is being written, and not run at once."""
    return isinstance(jax.lax.full((), 0.0), Tracer)


def _native(
    function: Callable[..., Any],
    structure: Any,
    shapes: Any,
    known: tuple[Known | None, ...],
    staged: bool,
) -> tuple[Native, list[Any]]:
    """The function of the leaves that are not `known`, of which there is at least one.

    With it comes a place where the structure of the result is left in tracing: what a result holds
    beside arrays may depend on shapes, such as the number of rows.
    """
    result: list[Any] = [None]

    def flat(*given: Array) -> list[Array]:
        axes = given[0].ndim - len(next(s for s, x in zip(shapes, known, strict=True) if x is None))
        moving = iter(given)
        leaves = [next(moving) if x is None else x.lanes(axes) for x in known]
        output = function(*jax.tree.unflatten(structure, leaves))
        arrays, result[0] = jax.tree.flatten(output)
        return [jnp.asarray(x) for x in arrays]

    return Native(flat, staged), result


_shared = functools.lru_cache(maxsize=256)(_native)
_with_constants = functools.lru_cache(maxsize=64)(_native)
"""Apart, as every other value makes another function."""


def call(function: Callable[..., Any], *args: PyTree, staged: bool = True) -> PyTree:
    """function(*args), batched natively under `vmap`.

    In a program that is being traced, small arrays whose values are known are constants of the
    function: the compiler then leaves out what does nothing, such as a product with 1.

    Args:
        function: pure, defined once; takes pytrees of arrays and returns one. Given trailing batch
            axes on all leaves (of the batch's size or of size 1) it must return them on all
            results.
        args: pytrees of arrays.
        staged: whether it may be cut into stages; what users write may be of any operations.

    Returns:
        What the function returns.
    """
    leaves, structure = jax.tree.flatten(args)
    known = [None] * len(leaves)
    if _CONSTANTS.get() and any(isinstance(x, Tracer) for x in leaves) and _is_tracing():
        known = [_known(x) for x in leaves]
    shapes = tuple(np.shape(x) for x in leaves)
    cached = _with_constants if any(x is not None for x in known) else _shared
    native, result = cached(function, structure, shapes, tuple(known), staged)
    arrays = [jnp.asarray(x) for x, value in zip(leaves, known, strict=True) if value is None]
    arrays = meshes.together(arrays)
    arrays = bound(arrays, native)  # its trace leaves the structure
    return jax.tree.unflatten(result[0], arrays)


def is_real(x: Any) -> bool:
    """Returns True where it is of floating numbers, which have derivatives."""
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _abstract(*args: Any, fun: Native, asks: Any) -> list[Any]:
    return meshes.typed(fun.shapes(args), args)


def _batched(args: Any, axes: Any, *, fun: Native, asks: Any) -> Any:
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)

    def last(x: Any, axis: int | None) -> Array:
        x = jnp.asarray(x)  # a constant of the trace may come as a Python number
        return x[..., None] if axis is None else jnp.moveaxis(x, axis, -1)

    results = bound(map(last, args, axes), fun)
    results = [jnp.broadcast_to(y, (*y.shape[:-1], size)) for y in results]
    return results, [y.ndim - 1 for y in results]


def _jvp(primals: Any, tangents: Any, *, fun: Native, asks: Any) -> Any:
    results = bound(primals, fun)
    moved = tuple(type(x) is not ad.Zero for x in tangents)
    given = (x for x, flag in zip(tangents, moved, strict=True) if flag)
    moving = iter(bound((*primals, *given), fun.tangent(moved)))
    return results, [
        next(moving) if is_real(y) else ad.Zero(ShapedArray(y.shape, jax.dtypes.float0))
        for y in results
    ]


def _transpose(cotangents: Any, *args: Any, fun: Native, asks: Any) -> Any:
    linear = tuple(ad.is_undefined_primal(x) for x in args)
    fixed = [x for x, flag in zip(args, linear, strict=True) if not flag]
    pairs = zip(args, linear, strict=True)
    avals = tuple((x.aval.shape, x.aval.dtype) for x, flag in pairs if flag)
    cotangents = [ad.instantiate_zeros(x) for x in cotangents]
    transposed = fun.transposed(linear, avals, cotangents[0].ndim)
    found = iter(bound((*fixed, *cotangents), transposed))
    return [next(found) if flag else None for flag in linear]


def _in_stages(*args: Array, fun: Native) -> list[Array]:
    """The function, cut into stages, of arrays with a last axis of one.

    XLA lets LLVM unroll the loops over the last axis of an array, which takes up to half of the
    time of compiling them and makes the vectorized code no faster.
    """
    lanes = [jnp.expand_dims(x, -1) for x in args]
    if not (fun.staged and fusion.staged()):
        return squeezed(*fun(*lanes))
    # were it inlined, XLA would copy the results to move the batch to the front
    return fusion.settled(fun, lanes, squeezed)


def squeezed(*lanes: Array) -> list[Array]:
    """Arrays without their last axis, which is of one."""
    return [jnp.squeeze(x, -1) for x in lanes]


def _lowered(function: Callable[..., Any]) -> Callable[..., Any]:
    """The lowering rule of a function (*args, fun=) that sees shapes and dtypes alone."""
    rule = mlir.lower_fun(function, multiple_results=True)

    def lower(ctx: Any, *args: Any, fun: Native, asks: Any) -> Any:
        with meshes.apart():
            plain = [meshes.plain(x) for x in ctx.avals_in]
            return rule(ctx.replace(avals_in=plain), *args, fun=fun)

    return lower


def _stopped(cotangent: Any, _: Any) -> list[Any]:
    """The transpose of `stop_gradient` within that of a native function: zero.

    A batched `lax.cond` puts it around what a branch of worlds that take another one is given, of
    tangents as well, and JAX has no transpose of it (jax-ml/jax#39219). Those worlds have a
    cotangent of zero there, which must not meet what is infinite in that branch. Where users stop
    a tangent in a derivative of their own, reverse mode so has zero, and forward mode the tangent.

    Raises:
        NotImplementedError: outside native functions, as without this rule.
    """
    if not _TRANSPOSED.get():
        raise NotImplementedError(
            "Transpose rule (for reverse-mode differentiation) for 'stop_gradient' not implemented"
        )
    return [None]


def _without_unused(wanted: list[bool], *context: Any) -> tuple[list[bool], Any]:
    """Leaves out the results that nobody needs, and what is done for them alone.

    The last argument is the equation. From JAX 0.12 on there is one before it, whether references
    are read later; native functions have none.
    """
    equation = context[-1]
    if not any(wanted):
        return [False] * len(equation.invars), None
    results = [x for x, flag in zip(equation.outvars, wanted, strict=True) if flag]
    params = equation.params | {"fun": equation.params["fun"].part(tuple(wanted))}
    kept = equation if all(wanted) else equation.replace(outvars=results, params=params)
    return [True] * len(equation.invars), kept


native_p.def_impl(lambda *args, fun, asks: fun.eager(*args))
native_p.def_abstract_eval(_abstract)
mlir.register_lowering(native_p, _lowered(lambda *args, fun: fun(*args)))
mlir.register_lowering(native_p, _lowered(_in_stages), platform="cpu")
batching.primitive_batchers[native_p] = _batched
ad.primitive_jvps[native_p] = _jvp
partial_eval.dce_rules[native_p] = _without_unused
ad.primitive_transposes[native_p] = _transpose
ad.primitive_transposes.setdefault(stop_gradient_p, _stopped)
