"""Masks the gradients of failed worlds."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxcon.core.pytree import LeafPartition
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree, T
from jaxcon.staging import batch_last
from jaxcon.staging.worlds import broadcast_worlds, expand_like, where_tree


def mask_failed_gradients(
    function: Callable[..., T], args: PyTree, batch: tuple[int, ...] | None = None
) -> T:
    """Calls function(*args), with zero gradients through failed worlds.

    A forward `where` is not enough: the transpose of a NaN derivative multiplies a zero cotangent
    by NaN. So tangents are masked on both sides of the linearized function, T ↦ P (f′ (P T)). Here
    P is 1 in healthy worlds and 0 in failed ones. The transpose is then masked on both sides, too:
    only healthy worlds contribute to gradients of parameters that worlds share. For second
    derivatives, the derivative of f′ with respect to the arguments is masked as well.

    Args:
        function: a function that returns a pytree and the status of the world, ().
        args: the arguments of the function, a tuple of pytrees.
        batch: the shape of the batch, which is the shape of the status; None to find it by one more
            trace of the function.

    Returns:
        The result of the function.
    """
    parts = LeafPartition.of(args)

    def call(floats: list[Array], others: list[Array]) -> Any:
        return function(*parts.merge(floats, others))

    contained, guarded = jax.custom_jvp(call), jax.custom_jvp(lambda floats, _: floats)

    def along(
        primals: tuple[list[Array], list[Array]],
        tangents: tuple[list[Array | SymbolicZero], list[Any]],
    ) -> Any:
        moved = [type(x) is not SymbolicZero for x in tangents[0]]
        moving = parts.among(moved)
        worlds = jax.eval_shape(call, *primals)[1].shape if batch is None else batch
        floats, others = primals
        # values that worlds share are broadcast, so that they can be masked in each world
        if batch_last.order() > 1:
            floats = guarded(broadcast_worlds(floats, worlds), others)
        start, fixed = moving.split(parts.merge(floats, others))
        start, given = (
            broadcast_worlds(start, worlds),
            broadcast_worlds(list(compress(tangents[0], moved)), worlds),
        )
        output, pushforward = jax.linearize(lambda x: function(*moving.merge(x, fixed)), start)
        healthy = ~failed(output[1])
        return output, _mask(healthy, pushforward(_mask(healthy, given)))

    @guarded.defjvp
    def _(primals: tuple[list[Array], list[Array]], tangents: tuple[list[Array], list[Any]]) -> Any:
        healthy = ~failed(call(*jax.lax.stop_gradient(primals))[1])
        return guarded(*primals), _mask(healthy, tangents[0])

    # zero tangents stay symbolic zeros: arrays of zeros cost work, and a factor such as 1/h² may
    # make them NaN
    contained.defjvp(along, symbolic_zeros=True)
    return contained(*parts.split(args))


def stop_failed(status: Array, tree: T) -> T:
    """Stops the gradient of a tree in the worlds whose status is a failure."""
    healthy = ~failed(status)
    return where_tree(healthy, tree, jax.lax.stop_gradient(tree))


def _mask(healthy: Array, tangents: T) -> T:
    """Sets the tangents of failed worlds to zero; `healthy` is a mask of the other worlds."""

    def mask(x: Array) -> Array:
        return x if x.dtype == jax.dtypes.float0 else jnp.where(expand_like(healthy, x), x, 0)

    return jax.tree.map(mask, tangents)
