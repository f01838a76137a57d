"""Starts of a search: the user's initial parameters, and random ones around them."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.typing import Array, Scalar
from jaxcon.learning.leaves import Space, by_name


def scattered(
    space: Space,
    y: tuple[Array, ...],
    restarts: int,
    spread: Scalar | Mapping[str, Scalar],
    key: Array | None,
    owner: str,
) -> tuple[Array, ...]:
    """Returns the user's start and random starts around it, stacked along a first axis.

    Args:
        space: search coordinates of the parameters, with their bounds.
        y: search coordinates of the user's start.
        restarts: number of starts, including the user's start.
        spread: standard deviation of the random starts in y: a number, an array that broadcasts to
            each leaf, or a mapping from names to numbers or arrays.
        key: random key.
        owner: name of the caller, for error messages.

    Raises:
        ValueError: the spread is invalid, has a wrong shape, or is zero although there are several
            starts.
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
    assert key is not None
    keys = jax.random.split(key, len(batch))
    noise = [
        jax.random.normal(k, x.shape, x.dtype).at[0].set(0)
        * jnp.broadcast_to(jnp.asarray(w, x.dtype), x.shape)
        for k, x, w in zip(keys, batch, widths, strict=True)
    ]
    return jax.vmap(space.clip)(tuple(map(jnp.add, batch, noise)))


def check_key(key: Array | None, needed: bool, owner: str) -> None:
    """Checks a random key.

    Raises:
        ValueError: a key is needed, but none is given.
        TypeError: `key` is not a key, or is an array of keys.
    """
    if key is None and needed:
        raise ValueError(
            f"{owner}: samples and restarts draw random numbers: give key=jax.random.key(0)."
        )
    if key is not None:
        checks.random_key(owner, "key", key)
