"""Functions of many worlds as kernels, in which each world has a thread of its own.

XLA computes a step by many loops over the batch, which pass every value from one to the next
through memory. In a kernel, the values of a world stay in registers, or next to them. Branches and
loops run in the worlds that need them.

`run` writes a native function as a kernel, and `run_worlds` a function of one world, such as a
whole rollout. Both trace the function, evaluate it entry by entry (`entries`), and bind a primitive
with the text of the kernel. A platform gives the text, and the rule by which XLA calls it: see
`cuda` and `cpu`.

If a function uses an operation without instructions, XLA compiles it as its own operations. The
environment variable JAXCON_KERNELS=off does this for all functions.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import mlir
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcon.core.typing import Array
from jaxcon.staging.entries import Evaluation, Stored
from jaxcon.staging.thread import (
    Address,
    Layout,
    Local,
    Statement,
    Thread,
    UnsupportedError,
    count_of,
)
from jaxcon.staging.worlds import batch_of, broadcast_worlds

if TYPE_CHECKING:
    from jaxcon.staging.batch_last import Native

NAME = "native"
"""The name of a kernel in its text."""

Aval = tuple[tuple[int, ...], Any]
"""A shape and a dtype."""

kernel_p = Primitive("kernel")
kernel_p.multiple_results = True


class Platform(Protocol):
    """Devices that run kernels.

    Attributes:
        max_length: the largest number of instructions of a kernel.
        max_arrays: the largest number of arrays of a kernel.
        max_places: the largest number of places of a slice at an index that is not known, within a
            loop of a known number of rounds. An entry is chosen among those of all places, and such
            loops take many slices.
        max_local: the largest number of entries of all local arrays of a thread.
    """

    max_length: int
    max_arrays: int
    max_places: int
    max_local: int

    def text(
        self,
        program: Sequence[Statement],
        worlds: int,
        arrays: Sequence[Layout],
        results: int,
        local: Sequence[Local],
    ) -> str:
        """Returns the text of a kernel.

        Args:
            program: the program of a thread.
            worlds: the number of worlds.
            arrays: the layouts of all arrays.
            results: the number of arrays that are results; they are the last ones.
            local: the local arrays, whose numbers follow.
        """
        ...


def run(
    platform: Platform, fun: Native, args: Sequence[Array], rank: int, spreads: bool = False
) -> list[Array]:
    """Calls a native function as one kernel.

    Args:
        platform: the devices that run it.
        fun: the native function.
        args: its arguments, (…, worlds) with `rank` trailing batch axes, of the batch's size or 1.
        rank: the number of batch axes.
        spreads: True if XLA may spread the worlds over several devices.

    Raises:
        UnsupportedError: the function needs an operation that has no instructions.
    """
    batch = batch_of(args, rank)
    shared = [x.shape[x.ndim - rank :] != batch for x in args]
    if fun.sums_shared(shared):
        raise UnsupportedError("a sum over worlds that share a cotangent")
    call = functools.partial(_call, platform, fun, rank)
    results = _spread(call, rank)(*args) if spreads else call(*args)
    like = fun.shapes([ShapedArray(x.shape, x.dtype) for x in args], rank)
    return [_reduced(y, x.shape, fun.sums) for y, x in zip(results, like, strict=True)]


def _call(platform: Platform, fun: Native, rank: int, *args: Array) -> list[Array]:
    """Calls a native function as one kernel; all results have all worlds. See `run`."""
    batch = batch_of(args, rank)
    flat = [_merged(x, batch) for x in args]
    worlds = math.prod(batch)
    one = fun.without_batch().pruned(*(((*x.shape[:-1], 1), x.dtype) for x in flat))
    own = tuple(worlds > 1 and x.shape[-1] == worlds for x in flat)
    text, shapes = _kernel(platform, one, own, worlds)
    shapes = tuple(((*shape[:-2], worlds), dtype) for shape, dtype in shapes)
    results = kernel_p.bind(*flat, text=text, shapes=shapes, worlds=worlds, in_place=True)
    return [y.reshape((*y.shape[:-1], *batch)) for y in results]


def _spread(call: Callable[..., list[Array]], rank: int) -> Callable[..., list[Array]]:
    """Makes a function of which each device evaluates its own worlds.

    Args:
        call: a function of arrays with `rank` trailing batch axes, of the batch's size or 1.
        rank: the number of batch axes.
    """
    function = custom_partitioning(call)

    def axes(shape: tuple[int, ...]) -> list[int | None]:
        """Returns the number of the batch axis at each axis of an array; None if it is none."""
        first = len(shape) - rank
        return [None if i < first or n == 1 else i - first for i, n in enumerate(shape)]

    def partition(mesh: Mesh, args: Sequence[Any], results: Sequence[Any]) -> Any:
        named: list[Any] = [None] * rank
        used: set[str] = set()
        for x in (*results, *args):
            spec = (*x.sharding.spec, *(None,) * len(x.shape))
            for axis, name in zip(axes(x.shape), spec, strict=False):
                parts = {name} if isinstance(name, str) else set(name or ())
                if axis is not None and named[axis] is None and parts and not parts & used:
                    named[axis] = name
                    used |= parts

        def placed(x: Any) -> NamedSharding:
            spec = (None if axis is None else named[axis] for axis in axes(x.shape))
            return NamedSharding(mesh, PartitionSpec(*spec))

        return mesh, call, list(map(placed, results)), tuple(map(placed, args))

    def rule(mesh: Mesh, args: Sequence[Any], results: Sequence[Any]) -> str:
        """Returns the axes of all arrays in Einstein notation; batch axes have the same names."""
        count = itertools.count()

        def names(x: Any) -> str:
            return " ".join(
                f"a{next(count)}" if axis is None else f"b{axis}" for axis in axes(x.shape)
            )

        return f"{', '.join(map(names, args))} -> {', '.join(map(names, results))}"

    function.def_partition(partition, sharding_rule=rule)
    return function


def _reduced(x: Array, shape: tuple[int, ...], sums: bool) -> Array:
    """Returns the sum over batch axes that have size 1 in `shape`, or the first of equal worlds."""
    axes = [a for a, (n, m) in enumerate(zip(x.shape, shape, strict=True)) if n != m]
    if sums:
        return jnp.sum(x, axis=axes, keepdims=True) if axes else x
    for axis in axes:
        x = jax.lax.slice_in_dim(x, 0, 1, axis=axis)
    return x


def _merged(x: Array, batch: tuple[int, ...]) -> Array:
    """Returns an array with all its batch axes as one, of size 1 if all worlds share it."""
    shape = x.shape[: x.ndim - len(batch)]
    if x.size == math.prod(shape):
        return x.reshape((*shape, 1))
    return broadcast_worlds(x, batch).reshape((*shape, math.prod(batch)))


def run_worlds(
    platform: Platform,
    closed: ClosedJaxpr,
    args: Sequence[Array],
    axes: Sequence[int | None],
    worlds: int,
) -> list[Array]:
    """Evaluates a function of one world in many worlds, as one kernel.

    Args:
        platform: the devices that run it.
        closed: the jaxpr of the function.
        args: its arguments.
        axes: the axis of worlds of each argument; None if they share it.
        worlds: the number of worlds.

    Returns:
        The results, with the worlds along the last axis.

    Raises:
        UnsupportedError: see `run`.
    """
    pairs = zip(args, axes, strict=True)
    last = [x[..., None] if a is None else jnp.moveaxis(x, a, -1) for x, a in pairs]
    own = tuple(worlds > 1 and axis is not None for axis in axes)
    text, shapes = _kernel(platform, closed, own, worlds, streams=True)
    return kernel_p.bind(*last, text=text, shapes=shapes, worlds=worlds, in_place=False)


def _kernel(
    platform: Platform, closed: ClosedJaxpr, own: Sequence[bool], worlds: int, streams: bool = False
) -> tuple[str, tuple[Aval, ...]]:
    """Writes a function of one world as a kernel.

    Args:
        platform: the devices that run it.
        closed: the jaxpr of the function.
        own: for each argument, True if each world has its own.
        worlds: the number of worlds.
        streams: True if loops may write their rows to results; see `Evaluation.store`.

    Returns:
        The text of the kernel; shapes and dtypes of the results, with the worlds along a last axis.
    """
    results = [x.aval for x in closed.jaxpr.outvars]
    dtypes = [x.dtype for x in (*closed.in_avals, *results)]
    if not worlds or any(jnp.issubdtype(x, jax.dtypes.extended) for x in dtypes):
        raise UnsupportedError("no worlds, or random keys")
    if len(dtypes) > platform.max_arrays:
        raise UnsupportedError(f"{len(dtypes)} arrays")
    written = _program(closed, streams, platform.max_places, platform.max_local)
    if isinstance(written, str):
        raise UnsupportedError(written)
    program, local = written
    if (length := count_of(program)) > platform.max_length:
        raise UnsupportedError(f"{length} instructions")
    sizes = [np.dtype(x).itemsize for x in dtypes]
    flags = [*own, *(True for _ in results)]
    arrays = [
        Layout(n, worlds * n) if flag else Layout(0, n)
        for n, flag in zip(sizes, flags, strict=True)
    ]
    text = platform.text(program, worlds, arrays, len(results), local)
    return text, tuple(((*x.shape, worlds), x.dtype) for x in results)


@functools.lru_cache(maxsize=8)  # a program of a robot takes tens of megabytes
def _program(
    closed: ClosedJaxpr, streams: bool, max_places: int, max_local: int
) -> tuple[list[Statement], list[Local]] | str:
    """Returns the program of a thread that evaluates a jaxpr, or why there is none.

    Returns:
        The program and its local arrays, or a reason.
    """
    kinds = [x.aval for x in (*closed.jaxpr.invars, *closed.jaxpr.outvars)]
    thread = Thread(len(kinds))
    arrays = [Stored(thread, Address(k), x.shape, x.dtype) for k, x in enumerate(kinds)]
    count = len(closed.jaxpr.invars)
    try:
        evaluation = Evaluation(thread, max_places, max_local)
        evaluation.store(closed, arrays[:count], arrays[count:], streams)
    except UnsupportedError as error:
        return str(error)
    return thread.program(), thread.local


def _abstract(
    *args: ShapedArray, text: str, shapes: Any, worlds: int, in_place: bool
) -> list[ShapedArray]:
    """The abstract evaluation rule: returns the shapes and dtypes of the results."""
    return [ShapedArray(shape, dtype) for shape, dtype in shapes]


def called(
    ctx: mlir.LoweringRuleContext,
    args: Sequence[Any],
    target: str,
    results: Sequence[Any],
    in_place: bool,
    **options: Any,
) -> Sequence[Any]:
    """Writes XLA's call of a kernel, whose arrays lie in memory with the batch last.

    Args:
        ctx: the lowering context of `kernel_p`.
        args: the arguments.
        target: the name by which XLA knows what to call.
        results: the types of the results: those of `kernel_p`, and others after them.
        in_place: True if arguments may lend their memory to results of `kernel_p`.
        options: further options of `jax.ffi.ffi_lowering`.
    """
    call = jax.ffi.ffi_lowering(
        target,
        operand_layouts=list(map(batch_last, ctx.avals_in)),
        result_layouts=list(map(batch_last, results)),
        operand_output_aliases=shared_memory(ctx.avals_in, ctx.avals_out) if in_place else {},
        **options,
    )
    return call(ctx.replace(avals_out=results), *args)


def shared_memory(args: Sequence[Any], results: Sequence[Any]) -> dict[int, int]:
    """Returns which argument lends its memory to which result, of the same shape and dtype.

    A loop then carries a state without copies. Each thread reads its world before it writes.
    """
    free = list(range(len(args)))
    pairs = {}
    for k, y in enumerate(results):
        like = [i for i in free if (args[i].shape, args[i].dtype) == (y.shape, y.dtype)]
        if like:
            pairs[like[0]] = k
            free.remove(like[0])
    return pairs


def batch_last(aval: Any) -> Sequence[int]:
    """Returns the axes of an array from the one contiguous in memory, the last, to the first."""
    return tuple(reversed(range(aval.ndim)))


def are_possible(ctx: mlir.LoweringRuleContext) -> bool:
    """Returns True if a program may call kernels.

    Exported programs must not depend on this version of XLA.
    """
    exported = ctx.module_context.lowering_parameters.for_export
    return os.environ.get("JAXCON_KERNELS") != "off" and not exported


def is_alone(ctx: mlir.LoweringRuleContext) -> bool:
    """Returns True if XLA compiles a program for one device, as also within `shard_map`."""
    place: Any = ctx.module_context.axis_context
    mesh = getattr(place, "mesh", None)
    if mesh is None:
        return getattr(place, "num_devices", 1) == 1
    return mesh.size == 1 or set(place.manual_axes) == set(mesh.axis_names)


def can_spread(ctx: mlir.LoweringRuleContext) -> bool:
    """Returns True if XLA spreads a program over the devices of a mesh that is known."""
    return getattr(ctx.module_context.axis_context, "abstract_mesh", None) is not None


kernel_p.def_abstract_eval(_abstract)
