"""Operations on batches of worlds along trailing axes; axes of size 1 are shared values."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree, T
from jaxcon.staging.program import is_known

Args = TypeVar("Args")

FEWEST, MOST_PARTS = 8, 8
"""The fewest worlds in a chunk of `where_wanted`, and the most chunks of a batch."""


def per_world(function: Callable[..., Any], rank: int) -> Callable[..., Any]:
    """Returns a function that maps a function of one world over trailing batch axes.

    Args:
        function: a function of pytrees of arrays without batch axes.
        rank: the number of trailing batch axes. Each axis of an array has the size of the batch, or
            size 1 if all worlds share the array.
    """
    if rank == 0:
        return function
    inner = per_world(function, rank - 1)

    def mapped(*args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        batched = [isinstance(x, jax.Array) and x.shape[-1] != 1 for x in leaves]
        shared = [
            x[..., 0] if isinstance(x, jax.Array) and not b else x
            for x, b in zip(leaves, batched, strict=True)
        ]

        def one_world(*mapped_leaves: Array) -> PyTree:
            given = iter(mapped_leaves)
            merged = [next(given) if b else x for x, b in zip(shared, batched, strict=True)]
            return inner(*jax.tree.unflatten(structure, merged))

        mapped_leaves = [x for x, b in zip(leaves, batched, strict=True) if b]
        if not mapped_leaves:
            return jax.tree.map(lambda x: jnp.asarray(x)[..., None], one_world())
        return jax.vmap(one_world, in_axes=-1, out_axes=-1)(*mapped_leaves)

    return mapped


def batch_of(tree: PyTree, rank: int) -> tuple[int, ...]:
    """Returns the shape of the batch: the last `rank` axes of all arrays, broadcast together."""
    shapes = (x.shape[x.ndim - rank :] for x in jax.tree.leaves(tree) if isinstance(x, jax.Array))
    return jnp.broadcast_shapes(*shapes)


def broadcast_worlds(tree: T, batch: tuple[int, ...]) -> T:
    """Broadcasts the trailing batch axes of all arrays of a tree to the shape of the batch."""

    def broadcast(x: Array) -> Array:
        return jnp.broadcast_to(x, (*x.shape[: x.ndim - len(batch)], *batch))

    return jax.tree.map(broadcast, tree)


def where_tree(chosen: Array, x: T, y: T) -> T:
    """Returns a tree with the values of x in the chosen worlds, and of y in all other worlds."""
    return jax.tree.map(lambda a, b: jnp.where(expand_like(chosen, a), a, b), x, y)


def expand_like(x: Array, like: Array) -> Array:
    """Adds leading axes of size 1 to x, so that it has as many axes as `like`.

    Args:
        x: one value for each world, (…).
        like: an array with further axes before the batch axes, such as (n, …).
    """
    return x.reshape((1,) * (like.ndim - x.ndim) + x.shape)


def where_wanted(wanted: Array, function: Callable[[Args], T], args: Args, others: T) -> T:
    """Returns function(args) in the worlds where `wanted` is True, and `others` elsewhere.

    If no world is wanted, the function is skipped. In a process with a single CPU device, the
    wanted worlds are gathered and evaluated in chunks of an eighth of the batch. A single wanted
    world then does not cost a whole batch. The whole batch is evaluated in three cases: on
    accelerators, whose time hardly depends on its size; on several devices, because gathering would
    move worlds between them; and if the batch size is symbolic.

    Args:
        wanted: a boolean for each world, (…).
        function: a function of a batch, in which no world depends on another world.
        args: a pytree of arrays (n, …), of the batch's size along each trailing axis or of size 1.
        others: a pytree with the structure and shapes of the result; at least one leaf is floating.

    Returns:
        A pytree like `others`.
    """

    def computed() -> T:
        one_cpu = jax.default_backend() == "cpu" and jax.device_count() == 1
        gathers = one_cpu and is_known(wanted.shape) and wanted.size > FEWEST
        results = _gathered(wanted, function, args, others) if gathers else function(args)
        return where_tree(wanted, results, others)

    return jax.lax.cond(somewhere(wanted), computed, lambda: others)


def _gathered(wanted: Array, function: Callable[[Args], T], args: Args, like: T) -> T:
    """Evaluates function(args) in the wanted worlds, chunk by chunk.

    The chunks take the wanted worlds first, and chunks without wanted worlds are skipped. The
    results of worlds that are not wanted are arbitrary.

    Args:
        wanted: a boolean for each world, (…).
        function: a function of a batch, in which no world depends on another world.
        args: the arguments of the function.
        like: a pytree with the structure and shapes of the result.
    """
    batch, count = wanted.shape, wanted.size
    size = max(FEWEST, -(-count // MOST_PARTS))
    parts = -(-count // size)
    order = jnp.argsort(~wanted.reshape(count))  # wanted worlds come first
    padded = jnp.pad(order, (0, parts * size - count), mode="edge")
    leaves, structure = jax.tree.flatten(like)
    lengths = [prod(x.shape[: x.ndim - len(batch)]) for x in leaves]
    real = next(x.dtype for x in leaves if jnp.issubdtype(x.dtype, jnp.floating))

    def part(_: None, i: Array) -> tuple[None, Array]:
        index = jax.lax.dynamic_slice(padded, (i * size,), (size,))

        def evaluated() -> Array:
            # the loop copies each of its outputs in every iteration: one array is cheaper than many
            results = jax.tree.leaves(function(_gather_worlds(args, index, batch)))
            return jnp.concatenate([x.astype(real).reshape(-1, size) for x in results])

        def skipped() -> Array:
            return jnp.zeros((sum(lengths), size), real)

        return None, jax.lax.cond(i * size < jnp.sum(wanted), evaluated, skipped)

    _, results = jax.lax.scan(part, None, jnp.arange(parts))
    place = jnp.zeros_like(order).at[order].set(jnp.arange(count))
    results = jnp.moveaxis(results, 0, 1).reshape(-1, parts * size)[:, place]
    arrays = jnp.split(results, np.cumsum(lengths)[:-1])
    arrays = [y.reshape(x.shape).astype(x.dtype) for x, y in zip(leaves, arrays, strict=True)]
    return jax.tree.unflatten(structure, arrays)


def _gather_worlds(tree: T, index: Array, batch: tuple[int, ...]) -> T:
    """Gathers k worlds of a batch.

    Args:
        tree: a pytree of arrays with trailing batch axes.
        index: the index of each gathered world in the flattened batch, (k,).
        batch: the shape of the batch.

    Returns:
        The tree with the batch axes (k, 1, …). Arrays that all worlds share are unchanged.
    """
    rank = len(batch)

    def gather(x: Array) -> Array:
        if jnp.ndim(x) < rank or prod(jnp.shape(x)[jnp.ndim(x) - rank :]) == 1:
            return x  # shared by all worlds
        shape = x.shape[: x.ndim - rank]
        x = broadcast_worlds(x, batch).reshape(*shape, prod(batch))
        return x[..., index].reshape(*shape, len(index), *(1,) * (rank - 1))

    return jax.tree.map(gather, tree)
