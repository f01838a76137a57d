"""One-sided constraints from a user's function, on generalized coordinates or on named bodies."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from jaxcon.constraints import autodiff
from jaxcon.constraints.bounds import BoundSet
from jaxcon.constraints.custom import CustomOnBodies, CustomOnCoordinates
from jaxcon.constraints.limits import one_sided, stop
from jaxcon.constraints.point_sets import spread_place
from jaxcon.constraints.primitives import Row
from jaxcon.constraints.ranges import check_ranges
from jaxcon.core.lanes import Vector
from jaxcon.core.pytree import pytree
from jaxcon.core.typing import Array, Lane, PyTree
from jaxcon.model.elements import Elements, element_at, replace_at, stack


@dataclass(frozen=True)
class Inequality:
    """φ(q, t) ≥ 0 from a user's function, one-sided: 0 ≤ λ ⊥ φ ≥ 0, row by row.

    The function is that of `Holonomic`: `function(q, t, params)` on generalized coordinates, with
    the system's params, and `function(*poses, t, params)` on bodies, with the `Pose` of each. It
    returns φ, (m,); J is found by automatic differentiation. A step treats each row as `Limit` does
    its gap. It may close and not become negative, a negative φ closes like a penetration there, at
    speeds in the unit of φ per second, and a row that arrives leaves with −e φ̇.

    Attributes:
        function: pure and hashable; define it once, since every new function object is a new trace.
        bodies: names; empty for generalized coordinates.
        name: unique in the system.
        params: any pytree of arrays, leaves of the system; on bodies only.
        restitution: e, 0 to 1.
        stiffness: k of a soft stop, a force by a unit of φ; None for a hard one.
        damping: its c, a force by a unit of φ̇.
        recovery: the fastest way back, in units of φ̇.
    """

    function: Callable[..., Array]
    bodies: tuple[str, ...] = ()
    name: str = "inequality"
    params: PyTree = None
    restitution: Any = 0.0
    stiffness: Any = None
    damping: Any = 0.0
    recovery: Any = 0.1

    def rate(self, call: Callable[..., Array], kinematics: autodiff.Kinematics) -> Any:
        """φ̇(q, v, t)."""
        return autodiff.holonomic_rate(lambda q, t: call(q, None, t), kinematics)

    def value(self, call: Callable[..., Array], q: PyTree, t: Any) -> Array:
        """φ(q, t)."""
        return call(q, None, t)

    @property
    def bare(self) -> Inequality:
        """Without its numbers, which are leaves of the system."""
        return Inequality(self.function, self.bodies, self.name)


class OneSided:
    """What a group of one `Inequality` has, besides its function, on whatever coordinates."""

    optional = ("restitution",)
    why_without = Elements.why_without

    def get(self: Any, i: int) -> dict[str, Any]:
        """The user's parameters, and the numbers of the stop."""
        numbers = {field: element_at(x, 0) for field, x in self.numbers.items()}
        return {"params": self.params} | numbers

    def set(self: Any, changes: Mapping[str, Any]) -> Any:
        """With other numbers; `changes` by name and field."""
        own, name = dict(changes.get(self.law.name, {})), self.law.name
        params = own.pop("params", self.params)
        new = {k: replace_at(f"{name}.{k}", self.numbers[k], 0, x) for k, x in own.items()}
        check_ranges(name, own)
        return dataclasses.replace(self, params=params, numbers=self.numbers | new)

    def bounds(self: Any, snapshot: Any, control: Any, dt: Any) -> BoundSet:
        """The rows at one instant, and what a step of dt wants of them."""
        value, rate, _, jacobian = self.linearized(snapshot)
        count = len(value)
        pulls = tuple(Vector(*(block[:, i] for i in range(block.shape[1]))) for block in jacobian)
        row, asked = one_sided(self.numbers, Row(value, rate, 0.0, pulls), dt)
        places = tuple(spread_place(place, count) for place in self.places)
        return BoundSet("single", (row,), places, points=None if count == 1 else count, **asked)


@pytree
class InequalityOnBodies(OneSided, CustomOnBodies):
    """An `Inequality` on the poses of named bodies.

    Attributes:
        numbers: of the stop, by field, lanes (1,).
    """

    numbers: dict[str, Lane] = dataclasses.field(default_factory=dict)


@pytree
class InequalityOnCoordinates(OneSided, CustomOnCoordinates):
    """An `Inequality` on generalized coordinates; its function's parameters are the system's.

    Attributes:
        numbers: of the stop, by field, lanes (1,).
    """

    numbers: dict[str, Lane] = dataclasses.field(default_factory=dict)


def numbers_of(element: Inequality, dtype: Any) -> dict[str, Lane]:
    """The numbers of the stop, checked, lanes (1,).

    Raises:
        ValueError: one is out of range.
    """
    return stack([stop(element, dtype)])
