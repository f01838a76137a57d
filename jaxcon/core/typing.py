"""The few types that signatures share."""

from typing import Any, TypeAlias

import jax

Array: TypeAlias = jax.Array
PyTree: TypeAlias = Any
Lane: TypeAlias = Any
"""One component for many bodies and worlds: an array, or a Python number known when tracing."""
