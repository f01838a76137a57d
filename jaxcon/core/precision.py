"""Computation in a chosen floating precision, whatever the configuration of JAX."""

from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxcon.core.typing import T


def precision(dtype: DTypeLike) -> AbstractContextManager[Any]:
    """Returns a context in which float64 is enabled in JAX if and only if `dtype` is float64."""
    return jax.enable_x64(np.dtype(dtype) == np.float64)


def cast(tree: T, dtype: DTypeLike) -> T:
    """Casts the floating arrays of a tree to a dtype; call it within `precision(dtype)`."""
    return jax.tree.map(
        lambda x: (
            jnp.asarray(np.asarray(x), dtype)
            if isinstance(x, jax.Array | np.ndarray | np.generic)
            and jnp.issubdtype(x.dtype, jnp.floating)
            else x
        ),
        tree,
    )
