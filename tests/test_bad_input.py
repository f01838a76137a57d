"""Mistakes of users: each error names the culprit, the value given, and a remedy.

The words of each case must appear in the message in this order.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

import jaxcon as jc
from jaxcon.core import checks


def scene(dim=3, **options):
    """A scene of two bodies and a particle."""
    s = jc.Scene(dim=dim, **options)
    inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
    for i, name in enumerate(("arm", "leg")):
        s.add_body(name, mass=1.0, inertia=inertia, position=(i,) + (0,) * (dim - 1))
    s.add_particle("bob", mass=1.0, position=(2,) + (0,) * (dim - 1))
    return s


def build(*elements, dim=3):
    s = scene(dim)
    for element in elements:
        s.add(element)
    return s.build()


def body(dim=3, **given):
    s = jc.Scene(dim=dim)
    s.add_body("arm", **({"mass": 1.0, "inertia": 1.0 if dim == 2 else (1.0,) * 3} | given))
    return s.build()


def particle(**given):
    s = jc.Scene(dim=2)
    s.add_particle("bob", **given)
    return s.build()


def twice(first, second):
    s = scene()
    s.add(first)
    s.add(second)


ORIGIN = (0.0, 0.0, 0.0)
Z = (0.0, 0.0, 1.0)
F32 = jnp.float32


def flat(a, t, p):
    return a.position


def matrix(a, t, p):
    return jnp.outer(a.position, a.position)


def tuples(a, t, p):
    return a.position[0], a.position[1]


def number(a, t, p):
    return a.position[0]


def whole(a, t, p):
    return jnp.ones(1, int)


def quadratic(a, t, p):
    return a.velocity * a.velocity


def bent(q, v, t, p):
    return (v @ v)[None]


def two_arguments(a, p):
    return a.position


def three_arguments(x, t, p):
    return x[1:]


def sheet(x, p):
    return x[:1]


def touching(x, p):
    return (x[:1] - p) ** 2


def nothing(q, t, p):
    return q[:0]


MISTAKES = {
    # names
    "unknown body": (
        lambda: build(jc.Distance("d", "arm", "lag")),
        ["Distance 'd'", "'lag' is unknown", "'leg'"],
    ),
    "unknown body of a force": (
        lambda: build(jc.forces.Force("f", "lag", Z)),
        ["Force 'f'", "'lag' is unknown", "'leg'"],
    ),
    "unknown joint of a drive": (
        lambda: build(jc.joints.Drive("d", "hinge", scenes.wave)),
        ["Drive 'd'", "joint 'hinge' is unknown"],
    ),
    "unknown joint of a spring": (
        lambda: build(jc.Fixed("bolt", "arm", "leg"), jc.forces.JointSpring("s", "hinge", 1.0)),
        ["JointSpring 's'", "joint 'hinge' is unknown", "'bolt'"],
    ),
    "unknown body of a constraint": (
        lambda: build(jc.joints.Holonomic(flat, bodies=("lag",), name="h")),
        ["Holonomic 'h'", "'lag' is unknown", "'leg'"],
    ),
    "body twice": (lambda: scene().add_body("arm", mass=1, inertia=Z), ["'arm' is taken"]),
    "particle named as a body": (lambda: scene().add_particle("arm", mass=1), ["'arm' is taken"]),
    "joint twice": (
        lambda: twice(jc.Fixed("j", "arm", "leg"), jc.Fixed("j", "arm", "bob")),
        ["'j' is taken"],
    ),
    "joint named as a body": (
        lambda: scene().add(jc.Fixed("arm", "arm", "leg")),
        ["'arm' is taken"],
    ),
    "two nameless user constraints": (
        lambda: twice(jc.joints.Holonomic(flat, ("arm",)), jc.joints.Holonomic(flat, ("leg",))),
        ["'holonomic' is taken"],
    ),
    "reserved name": (
        lambda: scene().add_body("world", mass=1, inertia=Z),
        ["'world' is reserved"],
    ),
    "empty name": (lambda: scene().add_particle("", mass=1), ["name", "''"]),
    "name that is a number": (lambda: scene().add_particle(3, mass=1), ["name", "3"]),
    # bodies of joints
    "joint to itself": (
        lambda: build(jc.Distance("d", "arm", "arm")),
        ["Distance 'd'", "'arm' to itself"],
    ),
    "joint of the world to itself": (
        lambda: build(jc.Distance("d", jc.WORLD, jc.WORLD)),
        ["Distance 'd'", "itself"],
    ),
    "fixed joint on a particle": (
        lambda: build(jc.Fixed("j", "arm", "bob")),
        ["Fixed 'j'", "orientation", "'bob' is a particle"],
    ),
    "revolute joint on a particle": (
        lambda: build(jc.Revolute("j", "bob", "arm", point=ORIGIN, axis=Z)),
        ["Revolute 'j'", "orientation", "'bob' is a particle"],
    ),
    "prismatic joint on a particle": (
        lambda: build(jc.Prismatic("j", jc.WORLD, "bob", axis=Z)),
        ["Prismatic 'j'", "orientation", "'bob' is a particle"],
    ),
    "point away from a particle": (
        lambda: build(jc.joints.Coincident("j", "arm", "bob", point=ORIGIN)),
        ["Coincident 'j'", "particle", "2.0"],
    ),
    "point of a distance away from a particle": (
        lambda: build(jc.Distance("j", "arm", "bob", point_b=(5.0, 0.0, 0.0))),
        ["Distance 'j'", "point_b", "5.0", "particle", "2.0"],
    ),
    "spring on a point away from a particle": (
        lambda: build(jc.Spring("s", "arm", "bob", 1.0, point_b=(5.0, 0.0, 0.0))),
        ["Spring 's'", "point_b", "5.0", "particle", "2.0"],
    ),
    "spherical joint in the plane": (
        lambda: build(jc.Spherical("j", "arm", "leg", point=(0, 0)), dim=2),
        ["Spherical 'j'", "3 dimensions only"],
    ),
    "universal joint in the plane": (
        lambda: build(jc.joints.Universal("j", "arm", "leg", (0, 0), (1, 0), (0, 1)), dim=2),
        ["Universal 'j'", "3 dimensions only"],
    ),
    "universal joint on a particle": (
        lambda: build(jc.joints.Universal("j", jc.WORLD, "bob", ORIGIN, (1, 0, 0), Z)),
        ["Universal 'j'", "orientation", "'bob' is a particle"],
    ),
    "screw joint in the plane": (
        lambda: build(jc.joints.Screw("j", "arm", "leg", axis=(1, 0), lead=0.1), dim=2),
        ["Screw 'j'", "3 dimensions only"],
    ),
    "sleeve on a particle": (
        lambda: build(jc.joints.Cylindrical("j", jc.WORLD, "bob", axis=Z)),
        ["Cylindrical 'j'", "orientation", "'bob' is a particle"],
    ),
    "line of a particle": (
        lambda: build(jc.joints.PointOnLine("j", "bob", "arm", axis=Z)),
        ["PointOnLine 'j'", "orientation", "'bob' is a particle", "body_b"],
    ),
    "rod hinged to a particle": (
        lambda: build(
            jc.joints.RevoluteSpherical("j", "bob", "arm", hinge=(2, 0, 0), ball=ORIGIN, axis=Z)
        ),
        ["RevoluteSpherical 'j'", "orientation", "'bob' is a particle", "body_b"],
    ),
    "drive of a joint without a coordinate": (
        lambda: build(jc.Fixed("bolt", "arm", "leg"), jc.joints.Drive("d", "bolt", scenes.wave)),
        ["Drive 'd'", "'bolt' has no coordinate"],
    ),
    "bodies as a string": (
        lambda: build(jc.joints.Holonomic(flat, bodies="arm", name="h")),
        ["Holonomic 'h'", "tuple", "'arm'"],
    ),
    "not an element": (lambda: scene().add("hinge"), ["joint, constraint or force", "hinge"]),
    "a class": (lambda: scene().add(jc.Revolute), ["joint, constraint or force", "Revolute"]),
    "a class of constraints": (
        lambda: scene().add(jc.joints.Holonomic),
        ["joint, constraint or force", "Holonomic"],
    ),
    # numbers out of range
    "mass of zero": (lambda: body(mass=0.0), ["body 'arm'", "mass", "positive", "0.0"]),
    "negative mass": (lambda: particle(mass=-1), ["particle 'bob'", "mass", "positive", "-1.0"]),
    "mass that is not a number": (
        lambda: particle(mass=float("nan")),
        ["particle 'bob'", "mass", "nan"],
    ),
    "infinite mass": (lambda: particle(mass=np.inf), ["particle 'bob'", "mass", "finite", "inf"]),
    "no mass": (lambda: particle(mass=None), ["particle 'bob'", "mass", "inertia that"]),
    "body without mass": (lambda: body(mass=None), ["body 'arm'", "mass", "inertia that"]),
    "inertia of zero": (
        lambda: body(inertia=(1, 1, 0)),
        ["body 'arm'", "inertia", "positive", "0.0"],
    ),
    "negative inertia": (
        lambda: body(2, inertia=-1),
        ["body 'arm'", "inertia", "positive", "-1.0"],
    ),
    "no inertia": (lambda: body(inertia=None), ["body 'arm'", "inertia is needed"]),
    "inertia against the triangle inequality": (
        lambda: body(inertia=(1, 1, 3)),
        ["body 'arm'", "triangle inequality"],
    ),
    "tensor that is not symmetric": (
        lambda: body(inertia=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]),
        ["body 'arm'", "symmetric"],
    ),
    "tensor that is not definite": (
        lambda: body(inertia=np.diag([1.0, 1.0, -1.0])),
        ["moments", "-1.0"],
    ),
    "mass twice": (
        lambda: body(mass=1.0, inertia=jc.inertia.sphere(1.0, 1.0)),
        ["body 'arm'", "mass= or an Inertia, not both"],
    ),
    "solid without size": (lambda: jc.inertia.sphere(1.0, 0.0), ["sphere", "radius", "0.0"]),
    "position that is not a number": (
        lambda: body(position=(0, np.nan, 0)),
        ["body 'arm'", "position", "finite", "nan"],
    ),
    "quaternion of zero": (
        lambda: body(quaternion=(0, 0, 0, 0)),
        ["body 'arm'", "quaternion", "length"],
    ),
    "axis of length zero": (
        lambda: build(jc.Revolute("j", "arm", "leg", point=ORIGIN, axis=ORIGIN)),
        ["Revolute 'j'", "axis", "length", "0.0"],
    ),
    "slider axis of length zero": (
        lambda: build(jc.Prismatic("j", "arm", "leg", axis=ORIGIN)),
        ["Prismatic 'j'", "axis", "length", "0.0"],
    ),
    "cross axis of length zero": (
        lambda: build(jc.joints.Universal("j", "arm", "leg", ORIGIN, axis_a=Z, axis_b=ORIGIN)),
        ["Universal 'j'", "axis_b", "length", "0.0"],
    ),
    "cross axes that are not perpendicular": (
        lambda: build(jc.joints.Universal("j", "arm", "leg", ORIGIN, axis_a=Z, axis_b=(0, 3, 4))),
        ["Universal 'j'", "axis_a and axis_b", "perpendicular", "0.8"],
    ),
    "distance of zero": (
        lambda: build(jc.Distance("d", "arm", "leg", length=0)),
        ["Distance 'd'", "length", "positive", "0.0"],
    ),
    "distance between equal points": (
        lambda: build(jc.Distance("d", jc.WORLD, "arm")),
        ["Distance 'd'", "length", "positive", "0.0"],
    ),
    "negative distance": (
        lambda: build(jc.Distance("d", "arm", "leg", length=-2)),
        ["Distance 'd'", "length", "positive", "-2.0"],
    ),
    "screw without a lead": (
        lambda: build(jc.joints.Screw("j", "arm", "leg", axis=Z)),
        ["Screw 'j'", "lead", "one turn"],
    ),
    "screw with a lead of zero": (
        lambda: build(jc.joints.Screw("j", "arm", "leg", axis=Z, lead=0.0)),
        ["Screw 'j'", "lead", "0.0"],
    ),
    "shafts that point at each other": (
        lambda: build(
            jc.joints.ConstantVelocity("j", "arm", "leg", ORIGIN, axis=Z, axis_b=(0, 0, -1))
        ),
        ["ConstantVelocity 'j'", "axis and axis_b", "opposite", "from a to b"],
    ),
    "rod of length zero": (
        lambda: build(jc.joints.RevoluteSpherical("j", "arm", "leg", hinge=Z, ball=Z, axis=Z)),
        ["RevoluteSpherical 'j'", "hinge to ball", "positive", "0.0"],
    ),
    "rod oblique to its hinge": (
        lambda: build(
            jc.joints.RevoluteSpherical("j", "arm", "leg", hinge=ORIGIN, ball=(0, 3, 4), axis=Z)
        ),
        ["RevoluteSpherical 'j'", "normal to the axis", "0.8"],
    ),
    "ball of radius zero": (
        lambda: build(jc.joints.RollingSphere("r", jc.WORLD, "arm", radius=0.0)),
        ["RollingSphere 'r'", "radius", "positive", "0.0"],
    ),
    "ball that rolls in the plane": (
        lambda: build(jc.joints.RollingSphere("r", jc.WORLD, "arm", radius=1.0), dim=2),
        ["RollingSphere 'r'", "3 dimensions only"],
    ),
    "cylinder that stands on its plane": (
        lambda: build(jc.joints.RollingCylinder("r", jc.WORLD, "arm", radius=1.0, axis=(0, 3, 4))),
        ["RollingCylinder 'r'", "axis", "parallel", "0.8"],
    ),
    "disc that lies flat": (
        lambda: build(jc.joints.RollingDisc("r", jc.WORLD, "arm", radius=1.0, axis=Z)),
        ["RollingDisc 'r'", "flat", "axis", "normal"],
    ),
    "disc without an axis": (
        lambda: build(jc.joints.RollingDisc("r", jc.WORLD, "arm", radius=1.0)),
        ["RollingDisc 'r'", "axis", "none"],
    ),
    "axis of a disc in the plane": (
        lambda: build(jc.joints.RollingDisc("r", jc.WORLD, "arm", radius=1.0, axis=Z), dim=2),
        ["RollingDisc 'r'", "in the plane", "axis"],
    ),
    "particle that rolls": (
        lambda: build(jc.joints.RollingDisc("r", jc.WORLD, "bob", radius=1.0, axis=Z)),
        ["RollingDisc 'r'", "orientation", "'bob' is a particle"],
    ),
    "normal of length zero": (
        lambda: build(jc.joints.RollingSphere("r", jc.WORLD, "arm", radius=1.0, normal=ORIGIN)),
        ["RollingSphere 'r'", "normal", "length", "0.0"],
    ),
    "ice in the plane": (
        lambda: build(jc.joints.KnifeEdge("k", jc.WORLD, "arm", edge=(1, 0), normal=(0, 1)), dim=2),
        ["KnifeEdge 'k'", "in the plane", "normal"],
    ),
    "edge of another dimension": (
        lambda: build(jc.joints.KnifeEdge("k", jc.WORLD, "arm", edge=(1, 0))),
        ["KnifeEdge 'k'", "edge", r"\(3,\)", r"\(2,\)"],
    ),
    "negative stiffness": (
        lambda: build(jc.Spring("s", "arm", "leg", stiffness=-1)),
        ["Spring 's'", "stiffness", "zero or more", "-1.0"],
    ),
    "negative damping of a joint": (
        lambda: build(
            jc.Revolute("j", "arm", "leg", point=ORIGIN, axis=Z),
            jc.forces.JointSpring("s", "j", 1.0, damping=-1.0),
        ),
        ["JointSpring 's'", "damping", "zero or more", "-1.0"],
    ),
    "force that is not a number": (
        lambda: build(jc.forces.Force("f", "arm", (0, np.inf, 0))),
        ["force 'f'", "force", "finite", "inf"],
    ),
    # shapes and dtypes
    "position of another dimension": (
        lambda: body(position=(0, 0)),
        ["body 'arm'", "position", r"\(3,\)", r"\(2,\)"],
    ),
    "inertia of the plane in space": (
        lambda: body(inertia=1.0),
        ["body 'arm'", "inertia", r"\(3,\)", r"\(\)"],
    ),
    "inertia of space in the plane": (
        lambda: body(2, inertia=np.eye(2)),
        ["body 'arm'", "inertia", r"\(\)", r"\(2, 2\)"],
    ),
    "principal moments in the plane": (
        lambda: body(2, inertia=(1.0, 2.0, 3.0)),
        ["body 'arm'", "inertia", r"shape \(\) in the plane", r"\(3,\)", "give the third"],
    ),
    "mass as a list": (
        lambda: particle(mass=[1.0]),
        ["particle 'bob'", "mass", r"\(\)", r"\(1,\)"],
    ),
    "mass as a word": (lambda: particle(mass="heavy"), ["particle 'bob'", "mass", "heavy"]),
    "ragged position": (lambda: body(position=[1, [2], 3]), ["body 'arm'", "position", "numbers"]),
    "complex mass": (lambda: particle(mass=1j), ["particle 'bob'", "mass", "1j"]),
    "point of another dimension": (
        lambda: build(jc.joints.Coincident("j", "arm", "leg", point=(0, 0))),
        ["Coincident 'j'", "point", r"\(3,\)", r"\(2,\)"],
    ),
    "gravity as a number": (
        lambda: jc.Scene(gravity=-9.81),
        ["Scene", "gravity", r"\(3,\)", r"\(\)"],
    ),
    "four dimensions": (lambda: jc.Scene(dim=4), ["dim must be 2 or 3", "4"]),
    "dimension as a word": (lambda: jc.Scene(dim="2"), ["dim must be 2 or 3", "'2'"]),
    "half precision": (lambda: jc.Scene(dtype=jnp.float16), ["float32 or float64", "float16"]),
    "float32 in a float64 scene": (
        lambda: body(position=jnp.zeros(3, F32)),
        ["body 'arm'", "position is float32", "scene is float64"],
    ),
    "float32 in a joint": (
        lambda: build(jc.joints.Coincident("j", "arm", "leg", point=jnp.zeros(3, F32))),
        ["Coincident 'j'", "point is float32", "scene is float64"],
    ),
    "quaternion in the plane": (
        lambda: body(2, quaternion=(1, 0, 0, 0)),
        ["body 'arm'", "2 dimensions", "angle=, not quaternion="],
    ),
    "angle in space": (
        lambda: body(angle=1.0),
        ["body 'arm'", "3 dimensions", "quaternion=, not angle="],
    ),
    "hinge axis in the plane": (
        lambda: build(jc.Revolute("j", "arm", "leg", point=(0, 0), axis=Z), dim=2),
        ["Revolute 'j'", "in the plane", "axis"],
    ),
    "no hinge axis in space": (
        lambda: build(jc.Revolute("j", "arm", "leg", point=ORIGIN)),
        ["Revolute 'j'", r"axis \(3,\)", "none"],
    ),
    "slider axis of space in the plane": (
        lambda: build(jc.Prismatic("j", "arm", "leg", axis=Z), dim=2),
        ["Prismatic 'j'", "axis", r"\(2,\)", r"\(3,\)"],
    ),
    "no slider axis": (
        lambda: build(jc.Prismatic("j", "arm", "leg", axis=None), dim=2),
        ["Prismatic 'j'", "axis", "none"],
    ),
    "no cross axis": (
        lambda: build(jc.joints.Universal("j", "arm", "leg", ORIGIN, axis_a=None, axis_b=Z)),
        ["Universal 'j'", r"axis_a \(3,\)", "none"],
    ),
    "cross axis of the plane": (
        lambda: build(jc.joints.Universal("j", "arm", "leg", ORIGIN, axis_a=(1, 0), axis_b=Z)),
        ["Universal 'j'", "axis_a", r"\(3,\)", r"\(2,\)"],
    ),
    "nothing moves": (lambda: jc.Scene().build(), ["no body that moves"]),
    # users' functions
    "curve of other arguments": (
        lambda: build(jc.joints.PointOnCurve("c", "arm", "bob", three_arguments)),
        ["PointOnCurve 'c'", r"curve\(x, params\) cannot be called"],
    ),
    "curve in space of one function": (
        lambda: build(jc.joints.PointOnCurve("c", "arm", "bob", sheet)),
        ["PointOnCurve 'c'", r"\(2,\) of float64 in 3 dimensions", r"\[1\]"],
    ),
    "curve whose function does not cross zero": (
        lambda: build(jc.joints.PointOnCurve("c", jc.WORLD, "bob", touching, params=2.0), dim=2),
        ["PointOnCurve 'c'", "rank 0, but 1", "crossed", "touched"],
    ),
    "curve of a particle": (
        lambda: build(jc.joints.PointOnCurve("c", "bob", "arm", sheet), dim=2),
        ["PointOnCurve 'c'", "orientation", "'bob' is a particle", "body_b"],
    ),
    "constraint that returns a matrix": (
        lambda: build(jc.joints.Holonomic(matrix, ("arm",), name="h")),
        ["Holonomic 'h'", r"\(m,\)", r"\[3, 3\]"],
    ),
    "constraint that returns a tuple": (
        lambda: build(jc.joints.Holonomic(tuples, ("arm",), name="h")),
        ["Holonomic 'h'", r"\(m,\)", "tuple"],
    ),
    "constraint that returns a number": (
        lambda: build(jc.joints.Holonomic(number, ("arm",), name="h")),
        ["Holonomic 'h'", r"\(m,\)", r"\[\]"],
    ),
    "constraint that returns integers": (
        lambda: build(jc.joints.Holonomic(whole, ("arm",), name="h")),
        ["Holonomic 'h'", "float64", "int"],
    ),
    "constraint of other arguments": (
        lambda: build(jc.joints.Holonomic(two_arguments, ("arm",), name="h")),
        ["Holonomic 'h'", "cannot be called", "argument"],
    ),
    "velocity constraint that is not affine": (
        lambda: build(jc.joints.VelocityLevel(quadratic, ("arm",), name="w")),
        ["VelocityLevel 'w'", "affine in the velocities"],
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    act, words = MISTAKES[mistake]
    with pytest.raises((ValueError, TypeError), match="(?s)" + ".*".join(words)):
        act()


def generalized(constraint, n=2):
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones_like(q),
        force=lambda q, v, t, u, p: -q,
        constraints=constraint if isinstance(constraint, tuple) else (constraint,),
    )
    return jc.init(system, jc.Method(), np.ones(n), np.zeros(n))


def ring(q, t, p):
    return (q @ q)[None]


GENERALIZED = {
    "a joint": (
        lambda: generalized(jc.Fixed("j", "a", "b")),
        ["Holonomic, VelocityLevel and Inequality", "Fixed"],
    ),
    "a constraint on bodies": (
        lambda: generalized(jc.joints.Holonomic(ring, bodies=("a",), name="h")),
        ["'h'", "no bodies"],
    ),
    "two constraints of one name": (
        lambda: generalized((jc.joints.Holonomic(ring), jc.joints.Holonomic(ring))),
        ["'holonomic'", "name="],
    ),
    "not affine": (
        lambda: generalized(jc.joints.VelocityLevel(bent, name="w")),
        ["VelocityLevel 'w'", "affine in the velocities"],
    ),
    "wrong shape": (
        lambda: generalized(jc.joints.Holonomic(lambda q, t, p: q @ q, name="h")),
        ["Holonomic 'h'", r"\(m,\)", r"\[\]"],
    ),
}


@pytest.mark.parametrize("mistake", GENERALIZED)
def test_a_mistake_on_generalized_coordinates_is_named(mistake):
    act, words = GENERALIZED[mistake]
    with pytest.raises((ValueError, TypeError), match="(?s)" + ".*".join(words)):
        act()


def stepping(**options):
    """Steps the mixed scene with one wrong argument."""
    built = scenes.build("mixed-2d")
    given = {"method": jc.Method(), "state": built.state, "control": None} | options
    return jc.step(built.system, given["method"], given["state"], given["control"], 1e-3)


def with_q(q):
    return dataclasses.replace(scenes.build("mixed-2d").state, q=q)


def begun(stabilizer):
    """A state of the mixed scene with the memory of a stabilizer."""
    built = scenes.build("mixed-2d")
    method = jc.Method(stabilizer=stabilizer)
    return jc.init(built.system, method, built.state.q, built.state.v)


def with_memory(memory):
    return dataclasses.replace(scenes.build("mixed-2d").state, memory=memory)


def gains(x):
    return jc.Method(stabilizer=jc.Baumgarte(x, x))


class Bare:
    """Parts of a method that do not derive from their protocols."""

    smoothing = None

    def factor(self, system):
        return jc.solvers.Schur().factor(system)

    def constraint_equations(self, rows, memory, dt):
        return rows.with_target(-rows.bias)

    def check(self):
        pass


STEPS = {
    "a solver without the base of solvers": (
        lambda: jc.Method(solver=Bare()),
        ["Method: solver: Bare must derive from jc.extend.Solver"],
    ),
    "a stabilizer without the base of stabilizers": (
        lambda: jc.Method(stabilizer=jc.stabilizers.Penalty(1.0, others=Bare())),
        ["Penalty: others: Bare must derive from jc.extend.Stabilizer"],
    ),
    "a solver in another without the base of solvers": (
        lambda: jc.Method(solver=jc.solvers.RankSafe(Bare())),
        ["RankSafe: solver: Bare must derive from jc.extend.Solver"],
    ),
    "a contact solver in another without the base of contact solvers": (
        lambda: jc.Method(contact_solver=jc.solvers.ActiveSet(solver=Bare())),
        ["ActiveSet: solver: Bare must derive from jc.extend.ContactSolver"],
    ),
    "a recovery without a check": (
        lambda: jc.Method(recovery=type("Own", (), {"repair": None})()),
        [r"Method: recovery must be a value such as Recovery\(\)"],
    ),
    "control of wrong length": (
        lambda: stepping(control=jnp.zeros(2)),
        ["control", r"\(3,\)", r"\(2,\)", "push"],
    ),
    "control of another dtype": (
        lambda: stepping(control=jnp.zeros(3, F32)),
        ["control is float32", "float64"],
    ),
    "memory that this method keeps": (
        lambda: stepping(state=with_memory({"integral": jnp.zeros(8)})),
        ["memory that this method keeps", "jc.init"],
    ),
    "a count of steps in place of an integral": (
        lambda: stepping(
            state=begun(jc.Projection(every=10)),
            method=jc.Method(stabilizer=jc.stabilizers.PID(integral=1.0)),
        ),
        ["memory that this method keeps", "jc.init"],
    ),
    "a window of another length": (
        lambda: stepping(
            state=begun(jc.stabilizers.SlidingWindowBaumgarte(window=8)),
            method=jc.Method(stabilizer=jc.stabilizers.SlidingWindowBaumgarte(window=16)),
        ),
        ["memory that this method keeps", "jc.init"],
    ),
    "batch without vmap": (
        lambda: stepping(state=with_q(jnp.zeros((5, 14)))),
        ["state.q", r"\(14,\)", r"\(5, 14\)", r"vmap\(lambda s: jc\.\w+\(system, "],
    ),
    "state of another dtype": (
        lambda: stepping(state=scenes.build("mixed-2d", "float32").state),
        ["float32", "float64", "mixed dtypes"],
    ),
    "gains for an unknown constraint": (
        lambda: stepping(method=gains({"rood": 1.0})),
        ["Baumgarte", "rood", "rod"],
    ),
    "gains of another length": (
        lambda: stepping(method=gains(np.ones(3))),
        ["Baumgarte", r"\(8,\)", r"\(3,\)"],
    ),
}


@pytest.mark.parametrize("mistake", STEPS)
def test_a_mistake_in_a_step_is_named(mistake):
    act, words = STEPS[mistake]
    with pytest.raises((ValueError, TypeError), match="(?s)" + ".*".join(words)):
        act()


@pytest.mark.parametrize("mistake", STEPS)
def test_it_is_named_when_tracing_too(mistake):
    act, words = STEPS[mistake]
    for dtype in ((), ("float32",)):
        scenes.build("mixed-2d", *dtype)  # once, outside of the trace
    with pytest.raises((ValueError, TypeError), match="(?s)" + ".*".join(words)):
        jax.jit(act)()


INITS = {
    "q of another length": (np.zeros(3), np.zeros(14), ["init", "q", r"\(14,\)", r"\(3,\)"]),
    "v of another length": (np.zeros(14), np.zeros(3), ["init", "v", r"\(14,\)", r"\(3,\)"]),
    "q of a batch": (np.zeros((2, 14)), np.zeros(14), ["init", "q", r"\(14,\)", r"\(2, 14\)"]),
    "q of another dtype": (jnp.zeros(14, F32), jnp.zeros(14, F32), ["float32", "float64"]),
    "q and v of two dtypes": (jnp.zeros(14), jnp.zeros(14, F32), ["v is float32", "float64"]),
}


@pytest.mark.parametrize("mistake", INITS)
def test_a_mistake_in_a_state_is_named(mistake):
    q, v, words = INITS[mistake]
    system = scenes.build("mixed-2d").system
    with pytest.raises(ValueError, match="(?s)" + ".*".join(words)):
        jc.init(system, jc.Method(), q, v)


def test_lists_are_a_state():
    system = scenes.build("polar").system
    state = jc.init(system, jc.Method(), [1, 2], [3, 4])
    np.testing.assert_array_equal(state.q, [1.0, 2.0])


def test_controls_may_be_numpy_arrays_and_lists():
    built = scenes.build("mixed-2d")
    expected = stepping(control=jnp.asarray([1.0, 2.0, 3.0]))[0].v
    for control in (np.array([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0], (1, 2, 3)):
        np.testing.assert_array_equal(stepping(control=control)[0].v, expected)
    assert built.system.layout.n_u == 3


def test_numpy_float64_in_a_float32_scene():
    """NumPy and Python scalars take the scene's dtype; a JAX array must already have it."""
    built = scenes.build("mixed-2d", "float32")
    new, _ = jc.step(built.system, jc.Method(), built.state, None, np.float64(1e-3))
    assert new.q.dtype == new.v.dtype == new.time.dtype == jnp.float32
    with pytest.raises(ValueError, match="control is float64, but the state is float32"):
        jc.step(built.system, jc.Method(), built.state, jnp.ones(3), 1e-3)


def test_the_step_size_may_be_any_number():
    built = scenes.build("revolute-2d-tree")
    for dt in (1e-3, np.float64(1e-3), jnp.asarray(1e-3), np.float32(1e-3)):
        new, _ = jc.step(built.system, jc.Method(), built.state, None, dt)
        np.testing.assert_allclose(new.time, 1e-3, rtol=1e-6)


@pytest.mark.parametrize("dt", ["0.001", None, (1e-3, 1e-3)])
def test_a_step_size_that_is_no_number(dt):
    built = scenes.build("revolute-2d-tree")
    with pytest.raises((ValueError, TypeError), match="dt"):
        jc.step(built.system, jc.Method(), built.state, None, dt)


def test_an_unknown_body_is_named_by_accessors():
    built = scenes.build("mixed-2d")
    for question in (jc.position, jc.velocity, jc.orientation, jc.angular_velocity):
        with pytest.raises(ValueError, match="'bib' is unknown.*'bob'"):
            question(built.system, built.state, "bib")


def test_the_same_scene_may_be_built_twice():
    s = scene()
    s.add(jc.Fixed("bolt", "arm", "leg"))
    (first, start), (second, again) = s.build(), s.build()
    assert jax.tree.structure(first) == jax.tree.structure(second)
    np.testing.assert_array_equal(start.q, again.q)


def test_an_unknown_order_of_elimination():
    system, state = build(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0)), dim=2)
    with pytest.raises(ValueError, match="order must be one of .*'levels'.* got 'random'"):
        jc.step(system, jc.Method(solver=jc.solvers.Sparse(order="random")), state, None, 1e-3)


@pytest.mark.parametrize("method", [jc.RK4(), jc.Method])
def test_what_is_no_method_is_named(method):
    system, state = build()
    for act in (
        lambda: jc.step(system, method, state, None, 1e-3),
        lambda: jc.rollout(system, method, state, None, 1e-3, 2),
    ):
        with pytest.raises(TypeError, match="jc.Method.*got (RungeKutta|Method)"):
            act()


@pytest.mark.parametrize(
    "call", ["position", "angular_velocity", "energy", "momentum", "report", "step", "rollout"]
)
def test_what_is_done_for_a_batch_names_what_was_called(call):
    scene = jc.Scene(dim=2)
    scene.add_body("arm", mass=1.0, inertia=1.0)
    system, state = scene.build()
    many = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    given = {
        "position": (system, many, "arm"),
        "angular_velocity": (system, many, "arm"),
        "step": (system, jc.Method(), many, None, 1e-3),
        "rollout": (system, jc.Method(), many, None, 1e-3, 5),
    }.get(call, (system, many))
    with pytest.raises(ValueError, match=rf"jax.vmap\(lambda s: jc.{call}\(system, "):
        getattr(jc, call)(*given)


def test_of_many_numbers_only_the_first_wrong_one_is_shown():
    masses = np.ones((5, 4))
    masses[2, 3] = -1.0
    with pytest.raises(ValueError, match=r"got -1.0 at \[2, 3\] of an array \(5, 4\)\.$"):
        checks.check("body 'a'", "mass", masses, above=0)


def test_parameters_of_functions_may_be_flags_indices_and_keys():
    kinds = {"key": jax.random.key(0), "flag": True, "mask": np.bool_(True), "index": 3}
    for name, x in kinds.items():
        jc.GeneralizedSystem(
            mass=lambda q, p: jnp.ones_like(q), force=lambda q, v, t, u, p: -q, params={name: x}
        )
        scene = jc.Scene(dim=2)
        scene.add_body("a", mass=1.0, inertia=1.0)
        pull = jc.forces.CustomForce(
            "f", ("a",), lambda a, t, u, p: (jnp.zeros(3),), params={name: x}
        )
        scene.add(pull)
        scene.build()
    with pytest.raises(ValueError, match="params 'limit' must not be NaN, got nan"):
        jc.GeneralizedSystem(
            mass=lambda q, p: jnp.ones_like(q),
            force=lambda q, v, t, u, p: -q,
            params={"limit": np.nan},
        )


def test_controls_of_user_forces_may_be_flags():
    system = jc.GeneralizedSystem(
        mass=lambda q, p: jnp.ones_like(q),
        force=lambda q, v, t, u, p: jnp.where(u["on"], -q, 0 * q),
    )
    state = jc.init(system, jc.Method(), jnp.ones(1), jnp.zeros(1))
    control = {"on": jnp.array(True)}
    assert jc.step(system, jc.Method(), state, control, 1e-3)[0].status == jc.Status.OK
    jc.report(system, state, jc.Method(), 1e-3, control=control)


def test_an_infinite_scale_ignores_a_part_of_a_loss():
    path = {"a": jnp.ones(3), "b": 5 * jnp.ones(3)}
    reference = {"a": jnp.zeros(3), "b": jnp.zeros(3)}
    found = jc.learning.losses.tracking(path, reference, {"a": 1.0, "b": jnp.inf})
    np.testing.assert_allclose(found, 0.5)
