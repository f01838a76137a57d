"""Joint limits, dry friction in joints, rate motors, and inequalities from users' functions.

Elements on a joint act on its coordinate θ, an angle that counts whole turns, or a travel. The
first part of the module checks the ranges of their parameters, and of the parameters of contacts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.custom import CustomOnBodies, CustomOnCoordinates, UserFunction
from jaxcon.constraints.primitives import Row
from jaxcon.contact.point_sets import spread_place
from jaxcon.contact.rows import BoundSet
from jaxcon.core import checks, numerics
from jaxcon.core.lanes import Vector, take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, Lane, PyTree
from jaxcon.system.coordinates import JointCoordinate, OnJoint
from jaxcon.system.elements import Elements, element_at, label, replace_at, stack

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


POSITIVE = ("stiffness", "recovery", "size")
NOT_NEGATIVE = (
    *("restitution", "damping", "friction", "rolling", "spinning"),
    *("max_force", "rate", "radius", "radius_a", "radius_b"),
)


@pytree
class Ranged(Elements):
    """Elements of the class `law`, whose parameters are checked against their valid ranges."""

    law: Any = static(default=None)
    coordinate = None

    @property
    def numbers(self) -> Mapping[str, Any]:
        """The parameters of the elements, by field."""
        return self.params

    def check_numbers(self, name: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks that the parameters of one element are in their valid ranges.

        Args:
            name: name of the element, for errors.
            numbers: the parameters by field.
            dtype: dtype of the scene, in which they are compared.
        """
        check_ranges(name, numbers, dtype)


def check_ranges(owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
    """Checks the parameters of an element with inequality rows; skips traced values.

    Args:
        owner: first words of errors.
        numbers: the parameters by field.
        dtype: dtype of the scene, in which they are compared.

    Raises:
        ValueError: a parameter is out of range, or the lower stop is not below the upper one.
    """
    for field in numbers.keys() & {*POSITIVE, *NOT_NEGATIVE}:
        limit: Any = {"above": 0} if field in POSITIVE else {"least": 0}
        checks.check(owner, field, numbers[field], dtype=dtype, **limit)
    e = numbers.get("restitution", 0.0)
    if checks.is_concrete(e) and np.asarray(e, dtype) > 1:
        raise ValueError(f"{owner}: restitution must lie in 0 to 1, got {float(e):g}.")
    if "lower" in numbers:
        check_ends(owner, numbers["lower"], numbers["upper"], dtype)


def check_ends(owner: str, lower: Array | float, upper: Array | float, dtype: DType) -> None:
    """Checks that the lower stop is below the upper stop in the dtype of the scene.

    Raises:
        ValueError: the lower stop is not below the upper stop.
    """
    if not checks.is_concrete((lower, upper)):
        return
    if not np.asarray(lower, dtype) < np.asarray(upper, dtype):
        raise ValueError(
            f"{owner}: lower must be below upper, got {checks.numerals(lower)} and"
            f" {checks.numerals(upper)}; what does not move at all is a Fixed joint or a Drive."
        )


def not_negative(x: Lane) -> Lane:
    """Replaces negative coefficients by 0, since traced numbers cannot be checked."""
    return jnp.where(x < 0, 0, x)


RECOVERED = 0.2
"""The fraction of a penetration that closes in one step."""

AT_ONCE = {32: 1e-3, 64: 1e-5}
"""The speed [m/s, rad/s] up to which a step closes a whole penetration, by bits of a float.

A larger closing speed is reduced by the factor `RECOVERED`, but not below this speed.
"""


@dataclass(frozen=True)
class Limit(OnJoint):
    """Keeps a joint coordinate between two stops, lower ≤ θ ≤ upper.

    φ is the gap to the nearer stop. A step with φ ≥ 0 ends with φ̇ ≥ −φ/h: the coordinate may reach
    the stop but not pass it. A penetration closes within a step if a speed of 1 mm/s or 1 mrad/s
    suffices (10 µm/s or 10 µrad/s in float64). Otherwise a fifth of it closes, but at least at this
    speed, and no faster than `recovery`. A coordinate that reaches the stop within the step leaves
    it at the rate −e φ̇, with φ̇ at the time of impact. A stop with a stiffness is a spring and a
    damper behind the gap, integrated implicitly. If a step would pass the farther stop, that stop
    acts in place of the nearer one.

    A step resolves one impact of a stop. If a joint rebounds so fast that it would cross its whole
    range in the rest of the step, the world ends with the status `LOST_IMPACTS`. With e = 1, stops
    0.2 m apart and h = 1 ms, this happens from 200 m/s on. `Events(splits=n)` resolves n impacts.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        lower, upper: coordinates of the stops [rad] or [m], zero at assembly; None for no stop. To
            remove a stop later, set an infinite number. `build` warns of angles beyond a turn,
            likely degrees.
        coordinate: name of the joint's coordinate; not needed if the joint has only one.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness: stiffness k of a soft stop [N m/rad] or [N/m]; None for a hard stop.
        damping: damping c of a soft stop [N m s/rad] or [N s/m].
        recovery: the largest speed at which a penetration closes [rad/s] or [m/s].
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
    unbounded_fields = ("lower", "upper")
    angles = ("lower", "upper")
    optional = ("restitution",)

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the parameters of the element.

        Raises:
            ValueError: there is no stop, lower ≥ upper, or a parameter is out of range.
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
        check_ends(label(self), lower, upper, dtype)
        return {"lower": lower, "upper": upper} | stop(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Array) -> Any:
        """Returns the one-sided row of the nearer stop, and further fields of its `BoundSet`.

        The field `far` is the gap of the farther stop.
        """
        below, above = row.value - p["lower"], p["upper"] - row.value
        near = below < above
        side = direction = jnp.where(near, 1.0, -1.0).astype(jnp.result_type(row.value))
        gap, far = jnp.where(near, below, above), jnp.where(near, above, below)
        # a missing stop gets a row with J = 0, which solvers leave out
        nowhere = gap == jnp.inf
        side, gap = jnp.where(nowhere, 0, side), jnp.where(nowhere, 0, gap)
        pulls = tuple(pull * side for pull in row.pulls)
        nearer = row._replace(value=gap, rate=side * row.rate, pulls=pulls)
        nearer, fields = one_sided(p, nearer, dt)
        return nearer, fields | {"far": far, "direction": direction}


@dataclass(frozen=True)
class JointFriction(OnJoint):
    """Dry friction in a joint, which resists θ̇ with a torque or force |λ| ≤ τ.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        max_force: largest torque or force τ: [N m] about an angle, [N] along a travel.
        coordinate: name of the joint's coordinate; not needed if the joint has only one.
    """

    name: str
    joint: str
    max_force: Any
    coordinate: str | None = None
    counts = False
    law = "box"

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the parameters of the element."""
        return max_force(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Array) -> Any:
        """Returns the box row with the target rate θ̇ = 0 and the bounds −τ ≤ λ ≤ τ."""
        return saturating(p, row, 0.0)


@dataclass(frozen=True)
class RateMotor(OnJoint):
    """A motor that drives a joint at a commanded rate with a limited torque or force, |λ| ≤ τ.

    If τ suffices, the motor reaches the rate within the step, for any inertia: it is a velocity
    servo with infinite gain and saturation.

    Attributes:
        name: name of the element, unique in the scene; also the name of its control channel, the
            commanded rate.
        joint: name of the joint.
        max_force: largest torque or force τ: [N m] about an angle, [N] along a travel.
        coordinate: name of the joint's coordinate; not needed if the joint has only one.
    """

    name: str
    joint: str
    max_force: Any
    coordinate: str | None = None
    controls = 1
    counts = False
    law = "box"

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the parameters of the element."""
        return max_force(self, dtype)

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Array) -> Any:
        """Returns the box row with the target rate θ̇ = u and the bounds −τ ≤ λ ≤ τ."""
        return saturating(p, row, u)


@dataclass(frozen=True)
class RateLimit(OnJoint):
    """Limits the rate of a joint coordinate, |θ̇| ≤ r.

    Each step limits the rate in the direction of motion at its start. A joint that starts from rest
    or reverses within a step may exceed the limit for that step.

    Attributes:
        name: name of the element, unique in the scene.
        joint: name of the joint.
        rate: largest rate r [rad/s] or [m/s].
        coordinate: name of the joint's coordinate; not needed if the joint has only one.
    """

    name: str
    joint: str
    rate: Any
    coordinate: str | None = None
    counts = False
    law = "single"

    def attach(self, dtype: DType) -> dict[str, Array]:
        """Returns the parameters of the element."""
        rate = checks.real(label(self), "rate", self.rate, dtype, least=0)
        return {"rate": rate}

    @staticmethod
    def bounds(p: dict[str, Any], row: Row, u: Lane, dt: Array) -> Any:
        """Returns the one-sided row −|θ̇| ≥ −r, where r is the largest rate.

        |θ̇| is θ̇ or −θ̇, by the direction of motion at the start of the step.
        """
        side = jnp.where(row.rate > 0, -1.0, 1.0).astype(jnp.result_type(row.rate))
        pulls = tuple(pull * side for pull in row.pulls)
        limited = Row(0.0, side * row.rate, 0.0, pulls, holonomic=False)
        return limited, {"target": -not_negative(p["rate"])}


@pytree
class Bounds(Ranged):
    """A group of elements of the class `law` on one coordinate of the joints of one group."""

    coordinate: JointCoordinate = static(default=None)  # type: ignore[assignment]
    starts: tuple[int, ...] = static(default=())

    def bounds(self, snapshot: Snapshot, control: Array | None, dt: Array) -> BoundSet:
        """Returns the inequality rows at one instant, with their targets for a step of dt."""
        row, fields = self.law.bounds(
            self.params, self.coordinate.read(snapshot), self._control(control), dt
        )
        return BoundSet(self.law.law, (row,), self.places, **fields)

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchors of the joints on which the elements act."""
        return self.coordinate.anchors(snapshot)

    def _control(self, control: Array | None) -> Lane:
        """Returns the control inputs of the elements; 0 if they have none."""
        return take(control, self.starts) if self.starts and control is not None else 0.0


class HasStop(Protocol):
    """Protocol of elements with a hard or soft stop: a limit, rope, contact or `Inequality`."""

    @property
    def name(self) -> str:
        """The name of the element, unique in the scene."""
        ...

    @property
    def restitution(self) -> Any:
        """The coefficient of restitution e, from 0 to 1."""
        ...

    @property
    def stiffness(self) -> Any:
        """The stiffness k of a soft stop; None for a hard stop."""
        ...

    @property
    def damping(self) -> Any:
        """The damping c of a soft stop."""
        ...

    @property
    def recovery(self) -> Any:
        """The largest speed at which a penetration closes [m/s, rad/s]."""
        ...


def saturating(p: dict[str, Any], row: Row, rate: Lane) -> tuple[Row, dict[str, Any]]:
    """Returns the box row of a joint with a target for θ̇ and the bounds −τ ≤ λ ≤ τ."""
    largest = not_negative(p["max_force"])
    fields = {"target": rate, "lower": -largest, "upper": largest}
    return row._replace(value=0.0, holonomic=False), fields


def one_sided(p: dict[str, Any], row: Row, dt: Array) -> tuple[Row, dict[str, Any]]:
    """Returns a one-sided row and its target: the smallest φ̇ allowed at the end of a step.

    The target follows from the gap φ. Rebounds raise it; see `jaxcon.contact.impacts`. A soft stop
    adds a compliance.
    """
    h = dt[None]
    closing = numerics.safe_divide(-row.value, h)
    # rounding leaves some corners of a resting box above the floor and others below it. The
    # derivative of u* must be the same on both sides and at zero, since otherwise no rigid motion
    # satisfies all corners; jnp.minimum would halve the derivative at the tie
    least = AT_ONCE[jnp.finfo(closing.dtype).bits]
    back = jnp.where(closing <= least, closing, jnp.maximum(RECOVERED * closing, least))
    back = jnp.minimum(back, not_negative(p["recovery"]))
    target = jnp.where(row.value > 0, closing, back)
    fields: dict[str, Lane] = {"target": target}
    if "restitution" in p:
        fields["restitution"] = not_negative(p["restitution"])
    if "stiffness" not in p:
        return row, fields
    # behind the gap, λ = −k (φ + h u) − c u is written u + C λ = u* with 1/C = h k + c; if the gap
    # is open, spring and damper act only on the part of the motion beyond the stop, u + φ/h
    k = not_negative(p["stiffness"])
    both = h * k + not_negative(p["damping"])
    # k = c = 0 means no stop; so do tiny values, at which the derivative of 1/both may overflow
    both = jnp.where(both > float(jnp.finfo(both.dtype).tiny) ** (1 / 3), both, 0)
    behind = numerics.safe_divide(-k * row.value, both)
    soft = jnp.where(both > 0, jnp.where(row.value > 0, closing, behind), 0)
    row = row._replace(pulls=tuple(pull * (both > 0).astype(both.dtype) for pull in row.pulls))
    return row, fields | {"target": soft, "compliance": numerics.safe_divide(1.0, both)}


def stop(element: HasStop, dtype: DType) -> dict[str, Array]:
    """Returns the checked parameters of a stop or contact.

    Raises:
        ValueError: a parameter is out of range, or both hard and soft parameters are given.
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
    check_ranges(owner, result, dtype)
    return result


def max_force(element: JointFriction | RateMotor, dtype: DType) -> dict[str, Array]:
    """Returns the checked largest force of an element.

    Raises:
        ValueError: the force is negative.
    """
    value = checks.real(label(element), "max_force", element.max_force, dtype, least=0)
    return {"max_force": value}


@dataclass(frozen=True)
class Inequality(UserFunction):
    """A user's inequality φ(q, t) ≥ 0, one-sided row by row: 0 ≤ λ ⊥ φ ≥ 0.

    On generalized coordinates, the function is `function(q, t, params)` with the params of the
    system. On bodies, it is `function(*poses, t, params)` with the `Pose` of each body. It returns
    φ, (m,); automatic differentiation computes J. A step treats φ like the gap of a `Limit`: φ may
    reach zero but not become negative. A negative φ closes like a penetration of a `Limit`, at
    speeds in the unit of φ per second. A row whose φ reaches zero leaves at the rate −e φ̇.

    Attributes:
        function: the user's function, pure and hashable; define it once, since each new function
            object is traced again.
        bodies: names of the bodies; empty for generalized coordinates.
        name: name of the element, unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
        restitution: coefficient of restitution e, from 0 to 1.
        stiffness: stiffness k of a soft stop, force per unit of φ; None for a hard stop.
        damping: damping c of a soft stop, force per unit of φ̇.
        recovery: the largest speed at which a negative φ closes, in units of φ̇.
    """

    name: str = "inequality"
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1
    optional = ("restitution",)

    @property
    def bare(self) -> Inequality:
        """The element without its parameters, which are leaves of the system."""
        return Inequality(self.function, self.bodies, self.name)


class OneSided:
    """A group with one `Inequality`, on bodies or on generalized coordinates."""

    missing_field_hint = Elements.missing_field_hint
    unbounded_fields = ()
    coordinate = None

    def get(self: Any, i: int) -> dict[str, Any]:
        """Returns the parameters of the user's function and of the stop, by name."""
        numbers = {field: element_at(x, 0) for field, x in self.numbers.items()}
        return {"params": self.params} | numbers

    def set(self: Any, changes: Mapping[str, Any]) -> Any:
        """Returns the group with changed parameters; `changes` is {name: {field: value}}."""
        fields, name = dict(changes.get(self.law.name, {})), self.law.name
        params = fields.pop("params", self.params)
        new = {k: replace_at(f"{name}.{k}", self.numbers[k], 0, x) for k, x in fields.items()}
        check_ranges(name, fields, checks.chosen_dtype(self.numbers))
        return dataclasses.replace(self, params=params, numbers=self.numbers | new)

    def bounds(self: Any, snapshot: Snapshot, control: PyTree, dt: Array) -> BoundSet:
        """Returns the inequality rows at one instant, with their targets for a step of dt."""
        value, rate, _, jacobian = self.linearized(snapshot)
        count = len(value)
        if not count:
            raise ValueError(
                f"{label(self.law)}: the function must return at least one φ, an array (m,) with m"
                " ≥ 1; it returned an empty array."
            )
        pulls = tuple(Vector(*(block[:, i] for i in range(block.shape[1]))) for block in jacobian)
        row, fields = one_sided(self.numbers, Row(value, rate, 0.0, pulls), dt)
        places = tuple(spread_place(place, count) for place in self.places)
        return BoundSet("single", (row,), places, points=None if count == 1 else count, **fields)


@pytree
class InequalityOnBodies(OneSided, CustomOnBodies):
    """An `Inequality` on the poses of named bodies.

    Attributes:
        numbers: parameters of the stop, by field, lanes (1,).
    """

    numbers: dict[str, Lane] = dataclasses.field(default_factory=dict)


@pytree
class InequalityOnCoordinates(OneSided, CustomOnCoordinates):
    """An `Inequality` on generalized coordinates; its function uses the params of the system.

    Attributes:
        numbers: parameters of the stop, by field, lanes (1,).
    """

    numbers: dict[str, Lane] = dataclasses.field(default_factory=dict)


def numbers_of(element: Inequality, dtype: DType) -> dict[str, Lane]:
    """Returns the checked parameters of the stop, as lanes (1,).

    Raises:
        ValueError: a parameter is out of range.
    """
    return stack([stop(element, dtype)])
