"""Minima are found, whatever happens on the way; bounds hold, and a search goes on where it was."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxcon as jc
from jaxcon.learning.leaves import space_of

BOWL = {"a": jnp.array([1.0, 3.0]), "b": {"c": 0.0, "n": 3}}


def bowl(p):
    """0 at a = e, c = 2; the aux is the sum of a."""
    off = jnp.sum((jnp.log(p["a"]) - 1) ** 2) + (p["b"]["c"] - 2.0) ** 2
    return off, jnp.sum(p["a"])


def test_the_least_of_a_bowl_is_found_and_its_history_kept():
    found = jc.tune(bowl, BOWL, steps=205, positive="a", optimizer=optax.adam(0.1))
    np.testing.assert_allclose(found.params["a"], np.e, rtol=2e-3)
    np.testing.assert_allclose(found.params["b"]["c"], 2.0, rtol=2e-3)
    assert found.params["b"]["n"] == 3
    assert found.history.shape == (205,)
    assert found.loss == found.history.min()
    np.testing.assert_allclose(found.aux, jnp.sum(found.params["a"]))  # at the best, not the last
    assert "every step was taken" in str(found)


@pytest.mark.parametrize("dtype", [jnp.float32])
def test_a_line_search_of_optax_finds_it_to_rounding(dtype):
    start = {"a": jnp.ones(2, dtype), "b": {"c": jnp.zeros((), dtype)}}
    found = jc.tune(bowl, start, steps=20, positive="a", optimizer=optax.lbfgs())
    assert found.params["a"].dtype == dtype
    np.testing.assert_allclose(found.params["a"], np.e, rtol=4 * float(jnp.finfo(dtype).eps) ** 0.5)


def test_an_optimum_beyond_a_bound_is_left_for_the_bound_itself():
    def loss(p):
        return bowl(p)[0], p["b"]["c"]

    seen = []

    def watched(p):
        jax.debug.callback(seen.append, p["b"]["c"])
        return loss(p)

    found = jc.tune(watched, BOWL, steps=30, bounds={"b": (-1.0, 1.5)}, optimizer=optax.adam(0.3))
    assert found.params["b"]["c"] == found.aux == 1.5
    assert max(seen) == 1.5  # reached and never passed
    assert min(seen) >= -1.0


@pytest.mark.parametrize("name", ["b", "b/c", "*/c"])
def test_leaves_are_named_by_path_by_part_and_by_pattern(name):
    space = space_of(BOWL, ["a"], {name: (-1.0, 1.5), "a": (0.5, None)}, "test")
    assert space.names == ("a", "b/c")
    assert space.positive == (True, False)
    again = space_of(BOWL, {"a": True, "b": False}, {name: (-1.0, 1.5), "a": (0.5, None)}, "test")
    assert jax.tree.structure(again) == jax.tree.structure(space)
    np.testing.assert_array_equal(space.low[1], -1.0)
    np.testing.assert_array_equal(space.high[0], np.inf)


def test_bounds_of_positive_leaves_hold_to_the_last_bit_and_let_go_again():
    """exp(log x) may round beyond x; at the bound there still is a derivative."""
    bound = jnp.asarray(np.random.default_rng(0).uniform(0.1, 100.0, 1000))
    space = space_of(bound, True, (None, bound), "test")
    y = space.encode(bound)
    assert not np.all(np.exp(y[0]) <= bound)  # some would
    assert np.all(space.decode(y) <= bound)
    slope = jax.grad(lambda y: jnp.sum(space.decode(y)))(y)
    np.testing.assert_allclose(slope[0], bound)


def test_a_start_stops_where_the_loss_falls_no_more():
    found = jc.tune(bowl, BOWL, steps=500, positive="a", patience=15, tolerance=1e-3)
    assert found.steps < 400
    assert len(found.history) == found.steps
    assert "fell no more" in found.stopped


def valley(x):
    """Minima at 1, of 0.5, and at −2, of 0; a start at 2 finds the worse one."""
    return jnp.minimum((x - 1) ** 2 + 0.5, (x + 2) ** 2)


def test_restarts_find_the_better_of_two_minima():
    start, options = jnp.asarray(2.0), {"steps": 80, "optimizer": optax.adam(0.1)}
    alone = jc.tune(valley, start, **options)
    assert abs(alone.loss - 0.5) < 1e-2
    found = jc.tune(valley, start, restarts=8, spread=3.0, key=jax.random.key(0), **options)
    assert found.loss < 1e-2
    assert found.histories.shape == (8, 80)
    np.testing.assert_allclose(found.histories[0], alone.history)  # the first is the one given
    assert "the best of 8 starts" in str(found)


def cliff(x):
    """Falls towards 1.05, from where on it is no number: steps of 0.3 lead beyond."""
    return jnp.where(x < 1.05, 2 - x, jnp.nan)


def test_a_loss_that_is_not_finite_somewhere_is_approached_with_shorter_steps():
    found = jc.tune(cliff, jnp.asarray(0.0), steps=60, optimizer=optax.sgd(0.3))
    assert 0.95 <= found.loss < 0.96
    assert np.isnan(found.history).any()
    assert "taken back" in str(found)
    assert found.params < 1.05


def test_a_gradient_that_is_not_finite_ends_the_start_and_keeps_the_best():
    found = jc.tune(lambda x: jnp.sqrt(jnp.abs(x)) + 1, jnp.asarray(0.0), steps=100)
    assert found.loss == 1.0  # whose derivative is NaN
    assert found.steps < 30
    assert "not finite" in found.stopped


def test_a_start_without_a_number_harms_no_other():
    def loss(x):
        return jnp.where(x > 0, jnp.nan, (x + 1) ** 2)

    key = jax.random.key(1)
    found = jc.tune(loss, jnp.asarray(0.1), restarts=6, spread=1.0, key=key, steps=100)
    assert found.loss < 1e-2
    assert np.isnan(found.histories[0]).all()
    assert len(found.history) == 100


def test_the_least_of_an_expectation():
    """E (x − k)², k normal around 1: the least is the variance, at the mean."""

    def loss(x, key):
        return (x - 1 - 0.5 * jax.random.normal(key)) ** 2

    options = {"samples": 64, "key": jax.random.key(3), "optimizer": optax.adam(0.03)}
    found = jc.tune(loss, jnp.asarray(0.0), steps=150, **options)
    assert abs(found.params - 1) < 4 * 0.5 / 64**0.5
    assert 0.15 < found.loss < 0.4
    assert found.loss > found.history.min()  # a lucky draw is not taken for the best


def noisy(x, key):
    return jnp.sum((x - 1 - 0.1 * jax.random.normal(key, x.shape, x.dtype)) ** 2)


@pytest.mark.parametrize("options", [{}, {"samples": 4, "restarts": 3, "spread": 0.5}])
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(options, tmp_path, monkeypatch):
    from jaxcon.learning import tuning

    loss = noisy if options else lambda x: bowl({"a": x, "b": {"c": 0.0}})[0]
    options = {"steps": 45, "key": jax.random.key(2), "positive": True, **options}
    start = jnp.array([0.5, 2.0], jnp.float32 if options.get("samples") else jnp.float64)
    whole = jc.tune(loss, start, **options)
    file = tmp_path / "search.npz"
    write, written = tuning.files.write, []

    def interrupted(*args):
        write(*args)
        written.append(args)
        if len(written) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tuning.files, "write", interrupted)
        part = jc.tune(loss, start, checkpoint=file, **options)
    assert part.steps == 20
    assert "interrupted" in part.stopped
    assert part.loss <= part.history[0]  # the best so far came back
    again = jc.tune(loss, start, checkpoint=file, **options)
    assert again.steps == 45
    np.testing.assert_array_equal(again.params, whole.params)
    np.testing.assert_array_equal(again.histories, whole.histories)
    assert again.loss == whole.loss
    assert [x.name for x in tmp_path.iterdir()] == ["search.npz"]


def test_a_checkpoint_is_refused_by_another_search(tmp_path):
    file = tmp_path / "search.npz"
    data = jnp.array([1.0, 2.0])
    start = {"x": jnp.zeros(2)}

    def loss(p, data=data):
        return jnp.sum((p["x"] - data) ** 2)

    jc.tune(loss, start, steps=10, checkpoint=file)
    others = [
        (lambda p: loss(p, data + 1), start, {}, "the loss, its data"),
        (loss, start, {"optimizer": optax.sgd(0.1)}, "the optimizer"),
        (loss, start, {"bounds": (-1.0, 1.0)}, "another option"),
        (loss, {"x": jnp.ones(2)}, {}, "the start"),
        (loss, {"x": jnp.zeros(3)[:2] + 0.5, "y": 1.0}, {}, "the leaves"),
        (loss, start, {"chunk": 5}, "the chunk"),
    ]
    for other, params, options, what in others:
        with pytest.raises(ValueError, match=f"(?s)another search.*{what}"):
            jc.tune(other, params, steps=10, checkpoint=file, **options)
    file.write_text("no checkpoint")
    with pytest.raises(ValueError, match="is no checkpoint"):
        jc.tune(loss, start, steps=10, checkpoint=file)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"positive": "q"}, "there is no leaf 'q'"),
        ({"positive": "b"}, "'b/c' is to stay positive"),
        ({"positive": 3}, "must be bools or names"),
        ({"bounds": {"a": (2.0, 4.0)}}, "'a' must start within its bounds"),
        ({"bounds": {"a": 2.0}}, "needs bounds"),
        ({"bounds": {"b": (0, 1), "b/*": (0, 1)}}, "meant by each of"),
        ({"restarts": 2}, "give key="),
        ({"restarts": 2, "key": jax.random.key(0)}, "give spread="),
        ({"steps": 0}, "whole number from 1"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(options, what):
    with pytest.raises(ValueError, match=what):
        jc.tune(bowl, BOWL, **options)


def test_a_loss_must_be_a_scalar_and_parameters_numbers():
    with pytest.raises(TypeError, match="floating scalar"):
        jc.tune(lambda x: x, jnp.zeros(2))
    with pytest.raises(ValueError, match="no floating number"):
        jc.tune(lambda x: 0.0, {"n": 3})
    with pytest.raises(ValueError, match="must be finite"):
        jc.tune(lambda x: x, jnp.nan)


def pendulum(dtype=None):
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.3))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))  # off by 4 cm
    scene.add(jc.ExternalWrench("push", "bob"))
    return scene.build()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_gains_of_a_method_are_leaves_like_others(dtype):
    system, state = pendulum(dtype)

    def loss(method):
        off = jc.rollout(
            system, method, state, None, 1e-2, 30, record=lambda s, i: i.violation.position
        )[1]
        return jnp.log(jnp.mean(off**2))

    method = jc.Method(stabilizer=jc.Baumgarte(dtype(2.0), dtype(2.0)))
    found = jc.tune(loss, method, steps=20, positive="stabilizer", optimizer=optax.adam(0.2))
    assert isinstance(found.params, jc.Method)
    assert found.params.stabilizer.beta > 4.0
    assert found.loss < found.history[0] - 0.5
    assert found.params.stabilizer.beta.dtype == dtype


def test_numbers_of_a_system_a_start_and_controls_together():
    """A length, the first velocity and forces over time bring a bob to a place."""
    system, state = pendulum()
    goal = jnp.array([0.6, -1.5])

    def loss(p):
        changed = system.with_params(p["system"])
        start = dataclasses.replace(state, v=p["start"])
        final, _ = jc.rollout(changed, jc.Method(), start, p["controls"], 2e-2, 20)
        return jnp.sum((final.q - goal) ** 2)

    params = {"system": {"rod": {"length": 1.0}}, "start": state.v, "controls": jnp.zeros((20, 2))}
    adam = optax.adam(0.2)
    found = jc.tune(loss, params, steps=80, positive="system/rod/length", optimizer=adam)
    assert found.loss < 1e-3 * found.history[0]
    for x, y in zip(jax.tree.leaves(found.params), jax.tree.leaves(params), strict=True):
        assert jnp.max(jnp.abs(x - y)) > 1e-2


def test_the_stiffness_of_a_constraint_that_is_least_in_expectation():
    """argmin E[L_task + α L_constraint(k)] is one call; starts are drawn with each key."""
    system, state = pendulum()

    def loss(k, key):
        method = jc.Method(stabilizer=jc.Penalty(k, 1.0))
        start = dataclasses.replace(state, v=0.3 * jax.random.normal(key, (2,)))
        final, (q, off) = jc.rollout(
            system, method, start, None, 1e-2, 20, record=lambda s, i: (s.q, i.violation)
        )
        task = jc.losses.tracking(q, np.tile([1.0, 0.0], (20, 1)))
        terms = {"task": task, "constraint": jc.losses.violation(off, 1e-2)}
        value, terms = jc.losses.weighted(terms, {"task": 1.0, "constraint": 0.3})
        return jc.losses.unless_failed(value, final), terms

    options = {"samples": 8, "key": jax.random.key(0), "optimizer": optax.adam(0.2)}
    found = jc.tune(loss, jnp.asarray(10.0), positive=True, steps=40, **options)
    assert found.aux["task"].shape == (8,)
    assert found.params > 20.0
    judge = jax.jit(
        lambda k: jnp.mean(jax.vmap(lambda key: loss(k, key)[0])(jax.random.split(KEY, 64)))
    )
    assert judge(found.params) < judge(jnp.asarray(10.0)) - 0.05


KEY = jax.random.key(9)
"""Of draws that no search has seen."""
