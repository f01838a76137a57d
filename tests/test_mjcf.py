"""Models of MuJoCo against MuJoCo itself: accelerations at random states, maps, what is refused."""

import numpy as np
import pytest
from compiling import quick_jit

mujoco = pytest.importorskip("mujoco")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

import jaxcon as jc  # noqa: E402

DENSE = jc.Method(stabilizer=jc.Unstabilized(), solver=jc.Dense())
AGREE = 1e-9
"""Accelerations, relative to the largest one of the state."""
BODY = '<inertial pos="0.1 0.02 -0.2" mass="1.3" fullinertia="0.06 0.05 0.04 0.01 0.005 -0.004"/>'
SMALL = '<inertial pos="0 0.1 0" quat="1 0.3 0 0.2" mass="0.7" diaginertia="0.02 0.03 0.025"/>'


def model(bodies, rest="", options=""):
    return (
        f'<mujoco><compiler angle="radian"/><option {options}/>'
        f"<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )


def random_states(m, n, seed=0):
    """qpos within half a radian or metre of the reference, any ball and free orientation."""
    random = np.random.default_rng(seed)
    qpos = m.qpos0 + random.uniform(-0.5, 0.5, (n, m.nq))
    for kind, q in zip(m.jnt_type, m.jnt_qposadr, strict=True):
        if kind in (0, 1):
            first = q if kind else q + 3
            turn = random.normal(size=(n, 4))
            qpos[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return qpos, random.normal(size=(n, m.nv)), random.uniform(-2, 2, (n, m.nu))


def agreement(text, n=20, **options):
    """The largest relative difference of qacc, and what comes back of qpos and qvel."""
    m = text if isinstance(text, mujoco.MjModel) else mujoco.MjModel.from_xml_string(text)
    read = jc.from_mjcf(m, **options)
    qpos, qvel, ctrl = random_states(m, n)
    data, expected = mujoco.MjData(m), np.zeros((n, m.nv))
    for i in range(n):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], ctrl[i]
        mujoco.mj_forward(m, data)
        expected[i] = data.qacc

    def accelerate(qpos, qvel, ctrl):
        state = read.state(qpos, qvel)
        solution = jc.forward_dynamics(read.system, state, ctrl, DENSE, 1e-3)
        return read.qacc(state, solution.acceleration), read.qpos(state), read.qvel(state)

    got, q, v = quick_jit(jax.vmap(accelerate))(qpos, qvel, ctrl)
    np.testing.assert_allclose(q, qpos, atol=1e-12)
    np.testing.assert_allclose(v, qvel, atol=1e-12)
    error = np.abs(got - expected).max(1) / np.abs(expected).max(1)
    assert error.max() < AGREE, (error.max(), got[0], expected[0])
    return read


HINGES = '<joint name="j{0}" axis="{1}" pos="0.1 0.2 0.3" ref="0.2" {2}/>'
SPRUNG = 'stiffness="{}" springref="0.3" damping="0.4" armature="0.05"'
TREES = {
    "two hinges": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(5)),
    "three hinges": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(5))
    + HINGES.format(3, "0.1 1 0.3", SPRUNG.format(2)),
    "slides and hinges": '<joint type="slide" axis="1 0.3 0" ref="0.1" stiffness="7"/>'
    '<joint type="slide" axis="0 1 0.2" armature="0.3"/>'
    + HINGES.format(1, "1 0.2 0.1", "")
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(2)),
    "hinges, then slides": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", "")
    + '<joint type="slide" axis="1 0.3 0" stiffness="7"/>'
    + '<joint type="slide" axis="0 1 0.2" damping="0.2" armature="0.1"/>',
    "six freedoms": "".join(
        f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1")
    )
    + "".join(HINGES.format(i, a, "") for i, a in enumerate(("1 0 0", "0 1 0", "0 0 1"))),
    "ball": '<joint name="j1" type="ball" pos="0.1 0 0.2" stiffness="2" damping="0.3"'
    ' armature="0.1"/>',
    "a slide and a ball": '<joint type="slide" axis="1 0.3 0" damping="2"/>'
    '<joint type="ball" pos="0.1 0 0.2" damping="0.3"/>',
}


@pytest.mark.parametrize("joints", TREES.values(), ids=list(TREES))
def test_bodies_with_several_joints(joints):
    """Below a body that moves, with a second one welded to it at an angle."""
    welded = f'<body pos="0.1 0.2 0" euler="0.3 0.2 0.1">{SMALL}</body>'
    inner = f'<body pos="0.2 0.1 0.3" euler="0.5 0.1 -0.4">{joints}{BODY}{welded}</body>'
    agreement(model(f'<body><joint axis="0 1 0"/>{SMALL}{inner}</body>'))


def test_free_bodies():
    """One with springs, damping and a rotor along its six freedoms, and one without."""
    loaded = '<joint type="free" damping="0.2" stiffness="1.5" armature="0.1"/>'
    agreement(
        model(
            f'<body pos="1 2 3" euler="0.3 0.2 0.1">{loaded}{BODY}</body>'
            f"<body><freejoint/>{SMALL}<body><joint/>{BODY}</body></body>"
        )
    )


ARM = (
    f'<body name="arm"><joint name="turn" axis="0 1 0" ref="0.3"/>{BODY}'
    f'<body name="tip" pos="0 0 1"><joint name="out" type="slide" axis="1 0 0"/>{SMALL}</body></body>'
)
ACTUATORS = """
<motor joint="turn" gear="3" ctrllimited="true" ctrlrange="-1 0.5"/>
<position joint="turn" kp="4" kv="0.5" gear="2" forcelimited="true" forcerange="-3 2"/>
<velocity joint="out" kv="3"/>
<general joint="turn" gaintype="affine" gainprm="1 0.3 0.2" biastype="affine"
  biasprm="0.1 -0.5 -0.3" gear="1.5"/>
<general joint="out" gainprm="3" forcelimited="true" forcerange="-2 2"/>
"""


def test_actuators_on_hinges_and_slides():
    read = agreement(model(ARM, f"<actuator>{ACTUATORS}</actuator>"))
    assert read.system.layout.n_u == 5


def test_actuators_on_ball_and_free_joints():
    bodies = (
        f'<body euler="0.2 0.3 0.4"><freejoint name="free"/>{BODY}'
        f'<body euler="0.1 0.5 0.2"><joint name="ball" type="ball"/>{SMALL}</body></body>'
    )
    actuators = """
    <motor joint="ball" gear="1 2 3"/>
    <motor jointinparent="ball" gear="1 -2 0.5"/>
    <position joint="ball" gear="0 2 1" kp="2" kv="0.3"/>
    <motor joint="free" gear="1 2 3 0 0 0"/>
    <motor joint="free" gear="0 0 0 1 2 3"/>
    <motor jointinparent="free" gear="0 0 0 1 -2 0.5"/>
    """
    agreement(model(bodies, f"<actuator>{actuators}</actuator>"))


def test_flags_of_the_options_are_obeyed():
    flags = "".join(f'{f}="disable" ' for f in ("gravity", "spring", "damper", "clampctrl"))
    text = model(ARM, f"<actuator>{ACTUATORS}</actuator>")
    agreement(text.replace("<option />", f"<option><flag {flags}/></option>"))


def test_positions_count_turns_where_that_is_asked_for():
    counting = jc.from_mjcf(model(ARM), count_turns=True)
    qpos = jnp.asarray([20.0, 0.1])
    state = counting.state(qpos, jnp.zeros(2))
    np.testing.assert_allclose(counting.qpos(state), qpos, rtol=1e-12)
    plain = jc.from_mjcf(model(ARM))
    seen = plain.qpos(plain.state(qpos, jnp.zeros(2)))
    np.testing.assert_allclose(seen, [20.0 - 6 * np.pi, 0.1], rtol=1e-12)


def test_names_are_those_of_the_model():
    """In MuJoCo a body, its joint and its motor may have one name."""
    bodies = f'<body name="arm"><joint name="arm"/>{BODY}<body><joint type="slide"/>{SMALL}</body></body>'
    actuator = '<actuator><motor name="arm" joint="arm"/></actuator>'
    read = jc.from_mjcf(model(bodies, actuator))
    assert read.system.layout.bodies == ("arm", "body 2")
    assert dict(read.joints) == {"arm": ("arm joint", "angle"), "joint 1": ("joint 1", "travel")}
    assert [name for name, *_ in read.system.layout.controls] == ["arm actuator"]


def test_keyframes_are_states_and_controls():
    keys = '<key name="bent" time="2" qpos="0.5 0.1" qvel="1 2" ctrl="3"/><key qpos="0.1 0.2"/>'
    read = jc.from_mjcf(
        model(ARM, f'<actuator><motor joint="turn"/></actuator><keyframe>{keys}</keyframe>')
    )
    assert read.keyframes == ("bent", "key 1")
    state, control = jax.tree.leaves(read.keyframe("bent").state), read.keyframe("bent").control
    assert all(jnp.all(jnp.isfinite(x)) for x in state)
    np.testing.assert_allclose(control, [3.0])
    np.testing.assert_allclose(read.qpos(read.keyframe("bent").state), [0.5, 0.1])
    np.testing.assert_allclose(read.qvel(read.keyframe("bent").state), [1.0, 2.0])
    np.testing.assert_allclose(read.keyframe("bent").state.time, 2.0)
    with pytest.raises(ValueError, match="'straight' is unknown.*'bent', 'key 1'"):
        read.keyframe("straight")


def test_a_model_unpacks_and_runs_in_both_precisions():
    for dtype in (jnp.float32, jnp.float64):
        system, state = jc.from_mjcf(model(ARM), dtype=dtype)
        final, _ = quick_jit(lambda system, s: jc.rollout(system, jc.Method(), s, None, 2e-3, 10))(
            system, state
        )
        jc.raise_for_status(final)
        assert final.q.dtype == dtype


def test_the_map_to_states_is_differentiable():
    """dq/dqpos along qvel is q̇ = N(q) v."""
    read = jc.from_mjcf(model(ARM))
    qpos, qvel = jnp.asarray([0.4, 0.2]), jnp.asarray([0.7, -0.3])
    slope = jax.jvp(lambda x: read.state(x, qvel).q, (qpos,), (qvel,))[1]
    state = read.state(qpos, qvel)
    np.testing.assert_allclose(slope, read.system.kinematics(state.q, state.v), atol=1e-12)


URDF = """
<robot name="arm">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial></link>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/><inertia ixx="0.1" iyy="0.2"
    izz="0.15" ixy="0.01" ixz="0" iyz="0"/></inertial></link>
  <link name="hand"><inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0"
    ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 1" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/><dynamics damping="0.3"/></joint>
  <joint name="grip" type="fixed"><parent link="upper"/><child link="hand"/>
    <origin xyz="0 0 0.4"/></joint>
</robot>
"""


def test_urdf():
    read = agreement(URDF)
    assert dict(read.joints) == {"shoulder": ("shoulder", "angle")}
    np.testing.assert_allclose(read.system.params["upper"]["mass"], 2.5)


SITES = '<site name="{}" pos="0.1 0.2 0.3" euler="0.4 0.1 0.2"/>'
WELDED = (
    f'<body name="a"><freejoint/>{BODY}{SITES.format("s")}</body>'
    f'<body name="b" pos="1 0 0" euler="0.1 0 0.3"><freejoint/>{SMALL}{SITES.format("t")}</body>'
)
EQUALITIES = {
    "connect": '<connect name="e" body1="a" body2="b" anchor="0.1 0.2 0.3"/>',
    "connect to the world": '<connect name="e" body1="a" anchor="0.1 0.2 0.3"/>',
    "connect sites": '<connect name="e" site1="s" site2="t"/>',
    "weld": '<weld name="e" body1="a" body2="b"/>',
    "weld in a pose": '<weld name="e" body1="a" body2="b" relpose="0.3 0.1 0.2 0.5 0.5 0.5 0.5"'
    ' anchor="0.1 0 0.2"/>',
    "weld sites": '<weld name="e" site1="s" site2="t"/>',
}


@pytest.mark.parametrize("equality", EQUALITIES.values(), ids=list(EQUALITIES))
def test_equalities_are_violated_as_much_as_in_mujoco(equality):
    """At random states: the gap of the points as MuJoCo sees it, and the sine of half the turn."""
    m = mujoco.MjModel.from_xml_string(model(WELDED, f"<equality>{equality}</equality>"))
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    qpos, qvel, _ = random_states(m, 3)
    for i in range(3):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(m, data)
        found = jc.violation(read.system, read.state(qpos[i], qvel[i]))
        expected = data.efc_pos.copy()  # of a weld: its turns in a frame of its own
        rows = np.array(found.position)
        pairs = [(rows[:3], expected[:3])]
        if len(rows) == 6:
            pairs.append((rows[3:], 2 * expected[3:]))
        for x, y in pairs:
            np.testing.assert_allclose(np.linalg.norm(x), np.linalg.norm(y), rtol=1e-9)


def test_coupled_joints():
    """A cubic of one coordinate, against MuJoCo's residual, and a joint held where it is."""
    equality = (
        '<joint name="cam" joint1="out" joint2="turn" polycoef="0.1 0.2 0.3 -0.4 0.5"/>'
        '<joint name="lock" joint1="turn" polycoef="0.2 0 0 0 0"/>'
    )
    m = mujoco.MjModel.from_xml_string(model(ARM, f"<equality>{equality}</equality>"))
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    data.qpos[:] = [0.7, 0.4]
    mujoco.mj_forward(m, data)
    found = jc.violation(read.system, read.state(data.qpos, data.qvel))
    expected = {"cam": data.efc_pos[0], "lock": data.efc_pos[1]}
    for name, x in expected.items():
        np.testing.assert_allclose(found[name], abs(x), rtol=1e-12)


def test_equalities_that_are_not_active_are_left_out():
    equality = '<connect name="e" body1="a" body2="b" anchor="0 0 0" active="false"/>'
    system, _ = jc.from_mjcf(model(WELDED, f"<equality>{equality}</equality>"))
    assert not system.constraints


GEOM = '<geom name="{}" size="0.1"/>'
HINGE = f'<body name="b"><joint name="j" {{}}/>{BODY}{{}}</body>'
REFUSED = {
    "contact": (
        model(HINGE.format("", GEOM.format("g")) + GEOM.format("floor")),
        "g' and 'floor|floor and g",
    ),
    "limit": (model(HINGE.format('range="0 1"', "")), "limits of 'j'"),
    "friction": (model(HINGE.format('frictionloss="1"', "")), "frictionloss of 'j'"),
    "fluid": (model(HINGE.format("", ""), options='density="1.2"'), "option 'density'"),
    "tendon": (
        model(
            HINGE.format("", ""),
            '<tendon><fixed name="t" stiffness="1"><joint joint="j" coef="1"/></fixed></tendon>',
        ),
        "tendons 't'",
    ),
    "gravcomp": (model(f'<body name="b" gravcomp="1"><joint/>{BODY}</body>'), "gravcomp of 'b'"),
}


@pytest.mark.parametrize("key", REFUSED)
def test_what_is_left_out_must_be_asked_for(key):
    text, match = REFUSED[key]
    with pytest.raises(NotImplementedError, match=match):
        jc.from_mjcf(text)
    with pytest.raises(NotImplementedError, match=f"ignore=\\('{key}',\\)"):
        jc.from_mjcf(text)
    jc.from_mjcf(text, ignore=(key,))


def acting(actuator):
    return model(ARM, f"<actuator>{actuator}</actuator>")


UNSUPPORTED = {
    "mocap body": model(f'<body mocap="true"/>{HINGE.format("", "")}'),
    "trntype 'site'": model(
        HINGE.format("", '<site name="s"/>'), '<actuator><motor name="m" site="s"/></actuator>'
    ),
    "dyntype 'filter'": acting('<general joint="turn" dyntype="filter" dynprm="1"/>'),
    "gaintype 'muscle'": acting('<muscle joint="turn" lengthrange="0 1"/>').replace(
        "muscle ", 'general gaintype="muscle" '
    ),
    "actuatorfrcrange of joint 'j'": model(HINGE.format('actuatorfrcrange="-1 1"', "")),
    "equality 'e' is of type 'tendon'": model(
        HINGE.format("", ""),
        '<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>'
        '<equality><tendon name="e" tendon1="t"/></equality>',
    ),
    "gear with a force and a torque": model(
        f'<body><freejoint name="f"/>{BODY}</body>',
        '<actuator><motor joint="f" gear="1 0 0 0 1 0"/></actuator>',
    ),
    "'j' and 'k'|'j', 'k'\\] of body 'b' pass each other": model(
        HINGE.format('axis="1 0 0"', '<joint name="k" axis="0 1 0" pos="0 0 1"/>')
        .replace(BODY + "<joint", "<joint")
        .replace("</body>", BODY + "</body>")
    ),
    "gimbal lock": model(
        '<body><joint axis="0 0 1"/><joint axis="1 0 0"/><joint axis="0 0 1"/>' + BODY + "</body>"
    ),
    "in this order": model(
        '<body><joint type="slide" axis="1 0 0"/><joint/><joint type="slide" axis="0 1 0"/>'
        + BODY
        + "</body>"
    ),
    "actuation='disable'": acting('<motor joint="turn"/>').replace(
        "<option />", '<option><flag actuation="disable"/></option>'
    ),
}


@pytest.mark.parametrize("match", UNSUPPORTED)
def test_what_is_not_supported_is_named(match):
    with pytest.raises(NotImplementedError, match=match):
        jc.from_mjcf(UNSUPPORTED[match])


@pytest.mark.parametrize(
    ("source", "error", "match"),
    [
        ("nowhere.xml", FileNotFoundError, "no file 'nowhere.xml'.*begins with '<'"),
        ("<mujoco><worldbody>", ValueError, "MuJoCo cannot compile this text"),
        ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", ValueError, "mass"),
        ("<mujoco/>", ValueError, "no body that moves"),
        (3, TypeError, "path of a file.*got int"),
    ],
)
def test_what_is_no_model_is_refused(source, error, match):
    with pytest.raises(error, match=match):
        jc.from_mjcf(source)


@pytest.mark.parametrize("ignore", ["contact", ("contacts",)])
def test_what_to_ignore_is_checked(ignore):
    with pytest.raises(ValueError, match="ignore must be names out of.*'contact'"):
        jc.from_mjcf(model(ARM), ignore=ignore)


def test_without_mujoco_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ImportError, match="pip install 'jaxcon\\[mujoco\\]'"):
        jc.from_mjcf(model(ARM))


def test_a_state_of_the_wrong_shape_is_refused():
    read = jc.from_mjcf(model(ARM))
    with pytest.raises(ValueError, match="qpos must have shape \\(2,\\), got \\(3,\\)"):
        read.state(np.zeros(3), np.zeros(2))
