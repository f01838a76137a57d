"""Pairs of bodies with each kind of element, placed so that singular configurations occur exactly.

At assembly both bodies are unrotated and at rest, 1 m apart along x, and every constraint holds.
An element's point on the second body is its point on the first body, shifted by 1 m. If the bodies
are moved onto each other, the two points coincide and lengths become zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxcon as jc

Made = list[Any]
PAIR = ("a", "b")


def along(dim: int, i: int) -> np.ndarray:
    """Returns the i-th world axis. In space, the last axis is normal to the plane."""
    return np.eye(dim)[i]


def hinge(dim: int, name: str = "joint", a: str = "a", b: str = "b", x: float = 0.5) -> Any:
    """Returns a revolute joint about z between two bodies, at a point on the x axis."""
    axis = None if dim == 2 else along(3, 2)
    return jc.Revolute(name, a, b, point=x * along(dim, 0), axis=axis)


def slide(dim: int, name: str = "joint", a: str = "a", b: str = "b") -> Any:
    """Returns a prismatic joint along x between two bodies."""
    return jc.Prismatic(name, a, b, axis=along(dim, 0), point=0.5 * along(dim, 0))


def ends(dim: int) -> dict[str, Any]:
    """Returns attachment points on the bodies a and b that coincide if the bodies do."""
    point = 0.3 * along(dim, 1)
    return {"point_a": point, "point_b": point + along(dim, 0)}


def wave(t: Any, p: Any) -> Any:
    """Returns the target of a drive, which starts at rest."""
    return p["size"] * (1 - jnp.cos(p["frequency"] * t))


def parabola(x: Any, p: Any) -> Any:
    """Returns the residuals of a point on a parabola, which passes through the point `start`."""
    y = x - p["start"]
    return jnp.stack([y[1] + p["curvature"] * y[0] ** 2, *y[2:]])


def apart(a: Any, b: Any, t: Any, p: Any) -> Any:
    """Returns the deviation of the squared distance from its value at assembly, 1 m²."""
    gap = b.position - a.position
    return jnp.stack([gap @ gap - p["square"]])


def skate(a: Any, b: Any, t: Any, p: Any) -> Any:
    """Returns the sideways velocity of a point of body b along a direction of body a, (1,) [m/s].

    The constraint requires that it is zero.
    """
    return jnp.stack([a.direction(p["edge"]) @ (b.point_velocity(p["anchor"]) - a.velocity)])


def pull(a: Any, b: Any, t: Any, u: Any, p: Any) -> Any:
    """Returns custom wrenches on both bodies that depend on their squared distance."""
    gap = b.position - a.position
    force = p["stiffness"] * gap * (gap @ gap - 1)
    wrench = jnp.concatenate([force, jnp.zeros(1 if len(gap) == 2 else 3, gap.dtype)])
    return wrench, -wrench


def hills(dim: int) -> np.ndarray:
    """Returns the heights of a terrain that passes below the second body."""
    x = 0.1 * np.cos(np.linspace(-4.0, 4.0, 12))
    return x - 0.3 if dim == 2 else np.add.outer(x, x) - 0.4


def spans(dim: int) -> Made:
    """Returns two spans between the bodies. The first has zero length if the bodies coincide."""
    near, far = ends(dim), ends(dim)
    far["point_b"] = far["point_b"] + 0.4 * along(dim, 1)
    return [jc.joints.Span("first", *PAIR, **near), jc.joints.Span("second", *PAIR, **far)]


def twisted(dim: int) -> Made:
    """Returns a ball joint, and a twist angle of it about x."""
    ball = jc.Spherical("joint", *PAIR, point=0.5 * along(dim, 0))
    return [ball, jc.joints.Twist("twist", *PAIR, axis=along(dim, 0))]


def two_hinges(dim: int) -> Made:
    """Returns a hinge between the world and body a, and a hinge between the bodies."""
    return [hinge(dim, "first", jc.WORLD, "a", 0.0), hinge(dim, "second")]


def slider(dim: int) -> Made:
    """Returns a hinge between the world and body a, and a slider of b along a."""
    return [hinge(dim, "first", jc.WORLD, "a", 0.0), slide(dim, "second")]


JOINTS: dict[str, tuple[tuple[int, ...], Callable[[int], Made]]] = {
    "coincident": (
        (2, 3),
        lambda n: [jc.joints.Coincident("joint", *PAIR, point=0.5 * along(n, 0))],
    ),
    "spherical": ((3,), lambda n: [jc.Spherical("joint", *PAIR, point=0.5 * along(n, 0))]),
    "distance": ((2, 3), lambda n: [jc.Distance("joint", *PAIR, **ends(n))]),
    "revolute": ((2, 3), lambda n: [hinge(n)]),
    "prismatic": ((2, 3), lambda n: [slide(n)]),
    "fixed": ((2, 3), lambda n: [jc.Fixed("joint", *PAIR, point=0.5 * along(n, 0))]),
    "universal": (
        (3,),
        lambda n: [
            jc.joints.Universal("joint", *PAIR, 0.5 * along(n, 0), along(n, 1), along(n, 2))
        ],
    ),
    "cylindrical": ((3,), lambda n: [jc.joints.Cylindrical("joint", *PAIR, axis=along(n, 0))]),
    "screw": ((3,), lambda n: [jc.joints.Screw("joint", *PAIR, axis=along(n, 0), lead=0.7)]),
    "planar": ((3,), lambda n: [jc.joints.Planar("joint", *PAIR, axis=along(n, 2))]),
    "parallel": ((3,), lambda n: [jc.joints.Parallel("joint", *PAIR, axis=along(n, 2))]),
    "constant velocity": (
        (3,),
        lambda n: [
            jc.joints.ConstantVelocity(
                "joint", *PAIR, 0.5 * along(n, 0), along(n, 0), along(n, 0) + 0.5 * along(n, 1)
            )
        ],
    ),
    "point on line": ((2, 3), lambda n: [jc.joints.PointOnLine("joint", *PAIR, axis=along(n, 0))]),
    "point on plane": (
        (2, 3),
        lambda n: [jc.joints.PointOnPlane("joint", *PAIR, axis=along(n, 1))],
    ),
    "point on curve": (
        (2, 3),
        lambda n: [
            jc.joints.PointOnCurve(
                "joint", *PAIR, parabola, params={"start": along(n, 0), "curvature": 0.7}
            )
        ],
    ),
    "spherical-spherical": (
        (3,),
        lambda n: [jc.joints.SphericalSpherical("joint", *PAIR, **ends(n))],
    ),
    "revolute-spherical": (
        (3,),
        lambda n: [
            jc.joints.RevoluteSpherical("joint", *PAIR, np.zeros(3), along(n, 0), axis=along(n, 1))
        ],
    ),
    "compound": (
        (3,),
        lambda n: [
            jc.joints.Compound(
                "joint", *PAIR, slides=(along(n, 0),), hinges=(along(n, 1), along(n, 2))
            )
        ],
    ),
    "gimbal": ((3,), lambda n: [jc.joints.Compound("joint", *PAIR, hinges=tuple(np.eye(3)))]),
    "drive of a hinge": (
        (2, 3),
        lambda n: [
            hinge(n),
            jc.joints.Drive("law", "joint", wave, {"size": 0.4, "frequency": 3.0}),
        ],
    ),
    "drive of a slide": (
        (2, 3),
        lambda n: [
            slide(n),
            jc.joints.Drive("law", "joint", wave, {"size": 0.4, "frequency": 3.0}),
        ],
    ),
    "rotor": ((2, 3), lambda n: [hinge(n), jc.joints.Armature("law", "joint", inertia=0.3)]),
    "gear": (
        (2, 3),
        lambda n: [*two_hinges(n), jc.joints.Gear("law", "first", "second", ratio=-2.0)],
    ),
    "rack": (
        (2, 3),
        lambda n: [*slider(n), jc.joints.RackAndPinion("law", "first", "second", radius=0.3)],
    ),
    "cam": (
        (2, 3),
        lambda n: [
            *slider(n),
            jc.joints.PolynomialCoupling("law", "first", "second", (0.0, 0.3, -0.2, 0.1)),
        ],
    ),
    "pulley": (
        (2, 3),
        lambda n: [*spans(n), jc.joints.Pulley("joint", "first", "second", parts=2.0)],
    ),
    "rolling sphere": ((3,), lambda n: [jc.joints.RollingSphere("joint", *PAIR, radius=0.4)]),
    "rolling cylinder": (
        (3,),
        lambda n: [jc.joints.RollingCylinder("joint", *PAIR, radius=0.4, axis=along(n, 1))],
    ),
    "rolling disc": (
        (2, 3),
        lambda n: [
            jc.joints.RollingDisc("joint", *PAIR, radius=0.4, axis=None if n == 2 else along(n, 1))
        ],
    ),
    "knife edge": ((2, 3), lambda n: [jc.joints.KnifeEdge("joint", *PAIR, edge=along(n, 0))]),
    "angular momentum": ((2, 3), lambda n: [jc.joints.AngularMomentum("joint", PAIR)]),
    "linear momentum": ((2, 3), lambda n: [jc.joints.LinearMomentum("joint", PAIR)]),
    "holonomic": (
        (2, 3),
        lambda n: [jc.joints.Holonomic(apart, PAIR, name="joint", params={"square": 1.0})],
    ),
    "velocity level": (
        (2, 3),
        lambda n: [
            jc.joints.VelocityLevel(
                skate, PAIR, name="joint", params={"anchor": along(n, 0), "edge": along(n, 1)}
            )
        ],
    ),
}

FORCES: dict[str, tuple[tuple[int, ...], Callable[[int], Made]]] = {
    "spring": (
        (2, 3),
        lambda n: [jc.Spring("joint", *PAIR, 30.0, 2.0, rest_length=0.4, **ends(n))],
    ),
    "spring of no length": (
        (2, 3),
        lambda n: [jc.Spring("joint", *PAIR, 30.0, 2.0, rest_length=0.0, **ends(n))],
    ),
    "springs of joints": (
        (2, 3),
        lambda n: [
            hinge(n),
            jc.forces.JointSpring("spring", "joint", 3.0, 0.2),
            jc.forces.PositionServo("servo", "joint", 5.0, 0.5),
            jc.forces.VelocityServo("speed", "joint", 0.3),
            jc.Motor("motor", "joint", gear=2.0),
        ],
    ),
    "twist": ((3,), lambda n: [*twisted(n), jc.forces.JointSpring("law", "twist", 3.0, 0.2)]),
    "bending": (
        (2, 3),
        lambda n: [jc.forces.Bending("joint", jc.WORLD, *PAIR, 2.0, point_a=-along(n, 0))],
    ),
    "flexure": (
        (2, 3),
        lambda n: [jc.forces.Flexure("joint", *PAIR, bending=2.0, twisting=0.0 if n == 2 else 1.0)],
    ),
    "force": (
        (2, 3),
        lambda n: [jc.forces.Force("joint", "b", force=along(n, 1), point=np.zeros(n))],
    ),
    "force of one's own": (
        (2, 3),
        lambda n: [jc.forces.CustomForce("joint", PAIR, pull, params={"stiffness": 2.0})],
    ),
}

TOUCH = {"friction": 0.5, "restitution": 0.3}
ENDS: dict[str, tuple[tuple[int, ...], Callable[[int], Made]]] = {
    "stops": ((2, 3), lambda n: [hinge(n), jc.Limit("law", "joint", -0.1, 0.2, restitution=0.5)]),
    "soft stops": (
        (2, 3),
        lambda n: [slide(n), jc.Limit("law", "joint", -0.1, 0.2, stiffness=100.0, damping=2.0)],
    ),
    "dry friction": ((2, 3), lambda n: [hinge(n), jc.contacts.JointFriction("law", "joint", 0.5)]),
    "rate motor": ((2, 3), lambda n: [hinge(n), jc.contacts.RateMotor("law", "joint", 0.5)]),
    "rate limit": ((2, 3), lambda n: [hinge(n), jc.contacts.RateLimit("law", "joint", 0.5)]),
    "slack rope": ((2, 3), lambda n: [jc.contacts.Rope("joint", *PAIR, **ends(n))]),
    "ball on a plane": (
        (2, 3),
        lambda n: [
            jc.PlaneContact("law", jc.WORLD, "b", radius=0.2, point=-0.2 * along(n, -1), **TOUCH)
        ],
    ),
    "ball that rolls with resistance": (
        (2, 3),
        lambda n: [
            jc.PlaneContact(
                "law", jc.WORLD, "b", radius=0.2, point=-0.2 * along(n, -1), rolling=0.02, **TOUCH
            )
        ],
    ),
    "box on a plane": (
        (2, 3),
        lambda n: [
            jc.contacts.BoxContact(
                "law", jc.WORLD, "b", np.full(n, 0.4), point=-0.2 * along(n, -1), **TOUCH
            )
        ],
    ),
    "two balls": (
        (2, 3),
        lambda n: [jc.contacts.CapsuleContact("law", *PAIR, radius_a=0.5, radius_b=0.5, **TOUCH)],
    ),
    "two capsules": (
        (2, 3),
        lambda n: [
            jc.contacts.CapsuleContact(
                "law",
                *PAIR,
                radius_a=0.5,
                radius_b=0.5,
                segment_a=np.outer((-0.3, 0.3), along(n, 1)),
                segment_b=np.outer((-0.3, 0.3), along(n, 1)) + along(n, 0),
                **TOUCH,
            )
        ],
    ),
    "ball on hills": (
        (2, 3),
        lambda n: [
            jc.contacts.HeightFieldContact(
                "law", jc.WORLD, "b", hills(n), 4.0 if n == 2 else (4.0, 4.0), radius=0.2, **TOUCH
            )
        ],
    ),
    "inequality": (
        (2, 3),
        lambda n: [jc.contacts.Inequality(apart, PAIR, name="law", params={"square": 1.0})],
    ),
}

ELEMENTS = JOINTS | FORCES | ENDS
