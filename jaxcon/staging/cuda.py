"""Native functions as one kernel of an NVIDIA GPU, in which each world has a thread of its own.

XLA computes a step by many kernels, which pass every value from one to the next through memory: a
chain of 5 links takes 70 kernels and 42 KB a world. Here a step is one kernel that reads the state
and writes the next one. A branch or a loop runs in the threads that need it, and the host waits for
none of them.

Functions that use an operation without instructions here are compiled by XLA, as before. The
environment variable JAXCON_KERNELS=off does this for all functions.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import mlir

from jaxcon.core.typing import Array
from jaxcon.staging.entries import Evaluation, Stored
from jaxcon.staging.program import traced
from jaxcon.staging.ptx import BLOCK, Thread, UnsupportedError
from jaxcon.staging.worlds import batch_of, broadcast_worlds

if TYPE_CHECKING:
    from jaxcon.staging.batch_last import Native

TARGET = "__gpu$xla.gpu.ptx"
"""XLA's name of a call of a kernel that is given as text."""

MAX_LINES = 75_000
"""The largest number of instructions of a kernel; longer programs are compiled by XLA.

The driver assigns registers for longer than a minute, and in tens of gigabytes, for twice as many.
"""

MAX_POINTERS = 500
"""The largest number of arrays of a kernel; NVIDIA's limit is 4 KB of addresses."""

NAME = "native"

kernel_p = Primitive("kernel")
kernel_p.multiple_results = True


def run(fun: Native, args: Sequence[Array], rank: int) -> list[Array]:
    """Calls a native function as one kernel.

    Args:
        fun: the native function.
        args: its arguments, (…, worlds) with `rank` trailing batch axes, of the batch's size or 1.
        rank: the number of batch axes.

    Raises:
        UnsupportedError: the function needs an operation that has no instructions here.
    """
    batch = batch_of(args, rank)
    shared = [x.shape[x.ndim - rank :] != batch for x in args]
    if fun.sums_shared(shared):
        raise UnsupportedError("a sum over worlds that share a cotangent")
    flat = [_merged(x, batch) for x in args]
    worlds = math.prod(batch)
    text, shapes = _written(fun.without_batch(), [(x.shape, x.dtype) for x in flat], worlds)
    results = kernel_p.bind(*flat, text=text, shapes=shapes, worlds=worlds, in_place=True)
    apart = [y.reshape((*y.shape[:-1], *batch)) for y in results]
    like = fun.shapes([ShapedArray(x.shape, x.dtype) for x in args])
    return [_reduced(y, x.shape, fun.sums) for y, x in zip(apart, like, strict=True)]


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
    closed: ClosedJaxpr, args: Sequence[Array], axes: Sequence[int | None], worlds: int
) -> list[Array]:
    """Evaluates a function of one world in many worlds, as one kernel.

    Args:
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
    text, shapes = _kernel(closed, [(x.shape, x.dtype) for x in last], worlds, streams=True)
    return kernel_p.bind(*last, text=text, shapes=shapes, worlds=worlds, in_place=False)


def _written(
    fun: Native, avals: Sequence[tuple[tuple[int, ...], Any]], worlds: int
) -> tuple[str, tuple[tuple[tuple[int, ...], Any], ...]]:
    """Writes a native function as a kernel; see `_kernel`."""
    one = [jax.ShapeDtypeStruct((*shape[:-1], 1), dtype) for shape, dtype in avals]
    text, shapes = _kernel(traced(fun, one), avals, worlds, streams=False)
    return text, tuple(((*shape[:-2], worlds), dtype) for shape, dtype in shapes)


def _kernel(
    closed: ClosedJaxpr,
    avals: Sequence[tuple[tuple[int, ...], Any]],
    worlds: int,
    streams: bool,
) -> tuple[str, tuple[tuple[tuple[int, ...], Any], ...]]:
    """Writes a function of one world as a kernel.

    Args:
        closed: the jaxpr of the function.
        avals: shapes and dtypes of the arrays of its arguments, whose last axis is that of worlds,
            of size 1 if the worlds share the array.
        worlds: the number of worlds.
        streams: True if loops may write their rows to results; see `Evaluation.store`.

    Returns:
        The text of the kernel; shapes and dtypes of the results, with the worlds along a last axis.
    """
    results = [x.aval for x in closed.jaxpr.outvars]
    dtypes = [x.dtype for x in (*closed.in_avals, *results)]
    if not worlds or any(jnp.issubdtype(x, jax.dtypes.extended) for x in dtypes):
        raise UnsupportedError("no worlds, or random keys")
    count = len(avals) + len(results)
    if count > MAX_POINTERS:
        raise UnsupportedError(f"{count} arrays")
    thread = Thread()
    each = [worlds > 1 and shape[-1] == worlds for shape, _ in avals] + [True] * len(results)
    kinds = [x.aval for x in closed.jaxpr.invars] + results
    sizes = [np.dtype(x.dtype).itemsize for x in kinds]
    thread.start(worlds, [n if own else 0 for n, own in zip(sizes, each, strict=True)])
    arrays = [
        Stored(thread, thread.pointer(k), worlds * n if own else n, x.shape, x.dtype)
        for k, (x, n, own) in enumerate(zip(kinds, sizes, each, strict=True))
    ]
    Evaluation(thread).store(closed, arrays[: len(avals)], arrays[len(avals) :], streams)
    text = thread.text(NAME, count)
    if (lines := text.count("\n")) > MAX_LINES:
        raise UnsupportedError(f"{lines} instructions")
    return text, tuple(((*x.shape, worlds), x.dtype) for x in results)


def _abstract(
    *args: ShapedArray, text: str, shapes: Any, worlds: int, in_place: bool
) -> list[ShapedArray]:
    """The abstract evaluation rule: returns the shapes and dtypes of the results."""
    return [ShapedArray(shape, dtype) for shape, dtype in shapes]


def _lowered(
    ctx: mlir.LoweringRuleContext,
    *args: Any,
    text: str,
    shapes: Any,
    worlds: int,
    in_place: bool,
) -> Sequence[Any]:
    """The lowering rule: a call of the kernel, whose arrays lie in memory with the batch last."""
    number = mlir.ir.IntegerType.get_signless(32)

    def integer(x: int) -> Any:
        return mlir.ir.IntegerAttr.get(number, x)

    blocks = -(-worlds // BLOCK)
    config = {"name": mlir.ir.StringAttr.get(NAME)}
    config |= {"kernel_type": mlir.ir.StringAttr.get("ptx")}
    config |= {"kernel_data": mlir.ir.StringAttr.get(text)}
    config |= {f"grid_{axis}": integer(n) for axis, n in zip("xyz", (blocks, 1, 1), strict=True)}
    config |= {f"block_{axis}": integer(n) for axis, n in zip("xyz", (BLOCK, 1, 1), strict=True)}
    config |= {"shared_mem_bytes": integer(0)}
    last = range(len(args), len(args) + len(shapes))
    config |= {"output_indices": mlir.ir.ArrayAttr.get(list(map(integer, last)))}
    call = jax.ffi.ffi_lowering(
        TARGET,
        operand_layouts=list(map(_batch_last, ctx.avals_in)),
        result_layouts=list(map(_batch_last, ctx.avals_out)),
        operand_output_aliases=_pairs(ctx.avals_in, ctx.avals_out) if in_place else {},
        backend_config=config,
    )
    return call(ctx, *args)


def _pairs(args: Sequence[Any], results: Sequence[Any]) -> dict[int, int]:
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


def _batch_last(aval: Any) -> Sequence[int]:
    """Returns the axes of an array from the one contiguous in memory, the last, to the first."""
    return tuple(reversed(range(aval.ndim)))


def is_possible(ctx: mlir.LoweringRuleContext) -> bool:
    """Returns True if a program may call kernels.

    XLA cannot split a kernel over devices, and exported programs must not depend on this version
    of XLA. Within `shard_map`, the program of each device is on its own.
    """
    if os.environ.get("JAXCON_KERNELS") == "off":
        return False
    module = ctx.module_context
    place: Any = module.axis_context
    mesh = getattr(place, "mesh", None)
    if mesh is None:
        alone = getattr(place, "num_devices", 1) == 1
    else:
        alone = mesh.size == 1 or set(place.manual_axes) == set(mesh.axis_names)
    return alone and not module.lowering_parameters.for_export


kernel_p.def_abstract_eval(_abstract)
mlir.register_lowering(kernel_p, _lowered, platform="cuda")
