"""Two bodies under each kind of element, placed so that singular spots are met exactly.

At assembly both bodies are unturned and at rest, one metre apart along x, and every constraint
holds. Second points are the first moved along with the bodies: where these are put onto each other,
so are the points, and what has a length has none.
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
    """An axis of the world; the last one is the normal of the plane in space."""
    return np.eye(dim)[i]


def hinge(dim: int, name: str = "joint", a: str = "a", b: str = "b", x: float = 0.5) -> Any:
    """About z, at a place on the x axis."""
    axis = None if dim == 2 else along(3, 2)
    return jc.Revolute(name, a, b, point=x * along(dim, 0), axis=axis)


def slide(dim: int, name: str = "joint", a: str = "a", b: str = "b") -> Any:
    """Along x."""
    return jc.Prismatic(name, a, b, axis=along(dim, 0), point=0.5 * along(dim, 0))


def ends(dim: int) -> dict[str, Any]:
    """A point of a, and that of b onto which it comes where the bodies do."""
    point = 0.3 * along(dim, 1)
    return {"point_a": point, "point_b": point + along(dim, 0)}


def wave(t: Any, p: Any) -> Any:
    """What a drive follows, from rest."""
    return p["size"] * (1 - jnp.cos(p["frequency"] * t))


def parabola(x: Any, p: Any) -> Any:
    """A curve through the middle."""
    y = x - p["start"]
    return jnp.stack([y[1] + p["curvature"] * y[0] ** 2, *y[2:]])


def apart(a: Any, b: Any, t: Any, p: Any) -> Any:
    """The square of a distance, one metre at assembly."""
    gap = b.position - a.position
    return jnp.stack([gap @ gap - p["square"]])


def skate(a: Any, b: Any, t: Any, p: Any) -> Any:
    """A point of b does not move across a direction of a."""
    return jnp.stack([a.direction(p["edge"]) @ (b.point_velocity(p["anchor"]) - a.velocity)])


def pull(a: Any, b: Any, t: Any, u: Any, p: Any) -> Any:
    """Wrenches of one's own, by the square of a distance."""
    gap = b.position - a.position
    force = p["stiffness"] * gap * (gap @ gap - 1)
    wrench = jnp.concatenate([force, jnp.zeros(1 if len(gap) == 2 else 3, gap.dtype)])
    return wrench, -wrench


def hills(dim: int) -> np.ndarray:
    """Heights of a ground that passes below the second body."""
    x = 0.1 * np.cos(np.linspace(-4.0, 4.0, 12))
    return x - 0.3 if dim == 2 else np.add.outer(x, x) - 0.4


def spans(dim: int) -> Made:
    """Two spans, one of them without length where the bodies meet."""
    near, far = ends(dim), ends(dim)
    far["point_b"] = far["point_b"] + 0.4 * along(dim, 1)
    return [jc.Span("first", *PAIR, **near), jc.Span("second", *PAIR, **far)]


def twisted(dim: int) -> Made:
    """A ball joint whose turns about x are read."""
    ball = jc.Spherical("joint", *PAIR, point=0.5 * along(dim, 0))
    return [ball, jc.Twist("twist", *PAIR, axis=along(dim, 0))]


def two_hinges(dim: int) -> Made:
    """One of a on the world, one between the bodies."""
    return [hinge(dim, "first", jc.WORLD, "a", 0.0), hinge(dim, "second")]


def slider(dim: int) -> Made:
    """A hinge of a on the world, and b slides along a."""
    return [hinge(dim, "first", jc.WORLD, "a", 0.0), slide(dim, "second")]


JOINTS: dict[str, tuple[tuple[int, ...], Callable[[int], Made]]] = {
    "coincident": ((2, 3), lambda n: [jc.Coincident("joint", *PAIR, point=0.5 * along(n, 0))]),
    "spherical": ((3,), lambda n: [jc.Spherical("joint", *PAIR, point=0.5 * along(n, 0))]),
    "distance": ((2, 3), lambda n: [jc.Distance("joint", *PAIR, **ends(n))]),
    "revolute": ((2, 3), lambda n: [hinge(n)]),
    "prismatic": ((2, 3), lambda n: [slide(n)]),
    "fixed": ((2, 3), lambda n: [jc.Fixed("joint", *PAIR, point=0.5 * along(n, 0))]),
    "universal": (
        (3,),
        lambda n: [jc.Universal("joint", *PAIR, 0.5 * along(n, 0), along(n, 1), along(n, 2))],
    ),
    "cylindrical": ((3,), lambda n: [jc.Cylindrical("joint", *PAIR, axis=along(n, 0))]),
    "screw": ((3,), lambda n: [jc.Screw("joint", *PAIR, axis=along(n, 0), lead=0.7)]),
    "planar": ((3,), lambda n: [jc.Planar("joint", *PAIR, axis=along(n, 2))]),
    "parallel": ((3,), lambda n: [jc.Parallel("joint", *PAIR, axis=along(n, 2))]),
    "constant velocity": (
        (3,),
        lambda n: [
            jc.ConstantVelocity(
                "joint", *PAIR, 0.5 * along(n, 0), along(n, 0), along(n, 0) + 0.5 * along(n, 1)
            )
        ],
    ),
    "point on line": ((2, 3), lambda n: [jc.PointOnLine("joint", *PAIR, axis=along(n, 0))]),
    "point on plane": ((2, 3), lambda n: [jc.PointOnPlane("joint", *PAIR, axis=along(n, 1))]),
    "point on curve": (
        (2, 3),
        lambda n: [
            jc.PointOnCurve(
                "joint", *PAIR, parabola, params={"start": along(n, 0), "curvature": 0.7}
            )
        ],
    ),
    "spherical-spherical": ((3,), lambda n: [jc.SphericalSpherical("joint", *PAIR, **ends(n))]),
    "revolute-spherical": (
        (3,),
        lambda n: [
            jc.RevoluteSpherical("joint", *PAIR, np.zeros(3), along(n, 0), axis=along(n, 1))
        ],
    ),
    "compound": (
        (3,),
        lambda n: [
            jc.Compound("joint", *PAIR, slides=(along(n, 0),), hinges=(along(n, 1), along(n, 2)))
        ],
    ),
    "gimbal": ((3,), lambda n: [jc.Compound("joint", *PAIR, hinges=tuple(np.eye(3)))]),
    "drive of a hinge": (
        (2, 3),
        lambda n: [hinge(n), jc.Drive("law", "joint", wave, {"size": 0.4, "frequency": 3.0})],
    ),
    "drive of a slide": (
        (2, 3),
        lambda n: [slide(n), jc.Drive("law", "joint", wave, {"size": 0.4, "frequency": 3.0})],
    ),
    "rotor": ((2, 3), lambda n: [hinge(n), jc.Armature("law", "joint", inertia=0.3)]),
    "gear": ((2, 3), lambda n: [*two_hinges(n), jc.Gear("law", "first", "second", ratio=-2.0)]),
    "rack": (
        (2, 3),
        lambda n: [*slider(n), jc.RackAndPinion("law", "first", "second", radius=0.3)],
    ),
    "cam": (
        (2, 3),
        lambda n: [
            *slider(n),
            jc.PolynomialCoupling("law", "first", "second", (0.0, 0.3, -0.2, 0.1)),
        ],
    ),
    "pulley": ((2, 3), lambda n: [*spans(n), jc.Pulley("joint", "first", "second", parts=2.0)]),
    "rolling sphere": ((3,), lambda n: [jc.RollingSphere("joint", *PAIR, radius=0.4)]),
    "rolling cylinder": (
        (3,),
        lambda n: [jc.RollingCylinder("joint", *PAIR, radius=0.4, axis=along(n, 1))],
    ),
    "rolling disc": (
        (2, 3),
        lambda n: [
            jc.RollingDisc("joint", *PAIR, radius=0.4, axis=None if n == 2 else along(n, 1))
        ],
    ),
    "knife edge": ((2, 3), lambda n: [jc.KnifeEdge("joint", *PAIR, edge=along(n, 0))]),
    "angular momentum": ((2, 3), lambda n: [jc.AngularMomentum("joint", PAIR)]),
    "linear momentum": ((2, 3), lambda n: [jc.LinearMomentum("joint", PAIR)]),
    "holonomic": (
        (2, 3),
        lambda n: [jc.Holonomic(apart, PAIR, name="joint", params={"square": 1.0})],
    ),
    "velocity level": (
        (2, 3),
        lambda n: [
            jc.VelocityLevel(
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
            jc.JointSpring("spring", "joint", 3.0, 0.2),
            jc.PositionServo("servo", "joint", 5.0, 0.5),
            jc.VelocityServo("speed", "joint", 0.3),
            jc.Motor("motor", "joint", gear=2.0),
        ],
    ),
    "twist": ((3,), lambda n: [*twisted(n), jc.JointSpring("law", "twist", 3.0, 0.2)]),
    "bending": (
        (2, 3),
        lambda n: [jc.Bending("joint", jc.WORLD, *PAIR, 2.0, point_a=-along(n, 0))],
    ),
    "flexure": (
        (2, 3),
        lambda n: [jc.Flexure("joint", *PAIR, bending=2.0, twisting=0.0 if n == 2 else 1.0)],
    ),
    "force": ((2, 3), lambda n: [jc.Force("joint", "b", force=along(n, 1), point=np.zeros(n))]),
    "force of one's own": (
        (2, 3),
        lambda n: [jc.CustomForce("joint", PAIR, pull, params={"stiffness": 2.0})],
    ),
}

TOUCH = {"friction": 0.5, "restitution": 0.3}
ENDS: dict[str, tuple[tuple[int, ...], Callable[[int], Made]]] = {
    "stops": ((2, 3), lambda n: [hinge(n), jc.Limit("law", "joint", -0.1, 0.2, restitution=0.5)]),
    "soft stops": (
        (2, 3),
        lambda n: [slide(n), jc.Limit("law", "joint", -0.1, 0.2, stiffness=100.0, damping=2.0)],
    ),
    "dry friction": ((2, 3), lambda n: [hinge(n), jc.JointFriction("law", "joint", 0.5)]),
    "rate motor": ((2, 3), lambda n: [hinge(n), jc.RateMotor("law", "joint", 0.5)]),
    "rate limit": ((2, 3), lambda n: [hinge(n), jc.RateLimit("law", "joint", 0.5)]),
    "slack rope": ((2, 3), lambda n: [jc.Rope("joint", *PAIR, **ends(n))]),
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
            jc.BoxContact("law", jc.WORLD, "b", np.full(n, 0.4), point=-0.2 * along(n, -1), **TOUCH)
        ],
    ),
    "two balls": (
        (2, 3),
        lambda n: [jc.CapsuleContact("law", *PAIR, radius_a=0.5, radius_b=0.5, **TOUCH)],
    ),
    "two capsules": (
        (2, 3),
        lambda n: [
            jc.CapsuleContact(
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
            jc.HeightFieldContact(
                "law", jc.WORLD, "b", hills(n), 4.0 if n == 2 else (4.0, 4.0), radius=0.2, **TOUCH
            )
        ],
    ),
    "inequality": (
        (2, 3),
        lambda n: [jc.Inequality(apart, PAIR, name="law", params={"square": 1.0})],
    ),
}

ELEMENTS = JOINTS | FORCES | ENDS
