"""Identification of parameters from recordings: values, errors, and unidentifiable parameters."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scenes

import jaxcon as jc
from jaxcon.learning.least_squares import FitProgress, Precision, least_squares, side_by_side
from jaxcon.learning.leaves import space_of
from jaxcon.learning.stretches import Stretches

TIMES = jnp.linspace(0.0, 6.0, 300)
TRUTH = {"size": 2.0, "gain": 1.5, "decay": 0.3, "offset": 0.4}
GUESS = {"size": 1.0, "gain": 1.0, "decay": 1.0, "offset": 0.0}
POSITIVE = ("size", "gain", "decay")


def ringing(p):
    """A decaying wave in which size and gain enter only as their product."""
    wave = p["size"] * p["gain"] * jnp.exp(-p["decay"] * TIMES) * jnp.cos(3 * TIMES)
    return {"x": wave + p["offset"]}


def recorded(noise, seed=0):
    x = np.array(ringing(TRUTH)["x"])
    x += noise * np.random.default_rng(seed).normal(size=x.shape)
    x[50:60] = np.nan
    return {"x": x}


def test_a_recording_with_gaps_gives_parameters_noise_and_errors():
    found = jc.identify(ringing, GUESS, recorded(0.05), positive=POSITIVE)
    assert found.observed == 290
    assert found.stopped == "converged"
    assert abs(found.noise - 0.05) < 0.005
    for name in ("decay", "offset"):
        error = found.errors[name]
        assert 1e-3 < error < 1e-2
        assert abs(found.params[name] - TRUTH[name]) < 3 * error
    product = found.params["size"] * found.params["gain"]
    assert abs(product - 3.0) < 0.05
    again = jc.identify(ringing, GUESS, recorded(0.05), positive=POSITIVE, noise=found.noise)
    np.testing.assert_allclose(again.errors["decay"], found.errors["decay"], rtol=1e-5)
    assert abs(again.noise - 1) < 1e-5


@pytest.mark.parametrize("start", [(20.0, 0.05), (100.0, 30.0), (1000.0, 0.01)])
def test_a_far_start_does_not_lead_out_of_all_numbers(start):
    """An unbounded step in the logarithms went to 1e-300, where the data seem uninformative."""
    height = scenes.hanging()
    seen = height({"stiffness": 8.0, "damping": 1.0})
    guess = dict(zip(("stiffness", "damping"), start, strict=True))
    found = jc.identify(height, guess, seen, positive=True)
    assert found.stopped == "converged"
    np.testing.assert_allclose([found.params[x] for x in guess], [8.0, 1.0], rtol=1e-9)
    assert not found.untold


@pytest.mark.parametrize(("steps", "noise"), [(120, 0.1), (200, 0.0), (600, 0.15)])
def test_local_minima_of_long_recordings_are_left_by_way_of_their_first_parts(steps, noise):
    """A fit of the whole recording at once ends at k = 76 or k = 46 from most of these starts."""
    height, truth = scenes.hanging(steps=steps), {"stiffness": 8.0, "damping": 1.0}
    data = height(truth) + noise * np.random.default_rng(1).normal(size=steps)
    near = jc.identify(height, truth, data, positive=True)
    for factors in ((0.178, 31.6), (5.6, 5.6), (31.6, 0.03), (31.6, 31.6)):
        guess = {name: truth[name] * x for name, x in zip(truth, factors, strict=True)}
        found = jc.identify(height, guess, data, positive=True)
        assert found.converged, factors
        for name in truth:
            np.testing.assert_allclose(found.params[name], near.params[name], rtol=1e-6)
            assert noise or abs(found.params[name] / truth[name] - 1) < 1e-9


@pytest.mark.parametrize("shape", [(300,), (3, 100), (100, 3)])
@pytest.mark.parametrize("given", [None, 0.05])
def test_residuals_that_noise_does_not_explain_are_no_convergence(given, shape):
    """The recording contains a second wave that the model lacks.

    With noise alone the fit converges.
    """
    lacking = np.asarray(0.3 * jnp.sin(0.8 * TIMES))

    def model(p):
        return wave(p).reshape(shape)

    noise = 0.05 * np.random.default_rng(0).normal(size=300)
    known = np.asarray(wave({"a": 2.0, "b": 0.4})) + noise
    start = {"a": 1.0, "b": 0.1}
    found = jc.identify(model, start, (known + lacking).reshape(shape), noise=given)
    assert not found.converged
    assert "at a minimum, but the residuals, " in found.stopped
    assert "local minimum, or the model lacks something" in str(found)
    assert ("times the noise given" in found.stopped) == (given is not None)
    whole = jc.identify(model, start, known.reshape(shape), noise=given)
    assert whole.converged
    exact = jc.identify(model, start, wave({"a": 2.0, "b": 0.4}).reshape(shape))
    assert exact.converged


def test_what_is_beyond_all_numbers_is_not_tried_and_has_an_infinite_error():
    space = space_of({"x": np.float32(2.0)}, True, None, "identify")
    for end in space.limits[0] + space.limits[1]:
        assert 0 < space.decode((end,))["x"] < np.inf
    largest = {"x": np.finfo(np.float32).max}
    top = space_of(largest, True, None, "identify")
    assert top.decode(top.encode(largest))["x"] == largest["x"]
    with pytest.raises(ValueError, match="'x' is to stay positive"):
        space_of({"x": np.float32(1e-44)}, True, None, "identify")
    ones = np.ones(9, np.float32)
    found = jc.identify(lambda p: p["x"] * ones / 1e30, {"x": np.float32(1.0)}, ones, positive=True)
    assert not np.isnan(found.errors["x"])


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_direction_that_data_do_not_tell_is_named(noise):
    found = jc.identify(ringing, GUESS, recorded(noise), positive=POSITIVE)
    (direction,) = found.untold
    assert set(direction) == {"size", "gain"}
    assert abs(direction["size"] + direction["gain"]) < 1e-6
    assert np.isinf(found.errors["size"])
    assert np.isinf(found.condition)
    assert "do not tell the relative change" in str(found)
    assert "+0.71" in str(found)
    np.testing.assert_allclose(found.params["size"], found.params["gain"], rtol=1e-6)  # as at start


def test_what_is_masked_was_not_seen():
    time = np.linspace(0, 1, 20)
    data = np.ma.masked_array(2 * time, mask=np.arange(20) == 3)
    data.data[3] = 50.0
    found = jc.identify(lambda p: p * time, 1.0, data)
    np.testing.assert_allclose(found.params, 2.0, rtol=1e-7)
    assert found.observed == 19


def test_errors_are_those_of_linear_least_squares():
    """The errors follow σ² (XᵀX)⁻¹, in the units of the parameters."""
    X = np.random.default_rng(1).normal(size=(50, 3))
    y = X @ np.array([1.0, -2.0, 0.0]) + 0.1
    found = jc.identify(lambda b: jnp.asarray(X) @ b, jnp.array([3.0, 0.0, 1.0]), y, noise=0.2)
    expected = np.linalg.lstsq(X, y)[0]
    np.testing.assert_allclose(found.params, expected, rtol=1e-7)
    np.testing.assert_allclose(
        found.errors, 0.2 * np.sqrt(np.diag(np.linalg.inv(X.T @ X))), rtol=1e-7
    )
    assert list(found.table) == ["[0]", "[1]", "[2]"]


def test_adam_finds_the_same():
    data, start = recorded(0.05), {k: v for k, v in GUESS.items() if k != "gain"}

    def simulate(p):
        return ringing(p | {"gain": 1.5})

    found = jc.identify(simulate, start, data, positive=("size", "decay"))
    assert not found.untold
    tuned = jc.tune(
        lambda p: jc.learning.losses.tracking(simulate(p), data),
        start,
        steps=300,
        positive=("size", "decay"),
        optimizer=optax.adam(optax.cosine_decay_schedule(0.1, 300)),
    )
    for name, x in tuned.params.items():
        assert abs(x - found.params[name]) < 0.1 * found.errors[name]


def test_bounds_hold_and_an_optimum_may_lie_on_one():
    found = jc.identify(
        ringing, GUESS, recorded(0.05), positive=POSITIVE, bounds={"decay": (0.5, None)}
    )
    assert found.params["decay"] == 0.5
    free = {"decay": 0.5, "gain": 1.5}
    expected = jc.identify(
        lambda p: ringing(p | free), {"size": 1.0, "offset": 0.0}, recorded(0.05)
    )
    np.testing.assert_allclose(found.params["offset"], expected.params["offset"], rtol=1e-6)


def fitted(function, start, steps=50):
    """Returns the result of one search."""
    free, precision = np.full(2, np.inf), Precision(1e-8, 1.0)
    search = least_squares(FitProgress(start), (-free, free), steps, precision)
    return side_by_side([search], lambda asked: {0: function(asked[0])})[0]


def test_an_interrupt_keeps_what_was_found():
    """Rosenbrock's valley, interrupted after a few evaluations."""
    calls = []

    def valley(z):
        calls.append(z)
        if len(calls) == 8:
            raise KeyboardInterrupt
        x, y = z
        return np.array([1 - x, 10 * (y - x * x)]), np.array([[-1.0, 0.0], [-20 * x, 10.0]])

    start = np.array([-1.2, 1.0])
    fit = fitted(valley, start)
    assert fit.broken
    assert fit.costs[-1] < fit.costs[0]
    np.testing.assert_allclose(fit.costs[-1], np.sum(fit.residual**2) / 2)
    calls = [None] * 8
    whole = fitted(valley, start)
    np.testing.assert_allclose(whole.z, 1.0, atol=1e-7)
    assert whole.stopped == "converged"
    short = fitted(valley, start, 3)
    assert len(short.costs) == 4
    assert "before it converged" in short.stopped


def test_all_may_lie_on_their_bounds():
    found = jc.identify(lambda x: x * jnp.ones(3), 0.0, np.ones(3), bounds=(-1.0, 0.5), noise=1.0)
    assert found.params == 0.5
    assert found.stopped == "converged"
    assert "the parameter = 0.5, on its bound" in str(found)


def wave(p):
    """A model that is linear in both parameters."""
    return p["a"] * jnp.cos(3 * TIMES) + p["b"]


WAVE = np.asarray(wave({"a": 2.0, "b": 0.4})) + 0.01 * np.random.default_rng(0).normal(size=300)


def test_a_bound_holds_the_errors_of_the_others_and_has_none():
    """The errors of the other parameters are those for a known value at the bound."""
    found = jc.identify(wave, {"a": 1.0, "b": 0.1}, WAVE, bounds={"b": (0.0, 0.2)})
    given = jc.identify(lambda a: wave({"a": a, "b": 0.2}), 1.0, WAVE)
    np.testing.assert_allclose(found.errors["a"], given.errors, rtol=1e-9)
    np.testing.assert_allclose(found.noise, given.noise, rtol=1e-9)
    assert np.isnan(found.errors["b"])
    assert found.bounded == ("b",)
    assert "b = 0.2, on its bound" in str(found)


@pytest.mark.parametrize(
    ("dtype", "start"), [(jnp.float64, 1e-9), (jnp.float64, 0.0), (jnp.float32, 1e-5)]
)
def test_a_start_near_zero_is_no_reason_to_stay_there(dtype, start):
    times = TIMES.astype(dtype)
    guess = {"a": jnp.asarray(1.0, dtype), "b": jnp.asarray(start, dtype)}
    found = jc.identify(lambda p: p["a"] * jnp.cos(3 * times) + p["b"], guess, WAVE)
    X = np.stack([np.cos(3 * np.asarray(TIMES)), np.ones(300)], 1)
    (_, expected), square = np.linalg.lstsq(X, WAVE)[:2]
    error = np.sqrt(np.linalg.inv(X.T @ X)[1, 1] * square[0] / 298)
    np.testing.assert_allclose(found.params["b"], expected, rtol=1e-5)
    np.testing.assert_allclose(found.errors["b"], error, rtol=1e-4)
    assert not found.untold


def test_a_weak_parameter_is_found_beside_a_strong_one_in_float32():
    """Their columns differ by a factor of 2e4 in length and are nearly orthogonal."""
    times = np.asarray(TIMES)
    X = np.stack([1e3 * np.cos(3 * times), 0.2 * np.sin(5 * times)], 1)
    data = X @ np.array([2.0, 1.0]) + 1e-2 * np.random.default_rng(0).normal(size=300)
    columns = jnp.asarray(X, jnp.float32)

    def both(p):
        return p["a"] * columns[:, 0] + p["b"] * columns[:, 1]

    guess = {"a": jnp.float32(1.9), "b": jnp.float32(0.5)}
    found = jc.identify(both, guess, data, positive=True, noise=1e-2)
    error = 1e-2 * np.sqrt(np.linalg.inv(X.T @ X)[1, 1])
    assert abs(float(found.params["b"]) - np.linalg.lstsq(X, data)[0][1]) < 0.2 * error
    np.testing.assert_allclose(found.errors["b"], error, rtol=1e-2)
    assert not found.untold


def test_a_wall_of_what_is_no_number_is_no_convergence():
    found = jc.identify(
        lambda x: jnp.where(x < 1.05, x, jnp.nan) * jnp.ones(3), 0.5, np.full(3, 2.0), noise=1.0
    )
    assert 1.0 < found.params < 1.05
    assert "not finite around the last point" in found.stopped


def test_data_that_are_met_exactly_are_known_to_rounding():
    """A model that reproduces its data leaves a residual of exactly zero."""
    data = np.array([1.0, 2.0, 4.0, 8.0])
    found = jc.identify(lambda a: a * jnp.asarray(data), jnp.asarray(1.0), data)
    rounding = np.finfo(float).eps * np.linalg.norm(data) / 2
    assert found.params == 1
    np.testing.assert_allclose(found.noise, rounding)
    np.testing.assert_allclose(found.errors, rounding / np.linalg.norm(data))
    assert found.condition == 1


def test_no_degree_of_freedom_tells_no_noise():
    """Two data and two parameters; if the noise is given, the errors are known."""
    X, data = np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([1.1, 1.9])
    found = jc.identify(lambda b: jnp.asarray(X) @ b, jnp.array([1.0, 0.5]), data)
    np.testing.assert_allclose(found.params, np.linalg.solve(X, data))
    assert np.isnan(found.noise)
    assert np.isnan(found.errors).all()
    assert "no degree of freedom is left" in str(found)
    known = jc.identify(lambda b: jnp.asarray(X) @ b, jnp.array([1.0, 0.5]), data, noise=0.1)
    np.testing.assert_allclose(known.errors, 0.1 * np.sqrt(np.diag(np.linalg.inv(X.T @ X))))


def test_directions_that_are_not_told_take_no_degree_of_freedom():
    """Two of three parameters enter only as their sum; the residual is that of a straight line."""
    times, data = np.arange(5.0), np.array([0.1, -0.2, 0.15, 0.05, -0.1])

    def line(p):
        return (p[0] + p[1]) + p[2] * jnp.asarray(times)

    found = jc.identify(line, jnp.ones(3), data)
    square = np.linalg.lstsq(np.stack([np.ones(5), times], 1), data)[1][0]
    np.testing.assert_allclose(found.noise, np.sqrt(square / 3), rtol=1e-6)


def test_leaves_that_are_not_searched_are_kept_as_they_are():
    """Integer leaves stay concrete, so that the model can use them as counts.

    They have no errors.
    """

    data = np.array([8.0, 8.1, 7.9])

    def power(p):
        return p["a"] * jnp.ones(3) * sum(p["k"].tolist()) + len(range(p["n"]))

    found = jc.identify(power, {"a": 1.0, "k": jnp.arange(3), "n": jnp.asarray(2)}, data)
    np.testing.assert_allclose(found.params["a"], 2.0)
    assert list(found.table) == ["a"]
    assert np.isnan(found.errors["k"]).all()
    assert found.errors["k"].shape == (3,)
    assert "a = 2 ±" in str(found)


def test_what_a_simulation_reads_elsewhere_may_change_between_two_calls():
    outside = {"gain": 1.0}

    def simulate(x):
        return outside["gain"] * x * jnp.ones(3)

    assert jc.identify(simulate, 1.0, np.full(3, 2.0), noise=1.0).params == 2.0
    outside["gain"] = 2.0
    assert jc.identify(simulate, 1.0, np.full(3, 2.0), noise=1.0).params == 1.0


def oscillate(rate, node):
    """Returns a segment of 20 samples of ẍ = −ω² x from a node, and the state at its end."""
    t = 0.05 * jnp.arange(21.0)
    c, s = jnp.cos(rate * t), jnp.sin(rate * t)
    x = node["x"] * c + node["v"] / rate * s
    v = node["v"] * c - node["x"] * rate * s
    return x[:-1], {"x": x[-1], "v": v[-1]}


def long_recording(stretches):
    t = 0.05 * np.arange(20 * stretches)
    return np.cos(3.0 * t) + 0.05 * np.random.default_rng(2).normal(size=t.shape)


def test_a_long_recording_is_fitted_in_stretches_or_in_longer_and_longer_parts():
    """A long cosine has a narrow basin around its minimum over ω.

    Short segments have a wide one.
    """
    x = long_recording(10)
    times = 0.05 * jnp.arange(200.0)
    one = jc.identify(lambda rate: jnp.cos(rate * times), jnp.asarray(4.0), x, positive=True)
    assert abs(one.params - 3) < 3 * one.errors
    data = x.reshape(10, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(10)}
    found = jc.identify(oscillate, jnp.asarray(4.0), data, nodes=nodes, positive=True)
    assert abs(found.params - 3) < 3 * found.errors
    assert found.errors < 4e-3
    assert abs(found.noise - 0.05) < 0.01
    ends = jax.vmap(lambda n: oscillate(found.params, n)[1])(found.nodes)
    np.testing.assert_allclose(ends["x"][:-1], found.nodes["x"][1:], atol=1e-3)


def interrupt(monkeypatch, when, error=KeyboardInterrupt):
    """Raises an error in an identification when when(points so far) is true.

    Returns the points of all evaluations.
    """
    evaluate, seen = Stretches.evaluate, []

    def watched(problem, points):
        seen.append(points)
        if when(seen):
            raise error
        return evaluate(problem, points)

    monkeypatch.setattr(Stretches, "evaluate", watched)
    return seen


@pytest.mark.parametrize("where", [1, 3])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("no room")])
def test_what_ends_the_second_decade_ends_the_search(where, error, monkeypatch):
    """The error comes at the first evaluation of the decade or later; earlier results are kept."""

    def second(seen):
        widths = [points[0][1] for points in seen[1:]]  # the start is evaluated first
        return len(set(widths)) == 2 and widths.count(widths[-1]) == where

    seen = interrupt(monkeypatch, second, error)
    data = long_recording(4).reshape(4, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(4)}
    found = jc.identify(oscillate, jnp.asarray(4.0), data, nodes=nodes, positive=True)
    assert len({points[0][1] for points in seen[1:]}) == 2
    assert ("no room" if isinstance(error, OSError) else "interrupted") in found.stopped
    assert abs(found.params - 3) < 0.5


@pytest.mark.parametrize("restarts", [1, 3])
@pytest.mark.parametrize("kind", ["one", "stretches", "parts"])
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(
    kind, restarts, tmp_path, monkeypatch
):
    """The process is killed at some evaluations; the search resumes at the last step."""
    file = tmp_path / "search.npz"
    data, options = long_recording(4).reshape(4, 20), {"positive": True}
    if restarts > 1:
        options |= {"restarts": restarts, "spread": 0.1, "key": jax.random.key(1)}
    calls_until_killed = (2, 3, 4, 6)
    if kind == "parts":
        times = 0.05 * jnp.arange(80.0)
        problem = (lambda rate: jnp.cos(rate * times), jnp.asarray(5.0), data.ravel())
        calls_until_killed = (20, 30, 10, 15)  # of 77 calls, 42 of them for the whole
    elif kind == "stretches":
        options["nodes"] = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(4)}
        problem = (oscillate, jnp.asarray(4.0), data)
    else:
        problem = (lambda p: jnp.exp(-p["d"] * jnp.arange(4.0)) * p["a"],)
        problem += ({"d": 1.0, "a": 1.0}, np.array([2.0, 1.0, 0.6, 0.4]))
    with monkeypatch.context() as patch:
        calls_of_whole = interrupt(patch, lambda seen: False)
        whole = jc.identify(*problem, **options)
    ended = 0
    for calls in calls_until_killed:
        with monkeypatch.context() as patch:
            killed = MemoryError()  # not caught, as if the process were killed
            interrupt(patch, lambda seen, calls=calls: len(seen) == calls, killed)
            with pytest.raises(MemoryError):
                jc.identify(*problem, checkpoint=file, **options)
            ended += file.exists()
    assert ended >= 3
    with monkeypatch.context() as patch:
        interrupt(patch, lambda seen: len(seen) == 3)
        part = jc.identify(*problem, checkpoint=file, **options)
    assert "interrupted" in part.stopped
    with monkeypatch.context() as patch:
        calls_of_rest = interrupt(patch, lambda seen: False)
        again = jc.identify(*problem, checkpoint=file, **options)
    assert kind != "parts" or len(calls_of_rest) < len(calls_of_whole) / 3
    for name in ("params", "errors", "noise", "costs", "ends"):
        for x, y in zip(*(jax.tree.leaves(getattr(f, name)) for f in (again, whole)), strict=True):
            np.testing.assert_array_equal(x, y, err_msg=name)
    assert again.stopped == whole.stopped
    assert [x.name for x in tmp_path.iterdir()] == ["search.npz"]


def test_more_steps_may_be_asked_of_a_checkpoint_and_nothing_else(tmp_path):
    file = tmp_path / "search.npz"
    short = jc.identify(ringing, GUESS, recorded(0.05), steps=2, checkpoint=file)
    assert "before it converged" in str(short)
    longer = jc.identify(ringing, GUESS, recorded(0.05), checkpoint=file)
    assert longer.stopped == "converged"
    whole = jc.identify(ringing, GUESS, recorded(0.05))
    np.testing.assert_array_equal(longer.costs, whole.costs)
    assert short.ends[0] < whole.costs[0]
    others = [
        (GUESS, {"data": recorded(0.05, 1)}, "the data"),
        (GUESS | {"decay": 1.1}, {}, "the start"),
        (GUESS, {"positive": POSITIVE}, "the simulation, another option"),
        (GUESS, {"bounds": {"decay": (0.0, 9.0)}}, "the bounds"),
        (GUESS, {"noise": 0.05}, "noise"),
    ]
    for guess, options, what in others:
        options = {"data": recorded(0.05)} | options
        with pytest.raises(ValueError, match=f"(?s)identify: .*another search.*{what}"):
            jc.identify(ringing, guess, checkpoint=file, **options)
    with pytest.raises(ValueError, match="identify: checkpoint.*lies in no folder"):
        jc.identify(ringing, GUESS, recorded(0.05), checkpoint=tmp_path / "no" / "x.npz")


def test_restarts_find_the_better_of_two_rates():
    """A long cosine has a narrow basin; starts that are not finite do not affect the others.

    The data are shuffled in time, so that the search cannot begin with a short first part.
    """
    order = np.random.default_rng(0).permutation(200)
    times, data = 0.05 * jnp.arange(200.0)[order], long_recording(10)[order]

    def simulate(rate):
        return jnp.where(rate > 1.0, jnp.cos(rate * times), jnp.nan)

    options = {"restarts": 12, "spread": 0.3, "key": jax.random.key(0), "positive": True}
    found = jc.identify(simulate, jnp.asarray(4.0), data, **options)
    assert abs(found.params - 3) < 3 * found.errors
    assert found.ends.shape == (12,)
    assert found.ends[0] > 2 * found.ends.min()  # of the given start
    assert "the best of 12 starts" in str(found)
    alone = jc.identify(simulate, jnp.asarray(4.0), data, positive=True)
    np.testing.assert_allclose(alone.costs[-1], found.ends[0], rtol=1e-9)
    partly = jc.identify(simulate, jnp.asarray(0.9), data, **options)
    assert partly.ends[0] == np.inf
    assert partly.params > 1.0
    with pytest.raises(ValueError, match="identify: restarts from one place"):
        jc.identify(simulate, 4.0, data, restarts=2, key=jax.random.key(0))
    with pytest.raises(ValueError, match="identify: .*give key="):
        jc.identify(simulate, 4.0, data, restarts=2, spread=0.1)


def test_noise_of_each_number_counts_in_its_own_stretch():
    """Uniform noise equals a single number; segments with huge noise count as not recorded."""
    data = long_recording(4).reshape(4, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(4)}

    def errors(noise, data=data):
        found = jc.identify(oscillate, jnp.asarray(3.2), data, nodes=nodes, noise=noise)
        return np.array([found.params, found.errors])

    same = np.full((4, 20), 0.05)
    np.testing.assert_allclose(errors(same), errors(0.05), rtol=1e-9)
    blind = same.copy()
    blind[2:] = 1e6
    unseen = data.copy()
    unseen[2:] = np.nan
    np.testing.assert_allclose(errors(blind), errors(0.05, unseen), rtol=1e-5)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-3])
def test_how_nearly_ends_meet_nodes_does_not_depend_on_the_unit_of_the_data(unit):
    """Noise that is not given is estimated first; gaps between segments are weighed with it."""
    data = long_recording(6).reshape(6, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(6)}

    def simulate(rate, node):
        x, end = oscillate(rate, node)
        return unit * x, end

    found = jc.identify(simulate, jnp.asarray(3.2), unit * data, nodes=nodes)
    again = jc.identify(oscillate, jnp.asarray(3.2), data, nodes=nodes, noise=found.noise / unit)
    np.testing.assert_allclose(found.params, again.params, rtol=1e-6)
    np.testing.assert_allclose(found.errors, again.errors, rtol=1e-2)


def test_a_recording_without_noise_is_met_to_rounding():
    data = np.cos(3.0 * 0.05 * np.arange(60)).reshape(3, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(3)}
    found = jc.identify(oscillate, jnp.asarray(3.2), data, nodes=nodes)
    np.testing.assert_allclose(found.params, 3.0, rtol=1e-12)
    assert found.noise < 1e-12
    assert found.errors < 1e-12


def test_errors_with_nodes_are_those_of_the_whole_motion():
    """With continuity, segments are as informative as one motion with an unknown start."""
    data = long_recording(4).reshape(4, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(4)}
    options = {"noise": 0.05, "continuity": 1e-5}
    found = jc.identify(oscillate, jnp.asarray(3.0), data, nodes=nodes, **options)

    def whole(p):
        t = 0.05 * jnp.arange(80.0)
        return p["x"] * jnp.cos(p["rate"] * t) + p["v"] / p["rate"] * jnp.sin(p["rate"] * t)

    start = {"x": 1.0, "v": 0.1, "rate": 3.0}
    expected = jc.identify(whole, start, data.ravel(), noise=0.05)
    np.testing.assert_allclose(found.params, expected.params["rate"], rtol=1e-5)
    np.testing.assert_allclose(found.errors, expected.errors["rate"], rtol=1e-4)


@pytest.mark.parametrize("noise", [0.05, None])
def test_ends_that_meet_far_below_the_noise_hide_nothing_in_float32(noise):
    """Gaps weigh 5·10⁵ times as much as the data, so their rank must be determined separately."""
    data = long_recording(4).reshape(4, 20)

    def found(dtype, continuity):
        nodes = {"x": jnp.asarray(data[:, 0], dtype), "v": jnp.zeros(4, dtype)}
        options = {"nodes": nodes, "noise": noise, "continuity": continuity}

        def simulate(rate, node):
            x, end = oscillate(rate.astype(float), jax.tree.map(lambda y: y.astype(float), node))
            return jax.tree.map(lambda y: y.astype(dtype), (x, end))

        return jc.identify(simulate, jnp.asarray(3.0, dtype), data, **options)

    rough, exact = found(jnp.float32, 1e-7), found(jnp.float64, 1e-5)
    np.testing.assert_allclose(rough.params, exact.params, rtol=1e-6)
    np.testing.assert_allclose(rough.errors, exact.errors, rtol=1e-4)
    np.testing.assert_allclose(rough.noise, exact.noise, rtol=1e-5)


def test_the_jacobian_of_stretches_is_the_derivative_of_their_residuals():
    data = long_recording(3).reshape(3, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(3)}
    rate = jnp.asarray(3.0)
    space = space_of(rate, True, None, "test")
    problem = Stretches(oscillate, space, jnp.ones(1), data, 0.5, nodes)

    def rows(z):
        return problem.evaluate([(z, 0.1, 1.0)])[0]

    z = np.append(np.log(3.0), problem.nodes)
    _, jacobian = rows(z)
    for i, step in enumerate(1e-6 * np.eye(z.size)):
        difference = (rows(z + step)[0] - rows(z - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, i], difference, atol=1e-7)


def test_stretches_of_a_mechanism_have_states_in_minimal_coordinates():
    """Identifies a pendulum's length from its angle, with unknown angles and rates at nodes."""
    steps, dt, count = 40, 1e-2, 3

    def stretch(length, node):
        scene, (angle, rate) = jc.Scene(dim=2), node
        way = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        across = rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        scene.add_particle("bob", mass=1.0, position=length * way, velocity=length * across)
        scene.add(jc.Distance("rod", jc.WORLD, "bob"))
        system, state = scene.build()

        def record(s, _):
            x, y = s.q
            return jnp.arctan2(x, -y), (x * s.v[1] - y * s.v[0]) / (x * x + y * y)

        method = jc.Method(solver=jc.solvers.Schur())
        _, (angles, rates) = jc.rollout(system, method, state, None, dt, steps, record=record)
        return angles[3::4], (angles[-1], rates[-1])

    truth, start = jnp.asarray(0.8), (jnp.asarray(1.2), jnp.asarray(0.0))
    seen = []
    for _ in range(count):
        angles, start = jax.jit(stretch)(truth, start)
        seen.append(angles)
    data = np.array(seen) + 1e-3 * np.random.default_rng(0).normal(size=(count, steps // 4))
    nodes = (jnp.asarray(data[:, 0]), jnp.zeros(count))
    found = jc.identify(stretch, jnp.asarray(1.0), data, nodes=nodes, positive=True)
    assert abs(found.params - truth) < 3 * found.errors
    assert found.errors < 5e-3
    assert abs(found.noise - 1e-3) < 4e-4
    np.testing.assert_allclose(found.nodes[0][0], 1.2, atol=5e-3)


def test_fewer_numbers_than_parameters_leave_directions_untold():
    found = jc.identify(lambda x: x[:1] * x[1:2], jnp.array([1.0, 2.0, 3.0]), np.array([4.0]))
    np.testing.assert_allclose(found.params[0] * found.params[1], 4.0)
    assert len(found.untold) == 2
    assert found.params[2] == 3.0


def test_float32_finds_what_its_rounding_allows():
    guess = {name: jnp.float32(x) for name, x in GUESS.items()}
    times = TIMES.astype(jnp.float32)

    def simulate(p):
        wave = p["size"] * p["gain"] * jnp.exp(-p["decay"] * times) * jnp.cos(3 * times)
        return {"x": wave + p["offset"]}

    found = jc.identify(simulate, guess, recorded(0.05), positive=POSITIVE)
    expected = jc.identify(ringing, GUESS, recorded(0.05), positive=POSITIVE)
    assert found.params["decay"].dtype == jnp.float32
    np.testing.assert_allclose(found.params["decay"], expected.params["decay"], rtol=1e-3)
    assert set(found.untold[0]) == {"size", "gain"}


def test_what_does_not_fit_is_refused_in_words():
    with pytest.raises(ValueError, match="structure.*compared with, x .3,"):
        jc.identify(ringing, GUESS, {"x": np.zeros(3)})
    with pytest.raises(ValueError, match="not finite at the start"):
        jc.identify(lambda p: jnp.sqrt(p) * jnp.ones(3), -1.0, np.ones(3))
    with pytest.raises(ValueError, match="noise must be positive"):
        jc.identify(ringing, GUESS, recorded(0.0), noise=0.0)
    with pytest.raises(ValueError, match=r"noise of shapes \[\(300, 1\)\] must broadcast"):
        jc.identify(wave, {"a": 1.0, "b": 0.0}, WAVE, noise=np.full((300, 1), 0.01))
    with pytest.raises(ValueError, match=r"noise of shapes \[\(\)\] .* in their structure"):
        jc.identify(wave, {"a": 1.0, "b": 0.0}, WAVE, noise={"c": 1.0})
    for data in (np.ones(3, complex), np.ones(3, bool), "hello"):
        with pytest.raises(ValueError, match="data must be real numbers"):
            jc.identify(lambda p: p * jnp.ones(3), 1.0, data)
    for data in (None, {}):
        with pytest.raises(ValueError, match=f"data hold no array, got {data}"):
            jc.identify(wave, {"a": 1.0, "b": 0.0}, data)
    with pytest.raises(ValueError, match="nodes must be finite, got"):
        jc.identify(oscillate, 3.0, np.ones((4, 20)), nodes=np.full((4, 2), np.nan))
    with pytest.raises(TypeError, match="simulate must be a function of params, got None"):
        jc.identify(None, 1.0, np.ones(3))
    with pytest.raises(TypeError, match=r"called as simulate\(params\), and does not accept that"):
        jc.identify(oscillate, 3.0, np.ones((4, 20)))
    with pytest.raises(TypeError, match="checkpoint must be the path of a file, got 3"):
        jc.identify(wave, {"a": 1.0, "b": 0.0}, WAVE, checkpoint=3)
    with pytest.raises(ValueError, match="nodes={} hold no array; leave them out"):
        jc.identify(oscillate, 3.0, np.ones((4, 20)), nodes={})
    nodes = {"x": jnp.ones(3), "v": jnp.ones(3)}
    # without an error, these ends would be compared with the wrong numbers, or broadcast
    ends = {"0 .., 1 ..": lambda n: (n["v"], n["x"]), "an array ..": lambda n: n["x"]}
    for words, end in ends.items():
        with pytest.raises(ValueError, match=f"an end like a node, v .., x .*returns is {words}"):
            jc.identify(lambda p, n, e=end: (p * n["x"], e(n)), 3.0, np.ones(3), nodes=nodes)
    with pytest.raises(ValueError, match="returns is nothing"):
        jc.identify(lambda p, n: p * n["x"], 3.0, np.ones(3), nodes=nodes)
    with pytest.raises(ValueError, match="3 nodes the data must have a first axis"):
        jc.identify(oscillate, 3.0, np.ones((4, 20)), nodes=nodes)
    for x in (np.ones(4, int), np.ones(3), 1.0):  # integers would be rounded at each step
        with pytest.raises(
            ValueError, match=r"nodes must be .* float64 \(4,\), (int64|float64) \("
        ):
            jc.identify(oscillate, 3.0, np.ones((4, 20)), nodes={"v": np.ones(4), "x": x})


@pytest.fixture(scope="module")
def pendulum():
    return runpy.run_path(str(Path(__file__).parents[1] / "examples" / "identify_pendulum.py"))


def test_gravity_alone_does_not_tell_masses(pendulum):
    found = pendulum["identify"](pendulum["free"])
    (direction,) = found.untold
    np.testing.assert_allclose(list(direction.values()), 0.5**0.5, atol=1e-6)
    assert set(direction) == {"mass/lower", "mass/upper"}
    ratio = found.params["mass"]["lower"] / found.params["mass"]["upper"]
    assert abs(ratio / 0.4 - 1) < 0.1
    assert abs(found.params["length"]["upper"] - 1) < 3 * found.errors["length"]["upper"]


def test_with_a_known_torque_errors_are_of_the_order_of_the_bound(pendulum):
    """Over many draws of noise, the mean of (deviation/error)² is 1."""
    truth = jax.tree.leaves(pendulum["TRUTH"])
    squares = []
    for seed in range(20):
        found = pendulum["identify"](pendulum["driven"], seed)
        assert not found.untold
        table = found.table.values()
        squares += [((x - y) / e) ** 2 for y, (x, e) in zip(truth, table, strict=True)]
    assert 0.5 < np.mean(squares) < 1.6


def test_a_small_step_at_the_end_is_taken_in_full():
    """In float32 a damped last step would leave a weak direction off by many standard errors."""
    t = np.arange(2000, dtype=np.float32)
    data = jnp.asarray(1.0 + 1.0 * (1 + 0.02 * t), jnp.float32)

    def simulate(p):
        return p["a"] + p["b"] * (1 + 0.02 * jnp.asarray(t))

    start = {"a": jnp.float32(1.0003), "b": jnp.float32(1.0)}
    found = jc.identify(simulate, start, data, noise=1e-6)
    assert abs(float(found.params["a"]) - 1) < 3e-5


def test_a_start_without_derivatives_is_refused():
    with pytest.raises(ValueError, match="derivatives are not finite at the start"):
        jc.identify(lambda p: jnp.sqrt(p["a"]) * jnp.ones(3), {"a": 0.0}, jnp.ones(3))


def test_a_start_next_to_zero_counts_as_zero():
    data = 1e-3 * np.random.default_rng(0).normal(size=60)
    for start in (0.0, 1e-12):
        found = jc.identify(lambda p: p["c"] + jnp.zeros(60), {"c": start}, data, noise=1e-3)
        assert not found.untold, start
        np.testing.assert_allclose(found.params["c"], np.mean(data), rtol=1e-6)
    with pytest.raises(ValueError, match="infinite.*NaN for the unseen"):
        jc.identify(lambda p: p["c"] + jnp.zeros(2), {"c": 1.0}, np.array([1.0, np.inf]))
