"""Constrained dynamics in JAX: M a = f + Jᵀλ, J a + C λ = b, jitted, batched, differentiable.

    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    final, path = jc.rollout(system, jc.Method(), state, None, 1e-3, 1000)

A tour of the names; `help` of each says more.

Scenes: Scene, WORLD, inertia, quaternion, Pose, Motion; rope, rod, hanging, Chain; from_mjcf,
    MujocoModel, Keyframe; in coordinates of one's own GeneralizedSystem, Vakonomic, vakonomic.
Joints: Revolute, Prismatic, Spherical, Fixed, Distance, Coincident, Cylindrical, Universal, Planar,
    Screw, ConstantVelocity, RevoluteSpherical, SphericalSpherical, Span, Twist, Parallel,
    PointOnLine, PointOnPlane, PointOnCurve, Compound.
Couplings: Gear, Belt, RackAndPinion, Pulley, Differential, PolynomialCoupling, Armature.
Other constraints: Drive; RollingDisc, RollingSphere, RollingCylinder, KnifeEdge; LinearMomentum,
    AngularMomentum; Holonomic, VelocityLevel of one's own.
Joint limits, friction and contact: Limit, RateLimit, RateMotor, JointFriction, Rope, PlaneContact,
    CapsuleContact, BoxContact, HeightFieldContact, box_corners; Inequality of one's own.
Forces: Spring, JointSpring, JointDamper, Bending, Flexure, ExternalWrench, CustomForce, Force;
    Motor, PositionServo, VelocityServo, AffineActuator; TurnCounter.
Simulation: init, step, rollout, forward_dynamics, assemble, restate, and shard and over_devices;
    State, StepInfo, Solution, Assembly.
Methods: Method of an integrator (SemiImplicitEuler, Heun, RK4, RungeKutta, ExplicitEuler, RATTLE,
    GeneralizedAlpha), a stabiliser (Baumgarte, AdaptiveBaumgarte, SlidingWindowBaumgarte, PID,
    Projection, Tolerance, Penalty, AugmentedLagrangian, Hybrid, Unstabilized), a solver (RankSafe,
    Sparse, Schur, Dense, ConjugateGradients, Priority, Lexicographic), one of bounded rows
    (InteriorPoint, GaussSeidel, Nearest), Events with Impacts, and a Recovery;
    largest_stable_rate, frequency_response.
Read out: position, velocity, orientation, angular_velocity, coordinate, coordinate_rate, energy,
    Energy, momentum, angular_momentum, center_of_mass, multipliers, wrench, violation.
Gradients: EveryStep, Checkpoints, Reversible, Truncated, Discounted; check_gradients,
    GradientCheck, gradient_growth, GradientGrowth, gradient_memory, GradientMemory.
Search: tune, Tuned, identify, Identified, losses; tradeoff, Tradeoff.
Trouble: report, Report, Finding, diagnose, Diagnosis, find_first_failure, Failure, Status,
    raise_for_status, SimulationError; integrability, Integrability; memory, Memory.
"""

import importlib
from typing import Any

from jaxcon.analysis.diagnosis import Diagnosis, diagnose
from jaxcon.analysis.failures import Failure, find_first_failure
from jaxcon.analysis.findings import Finding
from jaxcon.analysis.gradients import GradientCheck, check_gradients
from jaxcon.analysis.growth import GradientGrowth, gradient_growth
from jaxcon.analysis.integrability import Integrability, integrability
from jaxcon.analysis.memory import GradientMemory, Memory, gradient_memory, memory
from jaxcon.analysis.quantities import (
    angular_momentum,
    angular_velocity,
    center_of_mass,
    coordinate,
    coordinate_rate,
    energy,
    momentum,
    multipliers,
    orientation,
    position,
    velocity,
    violation,
    wrench,
)
from jaxcon.analysis.report import Report, report
from jaxcon.analysis.tradeoff import Tradeoff, tradeoff
from jaxcon.constraints.armature import Armature
from jaxcon.constraints.blades import KnifeEdge
from jaxcon.constraints.boxes import BoxContact
from jaxcon.constraints.compound import Compound
from jaxcon.constraints.contact import CapsuleContact, PlaneContact, Rope
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
from jaxcon.constraints.height_fields import HeightFieldContact
from jaxcon.constraints.inequality import Inequality
from jaxcon.constraints.joints import (
    Coincident,
    Distance,
    Fixed,
    Prismatic,
    Revolute,
    Spherical,
)
from jaxcon.constraints.limits import JointFriction, Limit, RateLimit, RateMotor
from jaxcon.constraints.momentum import AngularMomentum, LinearMomentum
from jaxcon.constraints.pairs import (
    Cylindrical,
    Parallel,
    Planar,
    PointOnLine,
    PointOnPlane,
    RevoluteSpherical,
    Screw,
    SphericalSpherical,
)
from jaxcon.constraints.point_sets import box_corners
from jaxcon.constraints.rolling import RollingCylinder, RollingDisc, RollingSphere
from jaxcon.constraints.shafts import ConstantVelocity, Universal
from jaxcon.constraints.span import Span
from jaxcon.constraints.twist import Twist
from jaxcon.core.devices import over_devices, shard
from jaxcon.core.status import SimulationError, Status, raise_for_status
from jaxcon.dynamics.assembly import Assembly, assemble
from jaxcon.dynamics.chains import Chain, hanging, rod, rope
from jaxcon.dynamics.generalized import GeneralizedSystem
from jaxcon.dynamics.scene import Scene
from jaxcon.dynamics.vakonomic import Vakonomic, vakonomic
from jaxcon.geometry import inertia, quaternion
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.io.mjcf import Keyframe, MujocoModel, from_mjcf
from jaxcon.learning import losses
from jaxcon.learning.identification import Identified, identify
from jaxcon.learning.tuned import Tuned
from jaxcon.learning.tuning import tune
from jaxcon.model.actuators import (
    AffineActuator,
    JointDamper,
    JointSpring,
    Motor,
    PositionServo,
    VelocityServo,
)
from jaxcon.model.coordinates import TurnCounter
from jaxcon.model.elastic import Bending, Flexure
from jaxcon.model.forces import CustomForce, ExternalWrench, Force, Spring
from jaxcon.model.inertial import restate
from jaxcon.model.layout import WORLD
from jaxcon.model.state import Energy, State
from jaxcon.simulation.adjoints import Checkpoints, Discounted, EveryStep, Truncated
from jaxcon.simulation.attempt import StepInfo
from jaxcon.simulation.events import Events, Impacts
from jaxcon.simulation.generalized_alpha import GeneralizedAlpha
from jaxcon.simulation.initialize import init
from jaxcon.simulation.integrators import (
    RK4,
    ExplicitEuler,
    Heun,
    RungeKutta,
    SemiImplicitEuler,
)
from jaxcon.simulation.method import Method
from jaxcon.simulation.rattle import RATTLE
from jaxcon.simulation.repair import Recovery
from jaxcon.simulation.response import frequency_response
from jaxcon.simulation.reversible import Reversible
from jaxcon.simulation.rollout import rollout
from jaxcon.simulation.stability import largest_stable_rate
from jaxcon.simulation.step import forward_dynamics, step
from jaxcon.solvers.conjugate_gradients import ConjugateGradients
from jaxcon.solvers.dense import Dense
from jaxcon.solvers.gauss_seidel import GaussSeidel
from jaxcon.solvers.interior_point import InteriorPoint
from jaxcon.solvers.nearest_rows import Nearest
from jaxcon.solvers.priority import Lexicographic, Priority
from jaxcon.solvers.proximal import RankSafe
from jaxcon.solvers.saddle import Solution
from jaxcon.solvers.schur import Schur
from jaxcon.solvers.sparse import Sparse
from jaxcon.stabilization.adaptive import AdaptiveBaumgarte, SlidingWindowBaumgarte
from jaxcon.stabilization.baumgarte import Baumgarte, Unstabilized
from jaxcon.stabilization.hybrid import Hybrid
from jaxcon.stabilization.multipliers import AugmentedLagrangian
from jaxcon.stabilization.penalty import Penalty
from jaxcon.stabilization.pid import PID
from jaxcon.stabilization.projection import Projection, Tolerance

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`jc.environments`, imported when it is first asked for: it tells Gymnasium of its tasks."""
    if name == "environments":
        return importlib.import_module("jaxcon.environments")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, without what the module itself imports."""
    return [*__all__, "environments", "__version__", "__doc__"]


__all__ = [
    "BoxContact",
    "CapsuleContact",
    "HeightFieldContact",
    "Inequality",
    "PlaneContact",
    "Rope",
    "GaussSeidel",
    "InteriorPoint",
    "JointFriction",
    "Limit",
    "RateLimit",
    "RateMotor",
    "PID",
    "RATTLE",
    "RK4",
    "WORLD",
    "AdaptiveBaumgarte",
    "AffineActuator",
    "AngularMomentum",
    "Armature",
    "Assembly",
    "AugmentedLagrangian",
    "Baumgarte",
    "Belt",
    "Bending",
    "Chain",
    "Checkpoints",
    "Coincident",
    "Compound",
    "ConjugateGradients",
    "ConstantVelocity",
    "CustomForce",
    "Cylindrical",
    "Dense",
    "Diagnosis",
    "Differential",
    "Discounted",
    "Distance",
    "Drive",
    "Energy",
    "Events",
    "EveryStep",
    "ExplicitEuler",
    "ExternalWrench",
    "Failure",
    "Finding",
    "Fixed",
    "Flexure",
    "Force",
    "Gear",
    "GeneralizedAlpha",
    "GeneralizedSystem",
    "GradientCheck",
    "GradientGrowth",
    "GradientMemory",
    "Heun",
    "Holonomic",
    "Hybrid",
    "Identified",
    "Impacts",
    "Integrability",
    "JointDamper",
    "JointSpring",
    "Keyframe",
    "KnifeEdge",
    "Lexicographic",
    "LinearMomentum",
    "Memory",
    "Method",
    "Motion",
    "Motor",
    "MujocoModel",
    "Nearest",
    "Parallel",
    "Planar",
    "Penalty",
    "PointOnCurve",
    "PointOnLine",
    "PointOnPlane",
    "PolynomialCoupling",
    "Pose",
    "PositionServo",
    "Priority",
    "Prismatic",
    "Projection",
    "Pulley",
    "RackAndPinion",
    "RankSafe",
    "Recovery",
    "Report",
    "Reversible",
    "Revolute",
    "RevoluteSpherical",
    "RollingCylinder",
    "RollingDisc",
    "RollingSphere",
    "RungeKutta",
    "Scene",
    "Schur",
    "Screw",
    "SemiImplicitEuler",
    "SimulationError",
    "Solution",
    "SlidingWindowBaumgarte",
    "Span",
    "Sparse",
    "Spherical",
    "SphericalSpherical",
    "Spring",
    "State",
    "Status",
    "StepInfo",
    "Tolerance",
    "Tradeoff",
    "Truncated",
    "Tuned",
    "TurnCounter",
    "Twist",
    "Universal",
    "Unstabilized",
    "Vakonomic",
    "VelocityLevel",
    "VelocityServo",
    "angular_momentum",
    "angular_velocity",
    "assemble",
    "box_corners",
    "center_of_mass",
    "check_gradients",
    "coordinate",
    "coordinate_rate",
    "diagnose",
    "energy",
    "find_first_failure",
    "forward_dynamics",
    "frequency_response",
    "from_mjcf",
    "gradient_growth",
    "gradient_memory",
    "hanging",
    "identify",
    "inertia",
    "init",
    "integrability",
    "largest_stable_rate",
    "losses",
    "memory",
    "momentum",
    "multipliers",
    "orientation",
    "over_devices",
    "position",
    "quaternion",
    "raise_for_status",
    "report",
    "restate",
    "rod",
    "rollout",
    "rope",
    "shard",
    "step",
    "tradeoff",
    "tune",
    "vakonomic",
    "velocity",
    "violation",
    "wrench",
]
