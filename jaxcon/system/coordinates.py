"""Joint coordinates: the angles and travels on which springs, motors, gears and drives act."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.doubled import Doubled
from jaxcon.core.lanes import Vector, take, total
from jaxcon.core.typing import Array, Lane
from jaxcon.system.elements import Element

if TYPE_CHECKING:
    from jaxcon.constraints.base import Joint
    from jaxcon.constraints.primitives import Row
    from jaxcon.system.body_system import Snapshot


@dataclass(frozen=True)
class JointCoordinate:
    """One coordinate of several joints of one group.

    In space the poses of the bodies give an angle θ_seen only up to whole turns. If whole turns are
    counted, the state has θ₀, the angle expected after the last step (see `expected`). The angle is
    then the value nearest to θ₀, θ = θ₀ + wrap(θ_seen − θ₀); its derivative is that of θ_seen.

    Attributes:
        group: index of the group of joints, in the constraints of the system.
        joints: indices of the joints in the group, one for each element.
        name: name of the coordinate, such as "angle" or "travel".
        counters: indices of the expected angles θ₀ in the `turns` of the state; empty if turns are
            not counted.
    """

    group: int
    joints: tuple[int, ...]
    name: str
    counters: tuple[int, ...] = ()

    def read(self, snapshot: Snapshot) -> Row:
        """Returns the coordinate of each joint as a row; the value includes counted turns.

        The row has value, rate, bias (the part of the second derivative without accelerations), and
        pulls (∂rate/∂v by body).
        """
        joints, row = self._read(snapshot)
        if joints != self.joints:
            places = tuple(map(joints.index, self.joints))
            row = jax.tree.map(lambda x: take(x, places), row)
        if not self.counters:
            return row
        before = take(snapshot.system.turns, self.counters)
        return row._replace(value=before + numerics.wrap(row.value - before))

    def _read(self, snapshot: Snapshot) -> tuple[tuple[int, ...], Row]:
        """Returns the row without counted turns, for at least these joints, and its joints.

        Rows are computed once for all elements that read the same joints, in any order, or some of
        them.
        """
        for (index, joints), rows in snapshot.joint_rows.items():
            if index == self.group and self.name in rows and {*self.joints} <= {*joints}:
                return joints, rows[self.name]
        joints = tuple(sorted({*self.joints}))
        rows = snapshot.joint_rows.setdefault((self.group, joints), {})
        group = snapshot.system.constraints[self.group]
        rows |= group.select(joints).coordinate_rows(snapshot, self.name)
        return joints, rows[self.name]

    def select(self, indices: tuple[int, ...]) -> JointCoordinate:
        """Returns the coordinates of some of the elements."""
        joints = tuple(self.joints[i] for i in indices)
        counters = tuple(self.counters[i] for i in indices) if self.counters else ()
        return JointCoordinate(self.group, joints, self.name, counters)

    def rate(self, snapshot: Snapshot, row: Row, v: Array) -> Lane:
        """Returns the rate θ̇ of the coordinate for other velocities at the same positions.

        Args:
            snapshot: the positions.
            row: the coordinate as a row, from `read`.
            v: the velocities, (n_v,).
        """
        places = snapshot.system.constraints[self.group].select(self.joints).places
        return total(
            pull.dot(snapshot.system.columns(place).take(v))
            for place, pull in zip(places, row.pulls, strict=True)
            if place.group is not None
        )

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchors on the second bodies, world frame [m]; None without anchors."""
        anchors = snapshot.system.constraints[self.group].anchors(snapshot)
        return None if anchors is None else anchors.map(lambda x: take(x, self.joints))

    def difference(self, snapshot: Snapshot, row: Row, reference: Doubled) -> Lane:
        """Returns value − reference, in [−π, π] for angles that are known only up to whole turns.

        In float32, an angle of 1e5 rad is a multiple of 8e-3 rad. In the plane, whole turns and the
        remaining angles are therefore subtracted separately.

        Args:
            snapshot: the system at one instant.
            row: the coordinate as a row, from `read`.
            reference: the reference as a sum of two floats.
        """
        joint = snapshot.system.constraints[self.group].law
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
"""A coordinate of one joint: the group, the index in the group, and the coordinate's name."""


def directory(groups: Sequence[Any]) -> dict[str, tuple[int, int]]:
    """Returns group and index of each joint, by name."""
    # groups of joints are the only constraints with has_vectors
    joints = ((g, group) for g, group in enumerate(groups) if group.has_vectors)
    return {name: (g, i) for g, group in joints for i, name in enumerate(group.names)}


def find(
    groups: Sequence[Any],
    where: Mapping[str, tuple[int, int]],
    owner: str,
    joint: str,
    name: str | None,
) -> End:
    """Looks up a coordinate of a joint by name.

    Args:
        groups: groups of joints.
        where: group and index of each joint, from `directory`.
        owner: class and name of the element that uses the coordinate, for error messages.
        joint: name of the joint.
        name: name of the coordinate; None for the only one.

    Raises:
        ValueError: no joint has this name, the joint has no such coordinate, or it has several and
            no name is given.
    """
    if not isinstance(joint, str) or joint not in where:
        raise ValueError(f"{owner}: joint '{joint}' is unknown; known are {[*where]}.")
    group, index = where[joint]
    names = list(groups[group].law.coordinates)
    if not names:
        raise ValueError(
            f"{owner}: '{joint}' has no coordinate; a Span measures a distance, a Twist a turn."
        )
    chosen: Any = names[0] if name is None and len(names) == 1 else name
    if not isinstance(chosen, str) or chosen not in names:
        raise ValueError(
            f"{owner}: the coordinates of '{joint}' are {names}; say which, got {name!r}."
        )
    return group, index, chosen


Counters = dict[tuple[int, str], dict[int, int]]
"""Maps (group of joints, coordinate name) to the index in `State.turns` of each joint."""


def numbered(counted: tuple[JointCoordinate, ...]) -> Counters:
    """Maps each counted (group, coordinate name) to the index in `State.turns` of each joint."""
    return {(c.group, c.name): dict(zip(c.joints, c.counters, strict=True)) for c in counted}


def at(counters: Counters, ends: Iterable[End]) -> JointCoordinate:
    """Returns one coordinate of several joints of a group.

    Args:
        counters: the indices in `State.turns` of all counted coordinates.
        ends: the coordinate of each joint; all have the same group and the same name.
    """
    groups, joints, names = zip(*ends, strict=True)
    indices = counters.get((groups[0], names[0]), {})
    counted = tuple(indices[j] for j in joints if j in indices)
    return JointCoordinate(
        groups[0], joints, names[0], counted if len(counted) == len(joints) else ()
    )


def turns_over(joint: type[Joint], name: str, dim: int) -> bool:
    """Returns True for an angle in space, which the poses give only up to whole turns."""
    return dim == 3 and joint.coordinates[name] == "rad"


def count(counted: tuple[JointCoordinate, ...], snapshot: Snapshot) -> Array:
    """Returns the angles whose turns are counted, (n,) [rad]."""
    return joined([coordinate.read(snapshot).value for coordinate in counted])


def expected(
    counted: tuple[JointCoordinate, ...], snapshot: Snapshot, end: Array, dt: Array, within: bool
) -> tuple[Array, Array]:
    """Returns the expected angles after a step, and bounds on their errors.

    With rates θ̇ and θ̇⁺ before and after the step, the expected change is h (θ̇ + θ̇⁺)/2. Its
    error is at most h |θ̇⁺ − θ̇|/2, because an integrator moves by some mean of both rates. Whole
    turns are counted correctly while the error is below half a turn.

    Args:
        counted: the angles.
        snapshot: the start of the step.
        end: v after the step, (n_v,).
        dt: h, () [s].
        within: True if angles are also read inside the step; the bound then covers the change from
            the start of the step.

    Returns:
        The angles, (n,) [rad], and the bounds on their errors, (n,) [rad].
    """
    rows = [coordinate.read(snapshot) for coordinate in counted]
    start, before = joined([row.value for row in rows]), joined([row.rate for row in rows])
    pairs = zip(counted, rows, strict=True)
    after = joined([coordinate.rate(snapshot, row, end) for coordinate, row in pairs])
    h = dt[None]
    missed = jnp.abs(h * (after - before)) / 2
    if within:
        missed = jnp.maximum(missed, jnp.abs(h) * jnp.maximum(jnp.abs(before), jnp.abs(after)))
    return jax.lax.stop_gradient((start + h * (before + after) / 2, missed))


def joined(lanes: Sequence[Lane]) -> Array:
    """Concatenates lanes (element, …) into one flat array."""
    batch = jnp.broadcast_shapes(*(jnp.shape(x)[1:] for x in lanes))
    return jnp.concatenate([jnp.broadcast_to(x, (jnp.shape(x)[0], *batch)) for x in lanes])


class OnCoordinates(Element):
    """The base class of elements that act on joint coordinates."""

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """The names of the joints on which the element acts, each with a coordinate's name."""
        raise NotImplementedError


class OnJoint(OnCoordinates):
    """The base class of elements that act on one coordinate of a joint."""

    joint: str
    coordinate: str | None
    potential: Any = None
    """A function (numbers, coordinate) → energy [J]; None for elements without an energy."""
    law: ClassVar[str | None] = None
    """The law of the multipliers of an inequality constraint; None for other elements."""

    @property
    def joint_coordinates(self) -> tuple[tuple[str, str | None], ...]:
        """A single pair: the name of the joint and the name of its coordinate."""
        return ((self.joint, self.coordinate),)


@dataclass(frozen=True)
class TurnCounter(OnJoint):
    """Counts the whole turns of a joint's angle, so that `jc.coordinate` includes them.

    Springs, servos and couplings count the turns of their joints themselves. In the plane, angles
    are coordinates and need no counting.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        coordinate: name of the joint's coordinate; needed if the joint has several.
    """

    name: str
    joint: str
    coordinate: str | None = None
