import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc


@pytest.fixture(scope="module")
def pushed():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    return scene.build()


METHOD = jc.Method()
DT = 0.01


def loop(system, state, controls, steps):
    """Rolls out in a Python loop; returns the states and infos of all steps."""
    states, infos = [], []
    for i in range(steps):
        state, info = jc.step(system, METHOD, state, controls(i, state), DT)
        states.append(state)
        infos.append(info)
    return states, infos


def test_every_step_is_recorded(pushed):
    system, state = pushed
    states, _ = loop(system, state, lambda i, s: None, 6)
    final, trajectory = jc.rollout(system, METHOD, state, None, DT, 6)
    np.testing.assert_allclose(trajectory.q, np.stack([s.q for s in states]), rtol=IDENTITY)
    np.testing.assert_allclose(trajectory.time, DT * np.arange(1, 7))
    np.testing.assert_array_equal(final.q, trajectory.q[-1])


@pytest.mark.parametrize("every", [1, 2, 3, 6])
def test_a_stride_keeps_the_last_of_each(pushed, every):
    system, state = pushed
    _, whole = jc.rollout(system, METHOD, state, None, DT, 6)
    final, some = jc.rollout(system, METHOD, state, None, DT, 6, every=every)
    assert some.q.shape == (6 // every, 2)
    np.testing.assert_allclose(some.q, whole.q[every - 1 :: every], rtol=IDENTITY)
    np.testing.assert_allclose(final.q, whole.q[-1], rtol=IDENTITY)


@pytest.mark.parametrize("every", [1, 3])
def test_controls_follow_the_steps(pushed, every):
    system, state = pushed
    controls = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)))
    states, _ = loop(system, state, lambda i, s: controls[i], 6)
    final, _ = jc.rollout(system, METHOD, state, controls, DT, 6, every=every)
    np.testing.assert_allclose(final.q, states[-1].q, rtol=IDENTITY)


def test_feedback_sees_every_state(pushed):
    system, state = pushed

    def feedback(state):
        return -3.0 * state.v

    states, _ = loop(system, state, lambda i, s: feedback(s), 6)
    final, _ = jc.rollout(system, METHOD, state, feedback, DT, 6, every=2)
    np.testing.assert_allclose(final.v, states[-1].v, rtol=IDENTITY, atol=IDENTITY)


def test_what_is_recorded_is_the_users_choice(pushed):
    system, state = pushed
    states, infos = loop(system, state, lambda i, s: None, 6)

    def record(state, info):
        return {"x": state.q[0], "tension": -info.multipliers[0]}

    _, kept = jc.rollout(system, METHOD, state, None, DT, 6, record=record, every=3)
    np.testing.assert_allclose(kept["x"], [states[2].q[0], states[5].q[0]], rtol=IDENTITY)
    seen = [-infos[2].multipliers[0], -infos[5].multipliers[0]]
    np.testing.assert_allclose(kept["tension"], seen, rtol=1e-10)


def test_no_steps(pushed):
    system, state = pushed
    final, trajectory = jc.rollout(system, METHOD, state, None, DT, 0)
    np.testing.assert_array_equal(final.q, state.q)
    assert trajectory.q.shape == (0, 2)


def test_jit_with_a_traced_step_size(pushed):
    system, state = pushed
    run = jax.jit(lambda dt: jc.rollout(system, METHOD, state, None, dt, 6)[0].q)
    np.testing.assert_allclose(run(DT), jc.rollout(system, METHOD, state, None, DT, 6)[0].q)
    np.testing.assert_allclose(jax.grad(lambda dt: run(dt).sum())(DT), _slope(run), rtol=1e-6)


def _slope(run):
    return (run(DT + 1e-6).sum() - run(DT - 1e-6).sum()) / 2e-6


@pytest.mark.parametrize(
    ("steps", "every", "what"),
    [
        (5, 2, "every=2 must divide steps=5"),
        (3, 6, "every=6 must divide steps=3"),
        (4, 0, "every must be a whole number from 1, got 0"),
        (-1, 1, "steps must be a whole number from 0, got -1"),
    ],
)
def test_a_stride_that_does_not_divide(pushed, steps, every, what):
    with pytest.raises(ValueError, match=what):
        jc.rollout(*pushed[:1], METHOD, pushed[1], None, DT, steps, every=every)


@pytest.mark.parametrize("shape", [(5, 2), (), (7, 2)])
def test_controls_of_another_length(pushed, shape):
    with pytest.raises(ValueError, match="controls must have 6 rows.*got shape"):
        jc.rollout(pushed[0], METHOD, pushed[1], jnp.zeros(shape), DT, 6)
    with pytest.raises(TypeError, match="controls must be None, arrays by step, or a function"):
        jc.rollout(pushed[0], METHOD, pushed[1], "none", DT, 6)
    with pytest.raises(ValueError, match="6 rows.* in an array, got the number 0.0; of a list"):
        jc.rollout(pushed[0], METHOD, pushed[1], [[0.0, 0.0]] * 6, DT, 6)


def test_what_is_no_record_and_no_policy_is_refused(pushed):
    def run(controls=None, **options):
        return jc.rollout(pushed[0], METHOD, pushed[1], controls, DT, 6, **options)

    with pytest.raises(TypeError, match="record must be a function of state, got 3"):
        run(record=3)
    with pytest.raises(TypeError, match=r"record is called as record\(state, info\)"):
        run(record=lambda s: s.q)
    with pytest.raises(TypeError, match=r"controls is called as controls\(state\)"):
        run(lambda state, time: state.v)
    with pytest.raises(TypeError, match="a function of the state, returned None"):
        run(lambda state: None)
    with pytest.raises(ValueError, match="6 rows.* got the number 3"):
        run(np.int64(3))


@pytest.fixture(scope="module")
def single():
    """A float32 scene, while float64 is enabled."""
    scene = jc.Scene(dim=2, dtype=jnp.float32)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    return scene.build()


PUSH = np.array([0.3, -0.2])
GIVEN = {
    "rows of NumPy": np.tile(PUSH, (6, 1)),
    "NumPy from a function": lambda state: PUSH,
    "what JAX makes of numbers": lambda s: jnp.where(jnp.array([True, False]), 0.3, -0.2),
}


@pytest.mark.parametrize("given", GIVEN)
def test_controls_that_choose_no_precision_get_that_of_the_scene(single, given):
    system, state = single
    controls = jnp.tile(jnp.asarray(PUSH, jnp.float32), (6, 1))
    expected, _ = jc.rollout(system, METHOD, state, controls, DT, 6)
    found, _ = jc.rollout(system, METHOD, state, GIVEN[given], DT, 6)
    assert found.v.dtype == jnp.float32
    assert np.max(np.abs(found.v - jc.rollout(system, METHOD, state, None, DT, 6)[0].v)) > 1e-3
    np.testing.assert_allclose(found.v, expected.v, rtol=1e-6, atol=1e-6)
