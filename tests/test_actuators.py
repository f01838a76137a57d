"""Springs, dampers, motors, servos and rotors of joints, against hand calculations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

both = pytest.mark.parametrize("dim", [2, 3])
FREE = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
INERTIA = 0.7


def wheel(dim, *elements, dtype=None, **body):
    """A wheel on an axis through its center, with moment of inertia 0.7 about it."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim, dtype=dtype)
    scene.add_body("wheel", mass=1.0, inertia=INERTIA if dim == 2 else (0.4, 0.5, INERTIA), **body)
    axis = None if dim == 2 else (0, 0, 2)
    scene.add(jc.Revolute("hub", jc.WORLD, "wheel", point=(0,) * dim, axis=axis))
    for element in elements:
        scene.add(element)
    return scene.build()


def slide(dim, *elements, **body):
    """A slider of 2 kg along the direction (3, 4)/5."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    scene.add_body("slide", mass=2.0, inertia=1.0 if dim == 2 else (1.0, 1.0, 1.0), **body)
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(3.0, 4.0, 0.0)[:dim]))
    for element in elements:
        scene.add(element)
    return scene.build()


def spinning(dim, rate):
    return rate if dim == 2 else (0.0, 0.0, rate)


def torque(system, state, control=None):
    """Returns the torque about the axis of the wheel, computed from the acceleration."""
    solution = jc.forward_dynamics(system, state, control, FREE, 1e-3)
    return INERTIA * solution.acceleration[-1]


def turned(system, state, angle):
    return dataclasses.replace(
        state, q=system.retract(state.q, jnp.zeros_like(state.v).at[-1].set(angle))
    )


LAWS = {
    "spring": (
        lambda: jc.forces.JointSpring("m", "hub", 3.0, 0.2, 0.5),
        None,
        lambda x, w: -3 * (x - 0.5) - 0.2 * w,
    ),
    "damper": (lambda: jc.forces.JointDamper("m", "hub", 0.3), None, lambda x, w: -0.3 * w),
    "motor": (lambda: jc.Motor("m", "hub", gear=2.0), 1.5, lambda x, w: 3.0),
    "motor out of range": (
        lambda: jc.Motor("m", "hub", control_range=(-1.0, 1.0)),
        1.5,
        lambda x, w: 1.0,
    ),
    "position": (
        lambda: jc.forces.PositionServo("m", "hub", 4.0, 0.1, gear=3.0),
        1.5,
        lambda x, w: 3 * (4 * (1.5 - 3 * x) - 0.1 * 3 * w),
    ),
    "position out of force": (
        lambda: jc.forces.PositionServo("m", "hub", 4.0, force_range=(-0.5, 0.25)),
        1.5,
        lambda x, w: 0.25,
    ),
    "velocity": (
        lambda: jc.forces.VelocityServo("m", "hub", 4.0, gear=3.0),
        1.5,
        lambda x, w: 12 * (1.5 - 3 * w),
    ),
    "affine": (
        lambda: jc.forces.AffineActuator("m", "hub", (2.0, 0.3, 0.1), (0.4, -1.0, -0.2), gear=3.0),
        1.5,
        lambda x, w: 3 * ((2 + 0.3 * 3 * x + 0.1 * 3 * w) * 1.5 + 0.4 - 3 * x - 0.2 * 3 * w),
    ),
}


@both
@pytest.mark.parametrize("law", LAWS)
def test_the_torque_is_that_of_the_law(dim, law):
    make, control, expected = LAWS[law]
    system, state = wheel(dim, make(), angular_velocity=spinning(dim, 0.8))
    u = None if control is None else jnp.asarray([control])
    np.testing.assert_allclose(
        torque(system, turned(system, state, 0.3), u), expected(0.3, 0.8), rtol=1e-9
    )


@both
def test_at_control_zero_a_motor_rests_and_a_servo_holds_zero(dim):
    servo = jc.forces.PositionServo("servo", "hub", 4.0)
    system, state = wheel(dim, jc.Motor("motor", "hub"), servo)
    found = torque(system, turned(system, state, 0.3), jnp.zeros(2))
    np.testing.assert_allclose(found, -1.2, rtol=1e-9)


def test_a_motor_without_control_is_named():
    system, state = wheel(2, jc.Motor("motor", "hub"), jc.forces.PositionServo("servo", "hub", 4.0))
    for act in (
        lambda: jc.step(system, jc.Method(), state, None, 1e-3),
        lambda: jc.rollout(system, jc.Method(), state, None, 1e-3, 2),
        lambda: jc.forward_dynamics(system, state, None, jc.Method(), 1e-3),
    ):
        with pytest.raises(ValueError, match=r"None, but motor, servo \(motors\) wait"):
            act()


def test_channels_lie_in_the_order_of_the_elements():
    system, state = wheel(
        2, jc.Motor("a", "hub"), jc.forces.JointSpring("s", "hub", 0.0), jc.Motor("b", "hub", 10.0)
    )
    assert (system.layout.control("a"), system.layout.control("b")) == (slice(0, 1), slice(1, 2))
    np.testing.assert_allclose(torque(system, state, jnp.asarray([1.0, 2.0])), 21.0, rtol=1e-9)


@both
def test_a_motor_of_a_slider_pushes_along_it(dim):
    system, state = slide(dim, jc.Motor("m", "rail"))
    solution = jc.forward_dynamics(system, state, jnp.asarray([10.0]), FREE, 1e-3)
    np.testing.assert_allclose(solution.acceleration[:2], [3.0, 4.0], rtol=1e-9)


@both
def test_a_rotor_adds_to_the_inertia_and_nothing_else(dim):
    """Equation (I + I_r) θ̈ = τ, multiplier λ = −I_r θ̈, kinetic energy ½ (I + I_r) θ̇²."""
    rotor, motor = jc.joints.Armature("rotor", "hub", 0.3), jc.Motor("m", "hub")
    system, state = wheel(dim, rotor, motor, angular_velocity=spinning(dim, 2.0))
    solution = jc.forward_dynamics(system, state, jnp.asarray([5.0]), FREE, 1e-3)
    np.testing.assert_allclose(solution.acceleration[-1], 5.0, rtol=1e-12)
    np.testing.assert_allclose(jc.wrench(solution, "rotor")[-1], -1.5, rtol=1e-12)
    np.testing.assert_allclose(jc.energy(system, state).kinetic, 2.0, rtol=1e-12)
    np.testing.assert_array_equal(jc.violation(system, state)["rotor"], 0.0)
    assert jc.report(system, state).degrees_of_freedom == 1
    assert jc.report(system, state).redundant == ()


@pytest.mark.parametrize(
    "solver",
    [jc.solvers.Dense(), jc.solvers.Schur(), jc.solvers.Sparse(), jc.solvers.ConjugateGradients()],
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_solver_knows_rotors(solver, dtype):
    system, state = wheel(
        3, jc.joints.Armature("rotor", "hub", 0.3), jc.Motor("m", "hub"), dtype=dtype
    )
    method = dataclasses.replace(FREE, solver=solver)
    solution = jc.forward_dynamics(system, state, jnp.asarray([5.0], dtype), method, 1e-3)
    bound = 1e-12 if dtype == "float64" else 1e-5
    np.testing.assert_allclose(solution.acceleration[-1], 5.0, rtol=bound)


def test_the_gradient_by_the_inertia_of_a_rotor():
    """The derivative is dθ̈/dI_r = −τ/(I + I_r)²."""
    system, state = wheel(3, jc.joints.Armature("rotor", "hub", 0.3), jc.Motor("m", "hub"))

    def acceleration(inertia):
        other = system.with_params({"rotor": {"inertia": inertia}})
        return jc.forward_dynamics(other, state, jnp.asarray([5.0]), FREE, 1e-3).acceleration[-1]

    np.testing.assert_allclose(jax.grad(acceleration)(0.3), -5.0, rtol=1e-9)


@both
def test_a_servo_goes_round_and_round(dim):
    """The target is an angle of two and a half turns, in the plane and in space."""
    system, state = wheel(dim, jc.forces.PositionServo("servo", "hub", 40.0, 10.0))
    target = 5 * np.pi
    run = jax.jit(
        lambda s: jc.rollout(
            system, jc.Method(), s, jnp.full((1500, 1), target), 4e-3, 1500, every=500
        )
    )
    final, path = run(state)
    angles = jax.vmap(lambda s: jc.coordinate(system, s, "hub"))(path)
    np.testing.assert_allclose(angles[-1], target, rtol=1e-6)
    np.testing.assert_allclose(jc.coordinate_rate(system, final, "hub"), 0.0, atol=1e-5)


def test_turns_are_counted_where_they_are_asked_for():
    """Without a counter an angle in space lies in [−π, π].

    It equals the counted angle modulo 2 π.
    """
    plain, start = wheel(3, angular_velocity=(0.0, 0.0, 10.0))
    counting, state = wheel(
        3, jc.joints.TurnCounter("count", "hub"), angular_velocity=(0.0, 0.0, 10.0)
    )
    assert jax.tree.leaves(start.turns) == []
    run = jax.jit(lambda system, s: jc.rollout(system, jc.Method(), s, None, 1e-2, 100)[0])
    seen = jc.coordinate(plain, run(plain, start), "hub")
    counted = jc.coordinate(counting, run(counting, state), "hub")
    np.testing.assert_allclose(counted, 10.0, rtol=1e-9)
    np.testing.assert_allclose(seen, 10.0 - 4 * np.pi, rtol=1e-9)


def test_turns_are_counted_backwards_and_in_batches():
    system, state = wheel(3, jc.joints.TurnCounter("count", "hub"))

    def angle(rate):
        s = dataclasses.replace(state, v=state.v.at[-1].set(rate))
        final = jc.rollout(system, jc.Method(), s, None, 1e-2, 100)[0]
        return jc.coordinate(system, final, "hub")

    rates = jnp.asarray([-30.0, -1.0, 0.0, 7.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(angle))(rates), rates, atol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.grad(angle))(7.0), 1.0, rtol=1e-9)


def test_a_state_that_does_not_count_is_refused():
    system, state = wheel(3, jc.joints.TurnCounter("count", "hub"))
    with pytest.raises(ValueError, match="turns.*\\(1,\\).*jc.init"):
        jc.energy(system, dataclasses.replace(state, turns=()))


def test_a_spring_in_space_counts_turns():
    """Torque −k (θ − θ₀) and energy ½ k (θ − θ₀)² hold beyond a half turn and a whole turn."""
    system, state = wheel(3, jc.forces.JointSpring("s", "hub", stiffness=10.0, rest=3.0))
    for angle in (3.1, 3.2, 6.4):
        counted = dataclasses.replace(turned(system, state, angle), turns=jnp.asarray([angle - 1]))
        np.testing.assert_allclose(torque(system, counted), -10.0 * (angle - 3.0), rtol=1e-9)
        stored = jc.energy(system, counted).potential
        np.testing.assert_allclose(stored, 5.0 * (angle - 3.0) ** 2, rtol=1e-9)


@both
def test_a_cylinder_between_two_points(dim):
    """A motor on a span pushes its ends apart; the coordinate is the change of length."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    for name, x in (("a", 0.0), ("b", 2.0)):
        scene.add_particle(name, mass=2.0, position=(x,) + (0.0,) * (dim - 1))
    scene.add(jc.joints.Span("cylinder", "a", "b"))
    scene.add(jc.Motor("pressure", "cylinder"))
    system, state = scene.build()
    a = jc.forward_dynamics(system, state, jnp.asarray([6.0]), FREE, 1e-3).acceleration
    np.testing.assert_allclose(a[:2], [-3.0, 3.0], rtol=IDENTITY)
    moved = dataclasses.replace(state, q=state.q.at[1].set(2.5))
    np.testing.assert_allclose(jc.coordinate(system, moved, "cylinder"), 0.5, rtol=IDENTITY)
    assert jc.report(system, state).rows == 0


def test_the_coordinates_of_joints_with_several():
    """Compares joint coordinates with the known motions by which bodies were displaced."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    names = ("cross", "sleeve", "nut", "puck", "mast", "ball", "bead")
    for name in names:
        scene.add_body(name, mass=1.0, inertia=(1.0, 1.0, 1.0))
    x, z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    scene.add(jc.joints.Universal("u", jc.WORLD, "cross", (0, 0, 0), axis_a=x, axis_b=(0, 1, 0)))
    scene.add(jc.joints.Cylindrical("c", jc.WORLD, "sleeve", axis=z))
    scene.add(jc.joints.Screw("s", jc.WORLD, "nut", axis=z, lead=np.pi))
    scene.add(jc.joints.Planar("p", jc.WORLD, "puck", axis=z))
    scene.add(jc.joints.Parallel("m", jc.WORLD, "mast", axis=z))
    scene.add(jc.joints.RevoluteSpherical("r", jc.WORLD, "ball", (0, 0, 0), (1, 0, 0), axis=z))
    scene.add(jc.joints.PointOnPlane("b", jc.WORLD, "bead", axis=z))
    system, state = scene.build()
    about_x, about_y = (
        jc.quaternion.from_axis_angle(axis, angle) for axis, angle in ((x, 0.4), ((0, 1, 0), -0.7))
    )
    q = state.q.at[system.layout.q("cross")[3:]].set(jc.quaternion.multiply(about_x, about_y))
    turn = jc.quaternion.from_axis_angle(z, 1.2)
    places = {"sleeve": (0, 0, 0.3), "nut": (0, 0, 0.6), "puck": (0.1, 0.2, 0)}
    places |= {"mast": (1, 2, 3), "ball": (0, 0, 0), "bead": (0.3, 0.1, 0)}
    for name, place in places.items():
        q = q.at[system.layout.q(name)].set(jnp.concatenate([jnp.asarray(place, float), turn]))
    moved = dataclasses.replace(state, q=q)
    assert jc.violation(system, moved).worst < 1e-14
    expected = {
        ("u", "angle_a"): 0.4,
        ("u", "angle_b"): -0.7,
        ("c", "travel"): 0.3,
        ("c", "angle"): 1.2,
        ("s", "travel"): 0.6,
        ("s", "angle"): 1.2,
        ("p", "angle"): 1.2,
        ("m", "angle"): 1.2,
        ("r", "angle"): 1.2,
    }
    for (joint, name), value in expected.items():
        got = jc.coordinate(system, moved, joint, name)
        np.testing.assert_allclose(got, value, rtol=IDENTITY, err_msg=f"{joint} {name}")
    for joint, place in (("p", (0.1, 0.2)), ("b", (0.3, 0.1))):
        both = [jc.coordinate(system, moved, joint, name) for name in ("x", "y")]
        np.testing.assert_allclose(np.hypot(*both), np.hypot(*place), rtol=IDENTITY)
    with pytest.raises(ValueError, match="'travel', 'angle'.*say which"):
        jc.coordinate(system, moved, "c")


def test_a_drive_is_compared_modulo_turns_whatever_counts():
    """A counted, driven wheel satisfies its drive after any number of whole turns."""

    def turning(t, p):
        return 2 * jnp.pi * t

    elements = jc.joints.Drive("drive", "hub", turning), jc.joints.TurnCounter("count", "hub")
    system, state = wheel(3, *elements, angular_velocity=(0.0, 0.0, 2 * np.pi))
    start = jc.init(system, jc.Method(), state.q, state.v, time=1.0)
    assert jc.violation(system, start)["drive"] < 1e-12


def test_turns_may_be_given_at_the_start():
    system, state = wheel(3, jc.joints.TurnCounter("count", "hub"))
    angle = 4 * np.pi + 0.3
    q = turned(system, state, 0.3).q
    start = jc.init(system, jc.Method(), q, state.v, turns=jnp.asarray([angle - 1.0]))
    np.testing.assert_allclose(jc.coordinate(system, start, "hub"), angle, rtol=IDENTITY)
    with pytest.raises(ValueError, match="turns.*\\(1,\\).*\\(2,\\)"):
        jc.init(system, jc.Method(), q, state.v, turns=jnp.zeros(2))


def test_a_counter_of_a_travel_is_refused():
    with pytest.raises(
        ValueError, match="TurnCounter 'count': the travel of 'rail' makes no turns"
    ):
        slide(3, jc.joints.TurnCounter("count", "rail"))


def test_a_muscle_pulls_most_at_its_best_length():
    """The force at L = 1 and V = 0 is F; the curves have one-sided derivatives that agree."""
    muscle = jc.forces.Muscle("m", "hub", 10.0, 1.0, (0.85, 1.15), (0.85, 1.15))
    system, state = wheel(2, muscle)

    def force(length, rate, u):
        q = state.q.at[2].set(length - 1)
        moved = state.replace(q=q, v=state.v.at[2].set(rate))
        return torque(system, moved, u[None])

    at = jax.jit(lambda *x: (force(*x), jax.jacfwd(force)(*x), jax.jacfwd(force, 1)(*x)))
    best, slope, by_rate = at(jnp.array(1.0), jnp.array(0.0), jnp.array(0.6))
    np.testing.assert_allclose(best, -6, rtol=1e-9)
    np.testing.assert_allclose(slope, 0, atol=1e-9)
    np.testing.assert_allclose(by_rate, -6 * 2 / 1.5, rtol=1e-9)
    for joint in (0.75, 1.3, 1.6, 0.5):  # the ends of the parabolas
        before, after = (
            at(jnp.array(joint + e), jnp.array(0.2), jnp.array(1.0)) for e in (-1e-9, 1e-9)
        )
        np.testing.assert_allclose(before[:2], after[:2], atol=1e-6)
    with pytest.raises(ValueError, match="length_range must be \\(smaller, larger\\), got"):
        wheel(2, jc.forces.Muscle("m", "hub", 10.0, 1.0, (1.2, 1.1)))
