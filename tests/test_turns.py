"""Joints that turn far within a step, and the count of their whole turns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.system.turning import continued, cos_sin, reduced

RIGHT = np.pi / 2
METHODS = {
    "euler": jc.Method(),
    "rk4": jc.Method(integrator=jc.RK4()),
    "events": jc.Method(events=jc.integrators.Events()),
    "seidel": jc.Method(contact_solver=jc.solvers.GaussSeidel()),
}
both = pytest.mark.parametrize("dim", [2, 3])
dtypes = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])


def rod(dim, dtype, lower=0.0, upper=RIGHT, **stop):
    """A rod of 0.12 m and 0.08 kg on a hinge with damping, a strong servo and, if given, stops."""
    length, mass = 0.12, 0.08
    scene = jc.Scene(dim=dim, gravity=(0, -9.81) if dim == 2 else (0, 0, -9.81), dtype=dtype)
    inertia = mass * length**2 / 12
    moments = inertia if dim == 2 else (1e-6, inertia, inertia)
    position = (length / 2, 0.0, 0.0)[:dim]
    scene.add_body("rod", mass=mass, inertia=moments, position=position)
    axis = None if dim == 2 else (0, 1, 0)
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0,) * dim, axis=axis))
    if upper is not None:
        scene.add(jc.Limit("range", "hinge", lower, upper, **stop))
    scene.add(jc.forces.JointDamper("damper", "hinge", 0.02))
    scene.add(jc.forces.PositionServo("servo", "hinge", 100.0))
    return scene.build()


def moved(system, method, state, target, steps=1000, dt=2e-3):
    """Returns the angles and the multipliers of the stop of each step, and the final state."""
    start = jc.init(system, method, state.q, state.v)
    controls = jnp.full((steps, 1), target, state.q.dtype)

    def seen(state, info):
        return jc.coordinate(system, state, "hinge"), info.reactions["range"][0]

    end, (angles, pushes) = jc.rollout(system, method, start, controls, dt, steps, record=seen)
    return np.asarray(angles), np.asarray(pushes), end


@both
@dtypes
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("target", "stop"), [(12.2, RIGHT), (-12.2, 0.0)])
def test_a_servo_rests_at_the_stop_that_one_step_would_pass(name, dim, dtype, target, stop):
    """Without the stop the first step would make two turns.

    The stop balances the servo and the weight.
    """
    if name in ("events", "seidel") and dtype == jnp.float64:
        pytest.skip("as in float32")
    system, state = rod(dim, dtype)
    angles, pushes, end = moved(system, METHODS[name], state, target)
    assert int(end.status) == jc.Status.OK
    np.testing.assert_allclose(angles[-1], stop, atol=1e-3)
    assert angles.max() < RIGHT + 0.2
    assert angles.min() > -0.2
    weight = 0.08 * 9.81 * 0.06 * np.cos(stop)
    np.testing.assert_allclose(pushes[-1], 100.0 * abs(target - stop) + weight, rtol=2e-2)


@pytest.mark.parametrize("kind", ["hard", "bouncing", "soft"])
def test_one_step_ends_at_the_far_stop(kind):
    """From anywhere in the range a step ends within 2 mrad of the stop.

    The remainder is the rotation of the arm within the step.
    """
    choice = {"bouncing": {"restitution": 0.5}, "soft": {"stiffness": 1e9, "damping": 1e5}}
    for start in (0.0, 0.5, 1.5):
        system, state = rod(2, jnp.float64, -start, RIGHT - start, **choice.get(kind, {}))
        angles, _, end = moved(system, jc.Method(), state, 12.2, 1)
        assert int(end.status) == jc.Status.OK
        if kind != "bouncing":
            np.testing.assert_allclose(angles[0], RIGHT - start, atol=2e-3)
        assert angles[0] < RIGHT - start + 2e-3


def test_the_gradient_of_a_step_to_the_far_stop():
    """In both modes the final angle depends on the stop alone, not on the torque."""
    system, state = rod(2, jnp.float64)

    def end(upper, torque):
        changed = system.with_params({"range": {"upper": upper}})
        start = jc.init(changed, jc.Method(), state.q, state.v)
        after, _ = jc.step(changed, jc.Method(), start, torque[None], 2e-3)
        return after.q[2]

    at = jnp.asarray(RIGHT), jnp.asarray(12.2)
    for slope in (jax.grad(end, (0, 1))(*at), jax.jacfwd(end, (0, 1))(*at)):
        np.testing.assert_allclose(slope, (1.0, 0.0), atol=1e-3)
    alone = [end(at[0] + x, at[1]) for x in (1e-4, -1e-4)]
    np.testing.assert_allclose(jax.grad(end)(*at), (alone[0] - alone[1]) / 2e-4, rtol=1e-6)


def test_worlds_of_a_batch_meet_stops_of_their_own():
    system, state = rod(2, jnp.float64)
    targets = jnp.asarray([12.2, -12.2, 0.5, 1e3])
    last = jax.vmap(lambda x: jnp.asarray(_last(system, state, x)))(targets)
    alone = [_last(system, state, x) for x in targets]
    np.testing.assert_allclose(last, alone, atol=1e-9)
    np.testing.assert_allclose(last[:2], (RIGHT, 0.0), atol=1e-3)


def _last(system, state, target):
    start = jc.init(system, jc.Method(), state.q, state.v)
    controls = jnp.full((50, 1), target, state.q.dtype)
    end, _ = jc.rollout(system, jc.Method(), start, controls, 2e-3, 50)
    return end.q[2]


def test_turning_further_than_can_be_told_is_a_status():
    """Without stops the rod turns twice in the first step, which a joint in space cannot see."""
    system, state = rod(3, jnp.float64, upper=None)
    start = jc.init(system, jc.Method(), state.q, state.v)
    end, info = jc.step(system, jc.Method(), start, jnp.asarray([12.2]), 2e-3)
    assert int(end.status) == int(info.status) == jc.Status.LOST_TURNS
    np.testing.assert_array_equal(end.q, start.q)
    with pytest.raises(jc.SimulationError, match="LOST_TURNS.*whole turns"):
        jc.raise_for_status(end)
    gentle, _ = jc.step(system, jc.Method(), start, jnp.asarray([1.0]), 2e-3)
    assert int(gentle.status) == jc.Status.OK


def spinning(speed, dtype):
    scene = jc.Scene(dim=3, gravity=(0, 0, 0), dtype=dtype)
    spin = (0, 0, speed)
    scene.add_body("wheel", mass=1.0, inertia=(0.4, 0.5, 0.7), angular_velocity=spin)
    scene.add(jc.Revolute("hub", jc.WORLD, "wheel", point=(0, 0, 0), axis=(0, 0, 1)))
    scene.add(jc.joints.TurnCounter("count", "hub"))
    return scene.build()


@dtypes
@pytest.mark.parametrize("turn", [0.4, 2.0, 3.6, -10.0, 50.0])
def test_turns_are_counted_at_any_speed(turn, dtype):
    """The velocity tells how many half turns a joint makes within a step."""
    system, state = spinning(turn / 2e-3, dtype)
    start = jc.init(system, jc.Method(), state.q, state.v)
    end, _ = jc.rollout(system, jc.Method(), start, None, 2e-3, 50)
    assert int(end.status) == jc.Status.OK
    np.testing.assert_allclose(jc.coordinate(system, end, "hub"), 50 * turn, rtol=1e-4)


@pytest.mark.parametrize(
    "method",
    [
        jc.Method(integrator=jc.RK4()),
        jc.Method(integrator=jc.integrators.RATTLE(), stabilizer=jc.stabilizers.Unstabilized()),
        jc.Method(
            integrator=jc.integrators.GeneralizedAlpha(), stabilizer=jc.stabilizers.Unstabilized()
        ),
    ],
    ids=["rk4", "rattle", "alpha"],
)
def test_stages_tell_less_than_half_a_turn(method):
    """Methods with stages read angles within a step, which limits them to half a turn a step."""
    for turn, status in ((1.0, jc.Status.OK), (3.6, jc.Status.LOST_TURNS)):
        system, state = spinning(turn / 2e-3, jnp.float64)
        start = jc.init(system, method, state.q, state.v)
        end, _ = jc.rollout(system, method, start, None, 2e-3, 5)
        assert int(end.status) == status


def rolled(system, method, state, steps, seen):
    """Rolls out with steps of 1 ms, checks the status, and returns final state and record."""
    end, path = jc.rollout(system, method, state, None, 1e-3, steps, record=seen)
    assert int(end.status) == jc.Status.OK
    return end, path


FLAT = {
    "euler": jc.Method(),
    "projection": jc.Method(stabilizer=jc.Projection()),
    "rk4": jc.Method(integrator=jc.RK4()),
    "rattle": jc.Method(
        integrator=jc.integrators.RATTLE(), stabilizer=jc.stabilizers.Unstabilized()
    ),
}
TURNED = float(np.float32(200 * np.pi))


def four_bar(dtype, *elements):
    """A crank, a coupler and a rocker in the plane."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81), dtype=dtype)
    points = np.array([(0, 0), (0.3, 0.4), (1.2, 0.7), (1, 0)])
    for i, (a, b) in enumerate(zip(points[:-1], points[1:], strict=True)):
        x, y = b - a
        scene.add_body(
            f"bar{i}",
            mass=1.0,
            inertia=float(x * x + y * y) / 12,
            position=tuple((a + b) / 2),
            angle=float(np.arctan2(y, x)),
        )
    for i, (a, b) in enumerate([(jc.WORLD, 0), (0, 1), (1, 2), (2, jc.WORLD)]):
        a, b = (x if x == jc.WORLD else f"bar{x}" for x in (a, b))
        scene.add(jc.Revolute(f"pin{i}", a, b, point=points[i]))
    for element in elements:
        scene.add(element)
    return scene.build()


@pytest.mark.parametrize("name", FLAT)
def test_a_linkage_turned_a_hundred_times_holds_as_one_that_is_not(name):
    """Checks φ in float32, where the continuous angles are multiples of 6e-5."""
    system, state = four_bar(jnp.float32)
    start = jc.init(system, FLAT[name], state.q.at[6:].add(TURNED), state.v)
    end, worst = rolled(system, FLAT[name], start, 1000, lambda s, info: info.violation.worst)
    assert float(worst[500:].max()) < 3e-6
    assert float(jc.violation(system, end).worst) < 3e-6
    assert float(np.abs(end.q[6:] - TURNED).max()) < 5  # users see continuous angles


def test_readers_see_angles_that_go_on():
    """Joint coordinates, servos and q are continuous.

    The result matches the linkage without turns.
    """
    servo = jc.forces.PositionServo("servo", "pin0", 0.3)
    system, state = four_bar(jnp.float32, servo)
    ends = []
    for shift in (0.0, TURNED):
        start = jc.init(system, jc.Method(), state.q.at[6:].add(shift), state.v)
        control = jnp.full((300, 1), shift, jnp.float32)
        end, angles = jc.rollout(
            system,
            jc.Method(),
            start,
            control,
            1e-3,
            300,
            record=lambda s, info: jc.coordinate(system, s, "pin0"),
        )
        ends.append((end, np.asarray(angles) - shift))
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=2e-3)
    np.testing.assert_allclose(ends[1][0].q[6:] - TURNED, ends[0][0].q[6:], atol=2e-3)


def test_the_derivative_of_the_reduction_is_one():
    """Derivatives by the initial angle, in both modes and in a batch, equal those without turns."""
    system, state = four_bar(jnp.float32)

    def end(angle, shift):
        q = state.q.at[6].set(angle).at[6:].add(shift)
        start = jc.init(system, jc.Method(), q, state.v)
        return jc.step(system, jc.Method(), start, None, 1e-3)[0].q[6]

    slopes = [
        jax.vmap(way(end), in_axes=(None, 0))(state.q[6], jnp.asarray([0.0, TURNED], jnp.float32))
        for way in (jax.grad, jax.jacfwd)
    ]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-4)
    np.testing.assert_allclose(slopes[0][0], slopes[0][1], rtol=1e-2)


def test_states_without_a_remainder_of_angles_step():
    """States without remainders, made by hand or saved earlier, keep their structure."""
    system, state = four_bar(jnp.float32)
    bare = jc.State(state.q.at[6:].add(TURNED), state.v, state.time, state.status)
    end, _ = jc.step(system, jc.Method(), bare, None, 1e-3)
    assert int(end.status) == jc.Status.OK
    assert end.angle_remainder == ()
    assert jax.tree.structure(end) == jax.tree.structure(bare)


def test_a_replaced_angle_forgets_its_remainder():
    angle, remainder = jnp.asarray([0.5, TURNED], jnp.float32), jnp.full(2, 2e-5, jnp.float32)
    before, turns = reduced(angle, remainder)
    assert float(before[0]) == 0.5
    np.testing.assert_array_equal(turns, [0.0, 100.0])
    angle, remainder = continued(angle, before)
    np.testing.assert_array_equal(angle, np.float32([0.5, TURNED]))
    np.testing.assert_array_equal(remainder, np.float32([0.0, 2e-5]))


@pytest.mark.parametrize("turns", [0, 1, -3, 100, -5000, 60000])
def test_reduction_and_return_are_exact_to_rounding(turns):
    """Compares the reduced angle, and the angle after a step plus its remainder, with float64."""
    exact = 2 * np.pi * turns + np.float64(np.float32([0.1, -3.1, 3.0, 1e-7]))
    angle = np.float32(exact)
    remainder = np.float32(exact - angle)
    before, counted = reduced(jnp.asarray(angle), jnp.asarray(remainder))
    np.testing.assert_array_equal(counted, turns)
    np.testing.assert_allclose(before, exact - 2 * np.pi * turns, atol=4e-7)
    step = np.float32([1e-3, -0.2, 0.5, -1e-6])
    after = before + step
    change = np.float64(after) - np.float64(before)
    end = np.sum(np.float64(continued(jnp.asarray(angle), after)), axis=0)
    np.testing.assert_allclose(
        end, np.float64(angle) + np.float64(remainder) + change, rtol=1e-13, atol=1e-7
    )


def pendulum(*elements, links=2):
    """A pendulum of several links in the plane, in float32."""
    scene = jc.Scene(dim=2, gravity=(0.0, -9.81), dtype=jnp.float32)
    for i in range(links):
        scene.add_body(f"link{i}", mass=1.0, inertia=0.1, position=(i + 0.5, 0.0))
        before = f"link{i - 1}" if i else jc.WORLD
        scene.add(jc.Revolute(f"pin{i}", before, f"link{i}", point=(float(i), 0.0)))
    for element in elements:
        scene.add(element)
    return scene.build()


def turned_by(system, state, turns):
    """Returns the state after whole turns of all bodies.

    Rounding errors go to `angle_remainder`.
    """
    angles = system.layout.angles
    exact = np.float64(state.q[angles]) + 2 * np.pi * turns
    rounded = np.float32(exact)
    return dataclasses.replace(
        state,
        q=state.q.at[angles].set(rounded),
        angle_remainder=jnp.asarray(exact - rounded, jnp.float32),
    )


def test_a_double_pendulum_turned_ten_thousand_times_moves_as_one_that_is_not():
    system, state = pendulum()
    ends = []
    for turns in (0, 10_000):
        start = turned_by(system, jc.init(system, jc.Method(), state.q, state.v), turns)
        end, seen = rolled(
            system,
            jc.Method(),
            start,
            1000,
            lambda s, info: (info.violation.worst, jc.energy(system, s).total),
        )
        angle = np.float64(end.q[system.layout.angles]) + np.float64(end.angle_remainder)
        ends.append((end, angle - 2 * np.pi * turns, np.asarray(seen[0]), np.asarray(seen[1])))
    (_, angle, violation, energy), (_, far, far_violation, far_energy) = ends
    np.testing.assert_allclose(far, angle, atol=1e-4)
    assert far_violation.max() < 2 * violation.max()
    np.testing.assert_allclose(far_energy, energy, atol=2e-4)


def test_rattle_keeps_the_energy_of_a_linkage_that_turns():
    """Energies are compared over 1e5 steps from 0 and from 200 π.

    Solving for momenta instead of their increments would drift by 3e-3.
    """
    system, state = four_bar(jnp.float32)
    method = FLAT["rattle"]
    crank = jnp.asarray([-2.4, 1.8, 12.0], jnp.float32)  # about its pin at the origin
    v = state.v.at[system.layout.v("bar0")].set(crank)
    start = jc.assemble(system, state.q, v, hold=("bar0",)).check()
    drifts = []
    for turns in (0, 100):
        begin = turned_by(system, jc.init(system, method, start.q, start.v), turns)
        end, energy = rolled(
            system, method, begin, 100_000, lambda s, info: jc.energy(system, s).total
        )
        assert float(end.q[6] - begin.q[6]) > 100 * 2 * np.pi
        energy = np.float64(energy)
        drift = energy[-10_000:].mean() - energy[:10_000].mean()
        drifts.append(drift / float(jc.energy(system, begin).kinetic))
    assert np.abs(drifts).max() < 2e-4


def test_a_drive_in_the_plane_is_smooth_after_a_day():
    """At 1e5 s the target is 2e5 rad; float32 resolves it to 0.016 only."""
    drive = jc.joints.Drive("drive", "pin0", lambda t, speed: speed * t, params=jnp.float32(2.0))
    system, state = pendulum(drive, links=1)
    late, target = 1e5, 2e5
    turns = round(target / (2 * np.pi))
    start = jc.init(system, jc.Method(), state.q, state.v.at[2].set(2.0), time=late)
    phase = target - 2 * np.pi * turns
    q = start.q.at[:3].set(np.float32([np.cos(phase) / 2, np.sin(phase) / 2, phase]))
    v = start.v.at[:2].set(np.float32([-np.sin(phase), np.cos(phase)]))
    start = turned_by(system, dataclasses.replace(start, q=q, v=v), turns)
    _, seen = rolled(
        system, jc.Method(), start, 1000, lambda s, info: (info.violation.worst, s.v[2])
    )
    assert float(seen[0].max()) < 4e-6
    np.testing.assert_allclose(seen[1], 2.0, atol=1e-2)


@pytest.mark.parametrize("ratio", [-2.0, 1 / 3])
def test_gears_mesh_after_many_turns(ratio):
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0), dtype=jnp.float32)
    for i in range(2):
        scene.add_body(f"gear{i}", mass=1.0, inertia=0.1, position=(float(i), 0.0))
        scene.add(jc.Revolute(f"pin{i}", jc.WORLD, f"gear{i}", point=(float(i), 0.0)))
    scene.add(jc.joints.Gear("mesh", "pin0", "pin1", ratio=ratio))
    system, state = scene.build()
    exact = np.float64(np.float32(ratio)) * 2 * np.pi * 3000
    angles = np.array([2 * np.pi * 3000, exact])
    rounded = np.float32(angles)
    start = jc.init(system, jc.Method(), state.q.at[4:].set(rounded), state.v)
    left = jnp.asarray(angles - rounded, jnp.float32)
    start = dataclasses.replace(start, angle_remainder=left)
    assert float(jc.violation(system, start).worst) < 2e-6
    v = start.v.at[4:].set(jnp.asarray([1.0, ratio], jnp.float32))
    start = dataclasses.replace(start, v=v)
    end, worst = rolled(system, jc.Method(), start, 500, lambda s, info: info.violation.worst)
    assert float(worst.max()) < 4e-6
    np.testing.assert_allclose(end.v[4:], [1.0, ratio], atol=1e-4)


@pytest.mark.parametrize("most", [1.0, np.pi, 1e3, 1e5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cosines_and_sines_are_right_to_the_last_place(dtype, most):
    """Errors are below one unit of rounding: 6e-8 for a float32 between 0.5 and 1."""
    places = np.linspace(-most, most, 100_001).astype(dtype)
    angle = jnp.asarray(places)
    (cos, sin), rates = jax.jvp(jax.jit(cos_sin), (angle,), (jnp.ones_like(angle),))
    exact = places.astype(float)
    bound = 2 * np.finfo(dtype).eps / 2
    for found, wanted in zip((cos, sin, *rates), _circle(exact), strict=True):
        np.testing.assert_allclose(found, wanted, atol=bound)


def _circle(angle):
    """Returns cos, sin, and their derivatives."""
    return np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)


def test_cosines_of_what_is_not_finite_are_not_numbers():
    """cos and sin of NaN and infinities are NaN, as in NumPy."""
    found = cos_sin(jnp.asarray([np.nan, np.inf, -np.inf], np.float32))
    assert np.isnan(found).all()


def test_users_functions_see_continuous_angles():
    """A custom torque equals the angle after a hundred turns."""

    def torque(motion, t, control, params):
        return jnp.stack([*jnp.zeros_like(motion.position), motion.orientation])

    system, state = pendulum(jc.forces.CustomForce("spring", ("link0",), torque), links=1)
    method = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
    start = turned_by(system, jc.init(system, method, state.q, state.v), 100)
    inertia = 0.1 + 0.25  # moment of inertia about the pin
    expected = (TURNED - 9.81 / 2) / inertia
    a, _, _ = jc.forward_dynamics(system, start, None, method, 1e-3)
    np.testing.assert_allclose(a[2], expected, rtol=1e-5)
    end, _ = jc.step(system, method, start, None, 1e-3)
    np.testing.assert_allclose(end.v[2], 1e-3 * expected, rtol=1e-5)


def test_states_pickled_before_angles_had_a_remainder_load():
    system, state = four_bar(jnp.float32)
    fields = {k: v for k, v in vars(state).items() if k != "angle_remainder"}
    old = jc.State.__new__(jc.State)
    old.__setstate__(fields)
    assert old.angle_remainder == ()
    assert int(jc.step(system, jc.Method(), old, None, 1e-3)[0].status) == jc.Status.OK
