"""Energy, violation and wrenches of a state, and where its bodies are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import Violation, layout_of, linearize
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, times, total
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Motion
from jaxcon.model import coordinates
from jaxcon.model.layout import Place
from jaxcon.model.momentum import Momentum, momentum_of
from jaxcon.model.state import Energy, State, at


def energy(system: Any, state: State) -> Energy:
    """Kinetic energy ½ vᵀMv, potential energy of gravity and springs, and `total`, () [J] each.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: where, of one world.
    """
    system = at(system, state, "jc.energy(system, s)")
    return system.energy(state.q, state.v, state.instant)


def violation(system: Any, state: State) -> Violation:
    """φ and φ̇ of a state, by constraint.

    Joints and other equality constraints alone: joint limits, friction and contacts are left out.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: where, of one world.

    Returns:
        A `Violation`: by name the norm of φ [m, rad], with `rate` that of φ̇ [m/s, rad/s].
    """
    system = at(system, state, "jc.violation(system, s)")
    return linearize(system, state.q, state.v, state.instant).violation


def position(system: Any, state: State, body: str, point: Any = None) -> Array:
    """Where a body is, or a point given in its frame, (dim,) [m], world frame.

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        body: its name.
        point: in the body's frame, (dim,) [m]; the frame's origin unless given.
    """
    motion = _motion(system, state, body, "position")
    return motion.position if point is None else motion.point(_local(motion, point))


def velocity(system: Any, state: State, body: str, point: Any = None) -> Array:
    """How fast a body, or a point given in its frame, moves, (dim,) [m/s], world frame.

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        body: its name.
        point: in the body's frame, (dim,) [m]; the frame's origin unless given.
    """
    motion = _motion(system, state, body, "velocity")
    return motion.velocity if point is None else motion.point_velocity(_local(motion, point))


def orientation(system: Any, state: State, body: str) -> Array:
    """Its angle () [rad] in the plane, or quaternion wxyz (4,), body to world, in space.

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        body: its name.
    """
    return _oriented(system, state, body, "orientation").orientation


def angular_velocity(system: Any, state: State, body: str) -> Array:
    """() in the plane, (3,) in the body frame in space [rad/s].

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        body: its name.
    """
    return _oriented(system, state, body, "angular_velocity").angular_velocity


def coordinate(system: Any, state: State, joint: str, name: str | None = None) -> Array:
    """A coordinate of a joint, zero at assembly, () [rad] or [m].

    In space an angle lies in [−π, π] unless its turns are counted: by a spring, servo or coupling
    on it, or a `TurnCounter`.

    Args:
        system: a `BodySystem`.
        state: where.
        joint: its name.
        name: which of its coordinates; not needed where it has but one.

    Raises:
        ValueError: no such joint or coordinate.
    """
    return jnp.reshape(_row(system, state, joint, name, "coordinate").value, ())


def coordinate_rate(system: Any, state: State, joint: str, name: str | None = None) -> Array:
    """The rate of a coordinate of a joint, () [rad/s] or [m/s].

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        joint: its name.
        name: which of its coordinates; not needed where it has but one.
    """
    return jnp.reshape(_row(system, state, joint, name, "coordinate_rate").rate, ())


def center_of_mass(
    system: Any, state: State, bodies: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Position (dim,) [m] and velocity (dim,) [m/s] of a centre of mass, world frame.

    Args:
        system: a `BodySystem`.
        state: where.
        bodies: whose; all that move unless given.
    """
    found = _momentum(system, state, bodies, "center_of_mass")
    return _point(found.position), _point(found.velocity)


def momentum(system: Any, state: State, bodies: Sequence[str] | None = None) -> Array:
    """Σ m ẋ of chosen bodies, all that move unless given, (dim,) [kg m/s], world frame.

    Args:
        system: a `BodySystem`.
        state: where, of one world.
        bodies: whose; all that move unless given.
    """
    return _point(_momentum(system, state, bodies, "momentum").linear)


def angular_momentum(
    system: Any, state: State, bodies: Sequence[str] | None = None, about: Any = None
) -> Array:
    """Σ m (x − c) × ẋ + R I ω of chosen bodies: () in the plane, (3,) in space [kg m²/s].

    Args:
        system: a `BodySystem`.
        state: where.
        bodies: whose; all that move unless given.
        about: c, world point (dim,) [m]; their common centre of mass unless given.

    Returns:
        The angular momentum, world frame. About the centre of mass it does not change where no
        outer torque acts, whatever the bodies do to each other. With `SemiImplicitEuler`, ω belongs
        half a step before the orientation: in space the direction of the result wobbles within a
        bound proportional to h. |I ω| of a free body is exact to rounding.
    """
    found = _momentum(system, state, bodies, "angular_momentum")
    own = found.angular
    if about is not None:
        point = checks.real("angular_momentum", "about", about, state.q.dtype, (system.layout.dim,))
        arm = found.position - Vector.of(point).map(lambda x: x[None])
        own = own + arm.cross(found.linear)
    return _point(own) if isinstance(own, Vector) else own[0]


def _momentum(system: Any, state: State, bodies: Sequence[str] | None, caller: str) -> Momentum:
    system = at(system, state, f"jc.{caller}(system, s, bodies)")
    if not hasattr(system, "layout"):
        raise TypeError("momentum: a GeneralizedSystem has no bodies whose momentum could be read.")
    names = (
        system.layout.bodies if bodies is None else [bodies] if isinstance(bodies, str) else bodies
    )
    if not names or len(set(names)) < len(names):
        raise ValueError(f"momentum: bodies must be different names, got {list(names)}.")
    places = [Place(group, (i,)) for group, i in map(system.layout.locate, names)]
    return momentum_of(system.snapshot(state.q, state.v, state.instant), places)


def _point(x: Vector) -> Array:
    """A vector of lanes of one element as an array."""
    return x.stack()[:, 0]


def wrench(system: Any, state: State, info: Any, name: str, body: str | None = None) -> Array:
    """What a constraint does to a body: force and torque, world frame, at the anchor.

    The generalized force Jᵀλ of the constraint's rows on the body, moved to the constraint's anchor
    on its second body.

    Args:
        system: a `BodySystem`.
        state: the state to which λ belongs, `info.state`: the one from which the step of `info`
            started, and the one at its end for `GeneralizedAlpha`. Another one is refused; while
            tracing, where values are not known, `info.state` is taken in its place.
        info: a `StepInfo`, or the `Solution` of `forward_dynamics`, for its multipliers. That of a
            bare solver does not know its state and cannot be checked.
        name: of the constraint.
        body: on which body; the second one unless given. On the world it is the opposite of that
            on the other body.

    Returns:
        (F, τ): (dim,) on a particle, (3,) in the plane, (6,) in space [N, N m].

    Raises:
        ValueError: no such constraint, it does not act on this body, or λ does not belong to this
            state.
        TypeError: `info` has no multipliers.
    """
    system, state = _at_multipliers(system, state, info, "wrench")
    snapshot = system.snapshot(state.q, state.v, state.instant)
    group = next((g for g in system.constraints if name in g.names), None)
    if group is None:
        known = [n for g in system.constraints for n in g.names]
        raise ValueError(
            f"constraint '{name}' is unknown; known are {known}. What acts as a force is read where"
            " it comes from: a motor's is its control."
        )
    index = group.names.index(name)
    λ = multipliers(system, state, info, name)
    owner, sign = _acts_on(system, group, index, body)
    columns, block = next(
        (c, rows)
        for c, rows in group.rows(snapshot).jacobian
        if c.start + c.indices[index] == system.layout.v(owner)[0]
    )
    lanes = [
        total(times(row[c], x) for row, x in zip(block, λ, strict=True))
        for c in range(columns.components)
    ]
    force = jnp.stack([jnp.broadcast_to(x, (len(columns.indices),))[index] for x in lanes])
    motion = system.principal_motion(owner, state.q, state.v)
    anchor = group.anchor(snapshot, index)
    return sign * _about(motion, force, motion.position if anchor is None else anchor)


def multipliers(system: Any, state: State, info: Any, name: str) -> Array:
    """λ of a constraint by its rows, (rows,): what its docstring says of its sign and unit.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: `info.state`, as of `wrench`.
        info: a `StepInfo` or `Solution`.
        name: of the constraint.

    Raises:
        ValueError: no such constraint, or λ does not belong to this state.
        TypeError: `info` has no multipliers.
    """
    here, state = _at_multipliers(system, state, info, "multipliers")
    layout = layout_of(here, state.q, state.v, state.instant)
    return info.multipliers[layout.rows(name)]


def _at_multipliers(system: Any, state: State, info: Any, caller: str) -> tuple[Any, State]:
    """The system and the state to which the multipliers of `info` belong."""
    here = at(system, state, f"jc.{caller}(system, s, info, name)")
    if not hasattr(info, "multipliers"):
        raise TypeError(
            f"{caller}: info must be a StepInfo or the Solution of forward_dynamics, got"
            f" {type(info).__name__}."
        )
    place = getattr(info, "state", None)
    if place is None:
        return here, state
    if np.shape(place.q) != np.shape(state.q):
        raise ValueError(
            f"{caller}: info.state.q has shape {np.shape(place.q)}, but state.q"
            f" {np.shape(state.q)}; for a batch use jax.vmap:"
            f" jax.vmap(lambda i: jc.{caller}(system, i.state, i, name))(info)."
        )
    given, own = ((s.q, s.v, s.time) for s in (state, place))
    if checks.is_concrete((given, own)) and not all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(given, own, strict=True)
    ):
        raise ValueError(
            f"{caller}: λ belongs to info.state, at t = {float(place.time):.6g} s, and state is"
            f" another one, at t = {float(state.time):.6g} s; a step tells λ at its start, or with"
            f" GeneralizedAlpha at its end. Call jc.{caller}(system, info.state, info, name)."
        )
    return at(system, place, f"jc.{caller}(system, s, info, name)"), place


def _row(system: Any, state: State, joint: str, name: str | None, caller: str) -> Any:
    """A coordinate of one joint with its rate."""
    system = at(system, state, f"jc.{caller}(system, s, joint)")
    where = coordinates.directory(system.constraints)
    end = coordinates.find(system.constraints, where, "coordinate", joint, name)
    along = coordinates.at(coordinates.numbered(system.counted), [end])
    return along.read(system.snapshot(state.q, state.v, state.instant))


def _acts_on(system: Any, group: Any, index: int, body: str | None) -> tuple[str, int]:
    """The moving body whose force answers for `body`, and the sign with which it does."""
    sides = [
        p.fixed[index] if p.group is None else system.layout.groups[p.group].names[p.indices[index]]
        for p in group.places
    ]
    sides = list(getattr(getattr(group, "law", None), "bodies", sides))
    moving = [side for side in sides if side in system.layout.places]
    target = sides[-1] if body is None else body
    if target in moving:
        return target, 1
    if target in sides and len(moving) == 1:
        return moving[0], -1
    raise ValueError(
        f"constraint '{group.names[index]}' acts on {sides}: the wrench on '{target}' does not"
        " follow from its multipliers."
    )


def _about(motion: Motion, force: Array, anchor: Array) -> Array:
    """The wrench (F, τ) about an anchor, world frame, of a generalized force on a body."""
    if motion.orientation is None:
        return force
    arm = motion.position - anchor
    if motion.position.shape == (2,):
        torque = force[2] + arm[0] * force[1] - arm[1] * force[0]
        return jnp.append(force[:2], torque)
    torque = motion.rotation @ force[3:] + jnp.cross(arm, force[:3])
    return jnp.concatenate([force[:3], torque])


def _local(motion: Motion, point: Any) -> Array:
    dtype, shape = motion.position.dtype, motion.position.shape
    return checks.real("position or velocity", "point", point, dtype, shape)


def _motion(system: Any, state: State, body: str, caller: str) -> Motion:
    system = at(system, state, f"jc.{caller}(system, s, body)")
    return system.motion(body, state.q, state.v)


def _oriented(system: Any, state: State, body: str, caller: str) -> Motion:
    motion = _motion(system, state, body, caller)
    if motion.orientation is None:
        raise ValueError(f"'{body}' is a particle: it has no orientation.")
    return motion
