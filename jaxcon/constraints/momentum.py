"""Prescribed momentum: rows on velocities that touch every body they name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.base import RowSet
from jaxcon.core import checks
from jaxcon.core.lanes import Vector, axes, plus, total
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.model.elements import Elements, label
from jaxcon.model.layout import Place
from jaxcon.model.momentum import Part, momentum_of, parts_of, torque_bias, torque_pulls


@dataclass(frozen=True)
class AngularMomentum:
    """The angular momentum of bodies about their common centre of mass is given: L(q, v) = L*.

    1 row in the plane, 3 in space, on velocities. Inner forces do not change L, so that λ is zero
    where no outer torque acts; elsewhere it is what holds L. Under feedback an error decays as
    that of `VelocityLevel` does.

        L = Σ m (x − c) × ẋ + R I ω,    L̇ = Σ m (x − c) × ẍ + R (I ω̇ + ω × I ω)

    Attributes:
        name: unique in the scene.
        bodies: a tuple of names; all that move unless given.
        value: L*, () in the plane, (3,) in space, world frame [kg m²/s]; zero unless given.
    """

    name: str
    bodies: tuple[str, ...] | None = None
    value: Any = None

    def attach(self, dim: int, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return {"value": _number(self, () if dim == 2 else (3,), dtype)}

    @staticmethod
    def amount(snapshot: Any, places: tuple[Place, ...]) -> tuple[Any, ...]:
        """L by components."""
        found = momentum_of(snapshot, places).angular
        return tuple(found) if isinstance(found, Vector) else (found,)

    @staticmethod
    def pulls(snapshot: Any, places: tuple[Place, ...], part: Part) -> list[Vector]:
        """∂L/∂v on each body of a part."""
        return torque_pulls(part, momentum_of(snapshot, places).position)

    @staticmethod
    def bias(parts: list[Part]) -> Any:
        """R (ω × I ω), summed; None where there is none."""
        terms = [torque_bias(part) for part in parts]
        sums = [[jnp.sum(x, axis=0, keepdims=True) for x in t] for t in terms if t is not None]
        return [total(x) for x in zip(*sums, strict=True)] or None


@dataclass(frozen=True)
class LinearMomentum:
    """The linear momentum of bodies is given: Σ m ẋ = P*, as many rows as dimensions.

    Attributes:
        name: unique in the scene.
        bodies: a tuple of names; all that move unless given.
        value: P*, (dim,), world frame [kg m/s]; zero unless given.
    """

    name: str
    bodies: tuple[str, ...] | None = None
    value: Any = None

    def attach(self, dim: int, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return {"value": _number(self, (dim,), dtype)}

    @staticmethod
    def amount(snapshot: Any, places: tuple[Place, ...]) -> tuple[Any, ...]:
        """P by components."""
        return tuple(momentum_of(snapshot, places).linear)

    @staticmethod
    def pulls(snapshot: Any, places: tuple[Place, ...], part: Part) -> list[Vector]:
        """∂P/∂v on each body of a part: m along each axis."""
        dim = len(part.frame.position)
        idle = (0.0,) * (0 if part.moments is None else 2 * dim - 3)
        return [Vector(*(n * part.mass), *idle) for n in axes(dim)]

    @staticmethod
    def bias(parts: list[Part]) -> Any:
        """None."""
        return None


@pytree
class Momenta(Elements):
    """One prescribed momentum, `law`; `places` are of one body each."""

    law: Any = static(default=None)

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """None: it acts at each body's centre of mass."""
        return None

    def rows(self, snapshot: Any) -> RowSet:
        """ψ = L − L* or P − P*, J and γ at one instant."""
        value = self.params["value"]
        wanted = tuple(value) if isinstance(value, Vector) else (value,)
        amount = self.law.amount(snapshot, self.places)
        parts = parts_of(snapshot, self.places)
        jacobian = []
        for part in parts:
            rows = self.law.pulls(snapshot, self.places, part)
            for k, index in enumerate(part.place.indices):
                own = tuple(row.map(lambda x, k=k: _element(x, k)) for row in rows)
                columns = snapshot.system.columns(Place(part.place.group, (index,)))
                jacobian.append((columns, own))
        rates = tuple(plus(x, -y) for x, y in zip(amount, wanted, strict=True))
        none = (0.0,) * len(rates)
        bias = self.law.bias(parts)
        bias = none if bias is None else tuple(bias)
        return RowSet(none, rates, bias, tuple(jacobian), (False,) * len(rates))


def _element(x: Any, k: int) -> Any:
    """One element of a lane, as a lane of one element; a number is the same for each."""
    return jax.lax.slice_in_dim(x, k, k + 1) if isinstance(x, jax.Array) else x


def _number(element: Any, shape: tuple[int, ...], dtype: Any) -> Array:
    owner = label(element)
    value = jnp.zeros(shape, dtype) if element.value is None else element.value
    return checks.real(owner, "value", value, dtype, shape)
