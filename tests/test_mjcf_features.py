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

AGREE = 1e-8
"""Tolerance of accelerations, relative to the largest one of a state."""
BODY = '<inertial pos="0.1 0.02 -0.2" mass="1.3" fullinertia="0.06 0.05 0.04 0.01 0.005 -0.004"/>'
SMALL = '<inertial pos="0 0.1 0" quat="1 0.3 0 0.2" mass="0.7" diaginertia="0.02 0.03 0.025"/>'


def model(bodies, rest="", options=""):
    return mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><option><flag contact="disable" limit="disable"/>'
        f"{options}</option><worldbody>{bodies}</worldbody>{rest}</mujoco>"
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
