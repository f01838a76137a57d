"""The rows of a contact: normal, friction along the tangents, resistance to rolling and spinning.

A contact has a point, a normal n, and two moving bodies. Its rows are components of the relative
velocity of the two material points at this point, along n and along the tangents. Further rows are
components of the relative angular velocity: rolling about the tangents, and spinning about n.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp

from jaxcon.constraints.primitives import Row
from jaxcon.contact.limits import HasStop, not_negative, one_sided, stop
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, perpendicular
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import label
from jaxcon.system.frames import Point, WorldFrame

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import JointFrame

MATERIAL = ("friction", "rolling", "spinning", "restitution")
"""The fields of contacts that add no rows and no parameter if they are the Python number 0."""


class Touch(NamedTuple):
    """The geometry of a contact between two bodies.

    Attributes:
        gap: distance φ of the bodies, negative if they overlap [m].
        normal: unit normal n from the first body to the second, in the world frame.
        place: the point halfway between the bodies, in the world frame. Forces act on the material
            point of each body there, so equal and opposite forces have no moment.
        a, b: the motion of the two bodies.
    """

    gap: Lane
    normal: Vector
    place: Vector
    a: JointFrame
    b: JointFrame


def contact_rows(p: dict[str, Any], touch: Touch, dt: Array) -> tuple[list[Row], dict[str, Any]]:
    """Returns the rows of a contact, and further fields of their `BoundSet`.

    The rows are the normal row and, with friction, the tangent rows. The fields are the target, the
    coefficients, and the rows of rolling and spinning resistance.
    """
    # If the gap to a fixed body is open, the force acts at the surface of the moving body, where
    # the contact will be. At the middle of the gap, its lever arm would depend on the gap. The
    # rotation of the body would then depend on when within the step it lands. Two moving bodies
    # share one point, which conserves angular momentum.
    half, place = touch.normal * (jnp.maximum(touch.gap, 0) / 2), touch.place
    if isinstance(touch.a, WorldFrame):
        place = place + half
    elif isinstance(touch.b, WorldFrame):
        place = place - half
    points = touch.a.material(place), touch.b.material(place)
    first, fields = one_sided(p, row_along(*points, touch.normal, touch.gap), dt)
    fields = fields | {"place": place}
    if "friction" not in p:
        return [first], fields
    tangents = across(touch.normal)
    fields = fields | {"friction": not_negative(p["friction"])}
    if "rolling" in p:
        rolls = tuple(turning(touch.a, touch.b, u) for u in tangents)
        fields |= {"rolling": not_negative(p["rolling"]), "rolls": rolls}
    if "spinning" in p:
        spins = (turning(touch.a, touch.b, touch.normal),)
        fields |= {"spinning": not_negative(p["spinning"]), "spins": spins}
    return [first, *(row_along(*points, u) for u in tangents)], fields


def turning(a: JointFrame, b: JointFrame, u: Vector) -> Row:
    """Returns the row of the relative angular velocity u·(ω_b − ω_a), or ω_b − ω_a in the plane."""
    if len(u) == 2:
        pulls = a.turn(-1.0), b.turn(1.0)
        return Row(0.0, b.omega - a.omega, 0.0, pulls, holonomic=False)
    pulls = -a.torque(u), b.torque(u)
    return Row(0.0, u.dot(b.spin - a.spin), 0.0, pulls, holonomic=False)


def row_along(a: Point, b: Point, u: Vector, gap: Lane | None = None) -> Row:
    """Returns the row u·(ṗ_b − ṗ_a), the relative velocity of two points along u, with φ = gap."""
    rate = u.dot(b.velocity - a.velocity)
    pulls = (-a.pull(u), b.pull(u))
    return Row(0.0 if gap is None else gap, rate, 0.0, pulls, holonomic=gap is not None)


def across(n: Vector) -> list[Vector]:
    """Returns the unit vectors normal to a unit vector n: one in the plane, two in space.

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


def material(element: HasStop, a: Pose, b: Pose) -> dict[str, Array]:
    """Returns the checked parameters of a contact, without fields that are the number 0.

    Raises:
        ValueError: a parameter is out of range, a particle has rolling or spinning resistance, or
            a contact in the plane has spinning resistance.
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
