"""Inequality constraints: joint limits, friction and contact.

Limits, motors and friction of joints: Limit, RateLimit, RateMotor, JointFriction.
Ropes: Rope.
Contact: PlaneContact, CapsuleContact, BoxContact, ShapeContact, HeightFieldContact, box_corners.
From a function: Inequality.
"""

from jaxcon.contact.boxes import BoxContact
from jaxcon.contact.contact import CapsuleContact, PlaneContact, Rope
from jaxcon.contact.height_fields import HeightFieldContact
from jaxcon.contact.limits import Inequality, JointFriction, Limit, RateLimit, RateMotor
from jaxcon.contact.point_sets import box_corners
from jaxcon.contact.shape_contact import ShapeContact


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "Limit",
    "RateLimit",
    "RateMotor",
    "JointFriction",
    "Rope",
    "PlaneContact",
    "CapsuleContact",
    "BoxContact",
    "ShapeContact",
    "HeightFieldContact",
    "box_corners",
    "Inequality",
]
