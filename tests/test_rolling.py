"""Rolling and blades: slip as velocity of material points, and motions with closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from tolerances import IDENTITY

import jaxcon as jc
from jaxcon.constraints.rows import linearize
from jaxcon.core.status import Status

IDEAL = jc.Method(integrator=jc.RK4(), stabilizer=jc.stabilizers.Unstabilized())


def slip_at(a, b, contact):
    """Returns the velocity of b relative to a, of the material points at the contact."""
    return b.point_velocity(b.local_point(contact)) - a.point_velocity(a.local_point(contact))


def pieces(name):
    """Returns rows, joint parameters, and motions of both bodies, off the constraints."""
    built = scenes.build(name)
    s = built.off
    rows = scenes.linearized(built.system, s.q, s.v, s.time)
    a, b = (built.system.principal_motion(body, s.q, s.v) for body in ("first", "second"))
    return rows, built.system.params["joint"], a, b


def compare(rows, p, a, slip, expected):
    """Checks φ, then φ̇ and ψ against the slip along the normal n and the tangents."""
    index = rows.layout.rows("joint")
    n, u, w = (a.direction(p[key]) for key in ("normal", "first_a", "second_a"))
    held = len(expected)
    np.testing.assert_allclose(rows.residual[index[:held]], expected, atol=IDENTITY)
    rates = rows.rate[index]
    np.testing.assert_allclose(rates[0], n @ slip, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(rates[held : held + 2], [u @ slip, w @ slip], rtol=1e-10, atol=1e-10)


def test_slip_of_a_ball_is_that_of_its_contact():
    rows, p, a, b = pieces("rolling_sphere-3d-between")
    n, c = a.direction(p["normal"]), b.point(p["anchor_b"])
    height = n @ (c - a.point(p["anchor_a"])) - p["radius"]
    compare(rows, p, a, slip_at(a, b, c - p["radius"] * n), [height])


def test_slip_of_a_disc_is_that_of_its_lowest_point():
    rows, p, a, b = pieces("rolling_disc-3d-between")
    n, e, c = a.direction(p["normal"]), b.direction(p["axis"]), b.point(p["anchor_b"])
    rim = [np.cross(e, x) for x in (n, np.cross(e, n))]
    rim = [x / np.linalg.norm(x) for x in rim]
    around = np.linspace(0, 2 * np.pi, 100_001)
    heights = n @ (np.outer(rim[0], np.cos(around)) + np.outer(rim[1], np.sin(around)))
    lowest = p["radius"] * np.min(heights)
    s = (n - (n @ e) * e) / np.linalg.norm(n - (n @ e) * e)
    np.testing.assert_allclose(-p["radius"] * n @ s, lowest, rtol=1e-8)
    height = n @ (c - a.point(p["anchor_a"])) - p["radius"] * n @ s
    compare(rows, p, a, slip_at(a, b, c - p["radius"] * s), [height])


def test_slip_of_a_cylinder_is_that_of_its_line():
    rows, p, a, b = pieces("rolling_cylinder-3d-between")
    n, e, c = a.direction(p["normal"]), b.direction(p["axis"]), b.point(p["anchor_b"])
    height = n @ (c - a.point(p["anchor_a"])) - p["radius"]
    compare(rows, p, a, slip_at(a, b, c - p["radius"] * n), [height, n @ e])
    spin = b.rotation @ b.angular_velocity - a.rotation @ a.angular_velocity
    np.testing.assert_allclose(rows.rate[rows.layout.rows("joint")[-1]], n @ spin, rtol=1e-12)


def test_slip_of_a_wheel_in_the_plane():
    rows, p, a, b = pieces("rolling_disc-2d-between")
    n, t, c = a.direction(p["normal"]), a.direction(p["first_a"]), b.point(p["anchor_b"])
    slip = slip_at(a, b, c - p["radius"] * n)
    height = n @ (c - a.point(p["anchor_a"])) - p["radius"]
    first, second = rows.layout.rows("joint")
    np.testing.assert_allclose(rows.residual[first], height, rtol=1e-12)
    np.testing.assert_allclose([rows.rate[first], rows.rate[second]], [n @ slip, t @ slip])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_blade_slips_to_its_left_only(dim):
    rows, p, a, b = pieces(f"knife_edge-{dim}d-between")
    c, e = b.point(p["anchor_b"]), b.direction(p["edge"])
    slip, index = slip_at(a, b, c), rows.layout.rows("joint")
    if dim == 2:
        left = jnp.stack([-e[1], e[0]])
    else:
        n = a.direction(p["normal"])
        left = jnp.cross(n, e) / jnp.linalg.norm(jnp.cross(n, e))
        height = n @ (c - a.point(p["anchor_a"]))
        np.testing.assert_allclose(rows.residual[index[0]], height, rtol=1e-12)
        np.testing.assert_allclose(rows.rate[index[0]], n @ slip, rtol=1e-10)
    np.testing.assert_allclose(rows.rate[index[-1]], left @ slip, rtol=1e-10)


def on_a_slope(dim, shape, slope=0.3):
    """A solid at rest on a plane inclined in the x direction."""
    gravity = np.zeros(dim)
    gravity[0], gravity[-1] = 9.81 * np.sin(slope), -9.81 * np.cos(slope)
    scene = jc.Scene(dim=dim, gravity=gravity)
    place = (0.0,) * (dim - 1) + (0.2,)
    moments = {2: 0.5 * 0.04, 3: (0.01, 0.02, 0.01)}[dim]
    scene.add_body("solid", mass=1.0, inertia=moments, position=place)
    joint = {
        "disc": jc.joints.RollingDisc,
        "cylinder": jc.joints.RollingCylinder,
        "sphere": jc.joints.RollingSphere,
    }
    axis = {} if dim == 2 or shape == "sphere" else {"axis": (0.0, 1.0, 0.0)}
    scene.add(joint[shape]("roll", jc.WORLD, "solid", radius=0.2, **axis))
    return scene.build()


@pytest.mark.parametrize(
    ("dim", "shape"), [(2, "disc"), (3, "disc"), (3, "cylinder"), (3, "sphere")]
)
def test_a_solid_rolls_down_a_slope(dim, shape):
    """a = g sin α / (1 + I/(m r²)); friction is −m a I/(m r²) and the normal force m g cos α."""
    system, state = on_a_slope(dim, shape)
    solution = jc.forward_dynamics(system, state, None, IDEAL, 1e-3)
    expected = 9.81 * np.sin(0.3) / 1.5
    np.testing.assert_allclose(solution.acceleration[0], expected, rtol=1e-12)
    force = jc.wrench(solution, "roll")[:dim]
    weight = 9.81 * np.cos(0.3)
    np.testing.assert_allclose(force, [-expected / 2, *[0.0] * (dim - 2), weight], atol=1e-12)


def test_a_ball_on_a_driven_turntable():
    """v̇ = (2/7) Ω z × v in the world; a motor turns the table, which is a body."""
    scene = jc.Scene()
    scene.add_body("table", mass=1.0, inertia=(1.0, 1.0, 2.0), angular_velocity=(0.0, 0.0, 2.0))
    start, velocity = np.array([0.5, 0.0, 0.1]), np.array([0.1, 0.2, 0.0])
    # without slip, v + ω × (−r z) = Ω z × x
    spin = ((0.0 + 2.0 * 0.5 - 0.2) / 0.1, 0.1 / 0.1, 0.3)
    ball = jc.inertia.sphere(1.0, 0.1)
    scene.add_body("ball", inertia=ball, position=start, velocity=velocity, angular_velocity=spin)
    scene.add(jc.Revolute("shaft", jc.WORLD, "table", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)))
    scene.add(jc.joints.Drive("motor", "shaft", turning, params={"speed": 2.0}))
    scene.add(jc.joints.RollingSphere("roll", "table", "ball", radius=0.1))
    system, state = scene.build()
    violation = jc.violation(system, state)
    assert violation.worst < 1e-14
    assert violation.worst_rate < 1e-14
    final = jax.jit(lambda s: jc.rollout(system, IDEAL, s, None, 2e-3, 500)[0])(state)
    angle = 2.0 * 2 / 7
    c, s = np.cos(angle), np.sin(angle)
    expected = np.array([[c, -s], [s, c]]) @ velocity[:2]
    np.testing.assert_allclose(jc.velocity(system, final, "ball")[:2], expected, atol=1e-9)


def turning(t, p):
    return p["speed"] * t


def test_errors_of_both_kinds_are_fed_back_and_read_by_name():
    """φ̈ + 2α φ̇ + β² φ = 0 for the contact, and ψ̇ = −2α ψ for the slip."""
    scene = jc.Scene(dim=2, gravity=(0.0, 0.0))
    scene.add_body("wheel", mass=1.0, inertia=0.02, position=(0.0, 0.25), velocity=(1.0, 0.0))
    scene.add(jc.joints.RollingDisc("roll", jc.WORLD, "wheel", radius=0.2, point=(0.0, 0.0)))
    system, state = scene.build()
    method = jc.Method(integrator=jc.RK4(), stabilizer=jc.Baumgarte.critical(rate=4.0))
    for _ in range(5):
        state, _ = jc.step(system, method, state, None, 0.01)
    violation, decay = jc.violation(system, state), 4.0 * 0.05
    np.testing.assert_allclose(violation["roll"], 0.05 * (1 + decay) * np.exp(-decay), rtol=1e-6)
    slip = violation.velocity[violation.layout.rows("roll")[1]]
    np.testing.assert_allclose(slip, -np.exp(-2 * decay), rtol=1e-6)
    assert violation.layout.velocity_level == ()
    assert violation.layout.free == (1,)
    assert violation.worst == violation["roll"]


def test_layout_of_several_wheels_tells_their_rows_apart():
    scene = jc.Scene(dim=2)
    for i in range(3):
        scene.add_body(f"wheel{i}", mass=1.0, inertia=0.02, position=(float(i), 0.2))
        scene.add(jc.joints.RollingDisc(f"roll{i}", jc.WORLD, f"wheel{i}", radius=0.2))
    scene.add(jc.Distance("rod", "wheel0", "wheel1"))
    scene.add(jc.joints.KnifeEdge("skate", jc.WORLD, "wheel2", edge=(1.0, 0.0)))
    system, state = scene.build()
    layout = jc.violation(system, state).layout
    expected = np.ones(layout.size, bool)
    for i in range(3):
        expected[layout.rows(f"roll{i}")[1]] = False
    expected[layout.rows("skate")] = False
    np.testing.assert_array_equal(layout.holonomic, expected)
    assert layout.velocity_level == ("skate",)


def disc_at(tilt, dtype=jnp.float64):
    """A disc whose axis is tilted from the normal by an angle [rad]."""
    scene = jc.Scene(dtype=dtype)
    turn = jc.quaternion.from_axis_angle(jnp.asarray([1.0, 0.0, 0.0], dtype), 0.5 * np.pi)
    scene.add_body("disc", mass=1.0, inertia=(0.01, 0.01, 0.02), quaternion=turn)
    scene.add(jc.joints.RollingDisc("roll", jc.WORLD, "disc", radius=0.2, axis=(0.0, 1.0, 0.0)))
    system, state = scene.build()
    lean = jnp.asarray([tilt, 0.0, 0.0], dtype)
    turned = jc.quaternion.multiply(jc.quaternion.exp(lean), jnp.eye(4, dtype=dtype)[0])
    q = state.q.at[3:].set(turned)
    return system, dataclasses.replace(state, q=q, v=jnp.ones_like(state.v))


def numbers_of_rows(system, q, v):
    rows = linearize(system, q, v, jnp.zeros((), q.dtype))
    return rows.residual, rows.rate, rows.jacobian.dense(), rows.bias


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_rows_of_a_disc_are_finite_upright_flat_and_next_to_it(dtype):
    """After the rotation at assembly the axis is z in the body.

    The identity orientation lies flat.
    """
    with jax.numpy_dtype_promotion("standard"):
        system, state = disc_at(0.0, jnp.dtype(dtype))
        tilts = jnp.asarray([0.0, 1e-7, 1e-3, np.pi / 2, np.pi], dtype)
        lean = jax.vmap(lambda x: jc.quaternion.exp(jnp.stack([x, 0 * x, 0 * x])))(tilts)
    q = jnp.concatenate([jnp.zeros((5, 3), dtype), lean], axis=1)

    def rows(q):
        return numbers_of_rows(system, q, state.v)

    for derivative in (rows, jax.jacrev(rows), jax.jacfwd(rows)):
        for leaf in jax.tree.leaves(jax.jit(jax.vmap(derivative))(q)):
            assert jnp.all(jnp.isfinite(leaf))
    flat = rows(q[0])
    np.testing.assert_allclose(flat[2][0, :3], [0, 0, 1], atol=1e-6)


def test_a_blade_on_its_tip_has_no_direction_and_is_finite():
    scene = jc.Scene()
    scene.add_body("skate", mass=1.0, inertia=(1.0, 1.0, 1.0))
    scene.add(jc.joints.KnifeEdge("blade", jc.WORLD, "skate", edge=(1.0, 0.0, 0.0)))
    system, state = scene.build()
    up = jc.quaternion.from_axis_angle(jnp.asarray([0.0, 1.0, 0.0]), -np.pi / 2)
    exact = jnp.asarray([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0])
    for turn in (up, exact):
        q = jnp.concatenate([jnp.zeros(3), turn])
        value, slope = jax.jacrev(numbers_of_rows, 1), jax.jacfwd(numbers_of_rows, 1)
        for f in (numbers_of_rows, value, slope):
            for leaf in jax.tree.leaves(f(system, q, jnp.ones_like(state.v))):
                assert jnp.all(jnp.isfinite(leaf))


def test_gradients_of_rolling_at_rest_and_upright():
    """Central differences of a rollout that starts at rest."""
    system, state = on_a_slope(3, "disc")

    def travelled(radius):
        changed = system.with_params({"roll": {"radius": radius}})
        return jc.rollout(changed, jc.Method(), state, None, 1e-3, 20)[0].q[0]

    h, run = 1e-4, jax.jit(travelled)
    slope = (run(0.2 + h) - run(0.2 - h)) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(travelled))(0.2), slope, rtol=1e-5)


def test_energy_of_rolling_converges_to_a_constant_with_the_order():
    """An ideal velocity constraint does no work, so the energy error is that of the integrator."""
    scene = jc.Scene()
    lean = jc.quaternion.from_axis_angle(jnp.asarray([1.0, 0.0, 0.0]), 0.2)
    axis = np.array([0.0, np.cos(0.2), np.sin(0.2)])
    arm = 0.5 * np.array([0.0, np.sin(0.2), -np.cos(0.2)])
    omega_b = np.array([0.4, 6.0, 0.0])
    matrix = np.asarray(jc.quaternion.matrix(lean))
    velocity = -np.cross(matrix @ omega_b, arm)
    scene.add_body(
        "disc",
        mass=2.0,
        inertia=(0.125, 0.25, 0.125),
        position=-arm,
        quaternion=lean,
        velocity=velocity,
        angular_velocity=omega_b,
    )
    scene.add(jc.joints.RollingDisc("roll", jc.WORLD, "disc", radius=0.5, axis=axis))
    system, state = scene.build()
    assert jc.violation(system, state).worst_rate < 1e-14
    before = jc.energy(system, state).total
    for integrator, order, steps in ((jc.integrators.Heun(), 2, 200), (jc.RK4(), 4, 100)):
        method = jc.Method(integrator=integrator, stabilizer=jc.stabilizers.Unstabilized())

        @jax.jit
        def loss(steps, method=method):
            def one(_, s):
                return jc.step(system, method, s, None, 0.5 / steps)[0]

            return jc.energy(system, jax.lax.fori_loop(0, steps, one, state)).total - before

        lost = np.abs([float(loss(steps * 2**k)) for k in range(3)])
        found = np.log2(lost[:-1] / lost[1:])
        assert np.all(found > order - 0.3), (lost, found)
        assert lost[-1] < 1e-3
    assert state.status == Status.OK
