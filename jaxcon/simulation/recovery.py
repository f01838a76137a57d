"""What happens to a world that fails: it stops, and its gradient with it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxcon.core import native
from jaxcon.core.pytree import Parts
from jaxcon.core.status import failed
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep, lift, spread


def contain(function: Callable[..., Any], args: PyTree) -> Any:
    """function(*args), with no gradient through a world that failed.

    A forward `where` is not enough: the transpose of a NaN derivative multiplies a zero cotangent
    by NaN. So tangents are masked on both sides of the linearized function, T ↦ P (f′ (P T)) with
    P = 1 in healthy worlds and 0 in failed ones; its transpose is masked on both sides as well, and
    the gradient by parameters shared between worlds is that of the healthy ones. Where a derivative
    of f′ is taken in a native function, that by the place of f′ is masked, too.

    Args:
        function: returns a pytree and the status of this world, ().
        args: pytree of its arguments.

    Returns:
        What the function returns.
    """
    parts = Parts.of(args)

    def call(floats: list[Array], others: list[Array]) -> Any:
        return function(*parts.merge(floats, others))

    contained, guarded = jax.custom_jvp(call), jax.custom_jvp(lambda floats, _: floats)

    def along(primals: Any, tangents: Any) -> Any:
        moved = [type(x) is not SymbolicZero for x in tangents[0]]
        moving = parts.among(moved)
        batch = jax.eval_shape(call, *primals)[1].shape
        floats, others = primals
        # what is shared by worlds must be masked in each of them
        if native.order() > 1:
            floats = guarded(spread(floats, batch), others)
        start, fixed = moving.split(parts.merge(floats, others))
        start, given = spread(start, batch), spread(list(compress(tangents[0], moved)), batch)
        output, pushforward = jax.linearize(lambda x: function(*moving.merge(x, fixed)), start)
        healthy = ~failed(output[1])
        return output, _mask(healthy, pushforward(_mask(healthy, given)))

    @guarded.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        healthy = ~failed(call(*jax.lax.stop_gradient(primals))[1])
        return guarded(*primals), _mask(healthy, tangents[0])

    # what does not move is left out: a tangent of zeros is work too, and by 1/h² may be NaN
    contained.defjvp(along, symbolic_zeros=True)
    return contained(*parts.split(args))


def stop_failed(status: Array, tree: PyTree) -> PyTree:
    """Returns the values without a gradient where the world failed."""
    healthy = ~failed(status)
    return keep(healthy, tree, jax.lax.stop_gradient(tree))


def _mask(healthy: Array, tangents: PyTree) -> PyTree:
    def mask(x: Any) -> Any:
        return x if x.dtype == jax.dtypes.float0 else jnp.where(lift(healthy, x), x, 0)

    return jax.tree.map(mask, tangents)
