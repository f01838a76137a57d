"""Force elements: springs, constant and user forces, wrenches as control.

Each class describes one element for the user; its static methods say what many of them do, lane by
lane, and are what the step traces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions, numerics
from jaxcon.core.lanes import Vector, times, zeros
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane, PyTree
from jaxcon.core.worlds import per_world
from jaxcon.geometry.pose import Pose
from jaxcon.model.elements import Elements, own_point
from jaxcon.model.layout import Place

Pulls = Iterable[tuple[Place, Vector]]


@pytree
class ForceElements(Elements):
    """Force elements of one class, `law`."""

    law: Any = static(default=None)

    def pulls(self, snapshot: Any, control: Any) -> Pulls:
        """The generalized forces on the bodies of each side."""
        forces = self.law.forces(self.params, *self.frames(snapshot))
        return zip(self.places, forces, strict=True)

    def potential(self, snapshot: Any) -> Iterable[Lane]:
        """The energy stored in each element [J]."""
        return (self.law.potential(self.params, *self.frames(snapshot)),)


@dataclass(frozen=True)
class Spring:
    """A spring and damper between two points: tension T = k (‖d‖ − l) + c d‖d‖/dt.

    The force on the second point is (k l − c d‖d‖/dt) n − k d with n = d/‖d‖: smooth at d = 0 where
    l = 0, and there n, which has no direction, counts as zero.

    Attributes:
        name: unique in the scene.
        body_a, body_b: names, or `WORLD`.
        stiffness: k [N/m].
        damping: c [N s/m].
        rest_length: l [m]; the distance at assembly unless given.
        point_a, point_b: world points at assembly, (dim,) [m]; the centres of mass unless given.
    """

    name: str
    body_a: str
    body_b: str
    stiffness: Any
    damping: Any = 0.0
    rest_length: Any = None
    point_a: Any = None
    point_b: Any = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies it acts on."""
        return (self.body_a, self.body_b)

    def attach(self, a: Pose, b: Pose) -> dict[str, Array]:
        """The numbers of the element, anchors in the frames of the bodies at assembly."""
        dtype = a.position.dtype
        start = own_point(self, "point_a", self.point_a, a)
        end = own_point(self, "point_b", self.point_b, b)
        owner = f"spring '{self.name}'"
        length = numerics.norm(end - start) if self.rest_length is None else self.rest_length
        return {
            "anchor_a": a.local_point(start),
            "anchor_b": b.local_point(end),
            "stiffness": checks.real(owner, "stiffness", self.stiffness, dtype, least=0),
            "damping": checks.real(owner, "damping", self.damping, dtype, least=0),
            "rest_length": checks.real(owner, "rest_length", length, dtype, least=0),
        }

    @staticmethod
    def forces(p: dict[str, Any], a: Any, b: Any) -> tuple[Vector, Vector]:
        """−T d/‖d‖ at the second point and its opposite at the first."""
        start, end = a.point(p["anchor_a"]), b.point(p["anchor_b"])
        d = end.position - start.position
        length = numerics.norm(d)
        direction = d * numerics.safe_divide(1.0, length)
        speed = direction.dot(end.velocity - start.velocity)
        slack = p["stiffness"] * p["rest_length"] - p["damping"] * speed
        force = direction * slack - d * p["stiffness"]
        return start.pull(-force), end.pull(force)

    @staticmethod
    def potential(p: dict[str, Any], a: Any, b: Any) -> Lane:
        """½ k (‖d‖ − l)², expanded where l = 0, so that its curvature at d = 0 is right."""
        d = b.point(p["anchor_b"]).position - a.point(p["anchor_a"]).position
        length = p["rest_length"]
        span = numerics.norm(d)
        expanded = d.dot(d) - 2 * length * span + length**2
        return p["stiffness"] * jnp.where(length == 0, expanded, (span - length) ** 2) / 2


@dataclass(frozen=True)
class Force:
    """A constant force, fixed in the world frame, at a point of a body.

    Attributes:
        name: unique in the scene.
        body: its name.
        force: (dim,) [N].
        point: world point at assembly, (dim,) [m]; the centre of mass unless given.
    """

    name: str
    body: str
    force: Any
    point: Any = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The name of the body it acts on."""
        return (self.body,)

    def attach(self, a: Pose) -> dict[str, Array]:
        """The numbers of the element."""
        dtype, shape = a.position.dtype, a.position.shape
        start = own_point(self, "point", self.point, a)
        force = checks.real(f"force '{self.name}'", "force", self.force, dtype, shape)
        return {"anchor": a.local_point(start), "force": force}

    @staticmethod
    def forces(p: dict[str, Any], a: Any) -> tuple[Vector]:
        """The force at the point."""
        return (a.point(p["anchor"]).pull(Vector.of(p["force"])),)

    @staticmethod
    def potential(p: dict[str, Any], a: Any) -> Lane:
        """−F · p."""
        return times(-1, a.point(p["anchor"]).position.dot(Vector.of(p["force"])))


@dataclass(frozen=True)
class ExternalWrench:
    """A wrench on a body as control: (F, τ) in the world frame, at a point of the body.

    Its channel in the control array has dim entries for a particle, 3 in the plane (F_x, F_y, τ)
    and 6 in space; `system.layout.control(name)` is its slice.

    Attributes:
        name: unique in the scene; also that of the control channel.
        body: name of the body.
        point: where the force acts, world point at assembly, (dim,) [m]; the centre of
            mass unless given.
    """

    name: str
    body: str
    point: Any = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The name of the body it acts on."""
        return (self.body,)

    def attach(self, a: Pose) -> dict[str, Array]:
        """The numbers of the element."""
        return {"anchor": a.local_point(own_point(self, "point", self.point, a))}


@pytree
class ExternalWrenches(Elements):
    """Wrenches whose first control inputs lie at `starts`."""

    starts: tuple[int, ...] = static(default=())

    def pulls(self, snapshot: Any, control: Any) -> Pulls:
        """The generalized forces on the bodies; none where there is no control."""
        if control is None:
            return []
        (frame,) = self.frames(snapshot)
        n = snapshot.system.layout.groups[self.places[0].group].kind.n_v
        wrench = Vector(*(control[np.asarray(self.starts) + i] for i in range(n)))
        return [(self.places[0], world_wrench(frame, self.params["anchor"], wrench))]

    def potential(self, snapshot: Any) -> Iterable[Lane]:
        """None."""
        return ()


@dataclass(frozen=True)
class CustomForce:
    """A user's force on named bodies: `function(*motions, t, control, params)` → wrenches.

    The function gets the `Motion` of each body and returns one wrench for each (a tuple where there
    are several): the force, then the torque about the body's position, world frame: (dim,) for a
    particle, (3,) in the plane, (6,) in space.

    Attributes:
        name: unique in the scene; also that of the control channel, if there is one.
        bodies: their names.
        function: pure, hashable; define it once, since every new function object is a new trace.
        params: any pytree of arrays.
        controls: number of control inputs; the function gets them as (controls,), or None.
    """

    name: str
    bodies: tuple[str, ...]
    function: Callable[..., Any]
    params: PyTree = None
    controls: int = 0


@pytree
class CustomForces(Elements):
    """One user's force; `params` are the user's own."""

    function: Any = static(default=None)
    channel: tuple[int, int] = static(default=(0, 0))
    bodies: tuple[str, ...] = static(default=())

    def get(self, i: int) -> Any:
        """The user's parameters."""
        return {"params": self.params}

    def set(self, changes: Any) -> CustomForces:
        """With other parameters."""
        new = changes.get(self.names[0], {}).get("params", self.params)
        return CustomForces(new, self.names, self.places, self.function, self.channel, self.bodies)

    def pulls(self, snapshot: Any, control: Any) -> Pulls:
        """The generalized forces on the bodies."""
        rank = snapshot.q.ndim - 1
        start, stop = self.channel
        own = control[start:stop] if control is not None and stop > start else None
        given = (snapshot.system, self.params, snapshot.q, snapshot.v, snapshot.t, own)
        wrenches = per_world(self._wrenches, rank)(*given)
        for place, wrench, name in zip(self.places, wrenches, self.bodies, strict=True):
            if place.group is None:  # the world takes up any force
                continue
            frame = snapshot.frame(place)
            n = snapshot.system.columns(place).components
            if wrench.shape[: wrench.ndim - rank] != (n,):
                raise ValueError(
                    f"force '{self.names[0]}': the wrench on '{name}' must have shape ({n},),"
                    f" got {wrench.shape[: wrench.ndim - rank]}."
                )
            lanes = Vector(*(x[None] for x in wrench))
            offset = snapshot.system.offsets.get(name)
            anchor = None if offset is None else Vector(*(x[None] for x in offset.position))
            yield place, world_wrench(frame, anchor, lanes)

    def _wrenches(self, system: Any, params: PyTree, q: Any, v: Any, t: Any, own: Any) -> Any:
        """The user's wrenches in one world."""
        motions = [system.motion(name, q, v) for name in self.bodies]
        owner = f"CustomForce '{self.names[0]}'"
        wrenches = functions.call(owner, "function", self.function, *motions, t, own, params)
        wrenches = wrenches if isinstance(wrenches, tuple) else (wrenches,)
        return tuple(functions.array(owner, "function", wrench) for wrench in wrenches)

    def potential(self, snapshot: Any) -> Iterable[Lane]:
        """None."""
        return ()


def world_wrench(frame: Any, anchor: Any, wrench: Vector) -> Vector:
    """The generalized force of (F, τ) in the world frame, F at an anchor (the origin if None)."""
    dim = len(frame.position)
    force, torque = Vector(*wrench[:dim]), wrench[dim:]
    pull = frame.point(zeros(dim) if anchor is None else anchor).pull(force)
    if not torque:
        return pull
    local = torque[0] if dim == 2 else frame.rotation.T @ Vector(*torque)
    return pull + frame.turn(local)
