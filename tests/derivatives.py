"""Checks of the gradients of a function of named numbers, and of its batches."""

import jax
import jax.numpy as jnp
import numpy as np
from tolerances import DIFFERENCE


def assert_smooth_and_batched(value, numbers, step, close):
    """Compares gradients with fourth-order differences, and a batch with a loop over its worlds.

    Args:
        value: function from a dict of numbers to a number.
        numbers: the point at which derivatives are taken.
        step: step of the differences, relative to each number.
        close: relative tolerance of the batch.
    """
    x = {key: jnp.asarray(number) for key, number in numbers.items()}
    run, gradient = jax.jit(value), jax.jit(jax.grad(value))(x)
    scale = max(abs(float(gradient[key] * x[key])) for key in x)
    for key in x:
        at = [float(run(x | {key: x[key] * (1 + s * step)})) for s in (2, 1, -1, -2)]
        slope = (8 * (at[1] - at[2]) - (at[0] - at[3])) / (12 * step)
        assert abs(float(gradient[key] * x[key]) - slope) < DIFFERENCE * scale, key
    worlds = {key: jnp.stack([number, 1.05 * number]) for key, number in x.items()}
    one_by_one = [run({key: number[i] for key, number in worlds.items()}) for i in (0, 1)]
    got = jax.jit(jax.vmap(value))(worlds)
    np.testing.assert_allclose(got, jnp.stack(one_by_one), rtol=close)


def assert_batched_either_way(value, shared, own, close):
    """Checks gradients by shared numbers, taken inside and outside a batch.

    Returns those of a loop.

    Args:
        value: function (shared, own of one world) → number.
        shared: the numbers that all worlds share.
        own: the numbers of each world, along the first axis.
        close: relative tolerance.
    """
    alone = np.array([jax.jit(jax.grad(value))(shared, x) for x in own])
    together = jax.jit(jax.vmap(jax.grad(value), (None, 0)))(shared, own)
    np.testing.assert_allclose(together, alone, rtol=close)
    total = jax.jit(jax.grad(lambda x: jnp.sum(jax.vmap(value, (None, 0))(x, own))))(shared)
    np.testing.assert_allclose(total, alone.sum(0), rtol=close)
    return alone
