"""Parameters come back from recordings, with honest errors, and what is not told is named."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxcon as jc
from jaxcon.learning.least_squares import least_squares
from jaxcon.learning.leaves import space_of
from jaxcon.learning.stretches import Stretches

TIMES = jnp.linspace(0.0, 6.0, 300)
TRUTH = {"size": 2.0, "gain": 1.5, "decay": 0.3, "offset": 0.4}
GUESS = {"size": 1.0, "gain": 1.0, "decay": 1.0, "offset": 0.0}
POSITIVE = ("size", "gain", "decay")


def ringing(p):
    """Size and gain enter by their product alone."""
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


def test_errors_are_those_of_linear_least_squares():
    """σ² (XᵀX)⁻¹, in the units of the parameters."""
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
        lambda p: jc.losses.tracking(simulate(p), data),
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


def test_an_interrupt_keeps_what_was_found():
    """Rosenbrock's valley, left after a few evaluations."""
    calls = []

    def valley(z):
        calls.append(z)
        if len(calls) == 8:
            raise KeyboardInterrupt
        x, y = z
        return np.array([1 - x, 10 * (y - x * x)]), np.array([[-1.0, 0.0], [-20 * x, 10.0]])

    start, free = np.array([-1.2, 1.0]), np.full(2, np.inf)
    fit = least_squares(valley, start, -free, free, 50, 1e-8)
    assert fit.interrupted
    assert fit.costs[-1] < fit.costs[0]
    np.testing.assert_allclose(fit.costs[-1], np.sum(fit.residual**2) / 2)
    calls = [None] * 8
    whole = least_squares(valley, start, -free, free, 50, 1e-8)
    np.testing.assert_allclose(whole.z, 1.0, atol=1e-7)
    assert whole.stopped == "converged"


def test_all_may_lie_on_their_bounds():
    found = jc.identify(lambda x: x * jnp.ones(3), 0.0, np.ones(3), bounds=(-1.0, 0.5), noise=1.0)
    assert found.params == 0.5
    assert found.stopped == "converged"


def oscillate(rate, node):
    """A stretch of 20 samples of ẍ = −ω² x, and its end."""
    t = 0.05 * jnp.arange(21.0)
    c, s = jnp.cos(rate * t), jnp.sin(rate * t)
    x = node["x"] * c + node["v"] / rate * s
    v = node["v"] * c - node["x"] * rate * s
    return x[:-1], {"x": x[-1], "v": v[-1]}


def long_recording(stretches):
    t = 0.05 * np.arange(20 * stretches)
    return np.cos(3.0 * t) + 0.05 * np.random.default_rng(2).normal(size=t.shape)


def test_a_long_recording_is_fitted_in_stretches_and_not_in_one():
    """The least over ω of a long cosine has a narrow basin; that of short ones is wide."""
    x = long_recording(10)
    times = 0.05 * jnp.arange(200.0)
    one = jc.identify(lambda rate: jnp.cos(rate * times), jnp.asarray(4.0), x, positive=True)
    assert abs(one.params - 3) > 0.5
    data = x.reshape(10, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(10)}
    found = jc.identify(oscillate, jnp.asarray(4.0), data, nodes=nodes, positive=True)
    assert abs(found.params - 3) < 3 * found.errors
    assert found.errors < 4e-3
    assert abs(found.noise - 0.05) < 0.01
    ends = jax.vmap(lambda n: oscillate(found.params, n)[1])(found.nodes)
    np.testing.assert_allclose(ends["x"][:-1], found.nodes["x"][1:], atol=1e-3)


def test_errors_with_nodes_are_those_of_the_whole_motion():
    """With ends that meet, stretches tell as much as one motion whose start is unknown."""
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


def test_the_jacobian_of_stretches_is_the_derivative_of_their_residuals():
    data = long_recording(3).reshape(3, 20)
    nodes = {"x": jnp.asarray(data[:, 0]), "v": jnp.zeros(3)}
    rate = jnp.asarray(3.0)
    space = space_of(rate, True, None, "test")
    problem = Stretches(oscillate, space, jnp.ones(1), data, 0.5, nodes)
    rows = problem.linearize(0.1)
    z = np.append(np.log(3.0), problem.nodes)
    _, jacobian = rows(z)
    for i, step in enumerate(1e-6 * np.eye(z.size)):
        difference = (rows(z + step)[0] - rows(z - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, i], difference, atol=1e-7)


def test_stretches_of_a_mechanism_have_states_in_minimal_coordinates():
    """The length of a pendulum from its angle alone, its starts and rates unknown."""
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

        method = jc.Method(solver=jc.Schur())
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
    with pytest.raises(ValueError, match="structure.*of the reference"):
        jc.identify(ringing, GUESS, {"x": np.zeros(3)})
    with pytest.raises(ValueError, match="not finite at the start"):
        jc.identify(lambda p: jnp.sqrt(p) * jnp.ones(3), -1.0, np.ones(3))
    with pytest.raises(ValueError, match="noise must be positive"):
        jc.identify(ringing, GUESS, recorded(0.0), noise=0.0)
    nodes = {"x": jnp.ones(3), "v": jnp.ones(3)}
    with pytest.raises(ValueError, match="3 nodes the data must have a first axis"):
        jc.identify(oscillate, 3.0, np.ones((4, 20)), nodes=nodes)


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
    """Over draws of noise the squares of errors by their deviation have the mean 1."""
    truth = jax.tree.leaves(pendulum["TRUTH"])
    squares = []
    for seed in range(20):
        found = pendulum["identify"](pendulum["driven"], seed)
        assert not found.untold
        table = found.table.values()
        squares += [((x - y) / e) ** 2 for y, (x, e) in zip(truth, table, strict=True)]
    assert 0.5 < np.mean(squares) < 1.6
