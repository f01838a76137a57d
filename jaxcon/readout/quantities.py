"""Quantities computed from a state: energy, momentum, violation, wrenches and body motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.rows import Violation, linearize
from jaxcon.core import checks
from jaxcon.core.lanes import Vector
from jaxcon.core.typing import Array, PyTree, Scalar
from jaxcon.execution.step import SolutionAt, forward_dynamics_for
from jaxcon.geometry.pose import Motion
from jaxcon.linear.proximal import RankSafe
from jaxcon.methods.baumgarte import Unstabilized
from jaxcon.methods.method import Method
from jaxcon.readout.wrenches import wrench_in
from jaxcon.step import StepInfo, without_memory
from jaxcon.system import coordinates
from jaxcon.system.layout import Place
from jaxcon.system.momentum import Momentum, momentum_of
from jaxcon.system.state import Energy, State, checked_system

if TYPE_CHECKING:
    from jaxcon.constraints.primitives import Row
    from jaxcon.protocols import Solver, System
    from jaxcon.system.body_system import BodySystem


def energy(system: System, state: State) -> Energy:
    """Returns the kinetic energy ½ vᵀMv, the potential energy and their sum, () [J] each.

    Args:
        system: the system.
        state: the state of one world.

    Returns:
        An `Energy` with `kinetic`, `potential` (gravity and springs) and `total`.
    """
    system = checked_system(system, state, "jc.energy(system, s)")
    return system.energy(state.q, state.v, state.instant)


def violation(system: System, state: State) -> Violation:
    """Returns the residuals φ and rates φ̇ of all equality constraints.

    Limits, friction and contacts are not included.

    Args:
        system: the system.
        state: the state of one world.

    Returns:
        A `Violation`. Indexing it by a constraint name gives ‖φ‖ [m, rad]; its `rate` gives ‖φ̇‖
        [m/s, rad/s].
    """
    system = checked_system(system, state, "jc.violation(system, s)")
    return linearize(system, state.q, state.v, state.instant).violation


def position(
    system: BodySystem, state: State, body: str, point: Scalar | Sequence[float] | None = None
) -> Array:
    """Returns the position of a body, or of a point fixed in it, (dim,) [m], world frame.

    Args:
        system: the system.
        state: the state of one world.
        body: name of the body.
        point: a point in the body's frame, (dim,) [m]; by default the origin of the frame.
    """
    motion = _motion(system, state, body, "position")
    return _position_of(motion, point, "position")


def velocity(
    system: BodySystem, state: State, body: str, point: Scalar | Sequence[float] | None = None
) -> Array:
    """Returns the velocity of a body, or of a point fixed in it, (dim,) [m/s], world frame.

    Args:
        system: the system.
        state: the state of one world.
        body: name of the body.
        point: a point in the body's frame, (dim,) [m]; by default the origin of the frame.
    """
    motion = _motion(system, state, body, "velocity")
    if point is None:
        return motion.velocity
    return motion.point_velocity(_local(motion, point, "velocity"))


def orientation(system: BodySystem, state: State, body: str) -> Array:
    """Returns the orientation of a body: an angle () [rad] in 2D, a unit quaternion (4,) in 3D.

    The quaternion has the order wxyz and rotates vectors from the body frame to the world frame.

    Args:
        system: the system.
        state: the state of one world.
        body: name of the body.
    """
    return _oriented(system, state, body, "orientation").orientation


def angular_velocity(system: BodySystem, state: State, body: str) -> Array:
    """Returns the angular velocity of a body [rad/s]: () in 2D; (3,) in the body frame in 3D.

    Args:
        system: the system.
        state: the state of one world.
        body: name of the body.
    """
    return _oriented(system, state, body, "angular_velocity").angular_velocity


def coordinate(system: BodySystem, state: State, joint: str, name: str | None = None) -> Array:
    """Returns a joint coordinate, () [rad] or [m], which is zero in the pose of the built scene.

    In 3D, angles lie in [−π, π] unless whole turns are counted. Turns are counted for joints with a
    spring, servo, coupling or `jc.joints.TurnCounter`.

    Args:
        system: the system.
        state: the state of one world.
        joint: name of the joint.
        name: name of the coordinate; optional if the joint has only one.

    Raises:
        ValueError: the joint or the coordinate is unknown.
    """
    return jnp.reshape(_row(system, state, joint, name, "coordinate").value, ())


def coordinate_rate(system: BodySystem, state: State, joint: str, name: str | None = None) -> Array:
    """Returns the time derivative of a joint coordinate, () [rad/s] or [m/s].

    Args:
        system: the system.
        state: the state of one world.
        joint: name of the joint.
        name: name of the coordinate; optional if the joint has only one.
    """
    return jnp.reshape(_row(system, state, joint, name, "coordinate_rate").rate, ())


def center_of_mass(
    system: BodySystem, state: State, bodies: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Returns the center of mass of bodies and its velocity, world frame.

    Args:
        system: the system.
        state: the state of one world.
        bodies: names of the bodies; by default all moving bodies.

    Returns:
        The position (dim,) [m] and the velocity (dim,) [m/s].
    """
    motion = _momentum(system, state, bodies, "center_of_mass")
    return _point(motion.position), _point(motion.velocity)


def momentum(system: BodySystem, state: State, bodies: Sequence[str] | None = None) -> Array:
    """Returns the total linear momentum Σ m ẋ of bodies, (dim,) [kg m/s], world frame.

    Args:
        system: the system.
        state: the state of one world.
        bodies: names of the bodies; by default all moving bodies.
    """
    return _point(_momentum(system, state, bodies, "momentum").linear)


def angular_momentum(
    system: BodySystem,
    state: State,
    bodies: Sequence[str] | None = None,
    about: Scalar | Sequence[float] | None = None,
) -> Array:
    """Returns the angular momentum Σ m (x − c) × ẋ + R I ω of bodies about a point c, world frame.

    Each body has mass m, center of mass x, rotation matrix R, inertia I and angular velocity ω in
    its own frame.

    Args:
        system: the system.
        state: the state of one world.
        bodies: names of the bodies; by default all moving bodies.
        about: the point c in the world frame, (dim,) [m]; by default the center of mass of the
            bodies.

    Returns:
        The angular momentum [kg m²/s]: () in 2D, (3,) in 3D. About the center of mass, it is
        conserved if no external torque acts. With `jc.SemiImplicitEuler`, ω lags the orientation by
        half a step. In 3D, the direction of the result then oscillates with an amplitude
        proportional to h. The magnitude |I ω| of a free body is exact up to rounding.
    """
    moment = _momentum(system, state, bodies, "angular_momentum")
    angular = moment.angular
    if about is not None:
        point = checks.real("angular_momentum", "about", about, state.q.dtype, (system.layout.dim,))
        arm = moment.position - Vector.of(point).map(lambda x: x[None])
        angular = angular + arm.cross(moment.linear)
    return _point(angular) if isinstance(angular, Vector) else angular[0]


def _momentum(
    system: BodySystem, state: State, bodies: Sequence[str] | None, caller: str
) -> Momentum:
    """Returns the momentum of bodies. Error messages name the public function `caller`.

    Raises:
        ValueError: a name is unknown or given twice, or no name is given.
        TypeError: the system has generalized coordinates, hence no bodies.
    """
    system = checked_system(system, state, f"jc.{caller}(system, s, bodies)")
    if system.layout is None:
        raise TypeError(f"{caller}: generalized coordinates have no bodies.")
    names = system.layout.bodies if bodies is None else checks.names(caller, "bodies", bodies)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{caller}: bodies must be different names, got {list(names)}.")
    places = [Place(group, (i,)) for group, i in map(system.layout.locate, names)]
    return momentum_of(system.snapshot(state.q, state.v, state.instant), places)


def _point(x: Vector) -> Array:
    """Converts a vector whose components have shape (1,) to an array (dim,)."""
    return x.stack()[:, 0]


def wrench(
    info: StepInfo | SolutionAt,
    name: str,
    body: str | None = None,
    *,
    system: BodySystem | None = None,
) -> Array:
    """Returns the force and torque of an element on a body, in the world frame.

    Elements are constraints, limits, friction, contacts, motors, springs and all other forces.

    The torque is taken about the element's anchor. Joints and springs have their anchor on the
    second body. A contact has its anchor at the contact point. For an element without an anchor, or
    with several contact points, the torque is about the body's center of mass.

    Forces of inequality constraints are averages over the step. Forces of equality constraints
    include the stabilizer's feedback; `jc.reaction` excludes it.

    An `info` has its system until JAX rebuilds it. Results of `jit`, `vmap` and rollouts, and
    results of `info[10]`, `jax.tree.map` and unpickling have no system: give `system=`. In a
    rollout, record the wrench: `record=lambda state, info: jc.wrench(info, "hinge")`.

    Args:
        info: the info returned by `jc.step` or recorded by `jc.rollout`, or the result of
            `jc.forward_dynamics`. With `system`, leading batch and time axes are allowed.
        name: name of the element.
        body: name of the body; by default the element's last body. If this body is fixed, the
            result is the negative of the wrench on the moving body, about the same point.
        system: the system, for an info that JAX has rebuilt.

    Returns:
        The wrench (F, τ) [N, N m]: (dim,) on a particle, (3,) in 2D, (6,) in 3D.

    Raises:
        ValueError: the element is unknown or does not act on the body, or the info needs a system.
        TypeError: `info` has another type, or belongs to a system of generalized coordinates, which
            has no bodies.
    """
    bodies = _bodies_of(info, system, "wrench", "info, name")

    return _over_leading_axes(lambda one: wrench_in(bodies, one, name, body), info)


def reaction(
    system: BodySystem,
    state: State,
    name: str,
    body: str | None = None,
    control: PyTree = None,
    solver: Solver | None = None,
    dt: Scalar = 1e-3,
) -> Array:
    """Returns the force and torque of an element on a body, without a stabilizer's feedback.

    Solves M a = f + Jᵀλ and J a + γ = 0 for accelerations a and multipliers λ at the given state.
    Compliant constraints add C λ to the second equation.

    Args:
        system: the system.
        state: the state of one world.
        name: name of a constraint, limit, contact or force element.
        body: name of the body; by default the element's last body.
        control: control input u, as in `jc.step`.
        solver: solver of the linear system; by default `jc.solvers.RankSafe`, which returns the
            smallest forces if constraints are redundant.
        dt: step size h [s] over which inequality constraints are solved. Unused in scenes without
            inequality constraints.

    Returns:
        The wrench (F, τ) [N, N m], with shape and anchor as in `jc.wrench`.

    Raises:
        ValueError: the element is unknown or does not act on the body.
        TypeError: the system has generalized coordinates, hence no bodies.
    """
    if getattr(system, "layout", ()) is None:
        raise TypeError("reaction: generalized coordinates have no bodies; see jc.multipliers.")
    method = Method(solver=RankSafe() if solver is None else solver, stabilizer=Unstabilized())
    given = system, without_memory(state), control, method, dt
    solution = forward_dynamics_for("reaction", *given)
    return wrench(solution, name, body)


def acceleration(
    info: StepInfo | SolutionAt,
    body: str,
    point: Scalar | Sequence[float] | None = None,
    *,
    system: BodySystem | None = None,
) -> Array:
    """Returns the acceleration of a body, or of a point fixed in it, (dim,) [m/s²], world frame.

    In scenes with contacts, it is the mean over the step.

    Args:
        info: the info of a step, or the result of `jc.forward_dynamics`. With `system`, leading
            batch and time axes are allowed.
        body: name of the body.
        point: a point in the body's frame, (dim,) [m]; by default the origin of the frame.
        system: the system, for an info that JAX has rebuilt; see `jc.wrench`.

    Raises:
        ValueError: the body is unknown, or the info needs a system.
        TypeError: `info` has another type, or belongs to a system of generalized coordinates.
    """
    bodies = _bodies_of(info, system, "acceleration", "info, body")

    def of_one(info: StepInfo | SolutionAt) -> Array:
        motion = _motion(bodies, info.state, body, "acceleration")
        where = _position_of(motion, point, "acceleration")
        center = bodies.principal_motion(body, info.state.q, info.state.v)
        a = info.acceleration[bodies.layout.v(body)]
        if center.orientation is None:
            return a
        arm = where - center.position
        if bodies.layout.dim == 2:
            ω, α = center.angular_velocity, a[2]
            return a[:2] + α * jnp.stack([-arm[1], arm[0]]) - ω**2 * arm
        ω, α = (center.rotation @ x for x in (center.angular_velocity, a[3:]))
        return a[:3] + jnp.cross(α, arm) + jnp.cross(ω, jnp.cross(ω, arm))

    return _over_leading_axes(of_one, info)


def angular_acceleration(
    info: StepInfo | SolutionAt, body: str, *, system: BodySystem | None = None
) -> Array:
    """Returns the angular acceleration of a body [rad/s²]: () in 2D; (3,) in the body frame in 3D.

    Args:
        info: the info of a step, or the result of `jc.forward_dynamics`. With `system`, leading
            batch and time axes are allowed.
        body: name of the body.
        system: the system, for an info that JAX has rebuilt; see `jc.wrench`.

    Raises:
        ValueError: the body is unknown or does not turn, or the info needs a system.
        TypeError: `info` has another type, or belongs to a system of generalized coordinates.
    """
    bodies = _bodies_of(info, system, "angular_acceleration", "info, body")

    def of_one(info: StepInfo | SolutionAt) -> Array:
        motion = _oriented(bodies, info.state, body, "angular_acceleration")
        α = info.acceleration[bodies.layout.v(body)][bodies.layout.dim :]
        if bodies.layout.dim == 2:
            return α[0]
        center = bodies.principal_motion(body, info.state.q, info.state.v)
        return motion.rotation.T @ (center.rotation @ α)

    return _over_leading_axes(of_one, info)


def multipliers(info: StepInfo | SolutionAt, name: str) -> Array:
    """Returns the Lagrange multipliers λ of a constraint, (…, rows).

    The docstring of the constraint gives the sign and unit of each row.

    Args:
        info: the info returned by `jc.step` or recorded by `jc.rollout`, or the result of
            `jc.forward_dynamics`. Leading batch and time axes are allowed.
        name: name of the constraint.

    Raises:
        ValueError: the constraint is unknown, or is a limit, contact or motor.
        TypeError: `info` has another type.
    """
    _check_info(info, "multipliers", "info, name")
    if isinstance(info.reactions, Mapping) and isinstance(name, str) and name in info.reactions:
        raise ValueError(
            f"multipliers: '{name}' is no equality constraint; read info.reactions['{name}'], or"
            f" jc.wrench(info, '{name}')."
        )
    return info.multipliers[..., info.violation.layout.rows(name)]


def _bodies_of(
    info: StepInfo | SolutionAt, system: BodySystem | None, caller: str, arguments: str
) -> BodySystem:
    """Returns the given system, or the system of the info if none is given.

    Args:
        info: the info.
        system: the system that the user gives; None to take the system of the info.
        caller: name of the public function, for messages.
        arguments: the arguments of the public function, for messages.

    Raises:
        ValueError: the info knows no system, and none is given.
        TypeError: `info` has another type, or the system has no bodies.
    """
    _check_info(info, caller, arguments)
    owner: Any = system
    if owner is None:
        if info.origin is None:
            raise ValueError(
                f"{caller}: this info knows no system, since JAX has rebuilt it: jit, vmap, a"
                " rollout, an index or a pickle returned it. Call"
                f" jc.{caller}({arguments}, system=system), or record"
                f" jc.{caller}({arguments}) in the rollout."
            )
        owner = info.origin.system
    if owner.layout is None:
        raise TypeError(
            f"{caller}: generalized coordinates have no bodies; see jc.multipliers and"
            " info.acceleration."
        )
    return owner


def _over_leading_axes(
    read: Callable[[StepInfo | SolutionAt], Array], info: StepInfo | SolutionAt
) -> Array:
    """Applies `read`, a function of the info of one world, over all leading axes of an info."""
    for _ in info.status.shape:
        read = jax.vmap(read)
    return read(info)


def _check_info(info: StepInfo | SolutionAt, caller: str, arguments: str) -> None:
    """Checks that `info` is a `StepInfo` or a `SolutionAt`.

    Raises:
        TypeError: `info` has another type.
    """
    if not isinstance(info, StepInfo | SolutionAt):
        raise TypeError(
            f"{caller}: expected the info of a step or the result of forward_dynamics, got"
            f" {type(info).__name__}; call jc.{caller}({arguments})."
        )


def _row(system: BodySystem, state: State, joint: str, name: str | None, caller: str) -> Row:
    """Returns the value and rate of a joint coordinate. Messages name the function `caller`."""
    system = checked_system(system, state, f"jc.{caller}(system, s, joint)")
    where = coordinates.directory(system.constraints)
    end = coordinates.find(system.constraints, where, caller, joint, name)
    joint_coordinate = coordinates.at(coordinates.numbered(system.counted), [end])
    return joint_coordinate.read(system.snapshot(state.q, state.v, state.instant))


def _position_of(motion: Motion, point: Scalar | Sequence[float] | None, caller: str) -> Array:
    """Returns the position of a point in a body's frame, or of the frame's origin, (dim,) [m]."""
    return motion.position if point is None else motion.point(_local(motion, point, caller))


def _local(motion: Motion, point: Scalar | Sequence[float], caller: str) -> Array:
    """Converts a point in a body's frame to an array (dim,) of the motion's dtype, after checks."""
    return checks.real(caller, "point", point, motion.position.dtype, motion.position.shape)


def _motion(system: BodySystem, state: State, body: str, caller: str) -> Motion:
    """Returns the motion of a body's frame. Error messages name the public function `caller`.

    Raises:
        TypeError: the system has generalized coordinates, hence no bodies.
    """
    system = checked_system(system, state, f"jc.{caller}(system, s, body)")
    if not system.has_bodies:
        raise TypeError(f"{caller}: generalized coordinates have no bodies; see state.q.")
    return system.motion(body, state.q, state.v)


def _oriented(system: BodySystem, state: State, body: str, caller: str) -> Motion:
    """Returns the motion of a body's frame, if the body has an orientation.

    Raises:
        ValueError: the body is a particle, which has no orientation.
    """
    motion = _motion(system, state, body, caller)
    if motion.orientation is None:
        raise ValueError(f"'{body}' is a particle: it has no orientation.")
    return motion
