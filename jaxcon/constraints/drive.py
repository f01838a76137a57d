"""Prescribed motion: a joint's coordinate as a function of time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.base import RowSet, gather
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import per_world
from jaxcon.model.coordinates import JointCoordinate
from jaxcon.model.layout import Place


@dataclass(frozen=True)
class Drive:
    """A joint's coordinate follows a given motion: θ = θ*(t), one row.

    θ is a coordinate of the joint, an angle [rad] or a travel [m], zero at assembly.
    λ is the torque or force that the drive applies. In space angles are compared modulo whole
    turns, so a crank may be driven round and round.

    Attributes:
        name: unique in the scene.
        joint: name of the driven joint.
        motion: `motion(t, params)` → θ* (); pure and hashable, twice differentiable in t.
        params: any pytree of arrays.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    motion: Callable[..., Array]
    params: PyTree = None
    coordinate: str | None = None
    counts = False


@pytree
class Drives:
    """One driven joint coordinate."""

    params: PyTree
    law: Drive = static()
    along: JointCoordinate = static()
    places: tuple[Place, ...] = static()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the constraint."""
        return (self.law.name,)

    def get(self, i: int) -> dict[str, Any]:
        """The parameters of the motion."""
        return {"params": self.params}

    def set(self, changes: Any) -> Drives:
        """With other parameters."""
        new = changes.get(self.law.name, {}).get("params", self.params)
        return dataclasses.replace(self, params=new)

    def rows(self, snapshot: Any) -> RowSet:
        """φ = θ − θ*(t), φ̇ = θ̇ − θ̇*, γ = γ_θ − θ̈*, by two nested derivatives of the motion."""
        row = self.along.read(snapshot)
        motion = per_world(self._motion, snapshot.q.ndim - 1)
        target, rate, bias = (x[None] for x in motion(snapshot.t, self.params))
        error = self.along.difference(snapshot, row, target)
        row = row._replace(value=error, rate=row.rate - rate, bias=row.bias - bias)
        return gather(snapshot, self.places, [row])

    def check(self, dtype: Any) -> None:
        """Calls the motion once, abstractly.

        Raises:
            ValueError: it cannot be called, or returns no number.
        """
        try:
            jax.eval_shape(self._motion, jnp.zeros((), dtype), self.params)
        except TypeError as error:
            raise ValueError(
                f"Drive '{self.law.name}': motion(t, params) cannot be called: {error}."
            ) from error

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """The anchor of the driven joint."""
        (joint,) = self.along.joints
        return snapshot.system.constraints[self.along.group].anchor(snapshot, joint)

    def _motion(self, t: Any, params: PyTree) -> tuple[Array, Array, Array]:
        """θ*, θ̇*, θ̈*."""

        def motion(t: Any) -> Array:
            target = jnp.asarray(self.law.motion(t, params))
            if target.shape != jnp.shape(t):
                raise ValueError(
                    f"Drive '{self.law.name}': its motion must return a number, got shape"
                    f" {target.shape}."
                )
            return target

        def with_rate(t: Any) -> tuple[Array, Array]:
            return jax.jvp(motion, (t,), (jnp.ones_like(t),))

        (target, rate), (_, bias) = jax.jvp(with_rate, (t,), (jnp.ones_like(t),))
        return target, rate, bias
