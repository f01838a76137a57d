"""Bounded rows of which only the nearest are solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.solvers.bounded import Kinds, is_exact
from jaxcon.solvers.interior_point import InteriorPoint


@pytree
class Nearest(checks.Checked):
    """Solves as many one-sided rows and contacts as asked, those that are nearest to act.

    Where many could touch and few do, this saves what bounded rows cost beyond their joints: one
    solution of the joints a row, the square of the number of rows a sweep, and its cube an
    iteration of the interior point. Nearest are those whose velocity u₀ without any bounded row,
    less the u* that it must not fall below, is least beside √(J M⁻¹ Jᵀ), by which rows of different
    units and masses compare; rows that joints hold are not among them. Motors and friction in
    joints are always solved. What is left out has λ = 0 in this step; by how much such a row misses
    its u*, if it does, is part of `info.reactions.residual`.

    Attributes:
        solver: `InteriorPoint()` or `GaussSeidel()`, of the chosen rows.
        contacts: how many contacts of a world are solved at most; None for all.
        stops: how many other one-sided rows, as limits, ropes and contacts without friction; None
            for all.
    """

    solver: Any = InteriorPoint()
    contacts: int | None = static(default=None)
    stops: int | None = static(default=None)

    @property
    def warm(self) -> bool:
        """Returns True where the solver starts where the last step ended."""
        return self.solver.warm

    @property
    def exact(self) -> bool:
        """Returns True where the solver finds the multipliers to full precision."""
        return is_exact(self.solver)

    @property
    def smoothing(self) -> Any:
        """The width of smoothed corners of the laws, for the derivative only [m/s, rad/s]."""
        return getattr(self.solver, "smoothing", None)  # what has none is refused by `check`

    def check(self) -> None:
        """Checks the numbers, and the solver.

        Raises:
            ValueError: a number that is no count, or a solver that is none of bounded rows.
        """
        for what in ("contacts", "stops"):
            if getattr(self, what) is not None:
                checks.count("Nearest", what, getattr(self, what))
        if isinstance(self.solver, Nearest) or not hasattr(self.solver, "smoothing"):
            raise ValueError(
                "Nearest: solver must be one of bounded rows, as InteriorPoint() or GaussSeidel(),"
                f" got {self.solver!r}."
            )
        self.solver.check()

    def leaves_out(self, kinds: Kinds) -> bool:
        """Returns True where there are more rows than are solved."""
        pairs = ((self.stops, kinds.single), (self.contacts, kinds.contacts))
        return any(most is not None and most < count for most, count in pairs)

    def choose(self, kinds: Kinds, distance: Array) -> Choice:
        """The rows to be solved, by how far each is from acting (n,).

        Raises:
            ValueError: some contacts only, in a scene where some resist turning.
        """
        parts = kinds.split(distance)
        single = _least(parts.single, self.stops)
        contact = _least(parts.normal, self.contacts)
        boxes = _least(parts.box, None) + kinds.single
        ranks = [kinds.normal + rank * kinds.contacts for rank in range(1 + kinds.tangents)]
        if kinds.turning and len(contact) < kinds.contacts:
            raise ValueError(
                "Nearest: contacts that resist rolling or spinning are solved all together; give no"
                f" contacts= in their scene, got {self.contacts} of {kinds.contacts}."
            )
        own = Kinds(len(single), kinds.boxes, len(contact), kinds.tangents, kinds.turning)
        turning = _least(distance[kinds.starts[1] :], None) + kinds.starts[1]
        rows = [single, boxes, *(contact + x for x in ranks), turning]
        return Choice(jnp.concatenate(rows), own, kinds)


@dataclass(frozen=True)
class Choice:
    """Some rows of many, other ones in each world.

    Attributes:
        rows: their numbers, (k,).
        kinds: how many there are of each law.
        whole: how many there were.
    """

    rows: Array
    kinds: Kinds
    whole: Kinds

    def take(self, x: Array) -> Array:
        """Returns the chosen rows (k, …) of an array (n, …)."""
        return jnp.take_along_axis(x, self.rows, axis=0)

    def contacts(self, x: Array) -> Array:
        """Returns the numbers of the chosen contacts."""
        normals = self.kinds.split(self.rows).normal - self.whole.normal
        return jnp.take_along_axis(x, normals, axis=0)

    def put(self, x: Array) -> Array:
        """Among zeros, (n, …)."""
        return jnp.sum(jnp.where(self.places(), x[None], 0), axis=1)

    def places(self) -> Array:
        """Returns True where a row is the i-th chosen one, (n, k, …)."""
        every = jnp.arange(self.whole.size, dtype=self.rows.dtype)
        return self.rows[None] == every.reshape(-1, *(1,) * self.rows.ndim)


def _least(x: Array, count: int | None) -> Array:
    """The numbers of the least along the first axis."""
    if count is None or count >= len(x):
        every = jnp.arange(len(x), dtype=jnp.int32)
        return jnp.broadcast_to(every.reshape(-1, *(1,) * (x.ndim - 1)), x.shape)
    return jnp.moveaxis(jax.lax.top_k(-jnp.moveaxis(x, 0, -1), count)[1], -1, 0)
