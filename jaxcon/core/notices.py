"""Warnings about inexact derivatives, each given once in a process, and recorded observations.

An observation is a set of values that a running program reports to the host.
"""

import contextlib
import functools
import warnings
from collections.abc import Hashable, Iterator
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
    """Returns x; gives a warning with this message when JAX traces a derivative through x."""
    return x


@when_differentiated.defjvp
def _(message: str, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    tell(message)
    return primals[0], tangents[0]


def tell(message: str) -> None:
    """Gives a warning, but only once per process; within `collected`, records it instead."""
    messages = _collected.get()
    if messages is not None:
        if message not in messages:
            messages.append(message)
    elif message not in _given:
        _given.add(message)
        warnings.warn(message, stacklevel=2)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Collects the messages of `tell` within this context in a list, instead of warning."""
    messages: list[str] = []
    token = _collected.set(messages)
    try:
        yield messages
    finally:
        _collected.reset(token)


def is_observing() -> bool:
    """Returns True within the context `observed`, where traced programs report observations."""
    return _observing.get()


@contextlib.contextmanager
def observed() -> Iterator[list[Any]]:
    """Collects the observations of programs that are traced and run within this context.

    The context sets XLA metadata, which is part of the key of JAX's trace cache. Programs are
    therefore traced anew in this context, and their earlier traces stay in the cache unchanged.
    """
    _observations.clear()
    token = _observing.set(True)
    try:
        with set_xla_metadata(jaxcon_observed="true"):
            yield _observations
    finally:
        _observing.reset(token)


def observe(x: Array, kind: Hashable, happens: Array, *values: Array) -> Array:
    """Returns x; within the context `observed`, also reports values to the host at run time.

    If `happens` is True anywhere, the tuple (kind, happens, *values) is added to the observations.
    Outside of the context, nothing is added to the traced program.

    Args:
        x: an array with one axis before the batch axes.
        kind: a label of the observation.
        happens: a mask, whose last axes are the batch axes of x.
        values: arrays, whose last axes are the batch axes of x.
    """
    if not _observing.get():
        return x

    def add(happens: np.ndarray, *values: np.ndarray) -> np.ndarray:
        if np.any(happens):
            _observations.append((kind, *map(np.asarray, (happens, *values))))
        return np.zeros(x.shape[1:], x.dtype)

    result = jax.ShapeDtypeStruct(x.shape[1:], x.dtype)
    given = (happens, *values)
    fixed = [jnp.broadcast_to(y, (*y.shape[: y.ndim - x.ndim + 1], *x.shape[1:])) for y in given]
    fixed = jax.lax.stop_gradient(fixed)
    return x + jax.pure_callback(add, result, *fixed, vmap_method="sequential")[None]
