"""Constrained dynamics in JAX: M a = f + Jᵀλ, J a + C λ = b, jitted, batched, differentiable."""

from jaxcon.analysis.memory import Memory, memory
from jaxcon.analysis.quantities import (
    angular_velocity,
    coordinate,
    coordinate_rate,
    energy,
    orientation,
    position,
    velocity,
    violation,
    wrench,
)
from jaxcon.analysis.report import Report, report
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
from jaxcon.constraints.custom import Holonomic, VelocityLevel
from jaxcon.constraints.drive import Drive
from jaxcon.constraints.joints import (
    Coincident,
    Distance,
    Fixed,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
)
from jaxcon.constraints.span import Span
from jaxcon.constraints.twist import Twist
from jaxcon.core.status import SimulationError, Status, raise_for_status
from jaxcon.dynamics.generalized import GeneralizedSystem
from jaxcon.dynamics.scene import Scene
from jaxcon.geometry import inertia, quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.io.mjcf import Keyframe, MujocoModel, from_mjcf
from jaxcon.model.actuators import (
    AffineActuator,
    JointDamper,
    JointSpring,
    Motor,
    PositionServo,
    VelocityServo,
)
from jaxcon.model.coordinates import TurnCounter
from jaxcon.model.forces import CustomForce, ExternalWrench, Force, Spring
from jaxcon.model.layout import WORLD
from jaxcon.model.state import Energy, State
from jaxcon.simulation.initialize import init
from jaxcon.simulation.integrators import (
    RK4,
    ExplicitEuler,
    Heun,
    RungeKutta,
    SemiImplicitEuler,
)
from jaxcon.simulation.method import Method
from jaxcon.simulation.rollout import rollout
from jaxcon.simulation.stability import largest_stable_rate
from jaxcon.simulation.step import StepInfo, forward_dynamics, step
from jaxcon.solvers.conjugate_gradients import ConjugateGradients
from jaxcon.solvers.dense import Dense
from jaxcon.solvers.schur import Schur
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.baumgarte import Baumgarte, Unstabilized

__version__ = "0.1.0"

__all__ = [
    "RK4",
    "WORLD",
    "AffineActuator",
    "Armature",
    "Baumgarte",
    "Belt",
    "Coincident",
    "Compound",
    "ConjugateGradients",
    "CustomForce",
    "Dense",
    "Differential",
    "Distance",
    "Drive",
    "Energy",
    "ExplicitEuler",
    "ExternalWrench",
    "Fixed",
    "Force",
    "Gear",
    "GeneralizedSystem",
    "Heun",
    "Holonomic",
    "JointDamper",
    "JointSpring",
    "Keyframe",
    "Memory",
    "Method",
    "Motion",
    "Motor",
    "MujocoModel",
    "PolynomialCoupling",
    "Pose",
    "PositionServo",
    "Prismatic",
    "Pulley",
    "RackAndPinion",
    "Report",
    "Revolute",
    "RungeKutta",
    "Scene",
    "Schur",
    "SemiImplicitEuler",
    "SimulationError",
    "Span",
    "Sparse",
    "Spherical",
    "Spring",
    "State",
    "Status",
    "StepInfo",
    "TurnCounter",
    "Twist",
    "Universal",
    "Unstabilized",
    "VelocityLevel",
    "VelocityServo",
    "angular_velocity",
    "coordinate",
    "coordinate_rate",
    "energy",
    "forward_dynamics",
    "from_mjcf",
    "inertia",
    "init",
    "largest_stable_rate",
    "memory",
    "orientation",
    "position",
    "quaternion",
    "raise_for_status",
    "report",
    "rollout",
    "step",
    "velocity",
    "violation",
    "wrench",
]
