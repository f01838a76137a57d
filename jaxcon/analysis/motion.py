"""Estimates how far the fastest motions turn or oscillate in one step. Host code."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxcon.constraints.rank import UnitRows, linearized
from jaxcon.constraints.rows import linearize
from jaxcon.core import host
from jaxcon.core.typing import Array, PyTree
from jaxcon.methods.stability import largest_stable_rate
from jaxcon.protocols import System
from jaxcon.system.state import State

if TYPE_CHECKING:
    from jaxcon.analysis.setup import Setup

MOST_VELOCITIES = 150
"""The largest n_v for which natural frequencies are computed, which costs O(n_v³) operations."""
LEAST = 1e-12
"""The length of a velocity, in the metric of M, below which it counts as zero."""


class Rate(NamedTuple):
    """An angular speed, and the body or coordinate that has it.

    Attributes:
        value: the angular speed [rad/s].
        name: name of the body or coordinate.
    """

    value: float
    name: str


@dataclasses.dataclass(frozen=True)
class StepAngle:
    """The angles by which the fastest motions turn or oscillate in one step.

    Attributes:
        turning: the largest angular speed at the velocities of the state.
        swinging: the largest angular rate that gravity and springs can cause from rest. It is the
            maximum of three rates: the natural frequencies at this position; √|α|, with a body's
            angular acceleration α; and √(κ |a|), with the curvature κ of the constrained path and
            the acceleration a along it.
        dt: step size h [s].
        limit: the largest h ω at which the integrator is stable for an undamped oscillation of
            frequency ω; 2 for semi-implicit Euler. It is 0 if no step size is stable, and infinite
            if every step size is. In the last case `swinging` ignores natural frequencies.
    """

    turning: Rate
    swinging: Rate
    dt: float
    limit: float

    @property
    def turn(self) -> float:
        """The angle h |ω| of the fastest rotation in one step, at the current velocities [rad]."""
        return self.dt * self.turning.value

    @property
    def swing(self) -> float:
        """The angle h ω per step of the fastest motion that gravity and springs can cause [rad]."""
        return self.dt * self.swinging.value

    def __str__(self) -> str:
        parts = [f"h|ω| = {self.turn:.2g} rad by the velocities of the state"]
        parts[0] += f" ({self.turning.name})" if self.turning.value else ""
        if self.swinging.value:
            parts.append(
                f"h ω = {self.swing:.2g} by gravity and springs ({self.swinging.name})"
                + (f", stable below {self.limit:.3g}" if 0 < self.limit < np.inf else "")
            )
        return f"fastest motion in a step: {'; '.join(parts)}"


def step_angle(setup: Setup) -> StepAngle | None:
    """Returns the angles of the fastest motions in one step; None without a step size."""
    if setup.dt is None:
        return None
    system, state, dtype = setup.system, setup.state, setup.state.q.dtype
    v = np.asarray(state.v, np.float64)
    force = np.asarray(host.evaluate(_force, system, state, setup.control), np.float64)
    unit, factor = _with_rotors(setup)
    # in the metric of M, splits the forces at rest into constraint reactions and the remainder
    pull = np.linalg.solve(factor, force)
    inverse = np.linalg.pinv(unit.values, rcond=unit.tolerance) if len(unit.values) else None
    reaction = np.zeros(0) if inverse is None else -(pull @ inverse)
    along = pull if inverse is None else pull + unit.values.T @ reaction
    a = np.linalg.solve(factor.T, along)
    at_rest = dataclasses.replace(state, v=np.zeros(len(v), dtype))
    driven = np.asarray(linearized(system, at_rest)[0].bias, np.float64)
    bends = np.asarray(setup.rows.bias, np.float64) - driven
    turning = max(_spin(system, v), _curved(setup, (unit, factor), bends, v, inverse), key=_value)
    swinging = [_root(_spin(system, a))]
    at_a = dataclasses.replace(state, v=np.asarray(a, dtype))
    bends = np.asarray(linearized(system, at_a)[0].bias, np.float64) - driven
    swinging.append(_root(_curved(setup, (unit, factor), bends, a, inverse)))
    limit = largest_stable_rate(setup.method.integrator, 1.0, 0.0)
    # integrators stable at every step size are chosen for stiff springs and light masses
    if len(v) <= MOST_VELOCITIES and np.isfinite(limit):
        λ = np.zeros(setup.rows.layout.size)
        λ[unit.numbers] = reaction / unit.length
        swinging.append(_natural(setup, unit, factor, λ))
    return StepAngle(turning, max(swinging, key=_value), setup.dt, limit)


def _with_rotors(setup: Setup) -> tuple[UnitRows, np.ndarray]:
    """Adds the inertia of rotors to the mass matrix M.

    Returns:
        The constraint rows, scaled to unit length in the metric of the sum M; and the Cholesky
        factor L of the sum, M = L Lᵀ.
    """
    mass, layout = np.asarray(setup.mass, np.float64), setup.rows.layout
    if not layout.inertial:
        return setup.unit, np.linalg.cholesky(mass)
    rotors = np.concatenate([layout.rows(name) for name in layout.inertial])
    j = np.asarray(setup.jacobian, np.float64)[rotors]
    inertia = 1 / np.asarray(setup.rows.compliance, np.float64)[rotors]
    mass = mass + j.T @ (inertia[:, None] * j)
    return UnitRows(layout, setup.jacobian, mass), np.linalg.cholesky(mass)


def _value(rate: Rate) -> float:
    """Returns the speed of a `Rate`; a key function for `max`."""
    return rate.value


def _root(rate: Rate) -> Rate:
    """Returns a `Rate` with the square root √x [rad/s] of a given value x [rad/s²].

    x is an angular acceleration, or κ |a| of a path with curvature κ and acceleration a.
    """
    return Rate(float(np.sqrt(rate.value)), rate.name)


def _spin(system: System, v: np.ndarray) -> Rate:
    """Returns the largest angular speed of all bodies, with the name of the body.

    Args:
        system: the system. The result is 0 if it has no bodies.
        v: velocities, (n_v,). For accelerations, the result is the largest angular acceleration.
    """
    layout = system.layout
    if layout is None:
        return Rate(0.0, "")
    rates = [
        Rate(float(np.linalg.norm(v[layout.v(name)[layout.dim :]])), name) for name in layout.bodies
    ]
    return max(rates, key=_value, default=Rate(0.0, ""))


def _curved(
    setup: Setup,
    metric: tuple[UnitRows, np.ndarray],
    bends: np.ndarray,
    v: np.ndarray,
    inverse: np.ndarray | None,
) -> Rate:
    """Returns the rate at which constraint forces turn the direction of v, in the metric of M.

    The rate is |Jᵀλ| / |v|. Here λ are the multipliers due to the velocity-dependent part of γ in
    φ̈ = J a + γ.

    Args:
        setup: the scene, its state and the method.
        metric: the unit-length rows, and the Cholesky factor L of M = L Lᵀ.
        bends: γ(v) − γ(0), (n_c,). The difference cancels the accelerations that drives prescribe.
        v: velocities, (n_v,).
        inverse: pseudoinverse of the unit-length rows; None without rows.
    """
    if inverse is None:
        return Rate(0.0, "")
    unit, factor = metric
    bend = inverse @ -(bends[unit.numbers] / unit.length)
    speed = float(np.linalg.norm(factor.T @ v))
    if speed < LEAST:
        return Rate(0.0, "")
    return Rate(float(np.linalg.norm(bend)) / speed, _owner(setup.system, bend))


def _natural(setup: Setup, unit: UnitRows, factor: np.ndarray, λ: np.ndarray) -> Rate:
    """Returns the highest natural frequency √|κ| of the scene at rest.

    κ is the eigenvalue of largest magnitude of the stiffness K = −∂(f + Jᵀλ)/∂q at constant
    multipliers λ. K is projected onto the null space of J, in the metric of M.

    Args:
        setup: the scene, its state and the method.
        unit: the unit-length rows.
        factor: Cholesky factor L of M = L Lᵀ, (n_v, n_v).
        λ: multipliers at rest, (n_c,).
    """
    _, σ, vt = unit.svd if len(unit.values) else (0, (), np.eye(len(factor)))
    rank = int(np.sum(np.asarray(σ) > unit.tolerance))
    free = vt[rank:]
    if not len(free):
        return Rate(0.0, "")
    dtype = setup.state.q.dtype
    moves = np.linalg.solve(factor.T, free.T).T  # of unit length in the metric of M
    change = host.evaluate(
        _stiffness, setup.system, setup.state, setup.control, λ.astype(dtype), moves.astype(dtype)
    )
    k = -np.asarray(change, np.float64) @ moves.T
    if not np.all(np.isfinite(k)):
        return Rate(0.0, "")
    values, vectors = np.linalg.eigh((k + k.T) / 2)
    worst = int(np.argmax(np.abs(values)))
    shape = vectors[:, worst] @ free
    return Rate(float(np.sqrt(np.abs(values[worst]))), _owner(setup.system, shape))


def _owner(system: System, x: np.ndarray) -> str:
    """Returns the name of the body or coordinate whose entries of x, (n_v,), are the largest."""
    layout = system.layout
    if layout is None:
        return f"coordinate {int(np.argmax(np.abs(x)))}"
    return max(layout.bodies, key=lambda name: float(np.linalg.norm(x[layout.v(name)])))


@jax.jit  # jit caches the trace: one trace serves all states of a scene
def _force(system: System, state: State, control: PyTree) -> Array:
    """Returns the applied force f with all velocities zero, (n_v,)."""
    return system.force(state.q, jnp.zeros_like(state.v), state.instant, control)


@jax.jit
def _stiffness(system: System, state: State, control: PyTree, λ: Array, moves: Array) -> Array:
    """Returns the derivative of f + Jᵀλ along displacements at constant λ, (n, n_v).

    Args:
        system: the system.
        state: state of one world.
        control: control input of a step, or None.
        λ: multipliers, (n_c,).
        moves: n displacements, (n, n_v).
    """
    rest = jnp.zeros_like(state.v)

    def pull(step: Array) -> Array:
        q = system.retract(state.q, step)
        force = system.force(q, rest, state.instant, control)
        if not λ.size:
            return force
        rows = linearize(system, q, rest, state.instant)
        return force + λ @ rows.jacobian.dense()

    def along(move: Array) -> Array:
        return jax.jvp(pull, (rest,), (move,))[1]

    return jax.vmap(along)(moves)
