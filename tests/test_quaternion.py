import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE, IDENTITY

from jaxcon.core.lanes import Vector
from jaxcon.geometry import quaternion

ONE = np.array([1.0, 0.0, 0.0, 0.0])


def random_unit(seed, shape=()):
    q = np.random.default_rng(seed).normal(size=(4, *shape))
    return jnp.asarray(q / np.linalg.norm(q, axis=0))


def rodrigues(phi):
    """Returns the matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(phi)
    x, y, z = phi / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def close(a, b):
    np.testing.assert_allclose(a, b, rtol=IDENTITY, atol=IDENTITY)


def test_group_axioms():
    p, q, r = (random_unit(seed) for seed in range(3))
    pq_r = quaternion.multiply(quaternion.multiply(p, q), r)
    close(pq_r, quaternion.multiply(p, quaternion.multiply(q, r)))
    close(quaternion.multiply(p, jnp.asarray(ONE)), p)
    close(quaternion.multiply(jnp.asarray(ONE), p), p)
    close(quaternion.multiply(p, quaternion.conjugate(p)), ONE)
    assert abs(float(jnp.linalg.norm(pq_r)) - 1) < IDENTITY


def test_units_multiply_as_hamilton_wrote():
    one, i, j, k = jnp.eye(4)
    close(quaternion.multiply(i, j), k)
    close(quaternion.multiply(j, k), i)
    close(quaternion.multiply(k, i), j)
    close(quaternion.multiply(i, i), -one)


def test_product_is_the_product_of_matrices():
    p, q = random_unit(0), random_unit(1)
    both = quaternion.matrix(quaternion.multiply(p, q))
    close(both, quaternion.matrix(p) @ quaternion.matrix(q))


@pytest.mark.parametrize("seed", range(3))
def test_matrix_is_that_of_rodrigues(seed):
    phi = np.random.default_rng(seed).normal(size=3)
    close(quaternion.matrix(quaternion.exp(jnp.asarray(phi))), rodrigues(phi))


def test_matrix_under_jit_is_an_array():
    q = random_unit(4)
    close(jax.jit(quaternion.matrix)(q), quaternion.matrix(q))


def test_matrix_of_float32_is_float32():
    assert quaternion.matrix(random_unit(4).astype(jnp.float32)).dtype == jnp.float32


def test_matrix_of_a_batch():
    q = random_unit(5, (3,))
    batch = quaternion.matrix(q)
    assert batch.shape == (3, 3, 3)
    close(batch[:, :, 1], quaternion.matrix(q[:, 1]))


def test_rotate_is_the_matrix_times_the_vector():
    q, x = random_unit(0), jnp.asarray([1.0, -2.0, 0.5])
    close(quaternion.rotate(q, x), quaternion.matrix(q) @ x)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-4, 1e-3, 0.1, 0.21, 1.0, 3.1])
def test_log_undoes_exp(size):
    phi = size * np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(
        quaternion.log(quaternion.exp(jnp.asarray(phi))), phi, rtol=1e-12, atol=1e-15
    )


@pytest.mark.parametrize("size", [0.0, 1e-8, 5e-4, 0.3, 2.0])
def test_log_of_exp_has_the_identity_for_its_derivative(size):
    phi = jnp.asarray(size * np.array([0.6, 0.0, -0.8]))

    def there_and_back(x):
        return quaternion.log(quaternion.exp(x))

    close(jax.jacfwd(there_and_back)(phi), np.eye(3))
    close(jax.jacrev(there_and_back)(phi), np.eye(3))


def test_log_of_zero_has_finite_derivatives():
    """A zero quaternion in one world must not spoil the gradient of a batch."""
    _, pull = jax.vjp(quaternion.log, jnp.zeros(4))
    np.testing.assert_array_equal(pull(jnp.zeros(3))[0], 0.0)
    assert np.all(np.isfinite(pull(jnp.ones(3))[0]))


def test_exp_undoes_log_up_to_sign():
    for q in (random_unit(0), -random_unit(0), random_unit(1)):
        back = quaternion.exp(quaternion.log(q))
        close(back, q * jnp.sign(q[0]))


def test_log_gives_the_shorter_turn():
    turn = quaternion.from_axis_angle((0, 0, 1), 3 * np.pi / 2)
    np.testing.assert_allclose(quaternion.log(turn), [0, 0, -np.pi / 2], atol=IDENTITY)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 2.0])
def test_derivative_of_a_turned_vector_by_the_rotation_vector(size):
    phi, x = size * np.array([0.6, 0.0, -0.8]), jnp.asarray([1.0, 2.0, 3.0])

    def turned(phi):
        return quaternion.rotate(quaternion.exp(phi), x)

    h = 1e-5
    slope = [
        (turned(jnp.asarray(phi + h * e)) - turned(jnp.asarray(phi - h * e))) / (2 * h)
        for e in np.eye(3)
    ]
    for derivative in (jax.jacfwd, jax.jacrev):
        got = derivative(turned)(jnp.asarray(phi))
        np.testing.assert_allclose(got, np.stack(slope, -1), rtol=DIFFERENCE, atol=1e-8)


def test_rate_is_that_of_turning_in_the_body():
    q, omega, h = random_unit(2), jnp.asarray([0.3, -1.0, 2.0]), 1e-5
    ahead = quaternion.multiply(q, quaternion.exp(h * omega))
    behind = quaternion.multiply(q, quaternion.exp(-h * omega))
    slope = (ahead - behind) / (2 * h)
    np.testing.assert_allclose(quaternion.derivative(q, omega), slope, atol=1e-9)


def test_normalize():
    close(quaternion.normalize(jnp.asarray([0.0, 3.0, 0.0, 4.0])), [0, 0.6, 0, 0.8])


@pytest.mark.parametrize("axis", [(1, 0, 0), (0.0, 2.0, 0.0), (1, 1, 1)])
def test_from_axis_angle(axis):
    phi = 0.7 * np.array(axis) / np.linalg.norm(axis)
    got = quaternion.matrix(quaternion.from_axis_angle(axis, 0.7))
    close(got, rodrigues(phi))


@pytest.mark.parametrize("zero", [(0, 0, 0), np.zeros(3), jnp.zeros(3)])
def test_an_axis_of_zeros_gives_the_identity(zero):
    close(quaternion.from_axis_angle(zero, 0.7), [1.0, 0.0, 0.0, 0.0])


def test_public_functions_take_arrays():
    """Functions of lanes, `rotation` and `split`, are not public."""
    q = random_unit(3)
    assert set(dir(quaternion)).isdisjoint({"rotation", "split"})
    assert quaternion.matrix(q).shape == (3, 3)


TURNS = {
    "identity": (1e-9, 0, 0),
    "small": (1e-4, 2e-4, -1e-4),
    "about x": (np.pi, 0, 0),
    "about y": (0, np.pi, 0),
    "about z": (0, 0, np.pi),
    "half turn": np.pi * np.ones(3) / np.sqrt(3),
    "any": (0.4, -1.0, 0.3),
}


@pytest.mark.parametrize("turn", TURNS)
def test_from_matrix(turn):
    r = rodrigues(np.array(TURNS[turn], float))
    q = quaternion.from_matrix(jnp.asarray(r))
    np.testing.assert_allclose(quaternion.matrix(q), r, atol=1e-9)


@pytest.mark.parametrize("turn", TURNS)
def test_from_matrix_can_be_differentiated_at_every_turn(turn):
    r = quaternion.exp(jnp.asarray(TURNS[turn], float))
    np.testing.assert_allclose(turned_back(jnp.zeros(3), r), np.eye(3), atol=1e-9)


@jax.jit
@jax.jacrev
def turned_back(phi, r):
    """Returns φ, recovered from the matrix of r exp(φ)."""
    back = quaternion.from_matrix(quaternion.matrix(quaternion.multiply(r, quaternion.exp(phi))))
    return quaternion.log(quaternion.multiply(quaternion.conjugate(r), back))


def test_lanes_and_arrays_give_the_same():
    p, q = random_unit(6, (5,)), random_unit(7, (5,))
    lanes = quaternion.multiply(Vector.of(p), Vector.of(q))
    assert isinstance(lanes, Vector)
    close(lanes.stack(), quaternion.multiply(p, q))
    close(quaternion.multiply(p, q)[:, 2], quaternion.multiply(p[:, 2], q[:, 2]))
