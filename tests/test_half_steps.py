"""Semi-implicit Euler: v belongs half a step before q, for feedback and for projections."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.scenes import four_bar

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.stabilisation import cast, spatial_loop  # noqa: E402

G = 9.81
KEEPERS = {
    "default": jc.Baumgarte(),
    "slow": jc.Baumgarte.critical(50.0),
    "PID": jc.PID(2500.0, 100.0, 1000.0),
    "projection": jc.Projection(),
    "linearized": jc.Projection(iterations=1),
    "sparse projection": jc.Projection(every=10),
}


def pendulum(speed=2.0):
    """A particle on a rod of a metre, under way."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("bob", mass=1.0, position=(0.0, -1.0), velocity=(speed, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def watched(built, method, dt, steps):
    """(status, worst φ, worst φ̇, worst change of energy) at 200 times."""
    system, state = built

    @jax.jit
    def run(state):
        start = jc.init(system, method, state.q, state.v)

        def seen(state, info):
            off = jc.violation(system, state)
            return off.worst, off.worst_rate, jc.energy(system, state).total

        final, (off, rate, energy) = jc.rollout(
            system, method, start, None, dt, steps, record=seen, every=steps // 200
        )
        change = jnp.max(jnp.abs(energy - jc.energy(system, start).total))
        return final.status, jnp.max(off), jnp.max(rate), change

    return [np.asarray(x) for x in run(state)]


@pytest.mark.parametrize("keeper", KEEPERS)
def test_energy_stays_in_a_band_or_drifts_slowly(keeper):
    """A four-bar at 10 rad/s for 20 s; slow feedback and sparse projections drift by 0.005/s."""
    method = jc.Method(stabilizer=KEEPERS[keeper])
    half, whole = (watched(four_bar(), method, 1e-3, steps) for steps in (10_000, 20_000))
    assert half[0] == whole[0] == jc.Status.OK
    start = float(jc.energy(*four_bar()).kinetic)
    if keeper in ("default", "projection", "linearized"):
        assert whole[3] < min(1.1 * half[3], 0.02 * start)
    else:
        assert whole[3] < 0.006 * 20 * start


def test_the_circle_is_kept_to_third_order():
    """φ is O(h³) by default feedback, where φ̇ held to 0 would leave h²γ/2."""
    worst = [watched(pendulum(), jc.Method(), h, round(4 / h))[1] for h in (4e-3, 2e-3)]
    assert np.log2(worst[0] / worst[1]) > 2.7
    assert worst[1] < 1e-7


def test_the_rate_seen_is_that_of_half_a_step_ago():
    system, state = pendulum()
    rows = linearize(system, state.q, state.v, state.time)
    age = jnp.asarray(1e-3)
    seen = rows.earlier(age).rate
    np.testing.assert_allclose(seen, -1e-3 * 4.0, rtol=1e-12)  # φ̇ = 0 and γ = v²/l
    q = state.q - age * state.v
    before = linearize(system, q, state.v, state.time - age).rate
    np.testing.assert_allclose(seen, before, rtol=1e-5)


def test_a_rotor_has_no_rate():
    """Its row is inertia: feedback has nothing to act on, however it turns."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0), velocity=(0.0, 1.0),
                   angular_velocity=2.0)  # fmt: skip
    hinge = jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0))
    scene.add(hinge)
    scene.add(jc.Armature("rotor", "hinge", inertia=0.2))
    system, state = scene.build()
    rows = linearize(system, state.q, state.v, state.time)
    rotor = rows.layout.rows("rotor")
    seen = rows.earlier(jnp.asarray(0.1)).rate
    np.testing.assert_array_equal(seen[rotor], rows.rate[rotor])
    others = rows.layout.rows("hinge")
    assert np.max(np.abs(seen[others] - rows.rate[others])) > 0.1


def test_rows_of_velocities_are_held_where_q_is():
    """A blade in a turn does not slip by ½hγ."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    moving = {"velocity": (3.0, 0.0), "angular_velocity": 1.0}
    scene.add_body("skate", mass=60.0, inertia=2.0, position=(0.0, 0.0), **moving)
    scene.add(jc.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    built = scene.build()
    code, _, slip, change = watched(built, jc.Method(), 1e-2, 400)
    assert code == jc.Status.OK
    assert slip < 1e-4  # 3 m/s · 1 rad/s · h/2 = 1.5e-2
    assert change < 0.05 * 0.5 * 60.0 * 3.0**2


def test_a_start_off_the_surface_gains_no_speed():
    """What the state was off before the step is not counted as a displacement by it."""
    system, state = pendulum(0.0)
    q = 1.1 * state.q
    for method in (jc.Method(stabilizer=jc.Projection()), jc.Method(jc.RK4(), jc.Projection())):
        start = jc.init(system, method, q, state.v)
        new, _ = jc.step(system, method, start, None, 1e-3)
        assert jc.violation(system, new).worst < IDENTITY
        assert np.max(np.abs(new.v)) < 1e-9


@pytest.mark.parametrize("speed", [0.0, 1e-9, 1e-3])
def test_two_links_off_the_surface_gain_no_speed(speed):
    """Here d is not normal to the surface where it ends, and d/h would be kept in part."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    for i, place in enumerate([(1.1, 0.1), (1.2, 1.2)]):
        scene.add_particle(f"bob{i}", mass=1.0, position=place)
        before = f"bob{i - 1}" if i else jc.WORLD
        scene.add(jc.Distance(f"rod{i}", before, f"bob{i}", length=1.0))
    system, state = scene.build()
    for dtype in (jnp.float64, jnp.float32):
        own, at = jax.tree.map(
            lambda x, dtype=dtype: x.astype(dtype) if x.dtype == jnp.float64 else x, (system, state)
        )
        for integrator in (jc.SemiImplicitEuler(), jc.RK4()):
            method = jc.Method(integrator, jc.Projection())
            start = jc.init(own, method, at.q, at.v + dtype(speed))
            new, _ = jc.step(own, method, start, None, 1e-3)
            assert np.max(np.abs(new.v)) < 3 * speed + 1e-12


def test_derivatives_of_a_hanging_rod_in_float32():
    """At rest T(v*) is rounding, of which nothing may be divided away."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G), dtype=jnp.float32)
    scene.add_particle("bob", mass=0.1, position=(0.0, -0.1))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Projection())

    def swing(speed, steps):
        push = speed * jnp.array([1.0, 0.0], jnp.float32)
        start = jc.init(system, method, state.q, state.v + push)
        return jc.rollout(system, method, start, None, 1e-3, steps)[0].q[0]

    for steps in (1, 20, 200):
        got = jax.jit(jax.grad(lambda x, steps=steps: swing(x, steps)))(jnp.float32(0.0))
        assert np.isfinite(got)
    frequency = np.sqrt(G / 0.1)
    np.testing.assert_allclose(got, np.sin(0.2 * frequency) / frequency, rtol=2e-2)


def test_forces_are_read_without_feedback():
    """λ of a body on a circle, after steps that left φ̇ = ½hγ: minus m v²/l."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(0.0, 2.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    final, _ = jc.rollout(system, jc.Method(), state, None, 1e-3, 50)
    _, info = jc.step(system, jc.Method(), final, None, 1e-3)
    read = jc.forward_dynamics(system, final, None, jc.Method(stabilizer=jc.Unstabilized()), 1e-3)
    np.testing.assert_allclose([info.multipliers[0], read.multipliers[0]], -4.0, rtol=1e-3)


def test_derivatives_at_rest_and_under_way():
    """Of a projected step, where d = 0 and v = 0, and where neither is."""
    system, state = pendulum(0.0)
    method = jc.Method(stabilizer=jc.Projection())

    def after(x):
        q = state.q + jnp.array([1.0, 0.0]) * x[0]
        start = jc.init(system, method, q, state.v + jnp.array([1.0, 0.0]) * x[1])
        final, _ = jc.rollout(system, method, start, None, 1e-2, 5)
        return jnp.concatenate([final.q, final.v])

    derivative, value = jax.jit(jax.jacobian(after)), jax.jit(after)
    for x in (jnp.zeros(2), jnp.array([0.0, 2.0])):
        e = 1e-6 * jnp.eye(2)
        numbers = np.stack([(value(x + d) - value(x - d)) / 2e-6 for d in e], 1)
        got = derivative(x)
        assert np.all(np.isfinite(got))
        np.testing.assert_allclose(got, numbers, atol=1e-6)


def test_worlds_in_float32_keep_their_dtype():
    system, state = jax.tree.map(
        lambda x: x.astype("float32") if x.dtype == "float64" else x, pendulum()
    )
    method = jc.Method(stabilizer=jc.Projection())
    final, _ = jc.rollout(system, method, state, None, 1e-3, 500)
    assert final.q.dtype == final.v.dtype == jnp.float32
    assert jc.violation(system, final).worst < 1e-6
    worlds = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    worlds = dataclasses.replace(worlds, v=worlds.v * jnp.array([[1.0], [0.5]], jnp.float32))
    both = jax.jit(jax.vmap(lambda s: jc.rollout(system, method, s, None, 1e-3, 500)[0]))(worlds)
    np.testing.assert_allclose(both.q[0], final.q, atol=1e-5)


VARIATIONAL = jc.Method(jc.SemiImplicitEuler(gyroscopic="trapezoidal"))


def tumbling(spin):
    """A free body with three moments of inertia, about its middle axis, and its energy."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    solid = jc.inertia.box(1.0, (0.3, 0.2, 0.1))
    scene.add_body("box", inertia=solid, angular_velocity=(0.01 * spin, spin, 0.0))
    return scene.build()


@pytest.mark.parametrize("spin", [10.0, 100.0])
def test_a_free_body_neither_gains_energy_nor_momentum(spin):
    """It flips over and over; a body that turns by 0.1 a step is off by (0.1)², without drift."""
    system, state = tumbling(spin)
    h = 1e-3

    def seen(state, _):
        return jc.energy(system, state).total, jc.angular_momentum(system, state)

    run = jax.jit(lambda s: jc.rollout(system, VARIATIONAL, s, None, h, 20000, record=seen)[1])
    energy, momentum = (np.asarray(x) for x in run(state))
    before = float(jc.energy(system, state).total)
    off = np.abs(energy / before - 1)
    turning = np.asarray(jc.angular_momentum(system, state))
    turned = np.linalg.norm(momentum - turning[None], axis=1) / np.linalg.norm(turning)
    assert np.max(off) < (h * spin) ** 2
    assert np.max(off[10000:]) < 1.1 * np.max(off[:10000]) + 1e-13
    assert np.max(turned) < h * spin


def test_rods_that_spin_about_themselves_in_a_loop_keep_their_energy():
    """With the torque of the start of a step they gain a tenth of it in 5 s, and end in 84 s."""
    built = spatial_loop()
    status, off, _, change = watched(built, VARIATIONAL, 1e-3, 20_000)
    assert status == jc.Status.OK
    assert off < 1e-5
    assert change < 5e-3 * G


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_a_change_of_spin_has_a_derivative_at_rest_and_at_any_speed(dtype, size):
    """Also of a mote and of a mountain: three moments, whose product is no number of float32."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_body("body", mass=size, inertia=(size, 2 * size, 2.5 * size))
    system, state = jax.tree.map(lambda x: cast(x, dtype), scene.build())

    def after(v):
        moved = dataclasses.replace(state, v=v)
        return jc.step(system, VARIATIONAL, moved, None, jnp.asarray(1e-2, dtype))[0].v

    slope = jax.jit(jax.jacfwd(after))
    for spin in (0.0, 1.0, 45.0, 1000.0):  # hω = 0, 0.01, 0.45, 10
        v = jnp.asarray([0, 0, 0, 0.3 * spin, spin, -0.2 * spin], dtype)
        found = np.asarray(slope(v))
        assert np.all(np.isfinite(found))
        if dtype == np.float64 and spin:
            for i in range(3, 6):
                d = 1e-6 * spin
                difference = (after(v.at[i].add(d)) - after(v.at[i].add(-d))) / (2 * d)
                np.testing.assert_allclose(found[:, i], difference, atol=1e-6)


def top(spin):
    """A symmetric top that leans by half a radian and goes round steadily, and its rate [1/s].

    With θ from the upright: A Ω² cos θ − C s Ω + m g l = 0, A about the tip, s all that it turns
    about its own axis.
    """
    m, arm, across, along, lean = 1.0, 0.3, 0.02, 0.03, 0.5
    about = across + m * arm * arm
    rate = float(np.min(np.roots([about * np.cos(lean), -along * spin, m * G * arm])))
    axis = np.array([np.sin(lean), 0.0, np.cos(lean)])
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -G))
    turn = (np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0)
    scene.add_body(
        "top",
        mass=m,
        inertia=(across, across, along),
        position=arm * axis,
        quaternion=turn,
        velocity=np.cross((0.0, 0.0, rate), arm * axis),
        angular_velocity=(-rate * np.sin(lean), 0.0, spin),
    )
    scene.add(jc.Spherical("tip", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    return scene.build(), rate


@pytest.mark.parametrize(
    "stabilizer", [jc.Baumgarte(), jc.Baumgarte.critical(50.0), jc.Projection()], ids=range(3)
)
def test_a_top_goes_round_steadily(stabilizer):
    """A fifth of a radian a step; the rows hold what the torque adds to v, whatever the gains."""
    (system, state), rate = top(200.0)
    method = jc.Method(VARIATIONAL.integrator, stabilizer)
    status, off, _, change = watched((system, state), method, 1e-3, 2000)
    final, _ = jax.jit(
        lambda s: jc.rollout(system, method, s, None, 1e-3, 600, record=lambda s, i: None)
    )(jc.init(system, method, state.q, state.v))
    x, y, _ = jc.position(system, final, "top")
    assert status == jc.Status.OK
    assert off < 1e-2
    assert change < 1e-3 * 0.5 * 0.03 * 200.0**2
    np.testing.assert_allclose(np.arctan2(y, x) / 0.6, rate, rtol=3e-2)


def test_the_rule_of_the_torque_is_nothing_in_the_plane_and_not_for_every_stabilizer():
    system, state = four_bar()
    explicit, other = (
        jax.jit(lambda s, m=m: jc.step(system, m, s, None, 1e-3)[0].v)(state)
        for m in (jc.Method(), VARIATIONAL)
    )
    np.testing.assert_array_equal(explicit, other)
    system, state = tumbling(1.0)
    with pytest.raises(ValueError, match="gyroscopic must be one of"):
        jc.step(system, jc.Method(jc.SemiImplicitEuler("implicit")), state, None, 1e-3)
    rounds = jc.AugmentedLagrangian()
    for stabilizer in (rounds, jc.Penalty({}, others=rounds)):
        method = jc.Method(VARIATIONAL.integrator, stabilizer)
        start = jc.init(system, method, state.q, state.v)
        with pytest.raises(ValueError, match="rounds of its own"):
            jax.eval_shape(lambda s, m=method: jc.step(system, m, s, None, 1e-3), start)
