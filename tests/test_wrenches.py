"""Wrenches by name: Newton–Euler equations of every body, with every element that acts on it."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import jaxcon as jc

IDEAL = jc.Method(stabilizer=jc.stabilizers.Unstabilized())


def machine(dim):
    """A cart with a driven arm, a spring, a rod, a motor, an active limit, friction and a floor."""
    scene = jc.Scene(dim=dim)
    axis, up = (None, (0.0, 1.0)) if dim == 2 else ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    x, z = (np.eye(dim)[i] for i in (0, -1))
    inertia = 0.3 if dim == 2 else (0.3, 0.2, 0.25)
    scene.add_body("cart", mass=2.0, inertia=inertia, position=0.0 * x, velocity=0.4 * x)
    scene.add_body("arm", mass=1.0, inertia=inertia, position=0.5 * x + 0.1 * z)
    scene.add_body("foot", mass=0.7, inertia=inertia, position=2.0 * x + 0.2 * z)
    scene.add_particle("bob", mass=0.5, position=-1.0 * x + 0.3 * z)
    scene.add(jc.Prismatic("rail", jc.WORLD, "cart", axis=x, point=0.2 * z))
    scene.add(jc.Revolute("hinge", "cart", "arm", point=0.1 * x, axis=axis))
    scene.add(jc.Distance("rod", "cart", "bob", point_a=-0.2 * x))
    scene.add(jc.Spring("spring", "arm", "foot", 30.0, 0.2, rest_length=0.5, point_a=0.9 * x))
    scene.add(jc.Motor("motor", "hinge"))
    scene.add(jc.joints.Armature("rotor", "hinge", 0.05))
    scene.add(jc.Limit("stop", "hinge", lower=0.0, upper=1.0))
    scene.add(jc.contacts.JointFriction("rub", "rail", 0.3))
    scene.add(jc.PlaneContact("floor", jc.WORLD, "foot", radius=0.2, normal=up, friction=0.4))
    scene.add(jc.forces.Force("wind", "bob", 0.3 * x))
    return scene.build()


def about_center(system, info, name, body):
    """Returns the wrench of an element on a body, about the body's center of mass."""
    wrench = np.asarray(jc.wrench(info, name, body))
    dim = system.layout.dim
    force, center = wrench[:dim], system.principal_motion(body, info.state.q, info.state.v)
    arm = anchor(system, info, name, center) - np.asarray(center.position)
    if len(wrench) == dim:
        return wrench
    turn = np.cross(np.append(arm, np.zeros(3 - dim)), np.append(force, np.zeros(3 - dim)))
    return np.concatenate([force, wrench[dim:] + turn[dim - 3 if dim == 3 else 2 :]])


def anchor(system, info, name, center):
    """Returns the point about which a wrench is given, (dim,)."""
    dim, s = system.layout.dim, info.state
    x, z = (np.eye(dim)[i] for i in (0, -1))
    where = {"rail": ("cart", 0.2 * z), "rub": ("cart", 0.2 * z), "spring": ("foot", 0 * x)}
    where |= dict.fromkeys(("hinge", "motor", "stop", "rotor"), ("arm", -0.4 * x - 0.1 * z))
    where |= {"rod": ("bob", None), "wind": ("bob", None)}
    if name == "floor":
        return np.asarray(jc.position(system, s, "foot")) - 0.2 * z
    return np.asarray(jc.position(system, s, *where[name]))


ON = {
    "cart": ("rail", "rub", "hinge", "motor", "stop", "rotor", "rod"),
    "arm": ("hinge", "motor", "stop", "rotor", "spring"),
    "foot": ("spring", "floor"),
    "bob": ("rod", "wind"),
}


@pytest.mark.parametrize(("dim", "control"), [(2, 0.8), (3, -3.0)])
def test_all_wrenches_on_a_body_make_its_motion(dim, control):
    """Σ F = m a and Σ τ = I α + ω × I ω about the center of mass, at both stops of a limit."""
    system, state = machine(dim)
    u = jnp.full(1, control)
    if control > 0:  # at the upper stop
        system = system.with_params({"stop": {"lower": -1.0, "upper": 0.0}})
    step = lambda s: jc.step(system, IDEAL, s, u, 1e-3)[1]  # noqa: E731
    info = step(state)
    assert int(info.status) == 0
    assert abs(float(info.reactions["stop"][0])) > 0.1
    assert float(info.reactions["floor"][0]) > 0.1
    for body, names in ON.items():
        columns = system.layout.v(body)
        mass = np.asarray(system.mass(state.q).values)[columns]
        weight = np.zeros(len(columns))
        weight[dim - 1] = -9.81 * mass[0]
        expected = mass * np.asarray(info.acceleration)[columns] - weight
        if len(columns) == 6:
            motion = system.principal_motion(body, state.q, state.v)
            ω = np.asarray(motion.angular_velocity)
            expected[3:] += np.cross(ω, mass[3:] * ω)
            expected[3:] = np.asarray(motion.rotation) @ expected[3:]
        found = sum(about_center(system, info, name, body) for name in names)
        np.testing.assert_allclose(found, expected, atol=1e-8)
    broken = dataclasses.replace(state, v=state.v.at[0].set(jnp.nan))
    info = step(broken)
    for name in ("hinge", "rod", "floor", "stop"):
        np.testing.assert_array_equal(jc.wrench(info, name), 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_on_the_floor_is_carried_by_its_corners(dim):
    """Checks the sum over the points, about the center of mass, and the wrench of the floor."""
    scene = jc.Scene(dim=dim)
    inertia = 0.3 if dim == 2 else (0.3, 0.2, 0.25)
    scene.add_body("box", mass=2.0, inertia=inertia, position=0.5 * np.eye(dim)[-1])
    scene.add(jc.contacts.BoxContact("floor", jc.WORLD, "box", np.ones(dim), friction=0.5))
    scene.add(jc.forces.ExternalWrench("push", "box"))
    system, state = scene.build()
    u = np.zeros(system.layout.n_u)
    u[0] = 1.0
    _, info = jc.step(system, jc.Method(), state, u, 1e-3)
    expected = np.zeros(len(u))
    expected[0], expected[dim - 1] = -1.0, 19.62
    np.testing.assert_allclose(jc.wrench(info, "floor")[:dim], expected[:dim], atol=1e-6)
    np.testing.assert_allclose(jc.wrench(info, "floor")[dim:], 0, atol=1e-6)
    np.testing.assert_allclose(jc.wrench(info, "floor", jc.WORLD), -jc.wrench(info, "floor"))
    np.testing.assert_allclose(jc.wrench(info, "push"), u)


def driven():
    scene = jc.Scene(dim=2)
    scene.add_body("bob", mass=2.0, inertia=0.1, position=(0.0, -0.5))
    scene.add(jc.Revolute("hinge", jc.WORLD, "bob", point=(0.0, 0.0)))
    scene.add(jc.Motor("motor", "hinge"))
    return scene.build()


def driven_call():
    system, state = driven()
    return system, IDEAL, state, jnp.zeros(1), 1e-3


def test_batches_and_trajectories():
    """After a transformation, an info needs the system; a recorded wrench does not."""
    system, state = driven()
    many = jnp.linspace(-1.0, 1.0, 3)[:, None]
    step = jax.jit(jax.vmap(lambda u: jc.step(system, jc.Method(), state, u, 1e-3)[1]))
    infos = step(many)
    found = jc.wrench(infos, "motor", system=system)
    np.testing.assert_allclose(found[:, 2], many[:, 0])
    each = [jc.wrench(jc.step(system, jc.Method(), state, u, 1e-3)[1], "hinge") for u in many]
    np.testing.assert_allclose(jc.wrench(infos, "hinge", system=system), each, atol=1e-12)
    with pytest.raises(ValueError, match="this info knows no system"):
        jc.wrench(infos, "hinge")
    read = lambda s, i: (jc.wrench(i, "hinge"), i)  # noqa: E731
    u = jnp.ones((4, 1))
    _, (loads, infos) = jc.rollout(system, jc.Method(), state, u, 1e-3, 4, record=read)
    np.testing.assert_allclose(jc.wrench(infos, "hinge", system=system), loads, atol=1e-12)


@pytest.mark.parametrize("adjoint", [jax.grad, jax.jacfwd])
def test_wrenches_have_derivatives(adjoint):
    """The pin of a pendulum at rest bears m g."""
    scene = jc.Scene(dim=2)
    scene.add_body("bob", mass=2.0, inertia=0.1, position=(0.0, -0.5))
    scene.add(jc.Revolute("pin", jc.WORLD, "bob", point=(0.0, 0.0)))
    system, state = scene.build()

    def load(mass):
        other = system.with_params({"bob": {"mass": mass}})
        return jc.reaction(other, state, "pin")[1]

    np.testing.assert_allclose(load(jnp.array(2.0)), 19.62, rtol=1e-9)
    np.testing.assert_allclose(adjoint(load)(jnp.array(2.0)), 9.81, rtol=1e-9)


@pytest.mark.parametrize("name", ["mixed-2d", "mixed-3d", "revolute-3d-between"])
def test_accelerations_of_points_are_differences_of_velocities(name):
    """Velocities of points change in a step h by h times their acceleration."""
    built = scenes.build(name)
    system, s, h = built.system, built.off, 1e-6
    info = jc.forward_dynamics(system, s, None, IDEAL, 1e-3)
    dim = system.layout.dim

    def at(x):
        q = system.retract(s.q, x * s.v + x * x / 2 * info.acceleration)
        return dataclasses.replace(s, q=q, v=s.v + x * info.acceleration)

    for body in ("first", "second"):
        for point in (None, np.arange(1.0, dim + 1)):
            before, after = (jc.velocity(system, at(x), body, point) for x in (-h, h))
            got = jc.acceleration(info, body, point)
            np.testing.assert_allclose(got, (after - before) / (2 * h), rtol=1e-5, atol=1e-5)
        before, after = (jc.angular_velocity(system, at(x), body) for x in (-h, h))
        got = jc.angular_acceleration(info, body)
        np.testing.assert_allclose(got, (after - before) / (2 * h), rtol=1e-5, atol=1e-5)


def test_an_info_that_is_returned_computes_no_wrenches():
    """Only wrenches that are read are computed."""
    system, state = driven()

    def operations(read):
        step = lambda s: jc.step(system, IDEAL, s, jnp.zeros(1), 1e-3)  # noqa: E731
        return len(jax.make_jaxpr(lambda s: read(*step(s)))(state).eqns)

    plain = operations(lambda s, i: s)
    assert operations(lambda s, i: (s, i)) == plain
    assert operations(lambda s, i: (s, i, jc.wrench(i, "hinge"))) > plain


def test_multipliers_of_a_limit_are_read_elsewhere():
    scene = jc.Scene(dim=2)
    scene.add_body("rod", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "rod", point=(0.0, 0.0)))
    scene.add(jc.Limit("stop", "hinge", -1.0, 1.0))
    system, state = scene.build()
    info = jc.step(system, jc.Method(), state, None, 1e-3)[1]
    with pytest.raises(ValueError, match=r"'stop' is no equality constraint; read info.reactions"):
        jc.multipliers(info, "stop")


def test_generalized_coordinates_have_no_wrenches():
    built = scenes.build("polar")
    _, info = jc.step(built.system, IDEAL, built.state, None, 1e-3)
    for system in (None, built.system):
        with pytest.raises(TypeError, match="wrench: generalized coordinates have no bodies"):
            jc.wrench(info, "rod", system=system)
    with pytest.raises(TypeError, match="acceleration: generalized coordinates have no bodies"):
        jc.acceleration(info, "rod")
    with pytest.raises(ValueError, match="element 'door' is unknown.*'hinge'"):
        jc.wrench(jc.step(*driven_call())[1], "door")


def test_worlds_that_share_their_state_have_wrenches_of_their_own():
    """Here only the gains are batched."""
    system, state = driven()
    state = state.replace(q=state.q.at[0].add(0.01))

    def load(rate):
        method = jc.Method(stabilizer=jc.Baumgarte.critical(rate))
        return jc.forward_dynamics(system, state, jnp.zeros(1), method, 1e-3)

    rates = jnp.array([1.0, 10.0])
    loads = jc.wrench(jax.vmap(load)(rates), "hinge", system=system)
    for rate, expected in zip(rates, loads, strict=True):
        np.testing.assert_allclose(jc.wrench(load(rate), "hinge"), expected, rtol=1e-12)
    assert abs(loads[1, 0] - loads[0, 0]) > 0.1


@pytest.mark.parametrize("events", [None, jc.integrators.Events()])
def test_a_stop_that_a_fast_step_reaches_pushes_back(events):
    """The slider starts nearer to the lower stop, and the upper stop stops it."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("slide", mass=1.0, inertia=1.0, position=(0.0, 0.0), velocity=(20.0, 0.0))
    scene.add(jc.Prismatic("rail", jc.WORLD, "slide", axis=(1.0, 0.0)))
    scene.add(jc.Limit("stop", "rail", lower=-0.01, upper=0.01))
    system, state = scene.build()
    state = state.replace(q=state.q.at[0].set(-0.001))
    new, info = jc.step(system, jc.Method(events=events), state, None, 1e-3)
    force = jc.wrench(info, "stop")[0]
    np.testing.assert_allclose(force, (new.v[0] - 20.0) / 1e-3, rtol=1e-6)
    assert force < -1e4


def test_a_failed_world_has_no_force_and_no_gradient():
    """Its NaN does not reach the gradient by a shared number."""
    system, state = driven()

    def load(gear):
        other = system.with_params({"motor": {"gear": gear}})
        step = lambda u: jc.step(other, jc.Method(), state, u[None], 1e-3)[1]  # noqa: E731
        u = jnp.array([1.0, jnp.nan])
        infos = jax.vmap(step)(u)
        loads = jc.wrench(infos, "motor", system=other)
        return jnp.sum(jnp.where(infos.status == 0, loads[:, 2], 0)), loads

    slope, loads = jax.grad(load, has_aux=True)(jnp.array(1.0))
    np.testing.assert_allclose(slope, 1.0, rtol=1e-12)
    np.testing.assert_array_equal(loads[1], 0)


def test_states_with_a_memory_and_pickled_infos_are_read():
    system, state = driven()
    method = jc.Method(stabilizer=jc.stabilizers.PID())
    begun = jc.init(system, method, state.q, state.v)
    expected = jc.reaction(system, state, "hinge", control=jnp.zeros(1))
    found = jc.reaction(system, begun, "hinge", control=jnp.zeros(1))
    np.testing.assert_array_equal(found, expected)
    _, info = jc.step(system, method, begun, jnp.ones(1), 1e-3)
    again = pickle.loads(pickle.dumps(info))
    expected = jc.wrench(info, "motor")
    found = jc.wrench(again, "motor", system=system)
    np.testing.assert_array_equal(found, expected)


def test_a_force_on_a_fixed_body_is_refused_where_it_does_not_follow():
    """The reaction to a user's force on a fixed body is unknown."""
    scene = jc.Scene(dim=2)
    scene.add_particle("ball", mass=1.0, position=(0.0, 1.0))
    pull = lambda ball, world, t, u, p: (jnp.ones(2), jnp.ones(2))  # noqa: E731
    scene.add(jc.forces.CustomForce("f", ("ball", jc.WORLD), pull))
    system, state = scene.build()
    _, info = jc.step(system, jc.Method(), state, None, 1e-3)
    np.testing.assert_array_equal(jc.wrench(info, "f"), 1.0)
    with pytest.raises(ValueError, match="body: element 'f' acts on"):
        jc.wrench(info, "f", jc.WORLD)
