"""Time as a sum of two floats: rounding, functions of time, and storage in states."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.core.doubled import Doubled, evaluate

F32 = jnp.float32
METHODS = {
    "euler": jc.Method(),
    "rk4": jc.Method(integrator=jc.RK4()),
    "rattle": jc.Method(
        integrator=jc.integrators.RATTLE(), stabilizer=jc.stabilizers.Unstabilized()
    ),
    "alpha": jc.Method(
        integrator=jc.integrators.GeneralizedAlpha(), stabilizer=jc.stabilizers.Unstabilized()
    ),
}


def turning(t, rate):
    return rate * t


def ball(dtype=F32):
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("ball", mass=1.0)
    return scene.build()


def wheel(motion=turning, params=2.0):
    """A wheel in space on a driven axis, in float32."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0), dtype=F32)
    scene.add_body("wheel", mass=1.0, inertia=(0.4, 0.5, 0.7))
    scene.add(jc.Revolute("hub", jc.WORLD, "wheel", point=(0, 0, 0), axis=(0, 0, 1)))
    scene.add(jc.joints.Drive("drive", "hub", motion, params=params))
    return scene.build()


def started(system, method, time, rate=2.0):
    """Returns the state of the wheel that its drive prescribes at a time."""
    half = np.mod(rate * time, 2 * np.pi) / 2
    q = np.zeros(7, np.float32)
    q[3], q[6] = np.cos(half), np.sin(half)
    v = np.zeros(6, np.float32)
    v[5] = rate
    return jc.init(system, method, jnp.asarray(q), jnp.asarray(v), time)


def left(state, steps, dt):
    """Returns steps · h minus the time of a state, in float64 [s]."""
    return steps * float(np.float32(dt)) - float(state.time) - float(state.time_remainder)


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("dt", [1e-3, 1e-4 / 3])
@pytest.mark.parametrize("count", [10**6, 10**8])
def test_a_hundred_million_additions_are_rounded_once(dt, constant, count):
    """The sum of a float32 step, known when compiling or given as an argument."""
    h, start = np.float32(dt), Doubled.of(jnp.zeros((), F32))

    def summed(h):
        return jax.lax.fori_loop(0, count, lambda _, t: t + h, start)

    total = jax.jit(lambda: summed(h))() if constant else jax.jit(summed)(h)
    exact = count * float(h)
    assert float(total.high) == float(np.float32(exact))
    # the rounding of remainders adds up to at most one rounding of the sum
    bound = 1e-9 if count == 10**6 else np.spacing(np.float32(exact))
    assert abs(exact - float(total.high) - float(total.low)) < bound


@pytest.mark.parametrize("name", METHODS)
def test_the_time_of_a_rollout_is_rounded_once(name):
    system, state = ball()
    start = jc.init(system, METHODS[name], state.q, state.v, 1000.0)
    end, _ = jc.rollout(system, METHODS[name], start, None, 1e-3, 1000)
    assert float(end.time) == float(np.float32(1000 + 1000 * float(np.float32(1e-3))))
    assert abs(1000 + left(end, 1000, 1e-3)) < 1e-9


def test_each_world_of_a_batch_has_its_own_time():
    system, state = ball()
    times = jnp.asarray([0.0, 1e3, 1e5], F32)
    starts = jax.vmap(lambda t: jc.init(system, jc.Method(), state.q, state.v, t))(times)
    end, _ = jax.vmap(lambda s: jc.rollout(system, jc.Method(), s, None, 1e-3, 500))(starts)
    exact = np.float64(times) + 500 * float(np.float32(1e-3))
    np.testing.assert_array_equal(end.time, exact.astype(np.float32))
    np.testing.assert_allclose(
        np.float64(end.time) + np.float64(end.time_remainder), exact, rtol=1e-12, atol=1e-9
    )


def test_parts_of_a_step_add_up():
    """A ball bounces on the floor; steps are split at the impacts."""
    scene = jc.Scene(dim=2, gravity=(0.0, -10.0), dtype=F32)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.2))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", radius=0.1, restitution=0.9))
    system, state = scene.build()
    method = jc.Method(events=jc.integrators.Events())
    start = jc.init(system, method, state.q, state.v, 1e4)
    end, _ = jc.rollout(system, method, start, None, 1e-3, 400)
    assert int(end.status) == jc.Status.OK
    assert abs(1e4 + left(end, 400, 1e-3)) < 1e-7


def test_derivatives_by_time_and_step():
    system, state = ball()

    def end(time, dt):
        start = jc.init(system, jc.Method(), state.q, state.v, time)
        return jc.rollout(system, jc.Method(), start, None, dt, 10)[0].time

    at = jnp.asarray(1e4, F32), jnp.asarray(1e-3, F32)
    np.testing.assert_allclose(jax.grad(end, (0, 1))(*at), (1.0, 10.0), rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(end, (0, 1))(*at), (1.0, 10.0), rtol=1e-6)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("time", "dt"), [(1e3, 1e-3), (3e3, 1e-4), (1e5, 1e-3)])
def test_a_drive_keeps_its_rate(name, time, dt):
    """The angle is within 1e-5 of its change over a thousand steps.

    The speed is right at every step.
    """
    system, _ = wheel()
    start = started(system, METHODS[name], time)
    end, speeds = jc.rollout(
        system, METHODS[name], start, None, dt, 1000, record=lambda s, i: s.v[5]
    )
    assert int(end.status) == jc.Status.OK
    q = np.float64(end.q)
    off = 2 * np.arctan2(q[6], q[3]) - 2.0 * (time + 1000 * float(np.float32(dt)))
    off = np.mod(off + np.pi, 2 * np.pi) - np.pi
    assert abs(off) < 1e-5 * 2.0 * 1000 * dt
    np.testing.assert_allclose(speeds, 2.0, atol=2e-2)


def test_a_drive_late_is_a_drive_early_in_a_batch():
    """Target, rate and bias of a sine at 1e5 s, in float32, by world."""
    params = {"size": jnp.asarray(0.4, F32), "rate": jnp.asarray(3.7, F32)}

    def wave(t, p):
        return p["size"] * jnp.sin(p["rate"] * t) + jnp.where(t > 1, 0.25 * t**2 * 1e-9, 0.0)

    system, _ = wheel(wave, params)
    drive = system.constraints[1]
    high = jnp.asarray([1e5, 1e5 + 0.5, 12.25], F32)
    low = jnp.asarray([3e-3, -2e-3, 4e-7], F32)
    target, rate, bias = jax.vmap(lambda h, x: drive._motion(Doubled(h, x), params))(high, low)
    t, size, w = np.float64(high) + np.float64(low), float(params["size"]), float(params["rate"])
    expected = size * np.sin(w * t) + 0.25 * t**2 * float(np.float32(1e-9))
    both = np.float64(target.high) + np.float64(target.low)
    np.testing.assert_allclose(both, expected, atol=1e-6)
    np.testing.assert_allclose(rate, size * w * np.cos(w * t) + 0.5 * t * 1e-9, atol=1e-5)
    np.testing.assert_allclose(bias, -size * w * w * np.sin(w * t), atol=1e-5)
    late = (Doubled(high[0], low[0]), params)
    slope = jax.grad(lambda p: drive._motion(late[0], p)[0].high)(params)
    np.testing.assert_allclose(slope["size"], np.sin(w * t[0]), atol=1e-6)
    np.testing.assert_allclose(slope["rate"], size * t[0] * np.cos(w * t[0]), rtol=1e-5)


def custom(x):
    """Returns softplus by jnp operations of many kinds, with a custom derivative."""
    return jax.nn.softplus(x)


@jax.custom_jvp
def wave(t):
    """Returns a sine with a custom derivative, of opposite sign to make its use visible."""
    return jnp.sin(7.0 * t)


@wave.defjvp
def _(primals, tangents):
    return wave(*primals), -7.0 * jnp.cos(7.0 * primals[0]) * tangents[0]


def loop(t, last):
    return jax.lax.fori_loop(0, last, lambda i, s: s + jnp.sin(7.0 * t) / 2, 0.0 * t)


def table(t):
    """Returns a number that depends on all kinds of results of a scan."""
    carry, stacked = jax.lax.scan(lambda c, w: (c + w * t, jnp.sin(w * t)), t, MANY)
    return jnp.cos(carry) + stacked[0] + stacked[1]


def circling(t):
    return jnp.imag(jnp.exp(7j * t) ** 2 / (2 + 1j) + 3 * jnp.exp(1j * t).conj())


MANY = np.asarray([7.3, -3.1, 0.57], np.float32)
EACH = np.float64(MANY)
SIZES = np.linspace(-1.3, 1.4, 24, dtype=np.float32).reshape(4, 2, 3)
FUNCTIONS = {
    "checkpoint": (jax.checkpoint(lambda t: jnp.sin(7.0 * t)), lambda t: np.sin(7.0 * t)),
    "cond": (
        lambda t: jax.lax.cond(t > 0, lambda t: jnp.sin(7.0 * t), lambda t: 0.0 * t, t),
        lambda t: np.sin(7.0 * t),
    ),
    "switch": (
        lambda t: jax.lax.switch(1, [jnp.cos, lambda t: jnp.sin(7.0 * t), jnp.tan], t),
        lambda t: np.sin(7.0 * t),
    ),
    "loop": (lambda t: loop(t, 2), lambda t: np.sin(7.0 * t)),
    "open loop": (lambda t: loop(t, jnp.where(t > 0, 2, 1)), lambda t: np.sin(7.0 * t)),
    "scan": (table, lambda t: np.cos((1 + EACH.sum()) * t) + np.sin(EACH[:2] * t).sum()),
    "complex": (
        lambda t: circling(t.astype(jnp.complex64)),
        lambda t: np.imag(np.exp(14j * t) / (2 + 1j)) - 3 * np.sin(t),
    ),
    "sum": (lambda t: jnp.sin(jnp.sum(MANY * t)), lambda t: np.sin(EACH.sum() * t)),
    "dot": (lambda t: jnp.sin(jnp.dot(MANY, jnp.full(3, t))), lambda t: np.sin(EACH.sum() * t)),
    "matrices": (
        lambda t: jnp.sin(jnp.einsum("ij,kij->ki", SIZES[0], SIZES * t)[3, 1]),
        lambda t: np.sin(np.float64(SIZES[0, 1]) @ np.float64(SIZES[3, 1]) * t),
    ),
    "polynomial": (
        lambda t: jnp.sin(jnp.polyval(MANY, t - 1e5 + 3.0)),
        lambda t: np.sin(np.polyval(EACH, t - 1e5 + 3.0)),
    ),
    "product": (lambda t: 2.75 * t * t, lambda t: 2.75 * t * t),
    "quotient": (lambda t: t / 7.0 + 3.0 / t, lambda t: t / 7.0 + 3.0 / t),
    "power": (lambda t: t**3 + t**-2, lambda t: t**3 + t**-2),
    "periodic": (lambda t: jnp.mod(t, 4.0), lambda t: np.mod(t, 4.0)),
    "scaled": (lambda t: jnp.exp(-t * 1e-5), lambda t: np.exp(-t * 1e-5)),
    "wave": (lambda t: jnp.cos(50.0 * t) - jnp.tan(t), lambda t: np.cos(50.0 * t) - np.tan(t)),
    "difference": (lambda t: jnp.sin(t - 1e5), lambda t: np.sin(t - 1e5)),
    "custom": (lambda t: custom(t - 1e5), lambda t: np.log1p(np.exp(t - 1e5))),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_two_floats(name):
    """Compares the value at 1e5 + 3e-3, and the derivative of the rounded function there."""
    function, exact = FUNCTIONS[name]
    x = Doubled(jnp.asarray(1e5, F32), jnp.asarray(3e-3, F32))
    value = jax.jit(lambda x: evaluate(function, x))(x)
    t = float(x.high) + float(x.low)
    scale = max(1.0, abs(exact(t)) * 1e-6)
    assert abs(float(value.high) + float(value.low) - exact(t)) < 1e-6 * scale
    derivative = jax.jacfwd if name == "open loop" else jax.grad
    got = derivative(lambda h: evaluate(function, Doubled(h, x.low)).high)(x.high)
    slope = (exact(t + 1e-4) - exact(t - 1e-4)) / 2e-4
    np.testing.assert_allclose(got, slope, rtol=1e-4, atol=1e-5)


PERIOD = np.float32(0.37)
EXACT_PERIOD = np.float64(PERIOD)
WHOLE = {
    "mod": (lambda t: jnp.mod(t, PERIOD), lambda t: np.mod(t, EXACT_PERIOD), 1.0),
    "mod of −t": (lambda t: jnp.mod(-t, PERIOD), lambda t: np.mod(-t, EXACT_PERIOD), -1.0),
    "rem": (lambda t: jax.lax.rem(-t, PERIOD), lambda t: -np.mod(t, EXACT_PERIOD), -1.0),
    "floor": (lambda t: jnp.floor(t / PERIOD), lambda t: np.floor(t / EXACT_PERIOD), 0.0),
    "ceil": (lambda t: jnp.ceil(t / PERIOD), lambda t: np.ceil(t / EXACT_PERIOD), 0.0),
    "round": (lambda t: jnp.round(64 * t), lambda t: np.round(64 * t), 0.0),
    "trunc": (lambda t: jnp.trunc(-128 * t), lambda t: np.trunc(-128 * t), 0.0),
    "sawtooth": (
        lambda t: t / PERIOD - jnp.floor(t / PERIOD),
        lambda t: t / EXACT_PERIOD - np.floor(t / EXACT_PERIOD),
        1 / EXACT_PERIOD,
    ),
}
"""Functions with jumps by name: the function of two floats, the exact function, and its slope."""


@pytest.mark.parametrize("name", WHOLE)
def test_jumps_of_remainders_and_whole_numbers_are_not_rounded(name):
    """Times lie within 1 µs of jumps near 1e5 s, where float32 has multiples of 8 ms."""
    function, exact, expected_slope = WHOLE[name]
    jumps = EXACT_PERIOD * np.arange(270_000, 270_200)
    t = np.concatenate([jumps - 1e-6, jumps + 1e-6, np.linspace(1e5, 1e5 + 1, 999)])
    high = np.float32(t)
    low = np.float32(t - high)
    value = jax.jit(jax.vmap(lambda h, x: evaluate(function, Doubled(h, x))))(high, low)
    found = np.float64(value.high) + np.float64(value.low)
    np.testing.assert_allclose(found, exact(np.float64(high) + np.float64(low)), atol=1e-8)
    slope = jax.vmap(jax.grad(lambda h, x: evaluate(function, Doubled(h, x)).high))(high, low)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-6)


def test_a_derivative_of_its_own():
    """At a late time a `jax.custom_jvp` keeps its value, and its rule replaces the derivative."""
    x = Doubled(jnp.asarray(1e5, F32), jnp.asarray(3e-3, F32))
    t = 1e5 + float(x.low)
    value, slope = jax.value_and_grad(lambda h: evaluate(wave, Doubled(h, x.low)).high)(x.high)
    np.testing.assert_allclose(value, np.sin(7.0 * t), atol=1e-6)
    np.testing.assert_allclose(slope, -7.0 * np.cos(7.0 * t), atol=1e-5)
    twice = jax.grad(jax.grad(lambda h: evaluate(wave, Doubled(h, x.low)).high))(x.high)
    np.testing.assert_allclose(twice, 49.0 * np.sin(7.0 * t), atol=1e-4)


def summed(t, params):
    return jnp.sin(7.0 * jnp.cumsum(jnp.stack([t, t]))[1])


def looped(t, params):
    return jax.lax.fori_loop(0, 2, lambda i, s: s + jnp.sin(params * t) / 2, 0.0 * t)


def test_a_drive_that_rounds_its_time_warns():
    with pytest.warns(UserWarning, match="Drive 'drive': .* through cumsum, .*rounded"):
        wheel(summed)


@pytest.mark.filterwarnings("error")
def test_a_drive_by_a_loop_keeps_its_phase():
    """Compares value, rate and acceleration at 1e5 s in a batch of worlds."""
    system, _ = wheel(looped, 7.0)
    drive = system.constraints[1]
    high, low = jnp.asarray([1e5, 2e5], F32), jnp.asarray([3e-3, -2e-3], F32)
    late = jax.vmap(lambda h, x: drive._motion(Doubled(h, x), drive.params))(high, low)
    t = np.float64(high) + np.float64(low)
    np.testing.assert_allclose(late[0].high, np.sin(7.0 * t), atol=1e-6)
    np.testing.assert_allclose(late[1], 7.0 * np.cos(7.0 * t), atol=1e-5)
    np.testing.assert_allclose(late[2], -49.0 * np.sin(7.0 * t), atol=1e-4)


def test_an_overflow_is_no_nan():
    big = Doubled.of(jnp.asarray(3e38, F32))
    assert float(evaluate(lambda x: x * x, big).high) == np.inf
    assert float(evaluate(lambda x: x / 2 + x, big).high) == np.inf
    assert float(evaluate(lambda x: 1 / (x * x), big).high) == 0
    assert float(evaluate(lambda x: 1 / (x - 3e38), big).high) == np.inf


def test_states_made_by_hand_and_saved_before():
    """States with the fields of earlier versions: by position, by name, as trees and from files."""
    system, state = ball()
    old = {"q": state.q, "v": state.v, "time": state.time, "status": state.status}
    for known in (
        jc.State(*old.values()),
        jc.State(*old.values(), (), ()),
        jc.State(**old),
        jc.State(**{name: np.asarray(x) for name, x in old.items()}),
    ):
        assert jax.tree.structure(known) == jax.tree.structure(state)
        end, _ = jc.rollout(system, jc.Method(), known, None, 1e-3, 10)
        assert float(end.time) == float(np.float32(10 * float(np.float32(1e-3))))
    saved = pickle.loads(pickle.dumps(state))
    np.testing.assert_array_equal(saved.time_remainder, 0)
    bare = object.__new__(jc.State)
    bare.__setstate__(old | {"memory": (), "turns": ()})
    np.testing.assert_array_equal(bare.time_remainder, 0)
    batch = jax.vmap(lambda q: jc.State(q, state.v, state.time, state.status))(state.q[None])
    assert batch.time_remainder.shape == (1,)
    axes = jc.State(0, 0, None, None)
    moved = jax.vmap(lambda s: s.q + s.time_remainder, in_axes=(axes,))
    same = dataclasses.replace(state, q=jnp.stack([state.q, state.q]))
    same = dataclasses.replace(same, v=jnp.stack([state.v, state.v]))
    assert moved(same).shape == (2, 2)


def test_a_replaced_time_forgets_its_remainder():
    system, state = ball()
    late = jc.init(system, jc.Method(), state.q, state.v, 1e5)
    late, _ = jc.rollout(system, jc.Method(), late, None, 1e-3, 3)
    assert abs(float(late.time_remainder)) > 1e-3
    again = dataclasses.replace(late, time=jnp.zeros((), F32))
    again, _ = jc.step(system, jc.Method(), again, None, 1e-3)
    assert float(again.time) == float(np.float32(1e-3))
