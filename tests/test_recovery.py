"""Failed steps are repaired in their world alone: rolled back, projected, or relaxed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DIFFERENCE

import jaxcon as jc

DT, STEPS, WORLDS, SICK = 1e-3, 30, 3, 1
HEALTHY = np.array([0, 2])
OK, ROLLED_BACK, PROJECTED, RELAXED = 0, 17, 18, 19
LIMIT, SHRINK, GROWTH, DAMPING, RETRIES = 0.02, 0.5, 1.25, 0.25, 4
METHOD = jc.Method(
    stabilizer=jc.Baumgarte.critical(rate=20.0),
    recovery=jc.stabilizers.Recovery(LIMIT, SHRINK, GROWTH, DAMPING, retries=RETRIES),
)


@pytest.fixture(scope="module")
def scene():
    """A pendulum that is pushed."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(0.6, 0.8), velocity=(0.4, -0.3))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    scene.add(jc.forces.ExternalWrench("push", "bob"))
    system, state = scene.build()
    return system, jc.init(system, METHOD, state.q, state.v)


@pytest.fixture(scope="module")
def simulate(scene):
    """Returns the function that simulates all worlds: final states, and (state, info) by step."""
    system, start = scene

    def one(x):
        changed = system.with_params({"bob": {"mass": x["mass"]}, "rod": {"length": x["length"]}})
        state = dataclasses.replace(start, q=x["q"])
        return jc.rollout(
            changed, METHOD, state, x["control"], DT, STEPS, record=lambda s, i: (s, i)
        )

    return jax.jit(jax.vmap(one))


def numbers(state):
    """Returns the numbers of a batch of healthy worlds."""
    return {
        "q": np.tile(state.q, (WORLDS, 1)),
        "control": np.tile([[0.0, 1.0]], (WORLDS, STEPS, 1)) * np.arange(WORLDS)[:, None, None],
        "mass": np.ones(WORLDS),
        "length": np.ones(WORLDS),
    }


def sicken(x, **changes):
    """Returns the batch with the numbers of one world changed."""
    x = {name: np.array(value) for name, value in x.items()}
    for name, change in changes.items():
        change(x[name][SICK], x[name])
    return x


def put(index, value):
    """Returns a function that writes a value into the numbers of the failing world."""

    def change(_, whole):
        whole[(SICK, *index)] = value

    return change


def test_a_failed_step_is_rolled_back_and_tried_again_with_weaker_feedback(scene, simulate):
    x = numbers(scene[1])
    well = simulate(x)
    final, (states, infos) = sick = simulate(sicken(x, control=put((5, 0), np.nan)))
    for a, b in zip(jax.tree.leaves(well), jax.tree.leaves(sick), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[HEALTHY], np.asarray(b)[HEALTHY])
    codes = np.asarray(infos.status)
    np.testing.assert_array_equal(codes[HEALTHY], OK)
    # relaxation grows from 0.5 by 1.25 a step and is 1 after four
    expected = [OK] * 5 + [ROLLED_BACK] + [RELAXED] * 4 + [OK] * (STEPS - 10)
    np.testing.assert_array_equal(codes[SICK], expected)
    np.testing.assert_array_equal(states.q[SICK, 5], states.q[SICK, 4])
    np.testing.assert_allclose(states.v[SICK, 5], (1 - DAMPING) * states.v[SICK, 4], rtol=1e-15)
    np.testing.assert_array_equal(states.time[SICK, 5], states.time[SICK, 4])
    np.testing.assert_allclose(final.time, np.array([30, 29, 30]) * DT, rtol=1e-12)
    relaxation = states.memory.recovery.relaxation[SICK, 4:11]
    np.testing.assert_allclose(relaxation, [1, 0.5, 0.625, 0.78125, 0.9765625, 1, 1])
    np.testing.assert_array_equal(states.memory.recovery.failures[SICK], np.arange(STEPS) == 5)
    np.testing.assert_array_equal(infos.multipliers[SICK, 5], 0)
    assert final.status[SICK] == ROLLED_BACK
    jc.raise_for_status(final)


def test_a_state_off_its_constraints_is_projected_to_the_nearest(scene, simulate):
    system, state = scene
    far = np.array([0.9, 1.2])
    x = sicken(numbers(state), q=put((), far))
    final, (states, infos) = simulate(x)
    np.testing.assert_array_equal(infos.status[SICK, :2], [PROJECTED, RELAXED])
    np.testing.assert_allclose(states.q[SICK, 0], far / 1.5, rtol=1e-12)  # in the same direction
    direction = far / 1.5
    kept = (1 - DAMPING) * np.asarray(state.v)
    np.testing.assert_allclose(states.v[SICK, 0], kept - direction * (direction @ kept), rtol=1e-12)
    assert states.time[SICK, 0] == 0
    left = jax.vmap(lambda s: jc.violation(system, s).worst)(final)
    assert np.max(left) < 1e-4


def test_after_so_many_attempts_the_failure_sticks(scene, simulate):
    final, (states, infos) = simulate(sicken(numbers(scene[1]), mass=put((), np.nan)))
    sticks = [ROLLED_BACK] * RETRIES + [jc.Status.NON_FINITE] * (STEPS - RETRIES)
    np.testing.assert_array_equal(infos.status[SICK], sticks)
    assert final.status[SICK] == jc.Status.NON_FINITE
    assert np.all(np.isfinite(states.q))
    np.testing.assert_array_equal(final.q[SICK], scene[1].q)
    np.testing.assert_array_equal(infos.status[HEALTHY], OK)


def test_the_limit_that_cannot_be_kept_is_named():
    """Two rods hold a particle such that no configuration satisfies both."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    for name, length in (("rod", 1.0), ("longer", 1.1)):
        scene.add(jc.Distance(name, jc.WORLD, "bob", length=length))
    system, state = scene.build()
    method = jc.Method(recovery=jc.stabilizers.Recovery(limit=0.01, retries=2))
    state = jc.init(system, method, state.q, state.v)
    final, _ = jc.rollout(system, method, state, None, DT, 5)
    assert final.status == jc.Status.VIOLATED
    with pytest.raises(jc.SimulationError, match="VIOLATED.*limit"):
        jc.raise_for_status(final)


def test_gains_that_are_unstable_are_relaxed_until_they_hold(scene):
    """φ̇⁺ = (1 − 2hα) φ̇ − …: for hα > 0.83 errors grow, and recovery lowers the gains."""
    system, start = scene
    wild = jc.Baumgarte.critical(rate=1.5 / DT)
    worst, codes = {}, {}
    for name, recovery in (
        ("without", None),
        ("with", jc.stabilizers.Recovery(limit=1e-3, retries=20)),
    ):
        method = jc.Method(stabilizer=wild, recovery=recovery)
        state = jc.init(system, method, start.q, start.v)

        def record(s, info):
            return jc.violation(system, s).worst, info.status

        with pytest.warns(UserWarning, match="unstable"):
            _, (worst[name], codes[name]) = jc.rollout(
                system, method, state, None, DT, 200, record=record
            )
    assert not np.max(worst["without"]) < 0.1
    assert np.max(worst["with"]) < 1e-3
    taken = np.isin(codes["with"], (OK, RELAXED))
    assert set(np.unique(codes["with"])) <= {OK, ROLLED_BACK, PROJECTED, RELAXED}
    assert np.sum(taken) > 150


def test_gradients_are_finite_and_those_of_what_was_done(scene, simulate):
    """One world of the batch was rolled back, one projected, and one is healthy."""
    system, start = scene
    x = numbers(start)
    x["control"][0, 5] = np.nan
    x["q"][1] = [0.9, 1.2]

    def loss(gravity, q, control):
        changed = system.with_params({"gravity": gravity})
        state = dataclasses.replace(start, q=q)
        return jnp.sum(jc.rollout(changed, METHOD, state, control, DT, STEPS)[0].q)

    def total(gravity, q):
        return jnp.sum(jax.vmap(loss, (None, 0, 0))(gravity, q, jnp.asarray(x["control"])))

    value, slope = jax.jit(total), jax.jit(jax.grad(total, (0, 1)))
    gravity, q = jnp.array([0.3, -9.81]), jnp.asarray(x["q"])
    by_gravity, by_q = slope(gravity, q)
    dg, dq = jnp.array([0.7, 0.4]), jnp.asarray(np.random.default_rng(0).normal(size=q.shape))
    step = 1e-6
    ahead, behind = (value(gravity + s * dg, q + s * dq) for s in (step, -step))
    got = by_gravity @ dg + jnp.sum(by_q * dq)
    np.testing.assert_allclose(got, (ahead - behind) / (2 * step), rtol=DIFFERENCE)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_generalized_coordinates_recover_too(dtype):
    """Covers batches, a user-defined correction, and both dtypes."""

    class Straight(jc.stabilizers.Unstabilized):
        def correct(self, system, solver, before, state, memory, dt):
            return dataclasses.replace(state, q=jnp.zeros_like(state.q).at[0].set(1)), state.status

    straight = jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(Straight))
    rod = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.stack([p, p]),
        force=lambda q, v, t, u, p: jnp.stack([0 * q[0], -9.81 * p]),
        constraints=(jc.joints.Holonomic(lambda q, t, p: jnp.stack([q @ q - 1]), name="length"),),
        params=jnp.ones((), dtype),
    )
    method = jc.Method(recovery=jc.stabilizers.Recovery(limit=0.1, projector=straight()))
    state = jc.init(rod, method, jnp.array([1.0, 0.0], dtype), jnp.zeros(2, dtype))
    starts = jnp.array([[1.0, 0.0], [2.0, 3.0]], dtype)
    final, codes = jax.vmap(
        lambda q: jc.rollout(
            rod, method, dataclasses.replace(state, q=q), None, DT, 3, record=lambda s, i: i.status
        )
    )(starts)
    np.testing.assert_array_equal(codes, [[OK, OK, OK], [PROJECTED, RELAXED, RELAXED]])
    assert final.q.dtype == dtype
    assert np.all(np.isfinite(final.q))


def test_numbers_that_are_arrays_are_checked_inside_a_trace_too():
    """The numbers of a tuned method are arrays, concrete in a trace that closes over them."""

    recovery = jax.tree.map(jnp.asarray, jc.stabilizers.Recovery(limit=0.1, shrink=0.5))
    jax.make_jaxpr(recovery.check)()
    wrong = jax.tree.map(lambda x: jnp.where(x == 0.5, 1.5, x), recovery)
    with pytest.raises(ValueError, match="shrink must be above 0 and at most 1"):
        jax.make_jaxpr(wrong.check)()


def test_what_is_refused(scene):
    system, state = scene
    for wrong, kind, words in (
        (
            lambda: jc.stabilizers.Recovery(growth=float("nan")),
            ValueError,
            "growth must be 1 or more and finite",
        ),
        (
            lambda: jc.stabilizers.Recovery(growth=float("inf")),
            ValueError,
            "growth must be 1 or more and finite",
        ),
        (
            lambda: jc.stabilizers.Recovery(shrink=2.0),
            ValueError,
            "shrink must be above 0 and at most 1, got 2.0",
        ),
        (
            lambda: jc.stabilizers.Recovery(shrink="a"),
            ValueError,
            "shrink must be a real number, got 'a'",
        ),
        (
            lambda: jc.stabilizers.Recovery(limit=1j),
            ValueError,
            "limit must be a real number, got 1j",
        ),
        (
            lambda: jc.stabilizers.Recovery(limit=True),
            ValueError,
            "limit must be a real number, got True",
        ),
        (lambda: jc.stabilizers.Recovery(limit=-1.0), ValueError, "limit must be positive"),
        (
            lambda: jc.stabilizers.Recovery(projector=jc.Baumgarte()),
            ValueError,
            "Baumgarte corrects no positions",
        ),
        (
            lambda: jc.stabilizers.Recovery(projector=jc.stabilizers.Penalty(1.0)),
            ValueError,
            "Penalty corrects no positions",
        ),
        (
            lambda: jc.stabilizers.Recovery(projector=jc.Projection(position=False)),
            ValueError,
            "Projection corrects no positions",
        ),
        (
            lambda: jc.stabilizers.Recovery(
                projector=jc.stabilizers.Hybrid(
                    jc.stabilizers.Penalty(1.0), large=jc.Projection(position=False)
                )
            ),
            ValueError,
            "Hybrid corrects no positions",
        ),
        (
            lambda: jc.stabilizers.Recovery(
                projector=jc.stabilizers.Hybrid(
                    jc.stabilizers.Penalty(1.0), large=jc.Projection(every=10)
                )
            ),
            ValueError,
            "Hybrid has a memory",
        ),
        (
            lambda: jc.stabilizers.Recovery(
                projector=jc.stabilizers.AugmentedLagrangian(feedback=jc.Projection())
            ),
            ValueError,
            "AugmentedLagrangian has a memory",
        ),
        (
            lambda: jc.stabilizers.Recovery(projector=jc.Projection(metric="Mass")),
            ValueError,
            "metric must be one of",
        ),
        (
            lambda: jc.stabilizers.Recovery(projector=jc.Projection(factor=3.0)),
            ValueError,
            "factor must be above 0 and at most 1",
        ),
        (
            lambda: jc.stabilizers.Recovery(projector="projection"),
            TypeError,
            "projector must be a stabilizer",
        ),
        (
            lambda: jc.stabilizers.Recovery,
            TypeError,
            r"recovery must be a value such as Recovery\(\)",
        ),
    ):
        with pytest.raises(kind, match=words):
            jc.step(system, jc.Method(recovery=wrong()), state, None, DT)
    forgetful = dataclasses.replace(state, memory=())
    with pytest.raises(ValueError, match="does not have the memory"):
        jc.step(system, METHOD, forgetful, None, DT)
