"""The scenes of the tests: one table of joints, each joint built in three topologies.

An entry of the table says how to make a joint between two bodies. Every test over `NAMES` then
covers it in the plane and in space, on a tree, between moving bodies and closing a loop. The
joints of one topology share a scene, each with bodies of its own, so that they compile together.
`build("revolute-3d-loop")` is the scene of one joint alone.
"""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon.constraints.curves import Curves
from jaxcon.constraints.rows import linearize

linearized = jax.jit(linearize)
"""Linearizes the rows of a scene at a state; compiled once for each scene."""


@dataclass(frozen=True)
class Site:
    """The place of a joint: its two bodies, a point and an axis."""

    a: str
    b: str
    dim: int
    point: np.ndarray
    axis: np.ndarray
    other: np.ndarray
    """A second point, for joints that have two."""
    suffix: str = ""
    """The suffix of the element names."""

    @property
    def joint(self) -> tuple[str, str, str]:
        """The names of the joint and of its two bodies."""
        return ("joint" + self.suffix, self.a, self.b)


@dataclass(frozen=True)
class Joint:
    """One entry of the table of joints.

    Attributes:
        make: returns the elements of the joint; the joint is called "joint", a drive "drive".
        parameter: the element and the field that tests differentiate by.
        dims: the dimensions in which the joint exists.
        held: the number of rows of "joint" that have a φ, in the plane and in space; these come
            first. None if all rows have one.
    """

    make: Callable[[Site], list[Any]]
    parameter: tuple[str, str]
    dims: tuple[int, ...] = (2, 3)
    held: tuple[int, int] | None = None


def coincident(s: Site) -> list[Any]:
    return [jc.joints.Coincident(*s.joint, point=s.point)]


def spherical(s: Site) -> list[Any]:
    return [jc.Spherical(*s.joint, point=s.point)]


def distance(s: Site) -> list[Any]:
    return [jc.Distance(*s.joint, point_a=s.point, point_b=s.other)]


def revolute(s: Site) -> list[Any]:
    axis = None if s.dim == 2 else s.axis
    return [jc.Revolute(*s.joint, point=s.point, axis=axis)]


def prismatic(s: Site) -> list[Any]:
    return [jc.Prismatic(*s.joint, axis=s.axis, point=s.point)]


def universal(s: Site) -> list[Any]:
    across = np.cross(s.axis, s.other)
    return [jc.joints.Universal(*s.joint, point=s.point, axis_a=s.axis, axis_b=across)]


def cylindrical(s: Site) -> list[Any]:
    return [jc.joints.Cylindrical(*s.joint, axis=s.axis, point=s.point)]


def screw(s: Site) -> list[Any]:
    return [jc.joints.Screw(*s.joint, axis=s.axis, point=s.point, lead=0.7)]


def planar(s: Site) -> list[Any]:
    return [jc.joints.Planar(*s.joint, axis=s.axis, point=s.point)]


def parallel(s: Site) -> list[Any]:
    return [jc.joints.Parallel(*s.joint, axis=s.axis)]


def constant_velocity(s: Site) -> list[Any]:
    return [
        jc.joints.ConstantVelocity(*s.joint, point=s.point, axis=s.axis, axis_b=s.axis + s.other)
    ]


def point_on_line(s: Site) -> list[Any]:
    return [jc.joints.PointOnLine(*s.joint, axis=s.axis, point=s.point)]


def point_on_plane(s: Site) -> list[Any]:
    return [jc.joints.PointOnPlane(*s.joint, axis=s.axis, point=s.point)]


def bend(x: Any, p: Any) -> Any:
    """Returns φ of a parabola through a point of body a, twisted out of its plane in space."""
    y = x - p["start"]
    rows = [y[1] + p["curvature"] * y[0] ** 2 + 0.3 * y[0] * y[1]]
    if len(x) == 3:
        rows.append(y[2] - 0.3 * y[0] + 0.2 * y[0] * y[1] * y[2])
    return jnp.stack(rows)


def point_on_curve(s: Site) -> list[Any]:
    params = {"start": np.zeros(s.dim), "curvature": 0.7}  # start_curves replaces the start
    return [jc.joints.PointOnCurve(*s.joint, bend, point=s.point, params=params)]


def spherical_spherical(s: Site) -> list[Any]:
    return [jc.joints.SphericalSpherical(*s.joint, point_a=s.point, point_b=s.other)]


def revolute_spherical(s: Site) -> list[Any]:
    across = np.cross(s.axis, s.other - s.point)
    return [jc.joints.RevoluteSpherical(*s.joint, hinge=s.point, ball=s.other, axis=across)]


def fixed(s: Site) -> list[Any]:
    return [jc.Fixed(*s.joint, point=s.point)]


def wave(t: Any, p: Any) -> Any:
    return p["size"] * jnp.sin(p["frequency"] * t)


WAVE = {"size": 0.4, "frequency": 3.0}


def drive(s: Site) -> Any:
    return jc.joints.Drive("drive" + s.suffix, s.joint[0], wave, params=WAVE)


def driven(
    make: Callable[[Site], list[Any]], coordinate: str | None = None
) -> Callable[[Site], list[Any]]:
    """Returns a function that makes a joint and drives one of its coordinates."""

    def elements(s: Site) -> list[Any]:
        one = dataclasses.replace(drive(s), coordinate=coordinate)
        return [*make(s), one]

    return elements


def pulley(s: Site) -> list[Any]:
    """A rope from a point of body a to a point of body b and back."""
    spans = [
        jc.joints.Span(name + s.suffix, s.a, s.b, start, end)
        for name, start, end in (("there", s.point, s.other), ("back", s.other, s.other + s.axis))
    ]
    names = [span.name for span in spans]
    return [*spans, jc.joints.Pulley(s.joint[0], *names, parts=2.0)]


def cam(s: Site) -> list[Any]:
    """A coupling: the distance of two points is a polynomial of a hinge angle."""
    axis = None if s.dim == 2 else s.axis
    hinge = jc.Revolute("hinge" + s.suffix, s.a, s.b, point=s.point, axis=axis)
    reach = jc.joints.Span("reach" + s.suffix, s.a, s.b, s.other, s.point + s.other)
    shape = (0.0, 0.3, -0.2, 0.1)
    return [hinge, reach, jc.joints.PolynomialCoupling(s.joint[0], hinge.name, reach.name, shape)]


def telescope(s: Site) -> list[Any]:
    """Two oblique slides and two oblique hinges; two couplings relate them in pairs."""
    axes = np.array([s.axis, s.other + s.axis, np.cross(s.axis, s.other) + 0.3 * s.axis])
    name, a, b = s.joint
    arm = jc.joints.Compound(name, a, b, s.point, slides=(*axes[:2],), hinges=(*axes[1:],))
    shape = (0.0, 0.3, -0.2, 0.1)
    cams = [
        jc.joints.PolynomialCoupling(cam + s.suffix, name, name, shape, *coordinates)
        for cam, *coordinates in (("cam", "angle_1", "travel_2"), ("rise", "travel_1", "angle_2"))
    ]
    return [arm, *cams]


def gimbal(s: Site) -> list[Any]:
    """A slide and three oblique hinges; two couplings relate the hinge angles."""
    axes = np.array([s.axis, np.cross(s.axis, s.other) + 0.2 * s.axis, s.other])
    name, a, b = s.joint
    arm = jc.joints.Compound(name, a, b, s.point, slides=(s.other,), hinges=(*axes,))
    shape = (0.0, 0.3, -0.2, 0.1)
    turns = ("angle_1", "angle_2"), ("angle_2", "angle_3")
    cams = [
        jc.joints.PolynomialCoupling(cam + s.suffix, name, name, shape, *pair)
        for cam, pair in zip(("outer", "inner"), turns, strict=True)
    ]
    return [arm, *cams]


def breathing(a: Any, b: Any, t: Any, p: Any) -> Any:
    """Returns φ of a time-dependent distance between a point of b and the center of a."""
    gap = b.point(p["anchor"]) - a.position
    return (gap @ gap - p["square"] * (1 + 0.2 * jnp.sin(2 * t)))[None]


def holonomic(s: Site) -> list[Any]:
    params = {"anchor": np.full(s.dim, 0.3), "square": 1.0}  # start_breathing replaces the square
    return [jc.joints.Holonomic(breathing, bodies=(s.a, s.b), name=s.joint[0], params=params)]


def skate(a: Any, b: Any, t: Any, p: Any) -> Any:
    """Returns φ̇ of a constraint that gives a point of b a speed along a direction of a."""
    speed = b.point_velocity(p["anchor"]) - a.velocity
    return (a.direction(p["edge"]) @ speed - 0.2 * jnp.sin(3 * t))[None]


def velocity_level(s: Site) -> list[Any]:
    params = {"anchor": np.full(s.dim, 0.3), "edge": np.arange(1.0, s.dim + 1)}
    return [jc.joints.VelocityLevel(skate, bodies=(s.a, s.b), name=s.joint[0], params=params)]


def rolling_sphere(s: Site) -> list[Any]:
    return [jc.joints.RollingSphere(*s.joint, radius=0.4, normal=s.axis, center=s.point)]


def rolling_cylinder(s: Site) -> list[Any]:
    along = np.cross(s.axis, s.other)
    return [
        jc.joints.RollingCylinder(*s.joint, radius=0.4, axis=along, normal=s.axis, center=s.point)
    ]


def rolling_disc(s: Site) -> list[Any]:
    axis = None if s.dim == 2 else s.other
    return [jc.joints.RollingDisc(*s.joint, radius=0.4, axis=axis, normal=s.axis, center=s.point)]


def knife_edge(s: Site) -> list[Any]:
    ice = None if s.dim == 2 else s.axis
    return [jc.joints.KnifeEdge(*s.joint, edge=s.other, normal=ice, center=s.point)]


def momentum(s: Site) -> list[Any]:
    bodies = tuple(name for name in (s.a, s.b) if name != jc.WORLD)
    value = 0.3 if s.dim == 2 else 0.1 * s.axis
    return [jc.joints.AngularMomentum(s.joint[0], bodies, value)]


JOINTS = {
    "coincident": Joint(coincident, ("joint", "anchor_b")),
    "spherical": Joint(spherical, ("joint", "anchor_b"), dims=(3,)),
    "distance": Joint(distance, ("joint", "length")),
    "revolute": Joint(revolute, ("joint", "anchor_b")),
    "prismatic": Joint(prismatic, ("joint", "anchor_b")),
    "universal": Joint(universal, ("joint", "anchor_b"), dims=(3,)),
    "cylindrical": Joint(cylindrical, ("joint", "anchor_b"), dims=(3,)),
    "screw": Joint(screw, ("joint", "lead"), dims=(3,)),
    "planar": Joint(planar, ("joint", "anchor_b"), dims=(3,)),
    "parallel": Joint(parallel, ("joint", "axis"), dims=(3,)),
    "constant_velocity": Joint(constant_velocity, ("joint", "anchor_b"), dims=(3,)),
    "point_on_line": Joint(point_on_line, ("joint", "anchor_b")),
    "point_on_plane": Joint(point_on_plane, ("joint", "anchor_b")),
    "point_on_curve": Joint(point_on_curve, ("joint", "params")),
    "spherical_spherical": Joint(spherical_spherical, ("joint", "length"), dims=(3,)),
    "revolute_spherical": Joint(revolute_spherical, ("joint", "length"), dims=(3,)),
    "fixed": Joint(fixed, ("joint", "anchor_b")),
    "driven_revolute": Joint(driven(revolute), ("drive", "params")),
    "driven_prismatic": Joint(driven(prismatic), ("drive", "params")),
    "driven_universal_a": Joint(driven(universal, "angle_a"), ("drive", "params"), dims=(3,)),
    "driven_universal_b": Joint(driven(universal, "angle_b"), ("drive", "params"), dims=(3,)),
    "driven_sleeve": Joint(driven(cylindrical, "travel"), ("drive", "params"), dims=(3,)),
    "driven_shaft": Joint(driven(cylindrical, "angle"), ("drive", "params"), dims=(3,)),
    "driven_planar": Joint(driven(planar, "y"), ("drive", "params"), dims=(3,)),
    "pulley": Joint(pulley, ("joint", "parts")),
    "cam": Joint(cam, ("joint", "coefficients")),
    "rolling_sphere": Joint(rolling_sphere, ("joint", "radius"), (3,), (1, 1)),
    "rolling_cylinder": Joint(rolling_cylinder, ("joint", "radius"), (3,), (2, 2)),
    "rolling_disc": Joint(rolling_disc, ("joint", "radius"), held=(1, 1)),
    "knife_edge": Joint(knife_edge, ("joint", "anchor_b"), held=(0, 1)),
    "telescope": Joint(telescope, ("joint", "anchor_b"), dims=(3,)),
    "gimbal": Joint(gimbal, ("joint", "anchor_b"), dims=(3,)),
    "holonomic": Joint(holonomic, ("joint", "params")),
    "velocity_level": Joint(velocity_level, ("joint", "params"), held=(0, 0)),
    "momentum": Joint(momentum, ("joint", "value"), held=(0, 0)),
}
CORE = (
    *("coincident", "distance", "revolute", "prismatic", "universal", "fixed"),
    *("driven_revolute", "pulley", "rolling_disc", "gimbal", "holonomic", "velocity_level"),
)
"""Joints that cover every kind of row, for tests where compiling all would take minutes."""
PARTS = {2: 2, 3: 5}
"""The number of scenes that share the joints of a topology, by dimension.

Compile time grows faster than the number of joints in a scene.
"""
CORE_PARTS = {2: 1, 3: 3}
"""The number of scenes that share the core joints of a topology, by dimension."""
TOPOLOGIES = ("tree", "between", "loop")


@dataclass(frozen=True)
class Built:
    """A scene, ready to run.

    Attributes:
        system: the system that `build` returned.
        state: a moving state at time 0 that satisfies the constraints.
        off: a state at another time that violates the constraints in position and velocity.
        parameters: elements and fields that tests differentiate by.
        velocity_level: constraints with rows that have no φ, each with its number of rows with φ.
    """

    system: Any
    state: jc.State
    off: jc.State
    parameters: tuple[tuple[str, str], ...] = ()
    velocity_level: tuple[tuple[str, int], ...] = ()


def joints_scene(kinds: tuple[str, ...], dim: int, topology: str, dtype: Any) -> Built:
    """Builds a scene of joints of the table, all in one topology."""
    random = seeded(kinds, dim, topology)
    scene = jc.Scene(dim=dim, dtype=dtype)
    parameters: list[tuple[str, str]] = []
    for kind in kinds:
        suffix = "" if len(kinds) == 1 else "_" + kind
        add_joint(scene, kind, topology, suffix, seeded((kind,), dim, topology))
        element, field = JOINTS[kind].parameter
        parameters += [(element + suffix, field), ("first" + suffix, "mass")]
    system, state = scene.build()
    level = tuple(
        ("joint" + ("" if len(kinds) == 1 else "_" + kind), held[dim - 2])
        for kind in kinds
        if (held := JOINTS[kind].held) is not None
    )
    system = start_curves(start_breathing(system, state), state)
    return finish(system, state, random, tuple(parameters), level)


def add_joint(scene: jc.Scene, kind: str, topology: str, suffix: str, random: Any) -> None:
    """Adds bodies at random places and the joint between them."""
    first, second = "first" + suffix, "second" + suffix
    for name in (first,) if topology == "tree" else (first, second):
        add_random_body(scene, name, random)
    a, b = (jc.WORLD, first) if topology == "tree" else (first, second)
    point, other = near((0.8, 0.4), random, scene.dim), near((1.2, 1.1), random, scene.dim)
    site = Site(a, b, scene.dim, point, random.normal(size=scene.dim), other, suffix)
    for element in JOINTS[kind].make(site):
        scene.add(element)
    if topology == "loop":
        left, right = (near(x, random, scene.dim) for x in ((-0.5, 0.3), (2.0, 0.8)))
        far = near((3.0, -1.5), random, scene.dim)
        scene.add(jc.Distance("left" + suffix, jc.WORLD, first, point_b=left))
        scene.add(jc.Distance("right" + suffix, second, jc.WORLD, point_a=right, point_b=far))


def near(place: tuple[float, float], random: Any, dim: int) -> np.ndarray:
    """Returns a random point near a point of the plane."""
    return np.pad(place, (0, dim - 2)) + 0.2 * random.normal(size=dim)


def start_breathing(system: Any, state: jc.State) -> Any:
    """Returns the system with each squared `breathing` distance as it is at assembly."""
    changes = {}
    for group in system.constraints:
        if getattr(getattr(group, "law", None), "function", None) is breathing:
            a, b = group.law.bodies
            gap = jc.position(system, state, b, group.params["anchor"])
            gap = gap - (0 if a == jc.WORLD else jc.position(system, state, a))
            changes[group.law.name] = {"params": group.params | {"square": gap @ gap}}
    return system.with_params(changes)


def start_curves(system: Any, state: jc.State) -> Any:
    """Returns the system with curves that pass through their points at assembly."""
    snapshot = system.snapshot(state.q, state.v, state.time)
    changes = {}
    for group in system.constraints:
        if isinstance(group, Curves):
            place = jnp.concatenate([row.value for row in group.place(snapshot)])
            changes[group.names[0]] = {"params": group.given | {"start": place}}
    return system.with_params(changes)


def add_random_body(scene: jc.Scene, name: str, random: Any) -> None:
    """Adds a randomly placed body.

    A "second" body has its center of mass and its principal axes off its frame.
    """
    dim = scene.dim
    place = (1.5, 0.5) if name.startswith("second") else (0.1, -0.1)
    motion: dict[str, Any] = {"position": near(place, random, dim)}
    motion["velocity"] = random.normal(size=dim)
    motion["angular_velocity"] = random.normal(size=() if dim == 2 else 3)
    motion["angle" if dim == 2 else "quaternion"] = random.normal(size=() if dim == 2 else 4)
    mass = random.uniform(0.5, 2.0)
    if name.startswith("second") and dim == 3:
        spread = random.normal(size=(3, 3))
        moment = spread @ spread.T
        tensor = jnp.asarray(np.trace(moment) * np.eye(3) - moment, scene.dtype)
        solid = jc.inertia.from_tensor(mass, tensor, center=(0.2, -0.1, 0.3))
        scene.add_body(name, inertia=solid, **motion)
    elif name.startswith("second"):
        solid = jc.inertia.Inertia(mass, 0.7, center=(0.2, -0.1))
        scene.add_body(name, inertia=solid, **motion)
    else:
        scene.add_body(name, mass=mass, inertia=0.8 if dim == 2 else (0.8, 1.1, 1.5), **motion)


def mixed_scene(dim: int, dtype: Any) -> Built:
    """Builds particles and rigid bodies with every constraint that a particle may have."""
    random = seeded("mixed", dim)
    scene = jc.Scene(dim=dim, dtype=dtype)
    add_random_body(scene, "first", random)
    add_random_body(scene, "second", random)
    places = random.normal(size=(4, dim))
    for name, place in zip(("bead", "bob", "mate", "free"), places, strict=True):
        scene.add_particle(name, mass=random.uniform(0.5, 2.0), position=place)
    axis = None if dim == 2 else (0.0, 1.0, 1.0)
    scene.add(jc.Revolute("hinge", jc.WORLD, "first", point=random.normal(size=dim), axis=axis))
    scene.add(jc.joints.Coincident("pin", "first", "bead", point=places[0]))
    scene.add(jc.Distance("rod", "bead", "bob"))
    scene.add(jc.Distance("bar", "second", "bob", point_a=random.normal(size=dim)))
    scene.add(jc.Distance("string", jc.WORLD, "mate", point_a=random.normal(size=dim)))
    edge = {"anchor": np.zeros(dim), "edge": np.arange(1.0, dim + 1)}
    scene.add(jc.joints.VelocityLevel(skate, bodies=("mate", "second"), name="skate", params=edge))
    scene.add(jc.Spring("spring", "free", "bob", stiffness=3.0, damping=0.2, rest_length=0.5))
    scene.add(jc.forces.ExternalWrench("push", "second"))
    system, state = scene.build()
    parameters = (("rod", "length"), ("bob", "mass"), ("spring", "stiffness"))
    return finish(system, state, random, parameters, (("skate", 0),))


def arm(*elements: Any, dim: int = 2) -> tuple[Any, jc.State]:
    """Builds a body on a hinge, with more elements if given."""
    scene = jc.Scene(dim=dim)
    place = np.eye(dim)[0]
    inertia = 0.1 if dim == 2 else (0.1, 0.2, 0.3)
    axis = {} if dim == 2 else {"axis": (0.0, 1.0, 0.0)}
    scene.add_body("arm", mass=1.0, inertia=inertia, position=0.5 * place)
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=0 * place, **axis))
    for element in elements:
        scene.add(element)
    return scene.build()


def hanging(dtype: Any = None, steps: int = 60) -> Any:
    """Returns a function: (stiffness, damping) → height of a bob on a rod and a spring.

    The heights are recorded every 10 ms for 0.6 s.
    """
    scene = jc.Scene(dim=2, dtype=dtype)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    spring = {"stiffness": 5.0, "damping": 0.3, "point_a": (0.0, 1.0)}
    scene.add(jc.Spring("spring", jc.WORLD, "bob", **spring))
    system, state = scene.build()

    def height(p: Any) -> jax.Array:
        own, record = system.with_params({"spring": p}), lambda s, i: s.q[1]
        last, y = jc.rollout(own, jc.Method(), state, None, 1e-2, steps, record=record)
        return jc.learning.losses.unless_failed(y, last)

    return height


def polar_mass(q: Any, p: Any) -> Any:
    return jnp.stack([p["mass"], p["mass"] * q[0] ** 2])


def polar_force(q: Any, v: Any, t: Any, u: Any, p: Any) -> Any:
    (r, angle), (speed, rate) = q, v
    pull = r * rate**2 + p["gravity"] * jnp.cos(angle)
    return p["mass"] * jnp.stack([pull, -2 * r * speed * rate - p["gravity"] * r * jnp.sin(angle)])


def polar_potential(q: Any, t: Any, p: Any) -> Any:
    return -p["mass"] * p["gravity"] * q[0] * jnp.cos(q[1])


def polar_rod(q: Any, t: Any, p: Any) -> Any:
    return q[:1] - p["length"] * (1 + 0.2 * jnp.sin(2 * t))


def polar_scene(dtype: Any) -> Built:
    """A pendulum in polar coordinates: a diagonal mass matrix that depends on q."""
    params = {"mass": 1.5, "gravity": 9.81, "length": 1.2}
    system = jc.GeneralizedSystem(
        mass=polar_mass,
        force=polar_force,
        potential=polar_potential,
        constraints=(jc.joints.Holonomic(polar_rod, name="rod"),),
        params={name: jnp.asarray(x, dtype) for name, x in params.items()},
    )
    state = jc.init(system, jc.Method(), jnp.asarray([1.2, 0.7], dtype), np.zeros(2))
    return finish(system, state, seeded("polar"))


def arm_mass(q: Any, p: Any) -> Any:
    coupling = p["coupling"] * jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2 * p["moment"], coupling]), jnp.stack([coupling, p["moment"]])])


def arm_force(q: Any, v: Any, t: Any, u: Any, p: Any) -> Any:
    swing = p["coupling"] * jnp.sin(q[0] - q[1])
    return jnp.stack([-swing * v[1] ** 2, swing * v[0] ** 2]) - 3 * jnp.sin(q)


def arm_speed(q: Any, v: Any, t: Any, p: Any) -> Any:
    return (jnp.cos(q) @ v - 0.2 * jnp.sin(3 * t))[None]


def arm_scene(dtype: Any) -> Built:
    """Two links described by their angles: a full mass matrix and a velocity constraint."""
    system = jc.GeneralizedSystem(
        mass=arm_mass,
        force=arm_force,
        constraints=(jc.joints.VelocityLevel(arm_speed, name="speed"),),
        params={"moment": jnp.asarray(1.3, dtype), "coupling": jnp.asarray(0.7, dtype)},
    )
    state = jc.init(system, jc.Method(), jnp.asarray([0.4, -0.9], dtype), np.zeros(2))
    return finish(system, state, seeded("arm"), (), (("speed", 0),))


OTHERS = {
    "mixed-2d": functools.partial(mixed_scene, 2),
    "mixed-3d": functools.partial(mixed_scene, 3),
    "polar": polar_scene,
    "arm": arm_scene,
}


def parts(dim: int, topology: str) -> tuple[str, ...]:
    """The names of the scenes that together contain every joint in this topology."""
    return tuple(f"part{i}-{dim}d-{topology}" for i in range(PARTS[dim]))


def core(dim: int, topology: str) -> tuple[str, ...]:
    """The names of the scenes that together contain the core joints in this topology."""
    return tuple(f"core{i}-{dim}d-{topology}" for i in range(CORE_PARTS[dim]))


ALL = tuple(name for dim in PARTS for topology in TOPOLOGIES for name in parts(dim, topology))
"""The scenes that together contain every joint in every topology."""
NAMES = (*ALL, *OTHERS)
SELECTED = (*parts(2, "loop"), *core(3, "loop"), *OTHERS)
"""The scenes that together contain every kind of row, in the plane and in space."""


def names(*topologies: str) -> tuple[str, ...]:
    """The names of the scenes of single joints in these topologies."""
    return tuple(
        f"{kind}-{dim}d-{topology}"
        for kind, joint in JOINTS.items()
        for dim in joint.dims
        for topology in topologies
    )


@functools.cache
def build(name: str, dtype: str = "float64") -> Built:
    """Builds the scene of this name."""
    if name in OTHERS:
        return OTHERS[name](jnp.dtype(dtype))
    kind, place, topology = name.split("-")
    dim = int(place[0])
    return joints_scene(kinds_of(kind, dim), dim, topology, jnp.dtype(dtype))


def kinds_of(kind: str, dim: int) -> tuple[str, ...]:
    """Returns the joints of a scene: one joint, a share of the core, or a share of all joints."""
    if kind in JOINTS:
        return (kind,)
    table, count = (CORE, CORE_PARTS) if kind.startswith("core") else (JOINTS, PARTS)
    kinds = tuple(key for key in table if dim in JOINTS[key].dims)
    return kinds[int(kind[4:]) :: count[dim]]


def finish(
    system: Any, state: jc.State, random: Any, parameters: Any = (), velocity_level: Any = ()
) -> Built:
    """Adds velocities that satisfy the constraints, and a second state that violates them."""
    dtype = state.q.dtype
    v = jnp.asarray(random.normal(size=state.v.shape), dtype)
    step = jnp.asarray(0.1 * random.normal(size=state.v.shape), dtype)
    on = dataclasses.replace(state, v=allowed(system, state, v))
    off = dataclasses.replace(
        state, q=system.retract(state.q, step), v=v, time=jnp.asarray(0.3, dtype)
    )
    return Built(system, on, off, parameters, velocity_level)


def allowed(system: Any, state: jc.State, v: jax.Array) -> jax.Array:
    """Returns the velocities nearest to v, in the metric of M, that satisfy the constraints."""
    rows = linearized(system, state.q, v, state.time)
    j = np.asarray(rows.jacobian.dense(), np.float64)
    lift = np.linalg.solve(np.asarray(system.mass(state.q).dense(), np.float64), j.T)
    change = lift @ np.linalg.solve(j @ lift, np.asarray(rows.rate, np.float64))
    return v - jnp.asarray(change, v.dtype)


def seeded(*key: Any) -> np.random.Generator:
    """Returns a random generator whose seed depends on the key alone."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))
