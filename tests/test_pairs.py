"""Less common joints, compared with hand calculations: threads, slots, bent shafts, rods."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import DERIVATIVE, IDENTITY

import jaxcon as jc

METHOD = jc.Method(stabilizer=jc.stabilizers.Unstabilized())
X, Y, Z = np.eye(3)


@jax.jit
def solve(system, state, control=None):
    return jc.forward_dynamics(system, state, control, METHOD, 1e-3)


@pytest.mark.parametrize("lead", [0.2, -0.2])
@pytest.mark.parametrize("turns", [0.0, 0.4, 3.7])
def test_a_nut_runs_down_its_thread(lead, turns):
    """m s̈ = −m g − (2π/p)² I s̈ for a nut on an upright screw, after any number of turns."""
    mass, moment, g = 1.5, 0.02, 9.81
    scene = jc.Scene()
    scene.add_body("nut", mass=mass, inertia=(0.03, 0.03, moment), position=0.3 * X)
    scene.add(jc.joints.Screw("thread", jc.WORLD, "nut", axis=Z, point=0.3 * X, lead=lead))
    system, state = scene.build()
    half = np.pi * turns
    q = jnp.array([0.3, 0.0, turns * lead, np.cos(half), 0.0, 0.0, np.sin(half)])
    state = dataclasses.replace(state, q=q)
    assert jc.violation(system, state).worst < IDENTITY
    a = solve(system, state).acceleration
    fall = -g * mass / (mass + moment * (2 * np.pi / lead) ** 2)
    expected = [0.0, 0.0, fall, 0.0, 0.0, fall * 2 * np.pi / lead]
    np.testing.assert_allclose(a, expected, rtol=IDENTITY, atol=IDENTITY)


def test_a_thread_far_off_is_off_by_less_than_half_a_turn():
    scene = jc.Scene()
    scene.add_body("nut", mass=1.0, inertia=(1.0, 1.0, 1.0))
    scene.add(jc.joints.Screw("thread", jc.WORLD, "nut", axis=Z, lead=0.2))
    system, state = scene.build()
    for travel, left in ((0.06, 0.06), (0.11, -0.09), (0.45, 0.05), (-0.38, 0.02)):
        moved = dataclasses.replace(state, q=state.q.at[2].set(travel))
        found = jc.violation(system, moved).position
        np.testing.assert_allclose(found, [0.0, 0.0, 0.0, 0.0, left], atol=IDENTITY)


def spinning(t, rate):
    return rate * t


def test_a_bead_is_thrown_out_of_a_turning_slot():
    """r̈ = Ω² r, and the slot pushes across itself with 2 m Ω ṙ."""
    mass, rate, r, speed = 0.7, 3.0, 0.5, 1.2
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("arm", mass=1.0, inertia=0.3, angular_velocity=rate)
    velocity = (speed, rate * r)
    scene.add_particle("bead", mass=mass, position=(r, 0.0), velocity=velocity)
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)))
    scene.add(jc.joints.Drive("motor", "hinge", spinning, params=rate))
    scene.add(jc.joints.PointOnLine("slot", "arm", "bead", axis=(1.0, 0.0), point=(r, 0.0)))
    system, state = scene.build()
    solution = solve(system, state)
    # at θ = 0: ẍ = r̈ − Ω² r = 0, ÿ = 2 Ω ṙ
    a = solution.acceleration[system.layout.v("bead")]
    np.testing.assert_allclose(a, [0.0, 2 * rate * speed], rtol=IDENTITY, atol=IDENTITY)
    push = jc.wrench(solution, "slot", system=system)
    np.testing.assert_allclose(push, [0.0, 2 * mass * rate * speed], rtol=IDENTITY, atol=IDENTITY)


def coupled(joint, bend):
    """A driven shaft along x, and a second shaft at an angle to it in the plane of x and y."""
    along = np.cos(bend) * X + np.sin(bend) * Y
    turn = (np.cos(bend / 2), 0.0, 0.0, np.sin(bend / 2))
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    solid = {"mass": 1.0, "inertia": (0.1, 0.2, 0.2)}
    scene.add_body("input", **solid, position=-0.5 * X)
    scene.add_body("output", **solid, position=0.5 * along, quaternion=turn)
    scene.add(jc.Revolute("bearing", jc.WORLD, "input", point=-X, axis=X))
    scene.add(jc.joints.Parallel("guide", jc.WORLD, "output", axis=along))
    scene.add(joint(along))
    scene.add(jc.forces.ExternalWrench("motor", "input"))
    return scene.build()


@pytest.mark.parametrize("bend", [0.0, 0.6, 2.0])
def test_shafts_of_constant_velocity_turn_alike(bend):
    """At every angle 0.5 N m accelerates both moments of 0.1 kg m² as shafts in line."""

    def joint(along):
        return jc.joints.ConstantVelocity(
            "joint", "input", "output", np.zeros(3), axis=X, axis_b=along
        )

    system, state = coupled(joint, bend)
    torque = jnp.zeros(6).at[3].set(0.5)
    for angle in (0.0, 0.9, 2.5, 4.0):
        half = jnp.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])
        q, v = state.q, jnp.zeros_like(state.v)
        for name in ("input", "output"):
            own = system.layout.q(name)[3:]
            q = q.at[own].set(jc.quaternion.multiply(q[own], half))  # about the body's x axis
            v = v.at[system.layout.v(name)[3]].set(2.0)
        moved = dataclasses.replace(state, q=q, v=v)
        assert jc.violation(system, moved).worst < IDENTITY
        assert jc.violation(system, moved).worst_rate < IDENTITY
        a = solve(system, moved, torque).acceleration
        expected = np.zeros((2, 6))
        expected[:, 3] = 0.5 / (0.1 + 0.1)
        found = [a[system.layout.v(name)] for name in ("input", "output")]
        np.testing.assert_allclose(found, expected, atol=DERIVATIVE)


@pytest.mark.parametrize("kind", ["planar", "parallel", "cylindrical"])
def test_what_is_free_stays_free(kind):
    """Without gravity a body keeps every allowed velocity, and the joint force is zero."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    allowed = {"planar": (X - Y, Z), "parallel": (X + Y + Z, Z), "cylindrical": (Z, Z)}[kind]
    velocity, spin = allowed
    scene.add_body(
        "body", mass=1.0, inertia=(1.0, 1.0, 2.0), velocity=velocity, angular_velocity=spin
    )
    site = scenes.Site(jc.WORLD, "body", 3, np.zeros(3), Z, X)
    for element in scenes.JOINTS[kind].make(site):
        scene.add(element)
    system, state = scene.build()
    assert jc.violation(system, state).worst_rate < IDENTITY
    a, multipliers, _ = solve(system, state)
    np.testing.assert_allclose(a, jnp.zeros(6), atol=IDENTITY)
    np.testing.assert_allclose(multipliers, jnp.zeros_like(multipliers), atol=IDENTITY)


PLANES = {"planar": jc.joints.Planar, "point": jc.joints.PointOnPlane}


def slid(kind, axis, x_axis, travel=(0.3, -0.2, 0.1), dtype=None):
    """Returns the coordinates x and y after a translation of the body."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0), dtype=dtype)
    scene.add_body("body", mass=1.0, inertia=(1.0, 1.0, 1.0))
    more = {} if x_axis is None else {"x_axis": x_axis}
    scene.add(PLANES[kind]("plane", jc.WORLD, "body", axis=axis, **more))
    system, state = scene.build()
    moved = dataclasses.replace(state, q=state.q.at[:3].add(jnp.asarray(travel, state.q.dtype)))
    return np.array([jc.coordinate(system, moved, "plane", name) for name in "xy"])


@pytest.mark.parametrize("kind", PLANES)
def test_x_of_a_plane_is_the_axis_that_was_chosen(kind):
    """The x axis is projected onto the plane and normalized; y = axis × x."""
    np.testing.assert_allclose(slid(kind, Z, X), [0.3, -0.2], atol=IDENTITY)
    np.testing.assert_allclose(slid(kind, -2 * Z, 3 * X + Z), [0.3, 0.2], atol=IDENTITY)
    np.testing.assert_allclose(slid(kind, Y, Z), [0.1, 0.3], atol=IDENTITY)
    n, x = np.array([1.0, 2.0, 2.0]) / 3, np.array([2.0, 1.0, -2.0]) / 3
    expected = [np.dot(u, [0.3, -0.2, 0.1]) for u in (x, np.cross(n, x))]
    np.testing.assert_allclose(slid(kind, 5 * n, x + n), expected, atol=IDENTITY)
    assert slid(kind, Z, X, dtype=jnp.float32).dtype == np.float32


@pytest.mark.parametrize("kind", PLANES)
def test_x_of_a_plane_without_a_choice_is_that_of_the_documentation(kind):
    """x = axis × e, with the world axis e along which the axis has its smallest component."""
    np.testing.assert_allclose(slid(kind, Z, None), [-0.2, -0.3], atol=IDENTITY)
    np.testing.assert_allclose(slid(kind, Y, None), [-0.1, -0.3], atol=IDENTITY)
    np.testing.assert_allclose(slid(kind, X, None), [0.1, 0.2], atol=IDENTITY)


@pytest.mark.parametrize("kind", PLANES)
def test_x_along_the_normal_of_a_plane_is_refused(kind):
    with pytest.raises(ValueError, match="'plane'.*x_axis must not be parallel to axis"):
        slid(kind, Z, -3 * Z)


def test_x_of_a_line_in_the_plane_points_as_it_was_chosen():
    for x_axis, sign in ((None, 1), ((-1.0, 0.2), 1), ((1.0, 0.0), -1)):
        scene = jc.Scene(dim=2)
        scene.add_particle("bead", mass=1.0, position=(0.0, 1.0))
        plane = jc.joints.PointOnPlane("line", jc.WORLD, "bead", axis=(0.0, 2.0), x_axis=x_axis)
        scene.add(plane)
        system, state = scene.build()
        moved = dataclasses.replace(state, q=state.q.at[0].add(-0.5))
        got = jc.coordinate(system, moved, "line", "x")
        np.testing.assert_allclose(got, 0.5 * sign, atol=IDENTITY)


def test_a_parallel_axis_is_held_by_a_torque_across_it():
    """A body under a force off its center would tip; the joint holds it with a pure torque."""
    scene = jc.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body("body", mass=2.0, inertia=(1.0, 1.0, 1.0), position=X)
    scene.add(jc.joints.Parallel("guide", jc.WORLD, "body", axis=Z))
    scene.add(jc.forces.Force("push", "body", force=(0.0, 0.0, 4.0), point=1.5 * X))
    system, state = scene.build()
    solution = solve(system, state)
    held = jc.wrench(solution, "guide", system=system)
    np.testing.assert_allclose(held, [0.0, 0.0, 0.0, 0.0, 2.0, 0.0], atol=IDENTITY)
    np.testing.assert_allclose(solution.acceleration[2], 2.0, rtol=IDENTITY)
