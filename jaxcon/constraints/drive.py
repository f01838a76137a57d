"""Prescribed motion: a joint's coordinate as a function of time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp

from jaxcon.constraints.primitives import Row
from jaxcon.core import functions
from jaxcon.core.doubled import Doubled, evaluate, rounding_operations
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, PyTree
from jaxcon.protocols import Constraint
from jaxcon.staging.worlds import per_world
from jaxcon.system.coordinates import JointCoordinate, OnJoint
from jaxcon.system.elements import UserElement

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class Drive(OnJoint):
    """A joint's coordinate follows a given motion: θ = θ*(t), one row.

    θ is a coordinate of the joint, an angle [rad] or a travel [m], zero at assembly. λ is the
    torque or force that the drive applies. In space angles are compared modulo whole turns, so a
    crank may turn without end.

    In float32 the motion is evaluated with the time and its rounding error: sums and products are
    computed in pairs of floats, also in branches, loops and called functions. The phase is then
    right even after days. Functions such as `jnp.sqrt` round their result: after them, a phase of
    1e5 rad is wrong by up to 4e-3 rad. Operations such as `jnp.cumsum` and linear solvers get the
    rounded time. The phase error is then ω ε t, with angular rate ω and machine epsilon ε; `build`
    warns of such operations.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the driven joint.
        motion: the function `motion(t, params)` → θ* (); pure and hashable, twice differentiable in
            t.
        params: any pytree of arrays.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    name: str
    joint: str
    motion: Callable[..., Array]
    params: PyTree = None
    coordinate: str | None = None
    counts = False


@pytree
class Drives(UserElement, Constraint):  # type: ignore[override]
    """A `Drive` in a system.

    Attributes:
        coordinate: the driven joint coordinate.
    """

    closes_loops: ClassVar[bool] = False

    coordinate: JointCoordinate = static(default=None)  # type: ignore[assignment]

    @property
    def driven(self) -> Hashable:
        """The group, joints and name of the driven coordinate, as a key."""
        return self.coordinate.group, self.coordinate.joints, self.coordinate.name

    def rows(self, snapshot: Snapshot) -> list[Row]:
        """Returns the row φ = θ − θ*(t), φ̇ = θ̇ − θ̇*, γ = γ_θ − θ̈*.

        Two nested derivatives of the motion give θ̇* and θ̈*; γ_θ is the coordinate's bias.
        """
        row = self.coordinate.read(snapshot)
        motion = per_world(self._motion, snapshot.q.ndim - 1)
        target, rate, bias = motion(Doubled.of(snapshot.instant), self.params)
        target, rate, bias = jax.tree.map(lambda x: x[None], (target, rate, bias))
        error = self.coordinate.difference(snapshot, row, target)
        row = row._replace(value=error, rate=row.rate - rate, bias=row.bias - bias)
        return [row]

    def check(self, dtype: DType) -> None:
        """Checks the motion by tracing it once; warns if its phase loses accuracy in float32.

        Raises:
            ValueError: the motion cannot be called, or does not return a number.
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

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchor of the driven joint, world frame [m]; None without anchors."""
        return self.coordinate.anchors(snapshot)

    def _motion(self, t: Doubled, params: PyTree) -> tuple[Doubled, Array, Array]:
        """Returns θ*, θ̇* and θ̈* at time t, each ()."""

        def motion(t: Array) -> Array:
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
            # float64 needs no pairs: it resolves a time of days to 1e-11 s
            if jnp.finfo(high.dtype).bits == 64:
                return motion(high), jnp.zeros_like(high)
            target = evaluate(motion, Doubled(high, t.low))
            return target.high, target.low

        def with_rate(high: Array) -> tuple[Array, Array, Array]:
            target, rate, low = jax.jvp(at, (high,), (jnp.ones_like(high),), has_aux=True)
            return target, rate, low

        (target, rate, low), (_, bias, _) = jax.jvp(with_rate, (t.high,), (jnp.ones_like(t.high),))
        return Doubled(target, low), rate, bias
