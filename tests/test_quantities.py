"""Wrenches balance, energies match textbook formulas, accessors return the given values."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc

IDEAL = jc.Method(stabilizer=jc.stabilizers.Unstabilized())


def solved(name):
    built = scenes.build(name)
    return (
        built.system,
        built.state,
        jc.forward_dynamics(built.system, built.state, None, IDEAL, 1e-3),
    )


JOINTED = [
    f"{kind}-{dim}d-between"
    for kind in ("coincident", "distance", "revolute", "prismatic", "fixed")
    for dim in (2, 3)
]


def moved(wrench, arm):
    """Returns the torque about another point, which lies `arm` away from the old one."""
    if len(wrench) == 3:
        return wrench[2] + arm[0] * wrench[1] - arm[1] * wrench[0]
    return wrench[3:] + np.cross(arm, wrench[:3])


@pytest.mark.parametrize("name", JOINTED)
def test_wrenches_on_the_two_bodies_balance(name):
    """The wrenches are equal and opposite about one point."""
    system, state, solution = solved(name)
    on_first = np.asarray(jc.wrench(solution, "joint", body="first"))
    on_second = np.asarray(jc.wrench(solution, "joint"))
    np.testing.assert_allclose(on_first, -on_second, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(on_second, jc.wrench(solution, "joint", body="second"))


@pytest.mark.parametrize("name", JOINTED)
def test_wrenches_explain_the_motion(name):
    """Newton's and Euler's equations hold for the body that only the joint holds."""
    system, state, solution = solved(name)
    dim, columns = system.layout.dim, system.layout.v("first")
    mass = np.asarray(system.mass(state.q).values)[columns]
    free = np.asarray(system.force(state.q, state.v, state.time))[columns]
    push = mass * np.asarray(solution.acceleration)[columns] - free
    motion = system.principal_motion("first", state.q, state.v)
    wrench = np.asarray(jc.wrench(solution, "joint", body="first"))
    np.testing.assert_allclose(wrench[:dim], push[:dim], rtol=1e-9, atol=1e-9)
    rows = system.params["joint"]
    anchor = system.principal_motion("second", state.q, state.v).point(rows["anchor_b"])
    torque = moved(wrench, np.asarray(anchor - motion.position))
    world = push[2] if dim == 2 else np.asarray(motion.rotation) @ push[3:]
    np.testing.assert_allclose(torque, world, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("order", [(jc.WORLD, "lamp"), ("lamp", jc.WORLD)])
def test_a_lamp_fixed_to_the_world(dim, order):
    """The world carries the weight of the lamp and its moment about the joint."""
    scene = jc.Scene(dim=dim)
    center = np.zeros(dim)
    center[0] = 0.5
    inertia = 0.1 if dim == 2 else (0.1, 0.2, 0.2)
    scene.add_body("lamp", mass=2.0, inertia=inertia, position=center)
    scene.add(jc.Fixed("bolt", *order, point=(0.0,) * dim))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, IDEAL, 1e-3)
    weight = 2.0 * 9.81
    # gravity exerts a clockwise torque about the bolt, and the bolt balances it
    expected = [0, weight, 0.5 * weight] if dim == 2 else [0, 0, weight, 0, -0.5 * weight, 0]
    on_lamp = jc.wrench(solution, "bolt", body="lamp")
    np.testing.assert_allclose(on_lamp, expected, atol=1e-9)
    on_world = jc.wrench(solution, "bolt", body=jc.WORLD)
    np.testing.assert_allclose(on_world, -np.array(expected), atol=1e-9)
    default = on_lamp if order[1] == "lamp" else on_world
    np.testing.assert_array_equal(jc.wrench(solution, "bolt"), default)


def test_a_particle_feels_a_force_alone():
    scene = jc.Scene(dim=3)
    scene.add_particle("bob", mass=2.0, position=(0.0, 0.0, -1.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, IDEAL, 1e-3)
    np.testing.assert_allclose(solution.multipliers, [-19.62])
    wrench = jc.wrench(solution, "rod")
    np.testing.assert_allclose(wrench, [0, 0, 19.62], atol=1e-12)
    back = jc.wrench(solution, "rod", body=jc.WORLD)
    np.testing.assert_allclose(back, [0, 0, -19.62], atol=1e-12)


def test_wrench_from_the_info_of_a_step():
    system, state, solution = solved("revolute-3d-between")
    _, info = jc.step(system, IDEAL, state, None, 1e-3)
    np.testing.assert_allclose(jc.wrench(info, "joint"), jc.wrench(solution, "joint"))


def swing(omega=3.0):
    """A planar physical pendulum, hanging from its pin, with an angular velocity."""
    scene = jc.Scene(dim=2)
    turn = {"velocity": (0.5 * omega, 0.0), "angular_velocity": omega}
    scene.add_body("bob", mass=2.0, inertia=0.1, position=(0.0, -0.5), **turn)
    scene.add(jc.Revolute("pin", jc.WORLD, "bob", point=(0.0, 0.0)))
    return scene.build()


def load(q, v):
    """Returns the force of the pin on the bob of `swing`, by Newton's law on its circle."""
    radius, mass = 0.5, 2.0
    theta, omega = q[2], v[2]
    bend = -mass * 9.81 * radius * np.sin(theta) / (0.1 + mass * radius**2)
    along, inward = (np.cos(theta), np.sin(theta)), (-np.sin(theta), np.cos(theta))
    turned = radius * bend * np.array(along) + radius * omega**2 * np.array(inward)
    return mass * (turned + np.array([0.0, 9.81]))


EXACT = {
    "explicit": jc.Method(jc.RK4(), jc.stabilizers.Unstabilized()),
    "implicit": jc.Method(jc.integrators.GeneralizedAlpha()),
}


@pytest.mark.parametrize("kind", EXACT)
def test_a_wrench_is_read_where_the_step_found_it(kind):
    """The wrench belongs to the start of an explicit step and to the end of an implicit one."""
    system, state = swing()
    state = jc.init(system, EXACT[kind], state.q, state.v)
    new, info = jc.step(system, EXACT[kind], state, None, 1e-2)
    right, wrong = (state, new) if kind == "explicit" else (new, state)
    np.testing.assert_array_equal(info.state.q, right.q)
    expected = load(np.asarray(right.q), np.asarray(right.v))
    assert np.linalg.norm(expected - load(np.asarray(wrong.q), np.asarray(wrong.v))) > 1e-2
    got = jc.wrench(info, "pin")
    np.testing.assert_allclose(got[:2], expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(jc.multipliers(info, "pin"), got[:2], rtol=1e-12)
    for read in (jc.wrench, jc.multipliers):
        with pytest.raises(TypeError, match=rf"jc\.{read.__name__}\(info, name\)"):
            read(system, "pin")


@pytest.mark.parametrize("kind", EXACT)
def test_a_wrench_recorded_in_a_rollout_is_that_of_the_state_it_belongs_to(kind):
    """`record` gets the state after a step; a wrench uses the state of the info."""
    system, state = swing()
    state = jc.init(system, EXACT[kind], state.q, state.v)

    def record(s, info):
        place = info.state
        return jc.wrench(info, "pin"), place.q, place.v

    _, (wrench, q, v) = jc.rollout(system, EXACT[kind], state, None, 1e-2, 20, record=record)
    expected = [load(*x) for x in zip(np.asarray(q), np.asarray(v), strict=True)]
    np.testing.assert_allclose(wrench[:, :2], expected, rtol=1e-7, atol=1e-7)


def test_the_derivative_of_a_wrench_is_that_at_the_place_of_its_multipliers():
    system, state = swing()

    def pull(omega):
        v = jnp.stack([0.5 * omega, jnp.zeros_like(omega), omega])
        start = dataclasses.replace(state, v=v)
        return jc.wrench(jc.step(system, EXACT["explicit"], start, None, 1e-2)[1], "pin")[1]

    omegas = jnp.array([1.0, 3.0])  # derivative of m g + m r ω²
    for derivative in (jax.grad, jax.jacfwd):
        slope = jax.jit(jax.vmap(derivative(pull)))(omegas)
        np.testing.assert_allclose(slope, 2 * omegas, rtol=1e-9)


def test_forward_dynamics_knows_its_state():
    """A solution unpacks into three values, also under jit, and works with batch axes."""
    system, state = swing()
    new, _ = jc.step(system, IDEAL, state, None, 1e-2)
    forward = jax.jit(lambda s: jc.forward_dynamics(system, s, None, IDEAL, 1e-2))
    solution = forward(state)
    assert isinstance(solution, jc.solvers.Solution)
    acceleration, multipliers, status = solution
    assert (acceleration.shape, multipliers.shape, status.shape) == ((3,), (2,), ())
    batch = jax.tree.map(lambda *x: jnp.stack(x), state, new)
    solutions = jax.vmap(forward)(batch)
    loads = jc.wrench(solutions, "pin", system=system)
    expected = jc.wrench(jc.forward_dynamics(system, state, None, IDEAL, 1e-2), "pin")
    np.testing.assert_allclose(loads[0], expected, atol=1e-12)
    assert jc.multipliers(solutions, "pin").shape == (2, 2)


@pytest.mark.parametrize("recovery", [None, jc.stabilizers.Recovery()])
@pytest.mark.parametrize("kind", EXACT)
def test_a_step_that_failed_has_the_wrench_zero(kind, recovery):
    system, state = swing()
    method = dataclasses.replace(EXACT[kind], recovery=recovery)
    state = jc.init(system, method, state.q, state.v)
    state = dataclasses.replace(state, v=state.v.at[0].set(jnp.nan))
    _, info = jc.step(system, method, state, None, 1e-2)
    np.testing.assert_array_equal(info.state.q, state.q)
    np.testing.assert_array_equal(jc.wrench(info, "pin"), 0)


def test_wrench_of_equal_joints_side_by_side():
    """Three lamps of different weights on joints of one kind: each wrench is that of its lamp."""
    scene = jc.Scene(dim=2)
    for i in range(3):
        scene.add_body(f"lamp{i}", mass=1.0 + i, inertia=0.1, position=(i, 0))
        scene.add(jc.Fixed(f"bolt{i}", jc.WORLD, f"lamp{i}"))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, IDEAL, 1e-3)
    for i in range(3):
        got = jc.wrench(solution, f"bolt{i}")
        np.testing.assert_allclose(got, [0, 9.81 * (1 + i), 0], atol=1e-10)


@pytest.mark.parametrize(
    ("name", "body", "match"),
    [("door", None, "'door' is unknown.*'joint'"), ("joint", "lamp", "'joint' acts on.*'lamp'")],
)
def test_wrench_of_something_else(name, body, match):
    system, state, solution = solved("revolute-2d-between")
    with pytest.raises(ValueError, match=match):
        jc.wrench(solution, name, body=body)


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_by_hand(dim):
    """½ m v² + ½ ω·Iω + m g h, for a body whose frame is not at its center of mass."""
    built = scenes.build(f"fixed-{dim}d-between")
    system, state = built.system, built.state
    kinetic = potential = 0.0
    for name in ("first", "second"):
        p = system.params[name]
        motion = system.principal_motion(name, state.q, state.v)
        omega = np.atleast_1d(motion.angular_velocity)
        kinetic += float(p["mass"]) * np.sum(np.square(motion.velocity)) / 2
        kinetic += np.sum(np.asarray(p["inertia"]) * omega**2) / 2
        potential += float(p["mass"]) * 9.81 * float(motion.position[-1])
    energy = jc.energy(system, state)
    np.testing.assert_allclose(energy.kinetic, kinetic, rtol=IDENTITY)
    np.testing.assert_allclose(energy.potential, potential, rtol=IDENTITY)


def test_energy_of_generalized_coordinates():
    built = scenes.build("polar")
    at = dataclasses.replace(built.state, v=jnp.asarray([0.3, -0.8]))
    r, angle = np.asarray(at.q)
    energy = jc.energy(built.system, at)
    np.testing.assert_allclose(energy.kinetic, 0.75 * (0.09 + r**2 * 0.64), rtol=IDENTITY)
    np.testing.assert_allclose(energy.potential, -1.5 * 9.81 * r * np.cos(angle), rtol=IDENTITY)


@pytest.mark.parametrize("dim", [2, 3])
def test_points_move_with_their_body(dim):
    built = scenes.build(f"mixed-{dim}d")
    system, s, h = built.system, built.off, 1e-6
    point = np.arange(1.0, dim + 1)
    ahead, behind = (dataclasses.replace(s, q=system.retract(s.q, x * s.v)) for x in (h, -h))
    for name in ("first", "second"):
        slope = jc.position(system, ahead, name, point) - jc.position(system, behind, name, point)
        got = jc.velocity(system, s, name, point)
        np.testing.assert_allclose(got, slope / (2 * h), rtol=1e-6, atol=1e-6)


def test_a_particle_has_no_orientation():
    built = scenes.build("mixed-2d")
    for question in (jc.orientation, jc.angular_velocity):
        with pytest.raises(ValueError, match="'bob' is a particle"):
            question(built.system, built.state, "bob")


def test_violation_by_name():
    built = scenes.build("mixed-2d")
    rows = scenes.linearized(built.system, built.off.q, built.off.v, built.off.time)
    violation = jc.violation(built.system, built.off)
    index = rows.layout.rows("hinge")
    np.testing.assert_allclose(violation["hinge"], np.linalg.norm(rows.residual[index]))
    np.testing.assert_allclose(violation.rate("hinge"), np.linalg.norm(rows.rate[index]))
    np.testing.assert_allclose(violation.worst, np.max(np.abs(rows.residual)))
    np.testing.assert_allclose(violation.worst_rate, np.max(np.abs(rows.rate)))
    index = rows.layout.rows("skate")  # a velocity-level constraint
    np.testing.assert_allclose(violation["skate"], np.linalg.norm(rows.rate[index]))
    with pytest.raises(ValueError, match="'door' is unknown.*'hinge'"):
        violation["door"]


def test_the_wrench_on_a_fixed_body_is_asked_for_by_its_own_name():
    scene = jc.Scene(dim=2)
    for name in ("wall", "other"):
        scene.add_body(name, fixed=True)
    scene.add_body("arm", mass=2.0, inertia=1.0, position=(1.0, 0.0))
    scene.add(jc.Revolute("hinge", "wall", "arm", point=(0.0, 0.0)))
    system, state = scene.build()
    solution = jc.forward_dynamics(system, state, None, jc.Method(), 1e-3)
    on_arm = jc.wrench(solution, "hinge")
    np.testing.assert_allclose(jc.wrench(solution, "hinge", "wall"), -on_arm)
    for name in ("other", jc.WORLD):
        with pytest.raises(ValueError, match="'wall', 'arm'"):
            jc.wrench(solution, "hinge", name)


def test_violation_of_a_trajectory_is_that_of_its_states():
    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob", length=1.1))
    system, state = scene.build()
    method = jc.Method(stabilizer=jc.Baumgarte.critical(50.0))
    _, seen = jc.rollout(system, method, state, None, 1e-3, 4, record=lambda s, i: (s, i))
    states, infos = seen
    expected = [float(abs(np.linalg.norm(q) - 1.1)) for q in (state.q, *states.q[:3])]
    np.testing.assert_allclose(infos.violation["rod"], expected, rtol=1e-9)
    np.testing.assert_allclose(infos.violation.worst, expected, rtol=1e-9)


def test_accelerations_of_a_batch_of_infos():
    built = scenes.build("revolute-3d-between")
    system, name = built.system, built.system.layout.bodies[-1]

    def stepped(speed):
        state = dataclasses.replace(built.state, v=speed * jnp.ones_like(built.state.v))
        return jc.step(system, IDEAL, state, None, 1e-3)[1]

    speeds = jnp.array([0.1, 0.4])
    infos = jax.vmap(stepped)(speeds)
    for read in (jc.acceleration, jc.angular_acceleration):
        rows = read(infos, name, system=system)
        for row, speed in zip(rows, speeds, strict=True):
            np.testing.assert_allclose(row, read(stepped(speed), name), rtol=IDENTITY, atol=1e-12)


@pytest.mark.parametrize(
    "read",
    ["position", "velocity", "orientation", "angular_velocity", "momentum", "center_of_mass"],
)
def test_readers_of_bodies_refuse_generalized_coordinates_by_their_name(read):
    built = scenes.build("polar")
    args = ["bob"] if read not in ("momentum", "center_of_mass") else []
    with pytest.raises(TypeError, match=f"^{read}: generalized coordinates have no bodies"):
        getattr(jc, read)(built.system, built.state, *args)


def test_readers_name_themselves_in_errors():
    built = scenes.build("revolute-2d-between")
    name = built.system.layout.bodies[-1]
    with pytest.raises(ValueError, match="^velocity: point must have shape"):
        jc.velocity(built.system, built.state, name, (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="^coordinate_rate: joint 'none' is unknown"):
        jc.coordinate_rate(built.system, built.state, "none")
    with pytest.raises(ValueError, match="^angular_momentum: bodies must be different"):
        jc.angular_momentum(built.system, built.state, [name, name])


@pytest.mark.parametrize(
    ("result", "error"),
    [(lambda q, t, p: None, TypeError), (lambda q, t, p: q, ValueError)],
)
def test_a_potential_that_returns_no_number_is_refused(result, error):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones(2), force=lambda q, v, t, u, p: -q, potential=result
    )
    state = jc.init(system, jc.Method(), jnp.ones(2), jnp.zeros(2))
    with pytest.raises(error, match="^GeneralizedSystem: potential must return"):
        jc.energy(system, state)


def test_a_reaction_names_itself_in_errors():
    built, coordinates = scenes.build("revolute-2d-between"), scenes.build("polar")
    with pytest.raises(TypeError, match="^reaction: generalized coordinates have no bodies"):
        jc.reaction(coordinates.system, coordinates.state, "rod")
    with pytest.raises(ValueError, match="^reaction: dt must be"):
        jc.reaction(built.system, built.state, "joint", dt=-1.0)
