"""The placement of arrays on a mesh, as JAX writes it into their types.

Inside `jax.shard_map` a type says along which mesh axes an array varies, and on a mesh with
explicit axes how each array axis is split. Native functions see neither: they are traced and
compiled as if all mesh axes were left to the compiler. `typed` says where their results lie.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
from jax.core import ShapedArray
from jax.sharding import AxisType, PartitionSpec

from jaxcon.core.typing import PyTree


def together(tree: PyTree) -> PyTree:
    """The tree with all its arrays on the mesh in use, varying where one of them does.

    A loop needs this of what it starts from: its types do not change on the way. The transpose of
    making an array vary is a sum over devices, so that where it is done decides how often devices
    meet in the reverse pass.
    """
    mesh = jax.sharding.get_abstract_mesh()
    if not (mesh.manual_axes or mesh.explicit_axes):
        return tree
    axes = frozenset().union(*(_varies(jax.typeof(x)) for x in jax.tree.leaves(tree)))

    def cast(x: Any) -> Any:
        missing = axes - _varies(jax.typeof(x))
        if missing:
            return jax.lax.pcast(x, tuple(sorted(missing)), to="varying")
        outside = mesh.explicit_axes and jax.typeof(x).sharding.mesh.empty
        return jax.sharding.reshard(x, PartitionSpec()) if outside else x

    return jax.tree.map(cast, tree)


def _varies(aval: Any) -> frozenset[Any]:
    """The mesh axes along which an array varies; JAX has renamed the attribute in 0.10."""
    return aval.manual_axis_type.varying if hasattr(aval, "manual_axis_type") else aval.vma


@contextmanager
def apart() -> Iterator[None]:
    """Lets the compiler choose where arrays lie, along explicit mesh axes as well."""
    mesh = jax.sharding.get_abstract_mesh()
    explicit = mesh.explicit_axes
    if not explicit:
        yield
        return
    with jax.sharding.use_abstract_mesh(
        mesh.update_axis_types(dict.fromkeys(explicit, AxisType.Auto))
    ):
        yield


def plain(aval: Any) -> ShapedArray:
    """The shape and dtype of a type alone."""
    return ShapedArray(aval.shape, aval.dtype)


def typed(results: Sequence[Any], args: Sequence[Any]) -> list[ShapedArray]:
    """Types of the results of a native function, which lie where its arguments do.

    Batch axes are last. Along an explicit mesh axis they are split in a result as they are in an
    argument. Other axes are whole on each device.

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

    def one(y: Any) -> ShapedArray:
        n = len(y.shape)
        spec = PartitionSpec(*(split.get((i - n, size)) for i, size in enumerate(y.shape)))
        return like.update(
            shape=y.shape, dtype=y.dtype, weak_type=False, sharding=like.sharding.update(spec=spec)
        )

    return [one(y) for y in results]
