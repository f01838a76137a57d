"""Frozen dataclasses that JAX flattens: numbers are leaves, choices are static."""

from dataclasses import dataclass, field
from typing import Any, TypeVar, dataclass_transform

import jax

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
