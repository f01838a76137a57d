"""Where everything lies in the flat arrays: host data, hashable, part of the trace.

Bodies of one kind form a group. Inside a group coordinates are component-major: all x, then all y,
and so on, so that reshaping a slice of q to (component, body) moves nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxcon.core.checks import shortened
from jaxcon.core.lanes import Vector, take
from jaxcon.core.typing import Array, Lane

WORLD = "world"
"""The name of the frame that does not move."""


@dataclass(frozen=True)
class Group:
    """Bodies of one kind, side by side.

    Attributes:
        kind: how such a body moves (`model.bodies`).
        names: of its bodies.
        q, v: where the group's coordinates and velocities begin.
    """

    kind: Any
    names: tuple[str, ...]
    q: int
    v: int

    def unpack(self, q: Array, v: Array) -> tuple[Vector, Vector]:
        """The group's coordinates and velocities by components, each lane (body, …)."""
        return (
            Vector.of_rows(q, self.q, self.kind.n_q, len(self.names)),
            Vector.of_rows(v, self.v, self.kind.n_v, len(self.names)),
        )


@dataclass(frozen=True)
class Place:
    """Which bodies a set of elements acts on: those with these indices in one group.

    Attributes:
        group: None for frames that are fixed to the world.
        indices: in the group, one for each element.
        fixed: names of frames that are fixed to the world, one for each element.
    """

    group: int | None
    indices: tuple[int, ...]
    fixed: tuple[str, ...] = ()

    def take(self, x: Lane) -> Lane:
        """The lanes of these bodies, from a lane (body, …)."""
        return take(x, self.indices)


@dataclass(frozen=True)
class Layout:
    """The map from names to places.

    Attributes:
        dim: 2 or 3.
        groups: of bodies with coordinates, in the order of q.
        fixed: names of the frames fixed to the world.
        controls: name and slice of each control channel.
    """

    dim: int
    groups: tuple[Group, ...]
    fixed: tuple[str, ...]
    controls: tuple[tuple[str, int, int], ...]

    @cached_property
    def angles(self) -> slice | None:
        """The slice of q with the angles of rigid bodies in the plane, or None."""
        for group in self.groups:
            if group.kind.turns:
                end = group.q + group.kind.n_q * len(group.names)
                return slice(end - len(group.names), end)
        return None

    @property
    def n_q(self) -> int:
        """Number of position coordinates."""
        return sum(g.kind.n_q * len(g.names) for g in self.groups)

    @property
    def n_v(self) -> int:
        """Number of velocities."""
        return sum(g.kind.n_v * len(g.names) for g in self.groups)

    @property
    def n_u(self) -> int:
        """Number of control inputs."""
        return max((stop for _, _, stop in self.controls), default=0)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies with coordinates."""
        return tuple(self.places)

    @cached_property
    def places(self) -> dict[str, tuple[int, int]]:
        """Group and index of each body with coordinates, by name."""
        return {n: (g, i) for g, group in enumerate(self.groups) for i, n in enumerate(group.names)}

    def locate(self, name: str) -> tuple[int, int]:
        """Group and index of a body.

        Raises:
            ValueError: no body has this name, or it has no coordinates.
        """
        if not isinstance(name, str):
            raise ValueError(f"a body must be given by its name, got {shortened(name)}.")
        if name in self.places:
            return self.places[name]
        reason = "is fixed to the world" if name in (WORLD, *self.fixed) else "is unknown"
        raise ValueError(f"body '{name}' {reason}; the bodies that move are {list(self.bodies)}.")

    def q(self, name: str) -> np.ndarray:
        """Indices of a body's coordinates in q.

        Args:
            name: of the body.
        """
        group, index = self.locate(name)
        g = self.groups[group]
        return g.q + index + len(g.names) * np.arange(g.kind.n_q)

    def v(self, name: str) -> np.ndarray:
        """Indices of a body's velocities in v.

        Args:
            name: of the body.
        """
        group, index = self.locate(name)
        g = self.groups[group]
        return g.v + index + len(g.names) * np.arange(g.kind.n_v)

    def control(self, name: str) -> slice:
        """Where a control channel lies in the control array.

        Args:
            name: of the element.

        Raises:
            ValueError: no element has a control channel of this name.
        """
        for owner, start, stop in self.controls:
            if owner == name:
                return slice(start, stop)
        known = [owner for owner, _, _ in self.controls]
        raise ValueError(f"'{name}' has no control channel; those that have are {known}.")
