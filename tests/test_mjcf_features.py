"""Features of models beyond joints, compared with MuJoCo at 100 random states."""

import sys
from pathlib import Path

import pytest

import jaxcon as jc

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
