"""Worlds along trailing axes, of the batch's size, or of size 1 where they share a number."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.program import is_known
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree

FEWEST, MOST_PARTS = 8, 8
"""Chunks of `where_wanted`: the fewest worlds in a chunk, and the most chunks of a batch."""


def per_world(function: Callable[..., Any], rank: int) -> Callable[..., Any]:
    """The function of one world, on arrays with `rank` trailing batch axes.

    Args:
        function: takes and returns pytrees of arrays without batch axes.
        rank: how many trailing axes enumerate worlds; each of the batch's size or of size 1.
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

        def one(*own: Array) -> PyTree:
            given = iter(own)
            merged = [next(given) if b else x for x, b in zip(shared, batched, strict=True)]
            return inner(*jax.tree.unflatten(structure, merged))

        own = [x for x, b in zip(leaves, batched, strict=True) if b]
        if not own:
            return jax.tree.map(lambda x: jnp.asarray(x)[..., None], one())
        return jax.vmap(one, in_axes=-1, out_axes=-1)(*own)

    return mapped


def batch_of(tree: PyTree, rank: int) -> tuple[int, ...]:
    """The shape of the `rank` trailing batch axes over all arrays of a tree."""
    shapes = (x.shape[x.ndim - rank :] for x in jax.tree.leaves(tree) if isinstance(x, jax.Array))
    return jnp.broadcast_shapes(*shapes)


def spread(tree: PyTree, batch: tuple[int, ...]) -> PyTree:
    """A tree with what worlds share repeated for each of them."""

    def one(x: Array) -> Array:
        return jnp.broadcast_to(x, (*x.shape[: x.ndim - len(batch)], *batch))

    return jax.tree.map(one, tree)


def keep(chosen: Array, x: PyTree, y: PyTree) -> PyTree:
    """One tree in the chosen worlds, another in the others."""
    return jax.tree.map(lambda a, b: jnp.where(lift(chosen, a), a, b), x, y)


def lift(x: Array, like: Array) -> Array:
    """A number of each world, (…), with leading axes to meet an array (n, …)."""
    return x.reshape((1,) * (like.ndim - x.ndim) + x.shape)


def where_wanted(
    wanted: Array, function: Callable[[PyTree], PyTree], args: PyTree, others: PyTree
) -> PyTree:
    """Evaluates function(args) in the worlds where `wanted` is set; the others keep `others`.

    If no world is set, the function is skipped. In a process with a single CPU device, the set
    worlds are gathered and evaluated in chunks of an eighth of the batch, so that one world does
    not cost a whole batch. Accelerators evaluate the whole batch, because their time hardly
    depends on its size. Several devices do so too, because gathering would move worlds between
    them, and so does a program for batches of any size.

    Args:
        wanted: a boolean for each world, (…).
        function: a function of a batch in which no world reads another.
        args: a pytree of arrays (n, …), of the batch's size along each trailing axis or of size 1.
        others: a pytree with the structure and shapes of the result; at least one leaf is floating.

    Returns:
        A pytree like `others`.
    """

    def found() -> PyTree:
        one_cpu = jax.default_backend() == "cpu" and jax.device_count() == 1
        gathers = one_cpu and is_known(wanted.shape) and wanted.size > FEWEST
        results = _gathered(wanted, function, args, others) if gathers else function(args)
        return keep(wanted, results, others)

    return jax.lax.cond(somewhere(wanted), found, lambda: others)


def _gathered(
    wanted: Array, function: Callable[[PyTree], PyTree], args: PyTree, like: PyTree
) -> PyTree:
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


def _gather_worlds(tree: PyTree, index: Array, batch: tuple[int, ...]) -> PyTree:
    """Gathers worlds by their index (k,) in the flattened batch; trailing axes become (k, 1, …)."""
    rank = len(batch)

    def gather(x: Any) -> Any:
        if jnp.ndim(x) < rank or prod(jnp.shape(x)[jnp.ndim(x) - rank :]) == 1:
            return x  # shared by all worlds
        own = x.shape[: x.ndim - rank]
        x = spread(x, batch).reshape(*own, prod(batch))
        return x[..., index].reshape(*own, len(index), *(1,) * (rank - 1))

    return jax.tree.map(gather, tree)
