"""Constraints that prescribe a momentum: velocity-level rows on several bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.primitives import Row
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, axes, plus, total
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, DType, Lane
from jaxcon.protocols import Constraint
from jaxcon.system.elements import Element, Elements, label
from jaxcon.system.layout import Place
from jaxcon.system.momentum import BodiesOfKind, momentum_of, parts_of, torque_bias, torque_pulls

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class PrescribedMomentum(Element):
    """The base class of constraints on the total momentum of some bodies.

    Attributes:
        name: name of the element, unique in the scene.
        bodies: a tuple of body names; None for all bodies that move.
        value: the prescribed momentum; None for zero.
    """

    name: str
    bodies: tuple[str, ...] | None = None
    value: Any = None

    @staticmethod
    def shape(dim: int) -> tuple[int, ...]:
        """Returns the shape of the momentum in a scene of `dim` dimensions."""
        return (dim,)

    def attach(self, dim: int, dtype: DType) -> dict[str, Array]:
        """Returns the prescribed momentum as a checked array."""
        shape = self.shape(dim)
        value = jnp.zeros(shape, dtype) if self.value is None else self.value
        return {"value": checks.real(label(self), "value", value, dtype, shape)}

    @staticmethod
    def bias(parts: list[BodiesOfKind]) -> list[Lane] | None:
        """Returns the rate of the momentum for zero accelerations; None if it is zero."""
        return None


@dataclass(frozen=True)
class AngularMomentum(PrescribedMomentum):
    """The angular momentum of bodies about their common center of mass is given: L(q, v) = L*.

    The constraint has 1 velocity-level row in the plane and 3 in space. Internal forces do not
    change L, so λ is zero if no external torque acts; otherwise λ is the torque that keeps L. Under
    feedback an error ψ = L − L* decays as ψ̇ = −2α ψ.

        L = Σ m (x − c) × ẋ + R I ω,    L̇ = Σ m (x − c) × ẍ + R (I ω̇ + ω × I ω)

    A body has mass m, inertia I, position x, rotation R and body-frame angular velocity ω. The
    common center of mass is c.

    Attributes:
        name: name of the element, unique in the scene.
        bodies: a tuple of body names; all bodies that move unless given.
        value: L*, () in the plane, (3,) in space, world frame [kg m²/s]; zero unless given.
    """

    @staticmethod
    def shape(dim: int) -> tuple[int, ...]:
        """Returns the shape of L: () in the plane, (3,) in space."""
        return () if dim == 2 else (3,)

    @staticmethod
    def amount(snapshot: Snapshot, places: tuple[Place, ...]) -> tuple[Any, ...]:
        """Returns the components of the angular momentum L about the center of mass, as lanes."""
        angular = momentum_of(snapshot, places).angular
        return tuple(angular) if isinstance(angular, Vector) else (angular,)

    @staticmethod
    def pulls(snapshot: Snapshot, places: tuple[Place, ...], part: BodiesOfKind) -> list[Vector]:
        """Returns ∂L/∂v on each body of one kind, one Vector for each component of L."""
        return torque_pulls(part, momentum_of(snapshot, places).position)

    @staticmethod
    def bias(parts: list[BodiesOfKind]) -> Any:
        """Returns the components of L̇ for zero accelerations, Σ R (ω × I ω); None if zero."""
        terms = [torque_bias(part) for part in parts]
        sums = [[jnp.sum(x, axis=0, keepdims=True) for x in t] for t in terms if t is not None]
        return [total(x) for x in zip(*sums, strict=True)] or None


@dataclass(frozen=True)
class LinearMomentum(PrescribedMomentum):
    """The linear momentum of bodies is given: Σ m ẋ = P*, one row for each dimension.

    Attributes:
        name: name of the element, unique in the scene.
        bodies: a tuple of body names; all bodies that move unless given.
        value: P*, (dim,), world frame [kg m/s]; zero unless given.
    """

    @staticmethod
    def amount(snapshot: Snapshot, places: tuple[Place, ...]) -> tuple[Any, ...]:
        """Returns the components of the linear momentum P, as lanes."""
        return tuple(momentum_of(snapshot, places).linear)

    @staticmethod
    def pulls(snapshot: Snapshot, places: tuple[Place, ...], part: BodiesOfKind) -> list[Vector]:
        """Returns ∂P/∂v on each body of one kind: its mass m along each axis."""
        dim = len(part.frame.position)
        idle = (0.0,) * (0 if part.moments is None else 2 * dim - 3)
        return [Vector(*(n * part.mass), *idle) for n in axes(dim)]


@pytree
class Momenta(Elements, Constraint):
    """A prescribed momentum in a system; each entry of `places` is one body."""

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns the rows ψ = L − L* or ψ = P − P* at one instant, with γ and ∂ψ/∂v by body."""
        value = self.params["value"]
        wanted = tuple(value) if isinstance(value, Vector) else (value,)
        amount = self.law.amount(snapshot, self.places)
        parts = parts_of(snapshot, self.places)
        by_body = {}
        for part in parts:
            rows = self.law.pulls(snapshot, self.places, part)
            for k, index in enumerate(part.place.indices):
                by_body[part.place.group, index] = [row.map(partial(_element, k)) for row in rows]
        pulls = zip(*(by_body[place.group, place.indices[0]] for place in self.places), strict=True)
        rates = (plus(x, -y) for x, y in zip(amount, wanted, strict=True))
        bias = self.law.bias(parts) or (0.0,) * len(wanted)
        lanes = zip(rates, bias, pulls, strict=True)
        return [Row(0.0, ψ, γ, pull, holonomic=False) for ψ, γ, pull in lanes]


def _element(k: int, x: Lane) -> Lane:
    """Returns the lane of element k; a Python number, which all elements share, stays as it is."""
    return jax.lax.slice_in_dim(x, k, k + 1) if isinstance(x, jax.Array) else x
