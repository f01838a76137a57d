"""Starts with violations of a tenth of the scene's size: corrected, or refused with a status."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.scenes import four_bar

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.stabilisation import INTEGRATORS, STABILIZERS, spatial_loop  # noqa: E402

SCENES = {"four_bar": four_bar, "spatial_loop": spatial_loop}
EULER = "semi-implicit Euler"
LAWS = [name for name in STABILIZERS if name != "none"]
PAIRS = [("four_bar", EULER, law) for law in LAWS] + [
    ("four_bar", "RK4", "Baumgarte"),
    ("four_bar", "RATTLE", "none"),
    ("spatial_loop", EULER, "Baumgarte, 50/s"),
    ("spatial_loop", "RATTLE", "none"),
]


def displaced(name):
    """Returns the scene with every coordinate displaced by up to 0.1 m or rad."""
    system, state = SCENES[name]()
    step = np.random.default_rng(0).uniform(-0.1, 0.1, state.v.shape)
    return system, dataclasses.replace(state, q=system.retract(state.q, jnp.asarray(step)))


def run(name, integrator, law):
    system, state = displaced(name)
    method = jc.Method(INTEGRATORS[integrator], STABILIZERS[law])
    assert jc.violation(system, state).worst > 0.05

    @jax.jit
    def two_seconds(state):
        start = jc.init(system, method, state.q, state.v)
        final, _ = jc.rollout(system, method, start, None, 1e-3, 2000, record=lambda s, i: None)
        return final.status, jc.violation(system, final).worst

    status, off = two_seconds(state)
    return jc.Status(int(status)), float(off)


@pytest.mark.parametrize(("name", "integrator", "law"), PAIRS)
def test_a_method_finds_its_way_back(name, integrator, law):
    status, off = run(name, integrator, law)
    assert status in (jc.Status.OK, jc.Status.CONFLICT)  # CONFLICT in the first steps
    assert off < (5e-3 if law == "PID" else 1e-3)  # the integral of PID decays slowly


def test_without_a_stabilizer_it_stays_off():
    status, off = run("four_bar", EULER, "none")
    assert status == jc.Status.OK
    assert off > 0.05


@pytest.mark.parametrize("name", SCENES)
def test_an_implicit_step_finds_its_way_back_or_says_that_it_cannot(name):
    status, off = run(name, "generalized-α", "none")
    assert status == jc.Status.NOT_CONVERGED or off < 1e-3
