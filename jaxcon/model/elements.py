"""Equal elements side by side: the numbers of many joints or springs as lanes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Vector, take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Pose
from jaxcon.model.layout import Place


class Grid(NamedTuple):
    """Numbers of elements that stay one array (element, …): points of a set, heights of a field.

    As a Vector each of them would be a lane.
    """

    values: Array


@pytree
class Elements:
    """Elements of one class on bodies of the same kinds.

    Attributes:
        params: by field, a lane (element,), a Vector of such, or a Grid.
        names: of the elements.
        places: the bodies they act on, one Place for each side.
    """

    params: dict[str, Any]
    names: tuple[str, ...] = static()
    places: tuple[Place, ...] = static()

    @property
    def endless(self) -> tuple[str, ...]:
        """The fields that may be infinite, as the side on which a joint has no stop."""
        return getattr(getattr(self, "law", None), "endless", ())

    @property
    def optional(self) -> tuple[str, ...]:
        """The fields that the number 0 leaves out, as the friction of a smooth contact."""
        return getattr(getattr(self, "law", None), "optional", ())

    def why_without(self, fields: set[str]) -> str:
        """Why fields are missing that these elements may have."""
        if not (left := fields & set(self.optional)):
            return ""
        field = min(left)
        return (
            f" A {field} given as the number 0 leaves no rows to change: build the scene with"
            f" another, or with {field}=jnp.zeros(())."
        )

    def frames(self, snapshot: Any) -> tuple[Any, ...]:
        """The motion of the bodies on each side."""
        return tuple(snapshot.frame(place) for place in self.places)

    def get(self, i: int) -> dict[str, Any]:
        """The numbers of one element, by field."""
        return {field: element_at(x, i) for field, x in self.params.items()}

    def set(self, changes: Mapping[str, Any]) -> Any:
        """The elements with other numbers; `changes` by name and field."""
        params = dict(self.params)
        for i, name in enumerate(self.names):
            given = changes.get(name, {})
            for field, value in given.items():
                params[field] = replace_at(
                    f"{name}.{field}", params[field], i, value, field in self.endless
                )
            if given:
                self.check_numbers(name, self.get(i) | dict(given))
        return dataclasses.replace(self, params=params)

    def check_numbers(self, name: str, numbers: Mapping[str, Any]) -> None:
        """Checks the numbers of one element, by field, where some of them are changed."""

    def select(self, indices: tuple[int, ...]) -> Any:
        """Some of the elements."""
        places = [
            Place(
                p.group,
                tuple(p.indices[i] for i in indices if p.indices),
                tuple(p.fixed[i] for i in indices if p.fixed),
            )
            for p in self.places
        ]
        return dataclasses.replace(
            self,
            params=jax.tree.map(lambda x: take(x, indices), self.params),
            names=tuple(self.names[i] for i in indices),
            places=tuple(places),
        )


def stack(elements: list[dict[str, Any]]) -> dict[str, Any]:
    """The numbers of elements side by side: arrays (), (n,) become lanes, Vectors of lanes."""
    return jax.tree.map(_stacked, *elements, is_leaf=lambda x: isinstance(x, Grid))


def _stacked(*numbers: Any) -> Any:
    if isinstance(numbers[0], Grid):
        return Grid(side_by_side([x.values for x in numbers], axis=0))
    lanes = side_by_side(numbers)
    return lanes if lanes.ndim == 1 else Vector.of(lanes)


def side_by_side(arrays: Sequence[Array], axis: int = -1) -> Array:
    """Arrays along a new axis; on the host where they are known, since they may be many."""
    if checks.is_concrete(arrays):
        return jnp.asarray(np.stack([np.asarray(x) for x in arrays], axis=axis))
    return jnp.stack(arrays, axis=axis)


def element_at(x: Any, i: int) -> Array:
    """The number (), vector (n,) or grid of one element."""
    if isinstance(x, Grid):
        return x.values[i]
    return Vector(*(lane[i] for lane in x)).stack() if isinstance(x, Vector) else x[i]


def replace_at(owner: str, x: Any, i: int, value: Any, endless: bool = False) -> Any:
    """The lanes with one element's number, vector or grid replaced.

    Raises:
        ValueError: a wrong shape or dtype, or not finite, naming the owner.
    """
    if isinstance(x, Grid):
        known, shape = x.values, x.values.shape[1:]
    else:
        known, shape = (x[0], (len(x),)) if isinstance(x, Vector) else (x, ())
    new = checks.real(owner, "the new value", value, known.dtype, shape, finite=not endless)
    if isinstance(x, Grid):
        return Grid(x.values.at[i].set(new))
    if not isinstance(x, Vector):
        return x.at[i].set(new)
    pairs = zip(x, Vector.of(new), strict=True)
    return Vector(*(lane.at[i].set(component) for lane, component in pairs))


def label(element: Any) -> str:
    """What errors call an element: its class and name."""
    return f"{type(element).__name__} '{element.name}'"


def own_point(element: Any, what: str, point: Any, pose: Pose) -> Array:
    """A world point that is to be attached to a body: its position unless given.

    Raises:
        ValueError: a wrong shape or dtype, not finite, or off a particle, which has no other point.
    """
    if point is None:
        return pose.position
    owner = label(element)
    point = checks.real(owner, what, point, pose.position.dtype, pose.position.shape)
    known = pose.orientation is None and checks.is_concrete((point, pose.position))
    if known and not np.allclose(point, pose.position, rtol=1e-5, atol=1e-6):
        raise ValueError(
            f"{owner}: {what} is {checks.numerals(point)}, but a particle has no other point than"
            f" its position {checks.numerals(pose.position)}."
        )
    return point
