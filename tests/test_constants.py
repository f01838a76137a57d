"""Operations on constants are simplified before a program is cut into stages."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcon.staging import constants, fusion
from jaxcon.staging.batch_last import Native
from jaxcon.staging.constants import Constant
from jaxcon.staging.program import Program

X = np.linspace(-0.7, 1.7, 24).reshape(4, 6)
HALVES = np.arange(4.0)[:, None] / 2


def full(number, x, shape=(4, 6)):
    return jnp.full(shape, number, x.dtype)


def halves(x):
    return jnp.asarray(HALVES, x.dtype)


# functions of an array, and the most operations that are left of them
FUNCTIONS = {
    "0 x": (lambda x: x * full(0, x), 1),
    "x 0": (lambda x: full(0, x) * x, 1),
    "1 x": (lambda x: 1.0 * x, 0),
    "x + 0": (lambda x: x + full(0, x, (4, 1)), 0),
    "0 + x": (lambda x: 0.0 + x, 0),
    "x - 0": (lambda x: x - 0.0, 0),
    "0 - x": (lambda x: 0.0 - x, 1),
    "x / 1": (lambda x: x / full(1, x), 0),
    "1 / x": (lambda x: 1.0 / x, 1),
    "x + ∞": (lambda x: x + jnp.inf, 1),
    "folded": (lambda x: x * (2.0 * full(1, x, (1, 6)) - 1.0), 0),
    "compared": (lambda x: jnp.where(full(4, x, (4, 1)) < 5.0, x, 2 * x), 1),
    "cast": (lambda x: x + jnp.zeros((4, 1), int).astype(x.dtype), 0),
    "transposed": (lambda x: x * full(1, x, (6, 4)).T.reshape(4, 6), 0),
    "other numbers": (lambda x: x * halves(x), 2),
    "one of other numbers": (lambda x: x[2:3] * halves(x)[2:3] + x[:1] * halves(x)[:1], 1),
    "beside": (lambda x: x * jnp.concatenate([full(1, x, (1, 6)), full(1, x, (3, 6))]), 0),
    "slice of a slice": (lambda x: x[1:, 2:][:2, 1:3], 1),
    "twice": (lambda x: x[:1] * x[1:2] + x[1:2] * x[:1], 4),
    "NaN": (lambda x: x + full(0, x, (1, 6)) * jnp.inf, 2),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_products_and_sums_with_constants_are_left_out(name, dtype):
    function, most = FUNCTIONS[name]
    native = Native(lambda x: [function(x).astype(dtype)])
    x = jnp.asarray(X, dtype)
    closed = native.traced((x.shape, x.dtype))
    program = Program(closed, fusion._settled_body)
    assert len(program.operations) <= most
    (found,) = jax.jit(lambda x: fusion.run_staged(native, [x]))(x)
    np.testing.assert_allclose(found, function(x), rtol=1e-6)


NUMBERS = {
    "floats": np.array([[0.0, -0.0, 1.5, -2.25], [np.inf, -np.inf, np.nan, 1e30]]),
    "others": np.array([[0.1, 3.0, -2.0, 1.5], [1.0, np.nan, 0.0, -1e30]]),
    "ints": np.array([[0, -1, 2, 3], [4, 5, -6, 7]], np.int32),
    "flags": np.array([[True, False, True, False], [False, True, True, False]]),
}
ON_CONSTANTS = {
    "transpose": lambda f, g, i, b: f.T,
    "ravel": lambda f, g, i, b: f.ravel(order="F"),
    "reshape": lambda f, g, i, b: f.reshape(4, 2),
    "columns first": lambda f, g, i, b: f.reshape((4, 2), order="F"),
    "squeeze": lambda f, g, i, b: jnp.squeeze(f[:1], 0),
    "every other": lambda f, g, i, b: f[:, ::2],
    "last first": lambda f, g, i, b: f[:, ::-1],
    "wide": lambda f, g, i, b: jnp.broadcast_to(f[:, 1:2], (2, 3)),
    "wide pieces": lambda f, g, i, b: jnp.broadcast_to(f[:, :1], (2, 9))[1:, 3:5],
    "beside": lambda f, g, i, b: jnp.concatenate([f, g], 1),
    "beside wide": lambda f, g, i, b: jnp.concatenate(
        [jnp.broadcast_to(f[:, :1], (2, 5)), jnp.broadcast_to(g[:, 1:2], (2, 5))]
    ),
    "+": lambda f, g, i, b: f + g,
    "-": lambda f, g, i, b: f - g,
    "*": lambda f, g, i, b: f * g,
    "/": lambda f, g, i, b: f / g,
    "integers /": lambda f, g, i, b: jax.lax.div(i, i + 8),
    "negative": lambda f, g, i, b: -f,
    "abs": lambda f, g, i, b: jnp.abs(f),
    "square": lambda f, g, i, b: jnp.square(f),
    "max": lambda f, g, i, b: jnp.maximum(f, g),
    "min": lambda f, g, i, b: jnp.minimum(f, g),
    "is finite": lambda f, g, i, b: jnp.isfinite(f),
    "==": lambda f, g, i, b: f == g,
    "!=": lambda f, g, i, b: f != g,
    "<": lambda f, g, i, b: f < g,
    "<=": lambda f, g, i, b: f <= g,
    ">": lambda f, g, i, b: f > g,
    ">=": lambda f, g, i, b: f >= g,
    "and": lambda f, g, i, b: b & (i > 2),
    "or": lambda f, g, i, b: b | (i > 2),
    "not": lambda f, g, i, b: ~b,
    "bits": lambda f, g, i, b: (i & 3) | ~i,
    "where": lambda f, g, i, b: jnp.where(b, f, g),
    "select": lambda f, g, i, b: jax.lax.select_n(i, f, g, f + g),
    "to float32": lambda f, g, i, b: f.astype(jnp.float32),
    "to integers": lambda f, g, i, b: f.astype(jnp.int32),
    "to bytes": lambda f, g, i, b: g.astype(jnp.uint8),
    "from integers": lambda f, g, i, b: i.astype(jnp.float64),
    "from flags": lambda f, g, i, b: b.astype(jnp.float64),
    "to flags": lambda f, g, i, b: f.astype(bool),
}


@pytest.mark.parametrize("name", ON_CONSTANTS)
def test_constants_are_evaluated_as_xla_does(name):
    def function(*numbers):
        return jnp.ravel(ON_CONSTANTS[name](*numbers))

    numbers = list(map(jnp.asarray, NUMBERS.values()))
    expected = jax.jit(function)(*numbers)
    native = Native(lambda x: [function(*numbers), x])
    found, _ = jax.jit(lambda x: fusion.run_staged(native, [x]))(jnp.asarray(X))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
    if found.dtype == jnp.float64:
        signs = [np.signbit(x) & ~np.isnan(x) for x in (found, expected)]
        np.testing.assert_array_equal(*signs)


def test_a_large_constant_is_not_copied():
    large = jnp.asarray(np.random.default_rng(0).normal(size=(300, 300)))
    native = Native(lambda x: [large[i:200] * x[0, 0] for i in range(10)])
    text = jax.jit(lambda x: fusion.run_staged(native, [x])).lower(jnp.asarray(X)).as_text()
    assert len(text) < 4 * large.size * 16


def test_constant_arrays_are_hidden_from_the_compiler():
    """It would make constants for all worlds; devices take their parts of them by their numbers."""

    def function(x):
        wide = jnp.broadcast_to(jax.lax.rem(full(5, x, (3, 1)), halves(x)[1:]), (3, 128))
        return [jnp.concatenate([full(0, x, (1, 128)), wide])]

    x, native = jnp.ones((4, 128)), Native(function)
    lowered = jax.jit(lambda x: fusion.run_staged(native, [x])).lower(x)
    assert re.search(r"optimization_barrier %\w+ : tensor<3x1xf64>", lowered.as_text())
    np.testing.assert_allclose(lowered.compile()(x)[0], function(x)[0], rtol=1e-15)


def test_equal_constants_are_one():
    wide = [jnp.broadcast_to(jnp.asarray(HALVES), (4, 6)) for _ in range(5)]
    native = Native(lambda x: [sum(x * (k + 2) * w for k, w in enumerate(wide))])
    program = Program(native.traced((X.shape, np.dtype("float64"))), fusion._settled_body)
    assert sum(op.name == "broadcast_in_dim" for op in program.operations) <= 1


def test_a_product_with_a_constant_0_is_0():
    """A known price of short programs, which the documentation names."""
    native = Native(lambda x: [0.0 * x])
    (found,) = jax.jit(lambda x: fusion.run_staged(native, [x]))(jnp.full((4, 6), jnp.nan))
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("index", [0, 1])
def test_branches_know_constants(index):
    def function(index, x):
        branches = [lambda x, c: x * c, lambda x, c: x + c]
        return [jax.lax.switch(index, branches, x, jnp.zeros((4, 6)))]

    native, given = Native(function), [jnp.asarray(index), jnp.asarray(X)]
    closed = native.traced(*((x.shape, x.dtype) for x in given))
    program = Program(closed, fusion._settled_body)
    (branch,) = (op for op in program.operations if op.name == "cond")
    assert len(branch.inputs) == 2
    assert not any("mul" in str(x) or "add" in str(x) for x in branch.params["branches"])
    (found,) = jax.jit(lambda *x: fusion.run_staged(native, x))(*given)
    np.testing.assert_array_equal(found, index * X)


def test_loops_know_constants():
    def function(x):
        zero = jnp.zeros((4, 6))
        count, x = jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] + zero), (0, x))
        return [x]

    native = Native(function)
    closed = native.traced((X.shape, np.dtype("float64")))
    program = Program(closed, fusion._settled_body)
    (loop,) = (op for op in program.operations if op.name == "while")
    assert loop.params["body_nconsts"] == 0
    (found,) = jax.jit(lambda x: fusion.run_staged(native, [x]))(jnp.asarray(X))
    np.testing.assert_array_equal(found, X)


def test_repeated_entries_are_stored_once():
    wide = Constant(np.broadcast_to(HALVES, (4, 10**6)))
    assert wide.number() is None
    assert constants.without_repetition(wide.array()).shape == (4, 1)
    assert Constant(np.broadcast_to(np.float32(3), (10**6, 5))).number() == 3
    assert Constant(np.array([np.nan, np.nan])).number() is None
    assert Constant(jnp.ones(constants.MAX_SIZE + 1)).array() is None
    assert Constant(jax.random.key(0)).array() is None
