"""Conditions on the worlds of a batch, asked on each device of its own worlds alone.

A loop or branch that goes on while one world needs it would otherwise make all devices meet in
every step, to learn of the worlds of the others. What each of them then does of its own contains
no exchange: worlds do not read each other.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import batching, mlir
from jax.sharding import NamedSharding, PartitionSpec

from jaxcon.core.typing import Array


def somewhere(flags: Array) -> Array:
    """Returns True where a flag (…) is set in some world that the device holds, ().

    It has no derivative. Under `jax.vmap` it is asked for each of the mapped arrays.
    """
    return somewhere_p.bind(jnp.asarray(flags, bool), asks=asking())


def everywhere(flags: Array) -> Array:
    """Returns True where a flag (…) is set in all worlds that the device holds, ()."""
    return ~somewhere(~flags)


def _any(flags: Array) -> Array:
    """Returns True where a flag is set."""
    return jnp.any(flags)


def _partition(mesh: Any, args: Any, result: Any) -> Any:
    """The function and shardings on several devices: each reads its own flags alone."""
    return mesh, _any, NamedSharding(mesh, PartitionSpec()), (args[0].sharding,)


def _axes(mesh: Any, args: Any, results: Any) -> str:
    """All axes of the flags go, in the notation of Einstein's sums."""
    return " ".join(f"i{k}" for k in range(len(args[0].shape))) + " -> "


_by_device = custom_partitioning(_any)
_by_device.def_partition(
    _partition,
    infer_sharding_from_operands=lambda mesh, args, result: NamedSharding(mesh, PartitionSpec()),
    sharding_rule=_axes,
)


@functools.cache
def asking() -> ClosedJaxpr:
    """A traced question, for the parameters of primitives whose lowering asks some.

    JAX looks for such questions in what is lowered, parameters included, to know that it needs the
    devices.
    """
    return jax.make_jaxpr(_by_device)(np.zeros(1, bool))


def _batched(args: Any, axes: Any, *, asks: Any) -> Any:
    """One answer for each of the mapped arrays, for which devices may have to meet."""
    (flags,), (axis,) = args, axes
    return jnp.any(jnp.moveaxis(flags, axis, 0), axis=tuple(range(1, flags.ndim))), 0


somewhere_p = Primitive("somewhere")
somewhere_p.def_impl(lambda flags, asks: _any(flags))
somewhere_p.def_abstract_eval(lambda flags, asks: ShapedArray((), jnp.dtype(bool)))
batching.primitive_batchers[somewhere_p] = _batched
mlir.register_lowering(
    somewhere_p, mlir.lower_fun(lambda flags, asks: _by_device(flags), multiple_results=False)
)
