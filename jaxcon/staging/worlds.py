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
"""Chunks of `where_wanted`: the fewest worlds in a chunk, and the most chunks of a batch."""


def per_world(function: Callable[..., Any], rank: int) -> Callable[..., Any]:
    """Maps a function of one world over `rank` trailing batch axes.

    Args:
        function: takes and returns pytrees of arrays without batch axes.
        rank: the number of trailing batch axes, each of the batch's size or of size 1.
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
    """Returns the shape of the `rank` trailing batch axes over all arrays of a tree."""
    shapes = (x.shape[x.ndim - rank :] for x in jax.tree.leaves(tree) if isinstance(x, jax.Array))
    return jnp.broadcast_shapes(*shapes)


def broadcast_worlds(tree: T, batch: tuple[int, ...]) -> T:
    """Broadcasts the arrays of a tree to the shape of the batch."""

    def broadcast(x: Array) -> Array:
        return jnp.broadcast_to(x, (*x.shape[: x.ndim - len(batch)], *batch))

    return jax.tree.map(broadcast, tree)


def where_tree(chosen: Array, x: T, y: T) -> T:
    """Returns the tree x in the chosen worlds, and y in the others."""
    return jax.tree.map(lambda a, b: jnp.where(expand_like(chosen, a), a, b), x, y)


def expand_like(x: Array, like: Array) -> Array:
    """Adds leading axes of size 1 to x (…), a value per world, to broadcast with `like` (n, …)."""
    return x.reshape((1,) * (like.ndim - x.ndim) + x.shape)


def where_wanted(wanted: Array, function: Callable[[Args], T], args: Args, others: T) -> T:
    """Evaluates function(args) in the worlds where `wanted` is set; the others keep `others`.

    If no world is wanted, the function is skipped. In a process with a single CPU device, the
    wanted worlds are gathered and evaluated in chunks of an eighth of the batch, so that one world
    does not cost a whole batch. The whole batch is evaluated in three cases: on accelerators, whose
    time hardly depends on its size; on several devices, because gathering would move worlds
    between them; and if the batch size is symbolic.

    Args:
        wanted: a boolean for each world, (…).
        function: a function of a batch in which no world reads another.
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
    """Evaluates function(args) in chunks that hold the wanted worlds first.

    The results of the other worlds are arbitrary.
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
            # the loop copies each of its outputs in every iteration: one array is cheaper
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
    """Gathers worlds by their index (k,) in the flattened batch; trailing axes become (k, 1, …)."""
    rank = len(batch)

    def gather(x: Array) -> Array:
        if jnp.ndim(x) < rank or prod(jnp.shape(x)[jnp.ndim(x) - rank :]) == 1:
            return x  # shared by all worlds
        shape = x.shape[: x.ndim - rank]
        x = broadcast_worlds(x, batch).reshape(*shape, prod(batch))
        return x[..., index].reshape(*shape, len(index), *(1,) * (rank - 1))

    return jax.tree.map(gather, tree)
