"""`where_wanted` evaluates a function in chosen worlds of a batch and keeps the other values."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.staging import worlds

BATCHES = [(), (1,), (5,), (64,), (67, 1), (5, 13)]


def squares(args):
    """Returns x² + 2 y, and whether the first x is positive."""
    x, shared, y = args
    return x * x + shared * y, x[0] > 0


def arguments(batch):
    random = np.random.default_rng(3)
    x = jnp.asarray(random.normal(size=(3, *batch)))
    return x, jnp.full((1,) * (1 + len(batch)), 2.0), jnp.asarray(random.normal(size=batch))[None]


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_worlds_get_what_they_want_and_others_what_is_given(batch, share):
    args = arguments(batch)
    wanted = jnp.asarray(np.random.default_rng(5).uniform(size=batch) < share)
    others = jnp.full((3, *batch), 7.0), jnp.zeros(batch, bool)

    def found(x, y):
        return worlds.where_wanted(wanted, squares, (x, args[1], y), others)

    def expected(x, y):
        return worlds.where_tree(wanted, squares((x, args[1], y)), others)

    given = args[0], args[2]
    for a, b in zip(jax.jit(found)(*given), expected(*given), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-14)
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = (mode(lambda *x, f=f: f(*x)[0], argnums=(0, 1))(*given) for f in (found, expected))
        for a, b in zip(*slopes, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14)


def test_few_worlds_are_evaluated_for_few():
    """On one CPU, 64 worlds are evaluated in chunks of 8; chunks without a choice are skipped."""
    in_chunks = jax.default_backend() == "cpu" and jax.device_count() == 1
    seen = []

    def function(args):
        jax.debug.callback(lambda x: seen.append(np.shape(x)), args[0])
        return squares(args)

    args = arguments((64,))
    others = jnp.zeros((3, 64)), jnp.zeros(64, bool)
    for count, parts in ((0, 0), (1, 1), (8, 1), (9, 2), (64, 8)):
        seen.clear()
        wanted = jnp.asarray(np.random.default_rng(0).permutation(64) < count)
        jax.block_until_ready(jax.jit(partial(worlds.where_wanted, wanted, function))(args, others))
        jax.effects_barrier()
        whole = [(3, 64)] * min(parts, 1)
        assert seen == ([(3, 8)] * parts if in_chunks else whole)


def test_landings_of_some_worlds_are_those_of_each_alone():
    """Compares final states and reverse derivatives of forty balls that land one after another."""
    scene = jc.Scene(dim=3)
    scene.add_body("ball", mass=1.3, inertia=(0.005,) * 3, position=(0.0, 0.0, 0.6))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", friction=0.5, radius=0.1))
    system, state = scene.build()
    method = jc.Method()

    def end(height, speed):
        q, v = state.q.at[2].set(height), state.v.at[0].set(speed)
        final, _ = jc.rollout(system, method, jc.init(system, method, q, v), None, 2e-3, 40)
        return jnp.concatenate([final.q, final.v])

    heights = jnp.linspace(0.1, 0.12, 40).at[7].set(0.4)
    speeds = jnp.linspace(0.5, 2.0, 40)

    def derivatives(h, u):
        found, pull = jax.vjp(end, h, u)
        return found, pull(jnp.arange(1.0, 14.0))

    together = jax.jit(jax.vmap(derivatives))(heights, speeds)
    alone = jax.jit(derivatives)
    for i in (0, 7, 20, 39):
        expected = alone(heights[i], speeds[i])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-9, atol=1e-11)
