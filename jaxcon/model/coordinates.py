"""The coordinates of joints: angles and travels that springs, motors, gears and drives act on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.doubled import Doubled
from jaxcon.core.lanes import take, total
from jaxcon.core.typing import Array, Lane


@dataclass(frozen=True)
class JointCoordinate:
    """One coordinate of several joints of one group.

    In space an angle is seen modulo whole turns only. Where an element needs more, the state holds
    the angle θ₀ that the last step was expected to lead to, see `expected`. The one now is that
    nearest to it, θ = θ₀ + wrap(θ_seen − θ₀). Its derivative is that of θ_seen, whatever θ₀ is.

    Attributes:
        group: of the joints, in the constraints of the system.
        joints: their indices in the group, one for each element.
        name: "angle", "travel", …
        counters: where the state holds each of them; empty where turns are not counted.
    """

    group: int
    joints: tuple[int, ...]
    name: str
    counters: tuple[int, ...] = ()

    def read(self, snapshot: Any) -> Any:
        """Value, rate, bias and pulls by element, the value over turns where they are counted."""
        rows = snapshot.joint_rows.setdefault((self.group, self.joints), {})
        if self.name not in rows:
            group = snapshot.system.constraints[self.group]
            rows |= group.select(self.joints).coordinate_rows(snapshot, self.name)
        row = rows[self.name]
        if not self.counters:
            return row
        before = take(snapshot.system.turns, self.counters)
        return row._replace(value=before + numerics.wrap(row.value - before))

    def rate(self, snapshot: Any, row: Any, v: Array) -> Lane:
        """θ̇ of the row under other velocities (n_v,), the bodies being where they are."""
        places = snapshot.system.constraints[self.group].select(self.joints).places
        sides = zip(places, row.pulls, strict=True)
        return total(
            pull.dot(snapshot.system.columns(place).take(v))
            for place, pull in sides
            if place.group is not None
        )

    def difference(self, snapshot: Any, row: Any, reference: Doubled) -> Any:
        """value − reference, in [−π, π] where a joint's angle is seen modulo whole turns.

        In the plane, in float32, whole turns and what is left of them are subtracted apart: an
        angle of 1e5 rad is rounded to 8e-3.
        """
        joint = snapshot.system.constraints[self.group].joint
        wraps = turns_over(joint, self.name, snapshot.system.layout.dim)
        if wraps and jnp.finfo(reference.high.dtype).bits < 64:
            reference = reference.reduced()
        elif row.reduced is not None:
            value, laps = row.reduced
            turns, reference = reference.turns, reference.reduced()
            return (value - reference.high) - reference.low + 2 * jnp.pi * (laps - turns)
        error = (row.value - reference.high) - reference.low
        return numerics.wrap(error) if wraps else error


End = tuple[int, int, str]
"""A coordinate of one joint: its group, its index there, and the coordinate's name."""


def directory(groups: Sequence[Any]) -> dict[str, tuple[int, int]]:
    """Group and index of each joint, by name."""
    joints = ((g, group) for g, group in enumerate(groups) if hasattr(group, "joint"))
    return {name: (g, i) for g, group in joints for i, name in enumerate(group.names)}


def find(groups: Sequence[Any], where: Any, owner: str, joint: str, name: str | None) -> End:
    """A coordinate of a joint by name; `where` is the directory of the groups.

    Raises:
        ValueError: no joint has this name, or it has no such coordinate, or several.
    """
    if not isinstance(joint, str) or joint not in where:
        raise ValueError(f"{owner}: joint '{joint}' is unknown; known are {[*where]}.")
    group, index = where[joint]
    known = list(getattr(groups[group].joint, "coordinates", ()))
    if not known:
        raise ValueError(
            f"{owner}: '{joint}' has no coordinate; a Span measures a distance, a Twist a turn."
        )
    chosen = known[0] if name is None and len(known) == 1 else name
    if chosen not in known:
        raise ValueError(
            f"{owner}: the coordinates of '{joint}' are {known}; say which, got {name!r}."
        )
    return group, index, chosen


Counters = dict[tuple[int, str], dict[int, int]]
"""By group and coordinate: where the state holds the turns of each joint."""


def numbered(counted: tuple[JointCoordinate, ...]) -> Counters:
    """Returns the counters by joint."""
    return {(c.group, c.name): dict(zip(c.joints, c.counters, strict=True)) for c in counted}


def at(counters: Counters, ends: Iterable[End]) -> JointCoordinate:
    """Returns one coordinate of several joints of a group, with the counters of its turns."""
    groups, joints, names = zip(*ends, strict=True)
    known = counters.get((groups[0], names[0]), {})
    own = tuple(known[j] for j in joints if j in known)
    return JointCoordinate(groups[0], joints, names[0], own if len(own) == len(joints) else ())


def turns_over(joint: Any, name: str, dim: int) -> bool:
    """Returns True where a coordinate is seen modulo whole turns; in the plane angles go on."""
    return dim == 3 and joint.coordinates[name] == "rad"


def count(counted: tuple[JointCoordinate, ...], snapshot: Any) -> Array:
    """The angles whose turns are counted, (n,) [rad]."""
    return _joined([coordinate.read(snapshot).value for coordinate in counted])


def expected(
    counted: tuple[JointCoordinate, ...], snapshot: Any, end: Array, dt: Array, within: bool
) -> tuple[Array, Array]:
    """The angles after a step by the mean of the rates before and after it, and what that misses.

    With rates θ̇ and θ̇⁺ an angle changes by h (θ̇ + θ̇⁺)/2, give or take h |θ̇⁺ − θ̇|/2: an integrator
    may move it by any mean of both. The turns are known where that is less than half a turn.

    Args:
        counted: which angles.
        snapshot: at the start of the step.
        end: v after it, (n_v,).
        dt: its length, () [s].
        within: whether angles are also read between its ends, which must then be less than half a
            turn away from its start.

    Returns:
        The angles, (n,) [rad], and by how much they may be off or go unseen, (n,) [rad].
    """
    rows = [coordinate.read(snapshot) for coordinate in counted]
    start = _joined([row.value for row in rows])
    pairs = zip(counted, rows, strict=True)
    before = _joined([row.rate for row in rows])
    after = _joined([coordinate.rate(snapshot, row, end) for coordinate, row in pairs])
    h = dt[None]
    missed = jnp.abs(h * (after - before)) / 2
    if within:
        missed = jnp.maximum(missed, jnp.abs(h) * jnp.maximum(jnp.abs(before), jnp.abs(after)))
    return jax.lax.stop_gradient((start + h * (before + after) / 2, missed))


def _joined(lanes: list[Lane]) -> Array:
    batch = jnp.broadcast_shapes(*(x.shape[1:] for x in lanes))
    return jnp.concatenate([jnp.broadcast_to(x, (x.shape[0], *batch)) for x in lanes])


@dataclass(frozen=True)
class TurnCounter:
    """Counts the whole turns of a joint's angle, for `coordinate` to read.

    Springs, servos and couplings count by themselves what they act on, and in the plane angles are
    coordinates, which need no counting.

    Attributes:
        name: unique in the scene.
        joint: name of the joint.
        coordinate: which of the joint's; not needed where it has but one.
    """

    name: str
    joint: str
    coordinate: str | None = None
    counts = True
