"""The user's own coordinates: q with M(q, θ) and f(q, v, t, u, θ)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions
from jaxcon.core.doubled import rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, PyTree
from jaxcon.model.layout import Place
from jaxcon.model.state import Energy
from jaxcon.model.system import Snapshot
from jaxcon.solvers.jacobian import Columns
from jaxcon.solvers.saddle import Diagonal, Full, Mass, Solution

OWNER = "GeneralizedSystem"
"""The first words of errors."""

WHOLE = Place(0, (0,))
"""All coordinates at once, as the one element of one group."""


@pytree
class GeneralizedCoordinates:
    """A system on the user's own coordinates; `GeneralizedSystem` makes one.

    Attributes:
        constraints: groups of one constraint each.
        params: θ, any pytree; shared by mass, force, potential and constraints.
        mass_function, force_function, potential: the user's functions.
        size: number of coordinates, where known.
        bounds: groups of one one-sided constraint each.
    """

    constraints: tuple[Any, ...]
    params: PyTree
    mass_function: Callable[..., Array] = static()
    force_function: Callable[..., Array] = static()
    potential: Callable[..., Array] | None = static(default=None)
    size: int | None = static(default=None)
    bounds: tuple[Any, ...] = ()

    @property
    def n_v(self) -> int:
        """Number of velocities."""
        if self.size is None:
            raise ValueError("GeneralizedSystem: its size is that of q, which is not known here.")
        return self.size

    def snapshot(self, q: Array, v: Array, t: Any) -> Snapshot:
        """The system at one instant."""
        return Snapshot(dataclasses.replace(self, size=v.shape[0]), q, v, t)

    @property
    def turns(self) -> PyTree:
        """None are counted: the user's coordinates count their own."""
        return ()

    @property
    def counted(self) -> tuple[Any, ...]:
        """None."""
        return ()

    def remember(self, turns: PyTree, remainder: PyTree = ()) -> GeneralizedCoordinates:
        """Itself."""
        return self

    def no_remainder(self, dtype: Any) -> PyTree:
        """None: what is an angle is not known."""
        return ()

    def unwind(self, q: Array) -> tuple[GeneralizedCoordinates, Array]:
        """Itself and q: what is an angle is not known."""
        return self, q

    def rewind(self, q: Array, after: Array) -> tuple[Array, PyTree]:
        """The coordinates after a step, without a remainder."""
        return after, ()

    def count(self, q: Array, v: Array, t: Any) -> PyTree:
        """Nothing."""
        return ()

    def expect(self, here: Snapshot, end: Array, dt: Array, within: bool) -> tuple[PyTree, Array]:
        """Nothing, and nothing is missed."""
        return (), jnp.zeros_like(dt)

    def mass(self, q: Array) -> Mass:
        """M(q, θ), (n_v, n_v), or its diagonal (n_v,) where the user's function gives that."""
        m = functions.call(OWNER, "mass", self.mass_function, q, self.params)
        m = functions.array(OWNER, "mass", m)
        n = q.shape[0]
        if m.shape not in ((n,), (n, n)):
            raise ValueError(
                f"GeneralizedSystem: mass must return ({n},) or ({n}, {n}), got {m.shape}."
            )
        return Diagonal(m) if m.ndim == 1 else Full(m)

    def force(self, q: Array, v: Array, t: Any, control: Any = None) -> Array:
        """f(q, v, t, u, θ), (n_v,)."""
        f = functions.call(
            OWNER, "force", self.force_function, q, v, rounded(t), control, self.params
        )
        f = functions.array(OWNER, "force", f)
        if f.shape != q.shape:
            raise ValueError(f"GeneralizedSystem: force must return {q.shape}, got {f.shape}.")
        return f

    def check(self, q: Array) -> None:
        """Checks what can be checked of the mass matrix at q, where it is known.

        Raises:
            ValueError: it is not symmetric.
        """
        mass = self.mass(q)
        if isinstance(mass, Full) and checks.is_concrete(mass.values):
            known = np.asarray(mass.values)
            if not np.max(np.abs(known - known.T), initial=0) <= 1e-6 * np.max(np.abs(known)):
                raise ValueError(
                    "GeneralizedSystem: mass must return a symmetric matrix, got"
                    f" {checks.clipped(checks.numerals(known))} at q = {checks.numerals(q)}."
                )

    def applied(self, q: Array, v: Array, t: Any, control: Any = None) -> Array:
        """f, (n_v,)."""
        return self.force(q, v, t, control)

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """p: v is q̇."""
        return p

    def extent(self, q: Array) -> Array:
        """max |q|."""
        return jnp.max(jnp.abs(q), axis=0, initial=0)

    def kinematics(self, q: Array, v: Array) -> Array:
        """q̇ = v."""
        return v

    def retract(self, q: Array, step: Array) -> Array:
        """q + Δ."""
        return q + step

    has_bodies: ClassVar[bool] = False
    """False: it is not known what coordinates turn."""

    @property
    def turns_in_space(self) -> bool:
        """No: v is q̇."""
        return False

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """None: v is q̇."""
        return jnp.zeros_like(v)

    def complete(self, solution: Solution) -> Solution:
        """The solution of the saddle system as it is."""
        return solution

    def sizes(self, n_q: int) -> tuple[int, int]:
        """How many positions and velocities a state has, where there are n_q positions."""
        return n_q, n_q

    def normalize(self, q: Array) -> Array:
        """q as it is."""
        return q

    def columns(self, place: Place) -> Columns:
        """All velocities."""
        return Columns(0, self.n_v, 1, place.indices)

    def energy(self, q: Array, v: Array, t: Any) -> Energy:
        """½ vᵀMv, and the user's potential(q, t, θ) where there is one [J]."""
        potential = jnp.zeros((), q.dtype)
        if self.potential is not None:
            potential = self.potential(q, rounded(t), self.params)
        return Energy(v @ self.mass(q).apply(v) / 2, potential)

    def with_params(self, params: PyTree) -> GeneralizedCoordinates:
        """Returns the system with other numbers; nothing is retraced by it.

        Args:
            params: where θ is a mapping, as much of it as changes; another θ elsewhere.

        Raises:
            ValueError: a name that θ does not have.
        """
        return dataclasses.replace(self, params=_changed(self.params, params))


def _changed(known: PyTree, changes: PyTree) -> PyTree:
    """Known mappings with some of their values changed, those of mappings within them likewise."""
    if not (isinstance(known, dict) and isinstance(changes, Mapping)):
        return changes
    if unknown := [name for name in changes if name not in known]:
        raise ValueError(f"with_params: {unknown} is unknown; known are {list(known)}.")
    return known | {name: _changed(known[name], x) for name, x in changes.items()}
