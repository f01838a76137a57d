"""Which bounded rows belong to which element, and what they did during a step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array


class UnknownElementError(KeyError, ValueError):
    """No element has this name: a KeyError to who takes reactions for a mapping."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class BoundLayout:
    """Which rows belong to which element.

    Attributes:
        entries: of each: name, its rows, and how many points there are with as many, one after the
            other; None for an element that is one.
    """

    entries: tuple[tuple[str, tuple[int, ...], int | None], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the elements, in the order of their rows."""
        return tuple(name for name, *_ in self.entries)

    def rows(self, name: str) -> np.ndarray:
        """The row numbers of an element, (rows,), or of its points, (points, rows).

        Raises:
            UnknownElementError: no element has this name.
        """
        if not isinstance(name, str) or name not in self._places:
            raise UnknownElementError(f"element '{name}' is unknown; known are {list(self.names)}.")
        rows, points = self._places[name]
        one = np.array(rows)
        return one if points is None else np.arange(points)[:, None] + one[None]

    @property
    def owners(self) -> np.ndarray:
        """The number of the element that has a row, (n,)."""
        rows = [self.rows(name).ravel() for name in self.names]
        owners = np.zeros(sum(map(len, rows)), np.int32)
        for i, own in enumerate(rows):
            owners[own] = i
        return owners

    @cached_property
    def _places(self) -> dict[str, Any]:
        return {name: place for name, *place in self.entries}


@pytree
class Reactions(Mapping[str, Array]):
    """What bounded rows did during a step; `reactions["stop"]` is the force of one element.

    A mapping from names of elements to their forces: `in`, `iter`, `len`, `items()` and `get`.

    Attributes:
        multipliers: λ (n,) [N, N m], means over the step: of an impact, its impulse over h. If the
            impact comes in the second half of a semi-implicit step, they lack what a one-sided row
            bore before it.
        gap: φ at its start, (n,); zero where a row has none.
        residual: by how much the laws are missed, as a velocity, ().
        kept: the part of the bounce that adds no energy, from 0 to 1, (): 1 unless it was capped.
        jump: what impacts within the step change at its end; None where there are none to come,
            and once an integrator has taken it.
        layout: rows by element.
    """

    multipliers: Array
    gap: Array
    residual: Array
    kept: Array
    jump: Any
    layout: BoundLayout = static()
    # a mapping compares its items, which are arrays without a single truth value
    __eq__ = object.__eq__
    __hash__ = object.__hash__  # type: ignore[assignment]

    def __iter__(self) -> Iterator[str]:
        """The names of the elements."""
        return iter(self.layout.names)

    def __len__(self) -> int:
        """The number of elements."""
        return len(self.layout.names)

    def __getitem__(self, name: str) -> Array:
        """λ of an element, (1,); of a contact that of the normal and of the tangents, (1 + t,).

        What resists rolling and spinning comes after, moments along the tangents and about the
        normal [N m].
        Of an element of k points, as a box, that of each, (k, …).
        """
        return self.multipliers[..., self.layout.rows(name)]
