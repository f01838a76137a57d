"""Equality and hashes of pytrees, for those that are static arguments or keys.

Two trees are equal where a function that is traced with the one as a constant is the same program
as with the other: one structure, and leaves of one type with the same bits. So 5 and 5.0 differ,
and NaN equals NaN.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def equal(a: Any, b: Any) -> bool:
    """Returns True for equal trees. Values of arrays are read only where all else agrees."""
    if a is b:
        return True
    (leaves_a, structure_a), (leaves_b, structure_b) = jax.tree.flatten(a), jax.tree.flatten(b)
    if structure_a != structure_b:
        return False
    pairs = [(x, y) for x, y in zip(leaves_a, leaves_b, strict=True) if x is not y]
    return all(_kind(x) == _kind(y) for x, y in pairs) and all(_same_bits(x, y) for x, y in pairs)


def hashed(tree: Any) -> int:
    """A hash that agrees with `equal` and waits for no device: of arrays it takes the types alone.

    Raises:
        TypeError: a leaf or static field cannot be hashed.
    """
    leaves, structure = jax.tree.flatten(tree)
    return hash((structure, *map(_kind, leaves)))


def _kind(x: Any) -> Any:
    """All of a leaf that is known without a device; a traced value is itself alone."""
    if isinstance(x, Tracer):
        return Tracer, id(x)
    if isinstance(x, jax.Array):
        return jax.Array, x.shape, x.dtype, x.aval.weak_type
    if isinstance(x, np.ndarray):
        return np.ndarray, x.shape, x.dtype
    if isinstance(x, bool | int | float | complex | np.generic):
        return type(x), repr(x)  # tells −0.0 from 0.0, and not NaN from NaN
    return x


def _same_bits(x: Any, y: Any) -> bool:
    """Returns True where two leaves of one kind have the same value."""
    if not isinstance(x, np.ndarray | jax.Array):
        return True  # the kind says it all
    if isinstance(x, jax.Array):
        if jnp.issubdtype(x.dtype, jax.dtypes.extended):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        if not (x.is_fully_addressable and y.is_fully_addressable):
            return False  # a part of them is known to another process alone
    return np.asarray(x).tobytes() == np.asarray(y).tobytes()
