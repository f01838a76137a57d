"""Checkpointed scans: the reverse pass keeps segment starts and recomputes the steps in between."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxcon.core.typing import Array, PyTree

C = TypeVar("C")
"""Type variable of a scan's carry."""

MORE = 1.25
"""The largest factor by which segments of equal length may increase the number of kept states."""


def equal_levels(steps: int, levels: int) -> tuple[int, ...]:
    """Returns segment lengths n^(L−1), …, n [steps], with n = ⌈steps^(1/L)⌉ and L = `levels`."""
    root = 1
    while root**levels < steps:
        root += 1
    return tuple(root**i for i in range(levels - 1, 0, -1))


def whole_levels(steps: int, levels: int) -> tuple[int, ...]:
    """Returns segment lengths close to `equal_levels` that divide each other and `steps`.

    A shorter last segment would need a conditional in every step, which XLA cannot fuse. If
    dividing lengths would keep more than `MORE` times as many states, the result is that of
    `equal_levels`.
    """
    if steps < 1:
        return ()
    equal, whole, length = equal_levels(steps, levels), [], steps
    for size in equal:
        length = min(_divisors(length), key=lambda n: abs(math.log(n / size)))
        whole.append(length)
    return tuple(whole) if sum(kept(steps, whole)) <= MORE * sum(kept(steps, equal)) else equal


def _divisors(n: int) -> list[int]:
    """Returns all divisors of n, including 1 and n."""
    small = [i for i in range(1, math.isqrt(n) + 1) if n % i == 0]
    return [*small, *(n // i for i in small)]


def kept(steps: int, sizes: Sequence[int]) -> tuple[int, ...]:
    """Returns the largest number of states that each level of checkpoints keeps, outermost first.

    The last level keeps one state for each step of its segment.

    Args:
        steps: number of steps.
        sizes: segment lengths [steps], from the outermost level to the innermost.
    """
    bounds = (steps, *(size for size in sizes if size < steps), 1)
    return tuple(-(-a // b) for a, b in itertools.pairwise(bounds))


def bytes_of(tree: PyTree) -> int:
    """Returns the total size of all leaves of a tree [B]."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def nested(
    body: Callable[[C, Any], tuple[C, Any]],
    carry: C,
    inputs: PyTree,
    length: int,
    sizes: Sequence[int],
    fresh: Callable[[C], C] = lambda carry: carry,
) -> tuple[C, Any]:
    """Scans with nested checkpoints: the reverse pass keeps only the carry at segment starts.

    Args:
        body: function (carry, input) → (carry, output).
        carry: the initial carry.
        inputs: inputs with a first axis of `length`.
        length: number of steps.
        sizes: segment lengths, from the outermost level to the innermost. The last segment of a
            level may be shorter.
        fresh: function carry → carry, applied at segment starts. It drops the parts of the carry
            that a segment need not keep.

    Returns:
        The last carry, and the outputs with a first axis of `length`.
    """
    sizes = [size for size in sizes if size < length]
    if not sizes:
        return jax.lax.scan(body, carry, inputs, length)
    size, count = sizes[0], -(-length // sizes[0])
    if count * size != length:
        body, inputs = _padded(body, carry, inputs, length, count * size)

    def segment(carry: C, inputs: PyTree) -> tuple[C, Any]:
        return nested(body, fresh(carry), inputs, size, sizes[1:], fresh)

    again = jax.checkpoint(segment, prevent_cse=False)
    carry, outputs = jax.lax.scan(again, carry, split(inputs, count, size), count)
    merged = jax.tree.map(lambda x: x.reshape((count * size, *x.shape[2:]))[:length], outputs)
    return carry, merged


def _padded(
    body: Callable[[C, Any], tuple[C, Any]], carry: C, inputs: PyTree, length: int, whole: int
) -> tuple[Callable[[C, Any], tuple[C, Any]], Any]:
    """Pads a scan to `whole` steps.

    Returns:
        A body that does nothing from step `length` on, and the padded inputs.
    """
    place = jnp.arange(whole)
    inputs = jax.tree.map(lambda x: x[jnp.minimum(place, length - 1)], inputs)
    first = jax.tree.map(lambda x: x[0], inputs)
    outputs = jax.eval_shape(body, carry, first)[1]

    def rest(carry: C, _: PyTree) -> tuple[C, Any]:
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), outputs)

    def until(carry: C, inputs: tuple[Array, PyTree]) -> tuple[C, Any]:
        return jax.lax.cond(inputs[0], body, rest, carry, inputs[1])

    return until, (place < length, inputs)


def split(inputs: PyTree, count: int, size: int) -> PyTree:
    """Splits the first axis of all inputs in two, (count, size, …)."""
    return jax.tree.map(lambda x: x.reshape((count, size, *x.shape[1:])), inputs)
