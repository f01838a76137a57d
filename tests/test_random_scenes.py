"""Random mechanisms under the default method; `python -m benchmarks.random_scenes` runs many."""

import sys
from pathlib import Path

import pytest

import jaxcon as jc

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import random_scenes  # noqa: E402


@pytest.mark.filterwarnings("ignore:.*impacts")
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_random_mechanism_is_simulated_as_it_should(dim, seed):
    """Checks status, energy, joints, momentum and batches; for seed 0 derivatives, too."""
    assert random_scenes.check(dim, seed, derivatives=seed == 0).wrong == {}


def test_a_wrong_motion_is_found():
    """Tests the study itself: with explicit Euler joints drift and energy grows."""
    method = jc.Method(jc.integrators.ExplicitEuler(), jc.stabilizers.Unstabilized())
    assert random_scenes.check(2, 1, derivatives=False, method=method).wrong
