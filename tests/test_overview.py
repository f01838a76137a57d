"""`python -m jaxcon model`: what is read from a model of MuJoCo."""

import pytest

pytest.importorskip("mujoco")

from jaxcon.__main__ import main, rollout_rate  # noqa: E402
from jaxcon.io.mjcf import from_mjcf  # noqa: E402

ARM = """<mujoco model="arm"><worldbody><geom type="plane" size="1 1 1"/>
<body name="upper" pos="0 0 2"><joint name="shoulder" range="-1 1" limited="true" damping="1"/>
<geom type="capsule" size="0.05 0.2"/>
<body name="hand" pos="0 0 -0.5"><joint/><geom size="0.1"/>
<body name="tip"><geom size="0.05"/></body></body></body></worldbody>
<actuator><motor joint="shoulder"/></actuator>
<sensor><jointpos joint="shoulder"/></sensor></mujoco>"""
EGGS = """<mujoco><worldbody><geom type="ellipsoid" size="1 2 3"/>
<body pos="0 0 9"><freejoint/><geom type="ellipsoid" size="1 2 3" condim="3"/></body>
</worldbody></mujoco>"""


@pytest.fixture
def written(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "model.xml"
        path.write_text(text)
        return str(path)

    return write


def test_a_model_is_described(written, capsys):
    assert main(["model", written(ARM), "--quick"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "arm"
    assert "bodies upper, hand" in lines
    assert "merged bodies 1 without a joint" in lines
    assert "coordinates 2 positions and 2 velocities in MuJoCo" in lines
    assert "joints 2 hinge" in lines
    assert "limits 1 of joints and tendons" in lines
    assert "actuators 1 joint" in lines
    assert "sensors 1 jointpos" in lines
    assert "contacts 2 plane and sphere, 1 plane and capsule" in lines


def test_all_reasons_of_a_refusal_are_told(written, capsys):
    wet = EGGS.replace("<worldbody>", '<option density="1"/><worldbody>')
    assert main(["model", written(wet.replace("condim", 'fluidshape="ellipsoid" condim'))]) == 1
    out = capsys.readouterr().out
    assert "contacts 1 of shapes without contact" in " ".join(out.split())
    assert "ignore=('shape',)" in out
    assert "fluidshape" in out
    assert main(["model", written(EGGS), "--ignore", "shape", "--quick"]) == 0


def test_a_file_that_cannot_be_read_is_named(tmp_path, capsys):
    assert main(["model", str(tmp_path / "none.xml")]) == 2
    assert "there is no file" in capsys.readouterr().out


def test_the_model_is_drawn_and_timed(written, tmp_path, capsys):
    picture = tmp_path / "arm.png"
    assert main(["model", written(ARM), "--batch", "4", "--picture", str(picture)]) == 0
    assert "steps/s" in capsys.readouterr().out
    assert picture.stat().st_size > 1000
    compiling, rate = rollout_rate(from_mjcf(ARM), 3, steps=5)
    assert compiling > 0
    assert rate > 0
