"""Functions evaluated with NumPy on the host give the values of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from jaxcon.constraints.rank import linearized
from jaxcon.core import host
from jaxcon.core.selection import ZEROS, select_rows, sum_rows

X = np.linspace(-1.7, 2.3, 12).reshape(3, 4)
FUNCTIONS = {
    "arithmetic": lambda x: (x + 2 * x - x / 3, -x, x**2, x**3, x**-2, jnp.maximum(x, 0.3)),
    "roots": lambda x: (jnp.sqrt(abs(x)), jnp.square(x), jnp.power(abs(x), 1.3), jnp.exp(x)),
    "angles": lambda x: (jnp.sin(x), jnp.cos(x), jnp.tan(x), jnp.arctan2(x, 1 + x * x)),
    "inverse": lambda x: (jnp.arcsin(x / 3), jnp.arccos(x / 3), jnp.arctan(x), jnp.tanh(x)),
    "parts": lambda x: (jnp.sign(x), jnp.floor(x), jnp.ceil(x), jnp.round(x), jnp.log(abs(x))),
    "logic": lambda x: ((x > 0) & (x < 1), ~(x >= 1) | (x == x[0, 0]), x != 0, jnp.isfinite(1 / x)),
    "choices": lambda x: (jnp.where(x > 0, x, -x), jnp.select([x > 1, x > 0], [x, 2 * x], 3 * x)),
    "integers": lambda x: (jnp.arange(5) // 2, jnp.arange(-3, 3) % 4, x.astype(int)),
    "shapes": lambda x: (x.T, x.reshape(2, 6), x[:, None], jnp.squeeze(x[:1]), x[::2, 1:3]),
    "columns first": lambda x: (x.ravel(order="F"), x.reshape((2, 6), order="F")),
    "rows": lambda x: (select_rows(x, (2, ZEROS, 0, 0)), sum_rows(x, ((0, 1, 2), (), (1,)))),
    "joined": lambda x: (
        jnp.concatenate([x, x[:1]]),
        jnp.stack([x, x]),
        jnp.pad(x, ((1, 0), (0, 2))),
    ),
    "cut": lambda x: (jnp.split(x, [1], 1), jax.lax.pad(x, x[0, 0], ((-1, 0, 0), (0, 0, 1)))),
    "sums": lambda x: (x.sum(0), x.max(1), x.min(), jnp.all(x > 0), x @ x.T, jnp.cumsum(x, 0)),
    "indexed": lambda x: (x[jnp.array([2, 0])], x.at[1, 2].add(5.0), jnp.eye(3, dtype=x.dtype)),
    "loops": lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y + jnp.sin(y) * i, x),
    "branches": lambda x: jax.lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x),
    "derivatives": lambda x: jax.jvp(lambda y: jnp.linalg.norm(y, axis=0), (x,), (2 * x,)),
    "calls": lambda x: (jax.jit(lambda y: (y, 2 * y))(x), jax.nn.relu(x), jax.nn.silu(x)),
    "batched": lambda x: jax.vmap(lambda row: jnp.dot(row, row))(x),
    "constants": lambda x: (jnp.asarray(X) @ jnp.ones(4), x),
    "unused": lambda x: [jnp.linalg.inv(x @ x.T), 2 * x][1:],
}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_it_is_what_jax_computes(name, dtype):
    x = jnp.asarray(X, dtype)
    got, expected = host.evaluate(FUNCTIONS[name], x), jax.jit(FUNCTIONS[name])(x)
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert isinstance(a, np.ndarray)
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, rtol=40 * float(jnp.finfo(dtype).eps), atol=1e-6)


@pytest.mark.parametrize("name", ["polar", "arm", "mixed-2d", "revolute-3d-loop"])
def test_rows_are_what_jax_computes(name):
    built = scenes.build(name)
    rows, jacobian, mass = linearized(built.system, built.off)
    expected = scenes.linearized(built.system, built.off.q, built.off.v, built.off.time)
    for a, b in zip(jax.tree.leaves(rows), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jacobian, expected.jacobian.dense(), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mass, built.system.mass(built.off.q).dense(), rtol=1e-12)
