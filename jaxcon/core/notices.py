"""Warnings of wrong derivatives, each once in a process, and observations of what causes them."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata

from jaxcon.core.typing import Array

_given: set[str] = set()
_collected: ContextVar[list[str] | None] = ContextVar("collected", default=None)
_observing = ContextVar("observing", default=False)
_observations: list[Any] = []


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def when_differentiated(x: Array, message: str) -> Array:
    """Returns x, and warns with the message where a derivative through x is traced."""
    return x


@when_differentiated.defjvp
def _(message: str, primals: Any, tangents: Any) -> tuple[Array, Array]:
    tell(message)
    return primals[0], tangents[0]


def tell(message: str) -> None:
    """Warns with a message that has not been given yet, or adds it to what is `collected`."""
    found = _collected.get()
    if found is not None:
        if message not in found:
            found.append(message)
    elif message not in _given:
        _given.add(message)
        warnings.warn(message, stacklevel=2)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Collects the messages of derivatives that are traced within, in place of warnings."""
    found: list[str] = []
    token = _collected.set(found)
    try:
        yield found
    finally:
        _collected.reset(token)


def is_observing() -> bool:
    """Returns True while programs are traced that report what they meet."""
    return _observing.get()


@contextlib.contextmanager
def observed() -> Iterator[list[Any]]:
    """Collects what the programs that are traced and run within `observe`.

    What was traced before is traced again, and apart from it, since metadata of XLA is among the
    settings by which JAX tells traces apart.
    """
    _observations.clear()
    token = _observing.set(True)
    try:
        with set_xla_metadata(jaxcon_observed="true"):
            yield _observations
    finally:
        _observing.reset(token)


def observe(x: Array, kind: Any, happens: Array, *values: Array) -> Array:
    """Returns x; where any of it happens, adds (kind, happens, *values) to what is `observed`.

    Nothing is traced for it outside `observed`.

    Args:
        x: with an axis before those of the worlds.
        kind: says what the values are.
        happens: booleans with the trailing axes of x.
        values: arrays likewise.
    """
    if not _observing.get():
        return x

    def add(happens: Any, *values: Any) -> Any:
        if np.any(happens):
            _observations.append((kind, *map(np.asarray, (happens, *values))))
        return np.zeros(x.shape[1:], x.dtype)

    result = jax.ShapeDtypeStruct(x.shape[1:], x.dtype)
    given = (happens, *values)
    fixed = [jnp.broadcast_to(y, (*y.shape[: y.ndim - x.ndim + 1], *x.shape[1:])) for y in given]
    fixed = jax.lax.stop_gradient(fixed)
    return x + jax.pure_callback(add, result, *fixed, vmap_method="sequential")[None]
