"""The scenes of the product tests: one table of joints, three places in which each is put.

A row says how a joint is made between two bodies; every test that runs over `NAMES` or `JOINTS`
then covers it in the plane and in space, on a tree, between moving bodies and closing a loop.
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
from compiling import quick_jit
from jaxcon.constraints.rows import linearize


@dataclass(frozen=True)
class Site:
    """Where a joint is to be made: between which bodies, at which point, along which axis."""

    a: str
    b: str
    dim: int
    point: np.ndarray
    axis: np.ndarray
    other: np.ndarray
    """A second point, for joints that have two."""


@dataclass(frozen=True)
class Joint:
    """One row of the table.

    Attributes:
        make: elements that make the joint, the joint itself called "joint".
        parameter: element and field of a number to differentiate by.
        dims: dimensions in which it exists.
        velocity_level: whether "joint" has no φ.
    """

    make: Callable[[Site], list[Any]]
    parameter: tuple[str, str]
    dims: tuple[int, ...] = (2, 3)
    velocity_level: bool = False


def coincident(s: Site) -> list[Any]:
    return [jc.Coincident("joint", s.a, s.b, point=s.point)]


def spherical(s: Site) -> list[Any]:
    return [jc.Spherical("joint", s.a, s.b, point=s.point)]


def distance(s: Site) -> list[Any]:
    return [jc.Distance("joint", s.a, s.b, point_a=s.point, point_b=s.other)]


def revolute(s: Site) -> list[Any]:
    axis = None if s.dim == 2 else s.axis
    return [jc.Revolute("joint", s.a, s.b, point=s.point, axis=axis)]


def prismatic(s: Site) -> list[Any]:
    return [jc.Prismatic("joint", s.a, s.b, axis=s.axis, point=s.point)]


def fixed(s: Site) -> list[Any]:
    return [jc.Fixed("joint", s.a, s.b, point=s.point)]


def wave(t: Any, p: Any) -> Any:
    return p["size"] * jnp.sin(p["frequency"] * t)


WAVE = {"size": 0.4, "frequency": 3.0}


def driven_revolute(s: Site) -> list[Any]:
    return [*revolute(s), jc.Drive("drive", "joint", wave, params=WAVE)]


def driven_prismatic(s: Site) -> list[Any]:
    return [*prismatic(s), jc.Drive("drive", "joint", wave, params=WAVE)]


def breathing(a: Any, b: Any, t: Any, p: Any) -> Any:
    """A point of b stays at a distance from the centre of a that varies in time."""
    gap = b.point(p["anchor"]) - a.position
    return (gap @ gap - p["square"] * (1 + 0.2 * jnp.sin(2 * t)))[None]


def holonomic(s: Site) -> list[Any]:
    # the anchor is in b's own frame, so what the square must be follows from the poses at assembly
    params = {"anchor": np.full(s.dim, 0.3), "square": 1.0}
    return [jc.Holonomic(breathing, bodies=(s.a, s.b), name="joint", params=params)]


def skate(a: Any, b: Any, t: Any, p: Any) -> Any:
    """A point of b moves across a direction of a as a wave in time says."""
    speed = b.point_velocity(p["anchor"]) - a.velocity
    return (a.direction(p["edge"]) @ speed - 0.2 * jnp.sin(3 * t))[None]


def velocity_level(s: Site) -> list[Any]:
    params = {"anchor": np.full(s.dim, 0.3), "edge": np.arange(1.0, s.dim + 1)}
    return [jc.VelocityLevel(skate, bodies=(s.a, s.b), name="joint", params=params)]


JOINTS = {
    "coincident": Joint(coincident, ("joint", "anchor_b")),
    "spherical": Joint(spherical, ("joint", "anchor_b"), dims=(3,)),
    "distance": Joint(distance, ("joint", "length")),
    "revolute": Joint(revolute, ("joint", "anchor_b")),
    "prismatic": Joint(prismatic, ("joint", "anchor_b")),
    "fixed": Joint(fixed, ("joint", "anchor_b")),
    "driven_revolute": Joint(driven_revolute, ("drive", "params")),
    "driven_prismatic": Joint(driven_prismatic, ("drive", "params")),
    "holonomic": Joint(holonomic, ("joint", "params")),
    "velocity_level": Joint(velocity_level, ("joint", "params"), velocity_level=True),
}
TOPOLOGIES = ("tree", "between", "loop")


@dataclass(frozen=True)
class Built:
    """A scene, ready to run.

    Attributes:
        system: what `build` gave.
        state: on the constraints, moving, at time 0.
        off: off the constraints in position and velocity, at another time.
        parameter: element and field to differentiate by; None on generalized coordinates.
        velocity_level: names of the constraints without φ.
    """

    system: Any
    state: jc.State
    off: jc.State
    parameter: tuple[str, str] | None
    velocity_level: tuple[str, ...] = ()


def joint_scene(kind: str, dim: int, topology: str, dtype: Any) -> Built:
    """One joint of the table: to the world, between two bodies, or closing a loop of them."""
    random = seeded(kind, dim, topology)
    scene = jc.Scene(dim=dim, dtype=dtype)
    bodies = ["first"] if topology == "tree" else ["first", "second"]
    for name in bodies:
        add_random_body(scene, name, random, dtype)
    a, b = (jc.WORLD, "first") if topology == "tree" else ("first", "second")
    point, axis, other = random.normal(size=(3, dim))
    for element in JOINTS[kind].make(Site(a, b, dim, point, axis, point + axis + 0.5 * other)):
        scene.add(element)
    if topology == "loop":
        scene.add(jc.Distance("left", jc.WORLD, "first", point_b=random.normal(size=dim)))
        scene.add(jc.Distance("right", "second", jc.WORLD, point_a=random.normal(size=dim)))
    system, state = scene.build()
    if kind == "holonomic":
        system = start_breathing(system, state, a, b)
    level = ("joint",) if JOINTS[kind].velocity_level else ()
    return finish(system, state, random, JOINTS[kind].parameter, level)


def start_breathing(system: Any, state: jc.State, a: str, b: str) -> Any:
    """The same with the square of the user's distance as it is at assembly."""
    params = system.params["joint"]["params"]
    gap = jc.position(system, state, b, params["anchor"])
    gap = gap - (0 if a == jc.WORLD else jc.position(system, state, a))
    return system.with_params({"joint": {"params": params | {"square": gap @ gap}}})


def add_random_body(scene: Any, name: str, random: Any, dtype: Any) -> None:
    """A body somewhere; "second" has its centre of mass and principal axes off its frame."""
    dim = scene.dim
    motion: dict[str, Any] = {"position": random.normal(size=dim)}
    motion["velocity"] = random.normal(size=dim)
    motion["angular_velocity"] = random.normal(size=() if dim == 2 else 3)
    motion["angle" if dim == 2 else "quaternion"] = random.normal(size=() if dim == 2 else 4)
    mass = random.uniform(0.5, 2.0)
    if name == "second" and dim == 3:
        spread = random.normal(size=(3, 3))
        moment = spread @ spread.T
        tensor = jnp.asarray(np.trace(moment) * np.eye(3) - moment, dtype)
        solid = jc.inertia.from_tensor(mass, tensor, center=(0.2, -0.1, 0.3))
        scene.add_body(name, inertia=solid, **motion)
    elif name == "second":
        solid = jc.inertia.Inertia(mass, 0.7, center=(0.2, -0.1))
        scene.add_body(name, inertia=solid, **motion)
    else:
        scene.add_body(name, mass=mass, inertia=0.8 if dim == 2 else (0.8, 1.1, 1.5), **motion)


def mixed_scene(dim: int, dtype: Any) -> Built:
    """Particles and rigid bodies together, every kind of constraint that a particle may have."""
    random = seeded("mixed", dim)
    scene = jc.Scene(dim=dim, dtype=dtype)
    add_random_body(scene, "first", random, dtype)
    add_random_body(scene, "second", random, dtype)
    places = random.normal(size=(4, dim))
    for name, place in zip(("bead", "bob", "mate", "free"), places, strict=True):
        scene.add_particle(name, mass=random.uniform(0.5, 2.0), position=place)
    axis = None if dim == 2 else (0.0, 1.0, 1.0)
    scene.add(jc.Revolute("hinge", jc.WORLD, "first", point=random.normal(size=dim), axis=axis))
    scene.add(jc.Coincident("pin", "first", "bead", point=places[0]))
    scene.add(jc.Distance("rod", "bead", "bob"))
    scene.add(jc.Distance("bar", "second", "bob", point_a=random.normal(size=dim)))
    scene.add(jc.Distance("string", jc.WORLD, "mate", point_a=random.normal(size=dim)))
    edge = {"anchor": np.zeros(dim), "edge": np.arange(1.0, dim + 1)}
    scene.add(jc.VelocityLevel(skate, bodies=("mate", "second"), name="skate", params=edge))
    scene.add(jc.Spring("spring", "free", "bob", stiffness=3.0, damping=0.2, rest_length=0.5))
    scene.add(jc.ExternalWrench("push", "second"))
    system, state = scene.build()
    return finish(system, state, random, ("rod", "length"), ("skate",))


def polar_mass(q: Any, p: Any) -> Any:
    return jnp.stack([p["mass"], p["mass"] * q[0] ** 2])


def polar_force(q: Any, v: Any, t: Any, u: Any, p: Any) -> Any:
    (r, angle), (speed, rate) = q, v
    pull = r * rate**2 + p["gravity"] * jnp.cos(angle)
    return p["mass"] * jnp.stack(
        [pull, -2 * r * speed * rate - p["gravity"] * r * jnp.sin(angle)]
    )


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
        constraints=(jc.Holonomic(polar_rod, name="rod"),),
        params={name: jnp.asarray(x, dtype) for name, x in params.items()},
    )
    state = jc.init(system, jc.Method(), jnp.asarray([1.2, 0.7], dtype), np.zeros(2))
    return finish(system, state, seeded("polar"), None)


def arm_mass(q: Any, p: Any) -> Any:
    coupling = p["coupling"] * jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2 * p["moment"], coupling]), jnp.stack([coupling, p["moment"]])])


def arm_force(q: Any, v: Any, t: Any, u: Any, p: Any) -> Any:
    swing = p["coupling"] * jnp.sin(q[0] - q[1])
    return jnp.stack([-swing * v[1] ** 2, swing * v[0] ** 2]) - 3 * jnp.sin(q)


def arm_speed(q: Any, v: Any, t: Any, p: Any) -> Any:
    return (jnp.cos(q) @ v - 0.2 * jnp.sin(3 * t))[None]


def arm_scene(dtype: Any) -> Built:
    """Two links by their angles: a full mass matrix, and a constraint on the velocity."""
    system = jc.GeneralizedSystem(
        mass=arm_mass,
        force=arm_force,
        constraints=(jc.VelocityLevel(arm_speed, name="speed"),),
        params={"moment": jnp.asarray(1.3, dtype), "coupling": jnp.asarray(0.7, dtype)},
    )
    state = jc.init(system, jc.Method(), jnp.asarray([0.4, -0.9], dtype), np.zeros(2))
    return finish(system, state, seeded("arm"), None, ("speed",))


OTHERS = {
    "mixed-2d": functools.partial(mixed_scene, 2),
    "mixed-3d": functools.partial(mixed_scene, 3),
    "polar": polar_scene,
    "arm": arm_scene,
}
NAMES = (
    *(
        f"{kind}-{dim}d-{topology}"
        for kind, joint in JOINTS.items()
        for dim in joint.dims
        for topology in TOPOLOGIES
    ),
    *OTHERS,
)
"""Every scene."""


def names(*topologies: str) -> tuple[str, ...]:
    """Every joint in these places, without the other scenes."""
    return tuple(name for name in NAMES if name.rpartition("-")[2] in topologies)


@functools.cache
def build(name: str, dtype: str = "float64") -> Built:
    """The scene of this name."""
    if name in OTHERS:
        return OTHERS[name](jnp.dtype(dtype))
    kind, dim, topology = name.split("-")
    return joint_scene(kind, int(dim[0]), topology, jnp.dtype(dtype))


def finish(
    system: Any, state: jc.State, random: Any, parameter: Any, velocity_level: Any = ()
) -> Built:
    """Adds velocities that the constraints allow, and a state off the constraints."""
    dtype = state.q.dtype
    v = jnp.asarray(random.normal(size=state.v.shape), dtype)
    step = jnp.asarray(0.1 * random.normal(size=state.v.shape), dtype)
    on = dataclasses.replace(state, v=allowed(system, state, v))
    off = dataclasses.replace(
        state, q=system.retract(state.q, step), v=v, time=jnp.asarray(0.3, dtype)
    )
    return Built(system, on, off, parameter, velocity_level)


def allowed(system: Any, state: jc.State, v: jax.Array) -> jax.Array:
    """The velocities nearest to v, in the metric of M, that the constraints allow."""
    rows = quick_jit(linearize)(system, state.q, v, state.time)
    j = np.asarray(rows.jacobian.dense(), np.float64)
    lift = np.linalg.solve(np.asarray(system.mass(state.q).dense(), np.float64), j.T)
    change = lift @ np.linalg.solve(j @ lift, np.asarray(rows.rate, np.float64))
    return v - jnp.asarray(change, v.dtype)


def seeded(*key: Any) -> np.random.Generator:
    """Random numbers that depend on the key alone."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))
