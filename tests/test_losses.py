"""Losses follow their formulas, ignore missing data, and are NaN for failed worlds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.core.status import Status


def pendulum(offset=0.0):
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0 + offset, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))
    return scene.build()


@pytest.fixture(scope="module")
def path():
    system, state = pendulum(0.01)

    def record(s, i):
        return s.q, i.violation, jc.energy(system, s), s

    method = jc.Method()
    return jax.jit(lambda s: jc.rollout(system, method, s, None, 1e-2, 50, record=record))(state)


def test_tracking_is_the_mean_of_squares_by_quantity_and_scale():
    path = {"angle": jnp.array([1.0, 2.0, 3.0]), "tip": jnp.ones((3, 2))}
    wanted = {"angle": np.array([1.0, np.nan, 1.0]), "tip": np.zeros((3, 2))}
    scale = {"angle": 2.0, "tip": np.array([[1.0, 2.0]])}
    expected = ((0 + (2 / 2) ** 2) / 2 + (1 + 1 / 4) / 2) / 2
    np.testing.assert_allclose(jc.learning.losses.tracking(path, wanted, scale), expected)
    slope = jax.grad(lambda p: jc.learning.losses.tracking(p, wanted, scale))(path)
    assert slope["angle"][1] == 0.0  # missing data
    np.testing.assert_allclose(slope["angle"][2], 0.25)


def test_what_is_masked_is_not_tracked():
    seen = np.ma.masked_array([1.0, 99.0, 1.0], [False, True, False])
    path = jnp.array([1.0, 2.0, 3.0])
    known = np.array([1.0, np.nan, 1.0])
    assert (
        jc.learning.losses.tracking(path, seen) == jc.learning.losses.tracking(path, known) == 2.0
    )
    assert jax.jit(jc.learning.losses.tracking)(path, known) == 2.0
    np.testing.assert_array_equal(jc.learning.losses.misfit(path, seen), [0.0, 0.0, 2.0])
    whole = np.ma.masked_array([1, 99, 1], [False, True, False])
    assert jc.learning.losses.tracking(path, whole) == 2.0


def test_tracking_says_what_does_not_fit():
    with pytest.raises(ValueError, match="a reference must be real numbers.*got bool"):
        jc.learning.losses.tracking(jnp.ones(3), np.ones(3, bool))
    with pytest.raises(ValueError, match="tip .3, 2.*tip .4, 2."):
        jc.learning.losses.tracking({"tip": jnp.ones((3, 2))}, {"tip": np.zeros((4, 2))})
    with pytest.raises(ValueError, match=r"scale of shape \(4, 1\).*\(3, 1\)"):
        jc.learning.losses.tracking(jnp.ones((3, 1)), np.zeros((3, 1)), np.ones((4, 1)))
    with pytest.raises(ValueError, match="reference is NaN throughout"):
        jc.learning.losses.tracking({"tip": jnp.ones(3)}, {"tip": np.full(3, np.nan)})
    with pytest.raises(ValueError, match="structure"):
        jc.learning.losses.tracking({"tip": jnp.ones((3, 2))}, {"toe": np.zeros((3, 2))})


def test_violation_is_the_size_of_position_and_of_velocity_over_a_step(path):
    _, (_, off, _, states) = path
    q, v = (np.asarray(x) for x in (states.q, states.v))
    # an info describes the state before its step, so it lacks the last state
    length = np.linalg.norm(q, axis=1)
    position, velocity = length - 1, np.sum(q * v, axis=1) / length
    np.testing.assert_allclose(off.position[1:, 0], position[:-1], atol=1e-12)
    square = np.mean(np.asarray(off.position) ** 2) + np.mean((1e-2 * velocity[:-1]) ** 2) * 49 / 50
    np.testing.assert_allclose(
        jc.learning.losses.violation(off, 1e-2), np.log10(square) / 2, rtol=1e-6
    )
    still = dataclasses.replace(off, position=0 * off.position, velocity=0 * off.velocity)
    assert jnp.isfinite(jc.learning.losses.violation(still, 1e-2))
    assert jc.learning.losses.mean_violation(still, 1e-2) == 0.0
    np.testing.assert_allclose(jc.learning.losses.mean_violation(off, 1e-2), square, rtol=1e-6)


def test_a_scene_without_rows_has_no_violation(path):
    _, (_, off, _, _) = path
    none = jax.tree.map(lambda x: x[:, :0], off)
    with pytest.raises(ValueError, match="no constraints"):
        jc.learning.losses.violation(none, 1e-2)


def test_energy_drift_is_that_of_the_energy(path):
    _, (_, _, energy, states) = path
    by_hand = np.sum(np.asarray(states.v) ** 2, axis=1) + 2.0 * 9.81 * np.asarray(states.q)[:, 1]
    change = (by_hand - by_hand[0]) / np.max(np.sum(np.asarray(states.v) ** 2, axis=1))
    np.testing.assert_allclose(
        jc.learning.losses.energy_drift(energy), np.sqrt(np.mean(change**2)), rtol=1e-9
    )
    still = jax.tree.map(jnp.ones_like, energy)
    assert jax.grad(lambda e: jc.learning.losses.energy_drift(e))(still).kinetic[0] == 0.0
    assert np.isnan(
        jc.learning.losses.energy_drift(jax.tree.map(lambda x: x.at[1].set(jnp.nan), still))
    )


def test_a_sum_comes_with_its_terms():
    terms = {"task": jnp.asarray(2.0), "drift": jnp.asarray(3.0)}
    value, aux = jc.learning.losses.weighted(terms, {"task": 1.0, "drift": 0.5})
    assert value == 3.5
    assert aux == terms
    with pytest.raises(ValueError, match="must be named as terms"):
        jc.learning.losses.weighted(terms, {"task": 1.0})


def test_a_failed_world_has_no_loss():
    _, state = pendulum()
    failed = dataclasses.replace(state, status=jnp.asarray(Status.SINGULAR, jnp.int32))
    noted = dataclasses.replace(state, status=jnp.asarray(Status.CONFLICT, jnp.int32))
    one = jnp.asarray(1.0)
    assert jc.learning.losses.unless_failed(one, state) == one
    assert jc.learning.losses.unless_failed(one, noted) == one
    assert jnp.isnan(jc.learning.losses.unless_failed({"x": one}, failed)["x"])
    batch = jax.tree.map(lambda *x: jnp.stack(x), state, failed)
    rows = jc.learning.losses.unless_failed({"each": jnp.ones((2, 3)), "mean": one}, batch)
    np.testing.assert_array_equal(np.isnan(rows["each"]), [[False] * 3, [True] * 3])
    assert jnp.isnan(rows["mean"])
    assert jnp.isnan(jc.learning.losses.unless_failed(1.0, jax.device_get(failed)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: jc.learning.losses.unless_failed(1.0, 2.0),
            "state must be the state .* got float",
        ),
        (
            lambda: jc.learning.losses.mean_violation(np.ones(3), 0.1),
            "off must be info.violation .* ndarray",
        ),
        (
            lambda: jc.learning.losses.energy_drift(np.ones(3)),
            r"energy must be jc.energy\(.* got ndarray",
        ),
        (
            lambda: jc.learning.losses.weighted({"a": np.ones(3)}, {"a": 1}),
            r"term 'a' .* got shape \(3,\)",
        ),
    ],
    ids=["state", "violation", "energy", "term"],
)
def test_what_is_of_another_kind_is_named(call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call()
