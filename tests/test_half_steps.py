"""Semi-implicit Euler, whose v belongs half a step before q: feedback, projections, fast spins."""

import dataclasses
import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.core.pytree import pytree
from jaxcon.protocols import Stabilizer
from jaxcon.scenes import four_bar

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.energy_drift import METHODS, PENDULUMS, measure  # noqa: E402
from benchmarks.stabilisation import cast, spatial_loop  # noqa: E402

G = 9.81
KEEPERS = {
    "default": jc.Baumgarte(),
    "slow": jc.Baumgarte.critical(50.0),
    "PID": jc.stabilizers.PID(2500.0, 100.0, 1000.0),
    "projection": jc.Projection(),
    "linearized": jc.Projection(iterations=1),
    "sparse projection": jc.Projection(every=10),
}


def pendulum(speed=2.0):
    """A moving particle on a rod of one meter."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G))
    scene.add_particle("bob", mass=1.0, position=(0.0, -1.0), velocity=(speed, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


@functools.partial(jax.jit, static_argnames=("steps", "record", "every"))
def rolled(system, method, state, h, steps, record=None, every=1):
    """Returns the last state and the records.

    Scenes that differ only in numbers share a program.
    """
    start = jc.init(system, method, state.q, state.v)

    def seen(state, info):
        return record and record(system, state)

    return jc.rollout(system, method, start, None, h, steps, record=seen, every=every)


def seen_to_drift(system, state):
    """Returns the worst φ, the worst φ̇, and the energy."""
    off = jc.violation(system, state)
    return off.worst, off.worst_rate, jc.energy(system, state).total


def watched(built, method, dt, steps, times=200):
    """Returns (status, worst φ, worst φ̇, worst energy change up to each of `times` instants)."""
    system, state = built
    final, (off, rate, energy) = rolled(
        system, method, state, dt, steps, seen_to_drift, steps // times
    )
    change = np.maximum.accumulate(np.abs(energy - jc.energy(system, state).total))
    return np.asarray(final.status), np.max(off), np.max(rate), change


@pytest.mark.parametrize("keeper", KEEPERS)
def test_energy_stays_in_a_band_or_drifts_slowly(keeper):
    """A four-bar at 10 rad/s for 20 s; slow feedback and rare projections drift by 0.005/s."""
    method = jc.Method(stabilizer=KEEPERS[keeper])
    status, _, _, change = watched(four_bar(), method, 1e-3, 20_000, 400)
    half, whole = change[199], change[-1]
    assert status == jc.Status.OK
    start = float(jc.energy(*four_bar()).kinetic)
    if keeper in ("default", "projection", "linearized"):
        assert whole < min(1.1 * half, 0.02 * start)
    else:
        assert whole < 0.006 * 20 * start


def swinging(name):
    """A particle pendulum, a rod pendulum or a double pendulum, released level."""
    scene = jc.Scene(dim=2)
    if name == "particle":
        scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
        scene.add(jc.Distance("thread", jc.WORLD, "bob"))
        return scene.build()
    for i in range(1 if name == "rod" else 2):
        before = f"link{i - 1}" if i else jc.WORLD
        scene.add_body(f"link{i}", mass=1.0, inertia=1 / 12, position=(i + 0.5, 0.0))
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(float(i), 0.0)))
    return scene.build()


@pytest.mark.parametrize(("name", "h"), [("particle", 0.02), ("rod", 0.02), ("two rods", 0.01)])
def test_energy_drifts_slowly_at_large_steps(name, h):
    """The bound is 1.5 % of the largest kinetic energy a minute.

    Linearized rows alone gain 4 to 18 %.
    """
    (system, state), method = swinging(name), jc.Method()

    def seen(state, info):
        # v belongs half a step before q
        a = jc.forward_dynamics(system, state, None, method, h).acceleration
        energy = jc.energy(system, dataclasses.replace(state, v=state.v + h / 2 * a))
        return energy.total, energy.kinetic

    steps = round(60 / h)
    final, (total, kinetic) = jax.jit(
        lambda s: jc.rollout(system, method, s, None, h, steps, record=seen)
    )(state)
    assert final.status == jc.Status.OK
    tenth = steps // 10
    drift = np.mean(total[-tenth:]) - np.mean(total[:tenth])
    assert abs(drift) < 0.015 * np.max(kinetic)


def test_the_circle_is_kept_to_third_order():
    """The violation φ is O(h³) with default gains. Feedback to φ̇ = 0 would leave h²γ/2."""
    worst = [watched(pendulum(), jc.Method(), h, 2000)[1] for h in (4e-3, 2e-3)]
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
    """The row of a rotor adds inertia; it has no φ̇ that feedback could act on."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0), velocity=(0.0, 1.0),
                   angular_velocity=2.0)  # fmt: skip
    hinge = jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0))
    scene.add(hinge)
    scene.add(jc.joints.Armature("rotor", "hinge", inertia=0.2))
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
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0)))
    built = scene.build()
    code, _, slip, change = watched(built, jc.Method(), 1e-2, 400)
    assert code == jc.Status.OK
    assert slip < 1e-4  # 3 m/s · 1 rad/s · h/2 = 1.5e-2
    assert change[-1] < 0.05 * 0.5 * 60.0 * 3.0**2


def test_a_start_off_the_surface_gains_no_speed():
    """The violation before a step is not counted as a displacement by the step."""
    system, state = pendulum(0.0)
    q = 1.1 * state.q
    for method in (jc.Method(stabilizer=jc.Projection()), jc.Method(jc.RK4(), jc.Projection())):
        start = jc.init(system, method, q, state.v)
        new, _ = jc.step(system, method, start, None, 1e-3)
        assert jc.violation(system, new).worst < IDENTITY
        assert np.max(np.abs(new.v)) < 1e-9


@pytest.mark.parametrize("speed", [0.0, 1e-9, 1e-3])
def test_two_links_off_the_surface_gain_no_speed(speed):
    """The correction d is not normal to the surface at its end; a velocity d/h must not remain."""
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
    """At rest T(v*) is rounding error, and nothing may be divided by it."""
    scene = jc.Scene(dim=2, gravity=(0.0, -G), dtype=jnp.float32)
    scene.add_particle("bob", mass=0.1, position=(0.0, -0.1))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Projection())

    @jax.jit
    @jax.grad
    def slope(speed, last):
        push = speed * jnp.array([1.0, 0.0], jnp.float32)
        start = jc.init(system, method, state.q, state.v + push)
        return jc.rollout(system, method, start, None, 1e-3, 200)[1].q[last, 0]

    for steps in (1, 20, 200):
        got = slope(jnp.float32(0.0), steps - 1)
        assert np.isfinite(got)
    frequency = np.sqrt(G / 0.1)
    np.testing.assert_allclose(got, np.sin(0.2 * frequency) / frequency, rtol=2e-2)


def test_forces_are_read_without_feedback():
    """λ = −m v²/l of a body on a circle, although earlier steps leave φ̇ = ½hγ."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(0.0, 2.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    final, _ = jc.rollout(system, jc.Method(), state, None, 1e-3, 50)
    _, info = jc.step(system, jc.Method(), final, None, 1e-3)
    read = jc.forward_dynamics(
        system, final, None, jc.Method(stabilizer=jc.stabilizers.Unstabilized()), 1e-3
    )
    np.testing.assert_allclose([info.multipliers[0], read.multipliers[0]], -4.0, rtol=1e-3)


def test_derivatives_at_rest_and_under_way():
    """Derivatives of projected steps at d = 0 and v = 0, and in motion."""
    system, state = pendulum(0.0)
    method = jc.Method(stabilizer=jc.Projection())

    def after(x):
        q = state.q + jnp.array([1.0, 0.0]) * x[0]
        start = jc.init(system, method, q, state.v + jnp.array([1.0, 0.0]) * x[1])
        final, _ = jc.rollout(system, method, start, None, 1e-2, 5)
        return jnp.concatenate([final.q, final.v])

    both = jax.jit(lambda x: (after(x), jax.jacobian(after)(x)))
    for x in (jnp.zeros(2), jnp.array([0.0, 2.0])):
        e = 1e-6 * jnp.eye(2)
        numbers = np.stack([(both(x + d)[0] - both(x - d)[0]) / 2e-6 for d in e], 1)
        got = both(x)[1]
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


def spinning(axis, spin, others, dtype=None):
    """A free body with three moments of inertia, spinning about one of its principal axes."""
    rates = [others] * 3
    rates[axis] = spin
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0), dtype=dtype)
    scene.add_body("box", mass=1.0, inertia=(0.01, 0.02, 0.025), angular_velocity=tuple(rates))
    return scene.build()


def kept(system, state):
    return jc.energy(system, state).kinetic, jc.angular_momentum(system, state)


def conserved(built, method, dt, steps, every):
    """Returns kinetic energy, |L| and L of a force-free motion, over their initial values."""
    system, state = built
    path = rolled(system, method, state, dt, steps, kept, every)[1]
    energy, momentum = (np.asarray(x, np.float64) for x in path)
    start = [np.asarray(x, np.float64) for x in kept(system, state)]
    size = np.linalg.norm(start[1])
    turned = np.linalg.norm(momentum - start[1], axis=1) / size
    return energy / start[0], np.linalg.norm(momentum, axis=1) / size, turned


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("axis", range(3))
def test_a_free_body_keeps_energy_and_momentum_for_200_s(axis, dtype):
    """The spin is 9 rad/s at 60 steps a second; about the middle axis the body tumbles."""
    built = spinning(axis, 9.0, 0.05, dtype)
    energy, size, _ = conserved(built, jc.Method(), 1 / 60, 12_000, 10)
    assert np.max(np.abs(energy - 1)) < (1e-4 if dtype == np.float32 else 1e-6)
    assert np.max(np.abs(size - 1)) < (1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.parametrize("turn", [0.3, 1.0])
def test_a_free_body_gains_no_energy_at_a_radian_a_step(turn):
    """|L| is kept to rounding at any rotation, the energy to 3e-4 at a radian a step."""
    for axis, others in ((1, 0.05), (2, 5.0)):
        energy, size, _ = conserved(spinning(axis, 9.0, others), jc.Method(), turn / 9, 6000, 10)
        assert np.max(energy) < 1 + 1e-3 * turn**4
        assert np.min(energy) > 1 - 1e-3 * turn**4
        assert np.max(np.abs(size - 1)) < 1e-12


def test_the_direction_of_momentum_is_kept_to_first_order():
    """L belongs half a step before; its direction oscillates by ½h|ω| and does not drift."""
    off = [
        np.max(conserved(spinning(1, 9.0, 0.5), jc.Method(), h, round(20 / h), 4)[2])
        for h in (8e-3, 4e-3)
    ]
    assert off[0] < 9.0 * 8e-3
    assert 1.7 < off[0] / off[1] < 2.3


def hinge_and_ball(beside=None):
    """A box on a hinge carries another box on a ball joint; `beside` adds a stone or friction."""
    scene = jc.Scene(dim=3)
    solids = jc.inertia.box(1.0, (0.1, 0.2, 0.5)), jc.inertia.box(0.5, (0.1, 0.15, 0.4))
    scene.add_body("upper", inertia=solids[0], position=(0.0, 0.0, -0.25))
    scene.add_body("lower", inertia=solids[1], position=(0.0, 0.0, -0.7))
    scene.add(jc.Revolute("hinge", jc.WORLD, "upper", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    scene.add(jc.Spherical("ball", "upper", "lower", point=(0.0, 0.0, -0.5)))
    if beside == "stone":
        scene.add_particle("stone", mass=1.0, position=(5.0, 5.0, 0.0))
        scene.add(jc.PlaneContact("floor", jc.WORLD, "stone"))
    elif beside == "friction":
        scene.add(jc.contacts.JointFriction("dry", "hinge", 1e-9))
    return scene.build()


def thrown(system, hinge, spin):
    """Returns v for a hinge rate and an angular velocity of the lower box."""
    rate = np.array([0.0, hinge, 0.0])
    end = np.cross(rate, (0.0, 0.0, -0.5))
    v = np.zeros(system.n_v)
    v[system.layout.v("upper")] = [*(end / 2), *rate]
    v[system.layout.v("lower")] = [*(end + np.cross(spin, (0.0, 0.0, -0.2))), *spin]
    return jnp.asarray(v)


STARTS = [
    (3.0, (0.0, 3.0, 0.0)),
    (1.0, (2.0, -1.0, 3.0)),
    (2.0, (4.0, 1.0, -3.0)),
    (4.0, (6.0, 2.0, 5.0)),
    (1.0, (2.0, -8.0, 12.0)),
]


FED, PROJECTED = jc.Baumgarte(), jc.Projection()


@pytest.mark.parametrize(
    ("beside", "stabilizer", "dtype"),
    [
        (None, FED, np.float32),
        (None, FED, np.float64),
        ("stone", FED, np.float64),
        ("friction", FED, np.float64),
        (None, PROJECTED, np.float32),
        ("stone", PROJECTED, np.float64),
    ],
)
def test_a_hinge_and_a_ball_joint_keep_their_energy_at_20_ms(beside, stabilizer, dtype):
    """The change in 120 s is below a tenth of the largest kinetic energy, at up to 0.3 rad a step.

    Neither a distant stone nor negligible friction changes that.
    """
    system, state = jax.tree.map(lambda x: cast(x, dtype), hinge_and_ball(beside))
    speeds = jnp.stack([thrown(system, *x) for x in STARTS]).astype(dtype)
    method = jc.Method(stabilizer=stabilizer)

    def run(v):
        start = dataclasses.replace(state, v=v)

        def seen(state, _):
            energy = jc.energy(system, state)
            return energy.total, energy.kinetic

        final, (total, kinetic) = jc.rollout(
            system, method, start, None, 0.02, 6000, record=seen, every=10
        )
        change = jnp.max(jnp.abs(total - jc.energy(system, start).total))
        off = jc.violation(system, final).worst
        return final.status, change / jnp.max(kinetic), off

    code, change, off = (np.asarray(x) for x in jax.jit(jax.vmap(run))(speeds))
    assert np.all(code == jc.Status.OK)
    assert np.all(change < 0.1)
    assert np.all(off < 1e-3)


def test_a_light_body_that_carries_a_heavy_one_hardly_gains_energy_at_20_ms():
    """Bodies turn by up to 0.04 rad a step.

    Corrected only from 0.025 rad on, the start would gain 60 % of its kinetic energy in 120 s.
    """
    pendulum = PENDULUMS["space, 0.3 kg carries 2 kg"]
    system, state = pendulum.build()
    spin, second = np.array((1.073, 0.0, 0.0)), np.array((-1.313, 0.882, 0.602))
    end, v = np.cross(spin, (0.0, 0.0, -0.3)), np.zeros(system.n_v)
    v[system.layout.v("upper")] = [*(end / 2), *spin]
    v[system.layout.v("lower")] = [*(end + np.cross(second, (0.0, 0.0, -0.3))), *second]
    start = dataclasses.replace(state, v=jnp.asarray(v))

    def seen(system, state):
        energy = jc.energy(system, state)
        return energy.total, energy.kinetic

    final, (total, kinetic) = rolled(system, jc.Method(), start, 0.02, 6000, record=seen)
    assert final.status == jc.Status.OK
    gain = np.mean(np.asarray(total).reshape(50, -1), axis=1) - jc.energy(system, start).total
    assert np.max(np.abs(gain)) < 0.15 * np.max(kinetic)


def test_energy_of_random_double_pendulums_is_measured():
    """RATTLE keeps what the default gains in the plane."""
    pendulum = PENDULUMS["plane, 1 kg carries 0.5 kg"]
    default, kept = (
        measure(pendulum, METHODS[name], 0.02, 24.0, 16) for name in ("default", "RATTLE")
    )
    assert default.starts == kept.starts > 12
    assert default.failed == kept.failed == 0
    assert kept.gain < 0.01 < default.gain
    assert kept.changed == 0


def end_of(system, state, method, dt, time):
    """Returns q after a given time."""
    steps = round(time / dt)
    run = jax.jit(
        lambda s: jc.rollout(system, method, s, None, dt, steps, record=lambda s, i: None)
    )
    final = run(jc.init(system, method, state.q, state.v))[0]
    assert final.status == jc.Status.OK
    return final.q


def test_a_projected_start_off_the_velocities_is_right_to_first_order():
    """The initial velocities of two boxes violate their joints.

    Each step rotates them by 0.03 rad.
    """
    system, state = hinge_and_ball()
    state = dataclasses.replace(state, v=thrown(system, 1.0, (2.0, -3.0, 6.0)).at[:3].add(1.0))
    assert jc.violation(system, state).worst_rate > 0.5
    exact = end_of(system, state, jc.Method(jc.RK4(), PROJECTED), 1e-4, 0.5)
    for method in (jc.Method(stabilizer=PROJECTED), jc.Method(jc.RK4(), PROJECTED)):
        off = np.abs(end_of(system, state, method, 4e-3, 0.5) - exact)
        assert np.max(off) < 4e-3


def test_a_rolling_ball_of_three_moments_is_projected_as_precisely_as_by_default():
    scene = jc.Scene()
    moving = {"angular_velocity": (3.0, 8.0, 5.0), "velocity": (0.8, -0.3, 0.0)}
    scene.add_body("ball", mass=1.0, inertia=(0.01, 0.014, 0.02), position=(0, 0, 0.1), **moving)
    scene.add(jc.joints.RollingSphere("roll", jc.WORLD, "ball", radius=0.1))
    system, state = scene.build()
    exact = end_of(system, state, jc.Method(jc.RK4(), PROJECTED), 1e-3, 2.0)
    for stabilizer in (FED, PROJECTED):
        off = np.abs(end_of(system, state, jc.Method(stabilizer=stabilizer), 4e-3, 2.0) - exact)
        assert np.max(off) < 6e-3


@pytest.mark.parametrize("radius", [1e-3, 1e-4])
def test_a_thin_rod_that_turns_end_over_end_does_not_spin_about_itself(radius):
    """In float32 two equal moments of inertia must give no torque about the third axis."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0), dtype=np.float32)
    moments = (radius**2 / 2, 1 / 12, 1 / 12)
    scene.add_body("rod", mass=1.0, inertia=moments, angular_velocity=(0.0, 6.0, 8.0))
    system, state = scene.build()
    final, spin = jc.rollout(
        system, jc.Method(), state, None, 1e-3, 2000, record=lambda s, _: s.v[3]
    )
    assert np.all(spin == 0.0)
    np.testing.assert_allclose(final.v[3:], [0.0, 6.0, 8.0], rtol=1e-6)


def test_rods_that_spin_about_themselves_in_a_loop_keep_their_energy():
    """An explicit gyroscopic torque would add a tenth of the energy in 5 s."""
    built = spatial_loop()
    status, off, _, change = watched(built, jc.Method(), 1e-3, 20_000)
    assert status == jc.Status.OK
    assert off < 1e-5
    assert change[-1] < 5e-3 * G


def next_velocity(system, state, v):
    moved = dataclasses.replace(state, v=v)
    return jc.step(system, jc.Method(), moved, None, jnp.asarray(1e-2, v.dtype))[0].v


slope_of_velocity = jax.jit(jax.jacfwd(next_velocity, argnums=2))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_a_change_of_spin_has_a_derivative_at_rest_and_at_any_speed(dtype, size):
    """Covers tiny and huge bodies, too: the product of their moments is beyond float32."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    scene.add_body("body", mass=size, inertia=(size, 2 * size, 2.5 * size))
    system, state = jax.tree.map(lambda x: cast(x, dtype), scene.build())

    after = functools.partial(next_velocity, system, state)
    slope = functools.partial(slope_of_velocity, system, state)
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
    """A symmetric top, tilted by half a radian, in steady precession, and its rate Ω [1/s].

    With the tilt θ, A Ω² cos θ − C s Ω + m g l = 0, where A is the moment about the tip and s the
    total spin about the top's own axis.
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
    """The top rotates by 0.2 rad a step; the rows balance the gyroscopic torque for all gains."""
    (system, state), rate = top(200.0)
    method = jc.Method(jc.SemiImplicitEuler(), stabilizer)
    final, (places, off, _, energy) = rolled(
        system, method, state, 1e-3, 2000, lambda s, x: (x.q[:2], *seen_to_drift(s, x)), 10
    )
    change = np.max(np.abs(energy - jc.energy(system, state).total))
    x, y = places[59]  # after 0.6 s
    assert final.status == jc.Status.OK
    assert np.max(off) < 1e-2
    assert change < 1e-3 * 0.5 * 0.03 * 200.0**2
    np.testing.assert_allclose(np.arctan2(y, x) / 0.6, rate, rtol=3e-2)


def test_a_stabilizer_with_rounds_of_its_own_works_in_space():
    """AugmentedLagrangian keeps no factors, so it works without corrections of linearized rows."""
    system, state = hinge_and_ball()
    method = jc.Method(stabilizer=jc.stabilizers.AugmentedLagrangian())
    start = jc.init(system, method, state.q, thrown(system, 3.0, (0.0, 3.0, 0.0)))
    final, _ = jax.jit(lambda s: jc.rollout(system, method, s, None, 2e-3, 50))(start)
    assert final.status == jc.Status.OK


def test_what_linearized_rows_miss_is_taken_out_smoothly():
    """Steps in which bodies rotate by 0.01 to 0.03 rad have derivatives equal to differences."""
    system, state = hinge_and_ball()
    v = thrown(system, 1.0, (0.3, -0.5, 0.4))

    def after(speed):
        start = dataclasses.replace(state, v=speed * v)
        new = jc.step(system, jc.Method(), start, None, 0.02)[0]
        return jnp.cos(jnp.arange(len(new.q))) @ new.q + jnp.sin(jnp.arange(len(new.v))) @ new.v

    all_ = jax.jit(lambda x: (after(x), jax.jacfwd(after)(x), jax.grad(after)(x)))
    for speed in (0.5, 0.7, 0.9, 1.1, 2.0):
        d = 1e-6
        difference = (all_(speed + d)[0] - all_(speed - d)[0]) / (2 * d)
        _, forward, reverse = all_(speed)
        np.testing.assert_allclose(forward, difference, rtol=1e-7)
        np.testing.assert_allclose(reverse, forward, rtol=1e-12)


def kinetic(system, state):
    return jc.energy(system, state).kinetic


@pytest.mark.parametrize("turn", [0.02, 0.1, 1.0, 1.5, 2.5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_body_on_a_ball_joint_spins_freely(turn, dtype):
    """A box held at its center spins about its middle axis: |L| stays, no energy is gained."""
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0), dtype=dtype)
    scene.add_body("box", mass=1.0, inertia=(0.01, 0.02, 0.025), position=(0.0, 0.0, 0.0))
    scene.add(jc.Spherical("ball", jc.WORLD, "box", point=(0.0, 0.0, 0.0)))
    system, state = scene.build()
    h = 1 / 60
    start = np.array([0.02, 1.0, 0.02]) * turn / h
    state = dataclasses.replace(state, v=state.v.at[3:].set(start.astype(dtype)))
    final, energy = rolled(system, jc.Method(), state, h, 2000, kinetic)
    assert final.status == jc.Status.OK
    ends = np.asarray(final.v[3:], float), start
    momentum = [np.linalg.norm(np.array([0.01, 0.02, 0.025]) * w) for w in ends]
    np.testing.assert_allclose(*momentum, rtol=1e-5 if turn <= 1 else 3e-5)  # rounding of float32
    share = np.asarray(energy, float) / float(energy[0]) - 1
    assert share.max() < 1e-4
    assert share.min() > (-2e-3 if turn < 2 else -0.06)


def spin_of_the_box(system, state):
    return jc.angular_velocity(system, state, "box")


@pytest.mark.parametrize("turn", [8.0, 12.0, 1e3, 3e4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_body_turns_on_however_fast_beside_a_constraint(turn, dtype):
    """The step uses `kick` for large rotations; at 12 rad `kick_little` overflows in four steps."""
    h = 1 / 60

    def spun(*, beside, held):
        scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0), dtype=dtype)
        spin = np.array([0.02, 1.0, 0.02]) * turn / h
        scene.add_body("box", mass=1.0, inertia=(0.01, 0.02, 0.025), angular_velocity=spin)
        if held:
            scene.add(jc.Spherical("ball", jc.WORLD, "box", point=(0.0, 0.0, 0.0)))
        if beside:
            scene.add_particle("lamp", mass=1.0, position=(5.0, 0.0, -1.0))
            scene.add(jc.Distance("cord", jc.WORLD, "lamp", point_a=(5.0, 0.0, 0.0)))
        system, state = scene.build()
        final, spins = rolled(system, jc.Method(), state, h, 500, spin_of_the_box)
        assert final.status == jc.Status.OK
        return spins[2] / (turn / h)

    alone = spun(beside=False, held=False)
    rounding = 1e4 * float(jnp.finfo(dtype).eps)  # the motion is chaotic: three steps
    for beside, held in ((True, False), (False, True)):
        found = spun(beside=beside, held=held)
        if turn < 100:
            np.testing.assert_allclose(found, alone, atol=rounding)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_fast_wheel_adds_no_noise_to_the_forces_of_a_distant_weight(dim):
    """In float32 at 0.1 ms the force at a hook, 50 m away, equals that without the wheel."""

    def forces(*, wheel):
        scene = jc.Scene(dim=dim, gravity=(*(0.0,) * (dim - 1), -G), dtype=np.float32)

        def at(x, z):
            return (x, z) if dim == 2 else (x, 0.0, z)

        def body(name, inertia, place, spin, **more):
            inertia = inertia if dim == 2 else (inertia, 2 * inertia, inertia)
            spin = spin if dim == 2 else (0.0, spin, 0.0)
            scene.add_body(name, inertia=inertia, position=place, angular_velocity=spin, **more)

        axis = {} if dim == 2 else {"axis": (0.0, 1.0, 0.0)}
        body("weight", 0.1, at(50.123, -1.0371), 0.01, mass=1.0, velocity=at(0.010371, 0.0))
        scene.add(jc.Revolute("hook", jc.WORLD, "weight", point=at(50.123, 0.0), **axis))
        if wheel:
            body("wheel", 1e-3, at(0.0, 0.0), 1000.0, mass=1.0)
            scene.add(jc.Revolute("axle", jc.WORLD, "wheel", point=at(0.0, 0.0), **axis))
        system, state = scene.build()
        method = jc.Method()
        start = jc.init(system, method, state.q, state.v)
        hook = linearize(system, state.q, state.v, state.time).layout.rows("hook")
        return jax.jit(
            lambda s: jc.rollout(
                system, method, s, None, 1e-4, 1000, record=lambda s, i: i.multipliers[hook]
            )[1]
        )(start)

    alone, beside = forces(wheel=False), forces(wheel=True)
    assert jnp.max(jnp.abs(beside - alone)) < 1.0  # 50 N with the error that this test found


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("stabilizer", "most"), [(FED, 3500.0), (PROJECTED, 3000.0)])
def test_a_top_may_spin_by_three_radians_a_step(stabilizer, most, dtype):
    """The axis is tilted by 45°; at a third of a radian a step the precession rate is right.

    At a radian a step the precession is a fifth too slow, and less so beyond.
    """
    h, height, moments = 1e-3, 0.1, (1e-3, 1e-3, 2e-3)
    method = jc.Method(stabilizer=stabilizer)

    def run(rate):
        scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.81), dtype=dtype)
        q = np.array([np.cos(np.pi / 8), 0.0, np.sin(np.pi / 8), 0.0])
        place = height * np.array([np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
        moving = {"quaternion": q, "angular_velocity": jnp.stack([0 * rate, 0 * rate, rate])}
        scene.add_body("top", mass=1.0, inertia=moments, position=place, **moving)
        scene.add(jc.Spherical("point", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
        system, state = scene.build()

        def seen(state, _):
            energy = jc.energy(system, state)
            return energy.kinetic + energy.potential, jc.violation(system, state)["point"]

        final, (energies, gaps) = jc.rollout(system, method, state, None, h, 2000, record=seen)
        drift = jnp.max(jnp.abs(energies - energies[0])) / energies[0]
        return final.status, final.q[:3], jnp.max(gaps), drift

    rates = np.array([300.0, 1000.0, 2000.0, 3000.0, most], dtype)
    codes, places, gaps, drifts = map(np.asarray, jax.jit(jax.vmap(run))(rates))
    assert (codes == jc.Status.OK).all()
    assert gaps.max() < (1e-6 if dtype == np.float64 else 3e-5)
    assert drifts.max() < 1e-3
    turned = 9.81 * height / (moments[2] * rates) * 2000 * h  # m g l / I₃ω, the rate of a fast top
    angles = np.arctan2(places[:, 1], places[:, 0]) % (2 * np.pi)
    np.testing.assert_allclose(angles[0], turned[0], rtol=0.03)
    assert 0.75 < angles[1] / turned[1] < 1


def test_a_floor_that_is_not_touched_does_not_move_a_projected_top():
    """Bodies that a contact may reach take a separate code path, with the same result."""

    def run(rate, floor):
        scene = jc.Scene(dim=3, gravity=(0.0, 0.0, -9.81))
        q = np.array([np.cos(np.pi / 8), 0.0, np.sin(np.pi / 8), 0.0])
        place = 0.1 * np.array([np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
        moving = {"quaternion": q, "angular_velocity": jnp.stack([0 * rate, 0 * rate, rate])}
        scene.add_body("top", mass=1.0, inertia=(1e-3, 1e-3, 2e-3), position=place, **moving)
        scene.add(jc.Spherical("point", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
        if floor:
            scene.add(jc.PlaneContact("floor", jc.WORLD, "top", point=(0.0, 0.0, -5.0)))
        system, state = scene.build()
        method = jc.Method(stabilizer=PROJECTED)
        state = jc.init(system, method, state.q, state.v)
        return jc.rollout(system, method, state, None, 1e-3, 200, record=lambda s, i: None)[0].q

    rates = np.array([300.0, 3000.0])
    alone, above = (jax.jit(jax.vmap(lambda r, f=f: run(r, f)))(rates) for f in (False, True))
    np.testing.assert_allclose(above, alone, atol=1e-10)


@pytree
class Held(Stabilizer):
    """A user-defined stabilizer that requires J a = −γ and has no other method."""

    def constraint_equations(self, rows, memory, dt):
        """Returns the rows with the target b = −γ."""
        return rows.with_target(-rows.bias)


def test_a_stabilizer_of_a_user_need_not_say_that_it_does_not_complete_steps():
    scene = jc.Scene(dim=3)
    scene.add_body("top", mass=1.0, inertia=(0.01, 0.01, 0.02), position=(0.1, 0.0, 0.0))
    scene.add(jc.Spherical("point", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    system, state = scene.build()
    user, known = (
        jc.step(system, m, jc.init(system, m, state.q, state.v), None, 1e-3)[0]
        for m in (jc.Method(stabilizer=Held()), jc.Method(stabilizer=jc.stabilizers.Unstabilized()))
    )
    assert user.status == jc.Status.OK
    np.testing.assert_array_equal(user.q, known.q)


def spinning_box(beside, turn=0.3, dt=1 / 60):
    """A box on a ball joint off its center.

    `beside` is the speed of a lamp in the scene, if any.
    """
    scene = jc.Scene(dim=3, gravity=(0.0, 0.0, 0.0))
    place, spin = np.array([0.1, 0.0, 0.1]), np.array([0.2, 1.0, 0.2]) * turn / dt
    moments, moving = (
        (0.01, 0.02, 0.025),
        {"angular_velocity": spin, "velocity": np.cross(spin, place)},
    )
    scene.add_body("box", mass=1.0, inertia=moments, position=place, **moving)
    scene.add(jc.Spherical("ball", jc.WORLD, "box", point=(0.0, 0.0, 0.0)))
    if beside is not None:
        swing = (beside, 0.0, 0.0)
        scene.add_particle("lamp", mass=1e-3, position=(5.0, 0.0, -1.0), velocity=swing)
        scene.add(jc.Distance("cord", jc.WORLD, "lamp", point_a=(5.0, 0.0, 0.0)))
    return scene.build()


@pytest.mark.parametrize("speed", [0.0, 1e-3, 0.03])
def test_a_body_turns_as_it_does_alone_beside_a_particle_that_hardly_moves(speed):
    def spun(built):
        system, state = built
        final, _ = rolled(system, jc.Method(), state, 1 / 60, 500)
        assert final.status == jc.Status.OK
        return jc.velocity(system, final, "box"), jc.angular_velocity(system, final, "box")

    for found, alone in zip(spun(spinning_box(speed)), spun(spinning_box(None)), strict=True):
        np.testing.assert_allclose(found, alone, rtol=1e-6, atol=1e-6)


def hanging_lamp(scene):
    scene.add_particle("lamp", mass=1.0, position=(5.0, -1.0), velocity=(0.03, 0.0))
    scene.add(jc.Distance("cord", jc.WORLD, "lamp", point_a=(5.0, 0.0)))


def fast_wheel(scene):
    wheel = {"mass": 1.0, "inertia": 1e-4, "position": (5.0, 0.0), "angular_velocity": 300.0}
    scene.add_body("wheel", **wheel)
    scene.add(jc.Revolute("axle", jc.WORLD, "wheel", point=(5.0, 0.0)))


def leaning_door(scene, **stop):
    scene.add_body("door", mass=1.0, inertia=1 / 12, position=(5.5, 0.0))
    scene.add(jc.Revolute("post", jc.WORLD, "door", point=(5.0, 0.0)))
    scene.add(jc.Limit("stop", "post", 0.0, 1.0, **stop))


def box_on_a_floor(scene):
    scene.add_body("box", mass=1.0, inertia=0.1, position=(5.0, 0.0))
    corners = (4.8, 0.0), (5.2, 0.0)
    scene.add(jc.PlaneContact("floor", jc.WORLD, "box", center=corners, friction=0.5))


BESIDE = {
    "lamp": hanging_lamp,
    "wheel": fast_wheel,
    "stop": leaning_door,
    "soft stop": lambda scene: leaning_door(scene, stiffness=300.0, damping=1.0),
    "floor": box_on_a_floor,
    "friction": lambda scene: scene.add(jc.contacts.JointFriction("rub", "hinge0", 1e-9)),
}


@pytest.mark.parametrize("name", [None, *BESIDE])
def test_two_rods_in_the_plane_gain_no_energy_whatever_is_beside_them(name):
    """The mean energy drifts by less than 0.2 J a minute.

    Without the Newton step it drifts by 8 J.
    """
    scene = jc.Scene(dim=2)
    for i in range(2):
        scene.add_body(f"link{i}", mass=1.0, inertia=1 / 12, position=(i + 0.5, 0.0))
        before = "link0" if i else jc.WORLD
        scene.add(jc.Revolute(f"hinge{i}", before, f"link{i}", point=(float(i), 0.0)))
    if name is not None:
        BESIDE[name](scene)
    system, state = scene.build()
    method = jc.Method()
    start = jc.init(system, method, state.q, state.v)

    def energy(state, info):
        return jc.energy(system, state).total

    final, found = jax.jit(
        lambda s: jc.rollout(system, method, s, None, 0.01, 6000, record=energy)
    )(start)
    assert final.status == jc.Status.OK
    assert abs(found[-600:].mean() - found[:600].mean()) < 0.2


@pytest.mark.parametrize("body", [False, True], ids=["particles", "bodies"])
@pytest.mark.parametrize("dim", [2, 3])
def test_rods_gain_no_energy_whatever_they_join(dim, body):
    """Two rods of 1 m, released level: 2 % of the largest kinetic energy in a minute.

    It was 56 % while the rotation of rods between bodies that hardly rotate was ignored.
    """
    aside = (0.0,) * (dim - 1)
    scene = jc.Scene(dim=dim, gravity=(*aside, -9.81))
    for i in range(2):
        place = (i + 1.0, *aside)
        if body:
            inertia = 0.05 if dim == 2 else (0.05,) * 3
            scene.add_body(f"bob{i}", mass=1.0, inertia=inertia, position=place)
        else:
            scene.add_particle(f"bob{i}", mass=1.0, position=place)
    scene.add(jc.Distance("rod0", jc.WORLD, "bob0", point_a=(0.0, *aside)))
    scene.add(jc.Distance("rod1", "bob0", "bob1"))
    system, state = scene.build()
    method = jc.Method()

    def energy(state, info):
        found = jc.energy(system, state)
        return found.total, found.kinetic

    final, (total, kinetic) = jax.jit(
        lambda s: jc.rollout(system, method, s, None, 0.02, 3000, record=energy)
    )(jc.init(system, method, state.q, state.v))
    assert final.status == jc.Status.OK
    assert abs(total[-300:].mean() - total[:300].mean()) < 0.02 * kinetic.max()


def test_a_dumbbell_is_as_rigid_in_fast_flight():
    """The error of the length is the same at 500 m/s: only the relative motion rotates the rod."""

    def length(along):
        scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
        scene.add_particle("a", mass=1.0, position=(0.0, 0.0), velocity=(along, -2.0))
        scene.add_particle("b", mass=3.0, position=(1.0, 0.0), velocity=(along, 6.0))
        scene.add(jc.Distance("rod", "a", "b"))
        system, state = scene.build()
        final, _ = rolled(system, jc.Method(), state, 0.02, 1000)
        return jc.violation(system, final).worst

    assert length(500.0) < 2e-6
    assert length(0.0) < 2e-6


def worst_violation(system, state):
    return jc.violation(system, state).worst


@pytest.mark.parametrize(("turn", "off"), [(0.5, 1e-3), (1.0, 0.07), (1.4, 0.4)])
def test_a_rod_that_turns_too_fast_leaves_its_length_and_recovery_says_so(turn, off):
    """As documented, the status alone is OK; the limit of a Recovery makes it VIOLATED."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0), velocity=(0.0, turn / 0.01))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()

    def run(method):
        return rolled(system, method, state, 0.01, 300, worst_violation)

    final, found = run(jc.Method())
    assert final.status == jc.Status.OK
    np.testing.assert_allclose(found.max(), off, rtol=0.05)
    final, _ = run(jc.Method(recovery=jc.stabilizers.Recovery(limit=off / 2)))
    assert final.status == jc.Status.VIOLATED


def test_a_stop_in_the_plane_holds_on_what_turns_fast():
    """A rotation of 0.1 rad a step presses a link against its stop, and the link stays there.

    The Newton step, which ignores the stop, would leave an error of 2.6e-4 rad.
    """
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("base", mass=1.0, inertia=1.0, position=(0.0, 0.0), angular_velocity=10.0)
    x, y = 0.5 + 0.3 * np.cos(0.5), 0.3 * np.sin(0.5)
    moving = {"velocity": (-10 * y, 10 * x), "angular_velocity": 10.0}
    scene.add_body("link", mass=0.2, inertia=0.01, position=(x, y), **moving)
    scene.add(jc.Revolute("axle", jc.WORLD, "base", point=(0.0, 0.0)))
    scene.add(jc.Revolute("hinge", "base", "link", point=(0.5, 0.0)))
    scene.add(jc.Limit("stop", "hinge", 0.0, 1.0))
    system, state = scene.build()
    method = jc.Method()
    start = jc.init(system, method, state.q, state.v)

    def angle(state, info):
        return state.q[5] - state.q[4]

    final, angles = jax.jit(lambda s: jc.rollout(system, method, s, None, 0.01, 300, record=angle))(
        start
    )
    assert final.status == jc.Status.OK
    assert jnp.max(jnp.abs(angles[100:])) < 1e-9
