import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

from jaxcon.core.lanes import Vector
from jaxcon.linear.jacobian import Block, Columns, Jacobian


@pytest.fixture
def small():
    """Four rows on bodies 0 and 2, one on body 1; column 0 belongs to other coordinates."""
    columns = Columns(start=1, components=2, bodies=3, indices=(0, 2))
    one, two = jnp.asarray([1.0, 2.0]), jnp.asarray([3.0, 4.0])
    block = Block((Vector(one, 0.0), Vector(1.0, two)), 0, columns)
    other = Block((Vector(jnp.asarray([5.0]), jnp.asarray([6.0])),), 4, Columns(1, 2, 3, (1,)))
    return Jacobian((block, other), (5, 7))


EXPECTED = np.array(
    [
        # other, x0, x1, x2, y0, y1, y2
        [0, 1, 0, 0, 0, 0, 0],
        [0, 0, 0, 2, 0, 0, 0],
        [0, 1, 0, 0, 3, 0, 0],
        [0, 0, 0, 1, 0, 0, 4],
        [0, 0, 5, 0, 0, 6, 0],
    ],
    float,
)


def test_dense_has_each_entry_in_its_place(small):
    np.testing.assert_array_equal(small.dense(), EXPECTED)


def test_products_by_hand(small):
    v, multipliers = np.arange(1.0, 8.0), np.arange(1.0, 6.0)
    np.testing.assert_allclose(small.apply(jnp.asarray(v)), EXPECTED @ v)
    np.testing.assert_allclose(small.transpose(jnp.asarray(multipliers)), EXPECTED.T @ multipliers)


@pytest.mark.parametrize("open_", [(), (0,), (0, 1), (1, 3), (2, 3, 4), (0, 1, 2, 3, 4)])
def test_rows_that_are_not_kept_are_zero(small, open_):
    kept = ~np.isin(np.arange(5), open_)
    only = small.only(kept, jnp.zeros(5))
    expected = EXPECTED * kept[:, None]
    np.testing.assert_array_equal(only.dense(), expected)
    v = np.arange(1.0, 8.0)
    np.testing.assert_allclose(only.apply(jnp.asarray(v)), expected @ v)


def test_blocks_on_the_same_rows_add():
    a = Block((Vector(jnp.asarray([2.0])),), 0, Columns(0, 1, 2, (0,)))
    b = Block((Vector(jnp.asarray([3.0])),), 0, Columns(0, 1, 2, (1,)))
    jacobian = Jacobian((a, b), (1, 2))
    np.testing.assert_array_equal(jacobian.dense(), [[2, 3]])
    np.testing.assert_array_equal(jacobian.apply(jnp.asarray([1.0, 10.0])), [32])


def test_no_rows():
    empty = Jacobian((), (0, 3))
    assert empty.dense().shape == (0, 3)
    assert empty.apply(jnp.ones(3)).shape == (0,)
    np.testing.assert_array_equal(empty.transpose(jnp.ones(0)), np.zeros(3))


@pytest.mark.parametrize("name", scenes.SELECTED)
def test_products_are_those_of_the_dense_matrix(name):
    built = scenes.build(name)
    rows = scenes.linearized(built.system, built.off.q, built.off.v, built.off.time)
    dense = np.asarray(rows.jacobian.dense())
    random = scenes.seeded(name, "jacobian")
    v, multipliers = random.normal(size=dense.shape[1]), random.normal(size=dense.shape[0])
    np.testing.assert_allclose(rows.jacobian.apply(jnp.asarray(v)), dense @ v, atol=IDENTITY)
    pull = rows.jacobian.transpose(jnp.asarray(multipliers))
    np.testing.assert_allclose(pull, dense.T @ multipliers, rtol=IDENTITY, atol=IDENTITY)
