"""Generalized-α compared with closed forms, and with scipy in other coordinates."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tolerances import DIFFERENCE, IDENTITY

import jaxcon as jc

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import heavy_tip  # noqa: E402

G = 9.81
ORDERS = (3.6, 4.5)
"""Bounds of the error ratio of a second-order method when the step is halved."""


def forces(state, info):
    return info.multipliers


def rollout(system, method, state, dt, steps, control=None):
    """Returns the final state and its multipliers."""
    start = jc.init(system, method, state.q, state.v)

    def run(start):
        return jc.rollout(system, method, start, control, dt, steps, record=forces, every=steps)

    final, λ = jax.jit(run)(start)
    return final, λ[-1]


def pendulum(length=1.0, speed=0.0, dtype=None):
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=2.0, position=(length, 0.0), velocity=(0.0, speed))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def swung(seconds):
    """Returns exact position, velocity and rod force of a pendulum of length 1 and mass 2."""
    options = {"rtol": 1e-12, "atol": 1e-12, "method": "DOP853"}
    θ, ω = solve_ivp(lambda _, y: [y[1], -G * np.cos(y[0])], (0, seconds), [0, 0], **options).y[
        :, -1
    ]
    radial, across = np.array([np.cos(θ), np.sin(θ)]), np.array([-np.sin(θ), np.cos(θ)])
    return radial, ω * across, -2 * (ω**2 - G * np.sin(θ))


@pytest.mark.parametrize("projects", [True, False])
def test_a_pendulum_is_of_second_order_in_positions_velocities_and_forces(projects):
    system, state = pendulum()
    method = jc.Method(jc.integrators.GeneralizedAlpha(rho=0.5, projects=projects))
    q, v, force = swung(0.9)
    errors = []
    for steps in (90, 180):
        got, found = rollout(system, method, state, 0.9 / steps, steps)
        left = jc.violation(system, got)
        assert got.status == jc.Status.OK
        assert left.worst < IDENTITY
        assert left.worst_rate < IDENTITY or not projects
        errors.append([np.max(abs(got.q - q)), np.max(abs(got.v - v)), abs(found[0] - force)])
    ratio = np.divide(*errors)
    assert np.all((ratio > ORDERS[0]) & (ratio < ORDERS[1])), ratio


def top():
    """A rigid body on a ball joint; returns also the offset of its center of mass."""
    scene, moments = jc.Scene(dim=3), np.array([0.3, 0.5, 0.4])
    offset, spin = np.array([0.2, -0.3, 0.8]), np.array([0.4, -0.7, 5.0])
    scene.add_body(
        "top",
        mass=1.5,
        inertia=moments,
        position=offset,
        velocity=np.cross(spin, offset),
        angular_velocity=spin,
    )
    scene.add(jc.Spherical("ball", jc.WORLD, "top", point=(0.0, 0.0, 0.0)))
    return *scene.build(), moments, offset, spin


def test_a_top_is_of_second_order():
    """The reference solves Euler's equations about the fixed point, Θ ω̇ + ω × Θ ω = s × Rᵀ m g."""
    system, state, moments, s, spin = top()
    about = np.diag(moments) + 1.5 * (s @ s * np.eye(3) - np.outer(s, s))

    def motion(_, y):
        r, ω = y[:9].reshape(3, 3), y[9:]
        turned = r @ np.cross(ω, np.eye(3)).T  # R [ω]×
        pull = np.cross(s, r.T @ [0, 0, -1.5 * G]) - np.cross(ω, about @ ω)
        return np.concatenate([turned.ravel(), np.linalg.solve(about, pull)])

    y = np.concatenate([np.eye(3).ravel(), spin])
    y = solve_ivp(motion, (0, 0.4), y, rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]
    method, errors = jc.Method(jc.integrators.GeneralizedAlpha()), []
    for steps in (40, 80):
        got, _ = rollout(system, method, state, 0.4 / steps, steps)
        assert got.status == jc.Status.OK
        ω = jc.angular_velocity(system, got, "top")
        center = jc.position(system, got, "top")
        errors.append([np.max(abs(center - y[:9].reshape(3, 3) @ s)), np.max(abs(ω - y[9:]))])
    ratio = np.divide(*errors)
    assert np.all((ratio > ORDERS[0]) & (ratio < ORDERS[1])), ratio


def test_a_spring_that_is_nearly_rigid_is_a_rod():
    """A spring of 10¹⁰ N/m vibrates at 7·10⁴ rad/s (ω h = 700) and stretches by 6 nm."""
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0))
    scene.add(jc.Spring("rod", jc.WORLD, "bob", stiffness=1e10, rest_length=1.0))
    system, state = scene.build()
    method, errors = jc.Method(jc.integrators.GeneralizedAlpha(rho=0.5)), []
    for steps in (90, 180):
        got, _ = rollout(system, method, state, 0.9 / steps, steps)
        assert got.status == jc.Status.OK
        errors.append(np.max(abs(got.q - swung(0.9)[0])))
    assert errors[1] < 5e-4
    assert errors[0] / errors[1] > ORDERS[0]
    explicit, _ = rollout(system, jc.Method(jc.RK4()), state, 1e-2, 90)
    assert explicit.status == jc.Status.NON_FINITE


def test_a_heavy_tip_on_light_links():
    """Three links and a tip of 10⁶ kg at 1 ms; the reference integrates the angles."""
    chain = heavy_tip.Chain(links=3, seconds=0.6)
    reference = chain.reference()
    got = heavy_tip.run(chain, jc.Method(jc.integrators.GeneralizedAlpha()), 1e-3, reference)
    assert got.status == jc.Status.OK
    assert got.violation < 1e-14
    assert got.energy < 2e-6
    assert got.error < 5e-6


def door(hinges):
    scene = jc.Scene(dim=3)
    swing = {"velocity": (0.0, 0.0, -0.4), "angular_velocity": (0.0, 1.0, 0.0)}
    solid = {"mass": 3.0, "inertia": (0.5, 0.7, 0.3)}
    scene.add_body("door", position=(0.4, 0.0, 0.0), **solid, **swing)
    for i, y in enumerate((-0.5, 0.5)[:hinges]):
        scene.add(jc.Revolute(f"hinge_{i}", jc.WORLD, "door", point=(0.0, y, 0.0), axis=(0, 1, 0)))
    return scene.build()


def test_two_hinges_of_a_door_share_its_weight():
    """Ten rows of rank five: the motion is that with one hinge, and λ has the least norm."""
    method = jc.Method(jc.integrators.GeneralizedAlpha())
    (one, start), (both, same) = door(1), door(2)
    expected, _ = rollout(one, method, start, 5e-3, 100)
    got, _ = rollout(both, method, same, 5e-3, 100)
    assert got.status == jc.Status.OK
    np.testing.assert_allclose(got.q, expected.q, atol=1e-9)
    info = jc.step(both, method, got, None, 5e-3)[1]
    loads = [jc.wrench(info, f"hinge_{i}")[0] for i in range(2)]
    np.testing.assert_allclose(loads[0], loads[1], atol=1e-4)
    info = jc.step(one, method, expected, None, 5e-3)[1]
    whole = jc.wrench(info, "hinge_0")[0]
    np.testing.assert_allclose(loads[0] + loads[1], whole, atol=1e-4)


def test_dependent_rows_without_regularization_are_singular():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=2.0, position=(1.0, 0.0), velocity=(0.0, 1.0))
    for name in ("rod", "other"):
        scene.add(jc.Distance(name, jc.WORLD, "bob"))
    system, state = scene.build()
    for tikhonov, status in ((0.0, jc.Status.SINGULAR), (None, jc.Status.OK)):
        method = jc.Method(jc.integrators.GeneralizedAlpha(tikhonov=tikhonov))
        assert rollout(system, method, state, 5e-3, 1)[0].status == status


def bricard(dtype):
    """Six rods of 1 m and 1 kg along edges of a cube: one of thirty rows is redundant."""
    corners = np.array(
        [(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], dtype=float
    )
    edges = np.roll(corners, -1, axis=0) - corners
    scene = jc.Scene(dim=3, gravity=(0.0, -G, 0.0), dtype=dtype)
    names = [*(f"rod{i}" for i in range(5)), jc.WORLD]
    for name, corner, edge in zip(names[:5], corners, edges, strict=False):
        moments = tuple((1 - np.abs(edge)) / 12 + 1e-3 * np.abs(edge))
        scene.add_body(name, mass=1.0, inertia=moments, position=corner + edge / 2)
    for i, corner in enumerate(corners):
        axis = np.cross(edges[i - 1], edges[i])
        scene.add(jc.Revolute(f"hinge{i}", names[i - 1], names[i], point=corner, axis=axis))
    return scene.build()


def parallelogram(dtype):
    """Two bars of 1 m swing a coupler through the position in which all are in line."""
    scene = jc.Scene(dim=2, dtype=dtype)
    angle, spin = 0.02, -2.0
    half = 0.5 * np.array([np.cos(angle), np.sin(angle)])
    turn = spin * np.array([-half[1], half[0]])
    solid = {"mass": 1.0, "inertia": 0.1}
    start = (1.0 + 2 * half[0], 2 * half[1])
    scene.add_body("coupler", **solid, position=start, velocity=2 * turn)
    for i in range(2):
        foot = np.array([float(i), 0.0])
        motion = {"angle": angle, "velocity": turn, "angular_velocity": spin}
        scene.add_body(f"bar{i}", **solid, position=foot + half, **motion)
        scene.add(jc.Revolute(f"foot{i}", jc.WORLD, f"bar{i}", point=foot))
        scene.add(jc.Revolute(f"head{i}", f"bar{i}", "coupler", point=foot + 2 * half))
    return scene.build()


def hinges(dtype):
    """Two links, each on two hinges with one oblique axis; their weight acts along it."""
    scene = jc.Scene(dim=3, dtype=dtype)
    axis, before = np.array([0.0, 0.6, 0.8]), jc.WORLD
    for i in range(2):
        name, place = f"link{i}", np.array([i + 0.5, 0.0, 0.0])
        scene.add_body(name, mass=1.0, inertia=(0.02, 0.1, 0.1), position=place)
        for side in (-0.1, 0.1):
            point = np.array([float(i), 0.0, 0.0]) + side * axis
            scene.add(jc.Revolute(f"{name}{side}", before, name, point=point, axis=axis))
        before = name
    return scene.build()


CLOSED = {jnp.float64: 1e-13, jnp.float32: 2e-6}
"""Bounds of the gap in a loop of one meter: 500 and 20 units of rounding."""


@pytest.mark.parametrize("dtype", list(CLOSED), ids=["float64", "float32"])
@pytest.mark.parametrize("scene", [bricard, parallelogram, hinges])
def test_loops_close_to_rounding(scene, dtype):
    """Redundant rows need regularization to have a λ; it must not open the loops."""
    system, state = scene(dtype)
    method = jc.Method(jc.integrators.GeneralizedAlpha())

    def look(s, info):
        left = jc.violation(system, s)
        return left.worst, jnp.max(jnp.abs(info.multipliers)), info.status

    def run(start):
        return jc.rollout(system, method, start, None, 1e-2, 16, record=look)

    final, (left, force, status) = jax.jit(run)(jc.init(system, method, state.q, state.v))
    np.testing.assert_array_equal(status, jc.Status.OK)
    assert np.max(left) < CLOSED[dtype]
    assert np.all(np.isfinite(force))
    assert np.max(np.abs(final.q - state.q)) > 0.01


def hub():
    """A disc with a motor and a rotor, a driven arm, and a wheel that a force rolls."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("disc", mass=1.0, inertia=0.3)
    scene.add(jc.Revolute("axle", jc.WORLD, "disc", point=(0.0, 0.0)))
    scene.add(jc.joints.Armature("rotor", "axle", inertia=0.2))
    scene.add(jc.Motor("motor", "axle"))
    scene.add_body("wheel", mass=2.0, inertia=2.0 * 0.3**2, position=(5.0, 0.0))
    scene.add(jc.forces.Force("pull", "wheel", force=(5.0, 0.0)))
    scene.add(jc.joints.VelocityLevel(rolling, ("wheel",), name="roll", params={"radius": 0.3}))
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(9.0, 0.0))
    scene.add(jc.Revolute("pivot", jc.WORLD, "arm", point=(8.5, 0.0)))
    scene.add(jc.joints.Drive("drive", "pivot", wave))
    return scene.build()


def rolling(wheel, t, p):
    return (wheel.velocity[0] + p["radius"] * wheel.angular_velocity)[None]


def wave(t, p):
    return 0.5 * (1 - jnp.cos(3 * t))


def test_rotors_rolling_and_drives():
    """θ̈ = τ/(I + I_rotor) and a = F/2m of a hoop are constant, hence exact.

    The drive has φ(q, t) = 0.
    """
    system, state = hub()
    torque = jnp.ones((20, 1))
    got, λ = rollout(system, jc.Method(jc.integrators.GeneralizedAlpha()), state, 0.05, 20, torque)
    assert got.status == jc.Status.OK
    np.testing.assert_allclose(jc.orientation(system, got, "disc"), 1 / 0.5 / 2, rtol=IDENTITY)
    np.testing.assert_allclose(jc.position(system, got, "wheel")[0], 5 + 1.25 / 2, rtol=IDENTITY)
    np.testing.assert_allclose(jc.orientation(system, got, "arm"), wave(1.0, None), rtol=1e-10)
    rotor = λ[jc.violation(system, got).layout.rows("rotor")]
    np.testing.assert_allclose(rotor, -0.2 * 2.0, rtol=1e-10)


def test_the_first_step_starts_from_the_accelerations_there_and_the_next_remembers():
    system, state = pendulum(speed=1.0)
    method = jc.Method(jc.integrators.GeneralizedAlpha())
    start = jc.init(system, method, state.q, state.v)
    assert not start.memory.integrator.started
    a, λ, _ = jc.forward_dynamics(system, start, None, method, 1e-6)
    np.testing.assert_allclose(a, [-1.0, -G], rtol=IDENTITY)
    once, info = jc.step(system, method, start, None, 1e-6)
    np.testing.assert_allclose(info.acceleration, a, atol=1e-3)
    np.testing.assert_allclose(info.multipliers, λ, atol=1e-3)
    np.testing.assert_allclose(once.memory.integrator.multipliers, λ, atol=1e-2)
    assert once.memory.integrator.started
    twice = jc.step(system, method, once, None, 1e-2)[0]
    forgetful = dataclasses.replace(start, q=once.q, v=once.v, time=once.time)
    assert np.max(abs(jc.step(system, method, forgetful, None, 1e-2)[0].v - twice.v)) > 1e-12
    with pytest.raises(ValueError, match="does not have the memory that this method keeps"):
        jc.step(system, method, state, None, 1e-2)


def reach(numbers):
    """Returns the final position of a rod on a spring, hinged twice, by its speed, mass and ρ."""
    speed, mass, rho = numbers
    scene = jc.Scene(dim=2)
    scene.add_body("a", mass=mass, inertia=0.2, position=(0.5, 0.0), angular_velocity=speed)
    for i in range(2):
        scene.add(jc.Revolute(f"hinge_{i}", jc.WORLD, "a", point=(0.0, 0.0)))
    spring = {"stiffness": 3e3, "damping": 2.0, "rest_length": 1.0}
    scene.add(jc.Spring("spring", jc.WORLD, "a", point_a=(0.0, 1.0), **spring))
    system, state = scene.build()
    start = jc.init(system, jc.Method(jc.integrators.GeneralizedAlpha(rho=rho)), state.q, state.v)
    method = jc.Method(jc.integrators.GeneralizedAlpha(rho=rho))
    final = jc.rollout(system, method, start, None, 1e-2, 8)[0]
    return final.q @ jnp.asarray([1.0, 0.3, -0.5]) + 0.1 * final.v[1]


def test_the_derivative_is_that_of_the_solution_also_where_rows_are_dependent():
    x, step = jnp.array([0.8, 1.3, 0.6]), 1e-5
    value = jax.jit(reach)
    got = jax.jit(jax.grad(reach))(x)
    around = [(value(x + e) - value(x - e)) / (2 * step) for e in step * np.eye(3)]
    np.testing.assert_allclose(got, around, rtol=DIFFERENCE)


def test_the_second_derivative_is_that_of_the_solution():
    method = jc.Method(jc.integrators.GeneralizedAlpha())

    def end(speed):
        system, state = pendulum(speed=speed)
        start = jc.init(system, method, state.q, state.v)
        return jc.step(system, method, start, None, 0.2)[0].q[0]

    slope = jax.jit(jax.grad(end))
    bend = jax.jit(lambda x: jax.jvp(jax.grad(end), (x,), (jnp.ones(()),)))(jnp.asarray(1.2))
    np.testing.assert_allclose(bend[0], slope(1.2), rtol=IDENTITY)
    around = (slope(1.2 + 1e-5) - slope(1.2 - 1e-5)) / 2e-5
    np.testing.assert_allclose(bend[1], around, rtol=DIFFERENCE)


def test_a_batch_is_its_worlds_and_one_that_fails_stops_alone():
    system, state = pendulum()

    def run(speed, rho):
        method = jc.Method(jc.integrators.GeneralizedAlpha(rho=rho))
        start = jc.init(system, method, state.q, jnp.stack([0.0 * speed, speed]))
        return jc.rollout(system, method, start, None, 2e-2, 10)[0]

    speeds, rhos = jnp.array([0.0, 1.0, jnp.nan, -2.0]), jnp.array([0.9, 0.5, 0.5, 0.0])
    batch = jax.jit(jax.vmap(run))(speeds, rhos)
    one = jax.jit(run)
    worlds = [one(s, r) for s, r in zip(speeds, rhos, strict=True)]
    for i in (0, 1, 3):
        np.testing.assert_allclose(batch.q[i], worlds[i].q, rtol=IDENTITY)
        np.testing.assert_allclose(batch.v[i], worlds[i].v, rtol=IDENTITY)
    np.testing.assert_array_equal(batch.status, [0, 0, jc.Status.NON_FINITE, 0])
    slopes = jax.jit(jax.grad(lambda s: jnp.sum(jax.vmap(run)(s, rhos).q)))(speeds)
    np.testing.assert_array_equal(np.isfinite(slopes), True)
    assert slopes[2] == 0
    assert slopes[1] != 0


def circle(q, t, p):
    return (q @ q - 1.0)[None]


def double_mass(q, p):
    return 2 * jnp.ones_like(q)


def weight(q, v, t, u, p):
    return jnp.array([0.0, -2 * G])


def test_coordinates_of_the_user_are_bodies():
    system = jc.GeneralizedSystem(
        mass=double_mass, force=weight, constraints=(jc.joints.Holonomic(circle),)
    )
    bodies, state = pendulum()
    method = jc.Method(jc.integrators.GeneralizedAlpha())
    expected, _ = rollout(bodies, method, state, 1e-2, 30)

    def run(speed):
        start = jc.init(system, method, state.q, jnp.stack([0.0 * speed, speed]))
        return jc.rollout(system, method, start, None, 1e-2, 30)[0]

    got = jax.jit(jax.vmap(run))(jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(got.q[0], expected.q, rtol=1e-10)
    np.testing.assert_array_equal(got.status, 0)


def test_single_precision():
    system, state = pendulum(dtype=jnp.float32)
    got, _ = rollout(system, jc.Method(jc.integrators.GeneralizedAlpha()), state, 1e-3, 900)
    q, v, _ = swung(0.9)
    assert got.status == jc.Status.OK
    assert {x.dtype for x in (got.q, got.v, got.memory.integrator.average)} == {np.dtype("float32")}
    assert jc.violation(system, got).worst < 1e-6
    np.testing.assert_allclose(got.q, q, atol=1e-4)
    np.testing.assert_allclose(got.v, v, atol=5e-4)


def test_a_step_too_large_has_not_converged():
    system, state = pendulum(speed=40.0)
    method = jc.Method(jc.integrators.GeneralizedAlpha(iterations=1))
    assert rollout(system, method, state, 0.1, 1)[0].status == jc.Status.NOT_CONVERGED


def test_it_refuses_what_it_cannot_do():
    system, state = pendulum()

    def step(stabilizer=None, system=system, state=state, **options):
        stabilizer = stabilizer or jc.Baumgarte()
        method = jc.Method(jc.integrators.GeneralizedAlpha(**options), stabilizer)
        return jc.step(system, method, jc.init(system, method, state.q, state.v), None, 1e-2)

    for admitted in (jc.Baumgarte(), jc.stabilizers.Unstabilized()):
        assert step(admitted)[0].status == jc.Status.OK
    with pytest.raises(ValueError, match="leaves nothing to Baumgarte.*without gains"):
        step(jc.Baumgarte.critical(rate=10.0))
    with pytest.raises(ValueError, match="rho must lie between 0 and 1, got 1.5"):
        step(rho=1.5)
    with pytest.raises(ValueError, match="iterations must be a whole number from 1, got 0"):
        step(iterations=0)
    with pytest.raises(ValueError, match=r"variational equations are not.*RK4"):
        step(None, *jc.systems.vakonomic(system, state))
