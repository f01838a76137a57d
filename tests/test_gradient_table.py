"""Pairs of method parts, on every joint: derivatives of both modes compared with differences."""

import functools
import itertools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

sys.path.insert(0, str(Path(__file__).parents[1]))

import jaxcon as jc  # noqa: E402
from benchmarks import gradient_table  # noqa: E402
from jaxcon.scenes import four_bar  # noqa: E402


def pairs(choice):
    """Returns the pairs of parts of a choice whose code interacts.

    Solvers do not see the stabilizer, and all Runge–Kutta tableaus run the same code. The benchmark
    covers all pairs, and the whole product.
    """
    table = "Heun" if choice.integrator == "RK4" else choice.integrator
    acts = {choice.stabilizer, choice.solver}
    return {(table, x) for x in acts} | {(choice.dtype, x) for x in acts | {choice.integrator}}


CHOICES = gradient_table.covering(gradient_table.choices(), pairs)
JOINTS = scenes.names("between")
SLOW = {"telescope-3d-between": "universal-3d-between"}  # the telescope takes a minute to compile
SPACE = [SLOW.get(name, name) for name in JOINTS if "3d" in name][::3]
PLANE = [name for name in JOINTS if "2d" in name]
HELD = [name for name in PLANE if scenes.JOINTS[name.split("-")[0]].held is None]


def cases():
    """Returns the cheapest integrator with every joint, and each other integrator with one joint.

    RATTLE takes joints whose rows all have a φ.
    """
    cheap = [choice for choice in CHOICES if choice.integrator == "semi-implicit Euler"]
    turns = {name: itertools.cycle(PLANE) for name in gradient_table.INTEGRATORS}
    turns["RATTLE"] = itertools.cycle(HELD)
    others = [(next(turns[c.integrator]), c) for c in CHOICES if c not in cheap]
    return [*zip([*PLANE, *SPACE], itertools.cycle(cheap), strict=False), *others]


@pytest.mark.parametrize(("name", "choice"), cases(), ids=str)
def test_both_modes_are_differences(name, choice):
    built = scenes.build(name)
    subject = gradient_table.Subject(built.system, built.state, built.parameters)
    row = gradient_table.measure(choice, name, subject)
    assert row.holds, row


METHODS = {
    "default": jc.Method(),
    "projected": jc.Method(jc.integrators.Heun(), jc.Projection()),
    "hybrid": jc.Method(stabilizer=gradient_table.STABILIZERS["hybrid"]),
    "RATTLE": jc.Method(jc.integrators.RATTLE()),
}
SPOTS = [*((2, "float64", name) for name in METHODS), (2, "float32", "default")]
SPOTS += [(3, "float32", "default")]


def straight(dim, dtype):
    """A straight chain at rest with φ = 0, and a spring of length zero at its end."""
    scene = jc.Scene(dim=dim, gravity=(0.0,) * dim, dtype=dtype)
    axis = None if dim == 2 else (0.0, 1.0, 0.0)
    places, before = np.eye(dim)[0], jc.WORLD
    for i, link in enumerate(("first", "second")):
        inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
        scene.add_body(link, mass=1.0, inertia=inertia, position=(i + 0.5) * places)
        scene.add(jc.Revolute(f"{link}_hinge", before, link, point=i * places, axis=axis))
        before = link
    ends = {"point_a": 2 * places, "point_b": 2 * places}
    scene.add(jc.Spring("spring", jc.WORLD, "second", stiffness=1.0, damping=1.0, **ends))
    return scene.build()


@pytest.mark.parametrize(("dim", "dtype", "name"), SPOTS)
def test_singular_spots_have_finite_derivatives(dim, dtype, name):
    parameters = (("first", "mass"), ("second_hinge", "anchor_b"))
    subject = gradient_table.Subject(*straight(dim, dtype), parameters)
    method = jax.tree.map(lambda x: jnp.asarray(x, dtype), METHODS[name])
    gradient = jax.jit(jax.grad(functools.partial(subject.outcome, method)))(subject.numbers())
    for path, leaf in jax.tree.leaves_with_path(gradient):
        assert np.all(np.isfinite(leaf)), path


def test_a_thousand_random_states_have_finite_derivatives():
    subject = gradient_table.Subject(*four_bar(), (("rocker", "mass"),))
    assert gradient_table.broken(subject, jc.Method(), 1000) == 0
