"""Bodies in the plane or in space: their mass, the forces on them, and how they move."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.doubled import rounded
from jaxcon.core.lanes import Vector, collect, total, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane, PyTree
from jaxcon.geometry.pose import Motion, Pose
from jaxcon.model import params
from jaxcon.model.bodies import rest
from jaxcon.model.coordinates import JointCoordinate, count, expected
from jaxcon.model.frames import WorldFrame
from jaxcon.model.layout import Layout, Place
from jaxcon.model.state import Energy
from jaxcon.model.turning import coarse, continued, reduced
from jaxcon.solvers.jacobian import Columns
from jaxcon.solvers.saddle import Diagonal, Solution

STILL = 1e-9
"""The speed [m/s] of the ends of a rod against each other below which it is not taken to turn."""

FARTHEST = 4.0
"""The turn of a body in a step [rad] from which it counts whatever its axis.

Where it turns by 2π, its end hardly depends on small changes of ω.
"""


@pytree
class MassProperties:
    """Mass and moments of inertia of the bodies of one group.

    Attributes:
        mass: (bodies,) [kg].
        moments: (bodies,) in the plane, in space a Vector of three such [kg m²]; None for
            particles.
    """

    mass: Array
    moments: Any


class Snapshot:
    """A system at one instant: frames of bodies and coordinates of joints, computed once.

    Read a snapshot only in the trace in which it was made: a value that is first read within a
    branch of a condition or a loop cannot be read outside of it.

    Attributes:
        system: the bodies, joints and forces.
        q: positions, (n_q,).
        v: velocities, (n_v,).
        instant: the time [s], with what rounding takes of it.
        joint_rows: rows of coordinates by name, for each group of joints and indices asked for.
    """

    def __init__(self, system: Any, q: Array, v: Array, instant: Any) -> None:
        self.system, self.q, self.v, self.instant = system, q, v, instant
        self.joint_rows: dict[Any, dict[str, Any]] = {}

    @property
    def t(self) -> Any:
        """The time, rounded, for users' functions; `instant` may hold its remainder."""
        return rounded(self.instant)

    @cached_property
    def frames(self) -> tuple[Any, ...]:
        """The motion of each group of bodies."""
        system, q = self.system, self.q
        if not isinstance(system.remainder, tuple):
            system, q = system.unwind(q)
        groups, counted = system.layout.groups, not isinstance(system.laps, tuple)
        frames = (g.kind.frame(*g.unpack(q, self.v)) for g in groups)
        return tuple(
            frame.after(system.laps) if counted and group.kind.turns else frame
            for group, frame in zip(groups, frames, strict=True)
        )

    def motion(self, name: str) -> Motion:
        """The motion of one body as arrays, for a user's function."""
        return self.system.motion(name, self.q, self.v)

    def map(self, function: Any) -> Snapshot:
        """Returns the snapshot with every number replaced by a function of it."""
        return Snapshot(*jax.tree.map(function, (self.system, self.q, self.v, self.instant)))

    def frame(self, place: Place) -> Any:
        """The motion of some bodies of one group, or of the world."""
        if place.group is None:
            return WorldFrame(self.system.layout.dim)
        return self.frames[place.group].gather(place.take)


@pytree
class BodySystem:
    """Particles and rigid bodies under forces and constraints; `Scene.build` makes one.

    Attributes:
        gravity: (dim,) [m/s²].
        inertia: mass properties of each group of bodies.
        constraints: groups of equal constraints.
        forces: groups of equal force elements.
        offsets: by name, the body's own frame as given by the user, in its principal frame; only
            for bodies where they differ.
        fixed: by name, the pose of each frame that is fixed to the world.
        turns: the angles near which those of joints whose whole turns are counted lie, (n,) [rad].
        layout: names and indices.
        counted: which these are.
        bounds: groups of equal elements whose multipliers are bounded.
        remainder: what the angles in q of bodies in the plane lack, (bodies,) [rad]; empty where
            that is not known.
        laps: the whole turns that these angles lack, (bodies,); empty where q has them.
    """

    gravity: Array
    inertia: tuple[MassProperties, ...]
    constraints: tuple[Any, ...]
    forces: tuple[Any, ...]
    offsets: dict[str, Pose]
    fixed: dict[str, Pose]
    turns: Any
    layout: Layout = static()
    counted: tuple[JointCoordinate, ...] = static(default=())
    bounds: tuple[Any, ...] = ()
    remainder: Any = ()
    laps: Any = ()

    @property
    def n_v(self) -> int:
        """Number of velocities."""
        return self.layout.n_v

    def snapshot(self, q: Array, v: Array, t: Any) -> Snapshot:
        """The system at one instant."""
        return Snapshot(self, q, v, t)

    def remember(self, turns: PyTree, remainder: PyTree = ()) -> BodySystem:
        """With other angles near which those that are counted lie, and remainders of others."""
        return dataclasses.replace(self, turns=turns, remainder=remainder)

    def no_remainder(self, dtype: Any) -> PyTree:
        """The `angle_remainder` of a state that has made no turns."""
        where = self.layout.angles if coarse(dtype) else None
        return () if where is None else jnp.zeros(where.stop - where.start, dtype)

    def unwind(self, q: Array) -> tuple[BodySystem, Array]:
        """The system that knows the whole turns of bodies in the plane, and q without them."""
        where = self.layout.angles
        if where is None or not coarse(q.dtype):
            return self, q
        none = isinstance(self.remainder, tuple)
        remainder = jnp.zeros_like(q[where]) if none else self.remainder
        angle, laps = reduced(q[where], remainder)
        system = dataclasses.replace(self, laps=laps, remainder=())
        return system, self._with_angles(q, angle)

    def rewind(self, q: Array, after: Array) -> tuple[Array, PyTree]:
        """The coordinates after a step with their whole turns, and what rounding takes of them.

        Args:
            q: at the start of the step, (n_q,).
            after: where the step led, from q without whole turns, (n_q,).
        """
        where = self.layout.angles
        if where is None or not coarse(q.dtype):
            return after, ()
        angle, remainder = continued(q[where], after[where])
        return self._with_angles(after, angle), remainder

    def _with_angles(self, q: Array, angle: Array) -> Array:
        """q with other angles of bodies in the plane."""
        lanes = [Vector.of_rows(q, g.q, g.kind.n_q, len(g.names)) for g in self.layout.groups]
        pairs = zip(self.layout.groups, lanes, strict=True)
        return _join([Vector(*x[:-1], angle) if g.kind.turns else x for g, x in pairs], q)

    def count(self, q: Array, v: Array, t: Any) -> PyTree:
        """The angles of the joints whose turns are counted, over turns, (n,) [rad]."""
        return count(self.counted, self.snapshot(q, v, t)) if self.counted else self.turns

    def expect(self, here: Snapshot, end: Array, dt: Array, within: bool) -> tuple[PyTree, Array]:
        """Returns the expected angles after a step, and by how much they may be off, ().

        Args:
            here: the start of the step.
            end: v after it, (n_v,).
            dt: its length, () [s].
            within: whether angles are also read between its ends.
        """
        if not self.counted:
            return self.turns, jnp.zeros_like(dt)
        turns, missed = expected(self.counted, here, end, dt, within)
        return turns, jnp.max(missed, axis=0)

    def mass(self, q: Array) -> Diagonal:
        """M: constant and diagonal, since frames lie at centres of mass along principal axes."""
        groups = zip(self.layout.groups, self.inertia, strict=True)
        return Diagonal(_join([g.kind.mass(p.mass, p.moments) for g, p in groups], q))

    def force(self, q: Array, v: Array, t: Any, control: Any = None) -> Array:
        """f (n_v,): gravity, gyroscopic force −ω × Iω, force elements and control."""
        groups = zip(self.layout.groups, self.inertia, strict=True)
        gyroscopic = [g.kind.gyroscopic(g.unpack(q, v)[1], p.moments) for g, p in groups]
        return self._forces(q, v, t, control, gyroscopic)

    def _weight(self, group: Any, mass: Lane) -> Vector:
        """Returns the weight of the bodies of a group."""
        own = [mass * g[None] for g in Vector.of(self.gravity)]
        return Vector(*own, *zeros(group.kind.n_v - self.layout.dim))

    def applied(self, q: Array, v: Array, t: Any, control: Any = None) -> Array:
        """f without the gyroscopic force, (n_v,); reads v only where a force element does."""
        none = [zeros(g.kind.n_v) for g in self.layout.groups]
        return self._forces(q, v, t, control, none)

    def _forces(self, q: Array, v: Array, t: Any, control: Any, gyroscopic: list[Vector]) -> Array:
        """Gravity, force elements and control, with gyroscopic forces by group."""
        snapshot = self.snapshot(q, v, t)
        groups = self.layout.groups
        own = [self._own_force(i, q, v, gyroscopic[i]) for i in range(len(groups))]
        terms = [
            [[(tuple(range(len(g.names))), x)] for x in f] for g, f in zip(groups, own, strict=True)
        ]
        for element in self.forces:
            for place, pull in element.pulls(snapshot, control):
                if place.group is not None:
                    for known, x in zip(terms[place.group], pull, strict=True):
                        known.append((place.indices, x))
        forces = (
            Vector(*(collect(x, len(g.names)) for x in t))
            for g, t in zip(groups, terms, strict=True)
        )
        return _join(list(forces), q)

    def _own_force(self, group: int, q: Array, v: Array, gyroscopic: Vector) -> Vector:
        """Gravity and gyroscopic force on the bodies of a group."""
        layout, properties = self.layout.groups[group], self.inertia[group]
        _, velocity = layout.unpack(q, v)
        spread = jnp.zeros_like(velocity[0])
        return (self._weight(layout, properties.mass) + gyroscopic).map(lambda x: spread + x)

    def kinematics(self, q: Array, v: Array) -> Array:
        """q̇ (n_q,) of the velocities v."""
        return self._each("kinematics", q, v)

    def retract(self, q: Array, step: Array) -> Array:
        """q ⊕ Δ for a finite step Δ = h v (n_v,); rotations by their exponential."""
        return self._each("retract", q, step)

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """ad*_v p (n_v,): what turning with the bodies does to a momentum p (n_v,), p × ω."""
        pairs = [(g.kind, g.unpack(q, v)[1], g.unpack(q, p)[1]) for g in self.layout.groups]
        return _join([kind.coadjoint(own, momentum) for kind, own, momentum in pairs], q)

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """(dexp⁻¹_Δ)ᵀ p (n_v,): a momentum along a step Δ = h v, as seen from where it begins.

        With −Δ it is as seen from where it ends, and dexp⁻¹_Δ p: the change of Δ that turns the end
        of the step by p in the frame of its start. Where velocities are rates of coordinates it is
        p.
        """
        pairs = [(g.kind, g.unpack(q, step)[1], g.unpack(q, p)[1]) for g in self.layout.groups]
        return _join([kind.carry(own, momentum) for kind, own, momentum in pairs], q)

    def kick(self, q: Array, v: Array, acceleration: Array, dt: Any, small: bool = False) -> Array:
        """v after a step of h under a, (n_v,); free rotation in space is split off.

        Args:
            q: positions, (n_q,).
            v: velocities before the step, (n_v,).
            acceleration: a at q and v, (n_v,), with its gyroscopic part.
            dt: h, (1,) [s].
            small: whether bodies turn by far less than a radian in a step, which takes less work.
        """
        parts = zip(self.layout.groups, self.inertia, strict=True)
        known = [
            (g.kind, g.unpack(q, v)[1], g.unpack(q, acceleration)[1], p.moments) for g, p in parts
        ]
        kicked = ((kind.kick_little if small else kind.kick)(*own, dt) for kind, *own in known)
        return _join(list(kicked), q)

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """The change p (n_v,) of velocities in body frames that have turned by Δ (n_v,)."""
        pairs = [(g.kind, g.unpack(q, step)[1], g.unpack(q, p)[1]) for g in self.layout.groups]
        return _join([kind.in_turned_frames(own, momentum) for kind, own, momentum in pairs], q)

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """The part of a, (n_v,), by which bodies without forces turn in space."""
        parts = zip(self.layout.groups, self.inertia, strict=True)
        known = [(g.kind, g.unpack(q, v)[1], p.moments) for g, p in parts]
        return _join(
            [
                kind.gyroscopic_acceleration(own, moments).map(lambda x, v=own: 0 * v[0] + x)
                for kind, own, moments in known
            ],
            q,
        )

    def rotate(self, q: Array, v: Array, dt: Any) -> Array:
        """v (n_v,) after a free rotation of h (1,) [s]."""
        parts = zip(self.layout.groups, self.inertia, strict=True)
        known = [(g.kind, g.unpack(q, v)[1], p.moments) for g, p in parts]
        return _join([kind.rotate(own, moments, dt) for kind, own, moments in known], q)

    def coast(self, q: Array, v: Array, dt: Any) -> Array:
        """The mean gyroscopic acceleration of a step of free rotation, less that at its start.

        Args:
            q: positions, (n_q,).
            v: velocities before the step, (n_v,).
            dt: h, (1,) [s].
        """
        parts = zip(self.layout.groups, self.inertia, strict=True)
        known = [(g.kind, g.unpack(q, v)[1], p.moments) for g, p in parts]
        return _join(
            [
                kind.coast(own, moments, dt).map(lambda x, v=own: 0 * v[0] + x)
                for kind, own, moments in known
            ],
            q,
        )

    def by_body(self, q: Array, x: Array) -> Array:
        """A mask of the numbers of bodies that have one that is not zero, (n_v,)."""
        groups = (g.unpack(q, x)[1] for g in self.layout.groups)
        some = (functools.reduce(operator.or_, (lane != 0 for lane in own)) for own in groups)
        sizes = (g.kind.n_v for g in self.layout.groups)
        return jnp.concatenate([x for own, n in zip(some, sizes, strict=True) for x in [own] * n])

    has_bodies: ClassVar[bool] = True
    """True for a system of bodies, of which it is known what turns."""

    @property
    def turns_in_space(self) -> bool:
        """True where bodies have an orientation in space."""
        return any(g.kind.n_q != g.kind.n_v for g in self.layout.groups)

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Any, dt: Any) -> Array:
        """The square of the largest turn in a step, of bodies and of rods, () [rad²].

        Args:
            q: positions, (n_q,).
            v: velocities of the step, (n_v,).
            before: velocities at which the rows are known, (n_v,).
            rows: the constraints.
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
        self, v: Array, before: Array, rows: Any, dt: Any, whole: bool = False
    ) -> Array:
        """The square of the largest turn of what a row holds of its bodies, (n_c,) [rad²].

        What a row holds of a body is an arm or an axis, r, or the row itself is a rod. In space a
        body may spin about r without turning it. The part J_ω of the row is across r, and so the
        part of ω along J_ω, at its largest among the rows of a constraint, is that which turns r.
        Of a body that turns by more than `FARTHEST` all of ω counts.

        Args:
            v: velocities of the step, (n_v,).
            before: velocities at which the rows are known, (n_v,).
            rows: the constraints.
            dt: h, (1,) [s].
            whole: whether all of ω counts, not only what turns r.
        """
        found: list[Array] = []
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
            found += [most] * count
        return jnp.concatenate(found)

    def _bends(self, start: int, blocks: list[Any], rows: Any) -> bool:
        """True for rows between particles alone that are no rods."""
        return start not in rows.swings and {x.columns.components for x in blocks} == {
            self.layout.dim
        }

    def complete(self, solution: Solution) -> Solution:
        """The solution of the saddle system as it is."""
        return solution

    def sizes(self, n_q: int) -> tuple[int, int]:
        """How many positions and velocities a state has."""
        return self.layout.n_q, self.layout.n_v

    def extent(self, q: Array) -> Array:
        """max |x| over all bodies [m]; angles in the plane, which grow by every turn, left out."""
        most = jnp.zeros(q.shape[1:], q.dtype)
        for g in self.layout.groups:
            place = Vector.of_rows(q, g.q, g.kind.dim, len(g.names))
            most = jnp.maximum(most, jnp.max(jnp.abs(place.stack()), axis=(0, 1)))
        return most

    def normalize(self, q: Array) -> Array:
        """q with its quaternions brought back to unit length."""
        if not self.turns_in_space:
            return q
        v = jnp.zeros((self.n_v, *q.shape[1:]), q.dtype)
        groups = self.layout.groups
        return _join([g.kind.normalize(g.unpack(q, v)[0]) for g in groups], q)

    def _each(self, verb: str, q: Array, v: Array) -> Array:
        groups = self.layout.groups
        return _join([getattr(g.kind, verb)(*g.unpack(q, v)) for g in groups], q)

    def columns(self, place: Place) -> Columns:
        """Where the velocities of some bodies lie in v."""
        if place.group is None:
            raise ValueError("the world has no velocities")
        group = self.layout.groups[place.group]
        return Columns(group.v, group.kind.n_v, len(group.names), place.indices)

    def motion(self, name: str, q: Array, v: Array) -> Motion:
        """The motion of a body in the frame in which the user gave it, as arrays.

        Raises:
            ValueError: the name is unknown.
        """
        if isinstance(name, str) and name in self.fixed:
            return rest(self.fixed[name])
        return self.principal_motion(name, q, v).seen_from(self.offsets.get(name))

    def principal_motion(self, name: str, q: Array, v: Array) -> Motion:
        """The motion of a body's principal frame at its centre of mass, as arrays."""
        group, index = self.layout.locate(name)
        own = q[self.layout.q(name)]
        kind = self.layout.groups[group].kind
        if not isinstance(self.laps, tuple) and kind.turns:
            own = own + jnp.asarray((0, 0, 2 * jnp.pi), own.dtype) * self.laps[index]
        return kind.motion(own, v[self.layout.v(name)])

    def energy(self, q: Array, v: Array, t: Any) -> Energy:
        """½ vᵀMv, and the potential of gravity and springs; user forces have none [J]."""
        snapshot = self.snapshot(q, v, t)
        potential: Lane = 0.0
        for frame, properties in zip(snapshot.frames, self.inertia, strict=True):
            height = frame.position.dot(Vector.of(self.gravity))
            potential = potential - jnp.sum(properties.mass * height)
        stored = total(jnp.sum(x) for f in self.forces for x in f.potential(snapshot))
        rotors = (c for c in self.constraints if hasattr(c, "kinetic"))
        kinetic = jnp.sum(self.mass(q).values * v * v) / 2
        kinetic = kinetic + total(jnp.sum(c.kinetic(snapshot)) for c in rotors)
        return Energy(kinetic, potential + stored)

    @property
    def params(self) -> dict[str, Any]:
        """Numbers by name: `gravity`, and for each body, constraint and force its fields.

        A rigid body has `mass`, `inertia` (moments about its centre of mass), `center` (of mass, in
        the frame in which the body was given) and in space `axes` (principal to that frame, a unit
        quaternion), but for the links of a `Flexure`, which goes by them. Where a fixed body is is
        not among them: build the scene inside the differentiated function for it.
        """
        return params.read(self)

    def with_params(self, changes: Mapping[str, Any]) -> BodySystem:
        """Returns the system with other numbers; nothing is retraced by it.

        A mass changed alone leaves the inertia as it is. `inertia` of a body in space may also be a
        tensor (3, 3) about its centre of mass, in the frame in which it was given, or an `Inertia`
        in place of all four. Where `center` or `axes` are given, points and axes of joints stay
        where they are on the body, also those at its old centre of mass, and a state of this system
        becomes one of the new by `jc.restate`; anchors changed beside them are given in the new
        principal frame. A body whose frames coincided has two then, which is one new trace.

        Args:
            changes: as `params`, as much of it as changes: `{"rod": {"length": 2.0}}`.

        Raises:
            ValueError: an unknown name or field, a wrong shape, or a value out of range.
        """
        return params.replaced(self, changes)


def bending(v: Array, start: int, blocks: list[Any], rows: Any) -> Array:
    """The square of the rate at which the direction of particles' motion turns, (element,).

    A constraint between particles alone, such as a curve of curvature κ, has a γ of κ|v|² for the
    difference v of their velocities, and turns it at |γ|/|v|. A γ that has other reasons makes this
    as large as one likes; callers take at most a radian a step.

    Args:
        v: velocities at which the rows are known, (n_v,).
        start: the first row of the constraints.
        blocks: of their Jacobian, one for each particle.
        rows: all constraints.
    """
    first, *others = (x.columns.take(v) for x in blocks)
    apart = [first - other for other in others] or [first]
    speed = functools.reduce(jnp.maximum, (x.dot(x) for x in apart))
    own = Vector.of_rows(rows.bias, start, *blocks[0].shape)
    fastest = functools.reduce(jnp.maximum, (x * x for x in own))
    return fastest / (speed + STILL**2)


def _join(groups: list[Vector], like: Array) -> Array:
    """One flat array, component-major inside each group."""
    if not groups:
        return jnp.zeros((0, *like.shape[1:]), like.dtype)
    lanes = [x for group in groups for x in group]
    batch = jnp.broadcast_shapes(*(x.shape[1:] for x in lanes))
    return jnp.concatenate([jnp.broadcast_to(x, (x.shape[0], *batch)) for x in lanes])
