"""Tools that check gradients against differences, and that measure how far they reach in time."""

import dataclasses
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.analysis.differences import ridders


@jax.custom_jvp
def slightly_wrong(x):
    return x**2


slightly_wrong.defjvp(lambda x, dx: (x[0] ** 2, 2.0001 * x[0] * dx[0]))


def several(x):
    large = jnp.sin(x["large"]) @ jnp.arange(1.0, 8.0)
    return {"a": slightly_wrong(x["wrong"]) + large, "b": x["right"] ** 3 * large}


NUMBERS = {"wrong": 1.5, "right": jnp.array([0.7, -0.3]), "large": jnp.linspace(0, 1, 7), "n": 3}


def test_a_wrong_leaf_is_named_and_the_others_are_not():
    check = jc.check_gradients(several, NUMBERS)
    assert not check.ok
    assert check.wrong == ("wrong",)
    assert [leaf.name for leaf in check.leaves] == ["large", "right", "wrong"]
    bad = check.leaves[2]
    np.testing.assert_allclose(bad.error, 1e-4 / 2.0001, rtol=1e-6)
    np.testing.assert_allclose(bad.reverse / bad.difference, 2.0001 / 2, rtol=1e-9)
    assert "wrong: the modes differ by" in str(check)
    assert "DISAGREES, both modes are off" in str(bad)
    assert str(check).startswith("gradients to 6.1e-06: wrong for ['wrong']\n")


def test_the_mode_that_is_off_is_named():
    leaf = jc.check_gradients(jnp.square, 3.0).leaves[0]
    for name, words in (("reverse", "reverse mode is off"), ("forward", "forward mode is off")):
        own = dataclasses.replace(leaf, **{name: 1.1 * getattr(leaf, name)})
        assert f"DISAGREES, {words}: reverse" in str(own)


@pytest.mark.parametrize(
    ("f", "x", "message"),
    [
        (jnp.square, jnp.nan, "check_gradients: x must be finite, got nan"),
        (lambda x: x["a"], {"a": jnp.inf}, "check_gradients: x.a must be finite, got inf"),
        (jnp.log, -1.0, "f is not finite at x"),
    ],
    ids=["x", "leaf", "f"],
)
def test_where_nothing_is_finite_there_is_nothing_to_check(f, x, message):
    with pytest.raises(ValueError, match=message):
        jc.check_gradients(f, x)


def test_empty_leaves_and_results_are_left_out():
    """An empty leaf is, for example, the control of a scene without controls."""
    check = jc.check_gradients(
        lambda x: (x["a"] ** 2, x["none"] * 2.0), {"a": 2.0, "none": jnp.zeros((5, 0))}
    )
    assert check.ok
    assert [leaf.name for leaf in check.leaves] == ["a"]
    with pytest.raises(ValueError, match="no leaf of floating numbers"):
        jc.check_gradients(lambda x: 1.0, {"none": jnp.zeros(0)})


def test_a_tolerance_is_the_users():
    assert jc.check_gradients(several, NUMBERS, tolerance=1e-3).ok


def test_right_leaves_are_right_to_rounding():
    check = jc.check_gradients(lambda x: several(x | {"wrong": 0.0}), NUMBERS)
    assert max(leaf.error for leaf in check.leaves[:2]) < 1e-10


@jax.custom_jvp
def forgotten(x):
    return x**2


forgotten.defjvp(lambda x, dx: (x[0] ** 2, 0.0 * dx[0]))


def test_a_missing_derivative_does_not_hide_behind_a_large_one_of_its_leaf():
    (leaf,) = jc.check_gradients(lambda x: 1e6 * x[1] ** 2 + forgotten(x[0]), jnp.ones(2)).leaves
    assert not leaf.ok
    np.testing.assert_allclose(leaf.error, 1.0, rtol=1e-3)
    assert "reverse 0, forward 0, differences 2.0" in str(leaf)


@pytest.mark.parametrize("coarse", ["leaf", "result"])
def test_the_coarsest_of_mixed_numbers_says_what_differences_can_tell(coarse):
    """The lowest precision sets the tolerance, so that rounding fails no right gradient."""

    def f(x):
        size = jnp.exp(x["b"].astype(jnp.float64)) * jnp.sin(x["a"])
        return (size.astype(jnp.float32) if coarse == "result" else size), 1.0 * x["b"]

    b = jnp.asarray(0.7, jnp.float32 if coarse == "leaf" else jnp.float64)
    check = jc.check_gradients(f, {"a": jnp.asarray(1.3), "b": b})
    assert check.ok, check
    np.testing.assert_allclose(check.tolerance, float(jnp.finfo(jnp.float32).eps) ** (1 / 3))


def test_leaves_that_are_no_floating_numbers_are_left_as_they_are():
    def power(x):
        return sum(x["a"].astype(x["dtype"]) ** i for i in range(1, x["n"]))

    assert jc.check_gradients(power, {"a": 1.3, "n": 4, "dtype": "float64"}).ok


def half_differentiable(x):
    """Returns x for x < 0, where the square root of the other branch has a NaN derivative."""
    return jnp.where(x > 0, jnp.sqrt(x), x)


def test_nan_is_no_agreement():
    check = jc.check_gradients(half_differentiable, -1.0)
    assert check.wrong == ("x",)


def test_what_differences_cannot_see_is_undecided():
    """The function has noise a million times larger than rounding."""

    def noisy(x):
        return jnp.sin(x) + 1e-6 * jnp.sin(1e9 * jax.lax.stop_gradient(x))

    (leaf,) = jc.check_gradients(noisy, 1.0).leaves
    assert leaf.undecided
    assert not leaf.ok


def test_a_pendulum_in_float32():
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()

    def end(params):
        dt = jnp.asarray(1e-2, jnp.float32)
        return jc.rollout(system.with_params(params), jc.Method(), state, None, dt, 5)[0].q

    check = jc.check_gradients(end, {"rod": {"length": system.params["rod"]["length"]}})
    assert check.ok, check
    assert check.leaves[0].name == "rod.length"


def test_nothing_to_differentiate_by():
    with pytest.raises(ValueError, match="no leaf of floating numbers"):
        jc.check_gradients(lambda x: 1.0 * x, 3)
    with pytest.raises(ValueError, match="f returns no floating number"):
        jc.check_gradients(lambda x: jnp.round(x).astype(int), 1.3)
    with pytest.raises(ValueError, match="tolerance must be positive"):
        jc.check_gradients(jnp.sin, 1.3, tolerance=0.0)


def test_a_function_that_does_not_tell_its_arguments_is_taken():
    assert jc.check_gradients(operator.itemgetter("x"), {"x": 1.3}).ok


def test_what_is_no_function_of_x_is_refused():
    with pytest.raises(TypeError, match="f must be a function of x, got 3"):
        jc.check_gradients(3, 1.3)
    with pytest.raises(TypeError, match=r"called as f\(x\), and does not accept that"):
        jc.check_gradients(lambda x, y: x * y, 1.3)
    with pytest.raises(ValueError, match="seed must be a whole number from 0"):
        jc.check_gradients(jnp.sin, 1.3, seed=-1)


@pytest.mark.parametrize("levels", [6, 7, 8])
def test_ridders_sees_past_a_kink_within_the_larger_steps(levels):
    steps = 0.1 * 0.5 ** np.arange(levels)
    kinks = np.geomspace(steps[-4], steps[0], 100)[:, None]
    slopes = 2.0 + steps**2 - 3 * steps**4 + 5 * np.maximum(steps - kinks, 0) / steps
    best, _ = ridders(slopes)
    np.testing.assert_allclose(best, 2, atol=1e-9)
    slopes[:, -1] = np.nan
    assert not np.any(np.isnan(ridders(slopes)[1]))


def test_ridders_takes_away_every_even_power():
    steps = 0.1 * 0.5 ** np.arange(10)
    slopes = 2.0 + np.stack([3 * steps**2 - steps**4, np.sin(steps) * steps])
    best, uncertainty = ridders(slopes)
    assert np.all(np.abs(best - 2.0) <= np.maximum(uncertainty, 1e-14))
    assert np.all(uncertainty < 1e-11)


def test_differences_know_what_rounding_makes_of_them():
    """Their noise cannot be derived from the spacing of f, as for a rollout of many steps."""
    steps, random = 0.1 * 0.5 ** np.arange(10), np.random.default_rng(0)
    noise = 1e-5 * random.normal(size=(2000, 10)) / steps
    best, uncertainty = ridders(2.0 + 3 * steps**2 - steps**4 + noise)
    off = np.abs(best - 2.0)
    assert np.mean(off > 4 * uncertainty) < 1e-2
    assert np.median(uncertainty) < 10 * np.median(off)


def swing(height, dtype=None):
    """A bob on a rod of 1 m, hanging or upright."""
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(0.0, height))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def test_an_inverted_pendulum_falls_as_its_exponent_says():
    """The growth is e^(√(g/l) t), in closed form by cosh and sinh, for moves along φ and across."""
    system, state = swing(1.0)
    growth = jc.analysis.gradient_growth(system, jc.Method(jc.RK4()), state, None, 1e-2, 400)
    rate, t = np.sqrt(9.81), growth.time
    c, s = np.cosh(rate * t), np.sinh(rate * t)
    expected = np.sqrt((2 * c**2 + (s / rate) ** 2 + (s * rate) ** 2) / 2)
    np.testing.assert_allclose(growth.growth, expected, rtol=1e-5)
    np.testing.assert_allclose(growth.exponent, rate, rtol=1e-3)
    # the time at which ε · growth = 1
    reach = np.log(2 / (np.finfo(float).eps * np.sqrt((2 + 9.81 + 1 / 9.81) / 2))) / rate
    np.testing.assert_allclose(growth.horizon(), reach, rtol=1e-3)
    assert growth.horizon(1e-3) < growth.time[-1] < growth.horizon()
    assert "useless beyond" in str(growth)


def test_growth_is_told_as_far_as_the_precision_reaches():
    """The square of the growth overflows in float32 beyond 2e19; the growth itself must not."""
    system, state = swing(1.0, jnp.float32)
    growth = jc.analysis.gradient_growth(system, jc.Method(), state, None, jnp.float32(2e-2), 2000)
    np.testing.assert_allclose(growth.exponent, np.sqrt(9.81), rtol=1e-3)
    assert np.max(growth.growth[np.isfinite(growth.growth)]) > 1e36
    assert not np.isfinite(growth.growth[-1])
    assert growth.horizon() < 6.0


def test_a_hanging_pendulum_has_no_horizon():
    system, state = swing(-1.0)
    growth = jc.analysis.gradient_growth(system, jc.Method(jc.RK4()), state, None, 1e-2, 400)
    assert growth.horizon() == np.inf
    assert growth.growth.max() < 4.0
    assert "no more than a power of time" in str(growth)


def test_a_rollout_that_fails_is_refused():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(0.0, -1.0))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()
    push = jnp.zeros((8, 2)).at[5].set(jnp.nan)
    with pytest.raises(ValueError, match="rollout fails, NON_FINITE.*find_first_failure"):
        jc.analysis.gradient_growth(system, jc.Method(), state, push, 1e-2, 8)


def test_no_freedom_is_refused():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.joints.Coincident("pin", jc.WORLD, "bob", point=(1.0, 0.0)))
    system, state = scene.build()
    with pytest.raises(ValueError, match="no freedom"):
        jc.analysis.gradient_growth(system, jc.Method(), state, None, 1e-2, 10)
    with pytest.raises(ValueError, match="dt must be positive"):
        jc.analysis.gradient_growth(system, jc.Method(), state, None, 0.0, 10)
