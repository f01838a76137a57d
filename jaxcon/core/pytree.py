"""A decorator for frozen dataclasses that are pytrees: numbers are leaves, options are static."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from typing import Any, dataclass_transform

import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer

from jaxcon.core.equality import equal, hashed
from jaxcon.core.static_data import decoded, encoded
from jaxcon.core.typing import Array, PyTree, T

_WRITTEN: set[str] = set()
"""Names of classes registered for `jax.export`, which accepts each name once."""


def static(**options: Any) -> Any:
    """Declares a static field: its value must be hashable, and is part of the tree structure.

    Args:
        options: arguments of `dataclasses.field`, such as `default`.
    """
    return field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, static))
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass whose non-static fields are pytree children.

    Instances are compared and hashed by structure and leaves (see `equality`), so a `Method` can be
    a static argument of `jax.jit`. `jax.export` can write instances of the library's classes. JAX
    rebuilds instances without calling `__post_init__`, so that method may check user input.
    """
    cls = dataclass(frozen=True, eq=False)(cls)
    if cls.__eq__ is object.__eq__:
        cls.__eq__, cls.__hash__ = _equal, _hash
    numbers = [f.name for f in fields(cls) if not f.metadata.get("static")]  # type: ignore[arg-type]
    choices = [f.name for f in fields(cls) if f.metadata.get("static")]  # type: ignore[arg-type]

    def rebuilt(known: Iterable[Any], children: Iterable[Any]) -> T:
        values = *zip(numbers, children, strict=True), *zip(choices, known, strict=True)
        new = object.__new__(cls)
        for name, x in values:
            object.__setattr__(new, name, x)
        return new

    def flatten(x: T) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(x, name) for name in numbers], tuple(getattr(x, name) for name in choices)

    def flatten_with_keys(x: T) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children, known = flatten(x)
        keys = map(jax.tree_util.GetAttrKey, numbers)
        return list(zip(keys, children, strict=True)), known

    if hasattr(cls, "__post_init__"):
        # `register_dataclass` would call the constructor, and thus its checks, with tracers,
        # gradients, vmap axes and placeholders in place of numbers
        jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, rebuilt, flatten)
    else:
        jax.tree_util.register_dataclass(cls, numbers, choices)
    return exportable(cls, rebuilt)


def exportable(cls: type[T], rebuilt: Callable[..., T] | None = None) -> type[T]:
    """Lets `jax.export` write pytrees that contain instances of a class of the library.

    Args:
        cls: a named tuple, or a class registered as a pytree.
        rebuilt: (static data, children) → the instance; None for JAX's own function.
    """
    name = f"{cls.__module__}.{cls.__qualname__}"
    if (
        not name.startswith("jaxcon.") or name in _WRITTEN
    ):  # a class is registered already if its module was reloaded
        return cls
    _WRITTEN.add(name)
    if issubclass(cls, tuple):
        return export.register_namedtuple_serialization(cls, serialized_name=name)
    return export.register_pytree_node_serialization(
        cls,
        serialized_name=name,
        serialize_auxdata=encoded,
        deserialize_auxdata=decoded,
        from_children=rebuilt,
    )


def _equal(self: Any, other: Any) -> Any:
    return equal(self, other) if type(self) is type(other) else NotImplemented


def _hash(self: Any) -> int:
    return hashed(self)


def unshared(tree: T, *others: PyTree) -> T:
    """Copies each array of a tree that occurs more than once in the tree, or in another tree, too.

    This makes the tree safe to donate: JAX frees donated arrays even if they are used elsewhere.
    """
    seen = {id(x) for x in jax.tree.leaves(others)}

    def copied(x: Array) -> Array:
        if not isinstance(x, jax.Array) or isinstance(x, Tracer):
            return x
        if id(x) in seen:
            return jnp.array(x, copy=True)
        seen.add(id(x))
        return x

    return jax.tree.map(copied, tree)


@dataclass(frozen=True)
class LeafPartition:
    """A partition of the leaves of a tree into differentiable (floating) and other leaves.

    Attributes:
        structure: the tree structure.
        real: for each leaf, True if it is floating.
    """

    structure: Any
    real: tuple[bool, ...]

    @classmethod
    def of(cls, tree: PyTree) -> "LeafPartition":
        """Partitions the leaves of a tree, which are arrays or `jax.ShapeDtypeStruct`s."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(
            structure, tuple(jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in leaves)
        )

    def among(self, chosen: Iterable[bool]) -> "LeafPartition":
        """Returns a partition with fewer differentiable leaves.

        Args:
            chosen: for each leaf that is real here, True if it stays real in the result.
        """
        flags = iter(chosen)
        return LeafPartition(self.structure, tuple(flag and next(flags) for flag in self.real))

    def split(self, tree: PyTree) -> tuple[list[Any], list[Any]]:
        """Returns the real leaves and the other leaves of a tree, as arrays."""
        pairs = [(jnp.asarray(x), r) for x, r in zip(jax.tree.leaves(tree), self.real, strict=True)]
        return [x for x, real in pairs if real], [x for x, real in pairs if not real]

    def merge(self, real: Iterable[Any], others: Iterable[Any]) -> Any:
        """Rebuilds a tree from its real leaves and its other leaves; inverts `split`."""
        leaves = {True: iter(real), False: iter(others)}
        return jax.tree.unflatten(self.structure, [next(leaves[flag]) for flag in self.real])
