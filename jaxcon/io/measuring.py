"""Frames, accelerations and forces at one instant of a model, from which sensors are read."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.tendons import Tendons
from jaxcon.contact.contact import Contacts
from jaxcon.contact.limits import Bounds
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.geometry import quaternion
from jaxcon.io.maps import Tree
from jaxcon.readout.wrenches import equality_pulls, inequality_pulls
from jaxcon.system.actuators import JointForces
from jaxcon.system.body_system import BodySystem
from jaxcon.system.state import State, checked_system


@pytree
class Objects:
    """Frames fixed in links, such as sites, n of them.

    Attributes:
        position: the origin in the frame of the link, (n, 3) [m].
        orientation: the orientation in the frame of the link, quaternions (n, 4).
        links: the name of the link of each frame; `jc.WORLD` for frames that do not move.
    """

    position: Array
    orientation: Array
    links: tuple[str, ...] = static()


@pytree
class Parts:
    """Bodies of MuJoCo that are merged with others into a link or fixed to the world, k of them.

    Attributes:
        mass: (k,) [kg].
        center: the center of mass in the frame of the link, (k, 3) [m].
        inertia: the inertia about the center of mass in the frame of the link, (k, 3, 3) [kg m²].
        links: the name of the link of each body; `jc.WORLD` for bodies that do not move.
    """

    mass: Array
    center: Array
    inertia: Array
    links: tuple[str, ...] = static()


class Frames(NamedTuple):
    """The motion of frames in the world.

    Attributes:
        position: (n, 3) [m].
        orientation: quaternions (n, 4).
        rotation: rotation matrices from the frame to the world, (n, 3, 3).
        velocity: velocity of the origin, (n, 3) [m/s].
        spin: angular velocity, (n, 3) [rad/s].
    """

    position: Array
    orientation: Array
    rotation: Array
    velocity: Array
    spin: Array


class Solids(NamedTuple):
    """Rigid bodies at one instant, in the world frame.

    Attributes:
        mass: (n,) [kg].
        position, velocity: of the centers of mass, (n, 3).
        momentum: angular momentum about the center of mass, (n, 3) [kg m²/s].
    """

    mass: Array
    position: Array
    velocity: Array
    momentum: Array


class Wrenches(NamedTuple):
    """Forces and torques on bodies, in the world frame.

    Attributes:
        position: the points about which torques are taken, (n, 3) [m].
        force: (n, 3) [N].
        torque: (n, 3) [N m].
    """

    position: Array
    force: Array
    torque: Array

    def about(self, point: Array) -> tuple[Array, Array]:
        """Returns forces and torques about points (m, 3), as arrays (m, n, 3)."""
        arm = self.position[None] - point[:, None]
        force = jnp.broadcast_to(self.force, arm.shape)
        return force, self.torque[None] + jnp.cross(arm, force)


class Reading:
    """A model at one instant; values are computed when they are first read.

    Attributes:
        system: the system, with the turns of the state.
        tree: the kinematic tree.
        parts: the bodies of links with several bodies, and the bodies that do not move.
        state: the state.
        info: accelerations and multipliers; None if they are not known.
        control: the control inputs; None if they are not known.
        snapshot: the system at the state.
        names: the names of the links, in the order of the arrays; the world comes first.
    """

    def __init__(
        self,
        system: BodySystem,
        tree: Tree,
        parts: Parts,
        state: State,
        info: Any,
        control: Array | None,
    ) -> None:
        self.system = checked_system(system, state)
        self.tree, self.parts = tree, parts
        self.state, self.info, self.control = state, info, control
        self.snapshot = self.system.snapshot(state.q, state.v, state.instant)
        (self.group,) = self.system.layout.groups  # all links are rigid bodies in space
        self.names = ("", *self.group.names)

    def index(self, links: tuple[str, ...]) -> np.ndarray:
        """Returns the index of links in the arrays by name; 0 for the world."""
        return np.array([self.names.index(x) if x in self.names else 0 for x in links], int)

    @cached_property
    def centers(self) -> Frames:
        """The motion of the principal frames of all links; the world comes first."""
        q, v = (jnp.stack(list(x), axis=1) for x in self.group.unpack(self.state.q, self.state.v))
        still = jnp.zeros((1, 3), q.dtype)
        upright = jnp.eye(4, dtype=q.dtype)[:1]
        orientation = jnp.concatenate([upright, q[:, 3:]])
        rotation = jax.vmap(quaternion.matrix)(orientation)
        spin = jnp.concatenate([still, v[:, 3:]])
        return Frames(
            jnp.concatenate([still, q[:, :3]]),
            orientation,
            rotation,
            jnp.concatenate([still, v[:, :3]]),
            _turned(rotation, spin),
        )

    @cached_property
    def offsets(self) -> tuple[Array, Array]:
        """The link frames in the principal frames: positions (n, 3) and quaternions (n, 4)."""
        zero, upright = jnp.zeros(3, self.state.q.dtype), jnp.eye(4, dtype=self.state.q.dtype)[0]
        given = [self.system.offsets.get(name) for name in self.names]
        return (
            jnp.stack([zero if x is None else x.position for x in given]),
            jnp.stack([upright if x is None else x.orientation for x in given]),
        )

    def arms(self, links: tuple[str, ...], points: Array) -> tuple[Array, np.ndarray]:
        """Returns points of link frames relative to the centers of mass, world frame, (n, 3)."""
        at = self.index(links)
        position, turn = (x[at] for x in self.offsets)
        local = position + _turned(jax.vmap(quaternion.matrix)(turn), points)
        return _turned(self.centers.rotation[at], local), at

    def frames(self, objects: Objects) -> Frames:
        """Returns the motion of frames in the world."""
        arm, at = self.arms(objects.links, objects.position)
        position, orientation, _, velocity, spin = (x[at] for x in self.centers)
        multiply = jax.vmap(quaternion.multiply)
        turn = multiply(multiply(orientation, self.offsets[1][at]), objects.orientation)
        velocity = velocity + jnp.cross(spin, arm)
        return Frames(position + arm, turn, jax.vmap(quaternion.matrix)(turn), velocity, spin)

    @cached_property
    def accelerations(self) -> tuple[Array, Array]:
        """Accelerations of centers of mass less gravity, and angular ones, world frame (n, 3)."""
        a = self.group.unpack(self.state.q, self.info.acceleration)[1]
        a = jnp.stack(list(a), axis=1)
        still = jnp.zeros((1, 3), a.dtype)
        linear = jnp.concatenate([still, a[:, :3]]) - self.system.gravity[None]
        turning = jnp.concatenate([still, a[:, 3:]])
        return linear, _turned(self.centers.rotation, turning)

    def acceleration(self, objects: Objects) -> tuple[Array, Array]:
        """Returns accelerations of frames less gravity, and angular ones, world frame (n, 3)."""
        arm, at = self.arms(objects.links, objects.position)
        linear, turning = (x[at] for x in self.accelerations)
        spin = self.centers.spin[at]
        swing = jnp.cross(spin, jnp.cross(spin, arm))
        return linear + jnp.cross(turning, arm) + swing, turning

    @cached_property
    def solids(self) -> Solids:
        """The links, followed by the bodies of `parts`."""
        (inertia,) = self.system.inertia
        position, _, rotation, velocity, spin = (x[1:] for x in self.centers)
        arm, at = self.arms(self.parts.links, self.parts.center)
        turning = self.centers.spin[at]
        return Solids(
            jnp.concatenate([inertia.mass, self.parts.mass]),
            jnp.concatenate([position, self.centers.position[at] + arm]),
            jnp.concatenate([velocity, self.centers.velocity[at] + jnp.cross(turning, arm)]),
            jnp.concatenate([_turned(self.tensors[0], spin), _turned(self.tensors[1], turning)]),
        )

    @property
    def fixed_moment(self) -> Array:
        """The sum Σ m c over the bodies that do not move, (3,) [kg m]; c are centers of mass."""
        fixed = np.flatnonzero(self.index(self.parts.links) == 0)
        return self.parts.mass[fixed] @ self.parts.center[fixed]

    @cached_property
    def tensors(self) -> tuple[Array, Array]:
        """The inertia tensors of links and of parts in the world frame, (n, 3, 3), (k, 3, 3)."""
        (inertia,) = self.system.inertia
        moments = jnp.stack(list(inertia.moments), axis=1)
        rotation = self.centers.rotation[1:]
        of_links = (rotation * moments[:, None]) @ jnp.swapaxes(rotation, 1, 2)
        at = self.index(self.parts.links)
        turned = self.centers.rotation[at] @ jax.vmap(quaternion.matrix)(self.offsets[1][at])
        return of_links, turned @ self.parts.inertia @ jnp.swapaxes(turned, 1, 2)

    @cached_property
    def loads(self) -> Wrenches:
        """The wrenches that accelerate the `solids` against gravity, about their centers of mass.

        F = m (a − g) and τ = I α + ω × I ω.
        """
        linear, turning = self.accelerations
        arm, at = self.arms(self.parts.links, self.parts.center)
        spin = self.centers.spin
        of_parts = linear[at] + jnp.cross(turning[at], arm)
        of_parts = of_parts + jnp.cross(spin[at], jnp.cross(spin[at], arm))
        acceleration = jnp.concatenate([linear[1:], of_parts])
        change = [
            _turned(tensor, x)
            for tensor, x in zip(self.tensors, (turning[1:], turning[at]), strict=True)
        ]
        every = jnp.concatenate([spin[1:], spin[at]])
        torque = jnp.concatenate(change) + jnp.cross(every, self.solids.momentum)
        force = self.solids.mass[:, None] * acceleration
        return Wrenches(self.solids.position, force, torque)

    def external(self, kind: str, index: int, side: int) -> Wrenches:
        """Returns the wrenches of contacts or equalities on one side, about centers of mass.

        Args:
            kind: "bounds" or "constraints", the field of the system with the group of elements.
            index: the index of the group in the field.
            side: 0 for the first bodies and 1 for the second bodies, which must not be the world.
        """
        group = getattr(self.system, kind)[index]
        if kind == "bounds":
            rows = group.bounds(self.snapshot, self.control, self.once)
            pulls = inequality_pulls(group, rows, self.info.reactions)
        else:
            layout = self.info.violation.layout
            pulls = equality_pulls(self.snapshot, group, layout, self.info.multipliers)
        place, pull = pulls[sum(p.group is not None for p in group.places[:side])]
        at = np.array(place.indices) + 1
        count = (len(at),)
        lanes = [jnp.broadcast_to(jnp.asarray(x, self.state.q.dtype), count) for x in pull]
        force, torque = jnp.stack(lanes[:3], axis=1), jnp.stack(lanes[3:], axis=1)
        rotation = self.centers.rotation[at]
        return Wrenches(self.centers.position[at], force, _turned(rotation, torque))

    @property
    def once(self) -> Array:
        """A step size: any value, as directions of forces do not depend on it."""
        return jnp.ones_like(self.state.time)

    @cached_property
    def actuators(self) -> dict[str, tuple[Array, Array, Array, Array]]:
        """Coordinate θ, rate θ̇, force along l = g θ and gear g of each actuator, by element name.

        The force of a `Motor` is its control input.
        """
        found = {}
        for group in self.system.forces:
            if not isinstance(group, JointForces) or not group.starts:
                continue
            row = group.coordinate.read(self.snapshot)
            gear = jnp.asarray(group.params.get("gear", 1.0), self.state.q.dtype)
            # at the coordinate l = g θ the gear is one; a division by g fails for g = 0
            direct = dataclasses.replace(group, params={**group.params, "gear": 1.0})
            geared = row._replace(value=gear * row.value, rate=gear * row.rate)
            force = direct.along(geared, self.control)
            numbers = row.value, row.rate, force, gear
            lanes = [jnp.broadcast_to(x, (len(group.names),)) for x in numbers]
            found |= {name: tuple(x[i] for x in lanes) for i, name in enumerate(group.names)}
        return found

    @cached_property
    def tendons(self) -> dict[str, tuple[Array, Array]]:
        """The change of length since assembly and its rate, of each tendon by name."""
        found = {}
        for group in self.system.constraints:
            if isinstance(group, Tendons):
                row = group.coordinate_rows(self.snapshot, "length")["length"]
                value, rate = jnp.asarray(row.value), jnp.asarray(row.rate)
                found |= {name: (value[i], rate[i]) for i, name in enumerate(group.names)}
        return found

    @cached_property
    def actuator_force(self) -> Array:
        """MuJoCo's qfrc_actuator, (nv,): the forces of all actuators along the joints."""
        force = jnp.zeros_like(self.state.v)
        for group in self.system.forces:
            if isinstance(group, JointForces) and group.starts:
                for place, pull in group.pulls(self.snapshot, self.control):
                    if place.group is None:
                        continue
                    at = self.system.columns(place).index()
                    for rows, x in zip(at, pull, strict=True):
                        force = force.at[rows].add(x)
        qpos, qvel = self.coordinates

        def velocities(qvel: Array) -> Array:
            """Returns the velocities v of the system, which are linear in qvel."""
            return self.tree.flat(self.system, qpos, qvel)[1]

        return jax.vjp(velocities, qvel)[1](force)[0]

    @cached_property
    def coordinates(self) -> tuple[Array, Array]:
        """MuJoCo's qpos and qvel."""
        return self.tree.read(self.system, self.state)

    @cached_property
    def limits(self) -> dict[str, tuple[Array, Array, Array]]:
        """Gap, rate and force of each limit by name; gap and rate of the nearer stop."""
        found = {}
        for group in self.system.bounds:
            if not isinstance(group, Bounds) or group.law.law != "single":
                continue
            row = group.bounds(self.snapshot, self.control, self.once).rows[0]
            gap, rate = jnp.asarray(row.value), jnp.asarray(row.rate)
            for i, name in enumerate(group.names):
                force = jnp.zeros_like(self.state.time)
                if self.info is not None:
                    force = self.info.reactions[name][0]
                found[name] = gap[i], rate[i], force
        return found

    def contacts(self) -> list[tuple[Contacts, Array, list[Array], Array]]:
        """Returns the groups of contacts with their points, directions and normal forces.

        Returns:
            For each group, the group; the points (n, 3) [m]; for each side, the direction of the
            normal force on it (n, 3), zeros for the world; and the normal forces (n,) [N]. If an
            element has several points, they lie side by side.
        """
        result = []
        for group in self.system.bounds:
            if not isinstance(group, Contacts):
                continue
            rows = group.bounds(self.snapshot, self.control, self.once)
            if rows.place is None:  # a rope
                continue
            each = len(rows.rows) + len(rows.rolls) + len(rows.spins)
            layout = self.info.reactions.layout
            numbers = np.concatenate([np.ravel(layout.rows(name)) for name in group.names])
            force = self.info.reactions.multipliers[numbers.reshape(-1, each)[:, 0]]
            place = jnp.stack(list(rows.place), axis=1)
            sides = []
            for where, pull in zip(rows.places, rows.rows[0].pulls, strict=True):
                fixed = where.group is None
                sides.append(jnp.zeros_like(place) if fixed else jnp.stack(list(pull[:3]), axis=1))
            result.append((group, place, sides, force))
        return result


def _turned(rotation: Array, x: Array) -> Array:
    """Returns R x for matrices R (n, 3, 3) and vectors x (n, 3)."""
    return jnp.sum(rotation * x[:, None, :], axis=2)
