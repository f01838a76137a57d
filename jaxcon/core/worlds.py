"""Worlds along trailing axes, of the batch's size, or of size 1 where they share a number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array, PyTree


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
