"""Drag of a body in a fluid at rest or in a wind, by the box model of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.lanes import Vector, total
from jaxcon.core.typing import Array, Lane
from jaxcon.geometry import quaternion
from jaxcon.geometry.pose import Pose
from jaxcon.system.elements import label, own_point
from jaxcon.system.forces import ForceElement
from jaxcon.system.frames import SpatialFrame


@dataclass(frozen=True)
class FluidDrag(ForceElement):
    """The drag of a fluid on a box that is fixed in a body, in space.

    With edges bᵢ, the mean edge d = (b₁ + b₂ + b₃)/3, density ρ and viscosity η, and components
    along the edges of the velocity v of the center relative to the fluid and of the angular
    velocity ω of the body:

        Fᵢ = −3π η d vᵢ − ½ ρ bⱼ bₖ |vᵢ| vᵢ
        τᵢ = −π η d³ ωᵢ − ρ bᵢ (bⱼ⁴ + bₖ⁴) |ωᵢ| ωᵢ / 64

    Attributes:
        name: name of the element, unique in the scene.
        body: name of the body.
        size: bᵢ, (3,) [m].
        density: ρ [kg/m³].
        viscosity: η [Pa s].
        wind: velocity of the fluid, world frame, (3,) [m/s].
        point: the center of the box, world frame at assembly, (3,) [m]; the center of mass unless
            given.
        orientation: the orientation of the box, quaternion in the world frame at assembly, (4,);
            that of the body's principal axes unless given.

    References:
        MuJoCo documentation, Computation, Fluid forces: inertia model.
    """

    name: str
    body: str
    size: Any
    density: Any = 0.0
    viscosity: Any = 0.0
    wind: Any = (0.0, 0.0, 0.0)
    point: Any = None
    orientation: Any = None
    dims = (3,)
    oriented = True
    ranges = MappingProxyType(dict.fromkeys(("density", "viscosity"), checks.NumberRange(least=0)))

    @property
    def bodies(self) -> tuple[str, ...]:
        """The name of the body on which the fluid acts."""
        return (self.body,)

    def attach(self, a: Pose) -> dict[str, Array]:
        """Returns the numbers of the element, with center and axes of the box in the body frame.

        Raises:
            ValueError: a number is out of range.
        """
        owner, dtype = label(self), a.position.dtype
        turn = a.orientation
        if self.orientation is not None:
            turn = checks.real(owner, "orientation", self.orientation, dtype, (4,))
        axes = quaternion.matrix(quaternion.normalize(turn)).T
        fields = ("first", "second", "axis")
        return {
            "anchor": a.local_point(own_point(self, "point", self.point, a)),
            "size": checks.real(owner, "size", self.size, dtype, (3,), least=0),
            "density": checks.real(owner, "density", self.density, dtype),
            "viscosity": checks.real(owner, "viscosity", self.viscosity, dtype),
            "wind": checks.real(owner, "wind", self.wind, dtype, (3,)),
            **{field: a.local_direction(u) for field, u in zip(fields, axes, strict=True)},
        }

    @staticmethod
    def forces(p: dict[str, Any], a: SpatialFrame) -> tuple[Vector]:
        """Returns the generalized force of the drag on each body."""
        point = a.point(p["anchor"])
        axes = [a.rotation @ Vector.of(p[field]) for field in ("first", "second", "axis")]
        speed = point.velocity - Vector.of(p["wind"])
        mean, density, viscosity = total(p["size"]) / 3, p["density"], p["viscosity"]
        forces, torques = [], []
        for i, u in enumerate(axes):
            b, c, d = (p["size"][(i + k) % 3] for k in range(3))
            v, ω = u.dot(speed), u.dot(a.spin)
            forces.append(-3 * jnp.pi * viscosity * mean * v - density * c * d * abs(v) * v / 2)
            blades = density * b * (c**4 + d**4) * abs(ω) * ω / 64
            torques.append(-jnp.pi * viscosity * mean**3 * ω - blades)
        force, torque = (
            Vector(*(total(x * u[k] for x, u in zip(along, axes, strict=True)) for k in range(3)))
            for along in (forces, torques)
        )
        return (point.pull(force) + a.torque(torque),)

    @staticmethod
    def potential(p: dict[str, Any], a: SpatialFrame) -> Lane:
        """Returns zero: drag stores no energy."""
        return 0 * p["density"]
