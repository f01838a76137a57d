"""A function of named numbers against differences and, by world, against a loop."""

import jax
import jax.numpy as jnp
import numpy as np
from tolerances import DIFFERENCE


def assert_smooth_and_batched(value, numbers, step, close):
    """Gradients are differences of fourth order, relative to the largest; worlds are a loop.

    Args:
        value: from a dict of numbers to a number.
        numbers: where.
        step: of the differences, relative to each number.
        close: what a batch may be off by, relative.
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
    """Gradients by what worlds share, inside of their batch and outside; returns those of a loop.

    Args:
        value: from (shared, of one world) to a number.
        shared: what worlds share.
        own: of each world, by first axis.
        close: what they may be off by, relative.
    """
    alone = np.array([jax.jit(jax.grad(value))(shared, x) for x in own])
    together = jax.jit(jax.vmap(jax.grad(value), (None, 0)))(shared, own)
    np.testing.assert_allclose(together, alone, rtol=close)
    total = jax.jit(jax.grad(lambda x: jnp.sum(jax.vmap(value, (None, 0))(x, own))))(shared)
    np.testing.assert_allclose(total, alone.sum(0), rtol=close)
    return alone
