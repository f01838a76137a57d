"""Searches find minima in spite of failures; bounds hold, and interrupted searches resume."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scenes

import jaxcon as jc
from jaxcon.core import checkpoint as files
from jaxcon.learning.leaves import space_of

BOWL = {"a": jnp.array([1.0, 3.0]), "b": {"c": 0.0, "n": jnp.asarray(3)}}


def bowl(p):
    """Returns a loss with minimum 0 at a = e, c = 2; aux is the sum of a."""
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
    assert "every step was taken, and it converged: within " in str(found)
    assert " (relative) of a minimum, possibly a local one" in str(found)
    short = jc.tune(bowl, BOWL, steps=20, positive="a", optimizer=optax.adam(0.03))
    assert "before it converged" in short.stopped
    assert "ask for more" in str(short)


def test_the_default_rate_reaches_what_is_a_hundred_times_larger():
    """60 steps suffice, also for a second leaf that is a hundred times smaller."""

    def loss(x):
        return jnp.sum(jnp.log(x / jnp.array([100.0, 0.01])) ** 2)

    found = jc.tune(loss, jnp.ones(2), steps=60, positive=True)
    np.testing.assert_allclose(found.params, [100.0, 0.01], rtol=0.1)


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
    assert found.bounded == ("b/c",)
    assert "b/c = 1.5, on its bound" in str(found)
    assert max(seen) == 1.5  # reaches the bound and never passes it
    assert min(seen) >= -1.0


@pytest.mark.parametrize("name", ["b", "b/c", "*/c"])
def test_leaves_are_named_by_path_by_part_and_by_pattern(name):
    space = space_of(BOWL, ["a"], {name: (-1.0, 1.5), "a": (0.5, None)}, "test")
    assert space.names == ("a", "b/c")
    assert space.positive == (True, False)
    again = space_of(BOWL, {"a": True, "b": False}, {name: (-1.0, 1.5), "a": (0.5, None)}, "test")
    assert jax.tree.structure(again) == jax.tree.structure(space)
    np.testing.assert_array_equal(space.low[1], -1.0)
    assert np.all(space.high[0] > 1e307)
    assert np.all(np.isfinite(np.exp(space.limits[1][0])))  # limits of logarithms stay finite


def test_bounds_of_positive_leaves_hold_to_the_last_bit_and_let_go_again():
    """exp(log x) may round beyond x; at the bound the derivative is not zero."""
    bound = jnp.asarray(np.random.default_rng(0).uniform(0.1, 100.0, 1000))
    space = space_of(bound, True, (None, bound), "test")
    y = space.encode(bound)
    assert not np.all(np.exp(y[0]) <= bound)  # rounding would exceed some bounds
    assert np.all(space.decode(y) <= bound)
    slope = jax.grad(lambda y: jnp.sum(space.decode(y)))(y)
    np.testing.assert_allclose(slope[0], bound)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_positive_leaf_stays_positive_however_far_it_is_thrown(dtype):
    def square(x):
        return 1e5 * x**2

    found = jc.tune(square, jnp.ones((), dtype), positive=True, steps=3, optimizer=optax.sgd(1.0))
    assert 0 < found.params < 1e-30


SPRING = {"stiffness": 8.0, "damping": 1.0}


def spring_loss(dtype):
    height = scenes.hanging(dtype)
    seen = height({name: dtype(x) for name, x in SPRING.items()})
    return lambda p: jc.learning.losses.tracking(height(p), seen)


@pytest.mark.parametrize(
    ("dtype", "start", "close"),
    [
        (jnp.float64, (5.0, 0.3), 1e-9),
        (jnp.float64, (100.0, 30.0), 1e-9),
        (jnp.float64, (1000.0, 0.01), 1e-9),
        (jnp.float32, (5.0, 0.3), 1e-4),
    ],
)
def test_the_default_search_gets_to_the_end_of_a_narrow_valley(dtype, start, close):
    """Adam alone ends 6 %, 35 % and 110 % off, with losses of 4e-8, 1e-6 and 1e-5."""
    guess = {name: dtype(x) for name, x in zip(SPRING, start, strict=True)}
    found = jc.tune(spring_loss(dtype), guess, positive=True)
    np.testing.assert_allclose([found.params[x] for x in SPRING], [8.0, 1.0], rtol=close)
    assert found.converged
    assert "it converged" in str(found)
    assert found.history[found.best_step] == found.loss


@pytest.mark.parametrize("factors", [(0.03, 0.03), (1.0, 30.0), (30.0, 0.03), (30.0, 30.0)])
def test_a_search_ends_no_worse_than_it_began_and_converges_to_minima_alone(factors):
    """A fit of 6 s has local minima, and one at zero damping, whose logarithm is −∞."""
    height = scenes.hanging(steps=600)
    seen = height(SPRING)

    def loss(log):
        stiffness, damping = jnp.exp(log)
        return jc.learning.losses.tracking(
            height({"stiffness": stiffness, "damping": damping}), seen
        )

    start = np.array(list(SPRING.values())) * factors
    guess = dict(zip(SPRING, start, strict=True))
    found = jc.tune(
        lambda p: loss(jnp.log(jnp.stack([p[x] for x in SPRING]))), guess, positive=True
    )
    assert found.loss <= found.history[0]
    log = np.log([found.params[x] for x in SPRING])
    if found.converged:
        curvature, slope = jax.hessian(loss)(log), jax.grad(loss)(log)
        assert np.linalg.eigvalsh(curvature)[0] > 0
        assert np.abs(np.linalg.solve(curvature, slope)).max() < 1e-3
        assert "possibly a local one" in found.stopped
    else:
        assert "before it converged" in found.stopped


def test_a_slide_through_a_valley_is_not_called_converged():
    """The loss decreases by 1e-10 a step only."""
    adam = optax.adam(optax.cosine_decay_schedule(0.1, 150))
    guess = {"stiffness": 5.0, "damping": 0.3}
    found = jc.tune(spring_loss(jnp.float64), guess, positive=True, steps=150, optimizer=adam)
    off = max(abs(np.log(found.params[x] / SPRING[x])) for x in SPRING)
    assert off > 0.05
    late = found.history[75:]
    assert late.max() - late.min() < 1e-2 * np.ptp(found.history)
    assert not found.converged
    assert "before it converged" in found.stopped
    assert "the loss still fell by" in found.stopped


@pytest.mark.parametrize(
    "optimizer", [optax.adam(0.5), optax.adam(0.05), optax.sgd(0.3, momentum=0.9)]
)
def test_leaps_across_a_valley_are_not_called_converged(optimizer):
    """The search leaps between the sides of a curved valley, and hardly moves along it.

    The minimum is at x = 3, the end at x < 0.01.
    """

    def valley(x):
        return 1e-3 * (x[0] - 3) ** 2 + 1e3 * (x[1] - jnp.sin(x[0])) ** 2

    found = jc.tune(valley, jnp.zeros(2), steps=200, optimizer=optimizer)
    assert found.params[0] < 0.1
    assert not found.converged
    assert "before it converged" in found.stopped


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "optimizer",
    [
        optax.adam(optax.cosine_decay_schedule(0.2, 400)),
        optax.adam(0.05),
        optax.sgd(0.1),
        optax.sgd(0.05, momentum=0.9),
    ],
    ids=["cosine", "adam", "sgd", "momentum"],
)
def test_other_optimizers_converge_in_a_bowl(optimizer, dtype):
    """At the end, steps and gradients are mere rounding errors."""
    turn = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    curvature = jnp.asarray(turn @ np.diag([0.5, 4.0, 1.0]) @ turn.T, dtype)
    target = jnp.asarray([1.0, 2.0, 0.7], dtype)
    found = jc.tune(
        lambda x: (x - target) @ curvature @ (x - target),
        jnp.zeros(3, dtype),
        steps=400,
        optimizer=optimizer,
    )
    np.testing.assert_allclose(found.params, target, rtol=1e-3)
    assert found.converged


def test_a_search_may_end_with_every_parameter_on_a_bound():
    found = jc.tune(
        lambda x: jnp.sum((x - 5) ** 2),
        jnp.zeros(1),
        steps=30,
        bounds=(-1.0, 1.0),
        optimizer=optax.adam(0.1),
    )
    np.testing.assert_allclose(found.params, 1.0)


def test_batches_share_parameters_and_starts_are_searched_beside_each_other():
    """Four worlds differ in mass and share stiffness and damping.

    Restarts end at the same minimum.
    """

    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.Spring("spring", jc.WORLD, "bob", 5.0, 0.3, point_a=(0.0, 1.0)))
    system, state = scene.build()
    masses = jnp.array([0.7, 1.0, 1.3, 2.0])

    def heights(p):
        def one(mass):
            own = system.with_params({"spring": p, "bob": {"mass": mass}})
            return jc.rollout(own, jc.Method(), state, None, 1e-2, 40, record=lambda s, i: s.q[1])

        last, y = jax.vmap(one)(masses)
        return jc.learning.losses.unless_failed(y, last)

    seen = heights(SPRING)
    options = {"restarts": 3, "spread": 1.0, "key": jax.random.key(0), "positive": True}
    found = jc.tune(
        lambda p: jc.learning.losses.tracking(heights(p), seen),
        {"stiffness": 5.0, "damping": 0.3},
        **options,
    )
    np.testing.assert_allclose([found.params[x] for x in SPRING], [8.0, 1.0], rtol=1e-9)
    assert np.all(np.nanmin(found.histories, axis=1) < 1e-18)


@pytest.mark.parametrize(
    ("scale", "optimizer"),
    [
        ("ratio", optax.adam(0.5)),
        ("ratio", optax.sgd(0.4, momentum=0.9)),
        ("log", optax.adam(0.5)),
        ("log", optax.sgd(0.4, momentum=0.9)),
    ],
)
def test_a_step_that_runs_away_is_taken_back_and_tried_again_shorter(scale, optimizer):
    """Beyond x = 2 the loss is 1e14 and flat, as it is for unstable gains."""

    def loss(x):
        width = 0.5 if scale == "ratio" else 1e-3
        value = jnp.where(x < 2.0, 1e-5 + width * (x - 1.9) ** 2, 1e14)
        return value if scale == "ratio" else jnp.log10(value)

    found = jc.tune(loss, jnp.asarray(0.0), steps=120, optimizer=optimizer)
    least = 1e-5 if scale == "ratio" else -5.0
    beyond = found.history > (1e3 if scale == "ratio" else 0.0)
    assert beyond.any()
    assert beyond.sum() == found.refused
    assert not beyond[-10:].all()
    assert found.loss < least + (1e-4 if scale == "ratio" else 1e-2)
    assert found.loss == found.history.min() == found.history[found.best_step]
    assert "taken back" in str(found)


def test_a_retry_begins_where_the_optimizer_was():
    """A retry takes half the step and the optimizer state of the accepted point.

    The failed step therefore does not enter the momentum.
    """
    seen = []

    def loss(x):
        jax.debug.callback(seen.append, x, ordered=True)
        return jnp.where(x > 1.0, jnp.nan, (x - 3.0) ** 2)

    momentum = optax.sgd(0.1, momentum=0.9)
    found = jc.tune(loss, jnp.asarray(0.0), steps=4, optimizer=momentum)
    first = 0.6
    second = first + 0.9 * 0.6 + 0.1 * 2 * (3.0 - first)  # beyond 1, so it fails
    half = first + 0.5 * (second - first)  # beyond 1, too
    quarter = first + 0.25 * (second - first)
    np.testing.assert_allclose(np.asarray(seen).ravel(), [0.0, first, second, half], rtol=1e-12)
    assert found.refused == 2
    again = jc.tune(loss, jnp.asarray(0.0), steps=5, optimizer=momentum)
    np.testing.assert_allclose(again.params, quarter, rtol=1e-12)
    assert again.best_step == 4


def test_a_search_with_samples_goes_back_to_the_last_end_of_a_chunk_that_was_good():
    def loss(x, key):
        noise = 1 + 0.1 * jax.random.normal(key)
        return jnp.where(x < 1.0, (x - 1.5) ** 2 * noise, 1e9 + x)

    options = {"samples": 8, "key": jax.random.key(0), "chunk": 5}
    found = jc.tune(loss, jnp.asarray(0.0), steps=200, optimizer=optax.sgd(0.05), **options)
    assert 0.9 < found.params < 1.0
    assert found.history[-40:].min() < 1.0  # the search returns from there


def test_a_start_stops_where_the_loss_falls_no_more():
    found = jc.tune(bowl, BOWL, steps=500, positive="a", patience=15, tolerance=1e-3)
    assert found.steps < 400
    assert len(found.history) == found.steps
    assert "fell no more" in found.stopped


def valley(x):
    """Returns a loss with minima 0.5 at 1 and 0 at −2; a start at 2 finds the former."""
    return jnp.minimum((x - 1) ** 2 + 0.5, (x + 2) ** 2)


def test_restarts_find_the_better_of_two_minima():
    start, options = jnp.asarray(2.0), {"steps": 80, "optimizer": optax.adam(0.1)}
    alone = jc.tune(valley, start, **options)
    assert abs(alone.loss - 0.5) < 1e-2
    found = jc.tune(valley, start, restarts=8, spread=3.0, key=jax.random.key(0), **options)
    assert found.loss < 1e-2
    assert found.histories.shape == (8, 80)
    np.testing.assert_allclose(found.histories[0], alone.history)  # of the given start
    assert "the best of 8 starts" in str(found)


def cliff(x):
    """Returns a loss that decreases up to x = 1.05 and is NaN beyond; steps of 0.3 pass it."""
    return jnp.where(x < 1.05, 2 - x, jnp.nan)


def test_a_loss_that_is_not_finite_somewhere_is_approached_with_shorter_steps():
    found = jc.tune(cliff, jnp.asarray(0.0), steps=60, optimizer=optax.sgd(0.3))
    assert 0.95 <= found.loss < 0.96
    assert np.isnan(found.history).any()
    assert "taken back" in str(found)
    assert found.params < 1.05


def test_a_gradient_that_is_not_finite_ends_the_start_and_keeps_the_best():
    found = jc.tune(lambda x: jnp.sqrt(jnp.abs(x)) + 1, jnp.asarray(0.0), steps=100)
    assert found.loss == 1.0  # its derivative is NaN
    assert found.steps < 30
    assert found.refused == found.steps
    assert f"{found.steps} steps were taken back" in str(found)
    assert "not finite" in found.stopped


def test_a_loss_that_is_finite_at_no_start_is_refused_at_once():
    seen = []

    def loss(x):
        jax.debug.callback(seen.append, x)
        return x * jnp.nan

    with pytest.raises(ValueError, match="not finite at the start"):
        jc.tune(loss, jnp.asarray(1.0), steps=50, chunk=3)
    assert len(seen) == 3


def test_a_start_without_a_number_harms_no_other():
    def loss(x):
        return jnp.where(x > 0, jnp.nan, (x + 1) ** 2)

    key = jax.random.key(1)
    found = jc.tune(loss, jnp.asarray(0.1), restarts=6, spread=1.0, key=key, steps=100)
    assert found.loss < 1e-2
    assert np.isnan(found.histories[0]).all()
    assert len(found.history) == 100


def test_the_least_of_an_expectation():
    """The minimum of E (x − k)² with normal k is the variance of k, at its mean 1."""

    def loss(x, key):
        return (x - 1 - 0.5 * jax.random.normal(key)) ** 2

    options = {"samples": 64, "key": jax.random.key(3), "optimizer": optax.adam(0.03)}
    found = jc.tune(loss, jnp.asarray(0.0), steps=150, **options)
    assert abs(found.params - 1) < 4 * 0.5 / 64**0.5
    assert 0.15 < found.loss < 0.4
    assert found.loss > found.history.min()  # a lucky draw is not the result


def test_a_start_that_is_the_best_is_what_comes_back():
    """Steps with few samples lead away from the minimum of the expectation at the start."""

    def loss(x, key):
        return x**2 + 3 * x * jax.random.normal(key)

    options = {"samples": 2, "key": jax.random.key(0), "optimizer": optax.sgd(0.3)}
    found = jc.tune(loss, jnp.asarray(0.0), steps=10, **options)
    assert found.params == found.loss == 0.0


def test_samples_without_a_number_are_left_out_and_counted():
    """NaN samples, and their gradients, are left out; a step may not increase their number."""

    def loss(x, key):
        chance = jax.random.uniform(key)
        root = jnp.sqrt(jnp.where(chance < jnp.where(x > 0.5, 0.35, 0.05), -1.0, 1.0) + 0 * x)
        return (x - 1) ** 2 * root

    options = {"samples": 32, "key": jax.random.key(0), "optimizer": optax.adam(0.02)}
    found = jc.tune(loss, jnp.asarray(0.0), steps=40, **options)
    assert 0 < found.lost < 6
    assert 0.2 < found.params <= 0.5
    np.testing.assert_allclose(found.loss, (found.params - 1) ** 2, rtol=1e-12)
    assert f"not finite at {found.lost} of its keys" in str(found)


def test_forward_mode_takes_the_same_way_and_goes_through_loops():
    """A while loop has no reverse mode."""

    def looped(p):
        def more(known):
            return known[0] < 3

        def one(known):
            return known[0] + 1, known[1] + (known[1] - p["a"]) ** 2

        value = jnp.sum((jnp.log(p["a"]) - 1) ** 2) + (p["c"] - 2.0) ** 2
        return value + 1e-3 * jnp.sum(jax.lax.while_loop(more, one, (0, p["a"]))[1])

    def unrolled(p):
        value = jnp.sum((jnp.log(p["a"]) - 1) ** 2) + (p["c"] - 2.0) ** 2
        return value + 1e-3 * jnp.sum(p["a"])

    start = {"a": jnp.array([1.0, 3.0]), "c": 0.0}
    with pytest.raises(ValueError, match="Reverse-mode"):
        jc.tune(looped, start, steps=3)
    found = jc.tune(looped, start, steps=30, forward=True, positive="a")
    expected = jc.tune(unrolled, start, steps=30, positive="a")
    np.testing.assert_allclose(found.history, expected.history, rtol=1e-12)


@pytest.mark.parametrize(("progress", "shown"), [(None, False), (False, False), (True, True)])
def test_a_bar_is_shown_where_it_is_wanted(progress, shown, capsys):
    jc.tune(lambda x: x**2, jnp.asarray(1.0), steps=2, progress=progress)
    jc.identify(lambda x: x * jnp.ones(3), 1.0, np.ones(3), noise=1.0, progress=progress)
    written = capsys.readouterr().err
    assert ("tuning" in written) == ("identifying" in written) == shown


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
    assert part.loss <= part.history[0]  # the best point so far is returned
    again = jc.tune(loss, start, checkpoint=file, **options)
    assert again.steps == 45
    np.testing.assert_array_equal(again.params, whole.params)
    np.testing.assert_array_equal(again.histories, whole.histories)
    assert again.loss == whole.loss
    assert [x.name for x in tmp_path.iterdir()] == ["search.npz"]


def test_a_search_that_goes_on_is_judged_where_it_would_have_been(tmp_path, monkeypatch):
    """Chunks end at the same steps, whatever number of steps an earlier call requested."""
    from jaxcon.learning import tuning

    options = {"samples": 2, "key": jax.random.key(2), "optimizer": optax.adam(0.1), "chunk": 10}
    options["checkpoint"] = tmp_path / "search.npz"
    jc.tune(noisy, jnp.zeros(2), steps=13, **options)
    write, seen = tuning.files.write, []

    def written(file, about, found):
        seen.append(int(found[0].step[0]))
        write(file, about, found)

    monkeypatch.setattr(tuning.files, "write", written)
    jc.tune(noisy, jnp.zeros(2), steps=37, **options)
    assert seen == [20, 30, 37]


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
    with pytest.raises(ValueError, match="another search.*the number of steps"):
        jc.tune(loss, start, steps=20, checkpoint=file)
    other = optax.sgd(0.1)
    own = tmp_path / "own.npz"
    jc.tune(loss, start, steps=5, checkpoint=own, optimizer=other)
    assert jc.tune(loss, start, steps=20, checkpoint=own, optimizer=other).steps == 20


def test_a_traced_search_is_refused():
    with pytest.raises(TypeError, match="tune is host code.*map over worlds in the loss"):
        jax.jit(lambda x: jc.tune(lambda y: y**2, x).loss)(1.0)


def damaged_header(file):
    """Writes a file with an unknown compression method."""
    np.savez(file, about=np.array("{}"))
    written = bytearray(file.read_bytes())
    written[written.rindex(b"PK\x01\x02") + 10] = 99
    file.write_bytes(written)


def array(file):
    np.save(file.with_suffix(".npy"), np.ones(3))
    file.with_suffix(".npy").rename(file)


FOREIGN = {
    "text": lambda file: file.write_text("no checkpoint"),
    "array": array,
    "list": lambda file: np.savez(file, about=np.array("[1]")),
    "header": damaged_header,
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_is_no_checkpoint_is_refused_in_words(kind, tmp_path):
    file = tmp_path / "search.npz"
    FOREIGN[kind](file)
    with pytest.raises(ValueError, match="is no checkpoint"):
        files.read(file, {}, {"x": 1}, "tune")


def test_a_checkpoint_that_cannot_be_written_is_refused_before_the_search(tmp_path):
    def never(x):
        raise AssertionError

    for file, what in ((tmp_path / "no" / "x.npz", "lies in no folder"), (tmp_path, "is a folder")):
        with pytest.raises(ValueError, match=what):
            jc.tune(never, jnp.zeros(2), checkpoint=file)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"positive": "q"}, "there is no leaf 'q'"),
        ({"positive": "b"}, "'b/c' is to stay positive"),
        ({"positive": 3}, "must be bools or names"),
        ({"positive": {"q": True}}, "positive must have the structure of the parameters"),
        ({"bounds": {"a": (2.0, 4.0)}}, "'a' must start within its bounds"),
        ({"bounds": {"a": 2.0}}, "needs bounds"),
        ({"bounds": {"b": (0, 1), "b/*": (0, 1)}}, "meant by each of"),
        ({"restarts": 2}, "give key="),
        ({"restarts": 2, "key": jax.random.key(0)}, "give spread="),
        (
            {"restarts": 2, "spread": np.nan, "key": jax.random.key(0)},
            "spread must be zero or more",
        ),
        (  # without an error, it would be one spread for each start
            {"restarts": 2, "spread": np.ones(2), "key": jax.random.key(0)},
            r"broadcasts to the shape \(\) of 'b/c', got \(2,\)",
        ),
        ({"steps": 0}, "whole number from 1"),
        ({"patience": 0}, "patience must be a whole number from 1"),
        ({"patience": 5, "tolerance": np.nan}, "tolerance must be zero or more and finite"),
        ({"tolerance": 1e-3}, "tolerance=0.001 .* give patience="),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(options, what):
    with pytest.raises(ValueError, match=what):
        jc.tune(bowl, BOWL, **options)


def test_an_optimizer_that_loses_its_way_is_named():
    """After three steps the optimizer's step is NaN, although loss and gradient are finite."""
    lost = optax.scale_by_schedule(lambda count: jnp.where(count < 3, -0.1, jnp.nan))
    found = jc.tune(lambda x: (x - 1.0) ** 2, 0.0, optimizer=lost, steps=20)
    assert found.stopped.startswith("the optimizer's step from the last point is not finite")
    np.testing.assert_allclose(found.history, (0.8 ** np.arange(4)) ** 2)
    np.testing.assert_allclose(found.params, 1 - 0.8**3)
    assert found.refused == 0


def test_a_loss_must_be_a_scalar_and_parameters_numbers():
    with pytest.raises(TypeError, match="floating scalar"):
        jc.tune(lambda x: x, jnp.zeros(2))
    with pytest.raises(TypeError, match="floating scalar.*None"):
        jc.tune(lambda x: None, jnp.zeros(2))
    with pytest.raises(TypeError, match=r"called as loss\(params\).*missing.*'key'"):
        jc.tune(noisy, jnp.zeros(2))
    with pytest.raises(TypeError, match=r"called as loss\(params, key\).*samples=2"):
        jc.tune(lambda x: x, jnp.zeros(2), samples=2, key=jax.random.key(0))
    with pytest.raises(TypeError, match=r"key must be a random key.*got 0"):
        jc.tune(noisy, jnp.zeros(2), samples=2, key=0)
    with pytest.raises(TypeError, match=r"key must be a single key, got an array \(3,\) of keys"):
        jc.tune(noisy, jnp.zeros(2), samples=2, key=jax.random.split(jax.random.key(0), 3))
    with pytest.raises(TypeError, match="mesh must be one of jax.sharding.Mesh, got 3"):
        jc.tune(jnp.sum, jnp.zeros(2), mesh=3)
    with pytest.raises(TypeError, match="optimizer must be a transformation of optax"):
        jc.tune(jnp.sum, jnp.zeros(2), optimizer=optax.adam)
    with pytest.raises(TypeError, match="forward must be True or False, got 'yes'"):
        jc.tune(jnp.sum, jnp.zeros(2), forward="yes")
    with pytest.raises(ValueError, match="2 leaves of the parameters are named 'a/b'"):
        jc.tune(lambda p: p["a/b"], {"a": {"b": 1.0}, "a/b": 2.0})
    with pytest.raises(ValueError, match="no floating number"):
        jc.tune(lambda x: 0.0, {"n": jnp.asarray(3)})
    for whole in (3, np.int64(3), np.array([3])):
        with pytest.raises(ValueError, match="'stiffness' is a whole number.*write it as a float"):
            jc.tune(lambda p: p["stiffness"], {"stiffness": whole, "damping": 0.1})
    for other in ("rod", "float32", jnp.sum):  # also the name of a dtype
        with pytest.raises(ValueError, match="'name' is .* and no number; leave it out"):
            jc.tune(lambda p: p["x"], {"x": 1.0, "name": other})
    with pytest.raises(ValueError, match="must be finite"):
        jc.tune(lambda x: x, jnp.nan)


def pendulum(dtype=None):
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.3))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.0))  # 4 cm too short
    scene.add(jc.forces.ExternalWrench("push", "bob"))
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


def test_a_tuned_method_runs_under_jit():
    """Tuned gains are arrays, which checks under jit must not take for traced values."""
    system, state = pendulum()

    def loss(method):
        start = jc.init(system, method, state.q, state.v)
        run = jc.rollout(system, method, start, None, 1e-2, 10, record=lambda s, i: i.violation)
        return jc.learning.losses.violation(run[1], 1e-2)

    method = jc.Method(stabilizer=jc.stabilizers.PID(25.0, 10.0, 1.0))
    found = jc.tune(loss, method, steps=np.int64(2), positive="stabilizer")
    assert isinstance(found.params.stabilizer.integral, jax.Array)
    np.testing.assert_allclose(jax.jit(lambda: loss(found.params))(), found.loss)


def test_numbers_of_a_system_a_start_and_controls_together():
    """A length, the initial velocity and the forces over time bring a bob to a target."""
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
    """One call finds argmin E[L_task + α L_constraint(k)]; each key draws another start."""
    system, state = pendulum()

    def loss(k, key):
        method = jc.Method(stabilizer=jc.stabilizers.Penalty(k, 1.0))
        start = dataclasses.replace(state, v=0.3 * jax.random.normal(key, (2,)))
        final, (q, off) = jc.rollout(
            system, method, start, None, 1e-2, 20, record=lambda s, i: (s.q, i.violation)
        )
        task = jc.learning.losses.tracking(q, np.tile([1.0, 0.0], (20, 1)))
        terms = {"task": task, "constraint": jc.learning.losses.violation(off, 1e-2)}
        value, terms = jc.learning.losses.weighted(terms, {"task": 1.0, "constraint": 0.3})
        return jc.learning.losses.unless_failed(value, final), terms

    options = {"samples": 8, "key": jax.random.key(0), "optimizer": optax.adam(0.2)}
    found = jc.tune(loss, jnp.asarray(10.0), positive=True, steps=40, **options)
    assert found.aux["task"].shape == (8,)
    assert found.params > 20.0
    judge = jax.jit(
        lambda k: jnp.mean(jax.vmap(lambda key: loss(k, key)[0])(jax.random.split(KEY, 64)))
    )
    assert judge(found.params) < judge(jnp.asarray(10.0)) - 0.05


KEY = jax.random.key(9)
"""A key for samples that no search has used."""


def test_samples_that_fail_at_first_do_not_end_a_search():
    """Every step has new keys: samples of the first one fail, yet all steps are made."""

    def loss(x, key):
        fails = jax.random.uniform(key) < 0.4
        return jnp.where(fails, jnp.nan, (x - 1.0) ** 2)

    steps, key = 30, jax.random.key(3)
    found = jc.tune(loss, 0.0, samples=3, steps=steps, chunk=1, key=key, optimizer=optax.adam(0.1))
    assert np.isnan(found.history[0])
    assert found.history.shape == (steps,)
    assert found.loss < 1.0
