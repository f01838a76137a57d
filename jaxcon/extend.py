"""Protocols and types for constraints, stabilizers, integrators and solvers of your own.

Systems: System, Bodies, Constraint, InequalityGroup, Joint, Row.
Methods: Stabilizer, Integrator, Solver, ContactSolver, Adjoint.
Steps: Dynamics, Advanced, StepInfo, Rows, Saddle, Snapshot, BoundSet, Bounded, RowCounts, Path.
Frames: Pose, Motion.
Pytrees: pytree, static.
Rows of joints: meet, travel, distance, angle_between, same_orientation; unit, anchors,
check_perpendicular.
Helpers: by_row, per_world, free_motion, delassus, judge.
"""

from jaxcon.constraints.base import Joint
from jaxcon.constraints.joints import anchors, check_perpendicular, unit
from jaxcon.constraints.primitives import (
    Row,
    angle_between,
    distance,
    meet,
    same_orientation,
    travel,
)
from jaxcon.constraints.rows import Rows
from jaxcon.contact.bounded import Bounded, RowCounts
from jaxcon.contact.rows import BoundSet
from jaxcon.core.pytree import pytree, static
from jaxcon.execution.adjoints import Path
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.linear.saddle import Saddle, free_motion, judge
from jaxcon.linear.schur import delassus
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
from jaxcon.system.body_system import Snapshot


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
    "Snapshot",
    "BoundSet",
    "Bounded",
    "RowCounts",
    "Path",
    "Pose",
    "Motion",
    "pytree",
    "static",
    "meet",
    "travel",
    "distance",
    "angle_between",
    "same_orientation",
    "unit",
    "anchors",
    "check_perpendicular",
    "by_row",
    "per_world",
    "free_motion",
    "delassus",
    "judge",
]
