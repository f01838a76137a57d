"""The doors of `wrong_calls`: public calls with one open argument each.

All other arguments of a call have valid values. `wrong_calls` passes wrong values to the open
argument.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon import environments
from jaxcon.environments import curricula

F32 = jnp.float32


@dataclass(frozen=True)
class Takes:
    """The valid values of an argument.

    Attributes:
        kind: "real" numbers, a "count", a "flag", a field of a "state", "one" fixed call, or
            "other".
        good: valid numbers, in the argument's shape.
        sign: "any", "not negative" or "positive".
        most: largest valid number.
        least: smallest valid count.
        allows: tags of other valid values, such as "none". "NaN" and "infinity" are for formulas
            that propagate them, "batch" for trailing axes.
        dtype: dtype of the scene, None if the call does not know it.
        shaped: True if only the shape of `good` is valid.
        unread: True if the call does not read values of JAX arrays; wrong values then end in a
            status.
    """

    kind: str = "none"
    good: Any = 1.0
    sign: str = "any"
    most: float | None = None
    least: int = 1
    allows: frozenset[str] = frozenset()
    dtype: Any = None
    shaped: bool = True
    unread: bool = False


@dataclass(frozen=True)
class Door:
    """One argument of one call.

    Attributes:
        name: name of the call and the argument.
        call: the call as a function of the argument, with valid values for all other arguments.
        takes: valid values.
        words: patterns, one of which the error message must match.
    """

    name: str
    call: Callable[[Any], Any]
    takes: Takes
    words: tuple[str, ...]


def real(good: Any = 1.0, sign: str = "any", *allows: str, **overrides: Any) -> Takes:
    """Describes real numbers in the dtype of the scene."""
    allowed = frozenset(allows)
    return Takes(
        **(
            {"kind": "real", "good": good, "sign": sign, "allows": allowed, "dtype": F32}
            | overrides
        )
    )


def free(good: Any = 1.0, sign: str = "any", *allows: str, **overrides: Any) -> Takes:
    """Describes real numbers of a call that does not know the dtype of the scene."""
    return real(good, sign, *allows, **({"dtype": None} | overrides))


def count(least: int = 1, *allows: str) -> Takes:
    """Describes an integer of at least `least`."""
    return Takes("count", 1, least=least, allows=frozenset(allows))


FUNCTION = Takes("other", allows=frozenset({"function"}))
"""The valid values of an argument that is a function of the user."""


PARAMETERS = Takes("other", allows=frozenset({"none", "key", "tree", "flag", "mask"}))
"""The valid values of an argument with the parameters of a user's function, by kind."""


def flag() -> Takes:
    """Describes an argument that is True or False."""
    return Takes("flag", allows=frozenset({"flag"}))


ORIGIN, X, Y, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
POINT, AXIS = real(ORIGIN, "any", "none"), real(Z)
ANY, SOME, POSITIVE = real(), real(1.0, "not negative"), real(1.0, "positive")
LENGTH = real(1.0, "positive", "none")
STOP = {
    "restitution": real(0.5, "not negative", most=1.0),
    "stiffness": real(1.0, "positive", "none"),
    "recovery": POSITIVE,
}
TOUCH = {"friction": SOME, **STOP}
ROUND = {"rolling": SOME, "spinning": SOME}
RANGE = real((-1.0, 1.0), "any", "none")

ELEMENTS: list[tuple[Any, dict[str, Any], dict[str, Takes]]] = [
    (jc.forces.Force, {"body": "arm", "force": Z}, {"force": AXIS, "point": POINT}),
    (
        jc.Spring,
        {"body_a": "arm", "body_b": "leg", "stiffness": 1.0},
        {
            "stiffness": SOME,
            "damping": SOME,
            "rest_length": real(1.0, "not negative", "none"),
            "point_a": POINT,
            "point_b": POINT,
        },
    ),
    (jc.forces.ExternalWrench, {"body": "arm"}, {"point": POINT}),
    (
        jc.Distance,
        {"body_a": "arm", "body_b": "leg"},
        {"length": LENGTH, "point_a": POINT, "point_b": POINT},
    ),
    (jc.joints.Coincident, {"body_a": "arm", "body_b": "leg", "point": ORIGIN}, {"point": POINT}),
    (jc.Fixed, {"body_a": "arm", "body_b": "leg"}, {"point": POINT}),
    (
        jc.Revolute,
        {"body_a": "arm", "body_b": "leg", "point": ORIGIN, "axis": Z},
        {"point": POINT, "axis": AXIS},
    ),
    (jc.Prismatic, {"body_a": "arm", "body_b": "leg", "axis": Z}, {"axis": AXIS, "point": POINT}),
    (jc.Spherical, {"body_a": "arm", "body_b": "leg", "point": ORIGIN}, {"point": POINT}),
    (
        jc.joints.Cylindrical,
        {"body_a": "arm", "body_b": "leg", "axis": Z},
        {"axis": AXIS, "point": POINT},
    ),
    (
        jc.joints.Universal,
        {"body_a": "arm", "body_b": "leg", "point": ORIGIN, "axis_a": X, "axis_b": Y},
        {"point": POINT, "axis_a": AXIS, "axis_b": AXIS},
    ),
    (
        jc.joints.Planar,
        {"body_a": "arm", "body_b": "leg", "axis": Z},
        {"axis": AXIS, "point": POINT},
    ),
    (
        jc.joints.Screw,
        {"body_a": "arm", "body_b": "leg", "axis": Z, "lead": 0.1},
        {"axis": AXIS, "point": POINT, "lead": ANY},
    ),
    (
        jc.joints.ConstantVelocity,
        {"body_a": "arm", "body_b": "leg", "point": ORIGIN, "axis": Z},
        {"point": POINT, "axis": AXIS, "axis_b": real(Z, "any", "none")},
    ),
    (
        jc.joints.RevoluteSpherical,
        {"body_a": "arm", "body_b": "leg", "hinge": ORIGIN, "ball": X, "axis": Z},
        {"hinge": POINT, "ball": POINT, "axis": AXIS},
    ),
    (
        jc.joints.SphericalSpherical,
        {"body_a": "arm", "body_b": "leg"},
        {"length": LENGTH, "point_a": POINT, "point_b": POINT},
    ),
    (jc.joints.Span, {"body_a": "arm", "body_b": "leg"}, {"point_a": POINT, "point_b": POINT}),
    (
        jc.joints.Twist,
        {"body_a": "arm", "body_b": "leg", "axis": Z},
        {"axis": AXIS, "point": POINT},
    ),
    (jc.joints.Parallel, {"body_a": "arm", "body_b": "leg", "axis": Z}, {"axis": AXIS}),
    (
        jc.joints.PointOnLine,
        {"body_a": "arm", "body_b": "leg", "axis": Z},
        {"axis": AXIS, "point": POINT},
    ),
    (
        jc.joints.PointOnPlane,
        {"body_a": "arm", "body_b": "leg", "axis": Z},
        {"axis": AXIS, "point": POINT},
    ),
    *[
        (
            joint,
            {"body_a": jc.WORLD, "body_b": "leg", "radius": 1.0, **extra},
            {"radius": POSITIVE, "normal": real(Z, "any", "none"), "center": POINT, "point": POINT},
        )
        for joint, extra in (
            (jc.joints.RollingSphere, {}),
            (jc.joints.RollingDisc, {"axis": Y}),
            (jc.joints.RollingCylinder, {"axis": Y}),
        )
    ],
    (
        jc.joints.KnifeEdge,
        {"body_a": jc.WORLD, "body_b": "leg", "edge": X},
        {"edge": real(X), "normal": real(Z, "any", "none"), "center": POINT},
    ),
    (jc.joints.LinearMomentum, {}, {"value": real(ORIGIN, "any", "none")}),
    (jc.joints.AngularMomentum, {}, {"value": real(ORIGIN, "any", "none")}),
    (
        jc.PlaneContact,
        {"body_a": jc.WORLD, "body_b": "leg"},
        {
            "radius": SOME,
            "center": POINT,
            "normal": real(Z, "any", "none"),
            "point": POINT,
            **TOUCH,
            **ROUND,
        },
    ),
    (
        jc.contacts.CapsuleContact,
        {"body_a": "arm", "body_b": "leg", "radius_a": 0.1, "radius_b": 0.1},
        {
            "radius_a": SOME,
            "radius_b": SOME,
            "segment_a": real((ORIGIN, X), "any", "none"),
            "segment_b": real((X, Y), "any", "none"),
            **TOUCH,
            **ROUND,
        },
    ),
    (
        jc.contacts.BoxContact,
        {"body_a": jc.WORLD, "body_b": "leg", "size": (1.0, 1.0, 1.0)},
        {
            "size": real((1.0, 1.0, 1.0), "positive"),
            "position": POINT,
            "orientation": real((1.0, 0.0, 0.0, 0.0), "any", "none"),
            "normal": real(Z, "any", "none"),
            "point": POINT,
            **TOUCH,
        },
    ),
    (
        jc.contacts.HeightFieldContact,
        {
            "body_a": jc.WORLD,
            "body_b": "leg",
            "heights": np.zeros((4, 4)),
            "size": (1.0, 1.0),
            "radius": 0.1,
        },
        {
            "heights": real(np.zeros((4, 4)), shaped=False),
            "size": real((1.0, 1.0), "positive"),
            "radius": SOME,
            "center": POINT,
            "position": POINT,
            "orientation": real((1.0, 0.0, 0.0, 0.0), "any", "none"),
            **TOUCH,
            **ROUND,
        },
    ),
    (
        jc.contacts.Rope,
        {"body_a": "arm", "body_b": "leg"},
        {"length": LENGTH, "point_a": POINT, "point_b": POINT, **STOP},
    ),
    (
        jc.joints.Compound,
        {"body_a": "arm", "body_b": "leg", "slides": (X,), "hinges": (Y,)},
        {
            "point": POINT,
            "slides": Takes("other"),
            "hinges": Takes("other"),
            "ball": flag(),
        },
    ),
    (
        jc.forces.Bending,
        {"body_a": "arm", "body_b": "leg", "body_c": "bob", "stiffness": 1.0},
        {"stiffness": SOME, "point_a": POINT, "point_b": POINT, "point_c": POINT},
    ),
    (
        jc.forces.Flexure,
        {"body_a": "arm", "body_b": "leg", "bending": 1.0},
        {"bending": SOME, "twisting": real(0.5, "not negative"), "straight": flag()},
    ),
]
"""Elements on bodies: class, valid arguments, and the open arguments with their valid values."""

ALONG: list[tuple[Any, dict[str, Any], dict[str, Takes]]] = [
    (jc.joints.Armature, {"joint": "one", "inertia": 1.0}, {"inertia": POSITIVE}),
    (
        jc.forces.JointSpring,
        {"joint": "one", "stiffness": 1.0},
        {"stiffness": SOME, "damping": SOME, "rest": ANY},
    ),
    (jc.forces.JointDamper, {"joint": "one", "damping": 1.0}, {"damping": SOME}),
    (jc.Motor, {"joint": "one"}, {"gear": ANY, "control_range": RANGE}),
    (
        jc.forces.PositionServo,
        {"joint": "one", "stiffness": 1.0},
        {
            "stiffness": SOME,
            "damping": SOME,
            "gear": ANY,
            "control_range": RANGE,
            "force_range": RANGE,
        },
    ),
    (
        jc.forces.VelocityServo,
        {"joint": "one", "damping": 1.0},
        {"damping": SOME, "gear": ANY, "control_range": RANGE, "force_range": RANGE},
    ),
    (
        jc.forces.AffineActuator,
        {"joint": "one"},
        {"gain": real(X), "bias": real(X), "gear": ANY, "control_range": RANGE},
    ),
    (
        jc.Limit,
        {"joint": "one", "lower": -1.0, "upper": 1.0},
        {
            "lower": real(-1.0, "any", "none", "infinity"),
            "upper": real(1.0, "any", "none", "infinity"),
            **STOP,
        },
    ),
    (jc.contacts.JointFriction, {"joint": "one", "max_force": 1.0}, {"max_force": SOME}),
    (jc.contacts.RateLimit, {"joint": "one", "rate": 1.0}, {"rate": SOME}),
    (jc.contacts.RateMotor, {"joint": "one", "max_force": 1.0}, {"max_force": SOME}),
    (jc.joints.Gear, {"joint_a": "one", "joint_b": "two", "ratio": 2.0}, {"ratio": ANY}),
    (
        jc.joints.Belt,
        {"joint_a": "one", "joint_b": "two", "radius_a": 1.0, "radius_b": 1.0},
        {"radius_a": ANY, "radius_b": ANY},
    ),
    (
        jc.joints.RackAndPinion,
        {"pinion": "one", "rack": "slide", "radius": 1.0},
        {"radius": ANY},
    ),
    (
        jc.joints.PolynomialCoupling,
        {"joint_a": "one", "joint_b": "two", "coefficients": (0.0, 1.0, 0.5)},
        {"coefficients": real((0.0, 1.0, 0.5), shaped=False)},
    ),
    (jc.joints.Pulley, {"span_a": "span", "span_b": "span2"}, {"parts": ANY}),
]
"""Elements on joints: class, valid arguments, and the open arguments with their valid values."""


def bodies(dtype: Any = F32) -> jc.Scene:
    """Returns a scene of two bodies and a particle."""
    scene = jc.Scene(dtype=dtype)
    for i, name in enumerate(("arm", "leg")):
        scene.add_body(name, mass=1.0, inertia=(1.0, 1.0, 1.0), position=(float(i), 0.0, 0.0))
    scene.add_particle("bob", mass=1.0, position=(2.0, 1.0, 0.0))
    return scene


def jointed(dtype: Any = F32) -> jc.Scene:
    """Returns a scene of two hinged arms, a slider and two spans."""
    scene = bodies(dtype)
    scene.add(jc.Revolute("one", jc.WORLD, "arm", point=ORIGIN, axis=Z))
    scene.add(jc.Revolute("two", "arm", "leg", point=X, axis=Z))
    scene.add_body("block", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 2.0, 0.0))
    scene.add(jc.Prismatic("slide", jc.WORLD, "block", axis=X))
    scene.add(jc.joints.Span("span", jc.WORLD, "bob"))
    scene.add(jc.joints.Span("span2", "leg", "bob"))
    return scene


def with_element(make: Callable[[], jc.Scene], kind: Any, arguments: Mapping[str, Any]) -> Any:
    """Builds a scene of `make` with one added element."""
    scene = make()
    scene.add(kind("it", **arguments))
    return scene.build()


@functools.cache
def motor() -> tuple[Any, Any]:
    """Builds an arm at rest on a hinge with a motor and a joint limit."""
    scene = bodies()
    scene.add(jc.Revolute("one", jc.WORLD, "arm", point=ORIGIN, axis=Z))
    scene.add(jc.Motor("drive", "one"))
    scene.add(jc.Limit("stop", "one", lower=-1.0, upper=1.0))
    scene.add(jc.Spring("coil", "arm", "leg", 1.0))
    scene.add(jc.joints.TurnCounter("turns", "one"))
    return scene.build()


@functools.cache
def plain() -> tuple[Any, Any]:
    """Builds a pendulum at rest."""
    scene = jc.Scene(dim=2, dtype=F32)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    return scene.build()


def body(dim: int, **arguments: Any) -> Any:
    """Builds a scene of one body with the given arguments."""
    scene = jc.Scene(dim=dim, dtype=F32)
    inertia = 1.0 if dim == 2 else (1.0, 1.0, 1.0)
    scene.add_body("arm", **({"mass": 1.0, "inertia": inertia} | arguments))
    return scene.build()


def particle(**arguments: Any) -> Any:
    """Builds a scene of one particle with the given arguments."""
    scene = jc.Scene(dtype=F32)
    scene.add_particle("bob", **({"mass": 1.0} | arguments))
    return scene.build()


def begun(**parts: Any) -> Any:
    """Returns the initial state of the pendulum under a method.

    The parameters of the method are read in the process.
    """
    system, state = plain()
    return jc.init(system, jc.Method(**parts), state.q, state.v)


def step(**overrides: Any) -> Any:
    """Takes a step of the arm with a motor, with some arguments replaced."""
    system, state = motor()
    arguments = {"control": np.zeros(1), "dt": 1e-3, "state": state} | overrides
    return jc.step(system, jc.Method(), arguments["state"], arguments["control"], arguments["dt"])


def rollout(**overrides: Any) -> Any:
    """Takes two steps of the pendulum, with some arguments replaced."""
    system, state = plain()
    arguments = {"controls": None, "dt": 1e-3, "steps": 2} | overrides
    return jc.rollout(
        system,
        jc.Method(),
        state,
        arguments.pop("controls"),
        arguments.pop("dt"),
        arguments.pop("steps"),
        **arguments,
    )


PARTS: list[tuple[str, Any, dict[str, Any], dict[str, Takes]]] = [
    (
        "solver",
        jc.solvers.Sparse,
        {},
        {"tikhonov": free(1e-6, "not negative", "none"), "run": count()},
    ),
    ("solver", jc.solvers.Schur, {}, {"tikhonov": free(1e-6, "not negative", "none")}),
    (
        "solver",
        jc.solvers.ConjugateGradients,
        {},
        {
            "tikhonov": free(1e-6, "not negative", "none"),
            "tolerance": free(1e-6, "not negative", "none"),
            "iterations": count(),
        },
    ),
    (
        "solver",
        jc.solvers.RankSafe,
        {},
        {
            "share": free(1e-6, "not negative", "none"),
            "scaling": free(1e-6, "not negative", "none"),
            "conflict": free(1e-2, "not negative", "none", "infinity"),
            "rounds": count(),
            "always": flag(),
            "solver": Takes("other"),
        },
    ),
    (
        "solver",
        jc.solvers.Priority,
        {"levels": {"rod": 0}},
        {
            "cutoff": free(1e-6, "not negative", "none"),
            "conflict": free(1e-6, "not negative", "none", "infinity"),
            "damping": free(1e-6, "not negative", "none"),
            "levels": Takes("other"),
        },
    ),
    (
        "contact_solver",
        jc.solvers.InteriorPoint,
        {},
        {
            "iterations": count(),
            "polish": count(0),
            "smoothing": free(1e-3, "not negative", "none"),
        },
    ),
    (
        "contact_solver",
        jc.solvers.GaussSeidel,
        {},
        {"sweeps": count(), "warm": flag(), "smoothing": free(1e-3, "not negative", "none")},
    ),
    (
        "contact_solver",
        jc.solvers.ActiveSet,
        {},
        {"contacts": count(1, "none"), "stops": count(1, "none"), "solver": Takes("other")},
    ),
    (
        "stabilizer",
        jc.Baumgarte,
        {"alpha": 1.0, "beta": 1.0},
        {
            "alpha": free(1.0, "not negative", "none", shaped=False),
            "beta": free(1.0, "not negative", "none", shaped=False),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.AdaptiveBaumgarte,
        {},
        {
            "size": free(1e-3, "positive", shaped=False),
            "floor": free(0.2, "not negative", most=1, shaped=False),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.SlidingWindowBaumgarte,
        {},
        {
            "rate": free(1.0, "not negative", "none", shaped=False),
            "damping_ratio": free(0.7, "positive", most=1, shaped=False),
            "speed": free(0.1, "not negative"),
            "recovery": free(0.1, "not negative"),
            "reach": free(10.0, "positive"),
            "noise": free(1e-9, "positive"),
            "margin": free(0.9, "not negative", most=1),
            "limit": free(1.0, "positive", "none"),
            "window": count(4),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.PID,
        {},
        {
            "proportional": free(1.0, "not negative", "none", shaped=False),
            "derivative": free(1.0, "not negative", "none", shaped=False),
            "integral": free(0.0, "not negative", shaped=False),
            "limit": free(1.0, "not negative", "none", shaped=False),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.Penalty,
        {"stiffness": 1.0},
        {
            "stiffness": free(1.0, "not negative", shaped=False),
            "damping": free(1.0, "not negative", shaped=False),
            "damping_ratio": free(1.0, "not negative", shaped=False),
            "implicit": flag(),
            "others": Takes("other"),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.AugmentedLagrangian,
        {},
        {
            "stiffness": free(1.0, "positive", shaped=False),
            "iterations": count(),
            "feedback": Takes("other"),
        },
    ),
    (
        "stabilizer",
        jc.Projection,
        {},
        {
            "metric": Takes("other"),
            "iterations": count(),
            "every": count(),
            "tolerance": free(1e-6, "not negative", "none"),
            "factor": free(1.0, "positive", most=1),
            "coupled": flag(),
            "position": flag(),
            "velocity": flag(),
        },
    ),
    (
        "stabilizer",
        jc.stabilizers.Hybrid,
        {"small": jc.Baumgarte(1.0, 1.0)},
        {
            "soft_below": free(1e-6, "positive"),
            "project_above": free(1e-2, "positive"),
            "sharpness": count(),
            "small": Takes("other"),
            "middle": Takes("other"),
        },
    ),
    (
        "integrator",
        jc.integrators.GeneralizedAlpha,
        {},
        {
            "rho": free(0.9, "not negative", most=1),
            "tolerance": free(1e-6, "not negative", "none"),
            "tikhonov": free(1e-6, "not negative", "none"),
            "iterations": count(),
            "projects": flag(),
        },
    ),
    ("integrator", jc.integrators.RATTLE, {}, {"iterations": count(), "rounds": count()}),
    ("integrator", jc.SemiImplicitEuler, {}, {"gyroscopic": Takes("other")}),
    (
        "recovery",
        jc.stabilizers.Recovery,
        {},
        {
            "limit": free(1.0, "positive", "none"),
            "shrink": free(0.5, "positive", most=1),
            "growth": free(1.05, "positive"),
            "damping": free(0.1, "not negative", most=1),
            "retries": count(0),
            "projector": Takes("other"),
        },
    ),
    (
        "events",
        jc.integrators.Events,
        {},
        {"splits": count(), "iterations": count(), "slips": flag()},
    ),
]
"""Parts of a method: field, class, valid arguments, and the open arguments with valid values."""


def doors() -> Iterator[Door]:
    """Yields the doors of all public calls."""
    for make, table in ((bodies, ELEMENTS), (jointed, ALONG)):
        for kind, arguments, fields in table:
            for field, takes in fields.items():
                yield _element(make, kind, arguments, field, takes)
    yield from _of_bodies()
    yield from _of_params()
    for part, kind, arguments, fields in PARTS:
        for field, takes in fields.items():

            def call(
                x: Any,
                part: str = part,
                kind: Any = kind,
                arguments: Any = arguments,
                f: str = field,
            ) -> Any:
                return begun(**{part: kind(**(arguments | {f: x}))})

            yield Door(f"{kind.__name__}.{field}", call, takes, (rf"\b{field.rstrip('s')}",))
            yield _constructor(kind, arguments, field, takes)
    for name, call, takes, *words in (
        *_simulation(),
        *_analysis(),
        *_search(),
        *_names(),
        *_pictures(),
        *_environments(),
        *_losses(),
        *_others(),
    ):
        yield Door(name, call, takes, tuple(words) or (rf"\b{re.split('[.(]', name)[-1]}\b",))


def _constructor(kind: Any, arguments: dict[str, Any], field: str, takes: Takes) -> Door:
    """Returns the door of a constructor, which also accepts arrays for a batch of worlds."""
    call = functools.partial(_with, kind, arguments, field)
    takes = dataclasses.replace(takes, shaped=False)
    return Door(f"{kind.__name__}({field}=)", call, takes, (rf"\b{field.rstrip('s')}",))


def _element(make: Any, kind: Any, arguments: Any, field: str, takes: Takes) -> Door:
    def call(x: Any) -> Any:
        return with_element(make, kind, arguments | {field: x})

    return Door(f"{kind.__name__}.{field}", call, takes, (rf"\b{field}\b",))


def _of_bodies() -> Iterator[Door]:
    vector, turn = real(ORIGIN, "any", "none"), real((1.0, 0.0, 0.0, 0.0), "any", "none")
    three = {
        "mass": POSITIVE,
        "inertia": real((1.0, 1.0, 1.0), "positive"),
        "position": vector,
        "quaternion": turn,
        "velocity": vector,
        "angular_velocity": vector,
        "fixed": flag(),
    }
    two = {
        "inertia": POSITIVE,
        "position": real((0.0, 0.0), "any", "none"),
        "angle": real(0.0, "any", "none"),
        "angular_velocity": real(0.0, "any", "none"),
    }
    for dim, fields in ((3, three), (2, two)):
        for field, takes in fields.items():
            call = functools.partial(_body_with, dim, field)
            yield Door(f"add_body.{field} in {dim}D", call, takes, (rf"\b{field}\b",))
    for field, takes in {"mass": POSITIVE, "position": vector, "velocity": vector}.items():
        call = functools.partial(_particle_with, field)
        yield Door(f"add_particle.{field}", call, takes, (rf"\b{field}\b",))


def _body_with(dim: int, field: str, x: Any) -> Any:
    return body(dim, **{field: x})


def _particle_with(field: str, x: Any) -> Any:
    return particle(**{field: x})


def _of_params() -> Iterator[Door]:
    fields = {
        ("gravity", None): AXIS,
        ("arm", "mass"): POSITIVE,
        ("arm", "inertia"): real((1.0, 1.0, 1.0), "positive"),
        ("arm", "center"): real(ORIGIN),
        ("coil", "stiffness"): SOME,
        ("coil", "damping"): SOME,
        ("coil", "rest_length"): SOME,
        ("drive", "gear"): ANY,
        ("stop", "lower"): real(-1.0, "any", "infinity"),
        ("stop", "recovery"): POSITIVE,
        ("one", "axis_a"): AXIS,
    }
    for (name, field), takes in fields.items():

        def call(x: Any, name: str = name, field: str | None = field) -> Any:
            return motor()[0].with_params({name: x if field is None else {field: x}})

        yield Door(f"with_params.{name}.{field}", call, takes, (rf"\b{field or name}\b",))


Row = tuple[Any, ...]


def _simulation() -> Iterator[Row]:
    yield "Scene.gravity", lambda x: jc.Scene(gravity=x, dtype=F32), real(ORIGIN, "any", "none")
    yield "Scene.dim", lambda x: jc.Scene(dim=x), count(2)
    yield "Scene.dtype", lambda x: jc.Scene(dtype=x), Takes("other", allows=frozenset({"none"}))
    system, state = motor()
    n_v = state.v.shape
    init = functools.partial(jc.init, system, jc.Method())
    yield "init.q", lambda x: init(x, state.v), real(np.asarray(state.q)), r"\bq\b"
    yield "init.v", lambda x: init(state.q, x), real(np.zeros(n_v)), r"\bv\b"
    yield "init.time", lambda x: init(state.q, state.v, x), real(0.0)
    turns = real(np.zeros(1), "any", "none")
    yield "init.turns", lambda x: init(state.q, state.v, turns=x), turns
    for field, good in {
        "q": state.q,
        "v": np.zeros(n_v),
        "time": 0.0,
        "turns": np.zeros(1),
    }.items():

        def call(x: Any, field: str = field) -> Any:
            return step(state=dataclasses.replace(state, **{field: x}))

        takes = Takes("state", np.asarray(good))
        yield f"State.{field}", call, takes, rf"state.{field}\b"
        for label, x in wrong_arrays().items():
            yield (
                f"State.{field} {label}",
                functools.partial(_given, call, x),
                Takes("one"),
                rf"state.{field}\b",
            )
    yield (
        "State.status",
        lambda x: step(state=dataclasses.replace(state, status=x)),
        Takes("other"),
        r"state.status\b",
    )
    dt = real(1e-3, "not negative", unread=True)
    yield "step.dt", lambda x: step(dt=x), dt
    yield "step.control", lambda x: step(control=x), real(np.zeros(1), unread=True)
    yield "step.state", lambda x: step(state=x), Takes("other"), "State"
    yield "step.method", lambda x: jc.step(*_swapped(method=x)), Takes("other"), "method"
    yield "step.system", lambda x: jc.step(*_swapped(system=x)), Takes("other"), "system"
    forward = lambda x: jc.forward_dynamics(system, state, np.zeros(1), jc.Method(), x)  # noqa: E731
    yield "forward_dynamics.dt", forward, dt
    yield "rollout.dt", lambda x: rollout(dt=x), dt
    yield "rollout.steps", lambda x: rollout(steps=x), count(0)
    yield "rollout.every", lambda x: rollout(every=x), count()
    yield "rollout.record", lambda x: rollout(record=x), FUNCTION
    yield "rollout.adjoint", lambda x: rollout(adjoint=x), Takes("other")
    controls = Takes("other", allows=frozenset({"none", "function"}))
    yield "rollout.controls", lambda x: rollout(controls=x), controls
    yield (
        "Checkpoints.levels",
        lambda x: rollout(adjoint=jc.adjoints.Checkpoints(levels=x)),
        count(1, "none"),
    )
    yield (
        "Checkpoints.segments",
        lambda x: rollout(adjoint=jc.adjoints.Checkpoints(segments=x)),
        count(1, "none"),
    )
    yield (
        "Checkpoints.budget",
        lambda x: rollout(adjoint=jc.adjoints.Checkpoints(budget=x)),
        free(1e9, "positive", "none"),
    )
    yield "Truncated.steps", lambda x: rollout(adjoint=jc.adjoints.Truncated(x)), count()
    yield (
        "Truncated.within",
        lambda x: rollout(adjoint=jc.adjoints.Truncated(1, x)),
        Takes("other"),
        "adjoint|within",
    )
    yield (
        "Discounted.factor",
        lambda x: rollout(adjoint=jc.adjoints.Discounted(x)),
        free(0.5, "not negative", most=1),
    )
    yield (
        "Reversible.segments",
        lambda x: rollout(adjoint=jc.adjoints.Reversible(x)),
        count(1, "none"),
    )


def wrong_arrays() -> dict[str, Any]:
    """Returns invalid values for a field of a float32 state, by description."""
    return {
        "of booleans": np.ones(1, bool),
        "of complex numbers": np.ones(1, complex),
        "of float16": jnp.ones(1, jnp.float16),
        "of float64": jnp.ones(1, jnp.float64),
        "of integers": jnp.ones(1, int),
        "of another shape": np.ones((2, 3), np.float32),
        "as a list": [1.0, 2.0],
    }


def _given(call: Callable[[Any], Any], x: Any, _: Any) -> Any:
    return call(x)


def _swapped(**overrides: Any) -> tuple[Any, ...]:
    system, state = motor()
    arguments = {"system": system, "method": jc.Method()} | overrides
    return arguments["system"], arguments["method"], state, np.zeros(1), 1e-3


def _analysis() -> Iterator[Row]:
    system, state = motor()
    for reader in (jc.position, jc.velocity):
        read = functools.partial(reader, system, state, "arm")
        yield f"{reader.__name__}.point", read, real(ORIGIN, "any", "none")
    yield (
        "angular_momentum.about",
        lambda x: jc.angular_momentum(system, state, about=x),
        real(ORIGIN, "any", "none"),
    )
    names = Takes("other")
    of_bodies = (jc.position, jc.orientation, jc.velocity, jc.angular_velocity)
    of_joints = (jc.coordinate, jc.coordinate_rate)
    for argument, readers in (("body", of_bodies), ("joint", of_joints)):
        for reader in readers:
            read = functools.partial(reader, system, state)
            yield f"{reader.__name__}.{argument}", read, names, f"{argument}|unknown"
    info = jc.forward_dynamics(system, state, np.zeros(1), jc.Method(), 1e-3)
    optional = Takes("other", allows=frozenset({"none"}))
    for reader in (jc.multipliers, jc.wrench):
        yield f"{reader.__name__}.info", lambda x, reader=reader: reader(x, "one"), names
        yield (
            f"{reader.__name__}.name",
            functools.partial(reader, info),
            names,
            "constraint|element|unknown",
        )
    yield "wrench.body", lambda x: jc.wrench(info, "one", x), optional
    for reader in (jc.acceleration, jc.angular_acceleration):
        name = reader.__name__
        yield f"{name}.info", lambda x, reader=reader: reader(x, "arm"), names
        yield f"{name}.body", functools.partial(reader, info), names, "body|unknown"
    at = functools.partial(jc.acceleration, info, "arm")
    yield "acceleration.point", at, real(ORIGIN, "any", "none")
    react = functools.partial(jc.reaction, system, state, control=np.zeros(1))
    yield "reaction.name", react, names, "element|unknown"
    yield "reaction.body", lambda x: react("one", x), optional
    yield "reaction.dt", lambda x: react("one", dt=x), free(1e-3, "not negative", shaped=False)
    yield "reaction.solver", lambda x: react("one", solver=x), optional
    ratio = free(1.0, "not negative")
    rate = jc.stabilizers.largest_stable_rate
    yield "largest_stable_rate.dt", lambda x: rate(jc.RK4(), x), free(1e-3, "positive")
    yield "largest_stable_rate.damping_ratio", lambda x: rate(jc.RK4(), 1e-3, x), ratio
    yield "largest_stable_rate.integrator", lambda x: rate(x, 1e-3), names
    response = {"frequency": 1.0, "alpha": 1.0, "beta": 1.0, "integral": 0.0}
    for field, good in response.items():
        takes = free(good, shaped=False)
        yield f"frequency_response.{field}", functools.partial(_response, field), takes
    yield (
        "frequency_response.dt",
        functools.partial(_response, "dt"),
        free(1e-3, "positive", shaped=False),
    )
    yield "frequency_response.integrator", functools.partial(_response, "integrator"), names
    system, state = plain()
    yield "report.dt", lambda x: jc.report(system, state, dt=x), free(1e-3, "positive", "none")
    yield "report.timed", lambda x: jc.report(system, state, timed=x), flag()
    yield "report.batch", lambda x: jc.report(system, state, batch=x), count()
    yield (
        "report.method",
        lambda x: jc.report(system, state, x),
        Takes("other", allows=frozenset({"none"})),
    )
    yield "Method.auto.batch", lambda x: jc.Method.auto(system, state, x), count()
    problem = (system, jc.Method(), state, None)
    yield "diagnose.dt", lambda x: jc.analysis.diagnose(*problem, x, 5), free(1e-3, "positive")
    yield "diagnose.steps", lambda x: jc.analysis.diagnose(*problem, 1e-3, x), count()
    yield (
        "find_first_failure.dt",
        lambda x: jc.analysis.find_first_failure(*problem, x, 5),
        free(1e-3, "not negative", unread=True),
    )
    yield (
        "find_first_failure.steps",
        lambda x: jc.analysis.find_first_failure(*problem, 1e-3, x),
        count(0),
    )
    yield (
        "gradient_growth.dt",
        lambda x: jc.analysis.gradient_growth(*problem, x, 5),
        free(1e-3, "positive"),
    )
    yield (
        "gradient_growth.steps",
        lambda x: jc.analysis.gradient_growth(*problem, 1e-3, x),
        count(4),
    )
    yield (
        "gradient_growth.seed",
        lambda x: jc.analysis.gradient_growth(*problem, 1e-3, 5, x),
        count(0),
    )
    check = functools.partial(jc.check_gradients, jnp.sum, jnp.ones(2))
    yield "check_gradients.tolerance", lambda x: check(tolerance=x), free(1e-3, "positive", "none")
    yield "check_gradients.directions", lambda x: check(directions=x), count()
    yield "check_gradients.seed", lambda x: check(seed=x), count(0)
    yield (
        "check_gradients.f",
        lambda x: jc.check_gradients(x, jnp.ones(2)),
        FUNCTION,
    )
    q = np.asarray(state.q)
    yield "assemble.q", lambda x: jc.assemble(system, x), real(q), r"\bq\b"
    yield "assemble.v", lambda x: jc.assemble(system, q, x), real(0 * q, "any", "none"), r"\bv\b"
    yield "assemble.time", lambda x: jc.assemble(system, q, time=x), real(0.0, "any", "none")
    yield (
        "assemble.tolerance",
        lambda x: jc.assemble(system, q, tolerance=x),
        real(1e-6, "positive", "none"),
    )
    yield "raise_for_status.result", jc.raise_for_status, Takes("other")
    yield (
        "vakonomic.multipliers",
        lambda x: jc.systems.vakonomic(*_sledge(), x),
        Takes("other", allows=frozenset({"none"})),
        "multipliers|constraint",
    )
    yield (
        "vakonomic.multipliers of a row",
        lambda x: jc.systems.vakonomic(*_sledge(), {"edge": x}),
        real(np.zeros(1)),
        "μ|multipliers",
    )
    for field in ("horizon", "budget"):
        yield f"tradeoff.{field}", functools.partial(_tradeoff, field), free(1.0, "positive")
    yield "tradeoff.gradients", functools.partial(_tradeoff, "gradients"), flag()
    yield "tradeoff.batch", functools.partial(_tradeoff, "batch"), count()
    yield (
        "tradeoff.dts",
        functools.partial(_tradeoff, "dts"),
        Takes("other", allows=frozenset({"none"})),
    )
    yield "tradeoff.hold", functools.partial(_tradeoff, "hold"), free(0.5, "positive", "none")
    yield (
        "tradeoff.methods",
        functools.partial(_tradeoff, "methods"),
        Takes("other", allows=frozenset({"none"})),
        "methods?",
    )
    yield "tradeoff.dtypes", functools.partial(_tradeoff, "dtypes"), Takes("other")


def _tradeoff(name: str, x: Any) -> Any:
    system, state = plain()
    arguments = {"horizon": 0.01, "budget": 1.0, "dts": [1e-2], "methods": {"a": jc.Method()}} | {
        name: x
    }
    return jc.tradeoff(system, state, arguments.pop("horizon"), **arguments)


def _response(name: str, x: Any) -> Any:
    arguments = {"frequency": 1.0, "alpha": 1.0, "beta": 1.0}
    if name in ("dt", "integrator"):
        arguments |= {"dt": 1e-3, "integrator": jc.RK4()}
    return jc.stabilizers.frequency_response(**(arguments | {name: x}))


@functools.cache
def _sledge() -> tuple[Any, Any]:
    scene = jc.Scene(dim=2, dtype=F32)
    scene.add_body("sledge", mass=1.0, inertia=1.0)
    scene.add(jc.joints.KnifeEdge("edge", jc.WORLD, "sledge", edge=(1.0, 0.0)))
    return scene.build()


def _search() -> Iterator[Row]:
    none = frozenset({"none"})
    tune = functools.partial(jc.tune, lambda p: jnp.sum(p**2), jnp.ones(2))
    yield "tune.steps", lambda x: tune(steps=x), count()
    yield "tune.restarts", lambda x: tune(steps=1, restarts=x), count()
    yield "tune.samples", lambda x: tune(steps=1, samples=x), count(0)
    yield "tune.patience", lambda x: tune(steps=1, patience=x), count(1, "none")
    yield "tune.tolerance", lambda x: tune(steps=1, tolerance=x), free(1e-3, "not negative")
    yield "tune.spread", lambda x: tune(steps=1, spread=x), free(0.1, "not negative", shaped=False)
    yield "tune.optimizer", lambda x: tune(steps=1, optimizer=x), Takes("other", allows=none)
    yield (
        "tune.loss",
        lambda x: jc.tune(x, jnp.ones(2), steps=1),
        FUNCTION,
    )
    low, high = (free(x, "any", "none", "infinity", shaped=False) for x in (0.0, 2.0))
    yield "tune.bounds", lambda x: tune(steps=1, bounds=(x, None)), low
    yield (
        "tune.bounds of one name",
        lambda x: tune(steps=1, bounds={"*": (None, x)}),
        high,
        "bounds",
    )
    yield (
        "tune.progress",
        lambda x: tune(steps=1, progress=x),
        Takes("flag", allows=frozenset({"flag", "none"})),
    )
    yield (
        "tune.key",
        lambda x: tune(steps=1, restarts=2, key=x),
        Takes("other", allows=frozenset({"key"})),
        "key",
    )
    simulate, data = (lambda p: p), jnp.ones(2)
    identify = functools.partial(jc.identify, simulate, jnp.ones(2), data)
    yield "identify.steps", lambda x: identify(steps=x), count()
    yield "identify.restarts", lambda x: identify(restarts=x), count()
    yield "identify.continuity", lambda x: identify(continuity=x), free(1e-3, "positive")
    yield "identify.noise", lambda x: identify(noise=x), free(1.0, "positive", "none", shaped=False)
    yield "identify.spread", lambda x: identify(spread=x), free(0.1, "not negative", shaped=False)
    nodes = functools.partial(jc.identify, lambda p, node: (p, node), jnp.ones(2), jnp.ones((1, 2)))
    yield "identify.nodes", lambda x: nodes(nodes=x), Takes("other", allows=none)
    yield (
        "identify.data",
        lambda x: jc.identify(simulate, jnp.ones(2), x),
        Takes("other"),
        "data|compared with",
    )
    yield (
        "identify.simulate",
        lambda x: jc.identify(x, jnp.ones(2), data),
        FUNCTION,
    )


def _names() -> Iterator[Row]:
    """Yields arguments that name bodies, joints and coordinates, and parameters of functions."""
    one_body, two_bodies = (jc.forces.Force, jc.forces.ExternalWrench), (jc.Fixed, jc.Revolute)
    for kind in (*one_body, *two_bodies, jc.joints.Universal):
        arguments = dict(next(x for k, x, _ in ELEMENTS if k is kind))
        for field in ("body",) if kind in one_body else ("body_a", "body_b"):

            def call(x: Any, kind: Any = kind, arguments: Any = arguments, f: str = field) -> Any:
                return with_element(bodies, kind, arguments | {f: x})

            yield f"{kind.__name__}.{field}", call, Takes("other"), "body"
    custom = {"bodies": ("bob",), "function": lambda *_: jnp.zeros(3)}
    for field, takes in {"bodies": Takes("other"), "params": PARAMETERS}.items():
        call = functools.partial(
            _with, functools.partial(_it, jc.forces.CustomForce), custom, field
        )
        yield f"CustomForce.{field}", call, takes
    named = Takes("other", allows=frozenset({"none"}))
    for kind in (jc.Motor, jc.forces.JointSpring):
        arguments = next(x for k, x, _ in ALONG if k is kind)
        for field, takes in {"joint": Takes("other"), "coordinate": named}.items():
            make = functools.partial(_on_joint, kind, arguments)
            yield f"{kind.__name__}.{field}", functools.partial(make, field), takes, field
    gears = {"left": "one", "right": "two", "carrier": "slide"}
    make = functools.partial(_on_joint, jc.joints.Differential, gears)
    yield "Differential.coordinates", functools.partial(make, "coordinates"), Takes("other")
    drive = {"joint": "one", "motion": lambda t, p: 0.0 * t}
    make = functools.partial(_on_joint, jc.joints.Drive, drive)
    yield "Drive.params", functools.partial(make, "params"), PARAMETERS
    yield (
        "Drive.params of a name",
        lambda x: make("params", {"a": x}),
        PARAMETERS,
        "params 'a'|params",
    )
    yield "GeneralizedSystem.params", lambda x: _generalized(params=x), PARAMETERS
    for field in ("mass", "force"):
        arguments = {"mass": lambda q, p: jnp.ones_like(q), "force": lambda q, v, t, u, p: -q}
        builder = functools.partial(_with, jc.GeneralizedSystem, arguments, field)
        yield f"GeneralizedSystem.{field}", builder, FUNCTION
    optional = Takes("other", allows=frozenset({"function", "none"}))
    yield "GeneralizedSystem.potential", lambda x: _generalized(potential=x), optional
    system, state = motor()
    for read in (jc.momentum, jc.angular_momentum):
        name = f"{read.__name__}.bodies"
        yield name, lambda x, read=read: read(system, state, bodies=x), named, "bodies|body"
    integrability = functools.partial(jc.analysis.integrability, system, state)
    yield "integrability.names", lambda x: integrability(names=x), named, "names|constraint"
    hold = functools.partial(jc.assemble, system, np.asarray(state.q))
    yield "assemble.hold", lambda x: hold(hold=x), Takes("other"), "hold|body|is held"
    for field in ("memory", "angle_remainder"):

        def go(x: Any, field: str = field) -> Any:
            return step(state=dataclasses.replace(state, **{field: x}))

        yield f"State.{field}", go, Takes("other"), "state.angle_remainder|memory"
    systems = functools.partial(_with, jc.systems.vakonomic, {"system": system, "state": state})
    for field in ("system", "state"):
        yield f"vakonomic.{field}", functools.partial(systems, field), Takes("other"), "State"
    over = functools.partial(jc.devices.over_devices)
    yield "over_devices.function", over, FUNCTION
    platform = lambda x: jc.Method.auto(system, state, platform=x)  # noqa: E731
    yield "Method.auto.platform", platform, named
    control = free(np.zeros(1), "any", "none")
    yield "report.control", lambda x: jc.report(system, state, control=x), control
    kind = free(np.zeros(1), "any", "none", "NaN", "infinity", "function")
    memory = functools.partial(jc.analysis.gradient_memory, system, jc.Method(), state)
    yield "gradient_memory.control", memory, kind
    wait = jc.Method().stabilizer_for
    yield "stabilizer_for.dt", wait, free(1e-3, "positive", shaped=False)
    for integrator in (jc.SemiImplicitEuler(), jc.RK4()):
        name = f"{type(integrator).__name__}.default_gains.dt"
        takes = free(1e-3, "any", "NaN", "infinity", shaped=False)
        yield name, integrator.default_gains, takes


def _it(kind: Any, **arguments: Any) -> Any:
    return with_element(bodies, kind, arguments)


def _on_joint(kind: Any, arguments: dict[str, Any], name: str, x: Any) -> Any:
    return with_element(jointed, kind, arguments | {name: x})


def _pictures() -> Iterator[Row]:
    if find_spec("matplotlib") is None:
        return
    system, state = plain()
    q = free(np.asarray(state.q))
    yield "view.links.q", functools.partial(jc.view.links, system), q
    yield "view.draw.q", functools.partial(jc.view.draw, system), q
    path = free(np.asarray(state.q)[None])
    yield "view.animate.path", lambda x: jc.view.animate(system, x, 0.1), path
    interval = lambda x: jc.view.animate(system, np.asarray(state.q)[None], x)  # noqa: E731
    yield "view.animate.interval", interval, free(0.1, "positive")
    for picture in (jc.view.links, jc.view.draw):
        name = f"view.{picture.__name__}.system"
        yield name, lambda x, picture=picture: picture(x, state.q), Takes("other")


@functools.cache
def cart() -> tuple[Any, Any, Any]:
    """Returns the environment `CartPole`, an episode of it, and two copies of it."""
    environment, key = environments.make("CartPole"), jax.random.key(0)
    return environment, environment.reset(key), environments.begin(environment, key, 2)[0]


def _environments() -> Iterator[Row]:
    environment, episode, copies = cart()
    name, key = type(environment).__name__, jax.random.key(0)
    keys, any_number = Takes("other", allows=frozenset({"key"})), ("NaN", "infinity")
    one = free(np.zeros(1), "any", *any_number)
    yield f"{name}.reset.key", environment.reset, keys
    yield f"{name}.step.action", lambda x: environment.step(episode, x), one
    for what in ("step", "judge"):
        act = getattr(environment, what)
        rest = (episode,) if what == "judge" else ()
        yield (
            f"{name}.{what}.episode",
            lambda x, act=act, rest=rest: act(x, np.zeros(1), *rest),
            Takes("other"),
        )
    yield f"{name}.observe.episode", environment.observe, Takes("other")
    draws = (environments.begin, environments.vary, environments.jitter)
    for draw, rest in zip(
        draws, (2, {"cart": {"mass": 0.1}}, {"cart": {"mass": 0.1}}), strict=True
    ):
        start = functools.partial(_with, draw, _named(draw, environment, key, rest))
        yield f"{draw.__name__}.key", functools.partial(start, "key"), keys
        yield (
            f"{draw.__name__}.environment",
            functools.partial(start, "environment"),
            Takes("other"),
        )
    yield "begin.count", lambda x: environments.begin(environment, key, x), count()
    optional = Takes("other", allows=frozenset({"none", "function"}))
    yield "begin.randomize", lambda x: environments.begin(environment, key, 2, x), optional
    advance = functools.partial(environments.advance, environment)
    yield "advance.copies", lambda x: advance(x, np.zeros((2, 1))), Takes("other")
    yield (
        "advance.actions",
        lambda x: advance(copies, x),
        free(np.zeros((2, 1)), "any", *any_number),
    )
    yield "advance.mode", lambda x: advance(copies, np.zeros((2, 1)), x), Takes("other")
    arguments = _named(
        environments.feasible_action, environment, episode, np.zeros(1), lambda e: e.state.q[:1]
    )
    explore = functools.partial(_with, environments.feasible_action, arguments)
    for field, takes in {
        "episode": Takes("other"),
        "action": one,
        "limits": FUNCTION,
        "noise": free(0.0, shaped=False),
    }.items():
        yield f"feasible_action.{field}", functools.partial(explore, field), takes
    arguments = _named(environments.returns, environment, lambda x: jnp.zeros(1), key, 1)
    run = functools.partial(_with, environments.returns, arguments | {"actions": 1})
    for field, takes in {
        "environment": Takes("other"),
        "policy": FUNCTION,
        "key": keys,
        "count": count(),
        "actions": count(1, "none"),
    }.items():
        yield f"returns.{field}", functools.partial(run, field), takes
    soften = functools.partial(
        _with,
        environments.with_stiffness,
        _named(environments.with_stiffness, environment, 1.0, 1.0),
    )
    for field in ("stiffness", "damping"):
        takes = free(1.0, "not negative", shaped=False)
        yield f"with_stiffness.{field}", functools.partial(soften, field), takes
    yield "near.x", lambda x: environments.near(x, 1.0), free(1.0, "any", *any_number, shaped=False)
    yield "near.scale", lambda x: environments.near(1.0, x), free(1.0, "positive", shaped=False)


def _named(function: Any, *arguments: Any) -> dict[str, Any]:
    """Returns the first arguments of a function by name."""
    return dict(zip(inspect.signature(function).parameters, arguments, strict=False))


def _losses() -> Iterator[Row]:
    system, state = plain()
    losses = jc.learning.losses
    path, off = np.ones(2), jc.violation(system, state)
    yield (
        "losses.tracking.path",
        lambda x: losses.tracking(x, path),
        free(path, "any", "NaN", "infinity"),
        "what is simulated",
    )
    yield (
        "losses.tracking.scale",
        lambda x: losses.tracking(path, path, x),
        free(1.0, "positive", shaped=False),
    )
    for loss in (losses.violation, losses.mean_violation):
        yield (
            f"losses.{loss.__name__}.dt",
            lambda x, loss=loss: loss(off, x),
            real(1e-3, "positive"),
        )
        yield f"losses.{loss.__name__}.off", lambda x, loss=loss: loss(x, 1e-3), Takes("other")
    weighted = losses.weighted
    term = free(1.0, "any", "NaN", "infinity")
    yield "losses.weighted.term", lambda x: weighted({"a": x}, {"a": 1.0}), term
    yield "losses.weighted.weight", lambda x: weighted({"a": jnp.ones(())}, {"a": x}), free(1.0)


def _others() -> Iterator[Row]:
    solids = {
        "sphere": ({"mass": 1.0, "radius": 1.0}, ()),
        "box": ({"mass": 1.0, "size": (1.0, 1.0, 1.0)}, ()),
        "cylinder": ({"mass": 1.0, "radius": 1.0, "length": 1.0}, ()),
        "capsule": ({"mass": 1.0, "radius": 1.0, "length": 1.0}, ()),
        "rod": ({"mass": 1.0, "radius": 0.1, "length": 1.0}, ()),
    }
    for solid, (arguments, _) in solids.items():
        for field, good in arguments.items():

            def call(
                x: Any, solid: str = solid, arguments: Any = arguments, field: str = field
            ) -> Any:
                return getattr(jc.inertia, solid)(**(arguments | {field: x}))

            yield f"inertia.{solid}.{field}", call, free(good, "positive")
    tensor = functools.partial(jc.inertia.from_tensor, 1.0)
    yield "inertia.from_tensor.tensor", tensor, free(np.eye(3))
    yield "inertia.from_log_cholesky.theta", jc.inertia.from_log_cholesky, free(np.zeros(10))
    yield (
        "box_corners.size",
        jc.contacts.box_corners,
        free((1.0, 1.0, 1.0), "positive", shaped=False),
    )
    yield (
        "box_corners.position",
        lambda x: jc.contacts.box_corners((1.0, 1.0, 1.0), x),
        free(ORIGIN, "any", "none"),
    )
    hung = {"start": (0.0, 0.0), "end": (1.0, 0.0), "length": 2.0}
    for field, good in hung.items():
        sign = "positive" if field == "length" else "any"
        yield f"hanging.{field}", functools.partial(_hanging, field), free(good, sign)
    yield "hanging.links", functools.partial(_hanging, "links"), count()
    line = np.linspace(ORIGIN, X, 4)
    for field, good in {
        "points": line,
        "mass": 1.0,
        "radius": 0.1,
        "bending": 1.0,
        "twisting": 0.0,
    }.items():
        takes = real(
            good,
            "not negative" if field in ("bending", "twisting") else "any",
            shaped=field == "mass",
        )
        if field == "mass":
            takes = POSITIVE
        if field in ("radius", "bending"):
            takes = dataclasses.replace(takes, allows=frozenset({"none"}))
        yield f"rod.{field}", functools.partial(_rod, jc.chains.rod, field), takes
        if field in ("points", "mass", "bending"):
            yield f"rope.{field}", functools.partial(_rod, jc.chains.rope, field), takes
    yield (
        "curricula.decay.time",
        lambda x: curricula.decay(1.0, 1.0, x),
        free(1.0, "positive", shaped=False),
    )
    for field, good in {"t": 1.0, "initial": 1.0}.items():
        decay = functools.partial(_with, curricula.decay, {"t": 1.0, "initial": 1.0, "time": 1.0})
        yield f"curricula.decay.{field}", functools.partial(decay, field), free(good, shaped=False)
    ramp = functools.partial(
        _with, curricula.warm_up, {"episode": 1.0, "begin": 0.0, "end": 2.0, "least": 0.1}
    )
    for field in ("episode", "begin", "end", "least"):
        takes = free(3.0 if field == "end" else 0.0, shaped=False)
        yield f"curricula.warm_up.{field}", functools.partial(ramp, field), takes
    by_mean = functools.partial(
        _with, curricula.by_performance, {"performance": 1.0, "least": 0.0, "most": 1.0}
    )
    for field in ("performance", "least", "most", "middle"):
        yield (
            f"curricula.by_performance.{field}",
            functools.partial(by_mean, field),
            free(1.0, shaped=False),
        )
    for task, build in environments.TASKS.items():
        for field, option in inspect.signature(build).parameters.items():
            make = functools.partial(_made, task, field)
            if isinstance(option.default, float | tuple):
                sign = "positive" if field == "dt" else "not negative"
                yield f"{task}.{field}", make, free(option.default, sign, shaped=False)
            elif type(option.default) is int:
                yield f"{task}.{field}", make, count(1, *(["none"] if field == "horizon" else []))
    yield from _quaternions()
    for field in ("base", "speed", "force"):

        def tolerance(x: Any, field: str = field) -> Any:
            return begun(
                stabilizer=jc.Projection(
                    tolerance=jc.stabilizers.Tolerance(**({"base": 1e-6} | {field: x}))
                )
            )

        allows = ("none",) if field != "base" else ()
        yield f"Tolerance.{field}", tolerance, free(1e-6, "not negative", *allows)
    yield "make.task", environments.make, Takes("other")
    none = frozenset({"none"})
    for field in ("qpos", "qvel", "time"):
        good = 0.0 if field == "time" else np.zeros(1)
        optional = ("none",) if field == "qvel" else ()
        takes = real(good, "any", *optional)
        yield f"MujocoModel.state.{field}", functools.partial(_model_state, field), takes
    for field, takes in {"ignore": Takes("other"), "count_turns": flag()}.items():
        read = functools.partial(_with, jc.from_mjcf, {"source": _text()})
        yield f"from_mjcf.{field}", functools.partial(read, field), takes
    yield "from_mjcf.dtype", lambda x: jc.from_mjcf(_text(), dtype=x), Takes("other", allows=none)
    yield "from_mjcf.source", jc.from_mjcf, Takes("other"), "source|from_mjcf|file|XML"


QUATERNIONS = {
    "multiply": {"p": 4, "q": 4},
    "conjugate": {"q": 4},
    "rotate": {"q": 4, "x": 3},
    "matrix": {"q": 4},
    "derivative": {"q": 4, "omega": 3},
    "exp": {"phi": 3},
    "log": {"q": 4},
    "normalize": {"q": 4},
}
"""Functions of quaternions and vectors, with the number of components of each argument."""


def _quaternions() -> Iterator[Row]:
    for name, sizes in QUATERNIONS.items():
        arguments = {field: np.eye(size)[0] for field, size in sizes.items()}
        for field, good in arguments.items():
            call = functools.partial(_with, getattr(jc.quaternion, name), arguments, field)
            takes = free(good, "any", "NaN", "infinity", "batch")
            yield f"quaternion.{name}.{field}", call, takes, rf"\b{field}\b"
    turn = {"axis": Z, "angle": 1.0}
    for field, good in turn.items():
        call = functools.partial(_with, jc.quaternion.from_axis_angle, turn, field)
        yield f"quaternion.from_axis_angle.{field}", call, free(good, unread=True)
    yield "quaternion.from_matrix.r", jc.quaternion.from_matrix, free(np.eye(3), unread=True)


def _with(function: Any, arguments: dict[str, Any], name: str, x: Any) -> Any:
    return function(**(arguments | {name: x}))


def _made(task: str, name: str, x: Any) -> Any:
    return environments.make(task, **{name: x})


def _hanging(name: str, x: Any) -> Any:
    arguments = {"start": (0.0, 0.0), "end": (1.0, 0.0), "length": 2.0, "links": 4}
    return jc.chains.hanging(**(arguments | {name: x}))


def _rod(make: Any, name: str, x: Any) -> Any:
    scene = jc.Scene(dtype=F32)
    arguments = {"points": np.linspace(ORIGIN, X, 4), "mass": 1.0} | {name: x}
    if make is jc.chains.rod:
        arguments = {"radius": 0.05} | arguments
    points, mass = arguments.pop("points"), arguments.pop("mass")
    make(scene, "it", points, mass, **arguments)
    return scene.build()


def hesitant(state: Any) -> Any:
    """Returns an action, but branches on a traced value: an invalid policy."""
    return jnp.zeros(1) if state.q[0] > 0 else jnp.ones(1)


def nothing(*_: Any) -> None:
    """Returns nothing, where a function must return a value."""


def words(*_: Any) -> str:
    """Returns a string, where a function must return an array."""
    return "force"


def branching(x: Any, *_: Any) -> Any:
    """Returns an array, but branches on a traced value."""
    leaf = jax.tree.leaves(x)[0]
    return leaf if jnp.sum(leaf) > 0 else -leaf


def _levels(level: Any) -> Any:
    return jc.solvers.Priority({"rod": level})


def _motor_rollout(**arguments: Any) -> Any:
    system, state = motor()
    return jc.rollout(system, jc.Method(), state, arguments.pop("controls"), 1e-3, 2, **arguments)


def _custom(function: Any) -> Any:
    system, state = with_element(
        bodies, jc.forces.CustomForce, {"bodies": ("bob",), "function": function}
    )
    return jc.step(system, jc.Method(), state, None, 1e-3)


def _generalized(mass: Any = None, force: Any = None, **arguments: Any) -> Any:
    system = jc.GeneralizedSystem(
        mass=mass or (lambda q, p: jnp.ones_like(q)),
        force=force or (lambda q, v, t, u, p: -q),
        **arguments,
    )
    state = jc.init(system, jc.Method(), np.ones(2), np.zeros(2))
    return jc.step(system, jc.Method(), state, None, 1e-3)


MJCF = """<mujoco><worldbody><body pos="0 0 1">
<joint type="hinge" axis="0 1 0" damping="{damping}"/>
<geom type="sphere" size="{size}" mass="{mass}"/></body></worldbody></mujoco>"""


def _text(**attributes: str) -> str:
    return MJCF.format(**({"damping": "0.1", "size": "0.1", "mass": "1"} | attributes))


def _mjcf(**attributes: str) -> Any:
    return jc.from_mjcf(_text(**attributes))


@functools.cache
def _model() -> Any:
    return jc.from_mjcf(_text(), dtype=F32)


def _model_state(name: str, x: Any) -> Any:
    return _model().state(**({"qpos": np.zeros(1), "qvel": np.zeros(1)} | {name: x}))


Special = tuple[Callable[[Any], Any], tuple[str, ...]]

SPECIAL: dict[str, Special] = {
    "a policy with if": (lambda _: _motor_rollout(controls=hesitant), ("hesitant",)),
    "a policy that returns nothing": (lambda _: _motor_rollout(controls=nothing), ("controls",)),
    "a policy that returns a string": (lambda _: _motor_rollout(controls=words), ("controls",)),
    "a record with if": (
        lambda _: rollout(record=lambda s, i: 1.0 if s.q[0] > 0 else 0.0),
        ("record",),
    ),
    "a record of strings": (lambda _: rollout(record=words), ("record",)),
    **{
        f"a policy of `returns` that {does}": (
            lambda _, policy=policy: environments.returns(
                cart()[0], policy, jax.random.key(0), 1, 1
            ),
            (words_of,),
        )
        for does, policy, words_of in (
            ("has if", branching, r"returns: policy, 'branching' \(.*wrong_doors.py:\d+\)"),
            ("returns nothing", nothing, "returns: policy must return"),
            ("returns a string", words, "returns: policy must return"),
            ("returns another shape", lambda x: jnp.ones(3), "CartPole: an action must have shape"),
        )
    },
    **{
        f"limits of an action that {does}": (
            lambda _, limits=limits: environments.feasible_action(*cart()[:2], np.zeros(1), limits),
            ("feasible_action: limits must return",),
        )
        for does, limits in (
            ("return nothing", nothing),
            ("return a string", words),
            ("return no axis", lambda x: x.state.q[0]),
        )
    },
    "a key of two": (
        lambda _: cart()[0].reset(jax.random.split(jax.random.key(0))),
        ("CartPole.reset: key must be a single key",),
    ),
    "no copies of an environment": (
        lambda _: environments.begin(cart()[0], jax.random.key(0), 0),
        ("begin: count",),
    ),
    "a stiffness of an unknown constraint": (
        lambda _: environments.with_stiffness(cart()[0], {"zz": 1.0}, 1.0),
        ("with_stiffness: there is no constraint",),
    ),
    "a simulation that returns complex numbers": (
        lambda _: jc.identify(lambda p: jax.lax.complex(p, p), jnp.ones(2), jnp.ones(2)),
        ("identify: what simulate returns must be real numbers",),
    ),
    "a function that returns a string for its gradient": (
        lambda _: jc.check_gradients(words, jnp.ones(2)),
        ("check_gradients: f must return arrays",),
    ),
    "gains of two lengths": (
        lambda _: jc.stabilizers.frequency_response(np.ones(3), np.ones(2), 1.0),
        ("frequency_response: .* do not broadcast",),
    ),
    "a state without memory": (
        lambda _: step(state=dataclasses.replace(motor()[1], memory=None)),
        ("memory",),
    ),
    "a remainder of angles that are none": (
        lambda _: step(
            state=dataclasses.replace(motor()[1], angle_remainder=jnp.ones(7, jnp.float32))
        ),
        ("state.angle_remainder",),
    ),
    "an animation of one state": (
        lambda _: jc.view.animate(plain()[0], plain()[1].q, 0.1),
        ("animate: path must have shape",),
    ),
    **{
        f"controls of {what} for a diagnosis": (
            lambda _, x=x: jc.analysis.diagnose(*plain()[:1], jc.Method(), plain()[1], x, 1e-3, 5),
            ("diagnose: controls",),
        )
        for what, x in (("text", "x"), ("complex numbers", np.ones((5, 0)) + 1j))
    },
    **{
        f"MJCF with a timestep of {x}": (
            lambda _, x=x: jc.from_mjcf(
                _text().replace("<mujoco>", f'<mujoco><option timestep="{x}"/>')
            ),
            ("timestep",),
        )
        for x in ("-1", "0")
    },
    "a record of dates": (
        lambda _: rollout(record=lambda s, i: np.datetime64("2026-01-01")),
        ("rollout: record must return arrays",),
    ),
    "no control for a motor": (lambda _: step(control=None), ("drive",)),
    "no controls for a motor": (lambda _: _motor_rollout(controls=None), ("drive",)),
    "a force that returns nothing": (lambda _: _custom(nothing), ("CustomForce 'it'",)),
    "a force that returns a string": (lambda _: _custom(words), ("CustomForce 'it'",)),
    "a force with if": (lambda _: _custom(branching), ("branching",)),
    **{
        f"a {what} that {does}": (
            lambda _, what=what, function=function: _generalized(**{what: function}),
            (f"GeneralizedSystem: {what}",),
        )
        for what in ("mass", "force")
        for does, function in (
            ("returns nothing", nothing),
            ("returns a string", words),
            ("has if", branching),
        )
    },
    "a mass matrix that is not symmetric": (
        lambda _: _generalized(mass=lambda q, p: jnp.asarray([[1.0, 0.5], [0.0, 1.0]])),
        ("symmetric",),
    ),
    **{
        f"a {kind.__name__} that {does}": (
            lambda _, kind=kind, function=function: with_element_of(kind, function),
            (f"{kind.__name__} 'it'",),
        )
        for kind in (jc.joints.Holonomic, jc.joints.VelocityLevel, jc.contacts.Inequality)
        for does, function in (
            ("returns nothing", nothing),
            ("returns a string", words),
            ("has if", branching),
        )
    },
    **{
        f"a drive that {does}": (
            lambda _, function=function: with_element(
                jointed, jc.joints.Drive, {"joint": "one", "motion": function}
            ),
            ("Drive 'it'",),
        )
        for does, function in (
            ("returns nothing", nothing),
            ("returns a string", words),
            ("has if", branching),
        )
    },
    **{
        f"a loss that {does}": (
            lambda _, function=function: jc.tune(function, jnp.ones(2), steps=1),
            ("tune: loss", "tune: the loss"),
        )
        for does, function in (
            ("returns nothing", nothing),
            ("returns a string", words),
            ("has if", branching),
        )
    },
    **{
        f"a simulation that {does}": (
            lambda _, function=function: jc.identify(function, jnp.ones(2), jnp.ones(2)),
            ("identify: simulate",),
        )
        for does, function in (
            ("returns nothing", nothing),
            ("returns a string", words),
            ("has if", branching),
        )
    },
    "RankSafe in RankSafe": (
        lambda _: begun(solver=jc.solvers.RankSafe(jc.solvers.RankSafe())),
        ("RankSafe: solver",),
    ),
    "Priority in RankSafe": (
        lambda _: begun(solver=jc.solvers.RankSafe(jc.solvers.Priority({"rod": 1}))),
        ("RankSafe: solver",),
    ),
    "a level that is half": (lambda _: begun(solver=_levels(0.5)), ("level",)),
    "a level that is True": (lambda _: begun(solver=_levels(True)), ("level",)),
    "a run of zero rows": (lambda _: begun(solver=jc.solvers.Sparse(run=0)), ("run",)),
    "a billion levels": (
        lambda _: rollout(adjoint=jc.adjoints.Checkpoints(levels=10**9)),
        ("levels",),
    ),
    "a status of 99": (
        lambda _: step(state=dataclasses.replace(motor()[1], status=99)),
        ("status",),
    ),
    "a status of 99 in an array": (
        lambda _: step(state=dataclasses.replace(motor()[1], status=np.array(99, np.int32))),
        ("status",),
    ),
    "states with the status 99": (lambda _: jc.raise_for_status(np.array([0, 99])), ("99",)),
    "a path that is too long": (
        lambda _: jc.tune(jnp.sum, jnp.ones(2), steps=1, checkpoint="x" * 5000),
        ("checkpoint",),
    ),
    "a model in a path that is too long": (
        lambda _: jc.from_mjcf("x" * 5000),
        ("from_mjcf", "source"),
    ),
    **{
        f"{what} as the {part} of a method": (
            lambda _, part=part, value=value: jc.Method(**{part: value}),
            (rf"Method: {part}\b",),
        )
        for part in ("integrator", "stabilizer", "solver", "recovery", "contact_solver", "events")
        for what, value in (("a class", float), ("a name", "RK4"), ("a number", 1.0))
    },
    "gains by numbers": (lambda _: begun(stabilizer=jc.Baumgarte({1: 1.0}, 1.0)), ("alpha",)),
    "a gain that is None by name": (
        lambda _: begun(stabilizer=jc.Baumgarte({"rod": None}, 1.0)),
        ("alpha",),
    ),
    "MJCF with a mass of NaN": (lambda _: _mjcf(mass="nan"), ("mass",)),
    "MJCF with a size of NaN": (lambda _: _mjcf(size="nan"), ("size",)),
    "MJCF with a damping of NaN": (lambda _: _mjcf(damping="nan"), ("damping",)),
}
"""Hand-written wrong calls with patterns, one of which the error message must match."""


def with_element_of(kind: Any, function: Any) -> Any:
    """Takes a step of a scene in which a body has a constraint with a user's function."""
    scene = bodies()
    scene.add(kind(function, ("bob",), name="it"))
    system, state = scene.build()
    return jc.step(system, jc.Method(), state, None, 1e-3)
