"""The variational (vakonomic) equations of motion for velocity-level rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rows import RowLayout, Rows, layout_of, linearize
from jaxcon.core import checks
from jaxcon.core.doubled import Doubled, rounded
from jaxcon.core.pytree import pytree, static
from jaxcon.core.typing import Array, DType, PyTree, Scalar
from jaxcon.geometry.pose import Motion
from jaxcon.linear.jacobian import Columns
from jaxcon.linear.saddle import Diagonal, Full, Mass, Solution
from jaxcon.protocols import System
from jaxcon.system.body_system import Snapshot
from jaxcon.system.coordinates import JointCoordinate
from jaxcon.system.layout import Place
from jaxcon.system.state import Energy, State, checked_system


@pytree
class Vakonomic:
    """A system that moves by the variational (vakonomic) equations; `vakonomic` makes one.

    In the physical (d'Alembert) equations the constraint forces of ψ = A v + b = 0 do no virtual
    work. The variational equations instead make ∫ L + μ·ψ dt stationary, as if the rows belonged to
    the Lagrangian L. This adds the momentum p = Aᵀμ to M v. With q̇ = N(q) v, Hamel's equations are

        M a = f + J_hᵀλ − Aᵀμ̇ + Nᵀ ∂(μ·ψ)/∂q − (dAᵀ/dt) μ + ad*_v p,       A a = −γ,

    where J_h has the rows of position constraints φ(q, t) = 0, and γ is the part of ψ̇ without a.
    d/dt is the rate along the motion. ad*_v p is p_ω × ω for bodies in space and zero elsewhere.
    This is the physical saddle system with one more force and with μ̇ = −λ. The force is the
    curvature dθ(·, v) of the form θ = μ·A, with terms of explicit time dependence. If ψ is the rate
    of a φ, the force vanishes for every μ; the variational and the physical motion are then equal.
    Rows with a φ therefore keep the physical equations.

    The velocities of this system are (v, μ): the physical velocities, then one μ for each row
    without a φ. Its positions are the physical positions. It is stepped, batched and differentiated
    like any other system.

    Attributes:
        system: the physical system, a `BodySystem` or `GeneralizedSystem`.
        rows: the row numbers of each constraint, and the rows without a φ.

    References:
        Arnold, Kozlov, Neishtadt, Mathematical Aspects of Classical and Celestial Mechanics (2006),
            section 1.4.
        Bloch, Nonholonomic Mechanics and Control (2003), sections 1.3 and 5.2.
    """

    system: Any  # a System; `kick` and `squared_turn` need the protocol `Bodies`
    rows: RowLayout = static()

    @property
    def layout(self) -> None:
        """None: the velocities have no names, because the multipliers μ belong to no body."""
        return

    @property
    def free(self) -> np.ndarray:
        """The numbers of the rows that do not derive from a position constraint φ = 0.

        Each of these rows has a multiplier μ.
        """
        return np.asarray(self.rows.free)

    def physical(self, state: State) -> State:
        """Returns the state of the physical system, without the multipliers μ.

        Args:
            state: a state of the variational system.
        """
        return dataclasses.replace(state, v=state.v[: state.v.shape[0] - len(self.free)])

    def multipliers(self, state: State, name: str) -> Array:
        """Returns the multipliers μ of a constraint, one for each of its rows without a φ.

        Args:
            state: a state of the variational system.
            name: name of the constraint.
        """
        chosen = np.isin(self.free, self.rows.rows(name))
        return state.v[state.v.shape[0] - len(self.free) :][chosen]

    @property
    def constraints(self) -> tuple[Any, ...]:
        """The constraints of the physical system."""
        return self.system.constraints

    @property
    def forces(self) -> tuple[Any, ...]:
        """The force elements of the physical system."""
        return self.system.forces

    def check(self, q: Array) -> None:
        """Checks numbers of the physical system that depend on q, such as its mass matrix.

        Args:
            q: positions, (n_q,).
        """
        self.system.check(q)

    def columns(self, place: Place) -> Columns:
        """Returns the columns of J of the bodies that a `Place` names."""
        return self.system.columns(place)

    @property
    def params(self) -> Any:
        """The parameters of the physical system."""
        return self.system.params

    @property
    def bounds(self) -> tuple[Any, ...]:
        """An empty tuple, because the system has no inequality constraints."""
        return ()

    def with_params(self, changes: PyTree) -> Self:
        """Returns the system with changed parameters of the physical system."""
        return dataclasses.replace(self, system=self.system.with_params(changes))

    @property
    def turns(self) -> Array | tuple[()]:
        """The expected angles of the joint coordinates whose turns are counted, (n,) [rad]."""
        return self.system.turns

    @property
    def counted(self) -> tuple[JointCoordinate, ...]:
        """The joint coordinates whose whole turns are counted."""
        return self.system.counted

    def with_turns(self, turns: Array | tuple[()], remainder: Array | tuple[()] = ()) -> Self:
        """Returns the system with other expected joint angles and rounding errors.

        Args:
            turns: the expected angles of joint coordinates whose turns are counted, (n,) [rad].
            remainder: the rounding errors of angles in q; () for none.
        """
        return dataclasses.replace(self, system=self.system.with_turns(turns, remainder))

    def no_remainder(self, dtype: DType) -> Array | tuple[()]:
        """Returns the `angle_remainder` of a new state: zeros, or () if angles are not reduced."""
        return self.system.no_remainder(dtype)

    def unwind(self, q: Array) -> tuple[Self, Array]:
        """Moves whole turns of angles in the plane from q to the system.

        Returns:
            The system, which stores the turns; and q, whose angles have no whole turns.
        """
        system, q = self.system.unwind(q)
        return dataclasses.replace(self, system=system), q

    def rewind(self, q: Array, after: Array) -> tuple[Array, Array | tuple[()]]:
        """Restores the whole turns of angles after a step.

        Args:
            q: positions at the start of the step, with whole turns, (n_q,).
            after: positions at the end of the step, computed without whole turns, (n_q,).

        Returns:
            The positions at the end of the step, with whole turns, (n_q,); and the rounding errors
            of their angles, or () if turns are not removed.
        """
        return self.system.rewind(q, after)

    def count(self, q: Array, v: Array, t: Doubled | Scalar) -> Array | tuple[()]:
        """Returns the angles of the joint coordinates whose turns are counted, (n,) [rad].

        The angles include whole turns.
        """
        return self.system.count(q, self._split(v)[0], t)

    def expect(
        self, here: Snapshot, end: Array, dt: Array, within: bool
    ) -> tuple[Array | tuple[()], Array]:
        """Predicts the angles of joint coordinates whose turns are counted, after a step.

        Args:
            here: the snapshot at the start of the step.
            end: v after the step, (n_v,).
            dt: h, () [s].
            within: True if angles are also read inside the step.

        Returns:
            The expected angles, (n,) [rad], and a bound on their error, () [rad].
        """
        return self.system.expect(here, self._split(end)[0], dt, within)

    @property
    def n_v(self) -> int:
        """The number of velocities (v, μ), which include the multipliers μ."""
        return self.system.n_v + len(self.free)

    def sizes(self, n_q: int) -> tuple[int, int]:
        """Returns the numbers of positions and of velocities of a state.

        The multipliers μ count as velocities.

        Args:
            n_q: the length of q.
        """
        positions, velocities = self.system.sizes(n_q)
        return positions, velocities + len(self.free)

    def snapshot(self, q: Array, v: Array, t: Doubled | Scalar) -> Snapshot:
        """Returns the `Snapshot` of the physical system at one instant.

        Args:
            q: positions, (n_q,).
            v: the velocities (v, μ), (n_v,).
            t: time, () [s].
        """
        return self.system.snapshot(q, self._split(v)[0], t)

    def mass(self, q: Array) -> Mass:
        """Returns the mass matrix of (v, μ): M of the physical system, and 1 for each μ."""
        mass, ones = self.system.mass(q), jnp.ones(len(self.free), q.dtype)
        if isinstance(mass, Diagonal):
            return Diagonal(jnp.concatenate([mass.values, ones]))
        return Full(jax.scipy.linalg.block_diag(mass.values, jnp.diag(ones)))

    def force(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """Returns the generalized force on (v, μ), (n_v,).

        It is the physical force f plus the curvature force for v, and zero for μ.
        """
        v, μ = self._split(v)
        f = self.system.force(q, v, t, control)
        return jnp.concatenate([f + self.curvature(q, v, t, μ), jnp.zeros_like(μ)])

    def applied(self, q: Array, v: Array, t: Doubled | Scalar, control: PyTree = None) -> Array:
        """Returns the generalized force on (v, μ) without the gyroscopic force, (n_v,).

        It includes the curvature force for v, and is zero for μ.
        """
        v, μ = self._split(v)
        f = self.system.applied(q, v, t, control)
        return jnp.concatenate([f + self.curvature(q, v, t, μ), jnp.zeros_like(μ)])

    def curvature(self, q: Array, v: Array, t: Doubled | Scalar, μ: Array) -> Array:
        """Returns the curvature force, by which variational and physical equations differ.

        The force is Nᵀ ∂(μ·ψ)/∂q − (dAᵀ/dt) μ + ad*_v Aᵀμ, for velocity-level rows ψ = A v + b = 0
        and q̇ = N(q) v; see the class docstring.

        Args:
            q: positions, (n_q,).
            v: the n_v velocities of the physical system, without μ.
            t: time, () [s].
            μ: the multipliers, one for each velocity-level row.

        Returns:
            The force on the velocities of the physical system, (n_v,).
        """
        system, weights = self.system, jnp.zeros(self.rows.size, q.dtype)
        weights = weights.at[self.free].set(μ)

        def momentum(q: Array, later: Array) -> Array:
            return linearize(system, q, v, Doubled.of(t) + later).jacobian.transpose(weights)

        now = jnp.zeros_like(rounded(t))
        along = (system.kinematics(q, v), jnp.ones_like(now))
        p, ṗ = jax.jvp(momentum, (q, now), along)
        slope = jax.grad(lambda q: linearize(system, q, v, t).rate @ weights)(q)
        (pull,) = jax.vjp(lambda w: system.kinematics(q, w), v)[1](slope)
        return pull - ṗ + system.coadjoint(q, v, p)

    def complete(self, solution: Solution) -> Solution:
        """Replaces the accelerations of μ in a solution by the rates μ̇ = −λ."""
        a, _ = self._split(solution.acceleration)
        rates = -solution.multipliers[self.free]
        return solution._replace(acceleration=jnp.concatenate([a, rates]))

    def kinematics(self, q: Array, v: Array) -> Array:
        """Returns the rates q̇ of the positions, (n_q,); they do not depend on μ."""
        return self.system.kinematics(q, self._split(v)[0])

    def retract(self, q: Array, step: Array) -> Array:
        """Returns the positions q ⊕ Δ after a step Δ = h v, (n_q,).

        Args:
            q: positions, (n_q,).
            step: (Δ, change of μ), (n_v,); the change of μ is ignored.
        """
        return self.system.retract(q, self._split(step)[0])

    @property
    def has_bodies(self) -> bool:
        """True if the physical system consists of bodies."""
        return self.system.has_bodies

    @property
    def turns_in_space(self) -> bool:
        """True if bodies of the system have an orientation in space."""
        return self.system.turns_in_space

    def coadjoint(self, q: Array, v: Array, p: Array) -> Array:
        """Returns the rate ad*_v p of a momentum p in frames that turn with the bodies, (n_v,).

        The rate is p_ω × ω for the angular part p_ω of a body in space, and zero for μ.

        Args:
            q: positions, (n_q,).
            v: the velocities (v, μ), (n_v,).
            p: the momentum in body frames, (n_v,).
        """
        (v, μ), (p, _) = self._split(v), self._split(p)
        return jnp.concatenate([self.system.coadjoint(q, v, p), jnp.zeros_like(μ)])

    def kick(
        self, q: Array, v: Array, acceleration: Array, dt: Array, small: bool = False
    ) -> Array:
        """Returns the velocities (v, μ) after a step h, (n_v,).

        The multipliers become μ + h μ̇. For bodies in space, the free rotation within the step is
        integrated separately.

        Args:
            q: positions, (n_q,).
            v: the velocities (v, μ) before the step, (n_v,).
            acceleration: the accelerations (a, μ̇) at q and v, (n_v,).
            dt: h, (1,) [s].
            small: True for a cheaper rule, for bodies that turn by far less than a radian.
        """
        (v, μ), (a, rate) = self._split(v), self._split(acceleration)
        return jnp.concatenate([self.system.kick(q, v, a, dt, small), μ + dt * rate])

    def gyroscopic_acceleration(self, q: Array, v: Array) -> Array:
        """Returns the accelerations of bodies on which no forces act, (n_v,), and zero for μ."""
        v, μ = self._split(v)
        return jnp.concatenate([self.system.gyroscopic_acceleration(q, v), jnp.zeros_like(μ)])

    def rotate(self, q: Array, v: Array, dt: Array) -> Array:
        """Returns the velocities (v, μ) after a free rotation of the bodies over h, (n_v,).

        The multipliers μ are unchanged.

        Args:
            q: positions, (n_q,).
            v: the velocities (v, μ), (n_v,).
            dt: h, (1,) [s].
        """
        v, μ = self._split(v)
        return jnp.concatenate([self.system.rotate(q, v, dt), μ])

    def in_turned_frames(self, q: Array, step: Array, p: Array) -> Array:
        """Converts a velocity change to body frames that have turned by a step Δ, (n_v,).

        The part of the change for μ stays as it is.

        Args:
            q: positions, (n_q,).
            step: Δ, (n_v,).
            p: the velocity change in the body frames before the turn, (n_v,).
        """
        (step, _), (p, rest) = self._split(step), self._split(p)
        return jnp.concatenate([self.system.in_turned_frames(q, step, p), rest])

    def squared_turn(self, q: Array, v: Array, before: Array, rows: Rows, dt: Array) -> Array:
        """Returns the square of the largest turn of a body or rod in a step, () [rad²].

        Args:
            q: positions, (n_q,).
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
        """
        v, before = self._split(v)[0], self._split(before)[0]
        return self.system.squared_turn(q, v, before, rows, dt)

    def squared_turns(
        self, v: Array, before: Array, rows: Rows, dt: Array, whole: bool = False
    ) -> Array:
        """Returns for each row the square of the largest turn of its arms and axes, (n_c,) [rad²].

        Args:
            v: velocities of the step, (n_v,).
            before: velocities at which the rows were computed, (n_v,).
            rows: the constraint rows.
            dt: h, (1,) [s].
            whole: True to include rotation about an arm or axis, which does not turn it.
        """
        v, before = self._split(v)[0], self._split(before)[0]
        return self.system.squared_turns(v, before, rows, dt, whole)

    def carry(self, q: Array, step: Array, p: Array) -> Array:
        """Returns (dexp⁻¹_Δ)ᵀ p, (n_v,): a momentum after a step Δ, pulled back to its start.

        The part of p for μ is unchanged.

        Args:
            q: positions, (n_q,).
            step: Δ = h v, (n_v,).
            p: the momentum, (n_v,).
        """
        (step, _), (p, rest) = self._split(step), self._split(p)
        return jnp.concatenate([self.system.carry(q, step, p), rest])

    def extent(self, q: Array) -> Array:
        """Returns the largest absolute value of a position coordinate, () [m]."""
        return self.system.extent(q)

    def normalize(self, q: Array) -> Array:
        """Returns q with quaternions scaled to length one."""
        return self.system.normalize(q)

    def energy(self, q: Array, v: Array, t: Doubled | Scalar) -> Energy:
        """Returns the energy of the physical system [J].

        If ψ is homogeneous in v, the multipliers μ add no energy.
        """
        return self.system.energy(q, self._split(v)[0], t)

    def kinetic_energy(self, q: Array, v: Array) -> Array:
        """Returns the kinetic energy ½ vᵀMv of the physical system, () [J]."""
        return self.system.kinetic_energy(q, self._split(v)[0])

    def motion(self, name: str, q: Array, v: Array) -> Motion:
        """Returns the motion of a body in the frame that the user gave it, as arrays."""
        return self.system.motion(name, q, self._split(v)[0])

    def _split(self, v: Array) -> tuple[Array, Array]:
        """Splits (v, μ) into the velocities v of the physical system and the multipliers μ."""
        n = v.shape[0] - len(self.free)
        return v[:n], v[n:]


def vakonomic(
    system: System, state: State, multipliers: Mapping[str, Any] | None = None
) -> tuple[Vakonomic, State]:
    """Replaces the physical equations by the variational ones, for all velocity-level rows.

    Velocity-level rows ψ = 0 are the rows that do not derive from a position constraint φ = 0. The
    variational equations describe optimal control, where the rows restrict the choice of motions. A
    wheel or a skate obeys the physical equations instead. A variational motion needs initial
    multipliers μ, besides q and v.

    Args:
        system: a `BodySystem` or `GeneralizedSystem`.
        state: the initial state of the physical system.
        multipliers: μ by constraint name, () or (rows without a φ,); zero for other constraints.

    Returns:
        The variational system, and its initial state.

    Raises:
        ValueError: an unknown name, a constraint whose rows all have a φ, a wrong shape, or a
            system with inequality rows.
    """
    if not isinstance(multipliers, Mapping | None):
        raise TypeError(
            "vakonomic: multipliers must be a mapping from names of constraints to μ, got"
            f" {checks.shortened(multipliers)}."
        )
    checked = checked_system(system, state, "jc.systems.vakonomic(system, s)")
    if system.bounds:
        names = [name for group in system.bounds for name in group.names]
        raise ValueError(
            f"vakonomic: there is no variational form of the inequality rows of {names} here; build"
            " the scene without these elements."
        )
    layout = layout_of(checked, state.q, state.v, state.instant)
    result = Vakonomic(system, layout)
    μ = jnp.zeros(len(result.free), state.v.dtype)
    for name, given in (multipliers or {}).items():
        indices = np.flatnonzero(np.isin(result.free, layout.rows(name)))
        if not len(indices):
            others = [n for n in layout.names if not np.all(layout.holonomic[layout.rows(n)])]
            raise ValueError(
                f"vakonomic: constraint '{name}' has a φ in each of its rows and takes no μ; those"
                f" that take one are {others}."
            )
        shape = np.shape(checks.check("vakonomic", f"μ of '{name}'", given)) and (len(indices),)
        value = checks.real(f"vakonomic: '{name}'", "μ", given, μ.dtype, shape)
        μ = μ.at[indices].set(value)
    return result, dataclasses.replace(state, v=jnp.concatenate([state.v, μ]))
