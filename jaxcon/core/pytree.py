"""Frozen dataclasses that JAX flattens: numbers are leaves, choices are static."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer

from jaxcon.core.equality import equal, hashed
from jaxcon.core.static_data import decoded, encoded

T = TypeVar("T")

_WRITTEN: set[str] = set()
"""Names by which `jax.export` writes our classes; it takes each but once."""


def static(**options: Any) -> Any:
    """A field that is part of the tree's structure: hashable, compared when a trace is reused."""
    return field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, static))
def pytree(cls: type[T]) -> type[T]:
    """Registers a class as a frozen dataclass whose non-static fields are pytree children.

    Instances are compared and hashed by structure and leaves, see `equality`: a method can be a
    static argument of `jax.jit`. Those of classes of the library can be written by `jax.export`.
    JAX rebuilds an instance without `__post_init__`, which so may check what a user gave.
    """
    cls = dataclass(frozen=True, eq=False)(cls)
    if cls.__eq__ is object.__eq__:
        cls.__eq__, cls.__hash__ = _equal, _hash
    numbers = [f.name for f in fields(cls) if not f.metadata.get("static")]  # type: ignore[arg-type]
    choices = [f.name for f in fields(cls) if f.metadata.get("static")]  # type: ignore[arg-type]

    def rebuilt(known: Any, children: Any) -> T:
        values = *zip(numbers, children, strict=True), *zip(choices, known, strict=True)
        if not hasattr(cls, "__post_init__"):
            return cls(**dict(values))
        new = object.__new__(cls)
        for name, x in values:
            object.__setattr__(new, name, x)
        return new

    if hasattr(cls, "__post_init__"):
        _register_without_init(cls, numbers, choices, rebuilt)
    else:
        jax.tree_util.register_dataclass(cls, numbers, choices)
    return exportable(cls, rebuilt)


def _register_without_init(
    cls: type, numbers: list[str], choices: list[str], rebuilt: Callable[[Any, Any], Any]
) -> None:
    """Registers a dataclass like `register_dataclass`, which would call the constructor.

    JAX rebuilds trees with tracers, gradients, axes and placeholders in the place of numbers.
    """
    keys = [jax.tree_util.GetAttrKey(name) for name in numbers]

    def flatten(x: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(x, name) for name in numbers], tuple(getattr(x, name) for name in choices)

    def flatten_with_keys(x: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children, known = flatten(x)
        return list(zip(keys, children, strict=True)), known

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, rebuilt, flatten)


def exportable(cls: type[T], rebuilt: Any = None) -> type[T]:
    """Lets `jax.export` write trees with nodes of a class of the library.

    Args:
        cls: a named tuple, or registered as a pytree.
        rebuilt: (static data, children) → the node, unless the registration says it.
    """
    name = f"{cls.__module__}.{cls.__qualname__}"
    if not name.startswith("jaxcon.") or name in _WRITTEN:  # there where its module is reloaded
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


def unshared(tree: Any, *others: Any) -> Any:
    """The tree with copies of the arrays that are in it twice, or in another tree as well.

    JAX frees the arrays of an argument that is donated, wherever else they are.
    """
    seen = {id(x) for x in jax.tree.leaves(others)}

    def own(x: Any) -> Any:
        if not isinstance(x, jax.Array) or isinstance(x, Tracer):
            return x
        if id(x) in seen:
            return jnp.array(x, copy=True)
        seen.add(id(x))
        return x

    return jax.tree.map(own, tree)


@dataclass(frozen=True)
class Parts:
    """Which leaves of a tree are real numbers, those that have derivatives.

    Attributes:
        structure: of the tree.
        real: whether each leaf is.
    """

    structure: Any
    real: tuple[bool, ...]

    @classmethod
    def of(cls, tree: Any) -> "Parts":
        """Returns the parts of a tree, of which shapes and dtypes are enough."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(
            structure, tuple(jnp.issubdtype(jnp.result_type(x), jnp.inexact) for x in leaves)
        )

    def among(self, chosen: Iterable[bool]) -> "Parts":
        """With only these of the real numbers."""
        own = iter(chosen)
        return Parts(self.structure, tuple(flag and next(own) for flag in self.real))

    def split(self, tree: Any) -> tuple[list[Any], list[Any]]:
        """The leaves that are real numbers, and the others, as arrays."""
        pairs = [(jnp.asarray(x), r) for x, r in zip(jax.tree.leaves(tree), self.real, strict=True)]
        return [x for x, real in pairs if real], [x for x, real in pairs if not real]

    def merge(self, real: Iterable[Any], others: Iterable[Any]) -> Any:
        """The tree of both."""
        own = {True: iter(real), False: iter(others)}
        return jax.tree.unflatten(self.structure, [next(own[flag]) for flag in self.real])
