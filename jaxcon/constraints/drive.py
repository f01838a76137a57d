"""Prescribed motion: a joint's coordinate as a function of time."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.constraints.base import RowSet, gather
from jaxcon.core import functions
from jaxcon.core.doubled import Doubled, evaluate, rounding_operations
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

    In float32 the motion is computed from the time with its remainder, in sums of two floats where
    it adds and multiplies, so that its phase is right after days. That holds in branches, loops and
    called functions, too. Functions such as `jnp.sqrt` round their result: a phase of 1e5 rad is
    off by up to 4e-3 rad after them. `build` warns of operations that see the rounded time alone,
    such as `jnp.cumsum` and solvers of linear equations: their phase is off by ω ε t.

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
        """The name of the constraint, alone in a tuple."""
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
        target, rate, bias = motion(Doubled.of(snapshot.instant), self.params)
        target, rate, bias = jax.tree.map(lambda x: x[None], (target, rate, bias))
        error = self.along.difference(snapshot, row, target)
        row = row._replace(value=error, rate=row.rate - rate, bias=row.bias - bias)
        return gather(snapshot, self.places, [row])

    def check(self, dtype: Any) -> None:
        """Calls the motion once, abstractly; warns where its phase is lost in float32.

        Raises:
            ValueError: it cannot be called, or returns no number.
        """
        start = Doubled.of(jnp.zeros((), dtype))
        try:
            jax.eval_shape(self._motion, start, self.params)
        except TypeError as error:
            if str(error).startswith("Drive '"):
                raise
            raise ValueError(
                f"Drive '{self.law.name}': motion(t, params) cannot be called: {error}."
            ) from error
        if jnp.finfo(dtype).bits == 64:
            return
        if names := rounding_operations(self.law.motion, start, self.params):
            warnings.warn(
                f"Drive '{self.law.name}': its motion passes the time through {', '.join(names)},"
                " which in float32 sees it rounded (to 8 ms at 1e5 s); write it by sums, products"
                " and elementary functions, or build the scene in float64.",
                stacklevel=2,
            )

    def anchor(self, snapshot: Any, i: int) -> Array | None:
        """The anchor of the driven joint."""
        (joint,) = self.along.joints
        return snapshot.system.constraints[self.along.group].anchor(snapshot, joint)

    def _motion(self, t: Doubled, params: PyTree) -> tuple[Doubled, Array, Array]:
        """θ*, θ̇*, θ̈*."""

        def motion(t: Any) -> Array:
            owner = f"Drive '{self.law.name}'"
            target = functions.call(owner, "motion", self.law.motion, t, params)
            target = functions.array(owner, "motion", target)
            if target.shape != jnp.shape(t):
                raise ValueError(
                    f"Drive '{self.law.name}': its motion must return a number, got shape"
                    f" {target.shape}."
                )
            return target

        def at(high: Array) -> tuple[Array, Array]:
            # in float64 a time of days is rounded to 1e-11 s
            if jnp.finfo(high.dtype).bits == 64:
                return motion(high), jnp.zeros_like(high)
            target = evaluate(motion, Doubled(high, t.low))
            return target.high, target.low

        def with_rate(high: Array) -> tuple[Array, Array, Array]:
            target, rate, low = jax.jvp(at, (high,), (jnp.ones_like(high),), has_aux=True)
            return target, rate, low

        (target, rate, low), (_, bias, _) = jax.jvp(with_rate, (t.high,), (jnp.ones_like(t.high),))
        return Doubled(target, low), rate, bias
