"""The rows of a touch: the normal, friction along the tangents, resistance to rolling and spinning.

Of a touch it is known where it is, along which normal, and how the two bodies move. The rows are
the velocities of the two material points there, n·(ṗ_b − ṗ_a) and along directions normal to n, and
of the relative angular velocity, along these directions what rolls and along n what spins.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxcon.constraints.limits import one_sided, stop
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.ranges import not_negative
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, perpendicular
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import label
from jaxcon.model.frames import Point, WorldFrame

MATERIAL = ("friction", "rolling", "spinning", "restitution")
"""Fields of contacts that the number 0 leaves out."""


class Touch(NamedTuple):
    """Where two bodies are nearest.

    Attributes:
        gap: φ, negative where they overlap [m].
        normal: n, from the first to the second, world frame.
        place: halfway between them, world frame: forces act on what of each is there, so that equal
            and opposite ones have no moment.
        a, b: the motion of the two bodies.
    """

    gap: Lane
    normal: Vector
    place: Vector
    a: Any
    b: Any


def touching(p: dict[str, Any], touch: Touch, dt: Any) -> tuple[list[Row], dict[str, Any]]:
    """The normal and, with friction, the tangents of a contact; and what a step wants of them."""
    # across an open gap to what is fixed, a body is pulled at its own surface, where it will be
    # touched: a lever that shrinks with the gap would turn it by the phase of the landing within
    # the step; two bodies keep one place between them, and so their angular momentum
    half, place = touch.normal * (jnp.maximum(touch.gap, 0) / 2), touch.place
    if isinstance(touch.a, WorldFrame):
        place = place + half
    elif isinstance(touch.b, WorldFrame):
        place = place - half
    points = touch.a.material(place), touch.b.material(place)
    first, asked = one_sided(p, along(*points, touch.normal, touch.gap), dt)
    if "friction" not in p:
        return [first], asked
    tangents = across(touch.normal)
    asked = asked | {"friction": not_negative(p["friction"])}
    if "rolling" in p:
        rolls = tuple(turning(touch.a, touch.b, u) for u in tangents)
        asked |= {"rolling": not_negative(p["rolling"]), "rolls": rolls}
    if "spinning" in p:
        spins = (turning(touch.a, touch.b, touch.normal),)
        asked |= {"spinning": not_negative(p["spinning"]), "spins": spins}
    return [first, *(along(*points, u) for u in tangents)], asked


def turning(a: Any, b: Any, u: Vector) -> Row:
    """u·(ω_b − ω_a); in the plane ω_b − ω_a."""
    if len(u) == 2:
        pulls = a.turn(-1.0), b.turn(1.0)
        return Row(0.0, b.omega - a.omega, 0.0, pulls, holonomic=False)
    pulls = -a.torque(u), b.torque(u)
    return Row(0.0, u.dot(b.spin - a.spin), 0.0, pulls, holonomic=False)


def along(a: Point, b: Point, u: Vector, gap: Any = None) -> Row:
    """u·(ṗ_b − ṗ_a)."""
    rate = u.dot(b.velocity - a.velocity)
    pulls = (-a.pull(u), b.pull(u))
    return Row(0.0 if gap is None else gap, rate, 0.0, pulls, holonomic=gap is not None)


def across(n: Vector) -> list[Vector]:
    """The directions normal to a unit vector: one in the plane, two in space.

    References:
        Duff et al., Building an orthonormal basis, revisited, J. Comput. Graph. Tech. 6 (2017).
    """
    if len(n) == 2:
        return [perpendicular(n)]
    x, y, z = n
    side = jnp.where(jnp.asarray(z) < 0, -1.0, 1.0).astype(jnp.result_type(x, y, z))
    a = -1 / (side + z)
    b = x * y * a
    return [
        Vector(1 + side * x * x * a, side * b, -side * x),
        Vector(b, side + y * y * a, -y),
    ]


def material(element: Any, a: Pose, b: Pose) -> dict[str, Array]:
    """The numbers of a contact, checked, without those that leave no trace.

    Raises:
        ValueError: one is out of range, or resists a turn that there is not.
    """
    owner, dtype = label(element), a.position.dtype
    given = {what: getattr(element, what, 0.0) for what in MATERIAL[:3]}
    turns = [what for what in given if what != "friction" and not checks.plain_zero(given[what])]
    numbers = stop(element, dtype)
    for what, x in given.items():
        if checks.plain_zero(x) and not (turns and what == "friction"):
            continue
        numbers[what] = checks.real(owner, what, x, dtype, least=0)
    if turns and (a.orientation is None or b.orientation is None):
        raise ValueError(f"{owner}: a particle does not turn; give no {turns[0]}.")
    if "spinning" in turns and a.position.shape == (2,):
        raise ValueError(f"{owner}: nothing spins about a normal in the plane; give no spinning.")
    return numbers
