"""Scans whose reverse pass keeps the start of segments, and steps forward once more within them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core.typing import PyTree

MORE = 1.25
"""How many times the states may be kept for segments that are all whole."""


def equal_levels(steps: int, levels: int) -> tuple[int, ...]:
    """Segments of n^(L−1), …, n steps, n the L-th root of their number rounded up."""
    root = 1
    while root**levels < steps:
        root += 1
    return tuple(root**i for i in range(levels - 1, 0, -1))


def whole_levels(steps: int, levels: int) -> tuple[int, ...]:
    """Nearly the same, but divisors of each other and of the number of steps.

    A last segment that is shorter takes a condition in every step, which fuses with nothing. Where
    no such divisors keep hardly more states, the segments are those of `equal_levels`.
    """
    if steps < 1:
        return ()
    equal, whole, length = equal_levels(steps, levels), [], steps
    for size in equal:
        length = min(_divisors(length), key=lambda n: abs(math.log(n / size)))
        whole.append(length)
    return tuple(whole) if sum(kept(steps, whole)) <= MORE * sum(kept(steps, equal)) else equal


def _divisors(n: int) -> list[int]:
    """Returns the divisors of a number, itself among them."""
    small = [i for i in range(1, math.isqrt(n) + 1) if n % i == 0]
    return [*small, *(n // i for i in small)]


def kept(steps: int, sizes: Sequence[int]) -> tuple[int, ...]:
    """How many states the reverse pass keeps at most, by level; the last are those of steps."""
    bounds = (steps, *(size for size in sizes if size < steps), 1)
    return tuple(-(-a // b) for a, b in itertools.pairwise(bounds))


def bytes_of(tree: PyTree) -> int:
    """Returns the bytes of all leaves."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def nested(
    body: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    inputs: PyTree,
    length: int,
    sizes: Sequence[int],
    fresh: Callable[[Any], Any] = lambda carry: carry,
) -> tuple[Any, PyTree]:
    """`lax.scan` whose reverse pass keeps the carry at the start of segments within segments.

    Args:
        body: (carry, input) → (carry, output).
        carry: at the start.
        inputs: by first axis, as many as the length.
        length: how often.
        sizes: of the segments; the last of each level may be shorter.
        fresh: what of the carry a segment needs.

    Returns:
        The last carry, and the outputs by first axis.
    """
    sizes = [size for size in sizes if size < length]
    if not sizes:
        return jax.lax.scan(body, carry, inputs, length)
    size, count = sizes[0], -(-length // sizes[0])
    if count * size != length:
        body, inputs = _padded(body, carry, inputs, length, count * size)

    def segment(carry: Any, inputs: PyTree) -> tuple[Any, PyTree]:
        return nested(body, fresh(carry), inputs, size, sizes[1:], fresh)

    again = jax.checkpoint(segment, prevent_cse=False)
    carry, outputs = jax.lax.scan(again, carry, split(inputs, count, size), count)
    merged = jax.tree.map(lambda x: x.reshape((count * size, *x.shape[2:]))[:length], outputs)
    return carry, merged


def _padded(body: Any, carry: Any, inputs: PyTree, length: int, whole: int) -> tuple[Any, PyTree]:
    """A body that does nothing beyond the length, and inputs that reach to a whole segment."""
    place = jnp.arange(whole)
    inputs = jax.tree.map(lambda x: x[jnp.minimum(place, length - 1)], inputs)
    first = jax.tree.map(lambda x: x[0], inputs)
    outputs = jax.eval_shape(body, carry, first)[1]

    def rest(carry: Any, given: Any) -> tuple[Any, PyTree]:
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), outputs)

    def until(carry: Any, given: Any) -> tuple[Any, PyTree]:
        return jax.lax.cond(given[0], body, rest, carry, given[1])

    return until, (place < length, inputs)


def split(inputs: PyTree, count: int, size: int) -> PyTree:
    """The first axis as two."""
    return jax.tree.map(lambda x: x.reshape((count, size, *x.shape[1:])), inputs)
