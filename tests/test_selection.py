"""Rows chosen when tracing, and their sums, against NumPy; see `core/selection.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcon.core.selection import ZEROS, select_rows, select_rows_p, sum_rows

X = np.random.default_rng(0).normal(size=(7, 3))
MANY = tuple(int(i) for i in np.random.default_rng(1).integers(ZEROS, 7, 40))
PLACES = [
    (0, 1, 2),
    (0, 1, 2, 3, 4, 5, 6),
    (4,),
    (2, 4, 6),
    (6, 4, 2),
    (6, 5, 4),
    (3, 3, 3),
    (0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5),
    (1, ZEROS, 2, 2, 5),
    (ZEROS, 0, 1),
    (ZEROS, ZEROS),
    MANY,
]
SOURCES = [
    ((0,), (1,), (2,), (3,), (4,), (5,), (6,)),
    ((0, 1, 2, 3, 4, 5, 6),),
    ((0, 1, 2, 3, 4), (5,), (), (6, 6), (1, 2, 3)),
    ((), ()),
    tuple(tuple(int(i) for i in np.random.default_rng(k).integers(0, 7, k)) for k in range(12)),
]


def selected(x, places):
    return np.stack([x[p] if p != ZEROS else np.zeros_like(x[0]) for p in places])


def spread(y, places, rows):
    x = np.zeros((rows, *y.shape[1:]))
    for row, place in enumerate(places):
        if place != ZEROS:
            x[place] += y[row]
    return x


@pytest.mark.parametrize("places", PLACES, ids=str)
def test_rows_are_selected_in_every_transformation(places):
    def select(x):
        return select_rows(x, places)

    x, y = jnp.asarray(X), np.random.default_rng(2).normal(size=(len(places), 3))
    expected = selected(X, places)
    np.testing.assert_array_equal(select(x), expected)
    np.testing.assert_array_equal(jax.jit(select)(x), expected)
    np.testing.assert_array_equal(jax.jvp(select, (x,), (2 * x,))[1], 2 * expected)
    (back,) = jax.vjp(select, x)[1](jnp.asarray(y))
    np.testing.assert_allclose(back, spread(y, places, 7), rtol=1e-14, atol=1e-15)
    for axis in range(3):
        batch = jnp.stack([x, 2 * x], axis)
        found = jax.vmap(select, axis)(batch)
        np.testing.assert_array_equal(found, [expected, 2 * expected])
    hessian = jax.hessian(lambda x: jnp.sum(select(x) ** 2))(x)
    counts = spread(np.ones((len(places), 3)), places, 7)
    np.testing.assert_allclose(hessian.reshape(21, 21), np.diag(2 * counts.ravel()), atol=1e-14)


@pytest.mark.parametrize("sources", SOURCES, ids=lambda s: f"{len(s)} sums")
def test_sums_are_those_of_the_rows(sources):
    found = sum_rows(jnp.asarray(X), sources)
    expected = np.stack([X[list(s)].sum(axis=0) for s in sources])
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-15)


def test_a_selection_of_everything_is_the_array_itself():
    x = jnp.asarray(X)
    assert select_rows(x, range(7)) is x


def test_derivatives_hold_neither_scatters_nor_padded_arrays():
    def loss(x):
        return jnp.sum(sum_rows(select_rows(x, MANY) ** 2, SOURCES[2]))

    text = jax.jit(jax.grad(loss)).lower(jnp.asarray(X)).as_text()
    assert "scatter" not in text
    assert "stablehlo.pad" not in text
    assert select_rows_p.name in str(jax.make_jaxpr(jax.grad(loss))(jnp.asarray(X)))


def test_places_beyond_the_array_are_refused():
    for places in ((7,), (0, -2)):
        with pytest.raises(IndexError, match="7 rows"):
            select_rows(jnp.asarray(X), places)


def test_nothing_can_be_selected():
    assert select_rows(jnp.asarray(X), ()).shape == (0, 3)
    assert sum_rows(jnp.asarray(X), ()).shape == (0, 3)
    gradient = jax.grad(lambda x: jnp.sum(select_rows(x, (ZEROS, ZEROS))))(jnp.zeros((0, 3)))
    assert gradient.shape == (0, 3)
