"""Starts of searches: the one given, and random ones around it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array
from jaxcon.learning.leaves import Space, by_name


def scattered(
    space: Space, y: tuple[Array, ...], restarts: int, spread: Any, key: Any, owner: str
) -> tuple[Array, ...]:
    """The start and others around it, with a first axis of starts.

    Args:
        space: of the parameters.
        y: the start.
        restarts: how many, the one given included.
        spread: standard deviation of y, a number or a mapping from names; or arrays that broadcast
            to the shape of a leaf.
        key: of random numbers.
        owner: for errors.

    Raises:
        ValueError: a deviation that is none or of another shape, or several starts at one place.
    """
    values = spread if isinstance(spread, Mapping) else {"*": spread}
    widths = by_name(values, space.names, 0.0, f"{owner}: spread")
    for name, width, x in zip(space.names, widths, y, strict=True):
        checks.check(owner, "spread", width, least=0)
        if not checks.fits(np.shape(width), x.shape):
            raise ValueError(
                f"{owner}: spread must be a number, or an array that broadcasts to the shape"
                f" {x.shape} of '{name}', got {np.shape(width)}."
            )
    batch = [jnp.broadcast_to(x, (restarts, *x.shape)) for x in y]
    if restarts == 1:
        return tuple(batch)
    if not any(np.any(np.asarray(w)) for w in widths):
        raise ValueError(
            f"{owner}: restarts from one place find one thing: give spread=, such as 0.5."
        )
    keys = jax.random.split(key, len(batch))
    noise = [
        jax.random.normal(k, x.shape, x.dtype).at[0].set(0)
        * jnp.broadcast_to(jnp.asarray(w, x.dtype), x.shape)
        for k, x, w in zip(keys, batch, widths, strict=True)
    ]
    return jax.vmap(space.clip)(tuple(map(jnp.add, batch, noise)))


def check_key(key: Any, needed: bool, owner: str) -> None:
    """Checks that there is a key of random numbers where they are drawn.

    Raises:
        ValueError: there is none.
        TypeError: it is something else.
    """
    if key is None and needed:
        raise ValueError(
            f"{owner}: samples and restarts draw random numbers: give key=jax.random.key(0)."
        )
    if key is not None and not isinstance(key, jax.Array):
        raise TypeError(f"{owner}: key must be one of jax.random.key(0), got {key!r}.")
    if key is not None and key.ndim != (not jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"{owner}: key must be a single one, got an array {key.shape} of keys.")
