"""The layout of the flat arrays q, v and u: hashable host data, static while tracing.

Bodies of one kind form a group. Inside a group coordinates are component-major: all x, then all y,
and so on. Reshaping a slice of q to (component, body) then moves no data.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from jaxcon.core.checks import shortened
from jaxcon.core.lanes import Vector, take
from jaxcon.core.typing import Array, Lane

if TYPE_CHECKING:
    from jaxcon.system.bodies import Particle

WORLD = "world"
"""The name of the frame that does not move."""


@dataclass(frozen=True)
class Group:
    """Bodies of one kind, adjacent in q and v.

    Attributes:
        kind: the kinematics of such a body (`system.bodies`).
        names: names of the bodies.
        q, v: the first index of the group in q and in v.
    """

    kind: Particle
    names: tuple[str, ...]
    q: int
    v: int

    def unpack(self, q: Array, v: Array) -> tuple[Vector, Vector]:
        """Returns the coordinates and velocities of the group as Vectors of lanes (body, …)."""
        return (
            Vector.of_rows(q, self.q, self.kind.n_q, len(self.names)),
            Vector.of_rows(v, self.v, self.kind.n_v, len(self.names)),
        )


@dataclass(frozen=True)
class Place:
    """The bodies on which equal elements act, one body for each element.

    Attributes:
        group: the group of the bodies; None for frames that are fixed to the world.
        indices: indices of the bodies in the group, one for each element.
        fixed: names of frames that are fixed to the world, one for each element.
    """

    group: int | None
    indices: tuple[int, ...]
    fixed: tuple[str, ...] = ()

    def take(self, x: Lane) -> Lane:
        """Gathers the values of these bodies from a lane (body, …) to a lane (element, …)."""
        return take(x, self.indices)


WHOLE = Place(0, (0,))
"""The place of an element on generalized coordinates, which count as the only body of a group."""


@dataclass(frozen=True)
class Layout:
    """The map from names to indices in q, v and u.

    Attributes:
        dim: 2 or 3.
        groups: groups of bodies with coordinates, in the order of q.
        fixed: names of the frames fixed to the world.
        controls: (name, start, stop) of each control channel.
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
        """The number of position coordinates."""
        return sum(g.kind.n_q * len(g.names) for g in self.groups)

    @property
    def n_v(self) -> int:
        """The number of velocities."""
        return sum(g.kind.n_v * len(g.names) for g in self.groups)

    @property
    def n_u(self) -> int:
        """The number of control inputs."""
        return max((stop for _, _, stop in self.controls), default=0)

    @property
    def bodies(self) -> tuple[str, ...]:
        """The names of the bodies with coordinates."""
        return tuple(self.places)

    @cached_property
    def places(self) -> dict[str, tuple[int, int]]:
        """The group and the index of each body with coordinates, by name."""
        return {n: (g, i) for g, group in enumerate(self.groups) for i, n in enumerate(group.names)}

    def locate(self, name: str) -> tuple[int, int]:
        """Returns the group of a body, and its index in the group.

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
        """Returns the indices of a body's coordinates in q.

        Args:
            name: name of the body.
        """
        group, index = self.locate(name)
        g = self.groups[group]
        return g.q + index + len(g.names) * np.arange(g.kind.n_q)

    def without_orientation(self, q: Array | np.ndarray) -> list[str]:
        """Returns the names of the bodies whose quaternion is zero at positions q, (n_q,)."""
        q = np.asarray(q)
        turning = [n for n in self.bodies if self.groups[self.locate(n)[0]].kind.n_q == 7]
        return [name for name in turning if not np.any(q[self.q(name)[3:]])]

    def v(self, name: str) -> np.ndarray:
        """Returns the indices of a body's velocities in v.

        Args:
            name: name of the body.
        """
        group, index = self.locate(name)
        g = self.groups[group]
        return g.v + index + len(g.names) * np.arange(g.kind.n_v)

    def control(self, name: str) -> slice:
        """Returns the slice of a control channel in the control array.

        Args:
            name: name of the element.

        Raises:
            ValueError: no element has a control channel of this name.
        """
        for owner, start, stop in self.controls:
            if owner == name:
                return slice(start, stop)
        channels = [owner for owner, _, _ in self.controls]
        raise ValueError(f"'{name}' has no control channel; those that have are {channels}.")
