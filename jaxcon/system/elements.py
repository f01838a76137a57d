"""Batches of equal elements: the numbers of many joints or springs as lanes (element,)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks
from jaxcon.core.lanes import Vector, take
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, Lane, PyTree
from jaxcon.geometry.pose import Pose
from jaxcon.system.layout import WHOLE, Place

if TYPE_CHECKING:
    from jaxcon.system.body_system import Snapshot


class Named(Protocol):
    """An element of any class that has a name."""

    @property
    def name(self) -> str:
        """The name of the element, unique in the scene."""
        ...


class Element:
    """The base class of joints, constraints and forces as a user describes them.

    The class attributes are options. A class without this base has the default options.
    """

    name: str
    dims: ClassVar[tuple[int, ...]] = (2, 3)
    """The dimensions of scenes in which the element exists."""
    oriented: ClassVar[bool] = False
    """True if the bodies of the element need an orientation; particles are then refused."""
    turns: ClassVar[bool] = False
    """True if the element has a field `axis` that is given in space only."""
    framed: ClassVar[bool] = False
    """True if `attach` also takes the user's frames of the element's bodies."""
    in_b: ClassVar[tuple[str, ...]] = ()
    """The fields in the frame of the second body, besides fields whose names end in `_b`."""
    by_principal_axes: ClassVar[bool] = False
    """True if the element depends on the principal axes of its bodies, which must not change."""
    repeats: ClassVar[bool] = False
    """True if several bodies of the element may be the same one; its coordinate is then used by
    tendons only."""
    controls: Any = 0
    """The number of control inputs."""
    counts: ClassVar[bool] = True
    """True if the element acts on the angle of a joint with its whole turns."""
    angles: ClassVar[tuple[str, ...]] = ()
    """The fields that are angles if the joint's coordinate is an angle."""
    unbounded_fields: ClassVar[tuple[str, ...]] = ()
    """The fields that may be infinite, such as the limit of a joint without a stop."""
    optional: ClassVar[tuple[str, ...]] = ()
    """The fields that remove rows if they are the Python number 0, such as a contact's friction."""
    ranges: ClassVar[Mapping[str, checks.NumberRange]] = MappingProxyType({})
    """The valid ranges of numbers by field."""
    nonzero: ClassVar[tuple[str, ...]] = ()
    """The fields that must not be zero."""

    @property
    def kind(self) -> Any:
        """A hashable value by which elements are grouped: the class, unless overridden."""
        return type(self)

    @classmethod
    def check_numbers(cls, owner: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks the ranges of an element's numbers; skips traced values and fields that are None.

        `build` calls it with the fields that the user gave, and `with_params` with changed numbers.

        Args:
            owner: first words of errors.
            numbers: the numbers by field; other fields are ignored.
            dtype: dtype of the scene, in which numbers are compared: in float32, 1e-50 is zero.

        Raises:
            ValueError: a number is out of range.
        """
        for field, limits in cls.ranges.items():
            if numbers.get(field) is not None:
                checks.check(owner, field, numbers[field], dtype=dtype, **limits)
        for field in cls.nonzero:
            if numbers.get(field) is not None:
                checks.nonzero(owner, field, numbers[field], dtype)


class BetweenBodies(Element):
    """The base class of elements between two bodies, given by their names."""

    body_a: str
    body_b: str

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies on which the element acts."""
        return (self.body_a, self.body_b)


class Grid(NamedTuple):
    """A field of many elements, kept as one array: contact points, or heights of a height field.

    A Vector would make a separate lane of each number.

    Attributes:
        values: the numbers, (element, …).
    """

    values: Array


Numbers: TypeAlias = Array | Vector | Grid
"""One field of many elements: a lane (element,), a Vector of lanes, or a Grid."""


@pytree
class Elements:
    """Elements of one class on bodies of the same kinds.

    Attributes:
        params: the numbers by field: a lane (element,), a Vector of lanes, or a Grid.
        names: names of the elements.
        places: the bodies on which the elements act, one Place for each side.
        law: the class of the elements, or their common `kind`.
    """

    params: dict[str, Any]
    names: tuple[str, ...] = static()
    places: tuple[Place, ...] = static()
    law: Any = static(default=Element)

    @property
    def unbounded_fields(self) -> tuple[str, ...]:
        """The fields that may be infinite."""
        return self.law.unbounded_fields

    def missing_field_hint(self, fields: set[str]) -> str:
        """Explains, for an error message, why the elements lack some optional fields.

        Args:
            fields: the missing fields.
        """
        if not (left := fields & set(self.law.optional)):
            return ""
        field = min(left)
        return (
            f" A {field} given as the number 0 leaves no rows to change: build the scene with"
            f" another, or with {field}=jnp.zeros(())."
        )

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns the anchors on the elements' last body, world frame [m]; None without anchors."""
        for field, side in (("anchor_b", 1), ("anchor", 0)):
            if isinstance(self.params.get(field), Vector):
                return snapshot.frame(self.places[side]).point(self.params[field]).position
        return None

    def potential(self, snapshot: Snapshot) -> Iterable[Lane]:
        """Returns the energy stored in each element [J]; empty by default."""
        return ()

    def frames(self, snapshot: Snapshot) -> tuple[Any, ...]:
        """Returns the `BodyFrame` of the bodies on each side."""
        return tuple(snapshot.frame(place) for place in self.places)

    def get(self, i: int) -> dict[str, Any]:
        """Returns the numbers of element i, by field."""
        return {field: element_at(x, i) for field, x in self.params.items()}

    def set(self, changes: Mapping[str, Any]) -> Self:
        """Returns the elements with changed numbers; `changes` is {name: {field: value}}."""
        params = dict(self.params)
        for i, name in enumerate(self.names):
            given = changes.get(name, {})
            for field, value in given.items():
                params[field] = replace_at(
                    f"{name}.{field}", params[field], i, value, field in self.unbounded_fields
                )
            if given:
                dtype = checks.chosen_dtype(self.params)
                self.check_numbers(name, self.get(i) | dict(given), dtype)
        return dataclasses.replace(self, params=params)

    def check_numbers(self, name: str, numbers: Mapping[str, Any], dtype: DType) -> None:
        """Checks the numbers of one element by the method `check_numbers` of its class.

        Args:
            name: name of the element, for errors.
            numbers: the numbers by field.
            dtype: dtype of the scene, in which they are compared.
        """
        self.law.check_numbers(name, numbers, dtype)

    def select(self, indices: tuple[int, ...]) -> Self:
        """Returns the elements with the given indices."""
        return dataclasses.replace(
            self,
            params=jax.tree.map(lambda x: take(x, indices), self.params),
            names=tuple(self.names[i] for i in indices),
            places=tuple(
                Place(
                    p.group,
                    tuple(p.indices[i] for i in indices if p.indices),
                    tuple(p.fixed[i] for i in indices if p.fixed),
                )
                for p in self.places
            ),
        )


@pytree
class UserElement:
    """An element that calls a user's function.

    Attributes:
        params: parameters of the function.
        law: the element without its params.
        places: the bodies on which the element acts.
    """

    params: PyTree
    law: Any = static()
    places: tuple[Place, ...] = static(default=(WHOLE,))

    @property
    def names(self) -> tuple[str, ...]:
        """A tuple with the name of the element."""
        return (self.law.name,)

    def get(self, i: int) -> dict[str, Any]:
        """Returns the user's parameters as the field "params"."""
        return {"params": self.params}

    def set(self, changes: Mapping[str, Any]) -> Self:
        """Returns the element with changed parameters; `changes` is {name: {"params": value}}."""
        given = changes.get(self.law.name, {})
        if "params" not in given:
            return self
        checks.parameters(self.law.name, given["params"])
        return dataclasses.replace(self, params=given["params"])

    def anchors(self, snapshot: Snapshot) -> Vector | None:
        """Returns None: a user's function has no anchor."""
        return None


def stack(elements: list[dict[str, Any]]) -> dict[str, Any]:
    """Stacks the numbers of elements: scalars () become lanes, arrays (n,) Vectors of lanes."""

    def stacked(*numbers: Array | Grid) -> Numbers:
        if isinstance(numbers[0], Grid):
            return Grid(side_by_side([x.values for x in numbers if isinstance(x, Grid)], axis=0))
        lanes = side_by_side([x for x in numbers if not isinstance(x, Grid)])
        return lanes if lanes.ndim == 1 else Vector.of(lanes)

    return jax.tree.map(stacked, *elements, is_leaf=lambda x: isinstance(x, Grid))


def side_by_side(arrays: Sequence[Array], axis: int = -1) -> Array:
    """Stacks arrays along a new axis; uses NumPy if all are concrete, which is faster for many."""
    if checks.is_concrete(arrays):
        return jnp.asarray(np.stack([np.asarray(x) for x in arrays], axis=axis))
    return jnp.stack(arrays, axis=axis)


def element_at(x: Numbers, i: int) -> Array:
    """Returns the number (), vector (n,) or grid of element i."""
    if isinstance(x, Grid):
        return x.values[i]
    return Vector(*(lane[i] for lane in x)).stack() if isinstance(x, Vector) else x[i]


def replace_at(owner: str, x: Numbers, i: int, value: PyTree, unbounded: bool = False) -> Any:
    """Replaces the number, vector or grid of one element.

    Args:
        owner: name and field of the element, for error messages.
        x: the field of all elements.
        i: index of the element.
        value: the new value.
        unbounded: True if the value may be infinite.

    Raises:
        ValueError: a wrong shape or dtype, or a value that is not finite.
    """
    like = jax.eval_shape(element_at, x, i)
    new = checks.real(owner, "the new value", value, like.dtype, like.shape, finite=not unbounded)
    parts = Vector.of(new) if isinstance(x, Vector) else Grid(new) if isinstance(x, Grid) else new
    return jax.tree.map(lambda lane, part: lane.at[i].set(part), x, parts)


def label(element: Named) -> str:
    """Returns the class and name of an element, for error messages."""
    return f"{type(element).__name__} '{element.name}'"


def own_point(element: Named, what: str, point: PyTree, pose: Pose) -> Array:
    """Returns a checked point, world frame, or the body's position if `point` is None.

    Raises:
        ValueError: a wrong shape or dtype, a value that is not finite, or a point of a particle
            other than its position.
    """
    if point is None:
        return pose.position
    owner = label(element)
    point = checks.real(owner, what, point, pose.position.dtype, pose.position.shape)
    checkable = pose.orientation is None and checks.is_concrete((point, pose.position))
    if checkable and not np.allclose(point, pose.position, rtol=1e-5, atol=1e-6):
        raise ValueError(
            f"{owner}: {what} is {checks.numerals(point)}, but a particle has no other point than"
            f" its position {checks.numerals(pose.position)}."
        )
    return point
