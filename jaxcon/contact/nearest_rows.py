"""Restricts the solution to the inequality rows that are nearest to becoming active."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxcon.contact.bounded import Bounded, RowCounts
from jaxcon.contact.interior_point import InteriorPoint
from jaxcon.core import checks
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.protocols import ContactSolver


@pytree
class ActiveSet(checks.Checked, ContactSolver):
    """Solves a limited number of one-sided rows and contacts, those nearest to becoming active.

    This saves time if many bodies could touch but few do. Each row costs a solve with the joints. A
    Gauss–Seidel sweep costs the square of the number of rows, an interior-point iteration its cube.

    Rows are ranked by (u₀ − u*)/√(J M⁻¹ Jᵀ), where u₀ is the velocity without any inequality row.
    The root makes rows of different units and masses comparable. Rows that the joints make
    immovable are not chosen. Motors and friction in joints are always solved. Rows that are not
    chosen have λ = 0 in this step; their target violation is part of `info.reactions.residual`.

    Attributes:
        solver: contact solver for the chosen rows, `InteriorPoint()` or `GaussSeidel()`.
        contacts: largest number of contacts solved in a world; None for all.
        stops: largest number of other one-sided rows solved in a world (limits, ropes and contacts
            without friction); None for all.
    """

    solver: ContactSolver = InteriorPoint()
    contacts: int | None = static(default=None)
    stops: int | None = static(default=None)

    @property
    def warm(self) -> bool:
        """True if the solver starts from the multipliers of the last step."""
        return self.solver.warm

    @property
    def exact(self) -> bool:
        """True if the solver finds the multipliers to full precision."""
        return self.solver.exact

    @property
    def smoothing(self) -> Any:
        """The width of the smoothed corners of the laws, for the derivative only [m/s, rad/s]."""
        return self.solver.smoothing

    @property
    def regularization(self) -> Any:
        """The least compliance of rows, as a share of their inverse mass; None for exact laws."""
        return self.solver.regularization

    def check(self) -> None:
        """Checks the numbers of contacts and stops, and the solver.

        Raises:
            ValueError: a number is not a positive integer, or the solver does not solve inequality
                rows.
        """
        for what in ("contacts", "stops"):
            if getattr(self, what) is not None:
                checks.count("ActiveSet", what, getattr(self, what))
        if isinstance(self.solver, ActiveSet) or not hasattr(self.solver, "smoothing"):
            raise ValueError(
                "ActiveSet: solver must be one of inequality rows, as InteriorPoint() or"
                f" GaussSeidel(), got {self.solver!r}."
            )
        checks.derives("ActiveSet", "solver", self.solver, ContactSolver)
        self.solver.check()

    def solve(self, problem: Bounded, start: Array) -> Array:
        """Returns the multipliers λ, (n,), of a problem that has only the chosen rows."""
        return self.solver.solve(problem, start)

    def leaves_out(self, kinds: RowCounts) -> bool:
        """Returns True if the scene has more rows than the limits allow."""
        pairs = ((self.stops, kinds.single), (self.contacts, kinds.contacts))
        return any(most is not None and most < count for most, count in pairs)

    def choose(self, kinds: RowCounts, distance: Array) -> RowChoice:
        """Chooses the one-sided rows and contacts nearest to becoming active, and all other rows.

        Args:
            kinds: numbers of rows by law.
            distance: distance of each row from becoming active, (n,).

        Raises:
            ValueError: contacts are limited in a scene with rolling or spinning resistance.
        """
        parts = kinds.split(distance)
        single = _least(parts.single, self.stops)
        contact = _least(parts.normal, self.contacts)
        boxes = _least(parts.box, None) + kinds.single
        ranks = [kinds.normal + rank * kinds.contacts for rank in range(1 + kinds.tangents)]
        if kinds.turning and len(contact) < kinds.contacts:
            raise ValueError(
                "ActiveSet: contacts that resist rolling or spinning are solved all together; give"
                f" no contacts= in their scene, got {self.contacts} of {kinds.contacts}."
            )
        chosen = RowCounts(len(single), kinds.boxes, len(contact), kinds.tangents, kinds.turning)
        turning = _least(distance[kinds.starts[1] :], None) + kinds.starts[1]
        rows = [single, boxes, *(contact + x for x in ranks), turning]
        return RowChoice(jnp.concatenate(rows), chosen, kinds)


@dataclass(frozen=True)
class RowChoice:
    """A selection of rows, which may differ between worlds.

    Attributes:
        rows: indices of the chosen rows, (k,).
        kinds: numbers of chosen rows by law.
        whole: numbers of all rows by law.
    """

    rows: Array
    kinds: RowCounts
    whole: RowCounts

    def take(self, x: Array) -> Array:
        """Selects the chosen rows, (k, …), from an array of all rows, (n, …)."""
        return jnp.take_along_axis(x, self.rows, axis=0)

    def contacts(self, x: Array) -> Array:
        """Selects the chosen contacts from an array of all contacts, (contacts, …)."""
        normals = self.kinds.split(self.rows).normal - self.whole.normal
        return jnp.take_along_axis(x, normals, axis=0)

    def put(self, x: Array) -> Array:
        """Scatters values of the chosen rows, (k, …), into zeros, (n, …)."""
        return jnp.sum(jnp.where(self.places(), x[None], 0), axis=1)

    def places(self) -> Array:
        """Returns a mask, (n, k, …), that is True at (i, j) if row i is the j-th chosen row."""
        indices = jnp.arange(self.whole.size, dtype=self.rows.dtype)
        return self.rows[None] == indices.reshape(-1, *(1,) * self.rows.ndim)


def _least(x: Array, count: int | None) -> Array:
    """Returns the indices of the `count` smallest entries along the first axis; None means all."""
    if count is None or count >= len(x):
        indices = jnp.arange(len(x), dtype=jnp.int32)
        return jnp.broadcast_to(indices.reshape(-1, *(1,) * (x.ndim - 1)), x.shape)
    x = jnp.where(x == 0, 0, x)  # kernels do not order zeros by their signs
    return jnp.moveaxis(jax.lax.top_k(-jnp.moveaxis(x, 0, -1), count)[1], -1, 0)
