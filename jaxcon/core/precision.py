"""Numbers of a chosen precision, whatever the configuration of JAX says."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core.typing import PyTree


def precision(dtype: Any) -> AbstractContextManager[Any]:
    """Within it float64 is there where `dtype` is that, and float32 is the default elsewhere."""
    return jax.enable_x64(np.dtype(dtype) == np.float64)


def cast(tree: PyTree, dtype: Any) -> PyTree:
    """A tree with its arrays of real numbers in another precision, within `precision(dtype)`."""

    def one(x: Any) -> Any:
        if isinstance(x, jax.Array | np.ndarray | np.generic) and jnp.issubdtype(
            x.dtype, jnp.floating
        ):
            return jnp.asarray(np.asarray(x), dtype)
        return x

    return jax.tree.map(one, tree)
