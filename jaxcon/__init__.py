"""Constrained dynamics in JAX: M a = f + Jᵀλ, J a + C λ = b, jitted, batched, differentiable."""

from jaxcon.analysis.memory import Memory, memory
from jaxcon.analysis.quantities import (
    angular_momentum,
    angular_velocity,
    center_of_mass,
    energy,
    momentum,
    orientation,
    position,
    velocity,
    violation,
    wrench,
)
from jaxcon.analysis.report import Report, report
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
from jaxcon.constraints.momentum import AngularMomentum, LinearMomentum
from jaxcon.core.status import SimulationError, Status, raise_for_status
from jaxcon.dynamics.assembly import Assembly, assemble
from jaxcon.dynamics.chains import Chain, hanging, rod, rope
from jaxcon.dynamics.generalized import GeneralizedSystem
from jaxcon.dynamics.scene import Scene
from jaxcon.geometry import inertia, quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.model.elastic import Bending, Flexure
from jaxcon.model.forces import CustomForce, ExternalWrench, Force, JointSpring, Spring
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
    "AngularMomentum",
    "Assembly",
    "Baumgarte",
    "Bending",
    "Chain",
    "Coincident",
    "ConjugateGradients",
    "CustomForce",
    "Dense",
    "Distance",
    "Drive",
    "Energy",
    "ExplicitEuler",
    "ExternalWrench",
    "Fixed",
    "Flexure",
    "Force",
    "GeneralizedSystem",
    "Heun",
    "Holonomic",
    "JointSpring",
    "LinearMomentum",
    "Memory",
    "Method",
    "Motion",
    "Pose",
    "Prismatic",
    "Report",
    "Revolute",
    "RungeKutta",
    "Scene",
    "Schur",
    "SemiImplicitEuler",
    "SimulationError",
    "Spherical",
    "Sparse",
    "Spring",
    "State",
    "Status",
    "StepInfo",
    "Universal",
    "Unstabilized",
    "VelocityLevel",
    "angular_momentum",
    "angular_velocity",
    "assemble",
    "center_of_mass",
    "energy",
    "forward_dynamics",
    "hanging",
    "inertia",
    "init",
    "largest_stable_rate",
    "memory",
    "momentum",
    "orientation",
    "position",
    "quaternion",
    "raise_for_status",
    "report",
    "rod",
    "rollout",
    "rope",
    "step",
    "velocity",
    "violation",
    "wrench",
]
