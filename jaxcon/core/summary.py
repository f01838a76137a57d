"""Short descriptions of large objects, for `repr`."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Self, TypeAlias

import jax
import numpy as np

from jaxcon.core import checks
from jaxcon.core.status import Status
from jaxcon.core.typing import Array, PyTree, T

Index: TypeAlias = int | slice | Array | np.ndarray | tuple[int | slice | Array | np.ndarray, ...]
"""An index into the leading axes of a tree."""

SHOWN = 6
"""The largest number of names that `listed` shows; further names are only counted."""


def listed(
    names: Sequence[str], shown: int = SHOWN, rest: Callable[[int], str] = "{} more".format
) -> str:
    """Joins names by commas; of a long list, shows the first names and counts the others.

    Args:
        names: the names.
        shown: the largest number of names in the text.
        rest: a function from the number of names that are not shown to a text.
    """
    text = ", ".join(names[:shown])
    return text if len(names) <= shown else f"{text} and {rest(len(names) - shown)}"


def table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Formats a title and rows of two aligned columns; leaves out rows without a second text."""
    full = [(left, right) for left, right in rows if right]
    width = max((len(left) for left, _ in full), default=0)
    return "\n".join([title, *(f"  {left:<{width}}  {right}" for left, right in full)])


def of_class(x: T | type[T]) -> type[T]:
    """Returns the class of an instance, or its attribute `element`; returns a class unchanged."""
    kind: Any = x if isinstance(x, type) else getattr(x, "element", type(x))
    return kind


def by_class(elements: Iterable[tuple[type, str]]) -> list[tuple[str, str]]:
    """Groups (class, name) pairs by class; returns rows for `table`."""
    names: dict[str, list[str]] = {}
    for cls, name in elements:
        names.setdefault(cls.__name__, []).append(name)
    return [(cls, listed(members)) for cls, members in names.items()]


def shape(x: Array) -> str:
    """Describes an array by shape and dtype, and any other value by its shortened repr."""
    return f"{x.shape} {x.dtype}" if hasattr(x, "dtype") else checks.shortened(x)


def readable(x: PyTree) -> bool:
    """Returns True if all values of x are concrete, and stored on devices of this process."""
    return checks.is_concrete(x) and getattr(x, "is_fully_addressable", True)


def span(x: Array, unit: str = "") -> str:
    """Describes a number by its value, an array by its range, and a tracer by its shape."""
    if not isinstance(x, jax.Array | np.ndarray | np.generic | float) or not readable(x):
        return shape(x)
    values, unit = np.asarray(x), unit and f" {unit}"
    if values.ndim == 0:
        return f"{float(values):.6g}{unit}"
    if not values.size:
        return "empty"
    return f"{float(values.min()):.6g} to {float(values.max()):.6g}{unit}"


def codes(x: Array) -> str:
    """Describes status codes by name; for several codes, adds the number of worlds of each."""
    if not isinstance(x, jax.Array | np.ndarray | np.generic | int) or not readable(x):
        return shape(x)
    counts = zip(*np.unique(np.asarray(x), return_counts=True), strict=True)
    names = {c.value: c.name for c in Status}
    pairs = [(names.get(int(code), str(code)), count) for code, count in counts]
    if len(pairs) == 1:
        return pairs[0][0]
    return ", ".join(f"{name} ({count})" for name, count in pairs)


class Stacked:
    """A mixin that gives trees with leading axes a length and indexing, such as `path[::5]`."""

    def leading(self) -> tuple[int, ...]:
        """Returns the shape of the leading axes; () for one world."""
        raise NotImplementedError

    def __bool__(self) -> bool:
        """Returns True, even if the length of the leading axis is 0."""
        return True

    def __len__(self) -> int:
        """Returns the length of the first leading axis: worlds or instants.

        Raises:
            TypeError: there are no leading axes.
        """
        if not (shape := self.leading()):
            raise TypeError(f"a {type(self).__name__} of one world has no length.")
        return shape[0]

    def __getitem__(self, index: Index) -> Self:
        """Indexes the leading axes of every leaf, like an array.

        Args:
            index: an integer, slice or mask, or a tuple of these.

        Raises:
            TypeError: there are no leading axes.
            IndexError: an integer index is out of range, or the index is None, `...`, or longer
                than the leading axes.
        """
        len(self)
        each = index if isinstance(index, tuple) else (index,)
        if len(each) > len(self.leading()) or any(i is None or i is Ellipsis for i in each):
            raise IndexError(
                f"a {type(self).__name__} is indexed along its leading axes alone, of shape"
                f" {self.leading()}: give an integer, slice or mask for each."
            )
        for i, size in zip(each, self.leading(), strict=False):
            known = isinstance(i, jax.Array) and i.dtype != bool and checks.is_concrete(i)
            if isinstance(i, jax.Array) and not (known and i.ndim == 0):
                continue
            if isinstance(i, int | np.integer | jax.Array) and not -size <= int(i) < size:
                raise IndexError(f"index {int(i)} is out of range: an axis has {size}.")
        return jax.tree.map(lambda x: x[index], self)
