"""Guarded functions at their singular point, next to it, and in a batch with one singular row."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE, IDENTITY

from jaxcon.core import numerics
from jaxcon.core.lanes import Vector
from jaxcon.geometry import quaternion


def unit(x):
    return numerics.unit(Vector.of(x)).stack()


def cos_sinc(x):
    return jnp.stack(numerics.cos_sinc(x[0]))


def arctan2(x):
    return numerics.safe_arctan2(x[0], x[1])


# name: (guarded function, plain function, singular point, value there, regular point)
GUARDS = {
    "sqrt": (lambda x: numerics.safe_sqrt(x[0]), lambda x: np.sqrt(x[0]), [0.0], 0.0, [2.0]),
    "divide": (
        lambda x: numerics.safe_divide(x[0], x[1]),
        lambda x: x[0] / x[1],
        [3.0, 0.0],
        0.0,
        [3.0, 2.0],
    ),
    "norm": (numerics.norm, np.linalg.norm, [0.0] * 3, 0.0, [1.0, -2.0, 3.0]),
    "unit": (unit, lambda x: x / np.linalg.norm(x), [0.0] * 3, [0.0] * 3, [1.0, -2.0, 3.0]),
    "arctan2": (arctan2, lambda x: np.arctan2(x[0], x[1]), [0.0, 0.0], 0.0, [-1.0, -2.0]),
    "cos_sinc": (
        cos_sinc,
        lambda x: np.array([np.cos(np.sqrt(x[0])), np.sin(np.sqrt(x[0])) / np.sqrt(x[0])]),
        [0.0],
        [1.0, 1.0],
        [2.0],
    ),
    "exp": (
        quaternion.exp,
        lambda x: np.append(
            np.cos(np.linalg.norm(x) / 2),
            np.sin(np.linalg.norm(x) / 2) * x / np.linalg.norm(x),
        ),
        [0.0] * 3,
        [1.0, 0.0, 0.0, 0.0],
        [0.3, -0.4, 1.0],
    ),
    "log": (
        quaternion.log,
        lambda x: 2 * np.arctan2(np.linalg.norm(x[1:]), x[0]) * x[1:] / np.linalg.norm(x[1:]),
        [1.0, 0.0, 0.0, 0.0],
        [0.0] * 3,
        [0.5, 0.5, -0.5, 0.5],
    ),
}
every_guard = pytest.mark.parametrize("name", GUARDS)


def derivatives(guard):
    """Returns the function of value, first and second derivatives, in both modes."""
    return lambda x: (guard(x), jax.jacrev(guard)(x), jax.jacfwd(guard)(x), jax.hessian(guard)(x))


@functools.cache
def compiled(name):
    return jax.jit(derivatives(GUARDS[name][0]))


def all_finite(tree):
    return all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(tree))


@every_guard
def test_at_the_singular_point(name):
    _, _, singular, value, _ = GUARDS[name]
    found = compiled(name)(jnp.asarray(singular))
    np.testing.assert_allclose(found[0], value, atol=IDENTITY)
    assert all_finite(found)


@every_guard
@pytest.mark.parametrize("distance", [1e-30, 1e-12, 1e-5])
def test_next_to_the_singular_point(name, distance):
    _, plain, singular, _, _ = GUARDS[name]
    x = np.array(singular) + distance
    if name == "log":
        x = x / np.linalg.norm(x)
    found = compiled(name)(jnp.asarray(x))
    np.testing.assert_allclose(found[0], plain(x), rtol=1e-9)
    assert all_finite(found)


@every_guard
def test_far_from_the_singular_point(name):
    _, plain, _, _, regular = GUARDS[name]
    x = np.array(regular)
    value, reverse, forward, _ = compiled(name)(jnp.asarray(x))
    np.testing.assert_allclose(value, plain(x), rtol=IDENTITY)
    h = 1e-6
    slope = [(plain(x + h * e) - plain(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    for found in (reverse, forward):
        np.testing.assert_allclose(found, np.stack(slope, axis=-1), rtol=DIFFERENCE, atol=1e-9)


@every_guard
def test_one_singular_row_does_not_touch_the_batch(name):
    guard, _, singular, _, regular = GUARDS[name]
    batch = jax.jit(jax.vmap(derivatives(guard)))(jnp.asarray([regular, singular, regular]))
    assert all_finite(batch)
    alone = compiled(name)(jnp.asarray(regular))
    for row in (0, 2):
        for got, expected in zip(batch, alone, strict=True):
            np.testing.assert_allclose(got[row], expected, rtol=IDENTITY, atol=IDENTITY)


def test_guards_of_zero_have_zero_gradient():
    assert jax.grad(numerics.safe_sqrt)(0.0) == 0
    np.testing.assert_array_equal(jax.grad(numerics.norm)(jnp.zeros(3)), np.zeros(3))
    assert jax.grad(numerics.safe_divide, argnums=1)(1.0, 0.0) == 0


def test_negative_numbers_have_no_root():
    assert numerics.safe_sqrt(jnp.asarray(-1.0)) == 0
    assert jax.grad(numerics.safe_sqrt)(-1.0) == 0


def test_nan_is_no_length():
    assert np.isnan(numerics.safe_sqrt(jnp.asarray(jnp.nan)))
    assert np.isnan(numerics.norm(jnp.array([1.0, jnp.nan])))


def test_cos_sinc_is_exact_within_and_across_half_turns():
    edges = np.array([1, 3, 5, 41]) * np.pi / 2
    for root in (1e-9, 1e-3, 0.1, 1.5, 3.0, np.pi, 100.0, *(edges - 1e-9), *(edges + 1e-9)):
        got, slope = jax.jvp(numerics.cos_sinc, (root**2,), (1.0,))
        cos, sinc = np.cos(root), np.sin(root) / root
        np.testing.assert_allclose(got, [cos, sinc], rtol=0, atol=4e-16 * (1 + root))
        near = -1 / 6 + root**2 / 60  # the derivative of sin √s / √s
        bent = near if root < 1e-2 else (cos - sinc) / (2 * root**2)
        np.testing.assert_allclose(slope, [-sinc / 2, bent], rtol=0, atol=2e-14)


def test_wrap_keeps_the_slope_everywhere():
    for angle in (0.1, np.pi - 1e-6, np.pi + 1e-6, 7.0, -20.0):
        value, slope = jax.value_and_grad(numerics.wrap)(angle)
        np.testing.assert_allclose(value, np.angle(np.exp(1j * angle)), atol=1e-14)
        assert slope == 1


@pytest.mark.parametrize("name", ["sqrt", "norm", "unit", "arctan2", "cos_sinc", "exp", "log"])
def test_float32_stays_float32(name):
    guard, plain, _, _, regular = GUARDS[name]
    got = guard(jnp.asarray(regular, jnp.float32))
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, plain(np.array(regular)), rtol=1e-6)
