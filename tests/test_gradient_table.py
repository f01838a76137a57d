"""Every pair of parts of a method, on every joint: both modes against differences."""

import itertools
import sys
from pathlib import Path

import pytest
import scenes
from compiling import quick_jit

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import gradient_table  # noqa: E402

CHOICES = gradient_table.covering(gradient_table.choices())
JOINTS = scenes.names("between")
PLANE = [name for name in JOINTS if "2d" in name]
HELD = [name for name in PLANE if scenes.JOINTS[name.split("-")[0]].held is None]


def cases():
    """Each integrator takes its joints in turn: the cheapest all of them, RATTLE those with a φ."""
    joints = {"semi-implicit Euler": JOINTS, "RATTLE": HELD}
    turns = {name: itertools.cycle(joints.get(name, PLANE)) for name in gradient_table.INTEGRATORS}
    return [(next(turns[choice.integrator]), choice) for choice in CHOICES]


@pytest.mark.parametrize(("name", "choice"), cases(), ids=str)
def test_both_modes_are_differences(name, choice):
    built = scenes.build(name)
    subject = gradient_table.Subject(built.system, built.state, built.parameters)
    row = gradient_table.measure(choice, name, subject, quick_jit)
    assert row.holds, row
