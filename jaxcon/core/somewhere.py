"""Conditions on a batch of worlds that each device evaluates for its own worlds only.

A loop or branch runs if any world needs it. Worlds are independent, so a device needs only the
flags of its own worlds. A plain `jnp.any` would exchange flags between devices in each step.
"""

import functools
from collections.abc import Sequence

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
    """Returns True if the flag of any world on this device is set, ().

    The result has no derivative. Under `jax.vmap`, each mapped array of flags has its own result.

    Args:
        flags: one flag for each world, (…).
    """
    return somewhere_p.bind(jnp.asarray(flags, bool), asks=asking())


def everywhere(flags: Array) -> Array:
    """Returns True if the flags are set in all worlds on this device, ()."""
    return ~somewhere(~flags)


def _any(flags: Array) -> Array:
    """Returns True if any flag is set, ()."""
    return jnp.any(flags)


_by_device = custom_partitioning(_any)
_by_device.def_partition(
    # each device reads only its own flags
    lambda mesh, args, result: (
        mesh,
        _any,
        NamedSharding(mesh, PartitionSpec()),
        (args[0].sharding,),
    ),
    infer_sharding_from_operands=lambda mesh, args, result: NamedSharding(mesh, PartitionSpec()),
    # a rule in Einstein notation, such as "i0 i1 -> ": all axes of the flags are reduced
    sharding_rule=lambda mesh, args, results: (
        " ".join(f"i{k}" for k in range(len(args[0].shape))) + " -> "
    ),
)


@functools.cache
def asking() -> ClosedJaxpr:
    """Returns a jaxpr that contains the custom partitioning of `somewhere`.

    It is passed as a parameter to each primitive whose lowering may use this partitioning. A
    program with a custom partitioning must know its devices when it is lowered. JAX therefore
    searches the program, and the parameters of its primitives, for custom partitionings. Without
    the parameter, JAX would miss a partitioning that only the lowering introduces.
    """
    return jax.make_jaxpr(_by_device)(np.zeros(1, bool))


def _batched(args: Sequence[Array], axes: Sequence[int], *, asks: ClosedJaxpr) -> tuple[Array, int]:
    """The batching rule of `somewhere`: returns one flag for each array of flags of the batch.

    Unlike `somewhere` itself, it combines the flags of all devices.
    """
    (flags,), (axis,) = args, axes
    return jnp.any(jnp.moveaxis(flags, axis, 0), axis=tuple(range(1, flags.ndim))), 0


somewhere_p = Primitive("somewhere")
somewhere_p.def_impl(lambda flags, asks: _any(flags))
somewhere_p.def_abstract_eval(lambda flags, asks: ShapedArray((), jnp.dtype(bool)))
batching.primitive_batchers[somewhere_p] = _batched
mlir.register_lowering(
    somewhere_p, mlir.lower_fun(lambda flags, asks: _by_device(flags), multiple_results=False)
)
