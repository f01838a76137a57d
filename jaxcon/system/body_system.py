"""Systems of bodies in the plane or in space: mass matrix, forces and kinematics."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import jax
import jax.numpy as jnp

from jaxcon.core import checks, numerics
from jaxcon.core.doubled import Doubled, rounded
from jaxcon.core.lanes import Vector, collect, total, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.summary import by_class, listed, of_class, table
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.linear.jacobian import Columns
from jaxcon.linear.saddle import Diagonal, Solution
from jaxcon.system import params
from jaxcon.system.bodies import Particle, rest
from jaxcon.system.coordinates import JointCoordinate, count, expected, joined
from jaxcon.system.frames import Frame, PlanarFrame, WorldFrame
from jaxcon.system.layout import Layout, Place
from jaxcon.system.state import Energy
from jaxcon.system.turning import coarse, continued, reduced

if TYPE_CHECKING:
    from jaxcon.constraints.rows import Rows
    from jaxcon.linear.jacobian import Block
    from jaxcon.protocols import System

STILL = 1e-9
"""A small relative speed of two particles [m/s] that keeps their turn rate finite in `bending`."""

FARTHEST = 4.0
"""The turn of a body in a step [rad] above which `squared_turns` counts turns about all axes.

After a turn near 2π the orientation no longer shows the direction of ω.
"""


@pytree
class MassProperties:
    """Mass and moments of inertia of the bodies of one group.

    Attributes:
        mass: (bodies,) [kg].
        moments: moments of inertia [kg m²]: (bodies,) in the plane, a Vector of three lanes in
            space; None for particles.
    """

    mass: Array
    moments: Any


class Snapshot:
    """A system at one instant: frames of bodies and coordinates of joints, computed once.

    Values are computed when they are first read. Read a snapshot only in the trace in which it was
    made: a value first read inside a `cond` or loop cannot be read outside of it.

    Attributes:
        system: the bodies, joints and forces.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        instant: the time and its rounding error [s].
    """

    def __init__(self, system: System, q: Array, v: Array, instant: Doubled | Scalar) -> None:
        # Any, since elements on bodies use attributes that the protocol `System` lacks
        self.system: Any = system
        self.q, self.v, self.instant = q, v, instant
        # rows of joint coordinates that were read: for each (group, joints), by coordinate name
        self.joint_rows: dict[Any, dict[str, Any]] = {}

    @property
    def t(self) -> Any:
        """The rounded time, () [s], for functions of the user."""
        return rounded(self.instant)

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """The `Frame` of each group of bodies: positions, rotations and velocities."""
        system, q = self.system, self.q
        if not isinstance(system.remainder, tuple):
            system, q = system.unwind(q)
        frames = []
        for group in system.layout.groups:
            frame = group.kind.frame(*group.unpack(q, self.v))
            if isinstance(frame, PlanarFrame) and not isinstance(system.laps, tuple):
                frame = frame.after(system.laps)
            frames.append(frame)
        return tuple(frames)

    def motion(self, name: str) -> Motion:
        """Returns the motion of a body's user frame, as arrays.

        Args:
            name: name of the body.
        """
        return self.system.motion(name, self.q, self.v)

    def map(self, function: Callable[[Array], Array]) -> Snapshot:
        """Applies a function to every array; returns the new snapshot."""
        return Snapshot(*jax.tree.map(function, (self.system, self.q, self.v, self.instant)))

    def frame(self, place: Place) -> Any:
        """Returns the `BodyFrame` of bodies, or of the world.

        Args:
            place: the group and the indices of the bodies.
        """
        if place.group is None:
            return WorldFrame(self.system.layout.dim)
        return self.frames[place.group].gather(place.take)


@pytree
class BodySystem:
    """Particles and rigid bodies under forces and constraints; `Scene.build` makes one.

    Attributes:
        gravity: gravitational acceleration, (dim,) [m/s²].
        inertia: mass properties of each group of bodies.
        constraints: groups of constraints, each of one kind.
        forces: groups of force elements, each of one kind.
        offsets: the poses of user's frames in principal frames, by body name; only for bodies whose
            two frames differ.
        fixed: the pose of each frame that is fixed to the world, by name.
        turns: the expected angles of the `counted` coordinates, (n,) [rad]; see `State.turns`.
        layout: names and indices.
        counted: the joint coordinates whose whole turns are counted.
        bounds: groups of inequality elements, each of one kind.
        remainder: the rounding errors of the angles of bodies in the plane, (bodies,) [rad]; empty
            if unknown.
        laps: whole turns that `unwind` removed from the angles of bodies in the plane, (bodies,);
            empty for none.
    """

    gravity: Array
    inertia: tuple[MassProperties, ...]
    constraints: tuple[Any, ...]
    forces: tuple[Any, ...]
    offsets: dict[str, Pose]
    fixed: dict[str, Pose]
    turns: Array | tuple[()]
    layout: Layout = static()
    counted: tuple[JointCoordinate, ...] = static(default=())
    bounds: tuple[Any, ...] = ()
    remainder: Array | tuple[()] = ()
    laps: Array | tuple[()] = ()

    @property
    def n_v(self) -> int:
        """The number of velocities."""
        return self.layout.n_v

    def __repr__(self) -> str:
        """Describes the system: sizes, and the names of bodies and elements."""
        groups = (*self.constraints, *self.bounds, *self.forces)
        elements = ((of_class(group.law), name) for group in groups for name in group.names)
        controls = [name for name, *_ in self.layout.controls]
        where = "in the plane" if self.layout.dim == 2 else "in space"
        rows = [
            ("q, v", f"{self.layout.n_q}, {self.layout.n_v} {self.gravity.dtype}, {where}"),
            ("bodies", listed(self.layout.bodies)),
            ("fixed", listed(self.layout.fixed)),
            *by_class(elements),
            ("control", f"({self.layout.n_u},) of {listed(controls)}" if controls else ""),
        ]
        return table("BodySystem", rows)

    def snapshot(self, q: Array, v: Array, t: Doubled | Scalar) -> Snapshot:
        """Returns the system at one instant, as a `Snapshot`."""
        return Snapshot(self, q, v, t)

    def with_turns(self, turns: Array | tuple[()], remainder: Array | tuple[()] = ()) -> Self:
        """Returns the system with other expected angles `turns` and rounding errors `remainder`."""
        return dataclasses.replace(self, turns=turns, remainder=remainder)

    def no_remainder(self, dtype: DType) -> Array | tuple[()]:
        """Returns the `angle_remainder` of a new state: zeros, or () if angles are not reduced."""
        where = self.layout.angles if coarse(dtype) else None
        return () if where is None else jnp.zeros(where.stop - where.start, dtype)

    def unwind(self, q: Array) -> tuple[Self, Array]:
        """Moves whole turns of angles in the plane from q to `laps`; returns the system and q."""
        where = self.layout.angles
        if where is None or not coarse(q.dtype):
            return self, q
        none = isinstance(self.remainder, tuple)
        remainder = jnp.zeros_like(q[where]) if none else self.remainder
        angle, laps = reduced(q[where], remainder)
        system = dataclasses.replace(self, laps=laps, remainder=())
        return system, self._with_angles(q, angle)

    def rewind(self, q: Array, after: Array) -> tuple[Array, Array | tuple[()]]:
        """Adds whole turns to the coordinates after a step; also returns rounding errors of angles.

        Args:
            q: coordinates at the start of the step, (n_q,).
            after: coordinates at the end of the step, (n_q,); the step starts from q without whole
                turns.
        """
        where = self.layout.angles
        if where is None or not coarse(q.dtype):
            return after, ()
        angle, remainder = continued(q[where], after[where])
        return self._with_angles(after, angle), remainder

    def _with_angles(self, q: Array, angle: Array) -> Array:
        """Returns q with new angles of the bodies in the plane."""
        lanes = []
        for g in self.layout.groups:
            *parts, last = Vector.of_rows(q, g.q, g.kind.n_q, len(g.names))
            lanes += [*parts, angle if g.kind.turns else last]
        return joined(lanes)

    def count(self, q: Array, v: Array, t: Doubled | Scalar) -> Array | tuple[()]:
        """Returns the angles of the counted joint coordinates, whole turns included, (n,) [rad]."""
        return count(self.counted, self.snapshot(q, v, t)) if self.counted else self.turns

    def expect(
        self, here: Snapshot, end: Array, dt: Array, within: bool
    ) -> tuple[Array | tuple[()], Array]:
        """Returns the expected `counted` angles after a step, and a bound on their error, () [rad].

        Args:
            here: the snapshot at the start of the step.
            end: v after the step, (n_v,).
            dt: h, () [s].
            within: True if angles are also read inside the step.
        """
        if not self.counted:
            return self.turns, jnp.zeros_like(dt)
        turns, missed = expected(self.counted, here, end, dt, within)
        return turns, jnp.max(missed, axis=0)

    def _by_group(self, function: Callable[..., Vector], q: Array, *vectors: Array) -> Array:
        """Applies a function to each group of bodies; concatenates the results, (n_v,) or (n_q,).

        Args:
            function: (kind of body, mass properties, *vectors) → a Vector of lanes (body, …).
            q: positions, (n_q,).
            vectors: arrays (n_v,), each passed to the function as one Vector for each group.
        """
        lanes = []
        for g, properties in zip(self.layout.groups, self.inertia, strict=True):
            lanes += function(g.kind, properties, *(g.unpack(q, x)[1] for x in vectors))
        return joined(lanes)

    def mass(self, q: Array) -> Diagonal:
        """Returns the mass matrix M: constant and diagonal, since frames are principal frames."""
        return Diagonal(self._by_group(lambda kind, p: kind.mass(p.mass, p.moments), q))

    def force(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """Returns the generalized force f, (n_v,), of gravity, force elements and control.

        It includes the gyroscopic force −ω × Iω.
        """
        return self._forces(q, v, t, control, True)

    def applied(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """Returns the generalized force f without the gyroscopic force, (n_v,)."""
        return self._forces(q, v, t, control, False)

    def _forces(
        self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree, gyroscopic: bool
    ) -> Array:
        """Returns the generalized force f, (n_v,): gravity, force elements and control.

        Args:
            q: positions, (n_q,).
            v: velocities, (n_v,).
            t: time, () [s].
            control: the control inputs, (n_u,), or None.
            gyroscopic: True to add the gyroscopic force.
        """
        snapshot, groups, terms = self.snapshot(q, v, t), self.layout.groups, []
        for g, properties in zip(groups, self.inertia, strict=True):
            _, velocity = g.unpack(q, v)
            weight = [properties.mass * x[None] for x in Vector.of(self.gravity)]
            force = Vector(*weight, *zeros(g.kind.n_v - self.layout.dim))
            turning = zeros(g.kind.n_v)
            if gyroscopic:
                turning = g.kind.gyroscopic(velocity, properties.moments)
            spread, every = jnp.zeros_like(velocity[0]), tuple(range(len(g.names)))
            terms.append([[(every, spread + x)] for x in force + turning])
        for element in self.forces:
            for place, pull in element.pulls(snapshot, control):
                if place.group is not None:
                    for term, x in zip(terms[place.group], pull, strict=True):
                        term.append((place.indices, x))
        pairs = zip(groups, terms, strict=True)
        lanes = [collect(x, len(g.names)) for g, by_component in pairs for x in by_component]
        return joined(lanes)

    def kinematics(self, q: Array, v: Array) -> Array:
        """Returns q̇, (n_q,), for velocities v."""
        return joined([x for g in self.layout.groups for x in g.kind.kinematics(*g.unpack(q, v))])

    def retract(self, q: Array, step: Array) -> Array:
        """Returns q ⊕ Δ for a finite step Δ = h v, (n_v,); rotations use the exponential map."""
        return joined([x for g in self.layout.groups for x in g.kind.retract(*g.unpack(q, step))])

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """Returns ad*_v p, (n_v,): p × ω for the angular part of a body-frame momentum p.

        This is the rate of p in a frame that turns with the body at the angular velocity ω.
        """
        return self._by_group(lambda kind, _, ω, x: kind.coadjoint(ω, x), q, v, p)

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """Returns (dexp⁻¹_Δ)ᵀ p, (n_v,): a momentum after a step Δ = h v, pulled back to its start.

        With −Δ in place of Δ the result is dexp⁻¹_Δ p: the change of Δ that displaces the end q ⊕ Δ
        by p, where p is in the body frames at the start. For velocities that are rates of
        coordinates, the result is p.
        """
        return self._by_group(lambda kind, _, Δ, x: kind.carry(Δ, x), q, step, p)

    def kick(
        self, q: Array, v: Array, acceleration: Array, dt: Array, small: bool = False
    ) -> Array:
        """Returns v after a step h of v̇ = a, (n_v,), without the energy drift of explicit rules.

        For bodies that turn in space, the gyroscopic part of a follows the free rotation within the
        step.

        Args:
            q: positions, (n_q,).
            v: velocities before the step, (n_v,).
            acceleration: a at q and v, (n_v,), with its gyroscopic part.
            dt: h, (1,) [s].
            small: True for the cheaper rule for bodies that turn by far less than a radian in a
                step.
        """

        def kicked(kind: Particle, p: MassProperties, v: Vector, a: Vector) -> Vector:
            return (kind.kick_little if small else kind.kick)(v, a, p.moments, dt)

        return self._by_group(kicked, q, v, acceleration)

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """Returns a velocity change p, (n_v,), in body frames that have turned by a step Δ.

        Args:
            q: positions, (n_q,).
            step: Δ, (n_v,).
            p: the velocity change in the body frames before the turn, (n_v,).
        """
        return self._by_group(lambda kind, _, Δ, x: kind.in_turned_frames(Δ, x), q, step, p)

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """Returns the accelerations of bodies without forces, (n_v,): the gyroscopic part of a."""
        return self._by_group(
            lambda kind, p, v: kind.gyroscopic_acceleration(v, p.moments).map(
                lambda x: 0 * v[0] + x
            ),
            q,
            v,
        )

    def rotate(self, q: Array, v: Array, dt: Array) -> Array:
        """Returns the velocities v, (n_v,), after a free rotation over h, (1,) [s]."""
        return self._by_group(lambda kind, p, v: kind.rotate(v, p.moments, dt), q, v)

    def coast(self, q: Array, v: Array, dt: Array) -> Array:
        """Returns the mean minus the initial gyroscopic acceleration of a free rotation over h.

        Args:
            q: positions, (n_q,).
            v: velocities before the step, (n_v,).
            dt: h, (1,) [s].

        Returns:
            The difference, (n_v,).
        """
        return self._by_group(
            lambda kind, p, v: kind.coast(v, p.moments, dt).map(lambda x: 0 * v[0] + x), q, v
        )

    def by_body(self, q: Array, x: Array) -> Array:
        """Returns a mask, (n_v,): True for all velocities of a body with a nonzero entry in x."""
        return self._by_group(
            lambda kind, _, x: [functools.reduce(operator.or_, (y != 0 for y in x))] * kind.n_v,
            q,
            x,
        )

    @property
    def has_bodies(self) -> bool:
        """True: the system consists of bodies."""
        return True

    @property
    def turns_in_space(self) -> bool:
        """True if bodies have an orientation in space."""
        return any(g.kind.n_q != g.kind.n_v for g in self.layout.groups)

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Rows, dt: Array) -> Array:
        """Returns the square of the largest turn of a body or rod in a step, () [rad²].

        Args:
            q: positions, (n_q,).
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
        """
        most = bends = jnp.zeros(v.shape[1:], v.dtype)
        for g in self.layout.groups:
            if g.kind.n_v > g.kind.dim:
                ω = Vector(*g.unpack(q, v)[1][g.kind.dim :])
                most = jnp.maximum(most, jnp.max(ω.dot(ω), axis=0))
        for swing in rows.swings.values():
            most = jnp.maximum(most, jnp.max(swing, axis=0))
        for start, blocks in rows.jacobian.by_rows():
            if self._bends(start, blocks, rows):
                bends = jnp.maximum(bends, jnp.max(bending(before, start, blocks, rows), axis=0))
        return jnp.maximum(dt[0] * dt[0] * most, jnp.minimum(dt[0] * dt[0] * bends, 1))

    def squared_turns(
        self, v: Array, before: Array, rows: Rows, dt: Array, whole: bool = False
    ) -> Array:
        """Returns the squared largest turn of the arms and axes of each row, (n_c,) [rad²].

        A row depends on an arm or axis r of each body, or on the direction of a rod. In space a
        body may spin about r without turning r. J_ω, the angular part of J in the row, is normal to
        r; so the component of ω along J_ω turns r. The function takes the largest turn over the
        rows of a constraint. If a body turns by more than `FARTHEST`, all of ω counts.

        Args:
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
            whole: True to count all of ω, not only the part that turns r.
        """
        squares: list[Array] = []
        for start, blocks in rows.jacobian.by_rows():
            count, elements = blocks[0].shape
            most = jnp.zeros((elements, *v.shape[1:]), v.dtype)
            for block in blocks:
                if block.columns.components <= self.layout.dim:
                    continue
                ω = Vector(*block.columns.take(v)[self.layout.dim :])
                square = ω.dot(ω)
                if self.turns_in_space and not whole:
                    most = jnp.maximum(most, square / FARTHEST**2)
                    across = (Vector(*row[self.layout.dim :]) for row in block.value)
                    parts = (numerics.safe_divide(x.dot(ω) ** 2, x.dot(x)) for x in across)
                    square = functools.reduce(jnp.maximum, parts)
                most = jnp.maximum(most, square)
            if start in rows.swings:
                most = jnp.maximum(most, rows.swings[start])
            most = dt * dt * most
            if self._bends(start, blocks, rows):
                bends = dt * dt * bending(before, start, blocks, rows)
                most = jnp.maximum(most, jnp.minimum(bends, 1))
            squares += [most] * count
        return jnp.concatenate(squares)

    def _bends(self, start: int, blocks: list[Block], rows: Rows) -> bool:
        """Returns True if constraints are not rods, and act only on particles.

        Args:
            start: number of the constraints' first row.
            blocks: the blocks of their Jacobian.
            rows: all constraint rows.
        """
        sizes = {x.columns.components for x in blocks}
        return start not in rows.swings and sizes == {self.layout.dim}

    def complete(self, solution: Solution) -> Solution:
        """Returns the solution of the saddle system unchanged: it contains all accelerations."""
        return solution

    def sizes(self, n_q: int) -> tuple[int, int]:
        """Returns the numbers of positions and velocities of a state."""
        return self.layout.n_q, self.layout.n_v

    def extent(self, q: Array) -> Array:
        """Returns the largest |x| of a body's position coordinates, () [m]; angles do not count."""
        most = jnp.zeros(q.shape[1:], q.dtype)
        for g in self.layout.groups:
            place = Vector.of_rows(q, g.q, g.kind.dim, len(g.names))
            most = jnp.maximum(most, jnp.max(jnp.abs(place.stack()), axis=(0, 1)))
        return most

    def normalize(self, q: Array) -> Array:
        """Returns q with quaternions scaled to length one."""
        if not self.turns_in_space:
            return q
        v = jnp.zeros((self.n_v, *q.shape[1:]), q.dtype)
        return joined([x for g in self.layout.groups for x in g.kind.normalize(g.unpack(q, v)[0])])

    def check(self, q: Array) -> None:
        """Checks that concrete positions q have no quaternion of zeros.

        Raises:
            ValueError: the quaternion of a body is zero.
        """
        if checks.is_concrete(q) and (wrong := self.layout.without_orientation(q)):
            raise ValueError(
                f"body '{wrong[0]}': its quaternion in q is zero, which is no orientation; the"
                " identity is (1, 0, 0, 0)."
            )

    def columns(self, place: Place) -> Columns:
        """Returns the indices in v, as columns of J, of the bodies that a `Place` names."""
        if place.group is None:
            raise ValueError("the world has no velocities")
        group = self.layout.groups[place.group]
        return Columns(group.v, group.kind.n_v, len(group.names), place.indices)

    def motion(self, name: str, q: Array, v: Array) -> Motion:
        """Returns the motion of a body's user frame, as arrays.

        Raises:
            ValueError: the name is unknown.
        """
        if isinstance(name, str) and name in self.fixed:
            return rest(self.fixed[name])
        return self.principal_motion(name, q, v).seen_from(self.offsets.get(name))

    def principal_motion(self, name: str, q: Array, v: Array) -> Motion:
        """Returns the motion of a body's principal frame at its center of mass, as arrays."""
        group, index = self.layout.locate(name)
        x, kind = q[self.layout.q(name)], self.layout.groups[group].kind
        if not isinstance(self.laps, tuple) and kind.turns:
            x = x + jnp.asarray((0, 0, 2 * jnp.pi), x.dtype) * self.laps[index]
        return kind.motion(x, v[self.layout.v(name)])

    def kinetic_energy(self, q: Array, v: Array) -> Array:
        """Returns the kinetic energy ½ vᵀMv, without that of rotors, () [J]."""
        return (v * self.mass(q).apply(v)).sum(axis=0) / 2

    def energy(self, q: Array, v: Array, t: Doubled | Scalar) -> Energy:
        """Returns the energy [J]: kinetic ½ vᵀMv, and potential of gravity and springs.

        The kinetic energy includes rotors; user forces have no potential.
        """
        snapshot = self.snapshot(q, v, t)
        potential = 0.0
        for frame, properties in zip(snapshot.frames, self.inertia, strict=True):
            height = frame.position.dot(Vector.of(self.gravity))
            potential = potential - jnp.sum(properties.mass * height)
        stored = total(jnp.sum(x) for f in self.forces for x in f.potential(snapshot))
        rotors = (c for c in self.constraints if c.is_inertia)
        kinetic = self.kinetic_energy(q, v)
        kinetic = kinetic + total(jnp.sum(c.kinetic(snapshot)) for c in rotors)
        return Energy(kinetic, potential + stored)

    @property
    def params(self) -> dict[str, Any]:
        """The numbers by name: `gravity`, and the fields of each body, constraint and force.

        A rigid body has `mass`, `inertia` (moments about its center of mass) and `center` (of mass,
        in the user's frame). In space it also has `axes` (unit quaternion from the principal frame
        to the user's frame), unless a `Flexure` depends on its axes. The poses of fixed bodies are
        no parameters: to differentiate by them, build the scene inside the differentiated function.
        """
        return params.read(self)

    def with_params(self, changes: Mapping[str, Any]) -> Self:
        """Returns the system with other numbers. Compiled programs are reused.

        A change of `mass` alone keeps the inertia. `inertia` of a body in space may also be a
        tensor (3, 3) about its center of mass in the user's frame, or an `Inertia` in place of all
        four fields.

        If `center` or `axes` change, the points and axes of joints keep their places on the body,
        including points at its old center of mass. `jc.systems.restate` then converts states.
        Anchors that change in the same call are given in the new principal frame. If the user's
        frame was the principal frame before, programs are traced once more.

        Args:
            changes: the part of `params` that changes: `{"rod": {"length": 2.0}}`.

        Raises:
            ValueError: an unknown name or field, a wrong shape, or a value out of range.
        """
        return params.replaced(self, changes)


def bending(v: Array, start: int, blocks: list[Block], rows: Rows) -> Array:
    """Returns the squared turn rate of the relative velocity of particles, (element,) [rad²/s²].

    A constraint between particles, such as a curve of curvature κ, has γ = κ|v|² for the relative
    velocity v, and turns v at the rate |γ|/|v|. For other constraints γ/|v| may be arbitrarily
    large; callers limit the turn to one radian a step.

    Args:
        v: velocities at which the rows were computed, (n_v,).
        start: number of the constraints' first row.
        blocks: the blocks of their Jacobian, one for each particle.
        rows: all constraint rows.
    """
    first, *others = (x.columns.take(v) for x in blocks)
    apart = [first - other for other in others] or [first]
    speed = functools.reduce(jnp.maximum, (x.dot(x) for x in apart))
    bias = Vector.of_rows(rows.bias, start, *blocks[0].shape)
    fastest = functools.reduce(jnp.maximum, (x * x for x in bias))
    return fastest / (speed + STILL**2)
