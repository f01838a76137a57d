"""Shapes of bodies in contact.

Shapes for jc.contacts.ShapeContact: Plane, Sphere, Capsule, Cylinder, Box, Ellipsoid, Hull.
"""

from jaxcon.contact.shapes import Box, Capsule, Cylinder, Ellipsoid, Hull, Plane, Sphere


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = ["Plane", "Sphere", "Capsule", "Cylinder", "Box", "Ellipsoid", "Hull"]
