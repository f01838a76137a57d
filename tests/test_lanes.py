import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcon.core import lanes
from jaxcon.core.lanes import Matrix, Vector


@pytest.fixture
def pair():
    return np.random.default_rng(0).normal(size=(2, 3, 5))


def test_numbers_known_when_tracing_emit_nothing():
    x = jnp.arange(3.0)
    assert lanes.times(0.0, x) == 0.0
    assert lanes.times(1.0, x) is x
    assert lanes.plus(0.0, x) is x
    text = str(jax.make_jaxpr(lambda x: lanes.plus(lanes.times(x, 1.0), lanes.times(0.0, x)))(x))
    assert "mul" not in text
    assert "add" not in text


def test_minus_one_negates():
    np.testing.assert_array_equal(lanes.times(-1, jnp.arange(3.0)), -np.arange(3.0))


def test_vector_algebra_is_that_of_numpy(pair):
    a, b = pair
    x, y = Vector.of(jnp.asarray(a)), Vector.of(jnp.asarray(b))
    np.testing.assert_allclose((x + y).stack(), a + b)
    np.testing.assert_allclose((x - y).stack(), a - b)
    np.testing.assert_allclose((2.0 * x).stack(), 2 * a)
    np.testing.assert_allclose(x.dot(y), np.sum(a * b, axis=0))
    np.testing.assert_allclose(x.cross(y).stack(), np.cross(a, b, axis=0))


def test_cross_product_in_the_plane_is_a_number():
    x, y = Vector(jnp.asarray(2.0), jnp.asarray(3.0)), Vector(jnp.asarray(5.0), jnp.asarray(7.0))
    assert x.cross(y) == 2 * 7 - 3 * 5
    np.testing.assert_array_equal(lanes.perpendicular(x).stack(), [-3, 2])


def test_matrix_times_vector_and_transpose():
    a = np.random.default_rng(1).normal(size=(2, 3, 4))
    x = np.random.default_rng(2).normal(size=(3, 4))
    matrix = Matrix(*(Vector.of(jnp.asarray(row)) for row in a))
    expected = np.einsum("ijk,jk->ik", a, x)
    np.testing.assert_allclose((matrix @ Vector.of(jnp.asarray(x))).stack(), expected)
    back = matrix.T.T @ Vector.of(jnp.asarray(x))
    np.testing.assert_allclose(back.stack(), expected)


def test_axes_and_zeros():
    rows = [list(axis) for axis in lanes.axes(3)]
    np.testing.assert_array_equal(rows, np.eye(3))
    assert list(lanes.zeros(2)) == [0.0, 0.0]


def test_stack_spreads_python_numbers_in_the_dtype_of_the_arrays():
    x = Vector(jnp.ones(4, jnp.float32), 2.0).stack()
    assert x.dtype == jnp.float32
    np.testing.assert_array_equal(x, [[1] * 4, [2] * 4])


def test_vectors_and_matrices_are_pytrees(pair):
    x = Vector.of(jnp.asarray(pair[0]))
    doubled = jax.tree.map(lambda lane: 2 * lane, Matrix(x, x))
    assert isinstance(doubled, Matrix)
    np.testing.assert_array_equal(doubled[1].stack(), 2 * pair[0])


def test_componentwise_takes_arrays_and_vectors(pair):
    add = lanes.componentwise(lambda x, y: x + y)
    a, b = (jnp.asarray(x) for x in pair)
    np.testing.assert_array_equal(add(a, b), a + b)
    assert isinstance(add(Vector.of(a), Vector.of(b)), Vector)
