"""Small version of `benchmarks.mjcf_agreement`: Gymnasium's models and closed loops."""

import sys
from pathlib import Path

import pytest

mujoco = pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import mjcf_agreement as agreement  # noqa: E402


@pytest.mark.parametrize("name", ["hopper", "inverted_double_pendulum"])
def test_accelerations_of_gymnasium_models_are_those_of_mujoco(name):
    assert agreement.acceleration_error(agreement.load(name), 10) < agreement.ACCELERATION


def test_a_trajectory_of_a_gymnasium_model_is_that_of_mujoco():
    model = agreement.load("point")
    assert agreement.trajectory_error(model, seconds=0.05) < agreement.TRAJECTORY


def test_a_closed_loop_is_the_limit_of_mujocos_and_closes_better():
    """The error is proportional to 1 − d, with MuJoCo's impedance d.

    The loop closes with a smaller gap than MuJoCo's.
    """
    found = agreement.loop_agreement("four_bar")
    assert found.errors[-1] < 2e-4
    for coarse, fine in zip(found.errors, found.errors[1:], strict=False):
        assert 9 < coarse / fine < 11
    assert found.limit < 1e-6
    assert found.closure < found.peer
