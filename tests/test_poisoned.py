"""A number of one world is NaN or infinite: it says so, and the others do not notice."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import poisoned  # noqa: E402


@pytest.mark.filterwarnings("ignore:.*unstable")
@pytest.mark.parametrize("name", poisoned.QUICK)
def test_the_world_is_told_and_others_do_not_notice(name):
    """Every number of a scene and of its method, in values and in both modes of derivatives."""
    counts = poisoned.measure(name, quick=True)
    assert counts.clean, poisoned.words(name, counts)
    assert counts.tried >= 70
    assert counts.told >= counts.tried / 3


def test_a_spoiled_number_is_found():
    """The study itself: a force hides its number, but not in its derivative."""

    def hides(a, t, u, p):
        return (jnp.where(p["gain"] > 0, p["gain"] * a.position[0], 0.0) * jnp.ones(3),)

    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1.0, inertia=0.1, position=(1.0, 0.0))
    scene.add(jc.CustomForce("pull", ("a",), hides, params={"gain": 2.0}))
    study = poisoned.Study(*scene.build(), jc.Method())
    cases = [case for case in study.cases() if "gain" in case.path]
    counts = study.run(cases)
    hidden = {f"params/pull/params/gain = {x}" for x in (np.nan, -np.inf)}
    assert {str(case) for case in counts.accepted} == hidden
    assert {str(case) for case in counts.gradients} >= hidden


@pytest.fixture(scope="module")
def pendulum():
    """A particle on a rod."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(0.0, 0.3))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def test_recovery_does_not_go_back_to_a_state_that_is_not_finite(pendulum):
    """A start that is NaN fails at once; a step that fails from a good one is rolled back."""
    system, state = pendulum
    method = jc.Method(recovery=jc.Recovery())
    start = jc.init(system, method, state.q, state.v)

    def one(v, h):
        return jc.step(system, method, dataclasses.replace(start, v=v), None, h)[0]

    v = jnp.stack([state.v, state.v.at[0].set(jnp.nan), state.v.at[1].set(jnp.inf), state.v])
    new = jax.jit(jax.vmap(one))(v, jnp.array([1e-2, 1e-2, 1e-2, jnp.nan]))
    bad, back = jc.Status.NON_FINITE, jc.Status.ROLLED_BACK
    np.testing.assert_array_equal(new.status, [jc.Status.OK, bad, bad, back])
    np.testing.assert_array_equal(new.q[1:], np.tile(state.q, (3, 1)))


ZERO = {
    "Euler": jc.Method(),
    "RK4": jc.Method(jc.RK4()),
    "RATTLE": jc.Method(jc.RATTLE()),
    "PID": jc.Method(stabilizer=jc.PID()),
    "limited window": jc.Method(stabilizer=jc.SlidingWindowBaumgarte(rate=5.0, limit=10.0)),
    "generalized-α": jc.Method(jc.GeneralizedAlpha()),
    "window": jc.Method(stabilizer=jc.SlidingWindowBaumgarte()),
}


@pytest.mark.parametrize("name", ZERO)
def test_a_step_of_no_length_stands_still_or_says_so(pendulum, name):
    """Methods that divide by h fail; the derivative of other worlds by h is their own."""
    system, state = pendulum
    method, steps = ZERO[name], 10  # more than a window

    def one(h, share):
        start = jc.init(system, method, state.q, state.v)
        final, _ = jc.rollout(system, method, start, None, h * share, steps)
        return jnp.sum(final.q * jnp.arange(1.0, 3.0)) + jnp.sum(final.v), final

    def total(shares):
        def losses(h):
            values, final = jax.vmap(one, (None, 0))(h, shares)
            return jnp.sum(values), final

        return jax.grad(losses, has_aux=True)(1e-2)

    run = jax.jit(total)
    slope, final = run(jnp.array([1.0, 0.0]))
    alone, _ = run(jnp.array([1.0, 1.0]))
    told = name in ("generalized-α", "window")
    assert final.status[1] == (jc.Status.NON_FINITE if told else jc.Status.OK)
    assert final.status[0] == jc.Status.OK
    np.testing.assert_allclose(final.q[1], state.q, atol=IDENTITY)
    np.testing.assert_allclose(slope, alone / 2, rtol=1e-9)


def test_a_failed_world_has_no_impacts():
    """None at a time of 0, by an element 0, which are those of a world that goes on."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.01), velocity=(0.0, -3.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", restitution=0.5))
    system, state = scene.build()
    method = jc.Method(events=jc.Events())

    def one(v):
        return jc.step(system, method, dataclasses.replace(state, v=v), None, 1e-2)[1].impacts

    seen = jax.jit(jax.vmap(one))(jnp.stack([state.v, state.v.at[0].set(jnp.nan)]))
    np.testing.assert_array_equal(seen.count, [1, 0])
    np.testing.assert_array_equal(seen.elements[:, 0], [0, -1])
    assert seen.times[0, 0] < 1e-2
    assert seen.times[1, 0] == np.inf
