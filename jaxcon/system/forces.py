"""Force elements: springs, constant and user forces, wrenches as control.

Each class describes one element for the user. Its static methods compute the forces and energies of
many elements at once, as lanes (element, …); the step traces them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions, numerics
from jaxcon.core.lanes import Vector, times, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane, PyTree
from jaxcon.geometry.pose import Pose
from jaxcon.staging.worlds import per_world
from jaxcon.system.elements import (
    BetweenBodies,
    Element,
    Elements,
    UserElement,
    label,
    own_point,
)
from jaxcon.system.frames import BodyFrame
from jaxcon.system.layout import Place

if TYPE_CHECKING:
    from jaxcon.system.body_system import BodySystem, Snapshot

Pulls = Iterable[tuple[Place, Vector]]
"""Generalized forces, each with the bodies on which it acts."""


class ForceElement(BetweenBodies):
    """The base class of force elements on the bodies in `bodies`, by default two."""


@pytree
class ForceElements(Elements):
    """A group of force elements of one class on bodies of the same kinds."""

    def pulls(self, snapshot: Snapshot, control: Array | None) -> Pulls:
        """Returns the generalized forces on the bodies of each side."""
        forces = self.law.forces(self.params, *self.frames(snapshot))
        return zip(self.places, forces, strict=True)

    def potential(self, snapshot: Snapshot) -> Iterable[Lane]:
        """Returns the energy stored in each element [J]."""
        return (self.law.potential(self.params, *self.frames(snapshot)),)


@dataclass(frozen=True)
class Spring(ForceElement):
    """A spring and damper between two points: tension T = k (‖d‖ − l) + c d‖d‖/dt.

    d is the vector from the first to the second point. The force on the second point is (k l − c
    d‖d‖/dt) n − k d, with the direction n = d/‖d‖, or n = 0 at d = 0. The force is smooth at d = 0
    if l = 0.

    Attributes:
        name: name of the element, unique in the scene.
        body_a, body_b: names of the bodies, or `WORLD`.
        stiffness: k [N/m].
        damping: c [N s/m].
        rest_length: l [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (dim,) [m]; the centers of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    stiffness: Any
    damping: Any = 0.0
    rest_length: Any = None
    point_a: Any = None
    point_b: Any = None
    ranges = MappingProxyType(
        dict.fromkeys(("stiffness", "damping", "rest_length"), checks.NumberRange(least=0))
    )

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """Returns the numbers of the element, with anchors in body frames."""
        dtype = a.position.dtype
        start = own_point(self, "point_a", self.point_a, a)
        end = own_point(self, "point_b", self.point_b, b)
        owner = label(self)
        length = numerics.norm(end - start) if self.rest_length is None else self.rest_length
        return {
            "anchor_a": a.local_point(start),
            "anchor_b": b.local_point(end),
            "stiffness": checks.real(owner, "stiffness", self.stiffness, dtype),
            "damping": checks.real(owner, "damping", self.damping, dtype),
            "rest_length": checks.real(owner, "rest_length", length, dtype),
        }

    @staticmethod
    def forces(p: dict[str, Any], a: BodyFrame, b: BodyFrame) -> tuple[Vector, Vector]:
        """Returns the generalized forces on both bodies: tension T towards the other end point."""
        start, end = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        d = end.position - start.position
        length = numerics.norm(d)
        direction = d * numerics.safe_divide(1.0, length)
        speed = direction.dot(end.velocity - start.velocity)
        slack = p["stiffness"] * p["rest_length"] - p["damping"] * speed
        force = direction * slack - d * p["stiffness"]
        return start.pull(-force), end.pull(force)

    @staticmethod
    def potential(p: dict[str, Any], a: BodyFrame, b: BodyFrame) -> Lane:
        """Returns the energy ½ k (‖d‖ − l)² [J], with the vector d between the end points."""
        # if l = 0 use d·d, since the square of norm(d) has a wrong second derivative at d = 0
        d = b.point(p["anchor_b"]).position - a.point(p["anchor_a"]).position
        length = p["rest_length"]
        span = numerics.norm(d)
        expanded = d.dot(d) - 2 * length * span + length**2
        return p["stiffness"] * jnp.where(length == 0, expanded, (span - length) ** 2) / 2


@dataclass(frozen=True)
class Force(ForceElement):
    """A constant force, fixed in the world frame, at a point of a body.

    Attributes:
        name: name of the element, unique in the scene.
        body: name of the body.
        force: the force, (dim,) [N].
        point: world point at assembly, (dim,) [m]; the center of mass unless given.
    """

    name: str
    body: str
    force: Any
    point: Any = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The name of the body on which the force acts."""
        return (self.body,)

    def attach(self, a: Pose) -> dict[str, Array]:
        """Returns the numbers of the element, with the anchor in the body frame."""
        dtype, shape = a.position.dtype, a.position.shape
        anchor = a.local_point(own_point(self, "point", self.point, a))
        force = checks.real(f"force '{self.name}'", "force", self.force, dtype, shape)
        return {"anchor": anchor, "force": force}

    @staticmethod
    def forces(p: dict[str, Any], a: BodyFrame) -> tuple[Vector]:
        """Returns the generalized force of the force F at its point of application."""
        return (a.point(p["anchor"]).pull(Vector.of(p["force"])),)

    @staticmethod
    def potential(p: dict[str, Any], a: BodyFrame) -> Lane:
        """Returns the potential energy −F · p [J] of the force F at its point of application p."""
        return times(-1, a.point(p["anchor"]).position.dot(Vector.of(p["force"])))


@dataclass(frozen=True)
class ExternalWrench(Element):
    """A wrench (F, τ) on a body as a control input, in the world frame at a point of the body.

    Its channel in the control array has dim entries for a particle, 3 in the plane (F_x, F_y, τ)
    and 6 in space; `system.layout.control(name)` is its slice.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel.
        body: name of the body.
        point: the point of application, world frame at assembly, (dim,) [m]; the center of mass
            unless given.
    """

    name: str
    body: str
    point: Any = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The name of the body on which the wrench acts."""
        return (self.body,)

    def attach(self, a: Pose) -> dict[str, Array]:
        """Returns the numbers of the element, with the anchor in the body frame."""
        return {"anchor": a.local_point(own_point(self, "point", self.point, a))}


@pytree
class ExternalWrenches(Elements):
    """`ExternalWrench` elements on bodies of one kind.

    Attributes:
        starts: the index of the first control input of each element.
    """

    starts: tuple[int, ...] = static(default=())

    def pulls(self, snapshot: Snapshot, control: Array | None) -> Pulls:
        """Returns the generalized forces on the bodies; none if the control is None."""
        if control is None:
            return []
        (frame,) = self.frames(snapshot)
        n = snapshot.system.layout.groups[self.places[0].group].kind.n_v
        wrench = Vector(*(control[np.asarray(self.starts) + i] for i in range(n)))
        return [(self.places[0], world_wrench(frame, self.params["anchor"], wrench))]


@dataclass(frozen=True)
class CustomForce(Element):
    """A user's force on named bodies: `function(*motions, t, control, params)` → wrenches.

    The function gets the `Motion` of each body and returns one wrench for each body, as a tuple if
    there are several. A wrench is the force, then the torque about the body's position, in the
    world frame: (dim,) for a particle, (3,) in the plane, (6,) in space.

    Attributes:
        name: name of the element, unique in the scene; also the name of the control channel, if
            there is one.
        bodies: names of the bodies.
        function: the user's function, pure and hashable; define it once, since each new function
            object is traced again.
        params: any pytree of arrays.
        controls: number of control inputs; the function gets them as (controls,), or None.
    """

    name: str
    bodies: tuple[str, ...]
    function: Callable[..., Any]
    params: PyTree = None
    controls: int = 0


@pytree
class CustomForces(UserElement):
    """A `CustomForce` in a system.

    Attributes:
        channel: the first index of its control inputs, and the index after the last.
    """

    channel: tuple[int, int] = static(default=(0, 0))

    def pulls(self, snapshot: Snapshot, control: Array | None) -> Pulls:
        """Returns the generalized forces on the bodies.

        Raises:
            ValueError: a wrench has a wrong shape.
        """
        rank = snapshot.q.ndim - 1
        start, stop = self.channel
        inputs = control[start:stop] if control is not None and stop > start else None
        given = (snapshot.system, self.params, snapshot.q, snapshot.v, snapshot.t, inputs)
        wrenches = per_world(self._wrenches, rank)(*given)
        for place, wrench, name in zip(self.places, wrenches, self.law.bodies, strict=True):
            if place.group is None:  # a force on the world has no effect
                continue
            n, shape = snapshot.system.columns(place).components, wrench.shape
            if shape[: len(shape) - rank] != (n,):
                raise ValueError(
                    f"force '{self.law.name}': the wrench on '{name}' must have shape ({n},),"
                    f" got {shape[: len(shape) - rank]}."
                )
            lanes = Vector(*(x[None] for x in wrench))
            offset = snapshot.system.offsets.get(name)
            anchor = None if offset is None else Vector(*(x[None] for x in offset.position))
            yield place, world_wrench(snapshot.frame(place), anchor, lanes)

    def _wrenches(
        self,
        system: BodySystem,
        params: PyTree,
        q: Array,
        v: Array,
        t: Array,
        inputs: Array | None,
    ) -> tuple[Array, ...]:
        """Calls the user's function in one world; returns the wrenches on the bodies."""
        motions = [system.motion(name, q, v) for name in self.law.bodies]
        owner = f"CustomForce '{self.law.name}'"
        wrenches = functions.call(owner, "function", self.law.function, *motions, t, inputs, params)
        wrenches = wrenches if isinstance(wrenches, tuple) else (wrenches,)
        return tuple(functions.array(owner, "function", wrench) for wrench in wrenches)

    def potential(self, snapshot: Snapshot) -> Iterable[Lane]:
        """Returns an empty tuple: the energy of a user's force is not known."""
        return ()


def world_wrench(frame: BodyFrame, anchor: Vector | None, wrench: Vector) -> Vector:
    """Returns the generalized force of a wrench (F, τ), world frame, whose F acts at an anchor.

    Args:
        frame: the motion of the bodies.
        anchor: the point of application in the body frame [m]; None for the origin.
        wrench: (F, τ) [N, N m].
    """
    dim = len(frame.position)
    force, torque = Vector(*wrench[:dim]), wrench[dim:]
    pull = frame.point(zeros(dim) if anchor is None else anchor).pull(force)
    if not torque:
        return pull
    local = torque[0] if dim == 2 else frame.rotation.T @ Vector(*torque)
    return pull + frame.turn(local)
