"""Models of MuJoCo, compared with MuJoCo: accelerations, coordinates, refused features."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.methods.choice import words

mujoco = pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import mjcf_agreement as agreement  # noqa: E402

AGREE = 1e-9
"""Tolerance of accelerations, relative to the largest one of a state."""
BODY = '<inertial pos="0.1 0.02 -0.2" mass="1.3" fullinertia="0.06 0.05 0.04 0.01 0.005 -0.004"/>'
SMALL = '<inertial pos="0 0.1 0" quat="1 0.3 0 0.2" mass="0.7" diaginertia="0.02 0.03 0.025"/>'


def model(bodies, rest="", options=""):
    return (
        f'<mujoco><compiler angle="radian"/><option {options}/>'
        f"<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    )


HINGES = '<joint name="j{0}{{0}}" axis="{1}" pos="0.1 0.2 0.3" ref="0.2" {2}/>'
SPRUNG = 'stiffness="{}" springref="0.3" damping="0.4" armature="0.05"'
SLIDES = '<joint type="slide" axis="1 0.3 0" stiffness="7" ref="0.1"/>'
SLIDES += '<joint type="slide" axis="0 1 0.2" damping="0.2" armature="0.1"/>'
AXES = ("1 0 0", "0 1 0", "0 0 1")
JOINTS = {
    "two hinges": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(5)),
    "three hinges": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(5))
    + HINGES.format(3, "0.1 1 0.3", SPRUNG.format(2)),
    "slides and hinges": SLIDES
    + HINGES.format(1, "1 0.2 0.1", "")
    + HINGES.format(2, "0.1 0.3 1", SPRUNG.format(2)),
    "hinges, then slides": HINGES.format(1, "1 0.2 0.1", SPRUNG.format(3))
    + HINGES.format(2, "0.1 0.3 1", "")
    + SLIDES,
    "six freedoms": "".join(f'<joint type="slide" axis="{a}"/>' for a in AXES)
    + "".join(HINGES.format(i, a, "") for i, a in enumerate(AXES)),
    "ball": '<joint type="ball" pos="0.1 0 0.2" stiffness="2" damping="0.3" armature="0.1"/>',
    "a slide and a ball": '<joint type="slide" axis="1 0.3 0" damping="2"/>'
    '<joint type="ball" pos="0.1 0 0.2" damping="0.3"/>',
}
ARM = (
    f'<body name="arm"><joint name="turn" axis="0 1 0" ref="0.3"/>{BODY}'
    '<body name="tip" pos="0 0 1"><joint name="out" type="slide" axis="1 0 0"/>'
    f"{SMALL}</body></body>"
)
ON_ARM = """
<motor joint="turn" gear="3" ctrllimited="true" ctrlrange="-1 0.5"/>
<position joint="turn" kp="4" kv="0.5" gear="2" forcelimited="true" forcerange="-3 2"/>
<velocity joint="out" kv="3"/>
<general joint="turn" gaintype="affine" gainprm="1 0.3 0.2" biastype="affine"
  biasprm="0.1 -0.5 -0.3" gear="1.5"/>
<general joint="out" gainprm="3" forcelimited="true" forcerange="-2 2"/>
"""
LIMITED = (
    f'<body><joint name="turn" axis="0 1 0" actuatorfrcrange="-0.4 0.7"/>{BODY}'
    '<body pos="0 0 1"><joint name="out" type="slide" axis="1 0 0" actuatorfrcrange="-2 2"/>'
    f"{SMALL}</body></body>"
)
ON_LIMITED = """
<position joint="turn" kp="4" gear="-2" forcelimited="true" forcerange="-0.3 2"/>
<motor joint="out" gear="30"/>
"""
FLOATING = (
    f'<body euler="0.2 0.3 0.4"><freejoint name="free"/>{BODY}'
    f'<body euler="0.1 0.5 0.2"><joint name="ball" type="ball"/>{SMALL}</body></body>'
)
ON_FLOATING = """
<motor joint="ball" gear="1 2 3"/>
<motor jointinparent="ball" gear="1 -2 0.5"/>
<position joint="ball" gear="0 2 1" kp="2" kv="0.3"/>
<motor joint="free" gear="1 2 3 0 0 0"/>
<motor joint="free" gear="0 0 0 1 2 3"/>
<motor jointinparent="free" gear="0 0 0 1 -2 0.5"/>
"""
LOADED = (
    '<body pos="1 2 3" euler="0.3 0.2 0.1">'
    f'<joint type="free" damping="0.2" stiffness="1.5" armature="0.1"/>{BODY}</body>'
)


def tree(name):
    """Two moving bodies and the joint between them; a third is welded to one at an angle."""
    joints = JOINTS[name].replace("{0}", name)
    welded = f'<body pos="0.1 0.2 0" euler="0.3 0.2 0.1">{SMALL}</body>'
    inner = f'<body pos="0.2 0.1 0.3" euler="0.5 0.1 -0.4">{joints}{BODY}{welded}</body>'
    return f'<body><joint axis="0 1 0"/>{SMALL}{inner}</body>'


TREES = {name: tree(name) for name in JOINTS}
TREES |= {"arm and actuators": ARM, "floating and actuators": FLOATING, "loaded": LOADED}
TREES |= {"limited actuators": LIMITED}
ACTUATORS = {
    "arm and actuators": ON_ARM,
    "floating and actuators": ON_FLOATING,
    "limited actuators": ON_LIMITED,
}


@pytest.mark.parametrize("name", TREES)
def test_accelerations_and_coordinates_are_those_of_mujoco(name):
    actuators = f"<actuator>{ACTUATORS.get(name, '')}</actuator>"
    m = mujoco.MjModel.from_xml_string(model(TREES[name], actuators))
    read = jc.from_mjcf(m)
    states = agreement.random_states(m, 4)
    expected = agreement.mujoco_accelerations(m, states)
    for qpos, qvel, ctrl, qacc in zip(*states, expected, strict=True):
        state = read.state(qpos, qvel)
        solution = jc.forward_dynamics(read.system, state, ctrl, agreement.EXACT, 1e-3)
        got = np.asarray(read.qacc(state, solution.acceleration))
        assert agreement.relative(got[None], qacc[None]) < AGREE
        np.testing.assert_allclose(read.qpos(state), qpos, atol=1e-12)
        np.testing.assert_allclose(read.qvel(state), qvel, atol=1e-12)


def test_flags_of_the_options_are_obeyed():
    flags = "".join(f'{f}="disable" ' for f in ("gravity", "spring", "damper", "clampctrl"))
    text = model(TREES["two hinges"] + ARM, f"<actuator>{ON_ARM}</actuator>")
    system, _ = jc.from_mjcf(text.replace("<option />", f"<option><flag {flags}/></option>"))
    np.testing.assert_array_equal(system.params["gravity"], 0)
    fields = [set(numbers) for numbers in system.params.values() if isinstance(numbers, dict)]
    assert not any({"stiffness", "damping", "control_range"} & own for own in fields)
    assert any("inertia" in own and "mass" not in own for own in fields)  # rotors remain


def test_positions_count_turns_where_that_is_asked_for():
    counting = jc.from_mjcf(model(ARM), count_turns=True)
    qpos = jnp.asarray([20.0, 0.1])
    state = counting.state(qpos, jnp.zeros(2))
    np.testing.assert_allclose(counting.qpos(state), qpos, rtol=1e-12)
    plain = jc.from_mjcf(model(ARM))
    seen = plain.qpos(plain.state(qpos, jnp.zeros(2)))
    np.testing.assert_allclose(seen, [20.0 - 6 * np.pi, 0.1], rtol=1e-12)


def test_names_are_those_of_the_model():
    """MuJoCo allows one name for a body, its joint and its motor; here they get a suffix."""
    inner = f'<body><joint type="slide"/>{SMALL}</body>'
    bodies = f'<body name="arm"><joint name="arm"/>{BODY}{inner}</body>'
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


def test_a_model_unpacks_and_runs_in_single_precision():
    system, state = jc.from_mjcf(model(ARM), dtype=jnp.float32)
    final, _ = jax.jit(lambda s: jc.step(system, jc.Method(), s, None, 2e-3))(state)
    jc.raise_for_status(final)
    assert {x.dtype for x in jax.tree.leaves(system)} == {jnp.dtype("float32")}


def test_a_model_says_which_method_suits_it():
    """The solver follows from the structure, other parts are as given.

    A start state is included.
    """
    arm = model(f"<body>{HINGES.format(1, AXES[0], '').format(0)}{BODY}</body>")
    read = jc.from_mjcf(arm)
    found = read.method()
    assert words(found.solver) == words(jc.Method.auto(*read).solver) == "Sparse()"
    assert jax.tree.structure(found) == jax.tree.structure(jc.Method(solver=jc.solvers.Sparse()))
    given = read.method(integrator=jc.RK4(), solver=jc.solvers.Dense(), batch=4)
    assert isinstance(given.integrator, jc.integrators.RungeKutta)
    assert isinstance(given.solver, jc.solvers.Dense)
    with pytest.raises(TypeError, match="unexpected keyword"):
        read.method(dt=1e-3)
    end, _ = jc.rollout(read.system, found, read.start, None, float(read.timestep), 3)
    assert int(end.status) == 0


@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_robots_on_the_floor_are_solved_fast_by_default(name):
    """The hopper has contacts between its limbs, the ant has none. The report names the solver."""
    solver = "Newton()"
    read = jc.from_mjcf(str(agreement.ASSETS / f"{name}.xml"))
    method = read.method()
    assert words(method.solver) == "Sparse()"
    assert words(method.resolve(*read).contact_solver) == solver
    start = read.state(read.tree.reference, np.zeros(read.tree.size))
    rows = start.memory.contact_multipliers.shape[0]
    assert rows == {"hopper": 30, "ant": 83}[name]
    found = jc.report(read.system, start, method, float(read.timestep))
    assert found.cost.contact_solver == solver
    # "impacts": gradients through landings; "range": ankles of the ant start 0.52 rad off limits
    assert set(found.warnings) == {"hopper": {"impacts"}, "ant": {"impacts", "range"}}[name]
    assert len(found.warnings["impacts"]) < 400  # names three of 25 contacts
    if name == "ant":
        assert "ankle_1 limit (0.52 rad below lower)" in found.warnings["range"]
        assert "and 22 others takes two steps" in found.warnings["impacts"]
        assert "40 joint rows of rank 40 and 8 rotor rows: 14 degrees of freedom" in str(found)
    slow = jc.report(read.system, start, jc.Method(contact_solver=jc.solvers.InteriorPoint()))
    assert f"inverts a matrix of {rows} inequality rows" in slow.warnings["dense"]


def test_the_map_to_states_is_differentiable():
    """The derivative of q by qpos along qvel is q̇ = N(q) v."""
    read = jc.from_mjcf(model(ARM))
    qpos, qvel = jnp.asarray([0.4, 0.2]), jnp.asarray([0.7, -0.3])
    slope = jax.jvp(lambda x: read.state(x, qvel).q, (qpos,), (qvel,))[1]
    state = read.state(qpos, qvel)
    np.testing.assert_array_equal(read.state(qpos).v, 0.0 * state.v)  # at rest by default
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


def test_urdf_with_a_mimic_joint():
    """MuJoCo reads it as an equality of joints: θ = 2 φ + 0.1."""
    link = '<link name="{}"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.2" izz="0.15"'
    link += ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
    joint = '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
    joint += '<axis xyz="0 1 0"/>{3}</joint>'
    mimic = '<mimic joint="lead" multiplier="2" offset="0.1"/>'
    text = "".join(map(link.format, "abc")) + joint.format("lead", "a", "b", "")
    read = jc.from_mjcf(
        f'<robot name="arm">{text}{joint.format("follow", "b", "c", mimic)}</robot>'
    )
    found = jc.violation(read.system, read.state([0.3, 0.6], [0.5, 1.0])).position
    np.testing.assert_allclose(found[-1], -0.1, atol=1e-12)


def test_mocap_bodies_are_held_if_their_motions_are_left_out():
    """A link hangs on the mocap body; contacts with it remain, and none between fixed geoms."""
    held = (
        '<geom name="floor" size="0.1"/><body name="hand" mocap="true" pos="1 0 2">'
        '<geom name="palm" size="0.1"/><body name="finger" pos="0 1 0"><joint/>'
        f"{BODY}</body></body>"
        f'<body name="ball"><freejoint/>{BODY}<geom name="skin" size="0.1"/></body>'
    )
    m = mujoco.MjModel.from_xml_string(model(held))
    read, data = jc.from_mjcf(m, ignore=("mocap",)), mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    position = jc.position(read.system, read.start, "finger")
    np.testing.assert_allclose(position, data.body("finger").xpos, atol=1e-12)
    names = {name for group in read.system.bounds for name in group.names}
    assert names == {"floor and skin", "palm and skin"}


def test_the_map_to_states_hardly_grows_with_the_model():
    """Links are lanes of arrays and joints are iterations of a loop, so the trace hardly grows."""
    sizes = []
    for links in (2, 6):
        link = '<body pos="0 0 1"><joint axis="0 1 0"/>' + BODY
        read = jc.from_mjcf(model(links * link + links * "</body>"))
        still = jnp.zeros(read.tree.size)
        program = jax.make_jaxpr(lambda q, v, r=read: r.tree.flat(r.system, q, v))(still, still)
        sizes.append(len(str(program).splitlines()))
    assert sizes[1] - sizes[0] < 4 * 8  # a few lines to stack each link
    assert sizes[0] > 100


def test_urdf():
    """A fixed joint merges two links into one body: 2 kg at 0.2 m and 0.5 kg at 0.4 m along z."""
    read = jc.from_mjcf(URDF)
    assert dict(read.joints) == {"shoulder": ("shoulder", "angle")}
    upper = read.system.params["upper"]
    np.testing.assert_allclose(upper["mass"], 2.5)
    across = 0.1 + 0.2 + 2 * 0.01 + 2 * (2 * 0.04**2 + 0.5 * 0.16**2)
    np.testing.assert_allclose(jnp.sum(upper["inertia"]), 0.15 + 0.01 + across, rtol=1e-9)
    np.testing.assert_allclose(read.qvel(read.state([0.3], [2.0])), [2.0], rtol=1e-12)


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
    """Positions agree; for an angle θ MuJoCo's error is sin θ/2, jaxcon's 2 sin θ/2."""
    m = mujoco.MjModel.from_xml_string(model(WELDED, f"<equality>{equality}</equality>"))
    read, data = jc.from_mjcf(m), mujoco.MjData(m)
    qpos, qvel, _ = agreement.random_states(m, 3)
    for i in range(3):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(m, data)
        found = jc.violation(read.system, read.state(qpos[i], qvel[i]))
        expected = data.efc_pos.copy()  # MuJoCo has the angles of a weld in another frame
        rows = np.array(found.position)
        pairs = [(rows[:3], expected[:3])]
        if len(rows) == 6:
            pairs.append((rows[3:], 2 * expected[3:]))
        for x, y in pairs:
            np.testing.assert_allclose(np.linalg.norm(x), np.linalg.norm(y), rtol=1e-9)


def test_coupled_joints():
    """A cubic coupling, compared with MuJoCo's residual, and a locked joint."""
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


HINGE = f'<body name="b"><joint name="j" {{}}/>{BODY}{{}}</body>'
GEOM = '<geom name="{}" size="0.1 0.1 0.1" {}/>'
EGG = 'type="ellipsoid"'
REFUSED = {
    "shape": (
        model(HINGE.format("", GEOM.format("g", EGG)) + GEOM.format("floor", EGG)),
        r"contacts between '(g|floor) and (g|floor) \(ellipsoid and ellipsoid\)'",
    ),
}
REFUSED["mocap"] = (
    model(f'<body name="hand" mocap="true"/>{HINGE.format("", "")}'),
    "motions of the mocap bodies 'hand' are not supported",
)


@pytest.mark.parametrize("key", REFUSED)
def test_what_is_left_out_must_be_asked_for(key):
    text, match = REFUSED[key]
    key = key.split()[0]
    with pytest.raises(NotImplementedError, match=match):
        jc.from_mjcf(text)
    with pytest.raises(NotImplementedError, match=f"ignore=\\('{key}',\\)"):
        jc.from_mjcf(text)
    jc.from_mjcf(text, ignore=(key,))


def acting(actuator):
    return model(ARM, f"<actuator>{actuator}</actuator>")


UNSUPPORTED = {
    "trntype 'body'": model(
        HINGE.format("", ""), '<actuator><adhesion name="m" body="b" ctrlrange="0 1"/></actuator>'
    ),
    "site that cannot move in the world": model(
        HINGE.format("", "") + '<site name="s"/>', '<actuator><motor site="s"/></actuator>'
    ),
    "site that cannot move in the link": model(
        HINGE.format("", '<site name="s"/><site name="t"/>'),
        '<actuator><motor site="s" refsite="t"/></actuator>',
    ),
    "reference site in the body 'b', which does not carry": model(
        HINGE.format("", '<site name="s"/>') + f'<body><joint/>{BODY}<site name="t"/></body>',
        '<actuator><motor site="t" refsite="s"/></actuator>',
    ),
    "turned by 0.4 rad": model(
        HINGE.format("", '<site name="s" axisangle="0 0 1 0.4"/>') + '<site name="t"/>',
        '<actuator><position site="s" refsite="t" gear="0 0 0 0 0 1" kp="1"/></actuator>',
    ),
    "dyntype 'user'": acting('<general joint="turn" dyntype="user" actdim="1"/>'),
    "has 2 activations": acting('<general joint="turn" dyntype="user" actdim="2"/>'),
    "gaintype 'fixed' and the biastype 'muscle'; a muscle needs both": acting(
        '<general joint="turn" biastype="muscle" biasprm="0.75 1.05 1 200 0.5 1.6 1.5 1.3 1.2"'
        ' lengthrange="0 1"/>'
    ),
    "joint 'j' has an actuatorfrcrange and 2 actuators": model(
        HINGE.format('actuatorfrcrange="-1 1"', ""),
        '<actuator><motor joint="j"/><motor joint="j"/></actuator>',
    ),
    "surfacevel of geom 'floor'": model(
        HINGE.format("", GEOM.format("g", "")) + GEOM.format("floor", 'surfacevel="1 0 0 0 0 0"')
    ),
    "adhesion of geom 'g'": model(
        HINGE.format("", GEOM.format("g", 'adhesion="1"')) + GEOM.format("floor", "")
    ),
    "friction that depends on the direction, of floor and g": model(
        HINGE.format("", GEOM.format("g", "")) + GEOM.format("floor", ""),
        '<contact><pair geom1="floor" geom2="g" friction="1 0.5"/></contact>',
    ),
    "friction that depends on the direction, of floor and g \\(sphere": model(
        HINGE.format("", GEOM.format("g", "")) + GEOM.format("floor", ""),
        '<contact><pair geom1="floor" geom2="g" condim="6" friction="1 1 0 1 2"/></contact>',
    ),
    "gear with a force and a torque": model(
        f'<body><freejoint name="f"/>{BODY}</body>',
        '<actuator><motor joint="f" gear="1 0 0 0 1 0"/></actuator>',
    ),
    "'j', 'k'\\] of body 'b' pass each other": model(
        f'<body name="b"><joint name="j" axis="1 0 0"/>'
        f'<joint name="k" axis="0 1 0" pos="0 0 1"/>{BODY}</body>'
    ),
    "fluidshape of geom 'g'": model(
        HINGE.format("", GEOM.format("g", 'fluidshape="ellipsoid"')), options='density="1.2"'
    ),
    "actuatorgravcomp of joint 'j' beside": model(
        '<body gravcomp="1"><joint name="j" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>'
        f"{BODY}</body>",
        '<actuator><motor joint="j"/></actuator>',
    ),
    "actuatorgravcomp of joint 'j' in a model": model(
        f'<body gravcomp="1"><joint name="j" actuatorgravcomp="true"/>{BODY}</body>'
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


def test_three_hinges_beyond_gimbal_lock_are_refused():
    read = jc.from_mjcf(model(TREES["three hinges"]))
    with pytest.raises(ValueError, match="qpos\\[2\\] = 2 turns the middle .* 'body 2' beyond"):
        read.state(np.array([0.0, 0.1, 2.0, 0.1]), np.zeros(4))
