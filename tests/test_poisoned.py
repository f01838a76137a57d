"""A NaN or infinite number of one world gives that world a status and affects no other world."""

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
    """Tries every number of scene and method, in values and in derivatives of both modes."""
    counts = poisoned.measure(name, quick=True)
    assert counts.clean, poisoned.words(name, counts)
    assert counts.tried >= 70
    assert counts.told >= counts.tried / 3


def test_a_spoiled_number_is_found():
    """Tests the study itself: a force hides a NaN parameter, but its derivative does not."""

    def hides(a, t, u, p):
        return (jnp.where(p["gain"] > 0, p["gain"] * a.position[0], 0.0) * jnp.ones(3),)

    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=1.0, inertia=0.1, position=(1.0, 0.0))
    scene.add(jc.forces.CustomForce("pull", ("a",), hides, params={"gain": 2.0}))
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
    """A NaN at the start fails at once; a failing step from a finite state is rolled back."""
    system, state = pendulum
    method = jc.Method(recovery=jc.stabilizers.Recovery())
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
    "RATTLE": jc.Method(jc.integrators.RATTLE()),
    "PID": jc.Method(stabilizer=jc.stabilizers.PID()),
    "limited window": jc.Method(
        stabilizer=jc.stabilizers.SlidingWindowBaumgarte(rate=5.0, limit=10.0)
    ),
    "generalized-α": jc.Method(jc.integrators.GeneralizedAlpha()),
    "window": jc.Method(stabilizer=jc.stabilizers.SlidingWindowBaumgarte()),
}


@pytest.mark.parametrize("name", ZERO)
def test_a_step_of_no_length_stands_still_or_says_so(pendulum, name):
    """Methods that divide by h fail; the derivatives of other worlds by h are not affected."""
    system, state = pendulum
    method, steps = ZERO[name], 10  # more than the window of a stabilizer

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
    """Failed worlds report no impact at time 0 of element 0, which another world may have."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 0.01), velocity=(0.0, -3.0))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "ball", restitution=0.5))
    system, state = scene.build()
    method = jc.Method(events=jc.integrators.Events())

    def one(v):
        return jc.step(system, method, dataclasses.replace(state, v=v), None, 1e-2)[1].impacts

    seen = jax.jit(jax.vmap(one))(jnp.stack([state.v, state.v.at[0].set(jnp.nan)]))
    np.testing.assert_array_equal(seen.count, [1, 0])
    np.testing.assert_array_equal(seen.elements[:, 0], [0, -1])
    assert seen.times[0, 0] < 1e-2
    assert seen.times[1, 0] == np.inf


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_velocity_whose_products_would_overflow_is_told(dim, dtype):
    """A motion has grown without bound long before its numbers are infinite."""
    scene = jc.Scene(dim=dim, dtype=dtype)
    axis = np.eye(dim)[0]
    inertia = 1.0 if dim == 2 else np.ones(3)
    scene.add_body("free", mass=1.0, inertia=inertia, position=0 * axis, velocity=axis)
    system, state = scene.build()
    method = jc.Method()

    def one(speed):
        moving = dataclasses.replace(state, v=speed * state.v)
        return jc.rollout(system, method, moving, None, 1e-3, 2)[0].status

    speeds = jnp.asarray([1.0, 0.9e10, 1.1e10, -1.1e10], dtype)
    codes = jax.jit(jax.vmap(one))(speeds)
    good, bad = jc.Status.OK, jc.Status.NON_FINITE
    np.testing.assert_array_equal(codes, [good, good, bad, bad])
    fast = dataclasses.replace(state, v=speeds[2] * state.v)
    found = jc.analysis.find_first_failure(system, method, fast, None, 1e-3, 2)
    assert "velocity of 'free'" in str(found)
    shared = dataclasses.replace(state, v=jnp.full_like(state.v, 0.6e10))  # 1.8e10 or more together
    found = jc.analysis.find_first_failure(system, method, shared, None, 1e-3, 2)
    assert "velocity of 'free'" in str(found)


@pytest.mark.parametrize("field", ["before", "after"])
@pytest.mark.parametrize("length", [np.inf, -np.inf])
def test_an_infinite_length_of_bending_is_told(field, length):
    """The force divides by that length and would become zero without an error."""
    scene = jc.Scene(dim=2)
    for i, name in enumerate(("first", "second")):
        scene.add_particle(name, mass=1.0, position=(1.0 + i, 0.1 * i))
    scene.add(jc.forces.Bending("bend", jc.WORLD, "first", "second", 2.0, point_a=(0.0, 0.0)))
    system, state = scene.build()

    def one(x):
        poisoned = system.with_params({"bend": {field: x}})
        return jc.step(poisoned, jc.Method(), state, None, 1e-2)[0].status

    codes = jax.jit(jax.vmap(one))(jnp.array([1.0, length]))
    np.testing.assert_array_equal(codes, [jc.Status.OK, jc.Status.NON_FINITE])


@pytest.mark.parametrize("poison", poisoned.POISONS)
def test_heights_that_the_search_reads_are_told_and_others_take_no_part(poison):
    """A large ball beside a slope: heights 4 to 7 are below it, and its search reads height 8."""
    line = np.linspace(-5.5, 5.5, 12)
    scene = jc.Scene(dim=2)
    scene.add_body("ball", mass=1.0, inertia=0.1, position=(0.2, 4.0))
    ground = "ground", jc.WORLD, "ball", 0.3 * line, 11.0
    scene.add(jc.contacts.HeightFieldContact(*ground, radius=3.9))
    system, state = scene.build()

    def one(heights, gravity):
        changed = system.with_params({"ground": {"heights": heights}, "gravity": gravity})
        new, _ = jc.step(changed, jc.Method(), state, None, 1e-2)
        return new.v, new.status

    heights = np.tile(0.3 * line, (13, 1))
    heights[np.arange(12), np.arange(12)] = poison
    derivative = jax.vmap(jax.jacrev(one, 1, has_aux=True), (0, None))
    gravity = system.params["gravity"]
    v, codes = jax.jit(jax.vmap(one, (0, None)))(heights, gravity)
    slopes, _ = jax.jit(derivative)(heights, gravity)
    told = [4, 5, 6, 7, 8]
    assert list(np.flatnonzero(codes)) == told
    free = np.setdiff1d(np.arange(12), told)
    for x in (v, slopes):
        np.testing.assert_array_equal(x[free], np.broadcast_to(x[12], x[free].shape))
    np.testing.assert_array_equal(slopes[np.array(told)], 0.0)


def test_zero_axes_and_quaternions_beside_springs_about_several_axes():
    """Such worlds continue with angles that have no derivative; other gradients do not change."""

    def gimbal(dim):
        joint = jc.joints.Compound("joint", "a", "b", hinges=tuple(np.eye(dim)))
        names = [f"angle_{i}" for i in (1, 2, 3)]
        springs = [jc.forces.JointSpring(f"by {x}", "joint", 3.0, 0.2, coordinate=x) for x in names]
        return [joint, *springs]

    elements = {"gimbal": ((3,), gimbal), "twist": poisoned.FORCES["twist"]}
    system, state = poisoned.stage(3, elements)
    study = poisoned.Study(system, state, jc.Method(), thorough=True)
    fields = ("q", "orientation", "axis")
    cases = [
        case
        for case in study.cases()
        if case.poison == 0.0 and case.path.rsplit("/", 1)[-1].startswith(fields)
    ]
    counts = study.run(cases)
    assert counts.clean, poisoned.words("zeros", counts)
    assert counts.tried >= 50


@pytest.mark.parametrize("time", [np.nan, np.inf])
def test_a_time_that_is_not_finite_is_told(pendulum, time):
    system, state = pendulum
    start = state.replace(time=jnp.asarray(time, state.time.dtype))
    new = jax.jit(lambda s: jc.step(system, jc.Method(), s, None, 1e-3)[0])(start)
    assert new.status == jc.Status.NON_FINITE
    assert "time" in str(jc.analysis.find_first_failure(system, jc.Method(), start, None, 1e-3, 3))


@pytest.mark.parametrize("run", [lambda f, h: f(h), lambda f, h: jax.jit(f)(h)])
def test_a_negative_step_of_a_jax_array_is_told(pendulum, run):
    """A Python number is refused at once; an array is not read."""
    system, state = pendulum

    def status(h):
        return jc.rollout(system, jc.Method(), state, None, h, 3)[0].status

    assert run(status, jnp.asarray(-1e-3)) == jc.Status.NON_FINITE
    assert run(status, jnp.asarray(1e-3)) == jc.Status.OK
    with pytest.raises(ValueError, match="dt"):
        status(-1e-3)


@pytest.mark.parametrize(
    "integrator",
    [
        jc.SemiImplicitEuler(),
        jc.RK4(),
        jc.integrators.RATTLE(),
        jc.integrators.GeneralizedAlpha(),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_quaternion_of_zero_is_told(integrator):
    scene = jc.Scene()
    scene.add_body("box", mass=1.0, inertia=(1.0, 2.0, 2.5))
    system, state = scene.build()
    method = jc.Method(integrator)
    start = jc.init(system, method, state.q, state.v)
    start = start.replace(q=jnp.zeros_like(state.q))
    assert jc.step(system, method, start, None, 1e-3)[0].status == jc.Status.NON_FINITE
    found = jc.analysis.find_first_failure(system, method, start, None, 1e-3, 3)
    assert "box has a quaternion of zeros" in str(found).replace("'", "")
    with pytest.raises(ValueError, match="body 'box': its quaternion in q is zero"):
        jc.init(system, method, start.q, state.v)


@pytest.mark.parametrize("method", [jc.Method(), jc.Method(jc.RK4())])
def test_a_mass_matrix_that_becomes_unsymmetric_is_told(method):
    """At the start it is symmetric."""

    def coupled(other):
        def mass(q, params):
            return jnp.stack([jnp.stack([2.0, q[0]]), jnp.stack([other * q[0], 2.0])])

        system = jc.GeneralizedSystem(mass=mass, force=lambda q, v, t, u, params: -q)
        start = jc.init(system, method, jnp.array([0.0, 0.1]), jnp.array([1.0, 0.0]))
        return jc.rollout(system, method, start, None, 1e-2, 3)[0].status

    assert coupled(1.0) == jc.Status.OK
    assert coupled(0.0) == jc.Status.NON_FINITE
