"""Constrained dynamics in JAX: M a = f + Jᵀλ, J a + C λ = b, jitted, batched, differentiable.

    scene = jc.Scene(dim=2)
    scene.add_particle("bob", mass=1.0, position=(1.0, 0.0))
    scene.add(jc.Distance("rod", jc.WORLD, "bob"))
    system, state = scene.build()
    final, path = jc.rollout(system, jc.Method(), state, None, 1e-3, 1000)

The names that most programs need; `help` of each says more.

Systems: Scene, WORLD, GeneralizedSystem, from_mjcf, assemble.
Parts: Revolute, Prismatic, Spherical, Fixed, Distance, Spring, Motor, Limit, PlaneContact.
Methods: Method, SemiImplicitEuler, RK4, Baumgarte, Projection.
Simulation: State, init, step, rollout, forward_dynamics.
All cores of a CPU: use_all_cores, shard, compiler_options.
Readout: position, velocity, orientation, angular_velocity, coordinate, coordinate_rate, energy,
    momentum, angular_momentum, center_of_mass, violation.
Forces: wrench, multipliers, reaction, acceleration, angular_acceleration.
Failures: Status, SimulationError, raise_for_status.
Analysis and search: report, check_gradients, tradeoff, tune, identify.

All other names are in namespaces, whose `help` lists them.

    joints          joints, couplings, drives, rolling, constraints from functions
    contacts        joint limits, dry friction, ropes, contact
    shapes          boxes, cylinders and other shapes of bodies in contact
    forces          springs, dampers, actuators, applied forces
    chains          ropes and rods of many bodies
    inertia         mass and inertia of solids
    quaternion      rotations in space
    systems         vakonomic systems, states for changed inertia
    io              models of MuJoCo
    integrators     explicit, symplectic and implicit integrators, steps split at impacts
    stabilizers     feedback, projection and penalties against constraint errors
    solvers         linear solvers, contact solvers
    adjoints        memory and truncation of gradients
    analysis        reports, diagnosis, checks of gradients, comparison of methods
    learning        tuning, identification, loss functions
    environments    tasks for reinforcement learning
    devices         batches over several devices
    view            pictures and animations
    extend          protocols and types for parts of your own
"""

import functools
import importlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxcon import (
    adjoints,
    analysis,
    chains,
    contacts,
    devices,
    extend,
    forces,
    integrators,
    io,
    joints,
    learning,
    shapes,
    solvers,
    stabilizers,
    systems,
    view,
)
from jaxcon.analysis.gradients import check_gradients
from jaxcon.analysis.report import report
from jaxcon.analysis.tradeoff import tradeoff
from jaxcon.builders.assembly import assemble
from jaxcon.builders.generalized import GeneralizedSystem
from jaxcon.builders.scene import Scene
from jaxcon.constraints.joints import Distance, Fixed, Prismatic, Revolute, Spherical
from jaxcon.contact.contact import PlaneContact
from jaxcon.contact.limits import Limit
from jaxcon.core.cores import compiler_options, use_all_cores
from jaxcon.core.devices import shard
from jaxcon.core.status import SimulationError, Status, raise_for_status
from jaxcon.execution.initialize import init
from jaxcon.execution.rollout import rollout
from jaxcon.execution.step import forward_dynamics, step
from jaxcon.geometry import inertia, quaternion
from jaxcon.io.mjcf import from_mjcf
from jaxcon.learning.identification import identify
from jaxcon.learning.tuning import tune
from jaxcon.methods.baumgarte import Baumgarte
from jaxcon.methods.integrators import RK4, SemiImplicitEuler
from jaxcon.methods.method import Method
from jaxcon.methods.projection import Projection
from jaxcon.readout.quantities import (
    acceleration,
    angular_acceleration,
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
    reaction,
    velocity,
    violation,
    wrench,
)
from jaxcon.system.actuators import Motor
from jaxcon.system.forces import Spring
from jaxcon.system.layout import WORLD
from jaxcon.system.state import State

if TYPE_CHECKING:
    from jaxcon import environments as environments

__version__ = "0.2.0"


@functools.cache
def _renamed() -> dict[str, str]:
    """Returns a dictionary from dotted names of earlier versions to current dotted names."""
    table = Path(__file__).with_name("renamed.json")
    return json.loads(table.read_text(encoding="utf-8"))["names"]


if not TYPE_CHECKING:  # otherwise type checkers would accept every name

    def __getattr__(name: str) -> Any:
        """Imports `environments` at its first use: the import registers tasks with Gymnasium.

        Raises:
            AttributeError: the name does not exist; for a name from before 0.2.0, or one that is in
                a namespace, the message says where it is.
        """
        if name == "environments":
            return importlib.import_module("jaxcon.environments")
        old = f"{__name__}.{name}"
        if (new := _renamed().get(old)) is not None:
            raise AttributeError(
                f"{old} is {new} since 0.2.0: see the changelog. tools/rename.py of the repository"
                " rewrites code."
            )
        spaces = (x for x in __all__ if name in getattr(globals()[x], "__all__", ()))
        place = next((f"; it is jc.{space}.{name}" for space in spaces), "")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{place}")


def __dir__() -> list[str]:
    """Returns the public names."""
    return [*__all__, "environments", "__version__", "__doc__"]


__all__ = [
    "Baumgarte",
    "Distance",
    "Fixed",
    "GeneralizedSystem",
    "Limit",
    "Method",
    "Motor",
    "PlaneContact",
    "Prismatic",
    "Projection",
    "RK4",
    "Revolute",
    "Scene",
    "SemiImplicitEuler",
    "SimulationError",
    "Spherical",
    "Spring",
    "State",
    "Status",
    "WORLD",
    "acceleration",
    "angular_acceleration",
    "angular_momentum",
    "angular_velocity",
    "assemble",
    "center_of_mass",
    "check_gradients",
    "compiler_options",
    "coordinate",
    "coordinate_rate",
    "energy",
    "forward_dynamics",
    "from_mjcf",
    "identify",
    "init",
    "momentum",
    "multipliers",
    "orientation",
    "position",
    "raise_for_status",
    "reaction",
    "report",
    "rollout",
    "shard",
    "step",
    "tradeoff",
    "tune",
    "use_all_cores",
    "velocity",
    "violation",
    "wrench",
    "adjoints",
    "analysis",
    "chains",
    "contacts",
    "devices",
    "extend",
    "forces",
    "inertia",
    "integrators",
    "io",
    "joints",
    "learning",
    "quaternion",
    "shapes",
    "solvers",
    "stabilizers",
    "systems",
    "view",
]
