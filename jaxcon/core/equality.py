"""Equality and hashes of pytrees, for use as static arguments or keys.

Two trees are equal if their structures are equal and their leaves have equal types and bits. Thus 5
and 5.0 differ, and NaN equals NaN. A function that is traced with equal trees as constants gives
the same program.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxcon.core.typing import PyTree


def equal(a: PyTree, b: PyTree) -> bool:
    """Returns True if two trees are equal; reads array values only if everything else agrees."""
    if a is b:
        return True
    (leaves_a, structure_a), (leaves_b, structure_b) = jax.tree.flatten(a), jax.tree.flatten(b)
    if structure_a != structure_b:
        return False
    pairs = [(x, y) for x, y in zip(leaves_a, leaves_b, strict=True) if x is not y]
    return all(_kind(x) == _kind(y) for x, y in pairs) and all(_same_bits(x, y) for x, y in pairs)


def hashed(tree: PyTree) -> int:
    """Returns a hash consistent with `equal`, without reading array values from a device.

    Raises:
        TypeError: a leaf or static field cannot be hashed.
    """
    leaves, structure = jax.tree.flatten(tree)
    return hash((structure, *map(_kind, leaves)))


def _kind(x: PyTree) -> Any:
    """Returns the type and properties of a leaf, without reading array values from a device.

    A number that is not an array is represented by its value, and a tracer by its identity.
    """
    if isinstance(x, Tracer):
        return Tracer, id(x)
    if isinstance(x, jax.Array):
        return jax.Array, x.shape, x.dtype, x.aval.weak_type
    if isinstance(x, np.ndarray):
        return np.ndarray, x.shape, x.dtype
    if isinstance(x, bool | int | float | complex | np.generic):
        return type(x), repr(x)  # repr distinguishes −0.0 from 0.0, and makes NaN equal NaN
    return x


def _same_bits(x: PyTree, y: PyTree) -> bool:
    """Returns True if two leaves have equal bits, given that their `_kind` is equal."""
    if not isinstance(x, np.ndarray | jax.Array):
        return True  # `_kind` has compared the values
    if isinstance(x, jax.Array) and isinstance(y, jax.Array):
        if jnp.issubdtype(x.dtype, jax.dtypes.extended):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        if not (x.is_fully_addressable and y.is_fully_addressable):
            return False  # parts on devices of other processes cannot be read
    return np.asarray(x).tobytes() == np.asarray(y).tobytes()
