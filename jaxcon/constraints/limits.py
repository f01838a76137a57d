"""Joints that end, rub, and are turned no faster or harder than their motors can.

Each class describes one element on a joint's coordinate θ, an angle over turns or a travel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from jaxcon.constraints.bounds import BoundSet
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.ranges import Ranged, check_ends, check_ranges, not_negative
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, Lane
from jaxcon.model.coordinates import JointCoordinate
from jaxcon.model.elements import label

RECOVERED = 0.2
"""The part of a penetration that a step takes back."""

AT_ONCE = {32: 1e-3, 64: 1e-5}
"""The speed [m/s, rad/s] up to which a step closes a whole penetration, by bits of a number.

A faster closing speed is reduced to a fifth of it, but not below this speed.
"""


@dataclass(frozen=True)
class Limit:
    """A joint's coordinate stays between two stops, lower ≤ θ ≤ upper.

    At the nearer stop, with gap φ ≥ 0, a step ends with φ̇ ≥ −φ/h: it may reach the stop and not
    pass it. A penetration closes within a step if 1 mm/s or 1 mrad/s suffices (10 µm/s or 10 µrad/s
    in float64). Otherwise it closes by a fifth, but at least at this speed, and no faster than
    `recovery`. A coordinate that would arrive within the step leaves with −e φ̇, at the time at
    which it arrives. A stop with a stiffness is a spring and a damper behind the gap, implicit over
    the step. The farther stop acts in place of the nearer one where the step would otherwise pass
    it.

    A step sees one impact of a stop. A joint that rebounds so fast that it would cross its whole
    range in the rest of the step ends with the status `LOST_IMPACTS`: with e = 1 between stops
    0.2 m apart and h = 1 ms, from 200 m/s on. `Events(splits=n)` follows n impacts.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        lower, upper: [rad] or [m], zero being the assembly; None where there is no stop,
            or later an infinite one. `build` warns of angles beyond a turn: degrees, most likely.
        coordinate: which of the joint's; not needed where it has but one.
        restitution: e, 0 to 1.
        stiffness: k of a soft stop [N m/rad] or [N/m]; None for a hard one.
        damping: its c [N m s/rad] or [N s/m].
        recovery: the fastest way back [rad/s] or [m/s].
    """

    name: str
    joint: str
    lower: Any = None
    upper: Any = None
    coordinate: str | None = None
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    counts = True
    law = "single"
    endless = ("lower", "upper")
    angles = ("lower", "upper")
    optional = ("restitution",)

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element.

        Raises:
            ValueError: there is no stop, lower ≥ upper, or a number is out of range.
        """
        if self.lower is None and self.upper is None:
            raise ValueError(f"{label(self)}: give lower, upper or both.")
        far = float("inf")
        lower = checks.real(
            label(self), "lower", -far if self.lower is None else self.lower, dtype, finite=False
        )
        upper = checks.real(
            label(self), "upper", far if self.upper is None else self.upper, dtype, finite=False
        )
        check_ends(label(self), lower, upper)
        return {"lower": lower, "upper": upper} | stop(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Any) -> Any:
        """The gap of the nearer stop, and that of the other."""
        below, above = row.value - p["lower"], p["upper"] - row.value
        near = below < above
        side = jnp.where(near, 1.0, -1.0).astype(row.value.dtype)
        gap, far = jnp.where(near, below, above), jnp.where(near, above, below)
        # a stop that is nowhere has a row of zeros, which solvers leave out
        nowhere = gap == jnp.inf
        side, gap = jnp.where(nowhere, 0, side), jnp.where(nowhere, 0, gap)
        pulls = tuple(pull * side for pull in row.pulls)
        own = row._replace(value=gap, rate=side * row.rate, pulls=pulls)
        own, asked = one_sided(p, own, dt)
        return own, asked | {"far": far}


@dataclass(frozen=True)
class JointFriction:
    """Dry friction in a joint: it holds θ̇ = 0 with up to a torque or force τ, |λ| ≤ τ.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        most: τ [N m] about an angle, [N] along a travel.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    most: Any
    coordinate: str | None = None
    counts = False
    law = "box"

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return most(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Any) -> Any:
        """θ̇ = 0 as far as −τ ≤ λ ≤ τ suffices."""
        return saturating(p, row, 0.0)


@dataclass(frozen=True)
class RateMotor:
    """A motor that turns a joint at the wanted rate with up to a torque or force τ, |λ| ≤ τ.

    It reaches the rate within the step if τ suffices, whatever the inertia: a velocity servo of
    infinite gain that saturates.

    Attributes:
        name: unique in the scene; also that of the control channel: the rate wanted.
        joint: name of the joint.
        most: τ [N m] about an angle, [N] along a travel.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    most: Any
    coordinate: str | None = None
    controls = 1
    counts = False
    law = "box"

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        return most(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Any) -> Any:
        """θ̇ = u as far as −τ ≤ λ ≤ τ suffices."""
        return saturating(p, row, u)


@dataclass(frozen=True)
class RateLimit:
    """A joint's coordinate changes no faster than a rate, |θ̇| ≤ r.

    The limit is that of the direction in which it moves when a step begins: what rests, or turns
    round within a step, may overshoot for that step.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        rate: r [rad/s] or [m/s].
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    rate: Any
    coordinate: str | None = None
    counts = False
    law = "single"

    def attach(self, dtype: Any) -> dict[str, Array]:
        """The numbers of the element."""
        rate = checks.real(label(self), "rate", self.rate, dtype, least=0)
        return {"rate": rate}

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Any) -> Any:
        """−|θ̇| ≥ −r, in the direction in which it moves."""
        side = jnp.where(row.rate > 0, -1.0, 1.0).astype(row.rate.dtype)
        pulls = tuple(pull * side for pull in row.pulls)
        own = Row(0.0, side * row.rate, 0.0, pulls, holonomic=False)
        return own, {"target": -not_negative(p["rate"])}


@pytree
class Bounds(Ranged):
    """Elements of one class, `law`, along one coordinate of joints of one group."""

    along: JointCoordinate = static(default=None)  # type: ignore[assignment]
    starts: tuple[int, ...] = static(default=())

    def bounds(self, snapshot: Any, control: Any, dt: Any) -> BoundSet:
        """The rows at one instant, and what a step of dt wants of them."""
        row, asked = self.law.bounds(
            self.params, self.along.read(snapshot), self._control(control), dt
        )
        return BoundSet(self.law.law, (row,), self.places, **asked)

    def _control(self, control: Any) -> Lane:
        """The element's own channels."""
        return take(control, self.starts) if self.starts and control is not None else 0.0


def saturating(p: dict[str, Any], row: Row, rate: Lane) -> tuple[Row, dict[str, Any]]:
    """θ̇ = rate as far as −τ ≤ λ ≤ τ suffices."""
    largest = not_negative(p["most"])
    asked = {"target": rate, "lower": -largest, "upper": largest}
    return row._replace(value=0.0, holonomic=False), asked


def one_sided(p: dict[str, Any], row: Row, dt: Any) -> tuple[Row, dict[str, Any]]:
    """A row and the least φ̇ that a step may end with, by its gap φ.

    What bounces has more of it, see `jaxcon.dynamics.impacts`.
    """
    h = dt[None]
    closing = numerics.safe_divide(-row.value, h)
    # rounding leaves some corners of a resting box above the floor and others below it. The
    # derivative of u* must be the same on both sides, and at zero, or no rigid motion meets all of
    # them; jnp.minimum would halve it at the tie
    least = AT_ONCE[jnp.finfo(closing.dtype).bits]
    back = jnp.where(closing <= least, closing, jnp.maximum(RECOVERED * closing, least))
    back = jnp.minimum(back, not_negative(p["recovery"]))
    target = jnp.where(row.value > 0, closing, back)
    asked = {"target": target}
    if "restitution" in p:
        asked["restitution"] = not_negative(p["restitution"])
    if "stiffness" not in p:
        return row, asked
    # λ = −k (φ + h u) − c u behind the gap, as u + C λ = u* with the stiffness of both over a step;
    # before it is closed, both act on the travel beyond it alone, u + φ/h
    k = not_negative(p["stiffness"])
    both = h * k + not_negative(p["damping"])
    # without both there is no stop; up to here the derivative of 1/both is finite
    both = jnp.where(both > float(jnp.finfo(both.dtype).tiny) ** (1 / 3), both, 0)
    behind = numerics.safe_divide(-k * row.value, both)
    soft = jnp.where(both > 0, jnp.where(row.value > 0, closing, behind), 0)
    row = row._replace(pulls=tuple(pull * (both > 0).astype(both.dtype) for pull in row.pulls))
    return row, asked | {"target": soft, "compliance": numerics.safe_divide(1.0, both)}


def stop(element: Any, dtype: Any) -> dict[str, Array]:
    """The numbers of what happens at a stop, checked.

    Raises:
        ValueError: one is out of range.
    """
    owner = label(element)
    numbers = {"recovery": element.recovery}
    if not checks.plain_zero(element.restitution):
        if element.stiffness is not None:
            raise ValueError(
                f"{owner}: restitution is of a hard stop, and stiffness and damping of a soft one;"
                " give one or the other."
            )
        numbers["restitution"] = element.restitution
    if element.stiffness is None and not checks.plain_zero(element.damping):
        raise ValueError(f"{owner}: damping is of a soft stop; give its stiffness, too.")
    if element.stiffness is not None:
        numbers |= {"stiffness": element.stiffness, "damping": element.damping}
    result = {what: checks.real(owner, what, x, dtype) for what, x in numbers.items()}
    check_ranges(owner, result)
    return result


def most(element: Any, dtype: Any) -> dict[str, Array]:
    """The largest force of an element, checked.

    Raises:
        ValueError: it is negative.
    """
    value = checks.real(label(element), "most", element.most, dtype, least=0)
    return {"most": value}
