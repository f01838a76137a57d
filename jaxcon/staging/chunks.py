"""Large batches in chunks that fit the cache of a CPU.

A step of a thousand worlds reads and writes more numbers than the cache of a core holds, and then
waits for memory. `by_world` wraps a function of one world, such as a rollout, in a primitive. If
`vmap` maps it over many worlds, a CPU evaluates it for some of them at a time, from the first step
to the last. On an NVIDIA GPU the function is one kernel, in which each world has a thread. Other
devices evaluate all worlds at once, step by step.

The primitive keeps the function of one world, and notes which arguments differ between worlds. In
reverse mode, the derivative is split into two functions of one world: one returns the results and
the residuals, which are the values that the linear map needs, and the other is this linear map.
Both are evaluated in chunks. So is the transpose of the linear map; gradients with respect to
values that the worlds share are then sums over the worlds of a chunk, and over chunks.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir, partial_eval

from jaxcon.core.jaxprs import without_unused
from jaxcon.core.typing import Array, PyTree, T
from jaxcon.staging import batch_last, cuda, kernels, meshes
from jaxcon.staging.operations import inside
from jaxcon.staging.program import is_known
from jaxcon.staging.thread import UnsupportedError

Flags = tuple[bool, ...]
"""A truth value for each array of a list."""
Axes = tuple[int | None, ...]
"""The axis of worlds of each array of a list; None if worlds share the array."""


class Batch(NamedTuple):
    """The worlds that evaluate a function.

    Attributes:
        size: the number of worlds; None for one world, whose arrays have no axis of worlds.
        axes: the axis of worlds of each argument.
        out_axes: the axis of worlds of each result.
    """

    size: int | None
    axes: Axes
    out_axes: Axes


class OneWorld:
    """A function of one world: arrays → list of arrays. Compared by identity.

    Attributes:
        closed: the jaxpr of the function, without constants.
        chunk_size: the number of worlds in a chunk.
    """

    def __init__(self, closed: ClosedJaxpr, chunk_size: int) -> None:
        # a rollout that records no infos must not compute them
        self.closed = ClosedJaxpr(without_unused(closed.jaxpr), closed.consts)
        self.chunk_size = chunk_size
        self.results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in closed.out_avals]
        self.arguments = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in closed.in_avals]
        self.tangent = functools.lru_cache(maxsize=16)(self._tangent)
        self.split = functools.lru_cache(maxsize=16)(self._split)
        self.transposed = functools.lru_cache(maxsize=16)(self._transposed)
        self.part = functools.lru_cache(maxsize=16)(self._part)
        self.differ = functools.lru_cache(maxsize=16)(self._differ)
        self.nested = functools.lru_cache(maxsize=16)(self._nested)
        # for calls outside of `jit`; programs live as long as the function
        self.compiled = jax.jit(
            lambda *args, batch: self.bound(batch, *args), static_argnames="batch"
        )
        self.pullback = jax.jit(
            lambda *args, masks: Pullback(self, *masks).bound(*args), static_argnames="masks"
        )

    def __call__(self, *args: Array) -> list[Array]:
        """Evaluates the function in one world."""
        return list(jaxpr_as_fun(self.closed)(*args))

    def bound(self, batch: Batch, *args: Array) -> list[Array]:
        """Evaluates the function through the primitive `worlds_p`."""
        return worlds_p.bind(*args, fun=self, batch=batch, jaxpr=self.closed)

    def over(self, size: int | None, axes: Axes) -> Batch:
        """Returns the batch of `size` worlds with these axes of the arguments.

        The axis of worlds of a result is the first one.
        """
        differ = self.differ(tuple(axis is not None for axis in axes))
        return Batch(size, axes, tuple(0 if flag else None for flag in differ))

    def vmapped(self, batch: Batch) -> Callable[..., list[Array]]:
        """Returns the function of all worlds at once, outside of the primitive."""
        if batch.size is None:
            return self
        out_axes = list(batch.out_axes)
        return jax.vmap(self, in_axes=batch.axes, out_axes=out_axes, axis_size=batch.size)

    def _differ(self, mapped: Flags) -> Flags:
        """Returns a flag for each result: True if it depends on an argument that is mapped."""
        every = batch_last.sources_of(self.closed)
        return tuple(any(mapped[i] for i in sources) for sources in every)

    def _moving(self, moved: Flags, args: Sequence[Array]) -> Callable[..., Any]:
        """Returns the function of the arguments whose flag in `moved` is True.

        It returns the floating results, which may have tangents, and all results.
        """
        fixed = chosen(args, moved, False)

        def function(*moving: Array) -> tuple[list[Array], list[Array]]:
            results = self(*merged(moved, moving, fixed))
            return list(filter(batch_last.is_real, results)), results

        return function

    def _tangent(self, moved: Flags) -> OneWorld:
        """Returns the tangent map: (arguments, tangents) → tangents of the floating results."""

        def along(*args: Array) -> list[Array]:
            primals, tangents = args[: len(moved)], args[len(moved) :]
            function = self._moving(moved, primals)
            return jax.jvp(function, chosen(primals, moved), tangents, has_aux=True)[1]

        arguments = [*self.arguments, *chosen(self.arguments, moved)]
        return OneWorld(jax.make_jaxpr(along)(*arguments), self.chunk_size)

    def _split(self, moved: Flags) -> Split:
        """Splits the derivative by the arguments whose flag in `moved` is True."""
        count = len(self.results)
        linear: list[ClosedJaxpr] = []

        def forward(*args: Array) -> list[Array]:
            function = self._moving(moved, args)
            _, pushforward, results = jax.linearize(function, *chosen(args, moved), has_aux=True)
            linear.append(jax.make_jaxpr(pushforward)(*chosen(self.arguments, moved)))
            return [*results, *linear[-1].consts]

        jaxpr = jax.make_jaxpr(forward)(*self.arguments)
        residuals = jaxpr.jaxpr.outvars[count:]
        # residuals that are arguments need not be returned; shared ones would be copied
        pool = [*jaxpr.jaxpr.invars, *jaxpr.jaxpr.outvars[:count]]
        for x in residuals:
            if isinstance(x, Literal) or x not in pool:
                pool.append(x)
        places = tuple(pool.index(x) for x in residuals)
        outvars = pool[len(self.arguments) :]
        open_jaxpr = jaxpr.jaxpr.replace(outvars=outvars)
        return Split(
            OneWorld(ClosedJaxpr(open_jaxpr, jaxpr.consts), self.chunk_size),
            places,
            OneWorld(without_constants(linear[-1]), self.chunk_size),
        )

    def _transposed(self, linear: Flags, given: Flags) -> OneWorld:
        """Returns the transpose in one world: (other arguments, ȳ) → cotangents.

        Args:
            linear: for each argument, True if the function is linear in it.
            given: for each result, True if its cotangent is given; the others are zero.
        """
        structs = [*chosen(self.arguments, linear, False), *chosen(self.results, given)]
        back = functools.partial(apply_pullback, self, self.arguments, linear, given)
        return OneWorld(jax.make_jaxpr(back)(*structs), self.chunk_size)

    def _nested(self, batch: Batch) -> OneWorld:
        """Returns the function of a batch as a function of one world."""
        types = batched_types(self.arguments, batch.size, batch.axes)
        chunk_size = max(1, self.chunk_size // (batch.size or 1))
        return OneWorld(jax.make_jaxpr(self.vmapped(batch))(*types), chunk_size)

    def _part(self, wanted: Flags) -> OneWorld:
        """Returns the function with the wanted results only."""
        if all(wanted):  # itself, with what its caches hold
            return self
        jaxpr = without_unused(self.closed.jaxpr, wanted)
        return OneWorld(ClosedJaxpr(jaxpr, self.closed.consts), self.chunk_size)


@dataclass(frozen=True)
class Split:
    """A derivative, split into two functions of one world.

    Attributes:
        forward: arguments → the results, and residuals.
        places: the place of each residual among the arguments and results of `forward`.
        linear: (residuals, tangents) → tangents of the floating results.
    """

    forward: OneWorld
    places: tuple[int, ...]
    linear: OneWorld


def apply_pullback(
    function: Callable[..., Sequence[Array]],
    arguments: Sequence[Any],
    linear: Flags,
    given: Flags,
    *args: Array,
) -> list[Array]:
    """Returns the cotangents of the linear arguments of a function.

    Args:
        function: the function, of one world or of several.
        arguments: shapes and dtypes of its arguments.
        linear: for each argument, True if the function is linear in it.
        given: for each result, True if its cotangent is given.
        args: the other arguments, and the given cotangents.
    """
    fixed, cotangents = args[: linear.count(False)], args[linear.count(False) :]

    def along(*moving: Array) -> list[Array]:
        return list(chosen(function(*merged(linear, moving, fixed)), given))

    moving = chosen(arguments, linear)
    return list(jax.linear_transpose(along, *moving)(list(cotangents)))


def chosen(xs: Sequence[T], flags: Sequence[bool], like: bool = True) -> tuple[T, ...]:
    """Returns the entries whose flag is True; or False, if `like` is False."""
    return tuple(x for x, flag in zip(xs, flags, strict=True) if flag is like)


def merged(flags: Flags, first: Sequence[T], second: Sequence[T]) -> Iterator[T]:
    """Merges two lists: takes the next of `first` for a flag that is True, else of `second`."""
    some, others = iter(first), iter(second)
    return (next(some) if flag else next(others) for flag in flags)


def without_constants(closed: ClosedJaxpr) -> ClosedJaxpr:
    """Turns the constants of a jaxpr into its first arguments."""
    jaxpr = closed.jaxpr
    arguments = [*jaxpr.constvars, *jaxpr.invars]
    return ClosedJaxpr(jaxpr.replace(constvars=[], invars=arguments), ())


def by_world(function: Callable[[], T], chunk_size: int, probed: PyTree) -> T:
    """Calls function(); if it is mapped over many worlds, a CPU evaluates them in chunks.

    A function is called without chunks if it has side effects or collectives, if it contains a
    `jax.custom_vjp`, which has no forward mode, or if types tell where its arrays are placed. It
    may then be traced twice.

    Args:
        function: a function of the arrays that it closes over.
        chunk_size: the largest number of worlds in a chunk.
        probed: arrays among those that it closes over. If `vmap` maps these over at most
            `chunk_size` worlds, the function is called directly.
    """
    apart = meshes.are_placed(probed) or jax.config.values["jax_disable_jit"]
    worlds = worlds_of(probed)
    if apart or not is_known([worlds]) or 0 < worlds <= chunk_size:
        return function()
    closed, shapes = jax.make_jaxpr(function, return_shape=True)()
    traced = any(isinstance(x, Tracer) for x in closed.consts)
    if traced and (has_own_transpose(closed.jaxpr) or meshes.are_placed(closed.consts)):
        return function()
    if not traced or closed.effects:
        results = jaxpr_as_fun(closed)()
    else:
        fun = OneWorld(without_constants(closed), chunk_size)
        results = fun.bound(fun.over(None, (None,) * len(closed.consts)), *closed.consts)
    return jax.tree.unflatten(jax.tree.structure(shapes), results)


def has_own_transpose(jaxpr: Any) -> bool:
    """Returns True if a jaxpr calls a `jax.custom_vjp` outside of native functions."""
    return any(
        equation.primitive.name == "custom_vjp_call"
        or any(map(has_own_transpose, inside(equation)))
        for equation in jaxpr.eqns
        if equation.primitive.name != "native"
    )


# Set by `worlds_of`, read by the batching rule of its primitive, which JAX calls with a fixed
# signature
_SIZES = ContextVar[list[int] | None]("sizes", default=None)


def worlds_of(tree: PyTree) -> int:
    """Returns the number of worlds over which `vmap` maps arrays at this place of the trace.

    Nested calls of `vmap` count with the product of their sizes. Without `vmap` the number is 0.
    """
    traced = [x for x in jax.tree.leaves(tree) if isinstance(x, Tracer)]
    sizes: list[int] = []
    with batch_last.during(_SIZES, sizes):
        probe_p.bind(*traced)
    return math.prod(sizes) if sizes else 0


def _probe_batched(
    args: Sequence[Array], axes: Sequence[int | None]
) -> tuple[list[Array], Sequence[int | None]]:
    """The batching rule of `probe_p`: notes the size of the batch for `worlds_of`."""
    sizes = _SIZES.get()
    if sizes is not None:  # a program traced earlier may be mapped later
        pairs = zip(args, axes, strict=True)
        sizes.append(next(x.shape[i] for x, i in pairs if i is not None))
    return probe_p.bind(*args), axes


def _probe_jvp(
    primals: Sequence[Array], tangents: Sequence[Any]
) -> tuple[list[Array], Sequence[Any]]:
    return probe_p.bind(*primals), tangents


probe_p = Primitive("probe")
probe_p.multiple_results = True
probe_p.def_impl(lambda *args: list(args))
probe_p.def_abstract_eval(lambda *args: list(args))
batching.primitive_batchers[probe_p] = _probe_batched
ad.primitive_jvps[probe_p] = _probe_jvp
mlir.register_lowering(probe_p, lambda ctx, *args: list(args))


class Pullback(NamedTuple):
    """The transpose of a function that many worlds evaluate.

    Its inputs are the arguments in which the function is not linear, and the given cotangents.

    Attributes:
        function: the function of one world.
        linear: for each argument, True if the function is linear in it.
        given: for each result, True if its cotangent is given; the others are zero.
        batch: the worlds.
    """

    function: OneWorld
    linear: Flags
    given: Flags
    batch: Batch

    @property
    def axes(self) -> Axes:
        """The axis of worlds of each input."""
        fixed = chosen(self.batch.axes, self.linear, False)
        return fixed + chosen(self.batch.out_axes, self.given)

    @property
    def out_axes(self) -> Axes:
        """The axis of worlds of each output; None for sums over worlds."""
        return chosen(self.batch.axes, self.linear)

    def bound(self, *args: Array) -> list[Array]:
        """Evaluates the transpose through the primitive `pullback_p`."""
        return pullback_p.bind(*args, pull=self, jaxpr=self.function.closed)

    def results(self) -> list[Any]:
        """Returns the shapes and dtypes of the outputs."""
        arguments = chosen(self.function.arguments, self.linear)
        return batched_types(arguments, self.batch.size, self.out_axes)

    def vmapped(self, size: int | None) -> Callable[..., list[Array]]:
        """Returns the transpose for `size` worlds at once, outside of the primitive."""
        batch = self.batch._replace(size=size)
        function = self.function.vmapped(batch)
        arguments = batched_types(self.function.arguments, size, batch.axes)
        return functools.partial(apply_pullback, function, arguments, self.linear, self.given)


def batched_types(types: Sequence[Any], size: int | None, axes: Axes) -> list[Any]:
    """Adds an axis of worlds to the types that have one."""
    return [
        x
        if axis is None or size is None
        else jax.ShapeDtypeStruct((*x.shape[:axis], size, *x.shape[axis:]), x.dtype)
        for x, axis in zip(types, axes, strict=True)
    ]


worlds_p, pullback_p = Primitive("worlds"), Primitive("pulled")
worlds_p.multiple_results = pullback_p.multiple_results = True


def _abstract(
    *_: ShapedArray, fun: OneWorld, batch: Batch, jaxpr: ClosedJaxpr
) -> list[ShapedArray]:
    types = batched_types(fun.results, batch.size, batch.out_axes)
    weak = (x.weak_type for x in fun.closed.out_avals)
    return [ShapedArray(x.shape, x.dtype, weak_type=y) for x, y in zip(types, weak, strict=True)]


def _batched(
    args: Sequence[Array],
    axes: Sequence[int | None],
    *,
    fun: OneWorld,
    batch: Batch,
    jaxpr: ClosedJaxpr,
) -> tuple[list[Array], list[int | None]]:
    """The batching rule: notes the axes of worlds. A second batch is mapped within the first."""
    if batch.size is not None:
        fun = fun.nested(batch)
    size = next(x.shape[i] for x, i in zip(args, axes, strict=True) if i is not None)
    several = fun.over(size, tuple(axes))
    return fun.bound(several, *args), list(several.out_axes)


def _jvp(
    primals: Sequence[Array],
    tangents: Sequence[Any],
    *,
    fun: OneWorld,
    batch: Batch,
    jaxpr: ClosedJaxpr,
) -> tuple[list[Array], list[Array | ad.Zero]]:
    """The JVP rule: evaluates the results, and then the tangents.

    In reverse mode, the first function also returns the residuals. In forward mode these would fill
    the memory, so the tangent map evaluates the function once more, step by step.
    """
    moved = tuple(type(x) is not ad.Zero for x in tangents)
    moving = chosen(tangents, moved)
    if any(isinstance(x, partial_eval.JaxprTracer) for x in moving):
        split = fun.split(moved)
        forward = split.forward.over(batch.size, batch.axes)
        # steps come before worlds in residuals, so that loops over steps store and read them as
        # they are. Results are as in the batch, where code that is not needed may be gone
        extra = zip(split.forward.results, forward.out_axes, strict=True)
        extra = [i if i is None else min(1, len(y.shape)) for y, i in extra][len(fun.results) :]
        forward = forward._replace(out_axes=(*batch.out_axes, *extra))
        evaluated = split.forward.bound(forward, *primals)
        pool, axes = [*primals, *evaluated], (*batch.axes, *forward.out_axes)
        results, along = evaluated[: len(fun.results)], split.linear
        inputs, places = [pool[i] for i in split.places], [axes[i] for i in split.places]
    else:
        results, along = fun.bound(batch, *primals), fun.tangent(moved)
        inputs, places = primals, batch.axes
    # a result that depends on no tangent has none: JAX then accepts loops of unknown length on it
    real = tuple(map(batch_last.is_real, results))
    depend = along.differ((False,) * len(inputs) + (True,) * len(moving))
    sloped = tuple(merged(real, depend, [False] * len(real)))
    along = along.part(depend)
    places = (*places, *chosen(batch.axes, moved))
    linear = Batch(batch.size, places, chosen(batch.out_axes, sloped))
    slopes = iter(along.bound(linear, *inputs, *moving))
    pairs = zip(results, sloped, strict=True)
    return results, [next(slopes) if flag else _no_tangent(y) for y, flag in pairs]


def _no_tangent(x: Array) -> ad.Zero:
    """Returns a symbolic zero for the tangent of an array."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())


def _transpose(
    cotangents: Sequence[Any],
    *args: Any,
    fun: OneWorld,
    batch: Batch,
    jaxpr: ClosedJaxpr,
) -> list[Array | None]:
    """The transpose rule: the linear map is transposed in all worlds of a chunk at once."""
    linear = tuple(ad.is_undefined_primal(x) for x in args)
    given = tuple(type(x) is not ad.Zero for x in cotangents)
    if not any(given):
        return [None] * len(args)
    inputs = *chosen(args, linear, False), *chosen(cotangents, given)
    if batch.size is None:
        back = fun.transposed(linear, given)
        results = iter(back.bound(back.over(None, (None,) * len(inputs)), *inputs))
    else:
        pull = Pullback(fun, linear, given, batch)
        results = iter(pull.bound(*inputs))
    return [next(results) if flag else None for flag in linear]


def _without_unused(
    wanted: list[bool], *context: bool | JaxprEqn
) -> tuple[list[bool], JaxprEqn | None]:
    """The rule for dead code elimination: removes unused results and the work for them."""
    equation: Any = context[-1]
    if not any(wanted):
        return [False] * len(equation.invars), None
    if all(wanted):
        return [True] * len(equation.invars), equation
    fun, batch = equation.params["fun"], equation.params["batch"]
    batch = batch._replace(out_axes=chosen(batch.out_axes, wanted))
    part = fun.part(tuple(wanted))
    params = {"fun": part, "batch": batch, "jaxpr": part.closed}
    outvars = list(chosen(equation.outvars, wanted))
    return [True] * len(equation.invars), equation.replace(outvars=outvars, params=params)


def _pullback_jvp(
    primals: Sequence[Array], tangents: Sequence[Any], *, pull: Pullback, jaxpr: ClosedJaxpr
) -> tuple[list[Array], list[Array]]:
    """The JVP rule of a pullback, which evaluates all worlds at once.

    Sums over worlds are contractions, which the derivative of one world after another would store
    for each world.
    """
    given = tuple(map(ad.instantiate_zeros, tangents))
    return jax.jvp(pull.vmapped(pull.batch.size), tuple(primals), given)


def _pullback_batched(
    args: Sequence[Array], axes: Sequence[int | None], *, pull: Pullback, jaxpr: ClosedJaxpr
) -> tuple[list[Array], list[int]]:
    """The batching rule of a pullback, which evaluates all worlds at once."""
    results = jax.vmap(pull.vmapped(pull.batch.size), in_axes=tuple(axes))(*args)
    return results, [0] * len(results)


def _pullback_transpose(
    cotangents: Sequence[Any], *args: Any, pull: Pullback, jaxpr: ClosedJaxpr
) -> list[Array | None]:
    """The transpose rule of a pullback, whose transpose is the function itself."""
    fixed = args[: pull.linear.count(False)]
    tangents = list(map(ad.instantiate_zeros, cotangents))
    results = pull.function.bound(pull.batch, *merged(pull.linear, tangents, fixed))
    slopes = zip(args[len(fixed) :], chosen(results, pull.given), strict=True)
    unknown = (y if ad.is_undefined_primal(x) else None for x, y in slopes)
    return [*(None for _ in fixed), *unknown]


def _in_chunks(*args: Array, fun: OneWorld, batch: Batch, devices: int) -> list[Array]:
    """Evaluates a function in chunks of worlds."""
    plan = plan_chunks(batch.size, fun.chunk_size, devices)
    if plan is None:
        return fun.vmapped(batch)(*args)
    differ = mapped(batch.out_axes)
    axes = [axis for axis in batch.out_axes if axis is not None]
    part = fun.part(differ).vmapped(Batch(plan.size, batch.axes, tuple(axes)))
    inputs, shared = plan.split_all(args, batch.axes)

    def one(_: None, xs: list[Array]) -> tuple[None, list[Array]]:
        return None, part(*merged(mapped(batch.axes), xs, shared))

    _, results = jax.lax.scan(one, None, inputs)
    unbatched: list[Array] = []
    if not all(differ):  # results that depend on no world, from the values of the first one
        pairs = zip(args, batch.axes, strict=True)
        world = [x if i is None else jax.lax.index_in_dim(x, 0, i, False) for x, i in pairs]
        unbatched = fun.part(tuple(not flag for flag in differ))(*world)
    return list(merged(differ, list(map(plan.join, results, axes)), unbatched))


def _at_once(*args: Array, fun: OneWorld, batch: Batch) -> list[Array]:
    """Evaluates a function in all worlds at once."""
    return fun.vmapped(batch)(*args)


def in_kernel(platform: kernels.Platform) -> Callable[..., list[Array]]:
    """Makes a function that evaluates another one as one kernel, which runs all steps.

    Functions without such a kernel are evaluated in all worlds at once.
    """

    def evaluate(*args: Array, fun: OneWorld, batch: Batch) -> list[Array]:
        if batch.size is None:
            return _at_once(*args, fun=fun, batch=batch)
        try:
            results = kernels.run_worlds(platform, fun.closed, args, batch.axes, batch.size)
        except UnsupportedError:
            return _at_once(*args, fun=fun, batch=batch)
        pairs = zip(results, batch.out_axes, strict=True)
        return [y[..., 0] if axis is None else jnp.moveaxis(y, -1, axis) for y, axis in pairs]

    return evaluate


def _pullback_in_chunks(*args: Array, pull: Pullback, devices: int) -> list[Array]:
    """Evaluates a pullback in chunks of worlds, and adds up what worlds share."""
    plan = plan_chunks(pull.batch.size, pull.function.chunk_size, devices)
    if plan is None:
        return pull.vmapped(pull.batch.size)(*args)
    count, summed = pull.linear.count(False), tuple(i is None for i in pull.out_axes)
    # copies of a world that fill the last chunk must not count: their cotangents are zero, and so
    # are their gradients, unless a derivative of the last world is infinite
    fixed, shared = plan.split_all(args[:count], pull.axes[:count])
    given, unbatched = plan.split_all(args[count:], pull.axes[count:], copies=False)
    by_device = plan.devices > 1 and any(summed)
    part = _on_each_device(pull, plan) if by_device else pull.vmapped(plan.size)
    flags = mapped(pull.axes)

    def one(sums: list[Array], xs: tuple[Array, list[Array], list[Array]]) -> Any:
        i, fixed, given = xs
        # a result that worlds share has one cotangent, which counts in the first chunk only
        first = [jnp.where(i == 0, x, 0) for x in unbatched]
        results = part(*merged(flags, [*fixed, *given], [*shared, *first]))
        sums = [x + y for x, y in zip(sums, chosen(results, summed), strict=True)]
        return sums, list(chosen(results, summed, False))

    extra = (plan.devices,) if by_device else ()
    zeros = [jnp.zeros(extra + x.shape, x.dtype) for x in chosen(pull.results(), summed)]
    sums, results = jax.lax.scan(one, zeros, (jnp.arange(plan.parts), fixed, given))
    if by_device:
        sums = [jnp.sum(x, axis=0) for x in sums]
    axes = [axis for axis in pull.out_axes if axis is not None]
    return list(merged(summed, sums, list(map(plan.join, results, axes))))


def _on_each_device(pull: Pullback, plan: Chunks) -> Callable[..., list[Array]]:
    """Returns a pullback that adds up, on each device, what the worlds of this device share.

    Its sums have a first axis of devices. Devices thus need not meet before the last chunk.
    """
    count = pull.linear.count(False)
    axes = (*pull.axes[:count], *(0 if i is None else i for i in pull.axes[count:]))
    out_axes = [0 if i is None else i for i in pull.out_axes]
    every = jax.vmap(pull.vmapped(plan.share), in_axes=axes, out_axes=out_axes)
    first = jnp.arange(plan.devices) == 0

    def part(*args: Array) -> list[Array]:
        inputs = [
            x
            if axis is None and i < count
            # the cotangent of a result that worlds share counts on the first device only
            else jnp.where(first.reshape(-1, *(1,) * x.ndim), x, 0)
            if axis is None
            else x.reshape(*x.shape[:axis], plan.devices, plan.share, *x.shape[axis + 1 :])
            for i, (x, axis) in enumerate(zip(args, pull.axes, strict=True))
        ]
        pairs = zip(every(*inputs), pull.out_axes, strict=True)
        return [
            y if axis is None else y.reshape(*y.shape[:axis], plan.size, *y.shape[axis + 2 :])
            for y, axis in pairs
        ]

    return part


def mapped(axes: Axes) -> Flags:
    """Returns a flag for each array: True if it has an axis of worlds."""
    return tuple(axis is not None for axis in axes)


class Chunks(NamedTuple):
    """Chunks of a batch. Each has equal shares of the worlds of all devices.

    Attributes:
        worlds: the number of worlds of the batch.
        parts: the number of chunks.
        share: the number of worlds of a device in a chunk.
        devices: the number of devices.
    """

    worlds: int
    parts: int
    share: int
    devices: int

    @property
    def size(self) -> int:
        """The number of worlds in a chunk."""
        return self.devices * self.share

    def split_all(
        self, args: Sequence[Array], axes: Axes, copies: bool = True
    ) -> tuple[list[Array], tuple[Array, ...]]:
        """Splits the arrays that have an axis of worlds; returns them and the others."""
        pairs = zip(args, axes, strict=True)
        split = [self.split(x, axis, copies) for x, axis in pairs if axis is not None]
        return split, chosen(args, mapped(axes), False)

    def split(self, x: Array, axis: int, copies: bool = True) -> Array:
        """Splits an array along its axis of worlds, and moves the axis of chunks to the front.

        The last chunk is filled with copies of the last world; with zeros if `copies` is False.
        """
        if extra := self.parts * self.size - self.worlds:
            last = jax.lax.slice_in_dim(x, self.worlds - 1, self.worlds, axis=axis)
            last = last if copies else jnp.zeros_like(last)
            shape = (*x.shape[:axis], extra, *x.shape[axis + 1 :])
            x = jnp.concatenate([x, jnp.broadcast_to(last, shape)], axis)
        before, after = x.shape[:axis], x.shape[axis + 1 :]
        x = x.reshape(*before, self.devices, self.parts, self.share, *after)
        return jnp.moveaxis(x, axis + 1, 0).reshape(self.parts, *before, self.size, *after)

    def join(self, y: Array, axis: int) -> Array:
        """Joins the results of chunks, (chunk, …), along their axis of worlds."""
        before, after = y.shape[1 : axis + 1], y.shape[axis + 2 :]
        y = y.reshape(self.parts, *before, self.devices, self.share, *after)
        y = jnp.moveaxis(y, 0, axis + 1).reshape(*before, self.parts * self.size, *after)
        return jax.lax.slice_in_dim(y, 0, self.worlds, axis=axis)


def plan_chunks(worlds: int | None, chunk_size: int, devices: int) -> Chunks | None:
    """Returns how a batch is cut into chunks; None if it is not.

    Args:
        worlds: the number of worlds, or None.
        chunk_size: the largest number of worlds of a device in a chunk.
        devices: the number of devices. A batch that does not divide among them is not cut.
    """
    if worlds is None or not is_known([worlds]) or worlds % devices:
        return None
    own = worlds // devices
    if own <= chunk_size:
        return None
    count = -(-own // chunk_size)
    share = -(-own // count)
    if devices > 1 and count * share != own:  # copies would move worlds between devices
        fitting = [k for k in range(share, max(1, chunk_size // 4), -1) if own % k == 0]
        if not fitting:
            return None
        share, count = fitting[0], own // fitting[0]
    return Chunks(worlds, count, share, devices)


def _lower(
    primitive: Primitive,
    at_once: Callable[..., Any],
    in_chunks: Callable[..., Any],
    in_kernel: Callable[..., Any] | None = None,
) -> None:
    """Registers the lowering rules of a primitive.

    Args:
        primitive: the primitive.
        at_once: evaluates it in all worlds at once.
        in_chunks: evaluates it in chunks, on CPUs.
        in_kernel: evaluates it as one kernel, on NVIDIA's GPUs; None for `at_once`.
    """

    def rule(ctx: mlir.LoweringRuleContext, *args: Any, jaxpr: ClosedJaxpr, **params: Any) -> Any:
        # the devices over which the compiler may spread a batch
        devices = getattr(ctx.module_context.axis_context, "num_devices", None) or 1
        function = functools.partial(in_chunks, devices=devices)
        return mlir.lower_fun(function, multiple_results=True)(ctx, *args, **params)

    def whole(ctx: mlir.LoweringRuleContext, *args: Any, jaxpr: ClosedJaxpr, **params: Any) -> Any:
        return mlir.lower_fun(at_once, multiple_results=True)(ctx, *args, **params)

    def kernel(ctx: mlir.LoweringRuleContext, *args: Any, jaxpr: ClosedJaxpr, **params: Any) -> Any:
        possible = kernels.are_possible(ctx) and kernels.is_alone(ctx)
        function = in_kernel if in_kernel and possible else at_once
        return mlir.lower_fun(function, multiple_results=True)(ctx, *args, **params)

    mlir.register_lowering(primitive, whole)
    mlir.register_lowering(primitive, rule, platform="cpu")
    mlir.register_lowering(primitive, kernel, platform="cuda")


worlds_p.def_impl(lambda *args, fun, batch, jaxpr: fun.compiled(*args, batch=batch))
worlds_p.def_abstract_eval(_abstract)
batching.primitive_batchers[worlds_p] = _batched
ad.primitive_jvps[worlds_p] = _jvp
ad.primitive_transposes[worlds_p] = _transpose
partial_eval.dce_rules[worlds_p] = _without_unused
_lower(worlds_p, _at_once, _in_chunks, in_kernel(cuda.Cuda()))

pullback_p.def_impl(lambda *args, pull, jaxpr: pull.function.pullback(*args, masks=pull[1:]))
pullback_p.def_abstract_eval(
    lambda *_, pull, jaxpr: [ShapedArray(x.shape, x.dtype) for x in pull.results()]
)
batching.primitive_batchers[pullback_p] = _pullback_batched
ad.primitive_jvps[pullback_p] = _pullback_jvp
ad.primitive_transposes[pullback_p] = _pullback_transpose
_lower(pullback_p, lambda *args, pull: pull.vmapped(pull.batch.size)(*args), _pullback_in_chunks)
