"""Large batches are simulated in chunks of worlds, with the same values and derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

from jaxcon.staging import chunks

MOST = 4
STEPS = 5
SHARED = jnp.asarray([0.7, -0.4])


def motion(x, shared, most=MOST):
    """A motion of one world: its end, and two numbers of each step. Nothing of it is linear."""

    def run():
        def step(state, i):
            state = jnp.sin(shared[0] * state + x) + shared[1] * i
            return state, jnp.stack([state, state * shared[1]])

        return jax.lax.scan(step, x, jnp.arange(STEPS) / STEPS)

    return chunks.by_world(run, most) if most else run()


def loss(x, shared, most=MOST):
    end, path = motion(x, shared, most)
    return end**2 + jnp.sum(path**3) + shared[0] * end


def total(x, shared, most=MOST):
    return jnp.sum(jax.vmap(partial(loss, most=most), (0, None))(x, shared))


def several(x, shared, most):
    """A batch of batches: the first has its own shared values, the second its own worlds."""
    return jax.vmap(lambda a: jax.vmap(lambda b: motion(b, a, most))(x))(
        jnp.stack([shared, -shared, 2 * shared])
    )


def population(x, shared, most):
    all_shared = jnp.outer(jnp.linspace(0.5, 1, 3), shared)
    return jnp.sum(jax.vmap(lambda a: total(x, a, most))(all_shared) ** 2)


TRANSFORMED = {
    "vmap": lambda x, a, most: jax.vmap(lambda x: motion(x, a, most))(x),
    "vmap, last axis": lambda x, a, most: jax.vmap(
        lambda x: jax.vmap(lambda x: motion(x, a, most), in_axes=-1, out_axes=-1)(x)
    )(jnp.stack([x, 2 * x])),
    "vmap(vmap)": several,
    "vmap(grad)": lambda x, a, most: jax.vmap(
        jax.grad(partial(loss, most=most), (0, 1)), (0, None)
    )(x, a),
    "vmap(grad) by shared values alone": lambda x, a, most: jax.vmap(
        jax.grad(partial(loss, most=most)), (None, 0)
    )(x[0], jnp.outer(x, a)),
    "grad(vmap)": lambda x, a, most: jax.grad(partial(total, most=most), (0, 1))(x, a),
    "grad(vmap(vmap))": lambda x, a, most: jax.grad(partial(population, most=most), (0, 1))(x, a),
    "vmap(grad(vmap))": lambda x, a, most: jax.vmap(
        jax.grad(partial(total, most=most), (0, 1)), (None, 0)
    )(x, jnp.stack([a, 2 * a, -a])),
    "jvp": lambda x, a, most: jax.jvp(partial(total, most=most), (x, a), (x + 1, a - 1)),
    "linearize": lambda x, a, most: jax.linearize(partial(total, most=most), x, a)[1](x + 1, a - 1),
    "vmap(jvp)": lambda x, a, most: jax.vmap(
        lambda t: jax.jvp(partial(total, most=most), (x, a), (t * x, t * a))
    )(jnp.arange(3.0)),
    "hessian": lambda x, a, most: jax.hessian(partial(total, most=most), (0, 1))(x, a),
    "grad(grad)": lambda x, a, most: jax.jacrev(jax.jacrev(partial(total, most=most), 1), (0, 1))(
        x, a
    ),
    "grad(jvp)": lambda x, a, most: jax.grad(
        lambda a: jax.jvp(partial(total, most=most), (x, a), (x + 1, a - 1))[1]
    )(a),
    "checkpoint": lambda x, a, most: jax.grad(jax.checkpoint(partial(total, most=most)), (0, 1))(
        x, a
    ),
    "scan": lambda x, a, most: jax.grad(
        lambda a: jnp.sum(
            jax.lax.scan(
                lambda x, _: (jax.vmap(partial(loss, most=most), (0, None))(x, a), None),
                x,
                length=2,
            )[0]
        )
    )(a),
    "cond": lambda x, a, most: jax.grad(
        lambda a: jax.lax.cond(x[0] < 2, partial(total, most=most), lambda x, a: a[0], x, a)
    )(a),
    "some results": lambda x, a, most: jax.grad(
        lambda a: jnp.sum(jax.vmap(lambda x: motion(x, a, most)[1])(x))
    )(a),
}


@pytest.mark.parametrize("worlds", [1, MOST, MOST + 1, 5 * MOST + 2])
@pytest.mark.parametrize("name", TRANSFORMED)
def test_chunks_change_no_value_and_no_derivative(name, worlds):
    x = jnp.linspace(-1.0, 1.0, worlds)
    function = TRANSFORMED[name]
    expected = jax.jit(partial(function, most=0))(x, SHARED)
    for got in (jax.jit(partial(function, most=MOST))(x, SHARED), function(x, SHARED, MOST)):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, IDENTITY, IDENTITY * worlds),
            got,
            expected,
        )
