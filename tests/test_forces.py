"""Forces, compared with the gradient of their potential and with hand calculations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc

both = pytest.mark.parametrize("dim", [2, 3])


def two_bodies(dim, *elements, gravity=None, damp=()):
    """Two moving bodies, a particle and a wall at random places, with the given forces."""
    random = np.random.default_rng(dim)
    scene = jc.Scene(dim=dim, gravity=gravity)
    for name in ("first", "second"):
        scenes.add_random_body(scene, name, random)
    scene.add_particle("bob", mass=0.7, position=random.normal(size=dim), velocity=(1.0,) * dim)
    turn = {"angle": 0.4} if dim == 2 else {"quaternion": (0.5, 0.5, 0.5, -0.5)}
    scene.add_body("wall", fixed=True, position=(0.3,) * dim, **turn)
    for element in elements:
        scene.add(element)
    return scene.build()


def elements(dim):
    point, other = np.arange(1.0, dim + 1), np.full(dim, -0.4)
    axis = None if dim == 2 else (1.0, 2.0, 3.0)
    return {
        "gravity": [],
        "spring": [
            jc.Spring("s", "first", "second", 30.0, rest_length=0.3, point_a=point, point_b=other)
        ],
        "spring to the world": [jc.Spring("s", jc.WORLD, "bob", 30.0, rest_length=0.3)],
        "spring to a wall": [jc.Spring("s", "wall", "first", 30.0, rest_length=0.3, point_a=point)],
        "spring on a particle": [jc.Spring("s", "bob", "second", 20.0, 0.0, 0.1)],
        "force": [jc.forces.Force("f", "second", force=point, point=other)],
        "joint spring": [
            jc.Revolute("joint", "first", "second", point=point, axis=axis),
            jc.forces.JointSpring("s", "joint", stiffness=3.0, rest=0.4),
        ],
        "slider spring": [
            jc.Prismatic("joint", "first", "second", axis=point),
            jc.forces.JointSpring("s", "joint", stiffness=3.0, rest=0.4),
        ],
    }


@both
@pytest.mark.parametrize("name", elements(2))
def test_force_is_minus_the_slope_of_the_potential(dim, name):
    system, state = two_bodies(dim, *elements(dim)[name])
    q = system.retract(
        state.q, jnp.asarray(0.2 * np.random.default_rng(1).normal(size=state.v.shape))
    )
    rest = jnp.zeros_like(state.v)

    def potential(step):
        return system.energy(system.retract(q, step), rest, state.time).potential

    slope = jax.jit(jax.grad(potential))(rest)
    force = system.force(q, rest, state.time, None)
    np.testing.assert_allclose(force, -slope, rtol=1e-11, atol=1e-11)
    assert np.any(np.abs(force) > 1e-3)


@both
def test_energy_of_a_spring_by_hand(dim):
    place = np.arange(1.0, dim + 1)
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    scene.add_particle("bob", mass=2.0, position=place, velocity=place)
    scene.add(jc.Spring("s", jc.WORLD, "bob", stiffness=3.0, damping=0.5, rest_length=0.4))
    system, state = scene.build()
    length = np.linalg.norm(place)
    energy = jc.energy(system, state)
    np.testing.assert_allclose(energy.potential, 1.5 * (length - 0.4) ** 2, rtol=IDENTITY)
    np.testing.assert_allclose(energy.kinetic, length**2, rtol=IDENTITY)
    np.testing.assert_allclose(energy.total, energy.kinetic + energy.potential)
    tension = 3.0 * (length - 0.4) + 0.5 * length
    force = system.force(state.q, state.v, state.time)
    np.testing.assert_allclose(force, -tension * place / length, rtol=IDENTITY)


@both
def test_a_spring_is_at_rest_at_assembly_unless_told_otherwise(dim):
    system, state = two_bodies(dim, jc.Spring("s", "first", "bob", 30.0), gravity=(0.0,) * dim)
    assert system.energy(state.q, state.v, state.time).potential < 1e-25


@both
def test_a_spring_of_length_zero_is_finite(dim):
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
    scene.add_particle("bob", mass=1.0, velocity=(1.0,) * dim)
    scene.add(jc.Spring("s", jc.WORLD, "bob", stiffness=3.0, damping=1.0, rest_length=0.4))
    system, state = scene.build()

    def force(q, v):
        return system.force(q, v, state.time)

    np.testing.assert_array_equal(force(state.q, state.v), np.zeros(dim))
    for derivative in (jax.jacfwd, jax.jacrev):
        for argnum in (0, 1):
            assert jnp.all(jnp.isfinite(derivative(force, argnum)(state.q, state.v)))
    hessian = jax.hessian(lambda q: system.energy(q, state.v, state.time).potential)(state.q)
    assert jnp.all(jnp.isfinite(hessian))


@both
@pytest.mark.parametrize("name", ["spring", "spring to a wall", "joint spring", "slider spring"])
def test_damping_takes_energy_and_springs_alone_do_not(dim, name):
    """The power of a damper is −c times its speed squared, never positive."""
    *joint, spring = elements(dim)[name]
    powers = []
    for damping in (0.0, 0.5, 1.0):
        changed = dataclasses.replace(spring, stiffness=0.0, damping=damping)
        system, state = two_bodies(dim, *joint, changed, gravity=(0.0,) * dim)
        gyroscopic, _ = two_bodies(dim, gravity=(0.0,) * dim)
        still = gyroscopic.force(state.q, state.v, state.time)
        powers.append(float(state.v @ (system.force(state.q, state.v, state.time) - still)))
    assert powers[0] == 0
    assert powers[1] < 0
    np.testing.assert_allclose(powers[2], 2 * powers[1], rtol=1e-9)


@both
@pytest.mark.parametrize("name", ["spring", "force", "joint spring"])
def test_internal_forces_balance(dim, name):
    """Springs between bodies do not change the total momentum; an external force does."""
    system, state = two_bodies(dim, *elements(dim)[name], gravity=(0.0,) * dim)
    force = system.force(state.q, state.v, state.time)
    total = sum(np.asarray(force[system.layout.v(b)[:dim]]) for b in ("first", "second", "bob"))
    outer = np.arange(1.0, dim + 1) if name == "force" else np.zeros(dim)
    np.testing.assert_allclose(total, outer, atol=1e-12)


@both
def test_gravity_is_the_weight(dim):
    system, state = two_bodies(dim)
    mass = system.params["second"]["mass"]
    weight = system.force(state.q, 0 * state.v, state.time)[system.layout.v("second")]
    expected = np.zeros(3 if dim == 2 else 6)
    expected[dim - 1] = -9.81 * mass
    np.testing.assert_allclose(weight, expected, rtol=IDENTITY)


def test_gyroscopic_force_is_that_of_euler():
    system, state = two_bodies(3, gravity=(0, 0, 0))
    moments = np.asarray(system.params["first"]["inertia"])
    omega = np.asarray(state.v)[system.layout.v("first")][3:]
    torque = np.asarray(system.force(state.q, state.v, state.time))[system.layout.v("first")][3:]
    np.testing.assert_allclose(torque, -np.cross(omega, moments * omega), rtol=IDENTITY)


def power(system, state, control):
    """Returns the power v · f of the control alone."""
    with_control = system.force(state.q, state.v, state.time, control)
    without = system.force(state.q, state.v, state.time, None)
    return state.v @ (with_control - without)


@both
@pytest.mark.parametrize("body", ["first", "second", "bob"])
def test_a_wrench_does_the_work_of_its_force_and_torque(dim, body):
    """The power is F · ṗ + τ · ω at the point where the force acts."""
    point = None if body == "bob" else np.arange(1.0, dim + 1)
    system, state = two_bodies(dim, jc.forces.ExternalWrench("push", body, point=point))
    control = jnp.asarray(np.random.default_rng(3).normal(size=system.layout.n_u))
    motion = system.motion(body, state.q, state.v)
    speed, turning = motion.velocity, 0.0
    if body != "bob":
        speed = motion.point_velocity(motion.pose.local_point(jnp.asarray(point)))
        torque, omega = control[dim:], jnp.atleast_1d(motion.angular_velocity)
        turning = torque @ (omega if dim == 2 else motion.rotation @ omega)
    expected = control[:dim] @ speed + turning
    np.testing.assert_allclose(power(system, state, control), expected, rtol=1e-11)


def test_without_control_a_wrench_is_zero():
    system, state = two_bodies(2, jc.forces.ExternalWrench("push", "first"))
    zero = system.force(state.q, state.v, state.time, jnp.zeros(3))
    np.testing.assert_array_equal(system.force(state.q, state.v, state.time, None), zero)


def pulling(a, b, t, u, p):
    """Returns a force between two bodies, proportional to control, time and a parameter."""
    force = p["gain"] * t * u[0] * (b.position - a.position)
    if a.position.shape == (2,):
        return jnp.append(force, u[1]), -force
    return jnp.concatenate([force, u[1] * jnp.ones(3)]), -force


@both
def test_custom_force_with_control(dim):
    """The user's wrench refers to the origin of the body frame that the user gave."""
    user = jc.forces.CustomForce(
        "pull", ("second", "bob"), pulling, params={"gain": 2.0}, controls=2
    )
    system, state = two_bodies(dim, jc.forces.ExternalWrench("push", "bob"), user)
    at = dataclasses.replace(state, time=jnp.asarray(0.5))
    control = jnp.zeros(dim + 2).at[system.layout.control("pull")].set(jnp.asarray([3.0, 0.7]))
    a, b = (system.motion(name, state.q, state.v) for name in ("second", "bob"))
    force = 3.0 * (b.position - a.position)
    omega = a.angular_velocity if dim == 2 else jnp.sum(a.rotation @ a.angular_velocity)
    expected = force @ (a.velocity - b.velocity) + 0.7 * omega
    without = dataclasses.replace(at, time=jnp.asarray(0.0))
    zero = jnp.zeros_like(control)
    gained = system.force(at.q, at.v, at.time, control) - system.force(at.q, at.v, at.time, zero)
    np.testing.assert_allclose(at.v @ gained, expected, rtol=1e-11)
    assert without.time == 0


def test_custom_force_of_the_wrong_shape():
    def wrong(a, t, u, p):
        return jnp.zeros(2)

    system, state = two_bodies(2, jc.forces.CustomForce("bad", ("first",), wrong))
    with pytest.raises(ValueError, match="force 'bad'.*'first'.*\\(3,\\).*\\(2,\\)"):
        system.force(state.q, state.v, state.time)


def test_a_spring_at_zero_length_keeps_its_stiffness():
    """For l = 0 force and energy are smooth at d = 0: dF/dq = −k, ∂V/∂l = −k ‖d‖."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_particle("bob", mass=1.0)
    scene.add(jc.Spring("s", jc.WORLD, "bob", stiffness=10.0))
    system, state = scene.build()
    slope = jax.jacfwd(lambda q: system.force(q, state.v, state.time))(state.q)
    np.testing.assert_allclose(slope, -10.0 * np.eye(2))
    curvature = jax.hessian(lambda q: system.energy(q, state.v, state.time).potential)(state.q)
    np.testing.assert_allclose(curvature, 10.0 * np.eye(2))

    def stored(length):
        changed = system.with_params({"s": {"rest_length": length}})
        return changed.energy(jnp.array([0.3, 0.4]), state.v, state.time).potential

    np.testing.assert_allclose(jax.grad(stored)(0.0), -5.0)


@both
def test_a_control_may_be_an_array_of_numpy(dim):
    """Bodies that take different forces in many pieces, and in few; an array of JAX is the same."""
    for count in (2, 12):
        scene = jc.Scene(dim=dim, gravity=(0.0,) * dim)
        for i in range(count):
            scene.add_particle(f"p{i}", mass=1.0, position=(float(i),) * dim)
        for i in range(0, count, 2):
            scene.add(jc.forces.ExternalWrench(f"w{i}", f"p{i}"))
        system, state = scene.build()
        control = np.arange(1.0, system.layout.n_u + 1)
        given = [system.force(state.q, state.v, 0.0, u) for u in (control, jnp.asarray(control))]
        np.testing.assert_array_equal(*given)
        assert np.sum(given[0]) == np.sum(control)


def test_drag_slows_a_body_and_has_gradients():
    """Drag along an edge and about it, by hand; the gradient by the density in float32."""
    scene = jc.Scene(dim=3, gravity=(0, 0, 0), dtype=jnp.float32)
    moving = {"velocity": (2.0, 0, 0), "angular_velocity": (0, 0, 3.0)}
    scene.add_body("box", mass=2.0, inertia=(1.0, 1.0, 0.5), **moving)
    size, ρ, η = (0.4, 0.2, 0.3), 5.0, 0.7
    scene.add(jc.forces.FluidDrag("drag", "box", size, ρ, η, wind=(0.5, 0, 0)))
    system, state = scene.build()

    def acceleration(density):
        changed = system.with_params({"drag": {"density": density}})
        return jc.forward_dynamics(changed, state, None, jc.Method(), 1e-3).acceleration

    density = jnp.asarray(ρ, jnp.float32)
    found, slope = jax.jit(lambda x: (acceleration(x), jax.jacfwd(acceleration)(x)))(density)
    force = -3 * np.pi * η * 0.3 * 1.5 - ρ * 0.06 * 1.5**2 / 2
    blades = 0.3 * (0.4**4 + 0.2**4) * 9 / 64
    torque = -np.pi * η * 0.3**3 * 3 - ρ * blades
    np.testing.assert_allclose(found, [force / 2, 0, 0, 0, 0, torque / 0.5], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        slope[np.array([0, 5])], [-0.06 * 1.5**2 / 4, -2 * blades], rtol=1e-5
    )
