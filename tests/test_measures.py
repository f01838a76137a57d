"""Coordinates of joints without rows: angles of rotation, thrusters and tendons.

Their rates and biases are compared with automatic differentiation of their values and rates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import DERIVATIVE

import jaxcon as jc
from jaxcon.constraints.base import blocks_of
from jaxcon.linear.jacobian import Jacobian
from jaxcon.system import coordinates

DT = 1e-3


def bodies(dtype=None, **gravity):
    """Three bodies in space without joints."""
    scene = jc.Scene(dim=3, dtype=dtype, **gravity)
    for i, name in enumerate("abc"):
        turn = jc.quaternion.exp(jnp.array([0.3, -0.2 * i, 0.1], scene.dtype))
        scene.add_body(
            name,
            mass=1.0 + i,
            inertia=(0.3, 0.4, 0.5 + 0.1 * i),
            position=(0.4 * i, 0.1, -0.2),
            quaternion=turn,
        )
    return scene


ENDS = {"point_a": (0.3, 0.3, -0.4), "point_b": (1.3, 0, -0.3)}
WRAPS = {"sphere": {}, "cylinder": {"axis": (0.2, 1, 0)}}
ELEMENTS = {
    "angle": [jc.joints.RotationAngle("x", "a", "b")],
    "angle in the world": [jc.joints.RotationAngle("x", jc.WORLD, "b")],
    "thrust": [jc.joints.Thrust("x", "a", "b", (0.2, 0.3, 0), (1, 2, 0), (0.3, 0, 1))],
    "thrust in the world": [jc.joints.Thrust("x", jc.WORLD, "b", (0.2, 0.3, 0), (1, 2, 0))],
    "tendon": [
        jc.joints.Span("there", "a", "b", (0, 0, 0), (0.5, 0.2, 0.3)),
        jc.joints.Span("on", "b", "c", (0.5, 0.2, 0.3), (1, 0.1, 0.4)),
        jc.joints.RotationAngle("turn", jc.WORLD, "c"),
        jc.joints.Tendon("x", ("there", "on", "turn"), (1.0, 0.5, -0.3)),
    ],
    **{
        f"wrapped {name}": [
            jc.joints.WrappedSpan("span", "a", "b", "c", 0.3, **ENDS, **given),
            jc.joints.Tendon("x", ("span",)),
        ]
        for name, given in WRAPS.items()
    },
}


def row(system, q, v, joint="x"):
    """Returns value, rate, bias and Jacobian (n_v,) of the only coordinate of a joint."""
    snapshot = system.snapshot(q, v, 0.0)
    where = coordinates.directory(system.constraints)
    end = coordinates.find(system.constraints, where, "test", joint, None)
    found = coordinates.at(coordinates.numbered(system.counted), [end]).read(snapshot)
    places = system.constraints[end[0]].select((end[1],)).places
    jacobian = Jacobian(tuple(blocks_of(system, places, [found], 0)), (1, v.shape[0]))
    return found.value[0], found.rate[0], jnp.broadcast_to(found.bias, (1,))[0], jacobian.dense()[0]


@pytest.mark.parametrize("name", ELEMENTS)
def test_rates_and_biases_are_derivatives(name):
    scene = bodies()
    for element in ELEMENTS[name]:
        scene.add(element)
    system, state = scene.build()

    def compare(key):
        """Returns pairs of numbers that must be equal, at a random state."""
        keys = jax.random.split(key)
        q = system.retract(state.q, jax.random.uniform(keys[0], state.v.shape, minval=-0.7))
        v = jax.random.normal(keys[1], state.v.shape)
        slopes = system.kinematics(q, v), jnp.zeros_like(v)
        found, change = jax.jvp(lambda *x: row(system, *x)[:2], (q, v), slopes)
        value, rate, bias, jacobian = row(system, q, v)
        along = rate if "thrust" in name else change[0]  # the value of a thrust is zero
        return (rate, bias, jacobian @ v), (along, change[1], found[1])

    keys = jax.random.split(jax.random.key(0), 100)
    got, expected = jax.jit(jax.vmap(compare))(keys)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_allclose(x, y, atol=DERIVATIVE)


def test_a_rotation_angle_and_its_force_at_assembly_are_zero():
    scene = bodies()
    scene.add(jc.joints.RotationAngle("x", "a", "b"))
    system, state = scene.build()
    v = jnp.ones_like(state.v)
    slopes = jax.jacrev(lambda q: row(system, q, v)[:3])(state.q)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slopes))
    np.testing.assert_array_equal(row(system, state.q, v)[3], 0)


def test_a_ball_joint_stops_at_its_largest_angle():
    """A pendulum on a ball joint falls and stops at 0.5 rad, in float32 and in batches."""
    scene = jc.Scene(dim=3, dtype=jnp.float32)
    scene.add_body("rod", mass=1.0, inertia=(0.1, 0.1, 0.01), position=(0.3, 0.2, 0.5))
    scene.add(jc.Spherical("ball", jc.WORLD, "rod", point=(0, 0, 0)))
    scene.add(jc.joints.RotationAngle("turn", jc.WORLD, "rod", (0, 0, 0)))
    scene.add(jc.Limit("cone", "turn", upper=0.5))
    system, state = scene.build()

    def fall(speed):
        start = state.replace(v=state.v.at[5].set(speed))
        end, _ = jc.rollout(system, jc.Method(), start, None, 5e-3, 200)
        return jc.coordinate(system, end, "turn"), end.status

    angles, status = jax.jit(jax.vmap(fall))(jnp.array([0.0, 1.0, -1.0], jnp.float32))
    assert not np.any(status)
    np.testing.assert_allclose(angles, 0.5, atol=1e-4)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_thruster_accelerates_a_body(dtype):
    """The force acts along the body's axis; its gradient by the control is the acceleration."""
    scene = bodies(dtype, gravity=(0, 0, 0))
    scene.add(jc.joints.Thrust("jet", jc.WORLD, "a", force=(0, 0, 2), torque=(0, 0.5, 0)))
    scene.add(jc.Motor("engine", "jet", gear=3.0))
    system, state = scene.build()

    def lifted(u):
        info = jc.forward_dynamics(system, state, u[None], jc.Method(), DT)
        return info.acceleration[system.layout.v("a")][:3]

    u = jnp.asarray(0.7, dtype)
    np.testing.assert_allclose(jax.jit(lifted)(u), [0, 0, 6 * u], atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(lifted))(u), [0, 0, 6], atol=1e-6)


def arm(dtype, *elements, dim=3):
    """A double pendulum in the x-y plane."""
    scene = jc.Scene(dim=dim, gravity=(0, -9.81, 0)[:dim], dtype=dtype)
    axis = (0, 0, 1) if dim == 3 else None
    for i, above in enumerate((jc.WORLD, "link 0")):
        at = (0.5 + i, 0, 0) if dim == 3 else (0.5 + i, 0)
        inertia = (0.01, 0.1, 0.1) if dim == 3 else 0.1
        scene.add_body(f"link {i}", mass=1.0, inertia=inertia, position=at)
        hinge = (float(i), 0, 0) if dim == 3 else (float(i), 0)
        scene.add(jc.Revolute(f"hinge {i}", above, f"link {i}", point=hinge, axis=axis))
    for element in elements:
        scene.add(element)
    return scene.build()


TENDON = jc.joints.Tendon("tendon", ("hinge 0", "hinge 1"), (0.3, -0.2))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_elements_act_on_tendons(dim, dtype):
    """Motor, spring and damper act by their moment arms; the gradient by an arm is exact."""
    elements = (
        jc.Motor("motor", "tendon", gear=2.0),
        jc.forces.DeadBandSpring("spring", "tendon", 30.0, 0.05, 0.1, damping=0.4),
    )
    system, state = arm(dtype, TENDON, *elements, dim=dim)
    plain, _ = arm(dtype, *(jc.Motor(f"motor {i}", f"hinge {i}") for i in (0, 1)), dim=dim)
    v = state.v.at[-1].set(0.3)
    q = system.retract(state.q, state.v.at[-1].set(-0.7))
    state = state.replace(q=q, v=v)

    def accelerations(arms, u):
        changed = system.with_params({"tendon": {"coefficients": arms}})
        found = jc.forward_dynamics(changed, state, u[None], jc.Method(), DT)
        length = jc.coordinate(changed, state, "tendon")
        rate = jc.coordinate_rate(changed, state, "tendon")
        spring = -30 * (length - jnp.clip(length, 0.05, 0.1)) - 0.4 * rate
        plainly = state.replace(turns=())
        given = plain, plainly, arms * (2 * u + spring), jc.Method(), DT
        return found.acceleration, jc.forward_dynamics(*given).acceleration

    given = jnp.array([0.3, -0.2], dtype), jnp.asarray(1.5, dtype)
    both = jax.jit(lambda *x: (accelerations(*x), jax.jacfwd(accelerations)(*x)))
    (got, expected), slopes = both(*given)
    tolerance = 1e-9 if dtype == jnp.float64 else 2e-4
    np.testing.assert_allclose(got, expected, atol=tolerance * 50)
    np.testing.assert_allclose(*slopes, atol=tolerance * 500)
    energy = jc.energy(system, state).potential
    energy -= jc.energy(plain, state.replace(turns=())).potential
    length = jc.coordinate(system, state, "tendon")
    np.testing.assert_allclose(energy, 15 * max(length - 0.1, 0) ** 2, rtol=1e-4)


@pytest.mark.parametrize("solver", [None, jc.solvers.GaussSeidel(), jc.solvers.InteriorPoint()])
def test_a_tendon_ends_rubs_and_couples(solver):
    """A falling arm is held by a limit and dry friction of tendons, for all contact solvers."""
    other = jc.joints.Tendon("other", ("hinge 0", "hinge 1"), (1.0, 0.5))
    elements = (
        jc.Limit("end", "tendon", lower=-0.2, upper=0.1),
        jc.contacts.JointFriction("rub", "other", 0.5),
    )
    system, state = arm(None, TENDON, other, *elements)
    method = jc.Method(contact_solver=solver)
    run = jax.jit(jax.vmap(lambda s: jc.rollout(system, method, s, None, 2e-3, 150)[0]))
    state = jc.init(system, method, state.q, state.v)
    end = run(jax.tree.map(lambda x: jnp.stack([x, x]), state))
    assert not np.any(end.status)
    length = jc.coordinate(system, end[0], "tendon")
    np.testing.assert_allclose(length, -0.2, atol=1e-3)


def test_a_coupling_of_tendons_holds():
    other = jc.joints.Tendon("other", ("hinge 0",), (0.5,))
    gear = jc.joints.Gear("gear", "tendon", "other", ratio=2.0)
    system, state = arm(None, TENDON, other, gear)
    end, info = jc.rollout(system, jc.Method(), state, None, 2e-3, 150)
    first, second = (jc.coordinate(system, end, x) for x in ("tendon", "other"))
    assert abs(first) > 0.01
    np.testing.assert_allclose(second, 2 * first, atol=1e-5)


def test_tendons_of_one_kind_share_their_code():
    tendons = [jc.joints.Tendon(f"t{i}", ("hinge 0", "hinge 1"), (1, i)) for i in range(5)]
    springs = [jc.forces.JointSpring(f"s{i}", f"t{i}", 1.0) for i in range(5)]
    system, state = arm(None, *tendons, *springs)
    assert [group.names for group in system.forces] == [("s0", "s1", "s2", "s3", "s4")]
    assert len(system.constraints) == 3
    assert jnp.shape(jc.coordinate(system, state, "t3")) == ()


@pytest.mark.parametrize(
    ("tendon", "match"),
    [
        (jc.joints.Tendon("t", ()), "joints must be a tuple with at least one name, got \\(\\)"),
        (jc.joints.Tendon("t", ("nothing",)), "joint 'nothing' is unknown"),
        (jc.joints.Tendon("t", ("hinge 0",), (1, 2)), "coefficients must have shape \\(1,\\)"),
        (jc.joints.Tendon("t", ("hinge 0",), (1,), ("a", "b")), "coordinate_names must be 1 names"),
        (jc.joints.Tendon("t", ("hinge 0",) * 2), "couples a coordinate with itself"),
    ],
)
def test_wrong_tendons_are_named(tendon, match):
    with pytest.raises(ValueError, match=match):
        arm(None, tendon)


def test_a_dead_band_is_not_reversed():
    with pytest.raises(ValueError, match="lower must not be above upper, got 0.2 and 0.1"):
        arm(None, TENDON, jc.forces.DeadBandSpring("s", "tendon", 1.0, 0.2, 0.1))


def test_a_span_wraps_around_a_cylinder():
    """A screw line between two straight lines, by hand; a straight line where it misses."""
    scene = bodies()
    given = jc.WORLD, jc.WORLD, "a", 0.3, (0, 0, 0), (0, 0, 1)
    ends = {"point_a": (0.5, 0.1, 0.0), "point_b": (-0.5, 0.1, 0.4)}
    scene.add(jc.joints.WrappedSpan("near", *given, **ends))
    ends = {"point_a": (0.5, 0.4, 0.0), "point_b": (-0.5, 0.4, 0.4)}
    scene.add(jc.joints.WrappedSpan("far", *given, **ends))
    params = scene.build()[0].params
    r = np.hypot(0.5, 0.1)
    angle = np.pi - 2 * np.arctan(0.2) - 2 * np.arccos(0.3 / r)
    flat = 2 * np.sqrt(r**2 - 0.09) + 0.3 * angle
    np.testing.assert_allclose(params["near"]["length"], np.hypot(flat, 0.4), rtol=1e-12)
    np.testing.assert_allclose(params["far"]["length"], np.hypot(1, 0.4), rtol=1e-12)
    scene.add(jc.forces.JointSpring("spring", "near", 1.0))
    with pytest.raises(ValueError, match="'near' has several points on one body; add a Tendon"):
        scene.build()


def test_a_wrapped_span_keeps_its_place_on_a_body_whose_center_moves():
    """The length of a span is that of the same points in new principal frames."""
    scene = bodies()
    scene.add(jc.joints.WrappedSpan("span", "a", "b", "c", 0.3, **ENDS))
    scene.add(jc.joints.Tendon("x", ("span",)))
    system, state = scene.build()
    changed = system.with_params({"c": {"center": jnp.array([0.1, 0.2, 0.3])}})
    moved = jc.systems.restate(state, system, changed)
    np.testing.assert_allclose(jc.coordinate(changed, moved, "x"), 0, atol=1e-12)


MASS = '<inertial pos="{} 0.02 -0.2" mass="{}" diaginertia="0.02 0.03 0.025"/>'


def sensed(bodies, rest="", flags="", ignore=()):
    """A MuJoCo model, its data and the same model read by jaxcon."""
    mujoco = pytest.importorskip("mujoco")
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option>{flags}</option>'
        f"<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )
    return mujoco, m, mujoco.MjData(m), jc.from_mjcf(m, ignore)


def compare(model, qpos, qvel=None, ctrl=(), names=None, read=None):
    """Compares sensors with those of MuJoCo, of the same names and at the same state."""
    mujoco, m, data, imported = model
    read = read or imported
    data.qpos[:], data.ctrl[:] = qpos, ctrl
    data.qvel[:] = 0 if qvel is None else qvel
    mujoco.mj_forward(m, data)
    names = names or tuple(read.sensor_slices)
    state, control = read.state(data.qpos, data.qvel), jnp.asarray(data.ctrl)
    info = jc.forward_dynamics(read.system, state, control, read.method(), 1e-3)
    expected = np.concatenate([data.sensordata[read.sensor_slices[name]] for name in names])
    np.testing.assert_allclose(read.sensors(state, info, names=names), expected, atol=1e-9)
    return expected


SUBTREES = "".join(
    f'<{kind} name="{kind} {body}" body="{body}"/>'
    for kind in ("subtreecom", "subtreelinvel", "subtreeangmom")
    for body in ("world", "base", "pad", "mark", "arm", "dot")
)


@pytest.mark.parametrize("mocap", ["", ' mocap="true"'])
def test_sensors_of_subtrees_and_energy_have_the_bodies_that_do_not_move(mocap):
    """A base, a pad on it, and bodies without mass, at which a subtree is the body alone."""
    bodies = (
        f'<body name="base" pos="0.3 0.2 0.5" euler="0.3 0.2 0.1"{mocap}>{MASS.format(0.1, 1.3)}'
        f'<body name="pad" pos="0 0.4 0">{MASS.format(0.2, 0.7)}</body>'
        '<body name="mark" pos="0.1 0.5 0.2"/></body>'
        f'<body name="arm" pos="0 0 1"><joint axis="0 1 0.2"/>{MASS.format(0.3, 1.1)}'
        f'<body name="dot" pos="0.2 0.3 0"/></body>'
    )
    if not mocap:  # the arm stands on the base, so that the base's subtree moves
        bodies = bodies.replace('</body><body name="arm"', '<body name="arm"') + "</body>"
    rest = f"<sensor>{SUBTREES}<e_potential/></sensor>"
    model = sensed(bodies, rest, ignore=("mocap",) if mocap else ())
    expected = compare(model, [0.4], [0.7])
    assert np.all(np.isfinite(expected))
    read = model[3]

    def potential(angle):
        return jnp.sum(read.sensors(read.state(angle[None]), names=tuple(read.sensor_slices)))

    assert np.isfinite(jax.grad(potential)(jnp.asarray(0.4)))


def test_the_force_of_an_actuator_is_that_before_the_limit_of_its_joint():
    bodies = f'<body><joint name="j" actuatorfrcrange="-1 1"/>{MASS.format(0.3, 1.1)}</body>'
    sensors = '<actuatorfrc name="own" actuator="m"/><jointactuatorfrc name="joint" joint="j"/>'
    rest = f'<actuator><motor name="m" joint="j" gear="9"/></actuator><sensor>{sensors}</sensor>'
    model = sensed(bodies, rest)
    assert compare(model, [0.1], ctrl=[-1.243], names=("joint",)) == -1
    read = model[3]
    with pytest.raises(NotImplementedError, match="'own'.* a joint with an actuatorfrcrange"):
        read.sensors(read.start, control=jnp.ones(1))


def test_tendon_sensors_have_the_limit_of_the_forces_of_a_tendon():
    bodies = f'<body><joint name="j"/>{MASS.format(0.3, 1.1)}</body>'
    tendon = (
        '<tendon><fixed name="t" actuatorfrcrange="-1 1"><joint joint="j" coef="2"/></fixed>'
        "</tendon>"
    )
    motor = '<general name="m" tendon="t" gear="9" gainprm="3"/>'
    sensors = '<actuatorfrc actuator="m"/><tendonactuatorfrc tendon="t"/>'
    rest = f"{tendon}<actuator>{motor}</actuator><sensor>{sensors}</sensor>"
    compare(sensed(bodies, rest), [0.1], ctrl=[-1.243])


def test_limits_of_a_joint_and_a_tendon_of_one_name_are_told_apart():
    bodies = f'<body><joint name="a" range="-3 -2"/>{MASS.format(0.3, 1.1)}</body>'
    tendon = '<tendon><fixed name="a" range="-3 -0.4"><joint joint="a" coef="1"/></fixed></tendon>'
    sensors = '<jointlimitpos joint="a"/><tendonlimitpos tendon="a"/>'
    expected = compare(sensed(bodies, f"{tendon}<sensor>{sensors}</sensor>"), [0.3])
    np.testing.assert_allclose(expected, [-2.3, -0.7])


def test_contacts_with_similar_names_are_told_apart():
    """A capsule "foot" has two contacts, of which the second is named as that of a ball."""
    bodies = "".join(
        f'<body name="{name}" pos="{x} 0 {height}"><joint type="slide" axis="0 0 1"/>'
        f'<geom name="{name}" type="{kind}" size="{size}" mass="1" euler="0 1.5707963267948966 0"/>'
        f'<site name="{name}" size="1"/></body>'
        for name, kind, size, x, height in (
            ("foot", "capsule", "0.1 0.2", 0, 0.1),
            ("foot 2", "sphere", "0.1", 3, 0.1),
            ("drum", "cylinder", "0.2 0.1", 6, 0.2),
        )
    )
    bodies = '<geom name="floor" type="plane" size="9 9 1"/>' + bodies
    names = ("foot", "foot 2", "drum")
    rest = "".join(f'<touch name="{name}" site="{name}"/>' for name in names)
    read = sensed(bodies, f"<sensor>{rest}</sensor>")[3]
    info = jc.step(read.system, read.method(), read.start, None, 2e-3)[1]
    np.testing.assert_allclose(read.sensors(read.start, info), [9.81] * 3, rtol=1e-6)


def test_sensors_without_a_name_keep_apart_from_sensors_with_theirs():
    bodies = "".join(
        f'<body><joint name="{name}" axis="0 1 0"/>{MASS.format(0.3, 1.1)}</body>' for name in "ab"
    )
    tie = "".join(
        f'<motor {name} joint="{joint}" gear="{gear}"/>'
        for name, joint, gear in (("", "a", 2), ('name="actuator 0"', "b", 3))
    )
    sensors = (
        '<jointpos joint="a"/><jointpos name="sensor 0" joint="b"/>'
        '<actuatorvel name="slow" actuator="actuator 0"/>'
    )
    rest = f"<actuator>{tie}</actuator><sensor>{sensors}</sensor>"
    model = sensed(bodies, rest)
    assert tuple(model[3].sensor_slices) == ("sensor 0 (unnamed)", "sensor 0", "slow")
    expected = compare(model, [0.1, 0.2], [0.3, 0.4], ctrl=[0, 0])
    np.testing.assert_allclose(expected, [0.1, 0.2, 1.2])


def test_sensors_of_actuators_follow_a_changed_gear():
    """A motor with a gain, whose parameter is the product of both, and a servo."""
    bodies = f'<body><joint name="a" axis="0 1 0"/>{MASS.format(0.3, 1.1)}</body>'
    tendon = '<tendon><fixed name="t"><joint joint="a" coef="2"/></fixed></tendon>'
    drives = (
        '<general name="m" joint="a" gainprm="3" gear="2"/>'
        '<position name="s" joint="a" kp="5" kv="0.3" gear="2"/>'
        '<general name="n" tendon="t" gainprm="3" gear="2"/><motor name="z" joint="a" gear="0"/>'
    )
    sensors = "".join(
        f'<actuator{kind} name="{kind} {drive}" actuator="{drive}"/>'
        for drive in "msnz"
        for kind in ("pos", "vel", "frc")
    )
    sensors += '<tendonactuatorfrc tendon="t"/><jointactuatorfrc joint="a"/>'
    rest = f"{tendon}<actuator>{drives}</actuator><sensor>{sensors}</sensor>"
    model = sensed(bodies, rest)
    ctrl = [0.3, 0.4, 0.5, 0.6]
    compare(model, [0.2], [0.3], ctrl)
    changes = {"m": {"gear": 12.0}, "s": {"gear": 4.0}, "n": {"gear": 12.0}}
    read = model[3].with_params(changes)
    model[1].actuator_gear[:3, 0] = 4
    compare(model, [0.2], [0.3], ctrl, read=read)


def test_sensors_of_ignored_limits_and_contacts_are_refused():
    bodies = (
        '<geom type="plane" size="2 2 1"/><body><joint name="a" type="slide" range="1 2"/>'
        '<geom size="0.1" mass="1"/><site name="s" size="1"/></body>'
    )
    sensors = '<jointlimitpos name="stop" joint="a"/><touch name="pressed" site="s"/>'
    rest = f"<sensor>{sensors}</sensor>"
    read = sensed(bodies, rest, ignore=("limit", "contact"))[3]
    for name in ("stop", "pressed"):
        with pytest.raises(NotImplementedError, match=f"'{name}'.*left out by `ignore`"):
            read.sensors(read.start, names=(name,))
    with pytest.raises(ValueError, match=r"must be a sequence of names.*names=\('stop',\)"):
        read.sensors(read.start, names="stop")
    both = '<clock name="time"/><jointlimitpos name="stop" joint="a"/>'
    read = sensed(bodies, f"<sensor>{both}</sensor>", ignore=("limit",))[3]
    with pytest.raises(NotImplementedError, match="model.readings.supported: 'time'\\."):
        read.sensors(read.start)
    assert read.sensors(read.start, names=read.readings.supported) == 0
