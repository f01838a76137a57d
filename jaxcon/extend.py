"""Protocols and types for constraints, stabilizers, integrators and solvers of your own.

Systems: System, Bodies, Constraint, InequalityGroup, Joint, Row.
Methods: Stabilizer, Integrator, Solver, ContactSolver, Adjoint.
Steps: Dynamics, Advanced, StepInfo, Rows, Saddle.
Frames: Pose, Motion.
Pytrees: pytree, static.
Helpers: by_row, per_world, free_motion, judge.
"""

from jaxcon.constraints.base import Joint
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.rows import Rows
from jaxcon.core.pytree import pytree, static
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.linear.saddle import Saddle, free_motion, judge
from jaxcon.methods.gains import by_row
from jaxcon.protocols import (
    Adjoint,
    Bodies,
    Constraint,
    ContactSolver,
    InequalityGroup,
    Integrator,
    Solver,
    Stabilizer,
    System,
)
from jaxcon.staging.worlds import per_world
from jaxcon.step import Advanced, Dynamics, StepInfo


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__]


__all__ = [
    "System",
    "Bodies",
    "Constraint",
    "InequalityGroup",
    "Joint",
    "Row",
    "Stabilizer",
    "Integrator",
    "Solver",
    "ContactSolver",
    "Adjoint",
    "Dynamics",
    "Advanced",
    "StepInfo",
    "Rows",
    "Saddle",
    "Pose",
    "Motion",
    "pytree",
    "static",
    "by_row",
    "per_world",
    "free_motion",
    "judge",
]
