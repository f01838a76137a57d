"""A step contains no operation, loop or number of features that its scene does not have."""

import functools
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc
from jaxcon.execution.shell import masked_step
from jaxcon.staging.operations import count, primitives

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import needed  # noqa: E402

PLAIN = jc.Method(solver=jc.solvers.Sparse())


def jaxpr_of(system, state, method=PLAIN):
    """Returns the jaxpr of a step, with all numbers of the system as arguments."""
    layout = system.layout
    state = jc.init(system, method, state.q, state.v)
    control = jnp.zeros(layout.n_u) if layout.n_u else None
    args = (system, state, control, jnp.asarray(1e-3))
    return jax.make_jaxpr(lambda x, s, u, h: masked_step(x, method, s, u, h))(*args).jaxpr


def text(jaxpr):
    """Returns the printed jaxpr without memory addresses."""
    return re.sub(r"0x[0-9a-f]+", "", str(jaxpr))


def arm(*elements):
    """A planar body on a hinge, with more elements if given."""
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=0.1, position=(0.5, 1.0))
    for element in (jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 1.0)), *elements):
        scene.add(element)
    return scene.build()


def floor(**kind):
    """A contact of a ball at the arm's end with the floor."""
    return jc.PlaneContact("floor", jc.WORLD, "arm", radius=0.1, center=(0.5, 0.0), **kind)


FEATURES = {  # scene with the feature, scene without it, primitives that only the former has
    "contact": (lambda: arm(floor()), arm, {"while"}),
    "limit": (lambda: arm(jc.Limit("stop", "hinge", -1.0, 1.0)), arm, {"while"}),
    "friction of joints": (
        lambda: arm(jc.contacts.JointFriction("rub", "hinge", 0.1)),
        arm,
        {"while"},
    ),
    "rate motor": (lambda: arm(jc.contacts.RateMotor("turn", "hinge", 0.1)), arm, {"while"}),
    "spring": (
        lambda: arm(jc.Spring("spring", jc.WORLD, "arm", stiffness=5.0, point_a=(2.0, 2.0))),
        arm,
        {"sqrt"},
    ),
    "joint spring": (lambda: arm(jc.forces.JointSpring("spring", "hinge", 2.0)), arm, set()),
    "actuator": (lambda: arm(jc.forces.PositionServo("servo", "hinge", 2.0)), arm, set()),
    "motor": (lambda: arm(jc.Motor("motor", "hinge")), arm, set()),
    "rotor": (lambda: arm(jc.joints.Armature("rotor", "hinge", 0.1)), arm, set()),
    "friction of contacts": (
        lambda: arm(floor(friction=0.5)),
        lambda: arm(floor()),
        set(),
    ),
    "rolling resistance": (
        lambda: arm(floor(friction=0.5, rolling=1e-3)),
        lambda: arm(floor(friction=0.5)),
        set(),
    ),
    "restitution": (lambda: arm(floor(restitution=0.5)), lambda: arm(floor()), set()),
}


@pytest.mark.parametrize("name", FEATURES)
def test_a_feature_brings_code_and_takes_it_away(name):
    """With the feature there are more operations; without it there is none of its primitives."""
    own, bare, marks = FEATURES[name]
    with_, without = jaxpr_of(*own()), jaxpr_of(*bare())
    assert count(with_) > count(without)
    assert marks <= primitives(with_) - primitives(without)


SPRING = functools.partial(jc.forces.JointSpring, "spring", "hinge", 2.0)
METHODS = {  # a method, and a scene in which its extra part has nothing to do
    "events": (jc.Method(solver=jc.solvers.Sparse(), events=jc.integrators.Events()), arm),
    "bounded": (
        jc.Method(solver=jc.solvers.Sparse(), contact_solver=jc.solvers.GaussSeidel(7)),
        arm,
    ),
    "rank": (jc.Method(), arm),  # rows of a tree are independent
}


@pytest.mark.parametrize("name", METHODS)
def test_a_method_leaves_nothing_where_it_has_nothing_to_do(name):
    method, scene = METHODS[name]
    assert text(jaxpr_of(*scene(), method)) == text(jaxpr_of(*scene()))


def test_a_projection_is_there_where_it_was_asked_for():
    projected = jc.Method(stabilizer=jc.Projection(), solver=jc.solvers.Sparse())
    own, plain = jaxpr_of(*arm(), projected), jaxpr_of(*arm())
    assert "while" in primitives(own) - primitives(plain)
    split = jc.Method(solver=jc.solvers.Sparse(), events=jc.integrators.Events())
    stopped = arm(jc.Limit("stop", "hinge", -1.0, 1.0))
    assert count(jaxpr_of(*stopped, split)) > 2 * count(jaxpr_of(*stopped))


def test_what_was_built_before_leaves_nothing():
    """A scene with every feature is built in between."""
    before = text(jaxpr_of(*arm()))
    every = [floor(friction=0.5), jc.Limit("stop", "hinge", -1.0, 1.0), SPRING()]
    jaxpr_of(*arm(*every, jc.Motor("motor", "hinge")))
    assert text(jaxpr_of(*arm())) == before


@pytest.mark.parametrize("dim", [2, 3])
def test_a_branch_for_fast_turns_is_only_where_something_is_held(dim):
    """Free particles and bodies have no such branch."""
    place = (1.0, *(0.0,) * (dim - 1))
    inertia = 1.0 if dim == 2 else (1.0, 2.0, 3.0)
    for held in (False, True):
        bob, body = jc.Scene(dim=dim), jc.Scene(dim=dim)
        bob.add_particle("bob", mass=1.0, position=place)
        body.add_body("top", mass=1.0, inertia=inertia, position=place)
        if held:
            bob.add(jc.Distance("rod", jc.WORLD, "bob"))
            joint = jc.Revolute if dim == 2 else jc.Spherical
            body.add(joint("tip", jc.WORLD, "top", point=(0.0,) * dim))
        for scene in (bob, body):
            assert ("cond" in primitives(jaxpr_of(*scene.build()))) == held


def force_of(scene):
    """Returns the jaxpr of f."""
    system, state = scene.build()
    return jax.make_jaxpr(system.force)(state.q, state.v, state.time).jaxpr


def test_gyroscopic_torque_is_that_of_bodies_that_turn_in_space():
    """Gravity alone is one product by axis; ω × Iω reads the velocities and has six more."""
    free, body, plane = jc.Scene(), jc.Scene(), jc.Scene(dim=2)
    free.add_particle("bob", mass=1.0)
    body.add_body("top", mass=1.0, inertia=(1.0, 2.0, 3.0))
    plane.add_body("disc", mass=1.0, inertia=1.0)
    assert count(force_of(body)) > count(force_of(free))
    for scene in (free, plane):
        products = [e for e in force_of(scene).eqns if e.primitive.name == "mul"]
        assert len(products) == scene.dim


MODEL = """<mujoco>{option}<worldbody>{ground}
  <body name="arm" pos="0 0 1"><joint name="swing" axis="0 1 0" {joint}/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02"/></body></worldbody>{more}</mujoco>"""
GROUND = '<geom type="plane" size="1 1 1"/>'


def read(joint="", ground="", option="", more="", ignore=()):
    """Returns the system of a MuJoCo model."""
    text = MODEL.format(joint=joint, ground=ground, option=option, more=more)
    return jc.from_mjcf(text, ignore).system


def flag(name):
    """Returns the option that disables a feature of a model."""
    return f'<option><flag {name}="disable"/></option>'


LIMITED = 'limited="true" range="-30 30"'
REMOVED = {  # a model with the feature, and the changes that turn it off
    "contact ignored": ({"ground": GROUND}, {"ignore": ("contact",)}),
    "contact disabled": ({"ground": GROUND}, {"option": flag("contact")}),
    "limit ignored": ({"joint": LIMITED}, {"ignore": ("limit",)}),
    "limit disabled": ({"joint": LIMITED}, {"option": flag("limit")}),
    "limit off": ({"joint": LIMITED}, {"joint": 'limited="false" range="-30 30"'}),
    "friction": ({"joint": 'frictionloss="0.1"'}, {"joint": 'frictionloss="0"'}),
    "friction disabled": ({"joint": 'frictionloss="0.1"'}, {"option": flag("frictionloss")}),
    "spring": ({"joint": 'stiffness="1"'}, {"joint": 'stiffness="0"'}),
    "damping": ({"joint": 'damping="1"'}, {"joint": 'damping="0"'}),
    "armature": ({"joint": 'armature="0.1"'}, {"joint": 'armature="0"'}),
}


@pytest.mark.parametrize("name", REMOVED)
def test_what_a_model_turns_off_is_not_in_its_system(name):
    """Structures and shapes are equal, and they alone determine the step."""
    pytest.importorskip("mujoco")
    own, changes = REMOVED[name]
    with_, off, never = read(**own), read(**own | changes), read()
    structure = jax.tree.structure
    assert structure(off) == structure(never)
    assert structure(with_) != structure(never)
    shapes = [[np.shape(x) for x in jax.tree.leaves(s)] for s in (off, never)]
    assert shapes[0] == shapes[1]


def test_scenes_need_more_the_more_they_have():
    """Runs the study on its small scenes."""
    found = [needed.measure(name, None) for name in ("particle", "rod", "planar pendulum")]
    assert [(x.positions, x.velocities, x.rows, x.bounded) for x in found] == [
        (2, 2, 0, 0),
        (2, 2, 1, 0),
        (3, 3, 2, 0),
    ]
    assert found[0].operations < found[1].operations < found[2].operations
    assert found[0].operations < 50
    assert "| rod | 2 | 2 | 1 | 0 |" in needed.line(found[1])
