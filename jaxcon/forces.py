"""Springs, dampers, actuators and applied forces.

Springs and dampers: Spring, JointSpring, DeadBandSpring, JointDamper, Bending, Flexure.
Actuators: Motor, PositionServo, VelocityServo, AffineActuator, Muscle.
Applied forces: ExternalWrench, CustomForce, Force, FluidDrag.
"""

from jaxcon.system.actuators import (
    AffineActuator,
    DeadBandSpring,
    JointDamper,
    JointSpring,
    Motor,
    Muscle,
    PositionServo,
    VelocityServo,
)
from jaxcon.system.elastic import Bending, Flexure
from jaxcon.system.fluid import FluidDrag
from jaxcon.system.forces import CustomForce, ExternalWrench, Force, Spring


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "Spring",
    "JointSpring",
    "DeadBandSpring",
    "JointDamper",
    "Bending",
    "Flexure",
    "Motor",
    "PositionServo",
    "VelocityServo",
    "AffineActuator",
    "Muscle",
    "ExternalWrench",
    "CustomForce",
    "Force",
    "FluidDrag",
]
