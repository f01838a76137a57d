"""Systems on generalized coordinates, with a mass matrix M(q, θ) and forces f from the user."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Self

import jax.numpy as jnp
import numpy as np

from jaxcon.core import checks, functions
from jaxcon.core.doubled import Doubled, rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.summary import by_class, of_class, table
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.linear.jacobian import Columns
from jaxcon.linear.saddle import Diagonal, Full, Mass, Solution
from jaxcon.system.body_system import Snapshot
from jaxcon.system.layout import Place
from jaxcon.system.state import Energy

OWNER = "GeneralizedSystem"
"""The first word of error messages."""


@pytree
class GeneralizedCoordinates:
    """A system on generalized coordinates; `GeneralizedSystem` makes one.

    Attributes:
        constraints: groups of one constraint each.
        params: θ, any pytree, for mass, force, potential and constraints.
        mass_function, force_function, potential: functions of the user for the mass matrix, the
            forces and the potential energy.
        size: number of coordinates; None if unknown.
        bounds: groups of one inequality constraint each.
    """

    constraints: tuple[Any, ...]
    params: PyTree
    mass_function: Callable[..., Array] = static()
    force_function: Callable[..., Array] = static()
    potential: Callable[..., Array] | None = static(default=None)
    size: int | None = static(default=None)
    bounds: tuple[Any, ...] = ()

    def __repr__(self) -> str:
        """Describes the system: the user's functions, and the names of the constraints."""
        groups = (*self.constraints, *self.bounds)
        names = [(of_class(group.law), name) for group in groups for name in group.names]
        rows = [
            ("mass", getattr(self.mass_function, "__name__", "")),
            ("force", getattr(self.force_function, "__name__", "")),
            *by_class(names),
        ]
        return table("GeneralizedCoordinates", rows)

    @property
    def layout(self) -> None:
        """None, because coordinates have no names."""
        return

    @property
    def n_v(self) -> int:
        """The number of velocities.

        Raises:
            ValueError: the number is unknown.
        """
        if self.size is None:
            raise ValueError("GeneralizedSystem: its size is that of q, which is not known here.")
        return self.size

    def snapshot(self, q: Array, v: Array, t: Doubled | Scalar) -> Snapshot:
        """Returns the system at one instant, as a `Snapshot`."""
        return Snapshot(dataclasses.replace(self, size=v.shape[0]), q, v, t)

    forces = ()
    """Empty: the forces come from the user's function."""

    turns = counted = ()
    """Empty: generalized coordinates include whole turns."""

    def with_turns(self, turns: Array | tuple[()], remainder: Array | tuple[()] = ()) -> Self:
        """Returns the system unchanged, because coordinates include whole turns."""
        return self

    def no_remainder(self, dtype: DType) -> Array | tuple[()]:
        """Returns an empty tuple, because no turns are removed from coordinates."""
        return ()

    def unwind(self, q: Array) -> tuple[Self, Array]:
        """Returns the system and q unchanged, because no turns are removed from coordinates."""
        return self, q

    def rewind(self, q: Array, after: Array) -> tuple[Array, Array | tuple[()]]:
        """Returns the coordinates after a step unchanged, and no rounding errors of angles."""
        return after, ()

    def count(self, q: Array, v: Array, t: Doubled | Scalar) -> Array | tuple[()]:
        """Returns an empty tuple, because no joint angles are counted."""
        return ()

    def expect(
        self, here: Snapshot, end: Array, dt: Array, within: bool
    ) -> tuple[Array | tuple[()], Array]:
        """Returns an empty tuple of expected angles, and an error bound of zero, ()."""
        return (), jnp.zeros_like(dt)

    def mass(self, q: Array) -> Mass:
        """Returns the mass matrix M(q, θ), (n_v, n_v), or its diagonal (n_v,).

        A matrix that is not symmetric becomes NaN, which ends the world.

        Raises:
            ValueError: the user's function returns another shape.
        """
        m = functions.call(OWNER, "mass", self.mass_function, q, self.params)
        m, n = functions.array(OWNER, "mass", m), q.shape[0]
        if m.shape not in ((n,), (n, n)):
            raise ValueError(
                f"GeneralizedSystem: mass must return ({n},) or ({n}, {n}), got {m.shape}."
            )
        if m.ndim == 1:
            return Diagonal(m)
        # factorizations read one triangle: with another one the motion would be silently wrong
        skew, size = (jnp.max(jnp.abs(x), initial=0) for x in (m - m.T, m))
        symmetric = skew <= float(jnp.finfo(m.dtype).eps) ** 0.5 * size
        return Full(jnp.where(symmetric, m, jnp.full_like(m, jnp.nan)))

    def force(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """Returns the generalized force f(q, v, t, u, θ), (n_v,).

        Raises:
            ValueError: the user's function returns another shape.
        """
        f = functions.call(
            OWNER, "force", self.force_function, q, v, rounded(t), control, self.params
        )
        f = functions.array(OWNER, "force", f)
        if f.shape != q.shape:
            raise ValueError(f"GeneralizedSystem: force must return {q.shape}, got {f.shape}.")
        return f

    def check(self, q: Array) -> None:
        """Checks that a concrete mass matrix at q is symmetric.

        Raises:
            ValueError: the mass matrix is not symmetric.
        """
        mass = self.mass(q)
        if isinstance(mass, Full) and checks.is_concrete(mass.values):
            values = np.asarray(mass.values)
            skew, size = (np.max(np.abs(x), initial=0) for x in (values - values.T, values))
            if not skew <= 1e-6 * size:
                raise ValueError(
                    "GeneralizedSystem: mass must return a symmetric matrix, got"
                    f" {checks.clipped(checks.numerals(values))} at q = {checks.numerals(q)}."
                )

    applied = force

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """Returns a momentum p pulled back to the start of a step: p unchanged, because v is q̇."""
        return p

    def extent(self, q: Array) -> Array:
        """Returns the largest |q| of all coordinates, ()."""
        return jnp.max(jnp.abs(q), axis=0, initial=0)

    def kinematics(self, q: Array, v: Array) -> Array:
        """Returns the rates of coordinates, q̇ = v."""
        return v

    def retract(self, q: Array, step: Array) -> Array:
        """Returns the coordinates after a step Δ, q + Δ."""
        return q + step

    @property
    def has_bodies(self) -> bool:
        """False: the coordinates need not belong to bodies."""
        return False

    turns_in_space = False
    """False: no coordinates describe an orientation in space, so v is q̇."""

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """Returns the rate of a momentum p due to turning frames: zero, because v is q̇."""
        return jnp.zeros_like(v)

    def complete(self, solution: Solution) -> Solution:
        """Returns the solution of the saddle system unchanged: it contains all accelerations."""
        return solution

    def sizes(self, n_q: int) -> tuple[int, int]:
        """Returns the numbers of positions and of velocities, both n_q."""
        return n_q, n_q

    def normalize(self, q: Array) -> Array:
        """Returns q unchanged, because it contains no quaternion."""
        return q

    def columns(self, place: Place) -> Columns:
        """Returns the indices of all velocities, as columns of J."""
        return Columns(0, self.n_v, 1, place.indices)

    def energy(self, q: Array, v: Array, t: Doubled | Scalar) -> Energy:
        """Returns the kinetic energy ½ vᵀMv, and the user's potential(q, t, θ) or zero [J].

        Raises:
            ValueError: the user's function returns another shape.
        """
        potential = jnp.zeros((), q.dtype)
        if self.potential is not None:
            potential = functions.call(
                OWNER, "potential", self.potential, q, rounded(t), self.params
            )
            potential = functions.array(OWNER, "potential", potential)
            if potential.shape != ():
                raise ValueError(
                    f"GeneralizedSystem: potential must return (), got {potential.shape}."
                )
        return Energy(v @ self.mass(q).apply(v) / 2, potential)

    def with_params(self, params: PyTree) -> Self:
        """Returns the system with other parameters. Compiled programs are reused.

        Args:
            params: the entries of θ that change if θ is a mapping; otherwise a new θ.

        Raises:
            ValueError: θ has no entry of this name.
        """

        def changed(known: PyTree, changes: PyTree) -> PyTree:
            if not (isinstance(known, dict) and isinstance(changes, Mapping)):
                return changes
            if unknown := [name for name in changes if name not in known]:
                raise ValueError(f"with_params: {unknown} is unknown; known are {list(known)}.")
            return known | {name: changed(known[name], x) for name, x in changes.items()}

        return dataclasses.replace(self, params=changed(self.params, params))
