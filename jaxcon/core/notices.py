"""Warnings given while a derivative is traced, each once in a process."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import jax

from jaxcon.core.typing import Array

_given: set[str] = set()
_collected: ContextVar[list[str] | None] = ContextVar("collected", default=None)


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
