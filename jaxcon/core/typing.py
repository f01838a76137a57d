"""Types for annotations throughout the library.

Docstrings give shapes: `(n_v,)` is an array with one number for each velocity, and `()` is a
scalar. Code that runs on a batch has the batch axis last; docstrings do not mention this axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field
from typing import Any, ClassVar, Protocol, TypeAlias, TypeVar, Union

import jax
import numpy as np

T = TypeVar("T")
"""The type of an argument, often a pytree, whose structure equals that of the result."""

Number = TypeVar("Number", float, jax.Array)
"""The type of a number: either a Python float known at trace time, or a JAX array."""

Array: TypeAlias = jax.Array

Scalar: TypeAlias = jax.Array | np.ndarray | np.number | np.bool_ | float
"""A real number or an array of real numbers, in any form that a user may pass."""

Lane: TypeAlias = jax.Array | float
"""One vector component of many bodies and worlds: an array, or a number known when tracing."""

DType: TypeAlias = np.dtype | type[np.generic]
"""The floating dtype of a scene."""


class TreeNode(Protocol):
    """A dataclass that is registered as a pytree; see `core.pytree`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Tree = TypeVar("Tree", bound="PyTree")
"""The type of a pytree argument whose structure equals that of the result."""

# `Union`, because `|` does not accept forward references at run time
PyTree: TypeAlias = Union[  # noqa: UP007
    Scalar, np.generic, TreeNode, Mapping[str, "PyTree"], Sequence["PyTree"], None
]
"""Nested containers of arrays, as JAX flattens them."""
