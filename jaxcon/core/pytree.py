"""Frozen dataclasses that JAX flattens: numbers are leaves, choices are static."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

T = TypeVar("T")


def static(**options: Any) -> Any:
    """A field that is part of the tree's structure: hashable, compared when a trace is reused."""
    return field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, static))
def pytree(cls: type[T]) -> type[T]:
    """Registers a class as a frozen dataclass whose non-static fields are pytree children.

    There is no `__eq__`: arrays have no single truth value, and structures are compared by JAX.
    """
    return jax.tree_util.register_dataclass(dataclass(frozen=True, eq=False)(cls))


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
        """Those of a tree, of which shapes and dtypes are enough."""
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
