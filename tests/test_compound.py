"""Compound joints and twists: angles of hinges in series, compared with composed rotations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import IDENTITY

import jaxcon as jc

FREE = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
POINT = np.array([0.3, -0.2, 0.5])
AXES = np.array([[1.0, 0.2, 0.1], [-0.3, 1.0, 0.4], [0.2, -0.1, 1.0]])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
SLIDES = np.array([[0.0, 1.0, 0.5], [1.0, 0.3, 0.0], [0.2, 0.1, 1.0]])
SLIDES /= np.linalg.norm(SLIDES, axis=1, keepdims=True)
MOMENTS = (0.4, 0.5, 0.7)


def arm(slides, hinges, *elements, ball=False, dtype=None, **body):
    """A body on a compound joint with the given numbers of slides and hinges."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0), dtype=dtype)
    scene.add_body("arm", mass=2.0, inertia=MOMENTS, position=(0.1, 0.4, 0.2), **body)
    joint = jc.joints.Compound(
        "joint",
        jc.WORLD,
        "arm",
        POINT,
        slides=(*SLIDES[:slides],),
        hinges=(*AXES[:hinges],),
        ball=ball,
    )
    scene.add(joint)
    for element in elements:
        scene.add(element)
    return scene.build()


def placed(system, state, travels, angles):
    """Returns q at these coordinates, by composing the motions of the slides and hinges."""
    turn = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    for axis, angle in zip(AXES, angles, strict=False):
        turn = jc.quaternion.multiply(turn, jc.quaternion.exp(jnp.asarray(axis) * angle))
    point = POINT + sum(x * s for x, s in zip(travels, SLIDES, strict=False))
    arm = jnp.asarray([0.1, 0.4, 0.2]) - POINT
    return jnp.concatenate([point + jc.quaternion.rotate(turn, arm), turn])


@pytest.mark.parametrize("slides", [0, 1, 2, 3])
@pytest.mark.parametrize("hinges", [0, 1, 2, 3])
def test_coordinates_are_those_that_were_composed(slides, hinges):
    """Compares coordinates, and their rates as derivatives of the composed pose."""
    system, state = arm(slides, hinges)
    travels = jnp.asarray([0.3, -0.7, 0.4])[:slides]
    angles = jnp.asarray([2.1, -1.1, -2.9])[:hinges]
    rates = jnp.asarray([0.4, -0.3, 0.8, 0.5, -0.6, 0.7])[: slides + hinges]
    names = [f"travel_{i + 1}" for i in range(slides)] + [f"angle_{i + 1}" for i in range(hinges)]

    def pose(x):
        return placed(system, state, x[:slides], x[slides:])

    @jax.jit
    def read(x, rates):
        q, slope = jax.jvp(pose, (x,), (rates,))
        spin = 2 * jc.quaternion.multiply(jc.quaternion.conjugate(q[3:]), slope[3:])[1:]
        s = dataclasses.replace(state, q=q, v=jnp.concatenate([slope[:3], spin]))
        off = jc.violation(system, s)
        worst = jnp.maximum(off.worst, off.worst_rate) if off.layout.size else jnp.zeros(())
        values = [jc.coordinate(system, s, "joint", name) for name in names]
        return worst, values, [jc.coordinate_rate(system, s, "joint", name) for name in names]

    worst, values, found = read(jnp.concatenate([travels, angles]), rates)
    assert worst < 1e-12
    np.testing.assert_allclose(values, [*travels, *angles], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found, rates, rtol=1e-9, atol=1e-12)


def test_springs_on_three_hinges_add_up():
    """Three springs evaluated together give the sum of the forces of each spring alone."""
    springs = [
        jc.forces.JointSpring(f"spring{i}", "joint", float(i), coordinate=f"angle_{i}")
        for i in (1, 2, 3)
    ]

    def force(*elements):
        system, state = arm(0, 3, *elements)
        q = placed(system, state, (), (2.1, -1.1, -2.9))
        return system.force(q, jnp.zeros(6), state.instant)

    np.testing.assert_allclose(force(*springs), sum(map(force, springs)), rtol=1e-12, atol=1e-12)
    assert np.linalg.norm(force(*springs)) > 1


def test_perpendicular_hinges_up_to_gimbal_lock():
    """The middle angle takes values up to ±90°, where accelerations and derivatives stay finite."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body("arm", mass=2.0, inertia=MOMENTS)
    scene.add(
        jc.joints.Compound("joint", jc.WORLD, "arm", hinges=((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    )
    scene.add(jc.forces.JointSpring("spring", "joint", 1.0, coordinate="angle_2"))
    system, state = scene.build()

    def middle(angle):
        turn = jc.quaternion.from_axis_angle(jnp.asarray([0.0, 1.0, 0.0]), angle)
        s = dataclasses.replace(state, q=jnp.concatenate([jnp.zeros(3), turn]))
        return jc.coordinate(system, s, "joint", "angle_2")

    for angle in (-1.5, 0.0, 1.5):
        np.testing.assert_allclose(middle(angle), angle, rtol=1e-12)
    turn = jc.quaternion.from_axis_angle(jnp.asarray([0.0, 1.0, 0.0]), jnp.pi / 2)
    lock = dataclasses.replace(state, q=jnp.concatenate([jnp.zeros(3), turn]))
    lock = dataclasses.replace(lock, v=jnp.ones(6))

    def acceleration(q):
        s = dataclasses.replace(lock, q=q)
        return jc.forward_dynamics(system, s, None, FREE, 1e-3).acceleration

    assert jnp.all(jnp.isfinite(jax.jit(jax.jacfwd(acceleration))(lock.q)))


def test_motors_on_two_hinges_do_the_work_of_their_angles():
    """At rest, M v̇ projected on the hinges equals the two torques τ."""
    motors = [jc.Motor(f"m{i}", "joint", coordinate=f"angle_{i}") for i in (1, 2)]
    system, state = arm(0, 2, *motors)
    lever = np.array([0.1, 0.4, 0.2]) - POINT
    lift = np.concatenate([np.cross(AXES[:2], lever), AXES[:2]], axis=1).T
    mass = np.diag([2.0] * 3 + list(MOMENTS))
    control = jnp.asarray([0.7, -1.2])
    expected = np.linalg.solve(lift.T @ mass @ lift, control)
    solution = jc.forward_dynamics(system, state, control, FREE, 1e-3)
    np.testing.assert_allclose(solution.acceleration, lift @ expected, rtol=1e-9)


def ball(*elements, **body):
    """A body on a ball joint at its center of mass, rotated at assembly."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body("ball", mass=1.0, inertia=MOMENTS, quaternion=(0.5, 0.5, 0.5, 0.5), **body)
    scene.add(jc.Spherical("socket", jc.WORLD, "ball", point=(0, 0, 0)))
    for i, axis in enumerate(np.eye(3)):  # x of the body is y of the world, y is z, z is x
        scene.add(jc.joints.Twist(f"twist{i}", jc.WORLD, "ball", axis=np.roll(axis, 1)))
    for element in elements:
        scene.add(element)
    return scene.build()


def test_a_motor_on_a_twist_is_a_torque_in_the_body():
    system, state = ball(*(jc.Motor(f"m{i}", f"twist{i}") for i in range(3)))
    torque = jnp.asarray([0.3, -0.2, 0.5])
    solution = jc.forward_dynamics(system, state, torque, FREE, 1e-3)
    expected = torque / jnp.asarray(MOMENTS)
    np.testing.assert_allclose(solution.acceleration[3:], expected, rtol=1e-9)


def test_rotors_on_three_twists_add_to_the_moments():
    """(I + I_r) ω̇ = −ω × Iω: rotors have momentum along their own axes in the body only."""
    spin = np.array([0.4, -0.8, 1.1])
    rotors = [jc.joints.Armature(f"r{i}", f"twist{i}", 0.2) for i in range(3)]
    system, state = ball(*rotors, angular_velocity=spin)
    solution = jc.forward_dynamics(system, state, None, FREE, 1e-3)
    moments = np.array(MOMENTS)
    expected = -np.cross(spin, moments * spin) / (moments + 0.2)
    np.testing.assert_allclose(solution.acceleration[3:], expected, rtol=1e-9)


def test_equal_springs_on_three_twists_pull_along_the_rotation_vector():
    system, state = ball(*(jc.forces.JointSpring(f"s{i}", f"twist{i}", 2.0, 0.1) for i in range(3)))
    turn, spin = jnp.asarray([0.7, -1.3, 0.4]), jnp.asarray([0.2, 0.1, -0.3])
    turned = jc.quaternion.multiply(state.q[3:], jc.quaternion.exp(turn))
    q = jnp.concatenate([jnp.zeros(3), turned])
    s = dataclasses.replace(state, q=q, v=jnp.concatenate([jnp.zeros(3), spin]))
    moments = jnp.asarray(MOMENTS)
    torque = -2.0 * turn - 0.1 * spin - jnp.cross(spin, moments * spin)
    solution = jc.forward_dynamics(system, s, None, FREE, 1e-3)
    np.testing.assert_allclose(solution.acceleration[3:] * moments, torque, rtol=1e-9)
    np.testing.assert_allclose(jc.energy(system, s).potential, turn @ turn, rtol=IDENTITY)


def test_a_free_compound_has_no_rows():
    system, state = arm(3, 0, ball=True)
    assert jc.report(system, state).degrees_of_freedom == 6


@pytest.mark.parametrize(
    ("slides", "hinges", "ball", "match"),
    [
        (((1, 0, 0), (2, 0, 0)), (), False, "'j'.*slides.*independent"),
        ((), ((1, 0, 0), (0, 1, 0), (1, 1, 0)), False, "'j'.*hinges.*independent"),
        ((), (np.eye(4)[:, :3].tolist()), False, "'j'.*hinges must be a tuple"),
        ((), ((0, 0, 0),), False, "'j'.*hinges\\[0\\] must have a length"),
        (((1, 0),), (), False, "'j'.*slides\\[0\\] must have shape \\(3,\\)"),
        ((), ((1, 0, 0),), True, "'j'.*hinges or ball"),
    ],
)
def test_bad_axes_are_named(slides, hinges, ball, match):
    scene = jc.Scene()
    scene.add_body("arm", mass=1.0, inertia=(1, 1, 1))
    scene.add(jc.joints.Compound("j", jc.WORLD, "arm", slides=slides, hinges=hinges, ball=ball))
    with pytest.raises(ValueError, match=match):
        scene.build()


def test_a_twist_is_neither_driven_nor_coupled():
    for element in (
        jc.joints.Gear("g", "twist0", "twist1", 2.0),
        jc.joints.Drive("g", "twist0", jnp.sin),
    ):
        with pytest.raises(ValueError, match="'g': the twist of 'twist0' is not the integral"):
            ball(element)
