"""Joints and other equality constraints.

Joints: Revolute, Prismatic, Spherical, Fixed, Distance, Coincident, Cylindrical, Universal, Planar,
    Screw, ConstantVelocity, RevoluteSpherical, SphericalSpherical, Span, Twist, RotationAngle,
    Thrust, Tendon, WrappedSpan, Parallel, PointOnLine, PointOnPlane, PointOnCurve, Compound.
Couplings: Gear, Belt, RackAndPinion, Pulley, Differential, PolynomialCoupling, Armature.
Prescribed motions: Drive.
Rolling and blades: RollingDisc, RollingSphere, RollingCylinder, KnifeEdge.
Prescribed momenta: LinearMomentum, AngularMomentum.
From a function: Holonomic, VelocityLevel.
Counted turns of a joint: TurnCounter.
"""

from jaxcon.constraints.armature import Armature
from jaxcon.constraints.compound import Compound
from jaxcon.constraints.couplings import (
    Belt,
    Differential,
    Gear,
    PolynomialCoupling,
    Pulley,
    RackAndPinion,
)
from jaxcon.constraints.curves import PointOnCurve
from jaxcon.constraints.custom import Holonomic, VelocityLevel
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.joints import Coincident, Distance, Fixed, Prismatic, Revolute, Spherical
from jaxcon.constraints.measures import RotationAngle, Thrust
from jaxcon.constraints.momentum import AngularMomentum, LinearMomentum
from jaxcon.constraints.pairs import (
    ConstantVelocity,
    Cylindrical,
    Parallel,
    Planar,
    PointOnLine,
    PointOnPlane,
    RevoluteSpherical,
    Screw,
    Span,
    SphericalSpherical,
    Twist,
    Universal,
)
from jaxcon.constraints.rolling import KnifeEdge, RollingCylinder, RollingDisc, RollingSphere
from jaxcon.constraints.tendons import Tendon
from jaxcon.constraints.wrapping import WrappedSpan
from jaxcon.system.coordinates import TurnCounter


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "Revolute",
    "Prismatic",
    "Spherical",
    "Fixed",
    "Distance",
    "Coincident",
    "Cylindrical",
    "Universal",
    "Planar",
    "Screw",
    "ConstantVelocity",
    "RevoluteSpherical",
    "SphericalSpherical",
    "Span",
    "Twist",
    "RotationAngle",
    "Thrust",
    "Tendon",
    "WrappedSpan",
    "Parallel",
    "PointOnLine",
    "PointOnPlane",
    "PointOnCurve",
    "Compound",
    "Gear",
    "Belt",
    "RackAndPinion",
    "Pulley",
    "Differential",
    "PolynomialCoupling",
    "Armature",
    "Drive",
    "RollingDisc",
    "RollingSphere",
    "RollingCylinder",
    "KnifeEdge",
    "LinearMomentum",
    "AngularMomentum",
    "Holonomic",
    "VelocityLevel",
    "TurnCounter",
]
