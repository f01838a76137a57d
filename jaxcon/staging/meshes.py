"""The placement of arrays on a mesh, which JAX keeps in their types.

Inside `jax.shard_map`, a type lists the mesh axes along which an array varies. On a mesh with
explicit axes, a type tells how each array axis is split. Native functions are traced and compiled
without this information, as if all mesh axes were left to the compiler. `typed` adds it to the
types of the results.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
from jax.core import ShapedArray
from jax.sharding import AxisType, PartitionSpec

from jaxcon.core.typing import Array, PyTree, T


def together(tree: T) -> T:
    """Puts all arrays of a tree on the current mesh, and lets them vary along the same mesh axes.

    The initial value of a loop needs this, since types must not change within a loop. The transpose
    of this operation is a sum over devices. If it is called outside of a loop, devices communicate
    once in the reverse pass, not in every step.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if not (mesh.manual_axes or mesh.explicit_axes):
        return tree
    axes = frozenset().union(*(_varies(jax.typeof(x)) for x in jax.tree.leaves(tree)))

    def cast(x: Array) -> Array:
        missing = axes - _varies(jax.typeof(x))
        if missing:
            return jax.lax.pcast(x, tuple(sorted(missing)), to="varying")
        outside = mesh.explicit_axes and jax.typeof(x).sharding.mesh.empty
        return jax.sharding.reshard(x, PartitionSpec()) if outside else x

    return jax.tree.map(cast, tree)


def _varies(aval: Any) -> frozenset[Any]:
    """Returns the mesh axes along which an array of this type varies, in any version of JAX."""
    return aval.manual_axis_type.varying if hasattr(aval, "manual_axis_type") else aval.vma


def are_placed(tree: PyTree) -> bool:
    """Returns True if types tell where arrays are: on an explicit mesh, or varying along an axis.

    Within `jax.shard_map(…, check_vma=False)` types do not tell it.
    """
    if jax.sharding.get_abstract_mesh().explicit_axes:
        return True
    arrays = (x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array))
    return any(_varies(jax.typeof(x)) for x in arrays)


@contextmanager
def apart() -> Iterator[None]:
    """Makes explicit mesh axes automatic in this context, so that the compiler places arrays."""
    mesh = jax.sharding.get_abstract_mesh()
    explicit = mesh.explicit_axes
    if not explicit:
        yield
        return
    with jax.sharding.use_abstract_mesh(
        mesh.update_axis_types(dict.fromkeys(explicit, AxisType.Auto))
    ):
        yield


def plain(aval: ShapedArray | jax.ShapeDtypeStruct) -> ShapedArray:
    """Returns the type of an array without its placement: only the shape and the dtype."""
    return ShapedArray(aval.shape, aval.dtype)


def typed(results: Sequence[Any], args: Sequence[Any]) -> list[ShapedArray]:
    """Returns the types of the results of a native function, placed like its arguments.

    An axis of a result is compared with axes of equal size at the same position in the arguments.
    Positions count from the last axis, because batch axes are last. If one of these axes is split
    along an explicit mesh axis, the axis of the result is split in the same way. All other axes are
    whole on each device.

    Args:
        results: shapes and dtypes.
        args: types of the arguments.
    """
    if not args:
        return [plain(y) for y in results]
    split: dict[tuple[int, Any], Any] = {}
    for x in args:
        spec = (*x.sharding.spec, *(None,) * x.ndim)[: x.ndim]
        places = zip(range(-x.ndim, 0), x.shape, spec, strict=True)
        split |= {(place, size): axis for place, size, axis in places if axis is not None}
    like = next((x for x in args if not x.sharding.mesh.empty), args[0])

    def placed(y: ShapedArray | jax.ShapeDtypeStruct) -> ShapedArray:
        n = len(y.shape)
        spec = PartitionSpec(*(split.get((i - n, size)) for i, size in enumerate(y.shape)))
        return like.update(
            shape=y.shape, dtype=y.dtype, weak_type=False, sharding=like.sharding.update(spec=spec)
        )

    return [placed(y) for y in results]
