"""The variational equations of rows of velocities, beside the physical ones (chapter 3.8.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, layout_of, linearize
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled, rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array
from jaxcon.geometry.pose import Motion
from jaxcon.model.state import Energy, State, at
from jaxcon.solvers.saddle import Diagonal, Full, Mass, Solution


@pytree
class Vakonomic:
    """A system under the variational equations; `vakonomic` makes one.

    The physical (d'Alembert) equations let the forces of ψ = A v + b = 0 do no virtual work. The
    variational ones ask that ∫ L + μ·ψ dt be stationary, as if the rows belonged to the Lagrangian,
    and so give the motion the momentum p = Aᵀμ besides its own. With q̇ = N(q) v, Hamel's equations
    are

        M a = f + J_hᵀλ − Aᵀμ̇ + Nᵀ ∂(μ·ψ)/∂q − (dAᵀ/dt) μ + ad*_v p,       A a = −γ,

    where d/dt follows the motion and ad*_v p is p_ω × ω on every body in space and nothing
    elsewhere. It is the physical saddle system with one more force, the curvature dθ(·, v) of the
    form θ = μ·A (and what depends on time), and μ̇ = −λ. That force vanishes for every μ where ψ is
    the rate of a φ: then both motions are the same. Rows that have a φ stay physical.

    Its velocities are (v, μ), the μ of every row without a φ behind those of the system; positions
    are the system's. It is stepped, batched and differentiated like any other system.

    Attributes:
        system: the physical one, a `BodySystem` or `GeneralizedSystem`.
        rows: which rows belong to which constraint, and which have no φ.

    References:
        Arnold, Kozlov, Neishtadt, Mathematical Aspects of Classical and Celestial Mechanics (2006),
            section 1.4.
        Bloch, Nonholonomic Mechanics and Control (2003), sections 1.3 and 5.2.
    """

    system: Any
    rows: RowLayout = static()

    @property
    def free(self) -> np.ndarray:
        """Numbers of the rows that have a μ."""
        return np.asarray(self.rows.free)

    def physical(self, state: State) -> State:
        """A state of the physical system: without μ.

        Args:
            state: of this system.
        """
        return dataclasses.replace(state, v=state.v[: state.v.shape[0] - len(self.free)])

    def multipliers(self, state: State, name: str) -> Array:
        """μ of a constraint, by those of its rows that have no φ.

        Args:
            state: of this system.
            name: of the constraint.
        """
        mine = np.isin(self.free, self.rows.rows(name))
        return state.v[state.v.shape[0] - len(self.free) :][mine]

    @property
    def constraints(self) -> tuple[Any, ...]:
        """The constraints of the system."""
        return self.system.constraints

    @property
    def params(self) -> Any:
        """The parameters of the system."""
        return self.system.params

    @property
    def bounds(self) -> tuple[Any, ...]:
        """None, as of the physical system."""
        return ()

    def with_params(self, changes: Any) -> Vakonomic:
        """With other parameters of the system."""
        return dataclasses.replace(self, system=self.system.with_params(changes))

    @property
    def turns(self) -> Any:
        """The angles that the system counts."""
        return self.system.turns

    @property
    def counted(self) -> Any:
        """Which these are."""
        return self.system.counted

    def remember(self, turns: Any, remainder: Any = ()) -> Vakonomic:
        """With other angles near which those that are counted lie, and remainders of others."""
        return dataclasses.replace(self, system=self.system.remember(turns, remainder))

    def no_remainder(self, dtype: Any) -> Any:
        """The `angle_remainder` of a state that has made no turns."""
        return self.system.no_remainder(dtype)

    def unwind(self, q: Array) -> tuple[Vakonomic, Array]:
        """The system that knows the whole turns in q, and q without them."""
        system, q = self.system.unwind(q)
        return dataclasses.replace(self, system=system), q

    def rewind(self, q: Array, after: Array) -> tuple[Array, Any]:
        """The coordinates after a step with their whole turns, and what rounding takes of them."""
        return self.system.rewind(q, after)

    def count(self, q: Array, v: Array, t: Any) -> Any:
        """The angles that the system counts."""
        return self.system.count(q, self._split(v)[0], t)

    def expect(self, here: Any, end: Array, dt: Array, within: bool) -> Any:
        """Returns the expected angles after a step, and by how much they may be off."""
        return self.system.expect(here, self._split(end)[0], dt, within)

    def sizes(self, n_q: int) -> tuple[int, int]:
        """How many positions and velocities a state has, μ among them."""
        positions, velocities = self.system.sizes(n_q)
        return positions, velocities + len(self.free)

    def snapshot(self, q: Array, v: Array, t: Any) -> Any:
        """The system at one instant."""
        return self.system.snapshot(q, self._split(v)[0], t)

    def mass(self, q: Array) -> Mass:
        """M, and 1 for each μ, which no row touches."""
        mass, more = self.system.mass(q), jnp.ones(len(self.free), q.dtype)
        if isinstance(mass, Diagonal):
            return Diagonal(jnp.concatenate([mass.values, more]))
        return Full(jax.scipy.linalg.block_diag(mass.values, jnp.diag(more)))

    def force(self, q: Array, v: Array, t: Any, control: Any = None) -> Array:
        """f and the force of the curvature; nothing on μ."""
        v, μ = self._split(v)
        f = self.system.force(q, v, t, control)
        return jnp.concatenate([f + self.curvature(q, v, t, μ), jnp.zeros_like(μ)])

    def curvature(self, q: Array, v: Array, t: Any, μ: Array) -> Array:
        """Nᵀ ∂(μ·ψ)/∂q − (dAᵀ/dt) μ + ad*_v Aᵀμ, (n_v,)."""
        system, every = self.system, jnp.zeros(self.rows.size, q.dtype)
        every = every.at[self.free].set(μ)

        def momentum(q: Array, later: Any) -> Array:
            return linearize(system, q, v, Doubled.of(t) + later).jacobian.transpose(every)

        now = jnp.zeros_like(rounded(t))
        along = (system.kinematics(q, v), jnp.ones_like(now))
        p, ṗ = jax.jvp(momentum, (q, now), along)
        slope = jax.grad(lambda q: linearize(system, q, v, t).rate @ every)(q)
        (pull,) = jax.vjp(lambda w: system.kinematics(q, w), v)[1](slope)
        return pull - ṗ + system.coadjoint(q, v, p)

    def complete(self, solution: Solution) -> Solution:
        """μ̇ = −λ beside the accelerations."""
        a, _ = self._split(solution.acceleration)
        rates = -solution.multipliers[self.free]
        return solution._replace(acceleration=jnp.concatenate([a, rates]))

    def kinematics(self, q: Array, v: Array) -> Array:
        """q̇ (n_q,)."""
        return self.system.kinematics(q, self._split(v)[0])

    def retract(self, q: Array, step: Array) -> Array:
        """q ⊕ Δ."""
        return self.system.retract(q, self._split(step)[0])

    @property
    def has_bodies(self) -> bool:
        """True where the system is one of bodies."""
        return self.system.has_bodies

    @property
    def turns_in_space(self) -> bool:
        """True where bodies of the system have an orientation in space."""
        return self.system.turns_in_space

    def kick(self, q: Array, v: Array, acceleration: Array, dt: Any, small: bool = False) -> Array:
        """The velocities after a step of h as those of the system, and μ + h μ̇."""
        (v, μ), (a, rate) = self._split(v), self._split(acceleration)
        return jnp.concatenate([self.system.kick(q, v, a, dt, small), μ + dt * rate])

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """The gyroscopic part of a as that of the system, and none of μ̇."""
        v, μ = self._split(v)
        return jnp.concatenate([self.system.gyroscopic_acceleration(q, v), jnp.zeros_like(μ)])

    def rotate(self, q: Array, v: Array, dt: Any) -> Array:
        """The velocities after a free rotation as those of the system, and μ as it is."""
        v, μ = self._split(v)
        return jnp.concatenate([self.system.rotate(q, v, dt), μ])

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """Velocities as those of the system, and μ as it is."""
        (step, _), (p, rest) = self._split(step), self._split(p)
        return jnp.concatenate([self.system.in_turned_frames(q, step, p), rest])

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Any, dt: Any) -> Array:
        """The square of the largest turn in a step, as of the system, () [rad²]."""
        v, before = self._split(v)[0], self._split(before)[0]
        return self.system.squared_turn(q, v, before, rows, dt)

    def squared_turns(
        self, v: Array, before: Array, rows: Any, dt: Any, whole: bool = False
    ) -> Array:
        """The square of the largest turn of what each row holds, as of the system, (n_c,)."""
        v, before = self._split(v)[0], self._split(before)[0]
        return self.system.squared_turns(v, before, rows, dt, whole)

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """A momentum along a step as that of the system, and what goes with μ as it is."""
        (step, _), (p, rest) = self._split(step), self._split(p)
        return jnp.concatenate([self.system.carry(q, step, p), rest])

    def extent(self, q: Array) -> Array:
        """The largest place, as of the system, ()."""
        return self.system.extent(q)

    def normalize(self, q: Array) -> Array:
        """q with its quaternions brought back to unit length."""
        return self.system.normalize(q)

    def energy(self, q: Array, v: Array, t: Any) -> Energy:
        """Returns the energy of the system [J]; μ, whose rows are homogeneous in v, adds none."""
        return self.system.energy(q, self._split(v)[0], t)

    def motion(self, name: str, q: Array, v: Array) -> Motion:
        """The motion of a body in the frame in which the user gave it."""
        return self.system.motion(name, q, self._split(v)[0])

    def _split(self, v: Array) -> tuple[Array, Array]:
        n = v.shape[0] - len(self.free)
        return v[:n], v[n:]


def vakonomic(
    system: Any, state: State, multipliers: Mapping[str, Any] | None = None
) -> tuple[Vakonomic, State]:
    """The variational equations in place of the physical ones, for all rows without a φ.

    They are the equations of optimal control, where rows say which motions are possible and not
    which force keeps to them; a wheel or a skate obeys the physical ones. A motion needs μ at the
    start besides q and v.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: at the start.
        multipliers: μ by constraint name, () or (rows without a φ,); zero for the others.

    Returns:
        The variational system, and its state.

    Raises:
        ValueError: an unknown name, one whose rows all have a φ, or a wrong shape; bounded rows.
    """
    if not isinstance(multipliers, Mapping | None):
        raise TypeError(
            "vakonomic: multipliers must be a mapping from names of constraints to μ, got"
            f" {checks.shortened(multipliers)}."
        )
    if system.bounds:
        names = [name for group in system.bounds for name in group.names]
        raise ValueError(
            f"vakonomic: there is no variational form of the bounded rows of {names} here; build"
            " the scene without these elements."
        )
    layout = layout_of(at(system, state), state.q, state.v, state.instant)
    result = Vakonomic(system, layout)
    μ = jnp.zeros(len(result.free), state.v.dtype)
    for name, given in (multipliers or {}).items():
        mine = np.flatnonzero(np.isin(result.free, layout.rows(name)))
        if not len(mine):
            raise ValueError(
                f"vakonomic: constraint '{name}' has a φ in each of its rows and takes no μ; those"
                f" that take one are {[n for n in layout.names if _takes(layout, n)]}."
            )
        shape = np.shape(checks.check("vakonomic", f"μ of '{name}'", given)) and (len(mine),)
        value = checks.real(f"vakonomic: '{name}'", "μ", given, μ.dtype, shape)
        μ = μ.at[mine].set(value)
    return result, dataclasses.replace(state, v=jnp.concatenate([state.v, μ]))


def _takes(layout: RowLayout, name: str) -> bool:
    """Returns True where a constraint has a row without a φ."""
    return not np.all(layout.holonomic[layout.rows(name)])
