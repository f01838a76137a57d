"""Features of models beyond joints, compared with MuJoCo at 100 random states."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.contact.rows import linearize_bounds

mujoco = pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import mjcf_agreement as agreement  # noqa: E402

HAS_ACTIVATIONS = pytest.mark.filterwarnings("ignore:from_mjcf. .* activation:UserWarning")
AGREE = 1e-8
"""Tolerance of accelerations, relative to the largest one of a state."""
BODY = '<inertial pos="0.1 0.02 -0.2" mass="1.3" fullinertia="0.06 0.05 0.04 0.01 0.005 -0.004"/>'
SMALL = '<inertial pos="0 0.1 0" quat="1 0.3 0 0.2" mass="0.7" diaginertia="0.02 0.03 0.025"/>'


def model(bodies, rest="", options=""):
    flag = '<flag contact="disable" limit="disable"/>'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option {options}>{flag}</option>'
        f"<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )


COMPENSATED = (
    f'<body gravcomp="0.7"><joint name="turn" axis="0 1 0"/>{BODY}'
    f'<body name="welded" pos="0.1 0.2 0" gravcomp="-0.4">{SMALL}</body>'
    '<body pos="0 0 1" gravcomp="1"><joint name="out" axis="1 0 0" actuatorgravcomp="true"/>'
    f"{SMALL}</body></body>"
)


def test_gravity_compensation_is_that_of_mujoco():
    m = model(COMPENSATED, '<actuator><motor joint="out"/></actuator>')
    assert agreement.acceleration_error(m) < AGREE


def test_gravity_compensation_can_be_left_out():
    m = model(COMPENSATED, '<actuator><motor joint="out"/></actuator>')
    names = jc.from_mjcf(m).system.params
    assert {"body 1 gravcomp", "welded gravcomp", "body 3 gravcomp"} <= set(names)
    assert not any("gravcomp" in x for x in jc.from_mjcf(m, ignore=("gravcomp",)).system.params)
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    assert not any("gravcomp" in x for x in jc.from_mjcf(m).system.params)


@pytest.mark.parametrize(
    "fluid", ['density="900"', 'viscosity="2"', 'density="1.2" viscosity="0.3" wind="1 -2 3"']
)
def test_drag_is_that_of_mujoco(fluid):
    m = model(COMPENSATED, options=fluid)
    m.jnt_actgravcomp[:] = 0
    assert agreement.acceleration_error(m) < AGREE
    assert not any("drag" in name for name in jc.from_mjcf(m, ignore=("fluid",)).system.params)


SITE = '<site name="{}" pos="0.3 0.1 -0.2" euler="0.4 0.1 0.2"/>'
ON_SITES = (
    f'<site name="ground" pos="0.2 -0.1 0.3" euler="0.1 0.7 0.3"/><body><freejoint/>{BODY}'
    f'{SITE.format("base")}<body pos="0 0 1"><joint type="ball"/>{SMALL}'
    f'<body pos="0.1 0.2 0" euler="0.3 0.5 0.1">{SMALL}{SITE.format("hand")}'
    '<site name="aligned" quat="{}"/></body></body></body>'
)
AT_SITES = """<actuator>
<motor site="hand" gear="1 2 3 0.3 0.2 -0.4"/>
<general site="base" gear="0 0 1 0 2 0" gainprm="2" biastype="affine" biasprm="0.3 -5 -0.7"/>
<general site="base" gear="0 0 0 0 0 0"/>
<position site="hand" refsite="base" gear="1 0.2 -0.5 0 0 0" kp="3" kv="0.4"/>
<position site="hand" refsite="ground" gear="0 2 0 0 0 0" kp="3" forcerange="-2 1"/>
<velocity site="hand" refsite="base" gear="0 0 0 0.3 0.2 1" kv="0.4"/>
<position site="aligned" refsite="base" gear="0 0 0 0 1 0.5" kp="3"/></actuator>
"""


def aligned():
    """Returns the model with sites, of which two are aligned in the reference pose."""
    m = model(ON_SITES.format("1 0 0 0"), AT_SITES)
    data, turn = mujoco.MjData(m), np.zeros(4)
    mujoco.mj_kinematics(m, data)
    body, base = (data.site(name).xmat.reshape(3, 3) for name in ("aligned", "base"))
    mujoco.mju_mat2Quat(turn, (body.T @ base).ravel())
    return model(ON_SITES.format(" ".join(map(repr, map(float, turn)))), AT_SITES)


def test_actuators_at_sites_are_those_of_mujoco():
    assert agreement.acceleration_error(aligned()) < AGREE


def test_the_rotation_of_a_ball_joint_is_limited():
    """MuJoCo's row of a limit has the position range − angle, less the margin."""
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody><body><freejoint/>{BODY}<body pos="0 0 1">'
        f'<joint name="ball" type="ball" range="0 0.7" margin="4" pos="0.1 0.2 0"/>{SMALL}'
        "</body></body></worldbody></mujoco>"
    )
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    states = agreement.random_states(m, 100)

    def rows(qpos, qvel):
        state = read.state(qpos, qvel)
        dt, control = jnp.asarray(1e-3), jnp.zeros(0)
        found = linearize_bounds(read.system, state.q, state.v, state.time, control, dt)
        return found.gap, found.rate

    gap, rate = agreement.quick(jax.vmap(rows))(*map(jnp.asarray, states[:2]))
    for i in range(100):
        data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
        mujoco.mj_forward(m, data)
        np.testing.assert_allclose(gap[i], data.efc_pos - data.efc_margin, atol=1e-9)
        np.testing.assert_allclose(rate[i], data.efc_vel, atol=1e-9)
    assert not jc.from_mjcf(m, ignore=("ball_limit",)).system.bounds


SENSED = (
    '<geom name="floor" type="plane" size="2 2 1" pos="0 0 -0.4"/>'
    '<site name="ground" pos="0.2 -0.1 0.3" euler="0.1 0.7 0.3"/>'
    f'<body name="base"><freejoint/>{BODY}{SITE.format("base")}'
    '<geom name="hull" type="capsule" size="0.1 0.2" pos="0.1 0 0.1" euler="0.4 0.3 0.1"/>'
    f'<body name="arm" pos="0 0 1"><joint name="ball" type="ball"/>{SMALL}'
    f'<body name="wrist" pos="0.1 0.2 0" euler="0.3 0.5 0.1">{SMALL}{SITE.format("wrist")}'
    '<geom name="knob" size="0.2" pos="0.1 0 0.1"/>'
    '<body name="hand" pos="0.1 0.1 0"><joint name="turn" axis="1 0.2 0" ref="0.3"'
    ' range="-0.2 0.4" stiffness="2" damping="0.3" armature="0.1"/>'
    f"{BODY}{SITE.format('hand')}"
    '<camera name="eye" pos="0.1 0.2 0.3" euler="0.5 0.1 0.2"/></body></body></body></body>'
    f'<body pos="1 0 0"><joint name="slide" type="slide" axis="0 1 0.3"/>{SMALL}</body>'
)
SENSORS = """<sensor>
<jointpos joint="turn"/><jointvel joint="slide"/><ballquat joint="ball"/><ballangvel joint="ball"/>
<jointactuatorfrc joint="turn"/><jointactuatorfrc joint="slide"/>
<actuatorpos actuator="servo"/><actuatorvel actuator="push"/><actuatorfrc actuator="servo"/>
<actuatorfrc actuator="push"/><actuatorpos actuator="jet"/><actuatorvel actuator="jet"/>
<framepos objtype="site" objname="hand"/>
<framepos objtype="body" objname="wrist" reftype="site" refname="base"/>
<framequat objtype="xbody" objname="wrist"/>
<framequat objtype="site" objname="hand" reftype="body" refname="arm"/>
<framexaxis objtype="geom" objname="hull"/>
<frameyaxis objtype="site" objname="hand" reftype="site" refname="ground"/>
<framezaxis objtype="camera" objname="eye"/>
<framelinvel objtype="site" objname="hand"/><frameangvel objtype="body" objname="wrist"/>
<framelinvel objtype="site" objname="hand" reftype="xbody" refname="base"/>
<frameangvel objtype="site" objname="hand" reftype="xbody" refname="base"/>
<framelinacc objtype="site" objname="hand"/><frameangacc objtype="body" objname="wrist"/>
<framelinacc objtype="site" objname="ground"/>
<gyro site="hand"/><velocimeter site="wrist"/><accelerometer site="hand"/>
<accelerometer site="base" cutoff="5"/><magnetometer site="hand"/>
<force site="hand"/><torque site="hand"/><force site="wrist"/><torque site="wrist"/>
<force site="base"/>
<subtreecom body="base"/><subtreecom body="wrist"/><subtreelinvel body="arm"/>
<subtreeangmom body="base"/><subtreeangmom body="wrist"/>
<clock/><e_potential/><e_kinetic/></sensor>"""
DRIVEN = """<actuator><position name="servo" joint="turn" kp="3" kv="0.2" gear="2"/>
<general name="push" joint="slide" gainprm="4" gear="3"/>
<motor name="jet" site="hand" gear="1 2 3 1 0 2"/></actuator>"""


def test_sensors_are_those_of_mujoco():
    m = model(SENSED, DRIVEN + SENSORS)
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    states = agreement.random_states(m, 100)
    method = agreement.EXACT

    def readings(qpos, qvel, ctrl):
        state = read.state(qpos, qvel, 0.3)
        info = jc.forward_dynamics(read.system, state, ctrl, method, 1e-3)
        return read.sensors(state, info)

    got = agreement.quick(jax.vmap(readings))(*map(jnp.asarray, states))
    for i in range(100):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (x[i] for x in states)
        data.time = 0.3
        mujoco.mj_forward(m, data)
        for name, where in read.sensor_slices.items():
            expected = data.sensordata[where]
            size = max(1, abs(expected).max())
            np.testing.assert_allclose(got[i][where], expected, atol=AGREE * size, err_msg=name)


LOADED = (
    '<geom name="floor" type="plane" size="2 2 1"/><body name="upper" pos="0 0 1">'
    f'<joint name="shoulder" type="ball"/>{BODY}<body name="lower" pos="0 0.3 -0.5">'
    f'<joint name="elbow" axis="1 0 0"/>{BODY}<body name="foot" pos="0.1 0.1 -0.5">{SMALL}'
    f'<geom name="sole" size="0.2"/>{SITE.format("foot")}</body>{SITE.format("knee")}'
    "</body></body>"
)


def test_sensors_of_force_read_the_wrench_of_a_joint():
    """The load on a joint less contacts and equalities below is the wrench of the joint."""
    rest = (
        '<equality><connect name="tie" body1="foot" body2="upper" anchor="0.1 0.2 0.1"/></equality>'
        '<sensor><force site="knee"/><torque site="knee"/><touch name="step" site="foot"/></sensor>'
    )
    text = f"<mujoco><worldbody>{LOADED}</worldbody>{rest}</mujoco>"
    read = jc.from_mjcf(text)
    method = read.method()
    qpos = jnp.array([1.0, 0.1, 0.2, 0.05, -0.7])
    qvel = jnp.array([0.3, -0.2, 0.1, 0.4])
    state = read.state(qpos, qvel)
    state = jc.init(read.system, method, state.q, state.v)
    info = jax.jit(lambda s: jc.step(read.system, method, s, None, 2e-3)[1])(state)
    system = read.system
    assert float(info.reactions["floor and sole"][0]) > 1
    wrench = jc.wrench(info, "elbow", system=system)
    data = mujoco.MjData(m := mujoco.MjModel.from_xml_string(text))
    data.qpos[:] = read.qpos(info.state)
    mujoco.mj_kinematics(m, data)
    arm = data.joint("elbow").xanchor - data.site("knee").xpos
    frame = data.site("knee").xmat.reshape(3, 3)
    force, torque = np.split(np.asarray(wrench), 2)
    expected = np.concatenate([frame.T @ force, frame.T @ (torque + np.cross(arm, force))])
    found = read.sensors(state, info, names=("sensor 0", "sensor 1"))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


TOUCHED = (
    '<geom type="plane" size="2 2 1"/><body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/>'
    '<geom name="left" size="0.1" pos="0.3 0 0" mass="1"/>'
    '<geom name="right" size="0.1" pos="-0.3 0 0" mass="1"/>'
    '<site name="both" size="0.5"/>'
    '<site name="heel" type="{}" pos="0.3 0 -0.1" size="0.1 0.1 0.1"/>'
    '<site name="above" size="0.1" pos="0.3 0 0.2"/><site name="aside" size="0.1" pos="0.3 0.3 0"/>'
    '<body><geom mass="2" size="0.1" contype="0" conaffinity="0" pos="0 0 1"/>'
    '<site name="head" size="0.5"/></body></body>'
)


@pytest.mark.parametrize("shape", ["sphere", "capsule", "ellipsoid", "cylinder", "box"])
def test_touch_is_that_of_mujoco(shape):
    """At rest two balls carry a weight; a zone above a contact is met by its line of action."""
    sites = ("both", "heel", "above", "aside", "head")
    sensors = "".join(f'<touch name="{site}" site="{site}"/>' for site in sites)
    body = f"<worldbody>{TOUCHED.format(shape)}</worldbody>"
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{body}<sensor>{sensors}</sensor></mujoco>")
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    info = jc.step(read.system, read.method(), read.start, None, 2e-3)[1]
    mujoco.mj_step(m, data, 2000)
    found = read.sensors(read.start, info)
    assert data.sensordata[1] > 0
    np.testing.assert_array_equal(np.asarray(found) == 0, data.sensordata == 0)
    np.testing.assert_allclose(found, data.sensordata, rtol=1e-4)


RANGED = (
    f'<body><joint name="turn" axis="0 1 0" range="-0.3 0.5" margin="0.1" ref="0.2"/>{BODY}'
    f'<body pos="0 0 1"><joint name="out" type="slide" axis="1 0 0" range="-9 9"/>{SMALL}</body>'
    "</body>"
)
LIMIT_SENSORS = "".join(
    f'<jointlimit{what} name="{what} {joint}" joint="{joint}"/>'
    for what in ("pos", "vel", "frc")
    for joint in ("turn", "out")
)


def test_sensors_of_limits():
    """The position and rate are MuJoCo's; the force is the reaction of the limit."""
    text = f'<mujoco><compiler angle="radian"/><worldbody>{RANGED}</worldbody>'
    m = mujoco.MjModel.from_xml_string(f"{text}<sensor>{LIMIT_SENSORS}</sensor></mujoco>")
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    names = [f"{what} {joint}" for what in ("pos", "vel") for joint in ("turn", "out")]
    readings = jax.jit(lambda q, v: read.sensors(read.state(q, v), names=names))
    for angle in (-0.4, 0.0, 0.45):
        data.qpos[:], data.qvel[:] = (angle, 0.1), (0.7, 0.2)
        mujoco.mj_forward(m, data)
        found = readings(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
        np.testing.assert_allclose(found, data.sensordata[:4], atol=1e-9)
    state = read.state(jnp.array([0.45, 0.1]))
    info = jc.forward_dynamics(read.system, state, None, read.method(), 1e-3)
    force = read.sensors(state, info)[4:]
    np.testing.assert_allclose(force, [info.reactions["turn limit"][0], 0], atol=1e-12)
    assert float(force[0]) > 0


def test_sensors_have_gradients_in_single_precision():
    sensors = (
        '<sensor><accelerometer site="s"/><force site="s"/><framequat objtype="site" objname="s"/>'
        '<subtreeangmom body="arm"/><jointpos joint="turn"/></sensor>'
    )
    body = f'<body name="arm"><joint name="turn" axis="0 1 0"/>{BODY}{SITE.format("s")}</body>'
    read = jc.from_mjcf(model(body, sensors), dtype=jnp.float32)

    def total(qpos):
        state = read.state(qpos)
        info = jc.forward_dynamics(read.system, state, None, agreement.EXACT, 1e-3)
        return jnp.sum(read.sensors(state, info))

    found = agreement.quick(jax.grad(total))(jnp.array([0.3], jnp.float32))
    assert found.dtype == jnp.float32
    assert np.all(np.isfinite(found))
    assert np.all(found)


def test_errors_of_sensors_name_them():
    sensors = (
        '<sensor><jointpos name="angle" joint="turn"/><gyro name="spin" site="s"/>'
        '<accelerometer name="felt" site="s"/><rangefinder name="ahead" site="s"/>'
        '<actuatorfrc name="pull" actuator="m"/></sensor>'
    )
    body = f'<body><joint name="turn" axis="0 1 0"/>{BODY}<site name="s"/></body>'
    m = model(body, '<actuator><motor name="m" joint="turn"/></actuator>' + sensors)
    read = jc.from_mjcf(m)
    state = read.state(jnp.array([0.3]), jnp.array([2.0]))
    found = read.sensors(state, names=("spin", "angle"))
    np.testing.assert_allclose(found, [0, 2, 0, 0.3], atol=1e-12)
    assert read.sensor_slices["ahead"] == slice(7, 8)
    for names, error, match in (
        (None, NotImplementedError, "'ahead' of type rangefinder is not supported; read other"),
        (("behind",), ValueError, "'behind' is unknown; known are \\['angle', 'spin'"),
        (("felt",), ValueError, "'felt' of type accelerometer needs accelerations and"),
        (("pull",), ValueError, "'pull' of type actuatorfrc needs the control inputs"),
    ):
        with pytest.raises(error, match=match):
            read.sensors(state, names=names)
    assert read.sensors(state, control=jnp.array([3.0]), names=("pull",)) == 3
    assert jc.from_mjcf(model(body)).sensors(state).shape == (0,)


STRUNG = (
    '<site name="post" pos="0.3 0.4 1.2"/><site name="beam" pos="-0.4 0.3 1"/>'
    f'<body name="a" pos="0 0 1"><joint name="ja" axis="0 1 0" ref="0.2"/>{BODY}'
    '<site name="a1" pos="0.2 0.1 0"/><site name="a2" pos="0 0.2 -0.3"/>'
    f'<body name="b" pos="0 0.1 -0.5"><joint name="jb" axis="1 0 0.2"/>{SMALL}'
    '<site name="b1" pos="0.1 0 -0.2"/><site name="b2" pos="-0.1 0.1 0"/>'
    f'<body name="c" pos="0 0 -0.4"><joint name="jc" type="slide" axis="0 0.1 1"/>{SMALL}'
    '<site name="c1" pos="0.1 0.1 0.1"/></body></body></body>'
    f'<body name="d" pos="1 0 0"><freejoint/>{SMALL}<site name="d1" pos="0.1 0 0.2"/></body>'
)
TENDONS = """<tendon>
<fixed name="mixed" stiffness="5" springlength="0.1 0.3" damping="0.7" armature="0.3" {0}>
  <joint joint="ja" coef="0.7"/><joint joint="jb" coef="-0.4"/><joint joint="jc" coef="2"/></fixed>
<fixed name="pair" stiffness="3" {1}><joint joint="jb" coef="1.5"/><joint joint="ja" coef="0.3"/>
  </fixed>
<fixed name="other" damping="0.4"><joint joint="jb" coef="0.5"/><joint joint="ja" coef="2"/></fixed>
<spatial name="rope" stiffness="8" damping="0.5" {2}><site site="post"/>
  <site site="a1"/><site site="a2"/><site site="b1"/><pulley divisor="2"/><site site="beam"/>
  <site site="c1"/><site site="d1"/></spatial>
<spatial name="line" springlength="0 2" stiffness="4"><site site="b2"/><site site="d1"/></spatial>
<spatial name="reel" armature="0.2"><site site="post"/><site site="a1"/><site site="b1"/></spatial>
<spatial name="plain"><site site="d1"/><site site="post"/></spatial></tendon>"""
ON_TENDONS = """<actuator><motor name="winch" tendon="rope" gear="2"/>
<position name="servo" tendon="mixed" kp="3" kv="0.4" gear="1.5"/>
<general name="both" tendon="rope" gear="-1" gainprm="3" biastype="affine" biasprm="0.3 -2 -0.2"
  forcerange="-1 2"/></actuator>"""
TENDON_SENSORS = "".join(
    f'<tendon{what} tendon="{name}"/>'
    for what in ("pos", "vel", "actuatorfrc")
    for name in ("mixed", "rope", "plain")
)
TENDON_SENSORS = f'<sensor>{TENDON_SENSORS}<jointactuatorfrc joint="jb"/></sensor>'


def test_tendons_are_those_of_mujoco():
    """Rotors are on tendons along one branch: between branches MuJoCo neglects their inertia."""
    m = model(STRUNG, TENDONS.format("", "", "") + ON_TENDONS + TENDON_SENSORS)
    assert agreement.acceleration_error(m) < AGREE
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    states = agreement.random_states(m, 20)
    readings = agreement.quick(jax.vmap(lambda q, v, u: read.sensors(read.state(q, v), control=u)))
    got = readings(*map(jnp.asarray, states))
    for i in range(20):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (x[i] for x in states)
        mujoco.mj_forward(m, data)
        np.testing.assert_allclose(got[i], data.sensordata, atol=1e-8)


def test_ranges_and_friction_of_tendons():
    """Gaps, rates and bounds are those of MuJoCo's rows; reactions are tested by hand elsewhere."""
    ranges = 'range="-9 0.1" margin="3"', 'frictionloss="0.6"', 'range="5 9" frictionloss="0.2"'
    text = (
        f'<mujoco><compiler angle="radian"/><worldbody>{STRUNG}</worldbody>'
        f"{TENDONS.format(*ranges)}</mujoco>"
    )
    m = mujoco.MjModel.from_xml_string(text)
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    states = agreement.random_states(m, 20)

    def rows(qpos, qvel):
        state = read.state(qpos, qvel)
        dt, control = jnp.asarray(1e-3), jnp.zeros(0)
        return linearize_bounds(read.system, state.q, state.v, state.time, control, dt)

    found = agreement.quick(jax.vmap(rows))(*map(jnp.asarray, states[:2]))
    layout = found.layout
    order = ("pair friction", "rope friction", "mixed limit", "rope limit")
    at = [int(layout.rows(name)[0]) for name in order]
    for i in range(20):
        data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
        mujoco.mj_forward(m, data)
        gaps = (data.efc_pos - data.efc_margin)[2:]
        np.testing.assert_allclose(found.rate[i][np.array(at)], data.efc_vel, atol=1e-8)
        np.testing.assert_allclose(found.gap[i][np.array(at[2:])], gaps, atol=1e-8)
    np.testing.assert_allclose(found.upper[0], data.efc_frictionloss[:2])


def test_equalities_of_tendons():
    """The residuals of a polynomial coupling and of a held tendon are those of MuJoCo."""
    equality = (
        '<equality><tendon name="cam" tendon1="rope" tendon2="mixed" polycoef="0.1 0.2 0.3 -1 0"/>'
        '<tendon name="held" tendon1="line" polycoef="0.2 0 0 0 0"/></equality>'
    )
    m = model(STRUNG, TENDONS.format("", "", "") + equality)
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    qpos, qvel, _ = agreement.random_states(m, 3)
    for i in range(3):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(m, data)
        found = jc.violation(read.system, read.state(qpos[i], qvel[i]))
        expected = {"cam": data.efc_pos[0], "held": data.efc_pos[1]}
        for name, x in expected.items():
            np.testing.assert_allclose(found[name], abs(x), rtol=1e-9)


def test_tendons_can_be_left_out_and_wrapped_ones_are_named():
    passive = model(STRUNG, TENDONS.format("", "", "") + ON_TENDONS)
    names = jc.from_mjcf(passive, ignore=("tendon",)).system.params
    assert {"rope", "mixed"} <= set(names)  # actuators act on them
    assert not {"rope spring", "pair", "line", "plain"} & set(names)
    sided = (
        '<tendon><spatial name="w" {}><site site="post"/><geom geom="drum" sidesite="core"/>'
        '<site site="d1"/></spatial></tendon>'
    )
    drum = '<geom name="drum" size="0.1" contype="0" conaffinity="0"/><site name="core"/>'
    sensor = '<sensor><tendonpos name="reach" tendon="w"/></sensor>'
    with pytest.raises(
        NotImplementedError, match="tendon 'w' wraps .* 'drum' on the side of .* 'core'"
    ):
        jc.from_mjcf(model(STRUNG + drum, sided.format('stiffness="1"')))
    read = jc.from_mjcf(model(STRUNG + drum, sided.format("") + sensor))
    with pytest.raises(NotImplementedError, match="'reach' of type tendonpos is of a tendon that"):
        read.sensors(read.start)


WRAPPED = (
    '<site name="post" pos="0.3 0.4 1.2"/><geom name="ball" size="0.3" pos="0.3 0.1 0.6"/>'
    f'<body name="a" pos="0 0 1"><joint axis="0 1 0"/>{BODY}<site name="a1" pos="0.2 0.1 -0.6"/>'
    '<geom name="drum" type="cylinder" size="0.15 0.3" pos="0.1 0 -0.3" euler="0.3 0.2 0"/>'
    f'<body name="b" pos="0 0.1 -0.5"><joint type="ball"/>{SMALL}<site name="b1" pos="0.1 0 -0.3"/>'
    "</body></body>"
    f'<body name="d" pos="0.5 0 0"><freejoint/>{SMALL}<site name="d1" pos="0.1 0 0.2"/></body>'
)
AROUND = """<tendon>
<spatial name="one" stiffness="8" springlength="0"><site site="post"/><geom geom="ball"/>
  <site site="a1"/></spatial>
<spatial name="two" stiffness="5" springlength="0" damping="0.5"><site site="d1"/>
  <geom geom="ball"/><site site="b1"/><geom geom="drum"/><site site="post"/></spatial>
<spatial name="three" stiffness="7" springlength="0"><site site="a1"/>
  <geom geom="drum"/><site site="d1"/></spatial></tendon>
<sensor><tendonpos tendon="one"/><tendonpos tendon="two"/><tendonpos tendon="three"/>
<tendonvel tendon="two"/></sensor>"""


def test_wrapped_tendons_are_those_of_mujoco():
    """Each surface is met in some states and missed in others."""
    m = model(WRAPPED, AROUND)
    assert agreement.acceleration_error(m) < AGREE
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    states = agreement.random_states(m, 100)
    readings = agreement.quick(jax.vmap(lambda q, v: read.sensors(read.state(q, v))))
    got = readings(*map(jnp.asarray, states[:2]))
    wrapped = []
    for i in range(100):
        data.qpos[:], data.qvel[:] = states.qpos[i], states.qvel[i]
        mujoco.mj_forward(m, data)
        np.testing.assert_allclose(got[i], data.sensordata, atol=1e-8)
        wrapped.append(data.ten_wrapnum > (2, 3, 2))
    assert np.all(np.any(wrapped, axis=0))
    assert not np.any(np.all(wrapped, axis=0))


ACTIVATED = """<actuator>
<general name="slow" joint="ja" dyntype="filter" dynprm="0.3" gainprm="2" ctrlrange="-1 1"/>
<general name="exact" joint="jb" dyntype="filterexact" dynprm="0.01" gaintype="affine"
  gainprm="2 0.3 0.1" biastype="affine" biasprm="0.2 -1 -0.3" gear="1.5" forcerange="-3 3"/>
<motor name="plain" joint="jc" ctrlrange="-0.5 0.5"/>
<general name="sum" joint="jc" dyntype="integrator" gainprm="3" actlimited="true"
  actrange="-0.1 0.1" actearly="true"/>
<muscle name="biceps" tendon="rope" lengthrange="1 4" force="90" ctrlrange="0 1" gear="0.9"/>
<muscle name="soft" joint="ja" lengthrange="-1 2" scale="40" tausmooth="0.3" range="0.5 1.1"/>
<general name="direct" joint="jb" gaintype="muscle" biastype="muscle" lengthrange="-2 1"
  gainprm="0.7 1.2 60 200 0.5 1.6 1.5 1.3 1.2" biasprm="0.7 1.2 60 200 0.5 1.6 1.5 0.9 1.2"/>
</actuator>"""


@HAS_ACTIVATIONS
def test_activations_and_muscles_are_those_of_mujoco():
    """Accelerations at given activations, and activations after a step of MuJoCo's Euler."""
    m = model(STRUNG, TENDONS.format("", "", "") + ACTIVATED)
    m.opt.timestep = 0.02
    read, data, count = jc.from_mjcf(m), mujoco.MjData(m), 100
    states, random = agreement.random_states(m, count), np.random.default_rng(1)
    ctrl, act = random.uniform(-1.5, 1.5, (count, m.nu)), random.uniform(0, 1, (count, m.na))

    def accelerate(qpos, qvel, ctrl, act):
        after, control = read.activate(act, ctrl)
        state = read.state(qpos, qvel)
        solution = jc.forward_dynamics(read.system, state, control, agreement.EXACT, 1e-3)
        return read.qacc(state, solution.acceleration), after

    given = map(jnp.asarray, (*states[:2], ctrl, act))
    got, after = agreement.quick(jax.vmap(accelerate))(*given)
    for i in range(count):
        mujoco.mj_resetData(m, data)
        data.qpos[:], data.qvel[:], data.ctrl[:], data.act[:] = (
            *(x[i] for x in states[:2]),
            ctrl[i],
            act[i],
        )
        mujoco.mj_forward(m, data)
        assert agreement.relative(np.asarray(got[i])[None], data.qacc[None].copy()) < AGREE
        mujoco.mj_step(m, data)
        np.testing.assert_allclose(after[i], data.act, atol=1e-12)
    np.testing.assert_array_equal(read.activation, np.zeros(m.na))
    plain = jc.from_mjcf(model(STRUNG))
    assert plain.activate(plain.activation, jnp.zeros(0))[0].shape == (0,)


@HAS_ACTIVATIONS
def test_activations_have_gradients_and_keyframes():
    key = '<keyframe><key name="k" act="0.2 0.3 0.05 0.4 0.5" ctrl="1 1 1 1 1 1 1"/></keyframe>'
    text = TENDONS.format("", "", "") + ACTIVATED + key
    read = jc.from_mjcf(model(STRUNG, text), dtype=jnp.float32)
    start = read.keyframe("k")

    def last(ctrl):
        def step(act, _):
            return read.activate(act, ctrl, 0.01)[0], None

        return jax.lax.scan(step, start.activation, None, 20)[0]

    slope = jax.jit(jax.jacrev(last))(0.5 * start.control)
    assert slope.dtype == jnp.float32
    acting = np.array([0, 1, 3, 4, 5])
    np.testing.assert_array_equal(np.diag(np.asarray(slope)[:, acting]) != 0, [1, 1, 0, 1, 1])
    with pytest.raises(ValueError, match="activation must have shape \\(5,\\), got \\(4,\\)"):
        read.activate(jnp.zeros(4, jnp.float32), start.control)


def test_actuators_with_activations_are_named():
    """`system, state = model` runs without the dynamics of the activations."""
    m = model(STRUNG, TENDONS.format("", "", "") + ACTIVATED)
    with pytest.warns(UserWarning, match="slow, exact, sum, biceps, soft have .* model.activate"):
        read = jc.from_mjcf(m)
    row = "slow (filter), exact (filterexact), sum (integrator), biceps (muscle), soft (muscle)"
    assert f"{row}: call activate in each step" in repr(read)
    filtered = '<general name="lag" joint="ja" dyntype="filter" dynprm="0.3"/>'
    with pytest.warns(UserWarning, match="from_mjcf: lag has an activation") as caught:
        jc.from_mjcf(model(STRUNG, f"<actuator>{filtered}</actuator>"))
    assert [x.filename for x in caught] == [__file__]
    assert "activations" not in repr(jc.from_mjcf(model(STRUNG)))


CLAMPED = (
    '<site name="post" pos="0.3 0.4 1.2"/>'
    f'<body name="a"><joint name="ja" axis="0 1 0" {{0}}/>{BODY}<site name="a1" pos="0.2 0.1 0"/>'
    f'<body name="b" pos="0 0.1 -0.5"><joint name="jb" axis="1 0 0.2" {{1}}/>{SMALL}'
    '<site name="b1" pos="0.1 0 -0.2"/>'
    f'<body name="c" pos="0 0 -0.4"><joint name="jc" axis="0 1 0.3"/>{SMALL}'
    '<site name="c1" pos="0.1 0.1 0.1"/></body></body></body>'
)
CLAMPED_TENDONS = """<tendon>
<fixed name="sum"><joint joint="ja" coef="0.7"/><joint joint="jc" coef="2"/></fixed>
<spatial name="rope"><site site="post"/><site site="a1"/></spatial>
<spatial name="above"><site site="b1"/><site site="c1"/></spatial></tendon>"""
SMALL_RANGE = 'actuatorfrcrange="-1 1"'


def clamped(actuators, first=SMALL_RANGE, second=""):
    rest = f"{CLAMPED_TENDONS}<actuator>{actuators}</actuator>"
    return model(CLAMPED.format(first, second), rest)


@pytest.mark.parametrize(
    ("actuators", "why"),
    [
        ('<motor name="m" tendon="sum" gear="9"/>', "the actuator 'm', which .* by a tendon"),
        ('<motor name="m" tendon="rope"/>', "the actuator 'm', which acts on it by a tendon"),
        ('<motor name="m" site="c1" gear="9"/>', "the actuator 'm', which acts on it by a site"),
        (
            '<motor name="m" site="c1" refsite="post"/>',
            "the actuator 'm', which acts on it by a site",
        ),
        ('<motor joint="ja"/><motor tendon="sum" gear="9"/>', "2 actuators"),
        ('<motor joint="ja"/><motor site="a1" gear="0 0 0 1 0 0"/>', "2 actuators"),
        ('<motor joint="ja"/><motor jointinparent="ja"/>', "2 actuators"),
    ],
)
def test_a_range_of_a_joint_beside_tendons_and_sites_is_refused(actuators, why):
    """MuJoCo clamps the sum of all actuator forces on the joint."""
    match = f"joint 'ja' has an actuatorfrcrange and {why}"
    with pytest.raises(NotImplementedError, match=match):
        jc.from_mjcf(clamped(actuators))


def test_ranges_of_joints_on_which_others_do_not_act():
    """The tendon and the site act between b and c, below both joints with a range."""
    m = clamped(
        '<motor joint="ja" gear="9" ctrlrange="-1 1"/><motor tendon="above" ctrlrange="-1 1"/>'
        '<motor site="c1" refsite="b1" gear="3 1 2 0 0 0" ctrlrange="-1 1"/>'
        '<motor site="c1" gear="0 0 0 0 0 0"/><motor tendon="rope" gear="0"/>',
        second=SMALL_RANGE,
    )
    assert agreement.acceleration_error(m, 20) < AGREE


@pytest.mark.parametrize(
    "at", ['joint="free" gear="0 0 3 0 0 0"', 'joint="free" gear="0 0 0 1 2 0"', 'site="base"']
)
def test_muscles_without_a_length_are_refused(at):
    body = f'<body><freejoint name="free"/>{BODY}<site name="base" pos="0.1 0 0"/></body>'
    law = (
        'gaintype="muscle" biastype="muscle" gainprm="0.7 1.2 60 200 0.5 1.6 1.5 1.3 1.2"'
        ' biasprm="0.7 1.2 60 200 0.5 1.6 1.5 1.3 1.2" lengthrange="-1 1"'
    )
    m = model(body, f'<actuator><general name="pull" {at} {law}/></actuator>')
    with pytest.raises(NotImplementedError, match="actuator 'pull' is a muscle on a free joint or"):
        jc.from_mjcf(m)


@pytest.mark.parametrize(
    ("passive", "flag"),
    [
        ('stiffness="1"', "spring"),
        ('damping="1"', "damper"),
        ('frictionloss="1"', "frictionloss"),
        ('range="0 1"', "limit"),
    ],
)
def test_tendons_without_effect_are_not_refused(passive, flag):
    """A tendon within one body cannot be imported, but a flag disables its only effect."""
    text = (
        '<mujoco><compiler autolimits="true"/><option><flag {}="disable"/></option>'
        f'<worldbody>{STRUNG}</worldbody><tendon><spatial name="inert" {passive}>'
        '<site site="b1"/><site site="b2"/></spatial></tendon></mujoco>'
    )
    jc.from_mjcf(text.format(flag))
    with pytest.raises(NotImplementedError, match="tendon 'inert' lies in one body"):
        jc.from_mjcf(text.format("contact"))
